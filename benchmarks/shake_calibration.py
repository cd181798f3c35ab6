"""A rig that was calibrated from noisy views of a plate, for the smoother's benchmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.random import Generator
from numpy.typing import NDArray

from telerig.estimator.calibration.calibrate import nominal_cameras
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.io.simulation.calibration.scene import hand_held_views, true_cameras, true_target
from telerig.io.simulation.calibration_files import exact_dots, rig_description
from telerig.io.simulation.config import CameraConfig
from telerig.io.simulation.presets import preset
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

Array = NDArray[np.float64]

SIGMA_PX = 0.3
"""Of a dot, each coordinate: a poor calibration, so that it matters."""


def calibrated(
    angle_deg: float, kappa_per_mm: float, rng: Generator
) -> tuple[tuple[Camera, Camera], Calibration]:
    """True cameras and what 12 views of a plate of 35 dots tell of them.

    Both in the frame of the calibration: the true rig is turned and shifted to where its rays fit
    the estimate's best, since no calibration knows the frame's own place.
    """
    cameras = tuple(
        CameraConfig(name, (1024, 1024), 10.03, 10.0, parameters={"kappa_per_mm": kappa_per_mm})
        for name in ("left", "right")
    )
    plain = preset("paper")
    pitch = (11.0, 11.0)
    target = replace(
        plain.target, rows=5, columns=7, pitch_mm=pitch, scale_dots=(0, 34), scale_distance_mm=None
    )
    settings = replace(
        plain, cameras=cameras, target=target, angle_deg=angle_deg, sigma_px=SIGMA_PX
    )
    true = dict(true_cameras(settings))
    plate = true_target(settings, rng)
    dots = exact_dots(settings, true, plate, hand_held_views(settings, true, plate, rng))
    dots = noisy(dots[dots["inside"] == 1].reset_index(drop=True), rng)
    rig = rig_description(settings, plate)
    found = self_calibrate(
        dots,
        list(nominal_cameras(rig)),
        rig.target,
        nominal_rotvec_deg=rig.rotvec_from_first_deg,
        model="kappa" if kappa_per_mm else "none",
    )
    left, right = (true[name] for name in ("left", "right"))
    return _aligned(left, right, found, rng), found


def noisy(dots: pd.DataFrame, rng: Generator) -> pd.DataFrame:
    out = dots.copy()
    out[["u_px", "v_px"]] += SIGMA_PX * rng.standard_normal((len(out), 2))
    out["suu_px2"] = out["svv_px2"] = SIGMA_PX**2
    out["suv_px2"] = 0.0
    return out


def _aligned(
    left: Camera, right: Camera, found: Calibration, rng: Generator
) -> tuple[Camera, Camera]:
    """The true cameras, their frame moved rigidly onto that of the calibration."""
    points = rng.uniform(-30, 30, (500, 3))
    seen = found.triangulate(left.project(points), right.project(points), sigma_px=0.01).points_mm
    a, b = points - points.mean(0), seen - seen.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt).T
    shift = seen.mean(0) - turn @ points.mean(0)
    moved = Pose(turn, shift).inverse()
    both = (replace(c, camera_from_rig=c.camera_from_rig @ moved) for c in (left, right))
    first, second = both
    return first, second
