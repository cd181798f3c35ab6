"""What the two views of a bubble have in common, learnt from the detections of a run.

The calibration may be off along the shared axis by more than bubbles are apart there, so the gap
alone would give wrong pairs that seem to confirm it. Sizes are independent of the calibration:
every combination of detections votes for its gap by how well the heights agree, the fullest place
is the start, and expectation-maximisation over the pairs' probabilities does the rest. The
systematic part of the gaps is a constant, or smooth in space where pairs left out of it agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.estimator.bubbles.pairing.groups import (
    Candidates,
    Groups,
    RigModel,
    candidates_of,
    deviation,
)
from telerig.estimator.bubbles.pairing.matching import (
    NEGLIGIBLE,
    Cameras,
    Finding,
    LogRatioModel,
    PairGeometry,
    PairModel,
    View,
    appearance_log_odds,
    bias_basis,
    near_pairs,
    prior_log_odds,
    shared_axis,
    unbiased,
    view_of,
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

_PASSES = 6
"""Passes of expectation-maximisation."""

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


def default_model(cameras: Cameras) -> PairModel:
    """Return the model for matching bubbles across the two views before any detection is known.

    It assumes that the calibration is right: its bias is 0. Raises InputError for cameras whose
    optical axes are parallel.
    """
    axis = shared_axis(cameras)
    size, contrast = (
        LogRatioModel(np.zeros(len(usual)), _PRIOR[name], np.zeros((2, len(usual))), 9.0 * usual)
        for name, usual in _USUAL.items()
    )
    reach = np.full(3, max(c.image_size_px[0] / c["scale_px_per_mm"] / 2 for c in cameras))
    return PairModel(
        np.zeros(1), np.zeros((1, 1)), np.zeros(3), reach, _PRIOR_SCATTER_PX, 0.0,
        size, contrast, (0.1, 0.1), _span_px(cameras, axis),
    )  # fmt: skip


def learn_rig(frames: Sequence[Sequence[pd.DataFrame]], cameras: Sequence[Camera]) -> RigModel:
    """Learn from a run how the images of one bubble agree in two cameras or more.

    frames : for each frame, the detection tables of all cameras; as for `estimate_pair_model`,
        which learns from each pair of cameras. With more than two cameras the systematic deviations
        of larger groups are learned, too, as an offset field of each camera; what a shift of all
        points explains is left out of them by a prior that favours small ones.

    Raises InputError for tables without centres or covariances and for parallel cameras.
    """
    every = list(combinations(range(len(cameras)), 2))
    seen = [p for p in every if not nearly_parallel((cameras[p[0]], cameras[p[1]]))] or every
    models = {
        (a, b): estimate_pair_model([(f[a], f[b]) for f in frames], (cameras[a], cameras[b]))
        for a, b in seen
    }
    model = RigModel.of(cameras, models)
    some = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MOST_FRAMES)).astype(int))
    return _with_offsets(model, [frames[i] for i in some]) if len(cameras) > 2 else model


def _with_offsets(model: RigModel, frames: Sequence[Sequence[pd.DataFrame]]) -> RigModel:
    """The model with the offsets of all cameras, by expectation-maximisation over the groups."""
    if not frames:
        return model
    wide = MOST_BIAS_PX / 2
    _, counts, found = candidates_of(frames, model, wide)
    groups = _joined_frames(found, counts)
    larger = np.flatnonzero(groups.pair < 0)
    frame = np.repeat(np.arange(len(found)), [len(f) for f in found])[larger]
    if not len(larger):
        return model
    points = groups.places.points_mm[larger]
    middle, spread = points.mean(0), np.maximum(2 * points.std(0), 1e-3)
    model = replace(model, origin_mm=middle, reach_mm=np.maximum(spread, 0.1 * spread.max()))
    for unsure in (wide, wide / 10, *[0.0] * (_PASSES - 2)):
        weight = _group_weights(groups, counts, model, unsure)[larger]
        model, _ = _offset_fit(model, groups.take(larger), weight, frame, 1)
    best, least = _offset_fit(model, groups.take(larger), weight, frame, 1)
    for terms in _BIAS_TERMS[1:]:
        if weight.sum() >= _PAIRS_PER_TERM * terms:
            trial, left = _offset_fit(model, groups.take(larger), weight, frame, terms)
            if left < _BETTER**2 * least:
                best, least = trial, left
    return replace(best, misplaced=_misplaced(best, len(frames)))


def _misplaced(model: RigModel, frames: int) -> tuple[int, float, float] | None:
    """Return `RigModel.misplaced`: the camera whose offset alone explains those of all best."""
    _, by_point = stacked_jacobian(model.cameras, model.origin_mm[None])
    kept = np.eye(len(by_point[0])) - by_point[0] @ np.linalg.pinv(by_point[0])
    left = kept @ model.offset(model.origin_mm).ravel()
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


def _joined_frames(found: Sequence[Candidates], counts: Ints) -> Groups:
    """Return the groups of all frames, with rows among the detections of all frames."""
    groups = Groups.concat([f.groups for f in found])
    starts = np.cumsum(counts, axis=0) - counts
    groups.rows[:] += np.where(groups.rows >= 0, np.repeat(starts, [*map(len, found)], 0), 0)
    return groups


def _group_weights(groups: Groups, counts: Ints, model: RigModel, unsure_px: float) -> Array:
    """Return the probabilities (G,) of groups whose rows are those of all frames together."""
    from telerig.estimator.bubbles.pairing import kernels

    variance = model.mean("frame_px") ** 2 / 2 + unsure_px**2
    total = groups.appearance + deviation(groups.places, groups.noise_px2, model, variance)[4]
    for k, own in enumerate(model.pairs.values()):
        mine = np.flatnonzero(groups.pair == k)
        gap = np.empty(len(mine))
        kernels.gap_log_odds(
            groups.gap_px[mine], groups.variance_px2[mine], 0.0, own.frame_px**2, own.span_px, gap
        )
        total[mine] = groups.appearance[mine] + gap
    return np.asarray(kernels.marginals(total, groups.rows, counts.sum(0), NEGLIGIBLE))


def _offset_fit(
    model: RigModel, groups: Groups, weight: Array, frame: Ints, terms: int
) -> tuple[RigModel, float]:
    """The model with offsets of so many terms, and the mean square of what they leave of groups in
    frames that they were not fitted to, in units of the stated noise."""
    plain = replace(model, offset_px=np.zeros((len(model.offset_px), 1)))
    variance = model.mean("frame_px") ** 2 / 2
    chi2 = deviation(groups.places, groups.noise_px2, model, variance)[0]
    _, own, pull, *_ = deviation(groups.places, groups.noise_px2, plain, variance)
    basis = bias_basis(groups.places.points_mm, model.origin_mm, model.reach_mm, terms)
    free = 2.0 * (groups.rows >= 0).sum(1) - 3
    weight = weight / (1 + chi2 / free / 8)
    size = pull.shape[1]
    prior = np.diag(np.tile(_PRIOR_BIAS_SD_PX[:terms] ** -2, size))

    def fitted(used: Bools) -> RigModel:
        tempered = weight * used
        matrix = np.einsum("g,gij,ga,gb->iajb", tempered, own, basis, basis, optimize=True)
        right = np.einsum("g,gi,ga->ia", tempered, pull, basis).ravel()
        found = np.linalg.solve(matrix.reshape(size * terms, -1) + prior, right)
        return replace(model, offset_px=found.reshape(size, terms))

    left = np.zeros(len(weight))
    for half in (frame % 2 == 0, frame % 2 == 1):
        test = deviation(groups.places, groups.noise_px2, fitted(half), variance)[0]
        left[~half] = test[~half]
    return fitted(np.ones(len(weight), bool)), float(
        np.average(left / free, weights=weight + 1e-12)
    )


def estimate_pair_model(
    frames: Sequence[tuple[pd.DataFrame, pd.DataFrame]], cameras: Cameras
) -> PairModel:
    """Learn from a run how the two images of one bubble agree.

    frames : for each frame, the detection tables of the first and of the second camera. At most
        ``MOST_FRAMES`` frames are used, evenly spread.
    cameras : the two calibrated cameras.

    Returns the model. If no frame has detections in both cameras, it is the default model with the
    finding NO_DETECTIONS. A bias up to ``MOST_BIAS_PX`` is found. The bias is a constant, or
    linear or quadratic in space if this predicts pairs better that are left out of its fit (at
    least three pairs per term).

    Raises InputError for tables without centres or covariances and for parallel cameras.
    """
    axis = shared_axis(cameras)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MOST_FRAMES)).astype(int))
    model = default_model(cameras)
    tables = [frames[i] for i in chosen if len(frames[i][0]) and len(frames[i][1])]
    if not tables:
        return replace(model, findings=(Finding.NO_DETECTIONS,))
    first, second = (
        view_of(pd.concat(own, ignore_index=True), c, axis) for own, c in zip(zip(*tables), cameras)
    )
    sample = _sampled(cameras, (first, second), np.array([[*map(len, own)] for own in tables]))
    model = _populations(model, (first, second))
    start, votes = _vote(sample, model)
    points = sample.geometry.points_mm
    model = replace(
        model,
        bias_px=np.array([start]),
        scatter_px=_START_SCATTER_PX,
        frame_px=_START_SCATTER_PX if len(tables) > 1 else 0.0,
        origin_mm=np.median(points, axis=0) if len(points) else np.zeros(3),
    )
    for _ in range(_PASSES):
        model = _improved(model, sample, 1)
    best = model
    for terms in _BIAS_TERMS[1:]:
        if model.pairs >= _PAIRS_PER_TERM * terms:
            trial = model
            for _ in range(_PASSES):
                trial = _improved(trial, sample, terms)
            as_many = trial.pairs >= _BETTER * best.pairs
            best = trial if as_many and trial.rms_px[3] < _BETTER * best.rms_px[3] else best
    return replace(best, findings=_findings(best, votes))


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


@dataclass(frozen=True)
class _Sample:
    """Combinations of the detections of F frames whose gaps a bias may explain.

    geometry : of all E combinations. rows, frame : (E, 2), (E,) their rows in the tables of their
    frames, and these. counts : (F, 2) detections of the frames.
    """

    geometry: PairGeometry
    rows: Ints
    frame: Ints
    counts: Ints

    def log_odds(self, model: PairModel) -> Array:
        """Return the log odds (E,) without the gaps."""
        odds = appearance_log_odds(self.geometry, model)
        return odds + prior_log_odds(self.counts[self.frame], model.unmatched_share)

    def by_frame(self) -> list[slice]:
        """Return which combinations are those of each frame."""
        cuts = np.searchsorted(self.frame, np.arange(len(self.counts) + 1)).tolist()
        return [slice(*ends) for ends in pairwise(cuts)]


def _sampled(cameras: Cameras, views: tuple[View, View], counts: Ints) -> _Sample:
    def near(geometry: PairGeometry) -> Bools:
        return np.asarray(np.abs(geometry.gap_px) < MOST_BIAS_PX + _VOTE_REACH_PX)

    geometry, rows, frame = near_pairs(cameras, views, counts, near)
    starts = np.cumsum(counts, axis=0) - counts
    return _Sample(geometry, rows - starts[frame], frame, counts)


def _improved(model: PairModel, sample: _Sample, terms: int) -> PairModel:
    """Do one pass: probabilities of all pairs, then the model that follows from them."""
    from telerig.estimator.bubbles.pairing import kernels

    gap, variance = unbiased(sample.geometry, model)
    appearance, frames = sample.log_odds(model), len(sample.counts)
    probability, shifts = np.zeros(len(gap)), np.zeros(frames)
    for f, one in enumerate(sample.by_frame()):
        rows, counts = sample.rows[one], sample.counts[f]
        odds, shifts[f], _ = kernels.common_shift(
            gap[one], variance[one], appearance[one], rows, counts, model.frame_px, model.span_px,
            NEGLIGIBLE,
        )  # fmt: skip
        probability[one] = kernels.marginals(odds, rows, counts, NEGLIGIBLE)
    total = np.asarray(np.bincount(sample.frame, probability, frames), float)
    centred = shifts - np.average(shifts, weights=total + 1e-9)
    likely = np.flatnonzero(probability > _LIKELY)
    pairs, weight = sample.geometry.take(likely), probability[likely]
    pairs = replace(pairs, gap_px=pairs.gap_px - centred[sample.frame[likely]])
    model = _with_bias(model, pairs, weight, terms)
    unmatched = 1 - (total.sum() + 0.5) / (sample.counts.sum(0) + 1.0)
    first, second = np.clip(unmatched, _LEAST_UNMATCHED, _MOST_UNMATCHED)
    mean, error = model.mean_gap_px
    frame_px = _frame_scatter(model, centred, total) if frames > 1 else 0.0
    return replace(
        model,
        mean_gap_px=(mean, float(np.hypot(error, frame_px / np.sqrt(frames)))),
        frame_px=frame_px,
        size=_learnt(model.size, "size", pairs.size, weight / pairs.scatter_factor**2),
        contrast=_learnt(model.contrast, "contrast", pairs.contrast, weight),
        unmatched_share=(float(first), float(second)),
        pairs=float(total.sum()),
    )


def _with_bias(model: PairModel, pairs: PairGeometry, weight: Array, terms: int) -> PairModel:
    """The model with bias, its covariance and the scatter; terms : 1, 4 or 10, see `PairModel`.

    pairs, weight : gaps less the common shifts of their frames, and probabilities.
    """
    if weight.sum() < 0.5:
        return model
    square = np.average((pairs.points_mm - model.origin_mm) ** 2, 0, weight)
    reach = np.maximum(3 * np.sqrt(square), 1e-3)
    model = replace(model, reach_mm=np.maximum(reach / 1.5, 0.1 * reach.max()))
    constant, rms_px = _bias_fit(model, pairs, weight, 1)
    best, best_rms_px = (constant, rms_px) if terms == 1 else _bias_fit(model, pairs, weight, terms)
    mean = (float(constant.bias_px[0]), float(np.sqrt(constant.bias_covariance_px2[0, 0])))
    return replace(best, mean_gap_px=mean, rms_px=(*rms_px[:2], *best_rms_px[1:]))


def _bias_fit(
    model: PairModel, pairs: PairGeometry, weight: Array, terms: int
) -> tuple[PairModel, tuple[float, float, float]]:
    """The model with a bias of so many terms; then the RMS of the gaps, after it, and left out.

    Reweighted least squares, tails tempered as of Student's t with 8 degrees of freedom.
    """
    gap_px, variance_px2, factor = pairs.gap_px, pairs.variance_px2, pairs.scatter_factor
    basis = model.basis(pairs.points_mm, terms)
    prior = _PRIOR_BIAS_SD_PX[:terms] ** -2
    scatter = model.scatter_px
    bias = np.zeros(terms)
    bias[0] = model.bias_px[0]
    residual = gap_px - basis @ bias
    covariance: Array = np.zeros((terms, terms))
    tempered = influence = lost = weight
    for _ in range(8):
        own = variance_px2 + (scatter * factor) ** 2
        tempered = weight * 9 / (8 + residual**2 / own)
        influence = tempered / own
        covariance = np.asarray(np.linalg.inv((basis.T * influence) @ basis + np.diag(prior)))
        bias = covariance @ (basis.T @ (influence * gap_px))
        residual = gap_px - basis @ bias
        lost = np.einsum("ni,ij,nj->n", basis, covariance, basis)
        excess = (tempered * (residual**2 + lost - variance_px2) / factor**2).sum()
        prior_squares = _PRIOR_PAIRS * _PRIOR_SCATTER_PX**2
        free = weight.sum() + _PRIOR_PAIRS
        scatter = float(np.sqrt(max((excess + prior_squares) / free, _SMALLEST_SCATTER_PX**2)))
    left_out = residual / (1 - np.minimum(influence * lost, 0.95))
    raw, after, predicted = (
        float(np.sqrt(np.average(r**2, weights=tempered))) for r in (gap_px, residual, left_out)
    )
    found = replace(model, bias_px=bias, bias_covariance_px2=covariance, scatter_px=scatter)
    return found, (raw, after, predicted)


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


def _populations(model: PairModel, views: tuple[View, View]) -> PairModel:
    """Return means and spreads of all detections; outliers count as 3 sd."""
    learnt: dict[str, LogRatioModel] = {}
    for name, usual in _USUAL.items():
        means, squares, count = [], _PRIOR_PAIRS * usual, _PRIOR_PAIRS
        for view in views:
            values: Array = getattr(view, f"log_{name}")
            values = values[np.isfinite(values).all(-1)]
            middle = np.median(values, axis=0) if len(values) else np.zeros(len(usual))
            off = values - middle
            limit = 3 * robust_sd(off, axis=0) if len(values) else 0.0
            off = np.clip(off, -limit, limit)
            means.append(middle)
            squares, count = squares + off.T @ off, count + len(off)
        old: LogRatioModel = getattr(model, name)
        learnt[name] = replace(old, means=np.array(means), spread=squares / count)
    return replace(model, size=learnt["size"], contrast=learnt["contrast"])


def _vote(sample: _Sample, model: PairModel) -> tuple[float, float]:
    """Return the gap with most votes within the search range, and its significance.

    Each combination counts by the log odds of its appearance, at most e^6 for one.
    """
    grid = np.arange(-MOST_BIAS_PX, MOST_BIAS_PX + 0.125, 0.25)
    odds = np.clip(sample.log_odds(model) + np.log(model.span_px / 4), -30.0, 30.0)
    share, gap, density = 1 / (1 + np.exp(-odds)), sample.geometry.gap_px, np.zeros(len(grid))
    for one in sample.by_frame():
        density += share[one] @ np.exp(-0.5 * (gap[one, None] - grid) ** 2)
    peak = int(np.argmax(density * np.exp(-0.5 * (grid / MOST_BIAS_PX) ** 2)))
    return float(grid[peak]), float(density[peak] / max(np.median(density), 1e-9))


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
