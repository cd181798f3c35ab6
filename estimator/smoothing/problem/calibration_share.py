"""The part of a calibration's uncertainty that affects the pixels of a run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.problem.problem import CalibrationShare

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.estimator.rig_drift.movement import Movement


_VISIBLE_PX = 2e-3


def calibration_share(
    calibration: Calibration, points_mm: Array, sigma_px: float, drift: Movement | None = None
) -> CalibrationShare | None:
    """Return the uncertainty of a calibration that affects the pixels of some points.

    Directions of the covariance are left out if they move the pixels by far less than the noise of
    a mean over the run.

    points_mm : (n, 3) in the rig frame.
    sigma_px : noise of a pixel.
    drift : a movement of a camera since the calibration; None if none has moved.
    """
    from telerig.estimator.rig_drift.movement import rig_block, with_drift
    from telerig.rig.triangulation import rig_jacobian

    covariance, free = calibration.covariance, calibration.free
    if drift is not None:
        covariance, free = rig_block(calibration)
        covariance = with_drift(covariance, drift)
    if not len(points_mm) or not covariance.size:
        return None
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.clip(values, 0, None))
    rows = rig_jacobian(calibration.cameras, free, points_mm) @ root
    flat = rows.reshape(-1, root.shape[1])
    _, strength, turn = np.linalg.svd(flat, full_matrices=False)
    visible = strength / np.sqrt(len(flat)) > min(_VISIBLE_PX, 0.02 * sigma_px)
    if not visible.any():
        return None
    return CalibrationShare(root @ turn[visible].T, free, covariance, drift)
