"""What the two views of a bubble have in common, learnt from the detections of a run.

The calibration may be off along the shared axis by more than bubbles are apart there, so the gap
alone would pair wrongly and prove itself right. Sizes know nothing of it: every combination of
detections votes for its gap by how well the heights agree, the fullest place is the start, and
expectation-maximisation over the pairs' probabilities does the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.estimator.bubbles.pairing.assignment import marginals
from telerig.estimator.bubbles.pairing.bias import PAIRS_PER_TERM, TERMS, better, fit_bias
from telerig.estimator.bubbles.pairing.geometry import (
    PairGeometry,
    View,
    pair_geometry,
    shared_axis,
    view_of,
)
from telerig.estimator.bubbles.pairing.matching import appearance_log_odds, common_shift
from telerig.estimator.bubbles.pairing.types import Cue, PairModel
from telerig.estimator.bubbles.pairing.wording import describe
from telerig.rig.camera import Camera

Array = NDArray[np.float64]

MOST_FRAMES = 60
MOST_BIAS_PX = 20.0
_START_SCATTER_PX = 1.5
_PASSES = 6
_LEAST_LONELY, _MOST_LONELY = 0.05, 0.9
_PRIOR_PAIRS = 3.0
_PRIOR_SCATTER_PX = 0.3
_SMALLEST = {"size": np.diag([0.005, 0.005]) ** 2, "contrast": np.diag([0.02]) ** 2}
_PRIOR = {"size": np.diag([0.03, 0.06]) ** 2, "contrast": np.diag([0.2]) ** 2}
_USUAL = {"size": np.array([[0.17, 0.15], [0.15, 0.17]]), "contrast": np.array([[0.1]])}
_USUAL_WEIGHT = 4.0


def default_model(cameras: tuple[Camera, Camera]) -> PairModel:
    """A model for a calibration that is believed, before any detection was seen."""
    axis = shared_axis(cameras)
    size, contrast = (
        Cue(np.zeros(len(usual)), _PRIOR[name], np.zeros((2, len(usual))), 9.0 * usual)
        for name, usual in _USUAL.items()
    )
    reach = np.full(3, max(c.image_size_px[0] / c["scale_px_per_mm"] / 2 for c in cameras))
    return PairModel(
        np.zeros(1), np.zeros((1, 1)), np.zeros(3), reach, _PRIOR_SCATTER_PX, 0.0,
        size, contrast, (0.1, 0.1), _span_px(cameras, axis),
    )  # fmt: skip


def estimate_pair_model(
    frames: Sequence[tuple[pd.DataFrame, pd.DataFrame]], cameras: tuple[Camera, Camera]
) -> PairModel:
    """Bias and scatter of the shared coordinate, scatter of the ratios, share of lonely detections.

    frames : detection tables of the first and second camera, one pair per frame; at most
    ``MOST_FRAMES`` are used, spread evenly. With nothing to learn from, the default model with
    words that say so. A bias up to ``MOST_BIAS_PX`` is found. The bias is a constant, or linear or
    quadratic in space when that predicts pairs left out better (at least three pairs per term).

    Raises InputError for tables without centres or covariances and for parallel cameras.
    """
    axis = shared_axis(cameras)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MOST_FRAMES)).astype(int))
    views = [
        (view_of(frames[i][0], cameras[0], axis), view_of(frames[i][1], cameras[1], axis))
        for i in chosen
    ]
    used = [pair for pair in views if len(pair[0]) and len(pair[1])]
    model = default_model(cameras)
    if not used:
        return replace(model, words=("No frame has detections in both cameras: nothing learnt.",))
    model = _populations(model, used)
    geometries = [pair_geometry(*pair) for pair in used]
    points = np.concatenate([g.points_mm.reshape(-1, 3) for g in geometries])
    start, votes = _vote(geometries, model)
    model = replace(
        model,
        bias_px=np.array([start]),
        scatter_px=_START_SCATTER_PX,
        frame_px=_START_SCATTER_PX if len(used) > 1 else 0.0,
        origin_mm=np.median(points, axis=0),
    )
    for _ in range(_PASSES):
        model = _improved(model, geometries, 1)
    best = model
    for terms in TERMS[1:]:
        if model.pairs >= PAIRS_PER_TERM * terms:
            trial = model
            for _ in range(_PASSES):
                trial = _improved(trial, geometries, terms)
            best = trial if better(trial, best) else best
    return describe(best, votes)


def _improved(model: PairModel, geometries: list[PairGeometry], terms: int) -> PairModel:
    """One pass: probabilities of all pairs, then everything that follows from them."""
    found = [common_shift(g, model) for g in geometries]
    probability = [marginals(odds) for _, _, odds, _ in found]
    weight = np.concatenate([p.ravel() for p in probability])
    use = weight > 0.01
    shifts = np.array([shift for *_, shift in found])
    total = np.array([p.sum() for p in probability])
    counts = np.array([p.shape for p in probability])
    centred = shifts - np.average(shifts, weights=total + 1e-9)
    flat = _Flat(geometries, centred, use)
    weight = weight[use]
    model = fit_bias(model, flat.points_mm, flat.raw_px - flat.shift_px, flat.variance_px2,
                     flat.doubt, weight, terms)  # fmt: skip
    lonely = 1 - (total.sum() + 0.5) / (counts.sum(0) + 1.0)
    first, second = np.clip(lonely, _LEAST_LONELY, _MOST_LONELY)
    mean, error = model.mean_gap_px
    frame_px = _frame_scatter(model, centred, total) if len(geometries) > 1 else 0.0
    return replace(
        model,
        mean_gap_px=(mean, float(np.hypot(error, frame_px / np.sqrt(len(geometries))))),
        frame_px=frame_px,
        size=_learnt(model.size, "size", flat.size, weight / flat.doubt**2),
        contrast=_learnt(model.contrast, "contrast", flat.contrast, weight),
        lonely=(float(first), float(second)),
        pairs=float(total.sum()),
    )


class _Flat:
    """Likely pairs of all frames, one row each."""

    def __init__(
        self, geometries: list[PairGeometry], shifts: Array, use: NDArray[np.bool_]
    ) -> None:
        def flat(name: str) -> Array:
            arrays: list[Array] = [getattr(g, name) for g in geometries]
            return np.concatenate([a.reshape(-1, *a.shape[2:]) for a in arrays])[use]

        self.raw_px, self.variance_px2 = flat("gap_px"), flat("variance_px2")
        self.size, self.contrast = flat("size"), flat("contrast")
        self.doubt, self.points_mm = flat("doubt"), flat("points_mm")
        sizes = [g.gap_px.size for g in geometries]
        self.shift_px = np.repeat(shifts, sizes)[use]


def _frame_scatter(model: PairModel, shifts: Array, total: Array) -> float:
    """Scatter of the frames' common shifts; their shrinkage towards 0 is undone in the mean."""
    share = model.frame_px**2 / (model.frame_px**2 + model.scatter_px**2 / np.maximum(total, 1e-3))
    unsure = (1 - share) * model.frame_px**2
    known = total > 0.5
    if not known.any():
        return model.frame_px
    return float(np.sqrt(np.mean(shifts[known] ** 2 + unsure[known])))


def _learnt(cue: Cue, name: str, ratio: Array, weight: Array) -> Cue:
    """Mean and covariance of the ratios over likely pairs, tails tempered (Student's t, 8)."""
    known = np.isfinite(ratio).all(-1)
    ratio, weight = ratio[known], weight[known]
    if weight.sum() < 0.5:
        return cue
    off = ratio - cue.difference
    far = (off * np.linalg.solve(cue.scatter, off.T).T).sum(-1)
    tempered = weight * (8 + ratio.shape[1]) / (8 + far)
    mean = tempered @ ratio / (tempered.sum() + 0.1)
    off = ratio - mean
    squares = (off.T * tempered) @ off + _PRIOR_PAIRS * _PRIOR[name]
    scatter = squares / (weight.sum() + _PRIOR_PAIRS) + _SMALLEST[name]
    return replace(cue, difference=mean, scatter=scatter)


def _populations(model: PairModel, views: list[tuple[View, View]]) -> PairModel:
    """Means and spreads of all detections; outliers count as three sd, few draw to the usual."""
    cues: dict[str, Cue] = {}
    for name, usual in _USUAL.items():
        means, squares, count = [], _USUAL_WEIGHT * usual, _USUAL_WEIGHT
        for c in range(2):
            values: Array = np.concatenate([getattr(pair[c], f"log_{name}") for pair in views])
            values = values[np.isfinite(values).all(-1)]
            middle = np.median(values, axis=0) if len(values) else np.zeros(len(usual))
            off = values - middle
            limit = 3 * 1.4826 * np.median(np.abs(off), axis=0) if len(values) else 0.0
            off = np.clip(off, -limit, limit)
            means.append(middle)
            squares, count = squares + off.T @ off, count + len(off)
        old: Cue = getattr(model, name)
        cues[name] = replace(old, means=np.array(means), spread=squares / count)
    return replace(model, size=cues["size"], contrast=cues["contrast"])


def _vote(geometries: list[PairGeometry], model: PairModel) -> tuple[float, float]:
    """The fullest place of the gaps within the search range, and how far it stands out.

    Each combination counts by the log odds of its appearance, at most e^6 for one.
    """
    grid = np.arange(-MOST_BIAS_PX, MOST_BIAS_PX + 0.125, 0.25)
    density = np.zeros(len(grid))
    for g in geometries:
        near = np.abs(g.gap_px) < MOST_BIAS_PX + 5
        odds = appearance_log_odds(g, model)
        share = 1 / (1 + np.exp(-np.clip(odds + np.log(model.span_px / 4), -30.0, 30.0)))
        kernel = np.exp(-0.5 * (g.gap_px[near][:, None] - grid) ** 2)
        density += np.sum(share[near][:, None] * kernel, axis=0)
    peak = int(np.argmax(density * np.exp(-0.5 * (grid / MOST_BIAS_PX) ** 2)))
    return float(grid[peak]), float(density[peak] / max(np.median(density), 1e-9))


def _span_px(cameras: tuple[Camera, Camera], axis: Array) -> float:
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
            "the two cameras see no common range along their shared axis",
            todo="check that the calibration belongs to these cameras",
        )
    return float(high - low) * cameras[0]["scale_px_per_mm"]
