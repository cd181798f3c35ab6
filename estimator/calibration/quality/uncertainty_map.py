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
    """Return a cubic grid of points in the rig frame that all cameras see.

    steps : number of points along each edge.

    Returns (steps^3, 3) points, in mm.
    """
    field = min(min(c.image_size_px) / c["scale_px_per_mm"] for c in cameras)
    axis = np.linspace(-0.5, 0.5, steps) * VOLUME_SHARE * field
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


@dataclass(frozen=True)
class UncertaintyMap:
    """Hold covariances of triangulated points over the working volume, split by their cause.

    points_mm : (N, 3) grid of points in the rig frame, in mm.
    calibration_mm2 : (N, 3, 3) covariances that the calibration's errors cause, in mm^2. These
        errors are common to all points of a run.
    measurement_mm2 : (N, 3, 3) covariances that the noise of the pixels causes, in mm^2. This noise
        is independent for each point.
    sigma_px : standard deviation of the pixels, in px.
    """

    points_mm: Array
    calibration_mm2: Array
    measurement_mm2: Array
    sigma_px: float


def uncertainty_map(
    calibration: Calibration, *, sigma_px: float | None = None, steps: int = STEPS
) -> UncertaintyMap:
    """Compute how uncertain points are that are triangulated from the pixels of all cameras.

    calibration : a calibration of two or more cameras.
    sigma_px : standard deviation of the pixels, in px; None takes the scatter of the calibration's
        own dots.
    steps : number of grid points along each edge of the working volume.

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
