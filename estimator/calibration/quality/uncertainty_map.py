"""How well points are known over the working volume: the calibration's share and the pixels'."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.quality.truth import working_volume
from telerig.estimator.calibration.result.calibration import Calibration

Array = NDArray[np.float64]

STEPS = 7


@dataclass(frozen=True)
class UncertaintyMap:
    """Standard deviations over the working volume, split by where they come from.

    points_mm : (N, 3) grid of rig points.  calibration_mm2, measurement_mm2 : (N, 3, 3); the first
    is common to all points of a run, the second is drawn anew for every point from ``sigma_px``.
    """

    points_mm: Array
    calibration_mm2: Array
    measurement_mm2: Array
    sigma_px: float


def uncertainty_map(
    calibration: Calibration, *, sigma_px: float | None = None, steps: int = STEPS
) -> UncertaintyMap:
    """Of points triangulated from pixels good to ``sigma_px`` (None: the calibration's dots).

    Raises CalibrationError for a single camera.
    """
    sigma = float(calibration.statistics.get("scatter_px", 0.02)) if sigma_px is None else sigma_px
    points = working_volume(calibration.cameras, steps)
    first, second = (calibration.project(c, points) for c in (0, 1))
    found = calibration.triangulate(first, second, sigma_px=sigma)
    own = found.measurement_covariance_mm2
    return UncertaintyMap(points, found.covariance_mm2 - own, own, sigma)
