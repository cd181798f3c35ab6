"""Which detection of the second camera shows the same bubble as which of the first.

Every combination gets log odds: how much better "one bubble seen twice" explains the two
detections than "two detections without a partner". Cues are the gap along the shared axis, the
height along it, the width, the contrast, and the predicted tracks. (Blur is no cue: views at an
angle are out of focus at different depths.) One assignment is then the best as a whole, with the
option to leave detections out, and each of its pairs has a posterior probability.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.estimator.bubbles.outline.types import Prediction
from telerig.estimator.bubbles.pairing.assignment import best_assignment, marginals
from telerig.estimator.bubbles.pairing.geometry import (
    PairGeometry,
    pair_geometry,
    shared_axis,
    view_of,
)
from telerig.estimator.bubbles.pairing.history import history_log_odds
from telerig.estimator.bubbles.pairing.types import Alternative, Cue, Matches, PairModel
from telerig.rig.camera import Camera

Array = NDArray[np.float64]

SAFE_NATS = 3.0
_TAIL, _TAIL_PX2, _GATE_SIGMA = 0.02, (0.25, 1.0), 5.0
_WRONG_SIZE, _WRONG_SIZE_FLAGGED, _WRONG_CONTRAST = 1e-6, 0.02, 0.05
_IMPOSSIBLE, _IMPOSSIBLE_SIGMA = 0.15, 10.0
_UNKNOWN_SIZE = 2.0
"""Nats against a pair with a bubble cut by the border or merged: its partner is often unseen."""
_RARE, _FREEDOM = 2.5, 6.0
_SHIFT_PASSES = 4
_NEVER = -1e6


def match_pairs(
    first: pd.DataFrame,
    second: pd.DataFrame,
    cameras: tuple[Camera, Camera],
    model: PairModel,
    *,
    predicted: Prediction | None = None,
) -> Matches:
    """Pairs of the detections of one frame.

    first, second : tables of `detect_bubbles`, in pixels of ``cameras``; other row labels than
    0..N-1 do not matter, results are positions. model : `estimate_pair_model` or `default_model`.

    Raises InputError for tables without centres or covariances and for parallel cameras.
    """
    axis = shared_axis(cameras)
    views = (view_of(first, cameras[0], axis), view_of(second, cameras[1], axis))
    if not len(first) or not len(second):
        return _no_pairs(len(first), len(second))
    geometry = pair_geometry(*views)
    history, track = history_log_odds(geometry, model, predicted)
    gap, variance, odds, shift = common_shift(geometry, model, history)
    return _matches(odds, gap, variance, geometry, track, shift)


def common_shift(
    geometry: PairGeometry, model: PairModel, history: Array | float = 0.0
) -> tuple[Array, Array, Array, float]:
    """Gaps (bias and the frame's shift removed), their variances, log odds, and the shift.

    The shift starts as unknown within ``model.frame_px`` and is then the mean over the pairs
    by their probabilities, with that scatter as its prior.
    """
    bias, bias_variance = model.bias(geometry.points_mm)
    raw = geometry.gap_px - bias
    own = geometry.variance_px2 + bias_variance + (model.scatter_px * geometry.doubt) ** 2
    appearance = appearance_log_odds(geometry, model) + history
    shift, uncertainty = 0.0, model.frame_px**2
    odds = appearance + _gap_log_odds(raw, own + uncertainty, model)
    for _ in range(_SHIFT_PASSES if model.frame_px > 0 else 0):
        weight = marginals(odds) / own
        weight = weight / (1 + (raw - shift) ** 2 / (4 * (own + uncertainty)))
        precision = weight.sum() + model.frame_px**-2
        shift, uncertainty = float((weight * raw).sum() / precision), float(1 / precision)
        odds = appearance + _gap_log_odds(raw - shift, own + uncertainty, model)
    return raw - shift, own + uncertainty, odds, shift


def appearance_log_odds(geometry: PairGeometry, model: PairModel) -> Array:
    """(N1, N2) log odds by height, width, contrast and the number of detections; not the gap.

    Heights that differ beyond all measurement exclude a pair; flagged ones may differ twice that.
    """
    first, second = geometry.views
    odds = np.full(geometry.gap_px.shape, _prior_log_odds(len(first), len(second), model.lonely))
    wrong = np.where(geometry.doubt > 1, _WRONG_SIZE_FLAGGED, _WRONG_SIZE)
    odds += _cue(model.size, geometry.size, first.log_size, second.log_size, wrong)
    apart = np.abs(geometry.size[..., 0] - model.size.difference[0])
    limit = max(_IMPOSSIBLE, _IMPOSSIBLE_SIGMA * model.size.sd[0])
    odds[apart > np.where(geometry.doubt > 1, 2 * limit, limit)] = _NEVER
    odds -= np.where(np.isfinite(apart), 0.0, _UNKNOWN_SIZE)
    contrasts = (first.log_contrast, second.log_contrast)
    odds += _cue(model.contrast, geometry.contrast, *contrasts, _WRONG_CONTRAST)
    return odds


def _prior_log_odds(n1: int, n2: int, lonely: tuple[float, float]) -> float:
    """Expected pairs over the product of expected lonely detections."""
    alone = (max(n1 * lonely[0], 1e-3), max(n2 * lonely[1], 1e-3))
    pairs = max(np.sqrt(n1 * (1 - lonely[0]) * n2 * (1 - lonely[1])), 1e-3)
    return float(np.log(pairs / (alone[0] * alone[1])))


def _gap_log_odds(gap: Array, variance: Array, model: PairModel) -> Array:
    """A normal core with wider tails (upset outlines), cut off, against any place in the span."""
    core = np.exp(-0.5 * gap**2 / variance)
    wide = variance + np.clip(3 * variance, *_TAIL_PX2)
    tail = np.exp(-0.5 * gap**2 / wide) * np.sqrt(variance / wide)
    density = ((1 - _TAIL) * core + _TAIL * tail) / np.sqrt(2 * np.pi * variance)
    near = gap**2 < _GATE_SIGMA**2 * wide
    return np.where(near, np.log(np.maximum(density * model.span_px, 1e-300)), _NEVER)


def _cue(cue: Cue, ratio: Array, first: Array, second: Array, wrong: Array | float) -> Array:
    """Log odds of properties: two noisy images of one bubble, or of two from the population.

    In the axes in which scatter and population are both uncorrelated (generalised eigenvectors),
    two images of one bubble have correlation 1 - scatter / 2; the log odds are those of the two
    normal distributions. How rare a bubble is counts to ``_RARE`` standard deviations.
    wrong : chance that one of the measurements says nothing about the bubble.
    """
    from scipy.linalg import eigh

    relative, axes = eigh(cue.scatter, cue.spread)
    alike = np.clip(1 - relative / 2, 0.0, 1 - 1e-6)
    apart = np.nan_to_num(ratio - cue.difference) @ axes
    own = [np.nan_to_num(v - cue.means[c]) @ axes for c, v in enumerate((first, second))]
    rare = np.clip(0.5 * (own[0][:, None] + own[1]), -_RARE, _RARE)
    odds = rare**2 @ (alike / (1 + alike)) + (apart**2).sum(-1) / 4
    tails = np.log1p(apart**2 @ (0.5 / (1 - alike)) / _FREEDOM)
    odds -= 0.5 * (_FREEDOM + len(alike)) * tails
    odds -= 0.5 * np.log1p(-(alike**2)).sum()
    odds = np.logaddexp(np.log1p(-wrong) + odds, np.log(wrong))
    return np.where(np.isfinite(ratio).all(-1), odds, 0.0)


def _matches(
    odds: Array,
    gap: Array,
    variance: Array,
    geometry: PairGeometry,
    track: NDArray[np.int64],
    shift: float,
) -> Matches:
    rows, columns = best_assignment(odds)
    probability = marginals(odds)
    confidence = probability[rows, columns]
    return Matches(
        rows, columns, confidence, gap[rows, columns],
        gap[rows, columns] / np.sqrt(variance[rows, columns]),
        np.exp(geometry.size[rows, columns, 0]),
        np.log(confidence) - np.log(np.maximum(1 - confidence, 1e-300)) < SAFE_NATS,
        tuple(_alternatives(int(i), int(j), probability) for i, j in zip(rows, columns)),
        track[rows, columns],
        np.setdiff1d(np.arange(odds.shape[0]), rows),
        np.setdiff1d(np.arange(odds.shape[1]), columns),
        shift, probability,
    )  # fmt: skip


def _alternatives(i: int, j: int, probability: Array) -> tuple[Alternative, ...]:
    """Other pairs of these two detections, or none for them, within reach of this pair."""
    least = probability[i, j] * np.exp(-SAFE_NATS)
    in_row, in_column = probability[i], probability[:, j]
    others = [Alternative(i, int(k), float(in_row[k])) for k in np.flatnonzero(in_row >= least)]
    others += [
        Alternative(int(k), j, float(in_column[k])) for k in np.flatnonzero(in_column >= least)
    ]
    others = [a for a in others if (a.first, a.second) != (i, j)]
    others.append(Alternative(i, -1, max(0.0, 1 - float(in_row.sum()))))
    others.append(Alternative(-1, j, max(0.0, 1 - float(in_column.sum()))))
    return tuple(sorted((a for a in others if a.probability >= least), key=_rank))


def _rank(alternative: Alternative) -> float:
    return -alternative.probability


def _no_pairs(n1: int, n2: int) -> Matches:
    none, empty = np.zeros(0, np.int64), np.zeros(0)
    return Matches(
        none, none, empty, empty, empty, empty, np.zeros(0, bool), (), none,
        np.arange(n1), np.arange(n2), 0.0, np.zeros((n1, n2)),
    )  # fmt: skip
