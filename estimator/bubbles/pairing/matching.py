"""Which detection of the second camera shows the same bubble as which of the first.

Every combination gets log odds: how much better "one bubble seen twice" explains the two
detections than "two detections without a partner". They come from the gap along the shared axis,
the height along it, the width, the contrast, and the predicted tracks. (Blur is not used: views at
an angle are out of focus at different depths.) One assignment is then the best as a whole, with the
option to leave detections out, and each of its pairs has a posterior probability.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.estimator.bubbles.pairing.assignment import best_assignment, marginals
from telerig.estimator.bubbles.pairing.geometry import (
    PairGeometry,
    pair_geometry,
    shared_axis,
    view_of,
)
from telerig.estimator.bubbles.pairing.pair_model import LogRatioModel, PairModel
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian

Array = NDArray[np.float64]

SAFE_LOG_ODDS = 3.0
"""Posterior log odds (20 to 1) below which a pair is ambiguous."""

_TAIL, _TAIL_PX2, _GATE_SIGMA = 0.02, (0.25, 1.0), 5.0
_WRONG_SIZE, _WRONG_SIZE_FLAGGED, _WRONG_CONTRAST = 1e-6, 0.02, 0.05
_IMPOSSIBLE, _IMPOSSIBLE_SIGMA = 0.15, 10.0
_UNKNOWN_SIZE = 2.0
"""Log odds against a pair with a bubble that is cut or merged: its partner is often unseen."""
_RARE, _FREEDOM = 2.5, 6.0
_SHIFT_PASSES = 4
_NEVER = -1e6

_SEEN = 0.95
_NEW_SHARE = 0.1
_TRACK_SIZE_SD = 0.1
_LARGEST_MAHALANOBIS2 = 60.0


@dataclass(frozen=True)
class Prediction:
    """Where the live tracks are expected in a frame, in the rig frame.

    ids : (K,); points_mm : (K, 3); covariance_mm2 : (K, 3, 3); d_eq_mm : (K,).
    """

    ids: NDArray[np.int64]
    points_mm: Array
    covariance_mm2: Array
    d_eq_mm: Array


@dataclass(frozen=True)
class Matches:
    """Pairs of one frame. Rows are positions in the two detection tables.

    first, second : (M,) rows.  confidence : (M,) posterior probability of the pair.
    gap_px, gap_sigma : (M,) mismatch along the shared axis, first less second, the model's bias
        and the frame's common shift removed; in px of the first image and in standard deviations.
    height_ratio : (M,) height (mm) in the first view over that in the second; NaN where unknown.
    ambiguous : (M,) whether the pair's posterior log odds are below ``SAFE_LOG_ODDS``.
    frame_shift_px : the shift common to this frame's gaps.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    confidence: Array
    gap_px: Array
    gap_sigma: Array
    height_ratio: Array
    ambiguous: NDArray[np.bool_]
    frame_shift_px: float = 0.0

    def __len__(self) -> int:
        return len(self.first)


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
        none, empty = np.zeros(0, np.int64), np.zeros(0)
        return Matches(none, none, empty, empty, empty, empty, np.zeros(0, bool))
    geometry = pair_geometry(*views)
    by_tracks = 0.0 if predicted is None else track_log_odds(geometry, model, predicted)
    gap, variance, odds, shift = common_shift(geometry, model, by_tracks)
    pairs = best_assignment(odds)
    confidence = marginals(odds)[pairs]
    return Matches(
        *pairs,
        confidence,
        gap[pairs],
        gap[pairs] / np.sqrt(variance[pairs]),
        np.exp(geometry.size[..., 0][pairs]),
        np.log(confidence) - np.log(np.maximum(1 - confidence, 1e-300)) < SAFE_LOG_ODDS,
        shift,
    )


def common_shift(
    geometry: PairGeometry, model: PairModel, by_tracks: Array | float = 0.0
) -> tuple[Array, Array, Array, float]:
    """Gaps (bias and the frame's shift removed), their variances, log odds, and the shift.

    The shift starts as unknown within ``model.frame_px`` and is then the mean over the pairs
    by their probabilities, with that scatter as its prior.
    """
    bias, bias_variance = model.bias(geometry.points_mm)
    raw = geometry.gap_px - bias
    own = geometry.variance_px2 + bias_variance + (model.scatter_px * geometry.scatter_factor) ** 2
    appearance = appearance_log_odds(geometry, model) + by_tracks
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
    odds = np.full(
        geometry.gap_px.shape, _prior_log_odds(len(first), len(second), model.unmatched_share)
    )
    wrong = np.where(geometry.scatter_factor > 1, _WRONG_SIZE_FLAGGED, _WRONG_SIZE)
    odds += _ratio_log_odds(model.size, geometry.size, first.log_size, second.log_size, wrong)
    apart = np.abs(geometry.size[..., 0] - model.size.difference[0])
    limit = max(_IMPOSSIBLE, _IMPOSSIBLE_SIGMA * model.size.sd[0])
    odds[apart > np.where(geometry.scatter_factor > 1, 2 * limit, limit)] = _NEVER
    odds -= np.where(np.isfinite(apart), 0.0, _UNKNOWN_SIZE)
    contrasts = (first.log_contrast, second.log_contrast)
    odds += _ratio_log_odds(model.contrast, geometry.contrast, *contrasts, _WRONG_CONTRAST)
    return odds


def _prior_log_odds(n1: int, n2: int, unmatched: tuple[float, float]) -> float:
    """Expected pairs over the product of the expected detections without a partner."""
    alone = (max(n1 * unmatched[0], 1e-3), max(n2 * unmatched[1], 1e-3))
    pairs = max(np.sqrt(n1 * (1 - unmatched[0]) * n2 * (1 - unmatched[1])), 1e-3)
    return float(np.log(pairs / (alone[0] * alone[1])))


def _gap_log_odds(gap: Array, variance: Array, model: PairModel) -> Array:
    """A normal core with wider tails (upset outlines), cut off, against any place in the span."""
    core = np.exp(-0.5 * gap**2 / variance)
    wide = variance + np.clip(3 * variance, *_TAIL_PX2)
    tail = np.exp(-0.5 * gap**2 / wide) * np.sqrt(variance / wide)
    density = ((1 - _TAIL) * core + _TAIL * tail) / np.sqrt(2 * np.pi * variance)
    near = gap**2 < _GATE_SIGMA**2 * wide
    return np.where(near, np.log(np.maximum(density * model.span_px, 1e-300)), _NEVER)


def _ratio_log_odds(
    expected: LogRatioModel, ratio: Array, first: Array, second: Array, wrong: Array | float
) -> Array:
    """Log odds of properties: two noisy images of one bubble, or of two from the population.

    In the axes in which scatter and population are both uncorrelated (generalised eigenvectors),
    two images of one bubble have correlation 1 - scatter / 2; the log odds are those of the two
    normal distributions. How rare a bubble is counts to ``_RARE`` standard deviations.
    wrong : chance that one of the measurements says nothing about the bubble.
    """
    from scipy.linalg import eigh

    relative, axes = eigh(expected.scatter, expected.spread)
    alike = np.clip(1 - relative / 2, 0.0, 1 - 1e-6)
    apart = np.nan_to_num(ratio - expected.difference) @ axes
    own = [np.nan_to_num(v - expected.means[c]) @ axes for c, v in enumerate((first, second))]
    rare = np.clip(0.5 * (own[0][:, None] + own[1]), -_RARE, _RARE)
    odds = rare**2 @ (alike / (1 + alike)) + (apart**2).sum(-1) / 4
    tails = np.log1p(apart**2 @ (0.5 / (1 - alike)) / _FREEDOM)
    odds -= 0.5 * (_FREEDOM + len(alike)) * tails
    odds -= 0.5 * np.log1p(-(alike**2)).sum()
    odds = np.logaddexp(np.log1p(-wrong) + odds, np.log(wrong))
    return np.where(np.isfinite(ratio).all(-1), odds, 0.0)


def track_log_odds(
    geometry: PairGeometry, model: PairModel, predicted: Prediction
) -> Array | float:
    """(N1, N2) log odds to add for the predicted tracks.

    Without tracks pairs lie anywhere in the volume that both cameras see. With them most lie where
    a track is expected (both pixels at once, through the point in space), and so do the
    detections of bubbles that only one camera found; one track cannot be the unmatched detection
    of both cameras.
    """
    tracks = len(predicted.ids)
    if not tracks:
        return 0.0
    density = _track_density(geometry, model, predicted)
    expected = (1 - _NEW_SHARE) * _SEEN**2 * density.sum(-1) / tracks + _NEW_SHARE
    near = [_unmatched_density(geometry, model, predicted, c) for c in range(2)]
    alone = (1 + near[0].sum(1))[:, None] * (1 + near[1].sum(1)) - near[0] @ near[1].T
    return np.asarray(np.log(expected) - np.log(alone))


def _normal_density(offset: Array, covariance: Array) -> Array:
    """(...,) of offsets (..., D), not below that at the largest Mahalanobis distance."""
    distance2 = (offset * np.linalg.solve(covariance, offset[..., None])[..., 0]).sum(-1)
    peak = 1 / np.sqrt(np.linalg.det(2 * np.pi * covariance))
    return np.asarray(peak * np.exp(-0.5 * np.minimum(distance2, _LARGEST_MAHALANOBIS2)))


def _track_density(geometry: PairGeometry, model: PairModel, predicted: Prediction) -> Array:
    """(N1, N2, K) density of a pair's point and size at each track, relative to anywhere."""
    first, second = geometry.views
    pixel = model.scatter_px**2 + 0.25 * (
        np.trace(first.covariance_px2, axis1=1, axis2=2)[:, None]
        + np.trace(second.covariance_px2, axis1=1, axis2=2)
    )
    pixel = pixel + model.frame_px**2
    sine2 = 1 - (first.direction @ second.direction.T) ** 2
    measured = pixel * geometry.mm_per_px**2 / sine2
    covariance = predicted.covariance_mm2 + measured[..., None, None, None] * np.eye(3)
    density = _normal_density(geometry.points_mm[..., None, :] - predicted.points_mm, covariance)
    size = 0.25 * (first.log_size.sum(-1)[:, None] + second.log_size.sum(-1))[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_ratio = size - np.log(np.asarray(predicted.d_eq_mm) / 2)
    population = float(np.sqrt(model.size.spread.mean()))
    sd = min(_TRACK_SIZE_SD, population)
    of_size = np.exp(-0.5 * (log_ratio / sd) ** 2) * population / sd
    of_size = np.where(np.isfinite(log_ratio), of_size, 1.0)
    widths = [min(v.camera.image_size_px) / v.camera["scale_px_per_mm"] for v in geometry.views]
    volume_mm3 = widths[0] * widths[1] * model.span_px * np.median(geometry.mm_per_px)
    return np.asarray(density * of_size * volume_mm3)


def _unmatched_density(
    geometry: PairGeometry, model: PairModel, predicted: Prediction, c: int
) -> Array:
    """(N, K) expected density of detections whose track only this camera sees, over the usual."""
    view = geometry.views[c]
    cameras = (geometry.views[0].camera, geometry.views[1].camera)
    pixels, jacobian, _ = stacked_jacobian(cameras, np.asarray(predicted.points_mm, float))
    rows = jacobian[:, 2 * c : 2 * c + 2]
    spread = rows @ predicted.covariance_mm2 @ np.swapaxes(rows, 1, 2)
    common = model.scatter_px**2 + model.frame_px**2 + model.bias_px[0] ** 2 / 4
    covariance = spread + view.covariance_px2[:, None] + common * np.eye(2)
    density = _normal_density(view.uv_px[:, None] - pixels[:, 2 * c : 2 * c + 2], covariance)
    width, height = view.camera.image_size_px
    usual = max(len(view) * model.unmatched_share[c], 1e-3)
    return np.asarray(_SEEN * (1 - _SEEN) * density * width * height / usual)
