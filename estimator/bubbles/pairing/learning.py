"""What the images of a bubble have in common, learnt from the detections of a run.

The calibration may be off along a shared axis by more than bubbles are apart there, so the gap
alone would give wrong pairs that seem to confirm it. Sizes are independent of the calibration:
every combination of detections votes for its gap by how well the heights agree, the fullest place
is the start, and expectation-maximisation over the pairs' probabilities does the rest. With more
than two cameras the same is repeated with all groups, which show deviations across the axes, too.
The systematic part of the innovations is an offset of each camera, constant, or smooth in space
where groups left out of it agree; a shift of all points, which changes none, is kept small by the
prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.estimator.bubbles.pairing.groups import (
    Cameras,
    Groups,
    View,
    near_pairs,
    possible_groups,
    prior_log_odds,
    shared_axis,
    views_of,
    with_innovations,
)
from telerig.estimator.bubbles.pairing.model import (
    GAP_PX,
    Comparison,
    Finding,
    LogRatioModel,
    PairModel,
    RigModel,
    appearance_log_odds,
)
from telerig.rig.camera import Camera
from telerig.rig.triangulation import nearly_parallel, stacked_jacobian
from telerig.statistics import robust_sd

MOST_FRAMES = 60
"""Frames that are learned from."""

MOST_BIAS_PX = 20.0
"""Largest offset of a calibration that is looked for."""

_VOTE_REACH_PX = 5.0
"""Beyond the largest bias: what a vote spreads to, and what gaps scatter."""

_LIKELY = 0.01
"""Probability of a pair above which it takes part in the fits."""

_START_SCATTER_PX = 1.5
"""Scatter of gaps and of frames' shifts before anything is learned."""

_PASSES, _SETTLED = 6, 1e-3
"""Largest number of passes of expectation-maximisation, and the relative change that ends them."""

_LEAST_UNMATCHED, _MOST_UNMATCHED = 0.05, 0.9
"""Limits of the share of detections without a partner."""

_PRIOR_PAIRS = 3.0
"""Weight of what is usual, in pairs."""

_PRIOR_SCATTER_PX, _SMALLEST_SCATTER_PX = 0.3, 0.02
"""Usual and smallest scatter of the gaps."""

_SMALLEST = {"size": np.diag([0.005, 0.005]) ** 2, "contrast": np.diag([0.02]) ** 2}
_PRIOR = {"size": np.diag([0.03, 0.06]) ** 2, "contrast": np.diag([0.2]) ** 2}
_USUAL = {"size": np.array([[0.17, 0.15], [0.15, 0.17]]), "contrast": np.array([[0.1]])}
"""Covariances of logarithms: smallest and usual ones of a pair's differences, and those of all
bubbles."""

_BIAS_TERMS = (1, 4, 10)
"""Numbers of terms of a bias: constant, linear, quadratic in space."""

_PAIRS_PER_TERM = 3.0
"""Pairs that a bias needs for each term."""

_BETTER = 0.95
"""With more terms the RMS of pairs left out has to be below this share of that with fewer, and the
number of pairs above."""

_PRIOR_BIAS_SD_PX = np.array([10.0] + [2.0] * 3 + [1.0] * 6)
"""Of the coefficients of a bias."""

_LEAST_PROBLEM_PX, _SIGNIFICANT = 0.5, 4.0
"""Offset that is a problem of the calibration: its size, and over its standard error."""

_FEW_PAIRS, _CLEAR_VOTE = 5.0, 3.0
"""Pairs below which no calibration is accused, and height of the vote's peak over its median."""


def default_model(cameras: Sequence[Camera]) -> RigModel:
    """Return the model for finding bubbles in all views before any detection is known.

    It assumes that the calibration is right: its offsets are 0. Raises InputError for cameras whose
    optical axes are all parallel.
    """
    every = list(combinations(range(len(cameras)), 2))
    seen = [(a, b) for a, b in every if not nearly_parallel((cameras[a], cameras[b]))] or every
    size, contrast = (
        LogRatioModel(np.zeros(len(usual)), _PRIOR[name], np.zeros((2, len(usual))), 9.0 * usual)
        for name, usual in _USUAL.items()
    )
    pairs = {}
    for a, b in seen:
        both = cameras[a], cameras[b]
        span = _span_px(both, shared_axis(both))
        pairs[a, b] = PairModel(_PRIOR_SCATTER_PX, 0.0, size, contrast, (0.1, 0.1), span)
    reach = np.full(3, max(c.image_size_px[0] / c["scale_px_per_mm"] / 2 for c in cameras))
    coefficients = 2 * len(cameras)
    return RigModel(
        tuple(cameras), pairs, np.zeros((coefficients, 1)), np.zeros((coefficients, coefficients)),
        np.zeros(3), reach,
    )  # fmt: skip


def learn_rig(frames: Sequence[Sequence[pd.DataFrame]], cameras: Sequence[Camera]) -> RigModel:
    """Learn from a run how the images of one bubble agree in two cameras or more.

    frames : for each frame, the detection tables of all cameras. At most ``MOST_FRAMES`` frames are
        used, evenly spread.

    An offset up to ``MOST_BIAS_PX`` is found. It is a constant, or linear or quadratic in space if
    this predicts groups better that are left out of its fit (at least three groups per term). A
    pair of cameras that see bubbles in no frame together has the finding NO_DETECTIONS.

    Raises InputError for tables without centres or covariances and for parallel cameras.
    """
    model = default_model(cameras)
    some = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MOST_FRAMES)).astype(int))
    if not len(some):
        none = {p: replace(m, findings=(Finding.NO_DETECTIONS,)) for p, m in model.pairs.items()}
        return replace(model, pairs=none)
    tables = [pd.concat(own, ignore_index=True) for own in zip(*(frames[i] for i in some))]
    counts = np.array([[len(table) for table in frames[i]] for i in some])
    views = views_of(tables, model)
    learnt = {pair: _of_pair(model, pair, views, counts) for pair in model.pairs}
    if len(cameras) == 2:
        return learnt[0, 1]
    model = replace(model, pairs={pair: own.pairs[0, 1] for pair, own in learnt.items()})
    return _of_groups(model, views, counts)


def _of_groups(model: RigModel, views: Sequence[View], counts: Ints) -> RigModel:
    """The model of more than two cameras, whose pairs are learnt, with the offsets of all.

    What the pairs do not show of a camera's offset is unknown at the start.
    """
    size = len(model.offset_px)
    information, pull = np.eye(size) / (MOST_BIAS_PX / 2) ** 2, np.zeros(size)
    for pair, axis in model.gap_axes.items():
        gap, error = np.array(model.pairs[pair].mean_gap_px) / GAP_PX
        variance = error**2 + _SMALLEST_SCATTER_PX**2
        information += np.outer(axis, axis) / variance
        pull += axis * gap / variance
    covariance = np.asarray(np.linalg.inv(information))
    model = replace(model, offset_px=(covariance @ pull)[:, None], offset_covariance_px2=covariance)
    best = _learned(model, _Sample(*possible_groups(views, counts, model), counts))
    return replace(best, misplaced=_misplaced(best, len(counts)))


def _of_pair(rig: RigModel, pair: tuple[int, int], views: Sequence[View], counts: Ints) -> RigModel:
    """The model of two of the cameras alone."""
    model = default_model([rig.cameras[c] for c in pair])
    two = [
        replace(v, log_size=v.log_size[:, [k]])
        for c in pair
        for v, k in [(views[c], [p for p in rig.pairs if c in p].index(pair))]
    ]
    counts = counts[:, list(pair)]
    frames = int((counts.min(1) > 0).sum())
    if not frames:
        return _with_pair(model, findings=(Finding.NO_DETECTIONS,))

    def near(found: Comparison) -> Bools:
        return np.asarray(np.abs(found.gap_px) < MOST_BIAS_PX + _VOTE_REACH_PX)

    found, rows, frame = near_pairs(model, (0, 1), two, counts, near)
    groups = Groups.of(_with_pair(model, scatter_px=GAP_PX), two, rows)
    starts = np.cumsum(counts, axis=0) - counts
    groups = replace(groups, rows=rows - starts[frame])
    sample = _Sample(groups, frame, counts, found)
    model = _populations(model, two)
    start, votes = _vote(sample, model)
    offset = model.gap_axes[0, 1][:, None] * start / GAP_PX
    middle = np.median(groups.points_mm, axis=0) if len(rows) else np.zeros(3)
    model = _with_pair(
        replace(model, offset_px=offset, origin_mm=middle),
        scatter_px=_START_SCATTER_PX, frame_px=_START_SCATTER_PX if frames > 1 else 0.0,
    )  # fmt: skip
    best = _learned(model, sample)
    return _with_pair(best, findings=_findings(best.pairs[0, 1], votes))


def _with_pair(model: RigModel, **changes: Any) -> RigModel:
    """The model of two cameras with changes of its pair."""
    return replace(model, pairs={(0, 1): replace(model.pairs[0, 1], **changes)})


@dataclass(frozen=True)
class _Sample:
    """Groups of the detections of F frames whose deviations an offset may explain.

    groups, frame : E groups, with the rows of their frames, and these (E,).
    counts : (F, C) detections of the frames.
    found : what is compared of E pairs of two cameras, whose appearance is learnt, too; the groups
        then have a scatter of 1 px.
    """

    groups: Groups
    frame: Ints
    counts: Ints
    found: Comparison | None = None

    def under(self, model: RigModel) -> tuple[Groups, Array]:
        """Return the groups, and their log odds (E,) without innovations."""
        if self.found is None:
            return self.groups, self.groups.log_odds
        odds = appearance_log_odds(self.found, model.pairs[0, 1])
        odds += prior_log_odds(self.groups, self.counts[self.frame], model)
        scatter_px2 = self.groups.scatter_px2 * model.scatter_px2()[0]
        return replace(self.groups, scatter_px2=scatter_px2), odds

    def by_frame(self) -> list[slice]:
        """Return which groups are those of each frame."""
        cuts = np.searchsorted(self.frame, np.arange(len(self.counts) + 1)).tolist()
        return [slice(*ends) for ends in pairwise(cuts)]


def _learned(model: RigModel, sample: _Sample) -> RigModel:
    """The model with offsets of the number of terms that predicts groups best."""
    constant, total, left = _settled(model, sample, _BIAS_TERMS[0])
    best, most, least = constant, total, left
    for terms in _BIAS_TERMS[1:]:
        if total >= _PAIRS_PER_TERM * terms:
            trial, many, left = _settled(constant, sample, terms)
            if many >= _BETTER * most and left < _BETTER * least:
                best, most, least = trial, many, left
    return best


def _settled(model: RigModel, sample: _Sample, terms: int) -> tuple[RigModel, float, float]:
    """Repeat `_improved` until neither the number of groups nor what is left of them changes."""
    before = np.zeros(2)
    for _ in range(_PASSES):
        model, total, left = _improved(model, sample, terms)
        now = np.array([total, left])
        if np.allclose(now, before, rtol=_SETTLED, atol=0.0):
            break
        before = now
    return model, total, left


def _improved(model: RigModel, sample: _Sample, terms: int) -> tuple[RigModel, float, float]:
    """Do one pass: probabilities of all groups, then the model that follows from them.

    Returns also the number of groups, and the RMS that is left of groups without themselves.
    """
    groups, odds = sample.under(model)
    _, shifts, probability = with_innovations(groups, odds, sample.frame, sample.counts, model)
    total = np.asarray(np.bincount(sample.frame, probability, len(shifts)), float)
    shifts -= np.average(shifts, axis=0, weights=total + 1e-9)
    likely = np.flatnonzero(probability > _LIKELY)
    some, weight = groups.take(likely), probability[likely]
    moved = (shifts[sample.frame[likely], None] @ some.axes)[:, 0]
    some = replace(some, innovation_px=some.innovation_px - moved)
    fit = _offset_fit(model, some, weight, terms)
    if sample.found is None:
        return fit.model, float(total.sum()), fit.rms_px[2]
    own, frames = model.pairs[0, 1], sample.counts.min(1) > 0
    found = sample.found.take(likely)
    unmatched = 1 - (total.sum() + 0.5) / (sample.counts[frames].sum(0) + 1.0)
    first, second = np.clip(unmatched, _LEAST_UNMATCHED, _MOST_UNMATCHED)
    axis = model.gap_axes[0, 1]
    frame_px = 0.0
    if frames.sum() > 1:
        frame_px = _frame_scatter(own, GAP_PX * shifts[frames] @ axis, total[frames])
    constant = fit if terms == 1 else _offset_fit(model, some, weight, 1)
    error = GAP_PX**2 * axis @ constant.model.offset_covariance_px2 @ axis
    settled = weight / some.scatter_px2[:, 0, 0] * model.scatter_px2()[0]
    return _with_pair(
        fit.model,
        scatter_px=own.scatter_px * fit.scatter,
        frame_px=frame_px,
        mean_gap_px=(
            float(GAP_PX * axis @ constant.model.offset_px[:, 0]),
            float(np.sqrt(error + frame_px**2 / frames.sum())),
        ),
        bias_px=tuple((GAP_PX * axis @ fit.model.offset_px).tolist()),
        rms_px=(*constant.rms_px[:2], *fit.rms_px[1:]),
        size=_learnt(own.size, "size", found.size, settled),
        contrast=_learnt(own.contrast, "contrast", found.contrast, weight),
        unmatched_share=(float(first), float(second)),
        pairs=float(total.sum()),
    ), float(total.sum()), fit.rms_px[2]  # fmt: skip


@dataclass(frozen=True)
class _Fit:
    """Hold a model with fitted offsets, the factor by which the scatter changes, and the RMS of the
    gaps, of what the offsets leave, and of what they leave of groups without themselves (px)."""

    model: RigModel
    scatter: float
    rms_px: tuple[float, float, float]


def _offset_fit(model: RigModel, groups: Groups, weight: Array, terms: int) -> _Fit:
    """Fit offsets of so many terms, whose number may be another one in the model.

    groups, weight : without the shifts of their frames, and probabilities.

    Reweighted least squares, tails tempered as of Student's t with 8 degrees of freedom.
    """
    if weight.sum() < 0.5:
        return _Fit(model, 1.0, (0.0, 0.0, 0.0))
    square = np.average((groups.points_mm - model.origin_mm) ** 2, 0, weight)
    reach = np.maximum(2 * np.sqrt(square), 1e-3)
    model = replace(model, reach_mm=np.maximum(reach, 0.1 * reach.max()))
    basis = model.basis(groups.points_mm, terms)
    prior = np.tile((_PRIOR_BIAS_SD_PX[:terms] / GAP_PX) ** -2.0, len(model.offset_px))
    flat = groups.axes[:, :, None] * basis[:, None, :, None]
    flat = flat.reshape(len(basis), len(prior), groups.axes.shape[2])
    free, left = groups.free, groups.innovation_px
    own = _trace(groups.noise_px2) - (left.shape[1] - free)
    usual = _trace(groups.scatter_px2) / free
    before_px2 = model.mean("scatter_px") ** 2
    usual_px2, least_px2 = _PRIOR_SCATTER_PX**2 / before_px2, _SMALLEST_SCATTER_PX**2 / before_px2
    start = np.zeros((len(model.offset_px), terms))
    start[:, 0] = model.offset_px[:, 0]
    found, factor2 = start.ravel(), 1.0
    for _ in range(8):
        residual = left - found @ flat
        inverse = np.linalg.inv(groups.noise_px2 + factor2 * groups.scatter_px2)
        chi2 = (residual[:, None] @ inverse @ residual[..., None])[:, 0, 0]
        tempered = weight * (8 + free) / (8 + chi2)
        weighted = flat @ (inverse * tempered[:, None, None])
        information = np.tensordot(weighted, flat, ([0, 2], [0, 2])) + np.diag(prior)
        covariance = np.asarray(np.linalg.inv(information))
        found = covariance @ np.tensordot(weighted, left, ([0, 2], [0, 1]))
        residual = left - found @ flat
        lost = flat.mT @ covariance @ flat
        excess = ((residual**2).sum(1) + _trace(lost) - own) / usual / free
        total = (tempered * excess).sum() + _PRIOR_PAIRS * usual_px2
        factor2 = float(max(total / (weight.sum() + _PRIOR_PAIRS), least_px2))
    taken = lost @ inverse * tempered[:, None, None]
    taken *= np.minimum(1.0, 0.95 / np.maximum(_trace(taken), 1e-9))[:, None, None]
    apart = np.linalg.solve(np.eye(left.shape[1]) - taken, residual[..., None])[..., 0]
    raw, after, predicted = (
        float(GAP_PX * np.sqrt(np.average((r**2).sum(1) / free, weights=tempered)))
        for r in (left, residual, apart)
    )
    offset = found.reshape(-1, terms)
    fitted = replace(model, offset_px=offset, offset_covariance_px2=covariance)
    return _Fit(fitted, float(np.sqrt(factor2)), (raw, after, predicted))


def _trace(matrices: Array) -> Array:
    return np.asarray(np.trace(matrices, axis1=1, axis2=2))


def _findings(model: PairModel, votes: float) -> tuple[Finding, ...]:
    """votes : how far the bias stood out in the first vote."""
    offset, error = model.mean_gap_px
    _, after_constant, after_all, _ = model.rms_px
    varies = len(model.bias_px) > 1 and after_constant > max(_LEAST_PROBLEM_PX, 1.5 * after_all)
    few = model.pairs < _FEW_PAIRS
    found = {
        Finding.CALIBRATION_OFFSET: not few
        and abs(offset) > max(_LEAST_PROBLEM_PX, _SIGNIFICANT * error),
        Finding.OFFSET_VARIES: varies,
        Finding.FEW_PAIRS: few,
        Finding.UNCLEAR_OFFSET: not few and votes < _CLEAR_VOTE,
        Finding.CAMERA_SHAKE: model.frame_px > max(0.1, model.scatter_px / 2),
    }
    return tuple(finding for finding, true in found.items() if true)


def _frame_scatter(model: PairModel, shifts: Array, total: Array) -> float:
    """Scatter of the frames' common shifts; their shrinkage towards 0 is undone in the mean."""
    share = model.frame_px**2 / (model.frame_px**2 + model.scatter_px**2 / np.maximum(total, 1e-3))
    unsure = (1 - share) * model.frame_px**2
    known = total > 0.5
    if not known.any():
        return model.frame_px
    return float(np.sqrt(np.mean(shifts[known] ** 2 + unsure[known])))


def _learnt(old: LogRatioModel, name: str, ratio: Array, weight: Array) -> LogRatioModel:
    """Return mean and covariance of ratios over likely pairs, robust (Student's t, 8)."""
    known = np.isfinite(ratio).all(-1)
    ratio, weight = ratio[known], weight[known]
    if weight.sum() < 0.5:
        return old
    off = ratio - old.difference
    far = (off * np.linalg.solve(old.scatter, off.T).T).sum(-1)
    tempered = weight * (8 + ratio.shape[1]) / (8 + far)
    mean = tempered @ ratio / (tempered.sum() + 0.1)
    off = ratio - mean
    squares = (off.T * tempered) @ off + _PRIOR_PAIRS * _PRIOR[name]
    scatter = squares / (weight.sum() + _PRIOR_PAIRS) + _SMALLEST[name]
    return replace(old, difference=mean, scatter=scatter)


def _populations(model: RigModel, views: Sequence[View]) -> RigModel:
    """Return means and spreads of all detections; outliers count as 3 sd."""
    learnt: dict[str, LogRatioModel] = {}
    for name, usual in _USUAL.items():
        means, squares, count = [], _PRIOR_PAIRS * usual, _PRIOR_PAIRS
        for view in views:
            values = view.log_size[:, 0] if name == "size" else view.log_contrast
            values = values[np.isfinite(values).all(-1)]
            middle = np.median(values, axis=0) if len(values) else np.zeros(len(usual))
            off = values - middle
            limit = 3 * robust_sd(off, axis=0) if len(values) else 0.0
            off = np.clip(off, -limit, limit)
            means.append(middle)
            squares, count = squares + off.T @ off, count + len(off)
        old: LogRatioModel = getattr(model.pairs[0, 1], name)
        learnt[name] = replace(old, means=np.array(means), spread=squares / count)
    return _with_pair(model, **learnt)


def _vote(sample: _Sample, model: RigModel) -> tuple[float, float]:
    """Return the gap with most votes within the search range, and its significance.

    Each combination counts by the log odds of its appearance, at most e^6 for one.
    """
    grid = np.arange(-MOST_BIAS_PX, MOST_BIAS_PX + 0.125, 0.25)
    assert sample.found is not None
    odds = sample.under(model)[1] + np.log(model.pairs[0, 1].span_px / 4)
    share, gap = 1 / (1 + np.exp(-np.clip(odds, -30.0, 30.0))), sample.found.gap_px
    density = np.zeros(len(grid))
    for one in sample.by_frame():
        density += share[one] @ np.exp(-0.5 * (gap[one, None] - grid) ** 2)
    peak = int(np.argmax(density * np.exp(-0.5 * (grid / MOST_BIAS_PX) ** 2)))
    return float(grid[peak]), float(density[peak] / max(np.median(density), 1e-9))


def _misplaced(model: RigModel, frames: int) -> tuple[int, float, float] | None:
    """Return `RigModel.misplaced`: the camera whose offset alone explains those of all best."""
    _, by_point = stacked_jacobian(model.cameras, model.origin_mm[None])
    kept = np.eye(len(by_point[0])) - by_point[0] @ np.linalg.pinv(by_point[0])
    left = kept @ model.offset(model.origin_mm)
    found = []
    for c in range(len(model.cameras)):
        own = kept[:, 2 * c : 2 * c + 2]
        shift = np.linalg.lstsq(own, left, rcond=None)[0]
        found.append((float(np.linalg.norm(left - own @ shift)), c, shift))
    _, camera, shift = min(found, key=lambda one: one[0])
    chance = model.mean("frame_px") / np.sqrt(frames)
    if np.linalg.norm(shift) < max(_LEAST_PROBLEM_PX, _SIGNIFICANT * chance):
        return None
    return camera, float(shift[0]), float(shift[1])


def _span_px(cameras: Cameras, axis: Array) -> float:
    """Length of the shared coordinate that both images cover, in px of the first."""
    spans = []
    for camera in cameras:
        width, height = camera.image_size_px
        corners = np.array([[u, v] for u in (0, width - 1) for v in (0, height - 1)], float)
        origin, _ = camera.unproject(corners)
        spans.append((origin @ axis).tolist())
    low, high = max(min(s) for s in spans), min(max(s) for s in spans)
    if high <= low:
        raise InputError(
            "the two cameras see no common range along the direction perpendicular to both "
            "optical axes",
            todo="check that the calibration belongs to these cameras",
        )
    return float(high - low) * cameras[0]["scale_px_per_mm"]
