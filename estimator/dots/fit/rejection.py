"""Decides which blobs and which fits are no dots."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.dots.fit.blurred_ellipse import axes_from_shape, extent_px
from telerig.estimator.dots.fit.candidates import Candidate, Candidates, Polarity
from telerig.estimator.dots.fit.types import PARAMETERS, DotFit, Reason

Array = NDArray[np.float64]
Grey = NDArray[np.float32]

_MAX_EDGE_RESIDUAL = 0.12
_MISFIT_CHI2 = 2.0
_MIN_RELATIVE_RADIUS = 0.28
_MIN_RELATIVE_CONTRAST = 0.2
_MIN_HOLE_SHARE = 0.02
_MAX_ONE_SIDED_SATURATION = 0.06


def reference_radius_px(found: Candidates) -> float:
    """Radius of the blob at the median of the promising blobs' area; 0 where there are none."""
    areas = np.sort([blob.area_px2 for blob in found.promising])
    if areas.size == 0:
        return 0.0
    middle = np.searchsorted(np.cumsum(areas), 0.5 * np.sum(areas))
    return float(np.sqrt(areas[min(middle, areas.size - 1)] / np.pi))


def is_ring(blob: Candidate) -> bool:
    """Whether holes make up a notable part of the blob, rather than specks of dust in it."""
    import cv2

    holes = sum(float(cv2.contourArea(hole.reshape(-1, 1, 2))) for hole in blob.holes)
    return holes > _MIN_HOLE_SHARE * blob.area_px2


def saturation_level(grey: Grey) -> float:
    """Grey level at which the sensor saturates: the top level if unusually many pixels have it,
    else infinity."""
    top = float(grey.max())
    at_top = int(np.count_nonzero(grey == top))
    span = top - float(grey.min())
    below = int(np.count_nonzero((grey < top) & (grey >= top - 0.02 * span)))
    return top if at_top >= 20 and at_top > below and span > 0.0 else np.inf


def _one_sided_saturation(
    grey: Grey, centre: Array, shape: Array, margin: float, level: float
) -> float:
    """Length of the mean direction towards saturated pixels; 0 where they are all round."""
    if not np.isfinite(level):
        return 0.0
    half = extent_px(shape) + margin
    low = np.maximum(np.floor(centre - half).astype(int), 0)
    high = np.minimum(np.ceil(centre + half).astype(int) + 1, grey.shape[::-1])
    crop = grey[low[1] : high[1], low[0] : high[0]]
    v, u = np.nonzero(crop >= level)
    if u.size == 0:
        return 0.0
    du, dv = u + low[0] - centre[0], v + low[1] - centre[1]
    away = np.hypot(du, dv) + 1e-9
    return float(np.hypot(np.sum(du / away), np.sum(dv / away))) / crop.size


def reason_against_blob(
    blob: Candidate, grey: Grey, reference_px: float, saturation: float
) -> Reason | None:
    """Reason to leave a blob out before any fit; None for a blob that may be a dot."""
    if blob.reason == Reason.TOUCHES_BORDER:
        return Reason.TOUCHES_BORDER
    if np.sqrt(blob.area_px2 / np.pi) < _MIN_RELATIVE_RADIUS * reference_px:
        return Reason.MUCH_SMALLER
    if blob.reason in (Reason.MERGED, Reason.NOT_ELLIPSE):
        lopsided = _one_sided_saturation(grey, blob.centre_px, blob.shape_px, 2.0, saturation)
        return Reason.GLARE if lopsided > _MAX_ONE_SIDED_SATURATION else blob.reason
    return blob.reason


def reason_against_fit(
    fit: DotFit, grey: Grey, polarity: Polarity, usual_contrast: float, saturation: float
) -> Reason | None:
    """Reason to leave a fitted dot out; None for a good one."""
    if fit.pixels <= PARAMETERS:
        return Reason.HIDDEN
    if not np.all(np.isfinite(fit.covariance_px2)) or axes_from_shape(fit.shape_px)[1] <= 0.0:
        return Reason.FIT_FAILED
    half, size = extent_px(fit.shape_px) + fit.sigma_px, np.array(grey.shape[::-1])
    if np.any(fit.centre_px - half < -0.5) or np.any(fit.centre_px + half > size - 0.5):
        return Reason.TOUCHES_BORDER
    lopsided = _one_sided_saturation(
        grey, fit.centre_px, fit.shape_px, 2.0 * fit.sigma_px, saturation
    )
    if lopsided > _MAX_ONE_SIDED_SATURATION:
        return Reason.GLARE
    if fit.edge_residual > _MAX_EDGE_RESIDUAL and fit.chi2_dof > _MISFIT_CHI2:
        return Reason.MISFIT
    if (fit.contrast > 0.0) != (polarity == "white_on_black"):
        return Reason.WRONG_SIGN
    if abs(fit.contrast) < _MIN_RELATIVE_CONTRAST * usual_contrast:
        return Reason.FAINT
    return None
