"""What predicted tracks say of a pair: expected numbers of pairs and of lonely detections."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.bubbles.outline.types import Prediction
from telerig.estimator.bubbles.pairing.geometry import PairGeometry
from telerig.estimator.bubbles.pairing.types import PairModel
from telerig.rig.triangulation import stacked_jacobian

Array = NDArray[np.float64]

_SEEN = 0.95
_NEW_SHARE = 0.1
_SIZE_SD = 0.1
_NEAR = 30.0


def history_log_odds(
    geometry: PairGeometry, model: PairModel, predicted: Prediction | None
) -> tuple[Array, NDArray[np.int64]]:
    """(N1, N2) log odds to add for the predicted tracks, and the track that fits best (-1: none).

    Without history pairs lie anywhere in the volume that both cameras see. With it most lie where
    a track is expected (both pixels at once, through the point in space), and so do the
    detections of bubbles that only one camera found; one track cannot be the lonely detection of
    both cameras.
    """
    n1, n2 = geometry.gap_px.shape
    none = np.full((n1, n2), -1, np.int64)
    if predicted is None or not len(predicted.ids):
        return np.zeros((n1, n2)), none
    tracks = len(predicted.ids)
    density = _track_density(geometry, model, predicted)
    expected = (1 - _NEW_SHARE) * _SEEN**2 * density.sum(-1) / tracks + _NEW_SHARE
    near = [_lonely_near(geometry, model, predicted, c) for c in range(2)]
    alone = (1 + near[0].sum(1))[:, None] * (1 + near[1].sum(1)) - near[0] @ near[1].T
    best = np.argmax(density, axis=-1)
    fits = np.take_along_axis(density, best[..., None], -1)[..., 0] * _SEEN**2 > _NEW_SHARE
    track = np.where(fits, np.asarray(predicted.ids)[best], none)
    return np.log(expected) - np.log(alone), track


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
    off = geometry.points_mm[..., None, :] - predicted.points_mm
    distance = (off * np.linalg.solve(covariance, off[..., None])[..., 0]).sum(-1)
    density = np.exp(-0.5 * np.minimum(distance, 2 * _NEAR))
    density /= np.sqrt(np.linalg.det(2 * np.pi * covariance))
    size = 0.25 * (first.log_size.sum(-1)[:, None] + second.log_size.sum(-1))[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        log_ratio = size - np.log(np.asarray(predicted.d_eq_mm) / 2)
    population = float(np.sqrt(model.size.spread.mean()))
    sd = min(_SIZE_SD, population)
    of_size = np.exp(-0.5 * (log_ratio / sd) ** 2) * population / sd
    of_size = np.where(np.isfinite(log_ratio), of_size, 1.0)
    return np.asarray(density * of_size * _volume_mm3(geometry, model))


def _volume_mm3(geometry: PairGeometry, model: PairModel) -> float:
    widths = [min(v.camera.image_size_px) / v.camera["scale_px_per_mm"] for v in geometry.views]
    return float(widths[0] * widths[1] * model.span_px * np.median(geometry.mm_per_px))


def _lonely_near(geometry: PairGeometry, model: PairModel, predicted: Prediction, c: int) -> Array:
    """(N, K) expected density of detections whose track only this camera sees, over the usual."""
    view = geometry.views[c]
    cameras = (geometry.views[0].camera, geometry.views[1].camera)
    pixels, jacobian, _ = stacked_jacobian(cameras, np.asarray(predicted.points_mm, float))
    rows = jacobian[:, 2 * c : 2 * c + 2]
    spread = rows @ predicted.covariance_mm2 @ np.swapaxes(rows, 1, 2)
    common = model.scatter_px**2 + model.frame_px**2 + model.bias_px[0] ** 2 / 4
    covariance = spread + view.covariance_px2[:, None] + common * np.eye(2)
    off = view.uv_px[:, None] - pixels[:, 2 * c : 2 * c + 2]
    distance = (off * np.linalg.solve(covariance, off[..., None])[..., 0]).sum(-1)
    density = np.exp(-0.5 * np.minimum(distance, 2 * _NEAR))
    density /= 2 * np.pi * np.sqrt(np.linalg.det(covariance))
    width, height = view.camera.image_size_px
    usual = max(len(view) * model.lonely[c], 1e-3)
    return np.asarray(_SEEN * (1 - _SEEN) * density * width * height / usual)
