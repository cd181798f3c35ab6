"""A calibration's results folder as files, for tests of what reads it."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from report_page import edit
from scipy.linalg import block_diag

from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import PARAMETERS
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.triangulation import POSE_COMPONENTS

SIGMA_PX, BUMP_MM = 0.01, 0.05
LENS_SD = {"scale_px_per_mm": 3.4e-4, "k1": 4.8e-5}
_edit = partial(edit, "calibration.json")


def _cameras(count: int) -> tuple[Camera, ...]:
    turned = Pose.from_rotvec([0.0, np.pi / 2, 0.0], [0.0, 0.3, 0.0])
    left = Camera.create("left", (512, 400), 10.0, k1=0.002)
    return (left, Camera.create("right", (512, 512), 10.3, camera_from_rig=turned))[:count]


def _pose_json(pose: Pose) -> dict[str, Any]:
    return {"rotation": pose.rotation.tolist(), "translation_mm": pose.translation_mm.tolist()}


def _points() -> np.ndarray:
    row, column = np.divmod(np.arange(15), 5)
    points = np.stack([7.0 * column, 7.0 * row, 0.0 * row], -1)
    points[7, 2] += BUMP_MM
    return points


def _views(rng: np.random.Generator) -> dict[str, Pose]:
    facing = rotation_from_rotvec([0.0, -np.pi / 4, 0.0])
    turns = [facing @ rotation_from_rotvec(0.3 * rng.standard_normal(3)) for _ in range(6)]
    return {f"view{i:02}": Pose(r, -r @ _points().mean(axis=0)) for i, r in enumerate(turns)}


def _camera_json(camera: Camera) -> dict[str, Any]:
    return {
        "image_size_px": list(camera.image_size_px),
        "rho_mm": camera.rho_mm,
        "parameters": {p: camera[p] for p in PARAMETERS},
        "free": list(LENS_SD),
        "standard_deviations": LENS_SD,
        "camera_from_rig": _pose_json(camera.camera_from_rig),
    }


def _rig_block(cameras: tuple[Camera, ...]) -> tuple[list[str], np.ndarray]:
    lens = {f"{camera.name}.{name}": sd for camera in cameras for name, sd in LENS_SD.items()}
    poses = {f"{camera.name}.{name}": float(k) for camera in cameras[1:]
             for k, name in enumerate(POSE_COMPONENTS, start=1)}  # fmt: skip
    sd = lens | poses
    return list(sd), np.diag(np.square(list(sd.values())))


def _content(cameras: tuple[Camera, ...], views: dict[str, Pose]) -> dict[str, Any]:
    names, matrix = _rig_block(cameras)
    rung = {"model": "none", "chi2_gain": None}
    return {
        "schema": 1,
        "kind": "telerig calibration",
        "name": "tank <2>",
        "gauge": "the gauge in words",
        "findings": [
            {
                "code": "ODD_VIEW",
                "views": ["<odd> &"],
                "cameras": ["left"],
                "numbers": {"kept": 6, "dots": 15},
            },
            {"code": "NOTE", "text": "a note"},
        ],
        "verdict": {"status": "USABLE, with warnings"},
        "cameras": {c.name: _camera_json(c) for c in cameras},
        "target": {"dots": list(range(15)), "points_mm": _points().tolist()},
        "views": {name: _pose_json(pose) for name, pose in views.items()},
        "covariance": {"names": names, "matrix": matrix.tolist()},
        "model": {"name": "none", "words": "none was enough", "ladder": [rung]},
        "twin": {"cost": 12.5, "other_cost": 99.25, "decided_by": "nominal rotation", "words": "w"},
        "statistics": {"rms_px": 0.01, "chi2_dof": 1.01, "dots_kept": 178, "dots_measured": 180,
                       "degrees_of_freedom": 301.0, "axes_angle_deg": 90.0,
                       "axes_angle_sd_deg": 6.9e-4, "space_sd_um": 0.51, "noise_floor_px": 0.0},
        "diagnostics": {},
        "stage": {},
    }  # fmt: skip


def _tables(
    cameras: tuple[Camera, ...], views: dict[str, Pose], rng: np.random.Generator
) -> tuple[pd.DataFrame, pd.DataFrame]:
    rows = []
    covariance = SIGMA_PX**2 * np.array([[1.0, 0.6], [0.6, 1.0]])
    for view, pose in views.items():
        for camera in cameras:
            uv = camera.project(pose.apply(_points()))
            noise = rng.multivariate_normal([0, 0], covariance, len(uv))
            for dot, (u, v), (du, dv) in zip(range(15), uv + noise, noise):
                rows.append([view, camera.name, dot, dot // 5, dot % 5, u, v, du, dv, 1.0, ""])
    columns = ["view", "camera", "dot", "row", "column", "u_px", "v_px"]
    columns += ["du_px", "dv_px", "weight", "reason"]
    residuals = pd.DataFrame(rows, columns=columns)
    residuals.loc[3, ["du_px", "weight", "reason"]] = [0.9, 0.0, "90 deviations"]
    dots = residuals[columns[:7]].assign(suu_px2=1e-4, suv_px2=6e-5, svv_px2=1e-4)
    return residuals, dots


def write_calibration_folder(folder: Path, cameras: int) -> Path:
    rng = np.random.default_rng(11)
    rig, views = _cameras(cameras), _views(rng)
    folder.mkdir()
    (folder / "calibration.json").write_text(json.dumps(_content(rig, views)))
    residuals, dots = _tables(rig, views, rng)
    residuals.to_csv(folder / "residuals.csv", index=False)
    dots.to_csv(folder / "dots.csv", index=False)
    names, block = _rig_block(rig)
    dot_names = [f"dot {i}.{axis}_mm" for i in range(15) for axis in "xyz"]
    root = 1e-3 * rng.standard_normal((45, 45))
    np.savez(folder / "covariance.npz", names=np.array([*names, *dot_names]),
             covariance=block_diag(block, root @ root.T))  # fmt: skip
    (folder / "run.json").write_text(json.dumps({"packages": {"numpy": "9.9"}, "seed": 3}))
    for camera in rig:
        (folder / "overlays" / camera.name).mkdir(parents=True)
        cv2.imwrite(str(folder / "overlays" / camera.name / "view01.jpg"), _noise_image(rng))
    return folder


def _noise_image(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 255, (500, 600, 3), dtype=np.uint8)
