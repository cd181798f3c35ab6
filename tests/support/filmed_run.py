"""A tracked run of ellipsoids with its calibration, to be filmed."""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pandas as pd

from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.triangulation import triangulate

SIZE_PX, SCALE, FRAMES = (320, 400), 12.0, 24
HALF_AXES_MM = np.array([1.6, 1.0, 1.6])
"""Oblate, its short axis along rig y, the vertical."""


def two_cameras(turn: float = np.pi / 2) -> tuple[Camera, Camera]:
    turned = Pose.from_rotvec([0.0, turn, 0.0])
    left = Camera.create("left", SIZE_PX, SCALE)
    return left, Camera.create("right", SIZE_PX, SCALE, camera_from_rig=turned)


def _ellipse(camera: Camera, quadric: np.ndarray) -> tuple[float, float, float]:
    """Semi-axes and angle of an ellipsoid's outline: the lens of these cameras is a plain one."""
    by_point = SCALE * camera.camera_from_rig.rotation[:2]
    squares, axes = np.linalg.eigh(by_point @ quadric @ by_point.T)
    return np.sqrt(squares[1]), np.sqrt(squares[0]), np.arctan2(axes[1, 1], axes[0, 1])


def write_run(folder: Path, calibration: bool = True) -> Path:
    """A bubble on a helix, tracked with noise, its outlines, and the calibration beside it."""
    rng = np.random.default_rng(3)
    frame = np.arange(FRAMES)
    turn = 2 * np.pi * frame / 16
    points = np.stack([2 + 3 * np.cos(turn), 8 - 0.7 * frame, 3 * np.sin(turn)], -1)
    cameras = two_cameras()
    uv = [c.project(points) + 0.05 * rng.standard_normal((FRAMES, 2)) for c in cameras]
    found = triangulate(cameras, (uv[0], uv[1]), 0.05)
    table = pd.DataFrame({"frame": frame, "particle": 0, "t_s": frame / 100})
    table[["x_mm", "y_mm", "z_mm"]] = found.points_mm
    upper = found.covariance_mm2[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    table[[f"s{pair}_mm2" for pair in ("xx", "xy", "xz", "yy", "yz", "zz")]] = upper
    detections = []
    for camera, pixels in zip(cameras, uv):
        c = camera.name
        table[[f"{c}_u_px", f"{c}_v_px"]] = pixels
        table[[f"{c}_suu_px2", f"{c}_suv_px2", f"{c}_svv_px2"]] = 0.0025, 0.0, 0.0025
        a, b, angle = _ellipse(camera, np.diag(HALF_AXES_MM**2))
        detections.append(pd.DataFrame({
            "frame": frame, "camera": c, "particle": 0, "u_px": pixels[:, 0], "v_px": pixels[:, 1],
            "a_px": a, "b_px": b, "angle_rad": angle, "c3_px": 0.4, "flags": "", "reason": "",
        }))  # fmt: skip
    table["ray_miss_mm"], table["confidence"] = found.ray_miss_mm, 1.0
    table["d_eq_mm"] = 2 * np.prod(HALF_AXES_MM) ** (1 / 3)
    table["equator_mm"], table["polar_mm"] = HALF_AXES_MM[:2]
    table[["pole_x", "pole_y", "pole_z"]] = 0.0, -1.0, 0.0
    folder.mkdir(parents=True)
    table.to_csv(folder / "tracks.csv", index=False)
    pd.concat(detections).to_csv(folder / "detections.csv", index=False)
    content = {"schema": 1, "kind": "telerig tracks", "run": "rise", "frames": FRAMES,
               "image_size_px": {"left": SIZE_PX, "right": SIZE_PX}}  # fmt: skip
    (folder / "tracking.json").write_text(json.dumps(content))
    if calibration:
        calibration_from_cameras(list(cameras)).save(folder.parent / "calibration")
    return folder


def decoded(file: Path) -> list[np.ndarray]:
    with av.open(str(file)) as container:
        return [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
