"""A `Calibration` as files: calibration.json, covariance.npz, dots.csv, residuals.csv."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.io.files.atomic import atomic_path, write_json_atomic
from telerig.io.files.csv_table import write_table
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.projection import PARAMETERS, intrinsics_from
from telerig.rig.windows import Wall

Array = NDArray[np.float64]

SCHEMA = 1


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write into the folder ``path``, or as ``path`` itself when it ends in .json."""
    folder, file = (
        (path.parent, path) if path.suffix == ".json" else (path, path / "calibration.json")
    )
    folder.mkdir(parents=True, exist_ok=True)
    write_json_atomic(file, as_dict(calibration))
    if calibration.joint_names:
        with atomic_path(folder / "covariance.npz") as temporary, temporary.open("wb") as stream:
            np.savez_compressed(
                stream,
                names=np.array(calibration.joint_names),
                covariance=calibration.joint_covariance.astype(np.float64),
            )
    else:
        (folder / "covariance.npz").unlink(missing_ok=True)
    if path.suffix != ".json":
        if calibration.dots is not None:
            write_table(calibration.dots, folder / "dots.csv")
        if calibration.residuals is not None:
            write_table(calibration.residuals, folder / "residuals.csv")


def as_dict(calibration: Calibration) -> dict[str, Any]:
    """What calibration.json holds."""
    return {
        "schema": SCHEMA,
        "kind": "telerig calibration",
        "name": calibration.name,
        "pixel_origin": "centre",
        "units": {"length": "mm", "image": "px", "angle": "rad unless the name ends in _deg"},
        "gauge": calibration.diagnostics.get("gauge", ""),
        "medium": calibration.medium,
        "verdict": dict(calibration.verdict),
        "cameras": {
            c.name: _camera(calibration, c, f)
            for c, f in zip(calibration.cameras, calibration.free)
        },
        "walls": {c.name: c.wall.as_dict() for c in calibration.cameras if c.wall is not None},
        "target": {
            "dots": calibration.dot_ids.tolist(),
            "points_mm": calibration.target_points_mm.tolist(),
        },
        "views": {v: _pose(p) for v, p in calibration.target_poses.items()},
        "covariance": {
            "names": list(calibration.covariance_names),
            "matrix": calibration.covariance.tolist(),
        },
        "model": dict(calibration.model),
        "stage": dict(calibration.stage),
        "twin": dict(calibration.twin),
        "statistics": dict(calibration.statistics),
        "diagnostics": dict(calibration.diagnostics),
        "notes": list(calibration.notes),
    }


def _camera(calibration: Calibration, camera: Camera, free: tuple[str, ...]) -> dict[str, Any]:
    sd = {n: calibration.sd(f"{camera.name}.{n}") for n in free}
    return {
        "image_size_px": list(camera.image_size_px),
        "rho_mm": camera.rho_mm,
        "parameters": {p: camera[p] for p in PARAMETERS},
        "free": list(free),
        "standard_deviations": sd,
        "camera_from_rig": _pose(camera.camera_from_rig),
    }


def _pose(pose: Pose) -> dict[str, list[Any]]:
    return {
        "rotation": pose.rotation.tolist(),
        "rotvec_deg": np.degrees(pose.rotvec_rad).tolist(),
        "translation_mm": pose.translation_mm.tolist(),
    }


def _pose_from(data: dict[str, Any]) -> Pose:
    return Pose(np.array(data["rotation"], float), np.array(data["translation_mm"], float))


def read_calibration(path: Path) -> Calibration:
    """Read calibration.json and, if it lies beside, covariance.npz.

    Raises InputError when the file is missing, is not a calibration, or is of a newer schema.
    """
    file = path / "calibration.json" if path.is_dir() else path
    if not file.is_file():
        raise InputError(
            "no calibration here", where=str(file), todo="run `telerig calibrate DATASET` first"
        )
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
        if data["kind"] != "telerig calibration":
            raise KeyError("kind")
        if data["schema"] > SCHEMA:
            raise InputError(
                f"schema {data['schema']} is newer than this version reads ({SCHEMA})",
                where=str(file),
                todo="update telerig",
            )
        return _from_dict(data, file)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        raise InputError(
            f"not a calibration that telerig wrote ({error!r})",
            where=str(file),
            todo="calibrate again, or name the right file",
        ) from error


def _from_dict(data: dict[str, Any], file: Path) -> Calibration:
    walls = {name: Wall.from_dict(wall) for name, wall in data.get("walls", {}).items()}
    cameras = tuple(
        Camera(
            name, (int(c["image_size_px"][0]), int(c["image_size_px"][1])), float(c["rho_mm"]),
            intrinsics_from(c["parameters"]), _pose_from(c["camera_from_rig"]), walls.get(name),
        )
        for name, c in data["cameras"].items()
    )  # fmt: skip
    rig = np.array(data["covariance"]["matrix"], float)
    names, joint = _joint_covariance(file.parent / "covariance.npz", rig)
    return Calibration(
        cameras=cameras,
        dot_ids=np.array(data["target"]["dots"], np.int64),
        target_points_mm=np.array(data["target"]["points_mm"], float).reshape(-1, 3),
        target_poses={v: _pose_from(p) for v, p in data["views"].items()},
        covariance=rig,
        covariance_names=tuple(data["covariance"]["names"]),
        free=tuple(tuple(c["free"]) for c in data["cameras"].values()),
        name=data["name"],
        verdict=data["verdict"],
        statistics=data["statistics"],
        twin=data["twin"],
        model=data["model"],
        diagnostics=data["diagnostics"],
        notes=tuple(data["notes"]),
        stage=_stage(data.get("stage", {})),
        medium=data.get("medium", "air"),
        joint_names=names,
        joint_covariance=joint,
    )


def _stage(data: dict[str, Any]) -> dict[str, Any]:
    """Checked for what the smoother reads; the file of an older version has none."""
    if data:
        for key, shape in (("axis", (3,)), ("basis", (3, 2)), ("joint_covariance", (3, 3))):
            if np.shape(data[key]) != shape:
                raise ValueError(f"stage.{key} has shape {np.shape(data[key])}, not {shape}")
        float(data["encoder_scale"])
    return data


def _joint_covariance(beside: Path, rig: Array) -> tuple[tuple[str, ...], Array]:
    """Names and matrix of the whole estimate; empty when the file is not there."""
    if not beside.is_file():
        return (), np.zeros((0, 0))
    try:
        with np.load(beside) as archive:
            names, joint = tuple(archive["names"].tolist()), archive["covariance"]
    except (ValueError, KeyError, OSError, BadZipFile) as error:
        raise InputError(
            f"not a covariance that telerig wrote ({error!r})",
            where=str(beside),
            todo="calibrate again, or delete this file: only the full covariance is lost",
        ) from error
    if not np.allclose(joint[: len(rig), : len(rig)], rig, rtol=1e-9, atol=0):
        raise InputError(
            "this covariance belongs to another calibration than the calibration.json beside it",
            where=str(beside),
            todo="copy both files together, or delete this one",
        )
    return names, joint
