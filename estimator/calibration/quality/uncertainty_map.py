"""The working volume, and how well points in it are known: the calibration's share, the pixels'."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array
from telerig.errors import CalibrationError
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.rig.camera import Camera

STEPS = 7
VOLUME_SHARE = 0.6
"""The working volume: a cube of this share of the smaller field of view, round the rig's origin."""


def working_volume(cameras: tuple[Camera, ...], steps: int = 5) -> Array:
    """(steps^3, 3) grid of rig points that all cameras see."""
    field = min(min(c.image_size_px) / c["scale_px_per_mm"] for c in cameras)
    axis = np.linspace(-0.5, 0.5, steps) * VOLUME_SHARE * field
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


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
    """Of points triangulated from all cameras' pixels, good to ``sigma_px`` (None: as the
    calibration's dots are).

    Raises CalibrationError for a single camera.
    """
    sigma = float(calibration.statistics.get("scatter_px", 0.02)) if sigma_px is None else sigma_px
    points = working_volume(calibration.cameras, steps)
    if len(calibration.cameras) < 2:
        raise CalibrationError(
            "one camera cannot triangulate, so there is no map of its uncertainty in space",
            todo="calibrate two cameras",
        )
    pixels = {c.name: calibration.project(c.name, points) for c in calibration.cameras}
    if len(pixels) == 2:
        first, second = pixels.values()
        found = calibration.triangulate(first, second, sigma_px=sigma)
    else:
        found = calibration.triangulate(pixels, sigma_px=sigma)
    own = found.measurement_covariance_mm2
    return UncertaintyMap(points, found.covariance_mm2 - own, own, sigma)
