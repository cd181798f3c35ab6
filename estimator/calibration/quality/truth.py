"""Score a calibration against a simulator's truth; only demo, benchmarks and tests need it.

What no image can tell (the gauge) is set aside.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.estimator.calibration.quality.comparison import after_rigid_motion
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.projection import intrinsics_from
from telerig.rig.triangulation import aligned_covariance, triangulate_any, working_volume

MANY_SD = 4.0


@dataclass(frozen=True)
class SpaceError:
    """Errors of N triangulated points, after the rigid motion that fits them best to the truth.

    rms_um, predicted_um : RMS error per axis, and its prediction by the calibration's covariance.
    errors_mm : (N, 3) estimated minus true.
    covariance_mm2 : (3N, 3N) predicted covariance.
    """

    rms_um: float
    predicted_um: float
    errors_mm: Array
    covariance_mm2: Array


@dataclass(frozen=True)
class Comparison:
    """A calibration compared with the truth of the simulator.

    table : text with one line per quantity.
    verdict : a sentence that begins with PASSED or FAILED.
    space : errors of points in space.
    """

    table: str
    verdict: str
    passed: bool
    space: SpaceError


def true_cameras(truth: Mapping[str, Any]) -> tuple[Camera, ...]:
    """Make the true cameras from the content of `truth/truth.json`."""
    out = []
    for name, data in truth["cameras"].items():
        pose = data["camera_from_rig"]
        intrinsics = intrinsics_from(data["parameters"])
        out.append(
            Camera(
                name, (data["image_size_px"][0], data["image_size_px"][1]), data["rho_mm"],
                intrinsics, Pose(np.array(pose["rotation"]), np.array(pose["translation_mm"])),
            )
        )  # fmt: skip
    return tuple(out)


def space_error(
    calibration: Calibration, truth: tuple[Camera, ...], points_mm: Array
) -> SpaceError:
    """Triangulate points from their true pixels with a calibration, and return the errors.

    truth : the true cameras. points_mm : (N, 3) true points in the rig frame.
    """
    calibration = calibration.in_air()
    pixels = [camera.project(points_mm) for camera in truth]
    found = triangulate_any(calibration.cameras, pixels, 1.0).points_mm
    errors = after_rigid_motion(found, points_mm)
    covariance = aligned_covariance(
        calibration.cameras, calibration.free, calibration.covariance, found
    )
    predicted = np.sqrt(np.trace(covariance) / errors.size)
    return SpaceError(
        float(1e3 * np.sqrt((errors**2).mean())), float(1e3 * predicted), errors, covariance
    )


def compare_with_truth(calibration: Calibration, truth: Mapping[str, Any]) -> Comparison:
    """Compare a calibration with the truth of the simulator.

    truth : content of `truth/truth.json` of the simulated dataset.
    """
    cameras = true_cameras(truth)
    space = space_error(calibration, cameras, working_volume(cameras))
    rows = _parameters(calibration, cameras)
    worst = max(abs(e - t) / s for _, e, t, s in rows)
    ratio = space.rms_um / space.predicted_um
    passed = worst < MANY_SD and ratio < 2.0
    lines = [f"{'quantity':<28}{'estimate':>14}{'truth':>14}{'sd':>10}{'off by':>9}"]
    lines += [f"{n:<28}{e:>14.6f}{t:>14.6f}{s:>10.2g}{(e - t) / s:>6.1f} sd" for n, e, t, s in rows]
    lines.append(
        f"3-D error of the calibration over the working volume: {space.rms_um:.2f} µm RMS per "
        f"axis; its covariance predicts {space.predicted_um:.2f} µm"
    )
    words = (
        f"PASSED: every quantity within {MANY_SD:.0f} standard deviations of the truth"
        if passed
        else f"FAILED: worst quantity {worst:.1f} standard deviations off, 3-D error "
        f"{ratio:.2f} times the predicted"
    )
    return Comparison("\n".join(lines), words, passed, space)


def _parameters(
    calibration: Calibration, cameras: tuple[Camera, ...]
) -> list[tuple[str, float, float, float]]:
    """Return rows (name, estimate, truth, sd) of quantities that do not depend on the gauge."""
    rows = []
    for estimate, truth in zip(calibration.cameras, cameras):
        for name in ("scale_px_per_mm", "k1"):
            sd = calibration.sd(f"{estimate.name}.{name}")
            if sd > 0:
                unit = (estimate.rho_mm / truth.rho_mm) ** 2 if name == "k1" else 1.0
                rows.append((f"{estimate.name} {name}", estimate[name], truth[name] * unit, sd))
    s = calibration.statistics
    others = {camera.name: camera.camera_from_rig.rotation[2] for camera in cameras[1:]}
    for name, axis in others.items():
        angle = float(np.degrees(np.arccos(axis[2])))
        of, words = (s, "") if len(others) == 1 else (s["from_first"][name], f", camera {name}")
        sd = of["axes_angle_sd_deg"]
        rows.append((f"angle of the axes (deg){words}", of["axes_angle_deg"], angle, sd))
    return rows
