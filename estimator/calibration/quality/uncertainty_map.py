"""Maps the uncertainty of triangulated points over the working volume."""

from __future__ import annotations

from dataclasses import dataclass

from telerig.arrays import Array
from telerig.errors import LOAD, CalibrationError, need_kind
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.rig.triangulation import working_volume


@dataclass(frozen=True)
class UncertaintyMap:
    """Covariances of triangulated points on a grid over the working volume, split by their cause.

    points_mm : (N, 3) in the rig frame.
    calibration_mm2 : (N, 3, 3) due to errors of the calibration, which are common to all points of
        a run.
    measurement_mm2 : (N, 3, 3) due to noise of the pixels with the standard deviation sigma_px,
        which is independent for each point.
    """

    points_mm: Array
    calibration_mm2: Array
    measurement_mm2: Array
    sigma_px: float


def uncertainty_map(
    calibration: Calibration, *, sigma_px: float | None = None, steps: int = 7
) -> UncertaintyMap:
    """Return the covariance of triangulated points on a cubic grid round the origin of the rig.

    It is split into the share of the calibration and that of the pixels (see `UncertaintyMap`).

    sigma_px : standard deviation of a pixel coordinate; None takes the scatter of the calibration's
        own dots.
    steps : number of grid points along each axis.

    Raises CalibrationError for a single camera.
    """
    need_kind(calibration, "cameras", "telerig.uncertainty_map", LOAD)
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
