"""HALCON's files: the parameter tuples as HDevelop lines, `.dat` camera parameters, `.dat` poses.

The `.dat` layouts are those of the reference manual (read_cam_par, write_pose). Before HALCON 13 a
telecentric camera is one with Focus 0 and Sx, Sy the pixel's size in the object; here the
magnification is 1, so that the numbers are the same in both conventions.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from telerig.io.exchange.export.halcon import HalconCamera
from telerig.io.files.atomic import atomic_folder
from telerig.rig.pose import Pose

Array = NDArray[np.float64]

_DAT = {
    "focus": ("Focus:foc", "DOUBLE:0.0:", "Focal length of the lens [meter]"),
    "kappa": ("Kappa:kappa", "DOUBLE::", "Radial distortion coefficient [1/(meter*meter)]"),
    **{
        name: (f"Poly{i}:poly{i}", "DOUBLE::", f"{nth} polynomial distortion coefficient")
        for i, name, nth in zip(
            range(1, 6), ("k1", "k2", "k3", "p1", "p2"), ("1st", "2nd", "3rd", "4th", "5th")
        )
    },
    "sx": ("Sx:sx", "DOUBLE:0.0:", "Width of a cell on the sensor [meter]"),
    "sy": ("Sy:sy", "DOUBLE:0.0:", "Height of a cell on the sensor [meter]"),
    "cx": ("Cx:cx", "DOUBLE::", "X-coordinate of the image center [pixel]"),
    "cy": ("Cy:cy", "DOUBLE::", "Y-coordinate of the image center [pixel]"),
    "image_width": ("ImageWidth:imgw", "INT:1:32767", "Width of the images [pixel]"),
    "image_height": ("ImageHeight:imgh", "INT:1:32767", "Height of the images [pixel]"),
}


def write_halcon(cameras: Sequence[HalconCamera], folder: str | PathLike[str]) -> list[str]:
    """Into a folder: cameras.hdev.txt, and per camera <camera>.dat and <camera>_pose.dat.

    Returns the names of the files. A camera with a tilted sensor has no `.dat`: its layout is not
    documented. Raises InputError when the folder cannot be written.
    """
    names = []
    with atomic_folder(folder) as place:
        for camera in cameras:
            if "tilt" not in camera.parameters:
                names.append(_write(place / f"{camera.camera}.dat", _parameters_text(camera)))
            names.append(_write(place / f"{camera.camera}_pose.dat", _pose_text(camera)))
        names.append(_write(place / "cameras.hdev.txt", hdevelop_lines(cameras)))
    return names


def hdevelop_lines(cameras: Sequence[HalconCamera]) -> str:
    """Assignments to paste into HDevelop: CamParam<i> (camera type first), Pose<i>."""
    lines = [
        "* World: telerig's rig frame, the first camera's.",
        "* Pixels: the centre of the top-left pixel is (0, 0).",
        "* CamParam: camera type, then its parameters in HALCON's order (m, px, degrees).",
        "* Pose: the world relative to the camera (camera point = Pose * world point), m, degrees.",
    ]
    for i, camera in enumerate(cameras, 1):
        error = "exact" if camera.exact else "; ".join(camera.notes)
        values = ", ".join(_number(v) for v in camera.parameters.values())
        pose = ", ".join(repr(float(v)) for v in pose_tuple(camera.camera_from_rig))
        lines += [
            "",
            f"* {camera.camera}: {error}",
            f"* error against telerig over the working volume: {camera.misfit.words()}",
            f"CamParam{i} := ['{camera.kind}', {values}]",
            f"Pose{i} := [{pose}, 0]",
        ]
    return "\n".join(lines) + "\n"


def pose_tuple(pose: Pose) -> Array:
    """(6,) translation in m, then angles in degrees, R = Rx Ry Rz (HALCON's type 0: Rp+T, gba)."""
    r = pose.rotation
    beta = np.arctan2(r[0, 2], np.hypot(r[1, 2], r[2, 2]))
    alpha = np.arctan2(-r[1, 2], r[2, 2]) if np.hypot(r[1, 2], r[2, 2]) > 1e-9 else 0.0
    c, s = np.cos(alpha), np.sin(alpha)
    second = c * r[1] + s * r[2]
    gamma = np.arctan2(second[0], second[1])
    return np.concatenate([pose.translation_mm * 1e-3, np.degrees([alpha, beta, gamma]) % 360])


def _parameters_text(camera: HalconCamera) -> str:
    values = dict(camera.parameters)
    if "magnification" in values:
        values = {"focus": 0.0} | {k: v for k, v in values.items() if k != "magnification"}
    lines = [
        f"# {camera.camera}: {camera.kind}, magnification 1, Sx and Sy in the object",
        *(f"# {note}" for note in camera.notes),
        f"# error against telerig over the working volume: {camera.misfit.words()}",
        "# INTERNAL CAMERA PARAMETERS",
        "",
        "ParGroup: Camera: Parameter;",
        '  "Internal camera parameters";',
    ]
    for name, value in values.items():
        head, kind, words = _DAT[name]
        lines += ["", f"{head}: {_number(value)};", f"  {kind};", f'  "{words}";']
    return "\n".join(lines) + "\n"


def _pose_text(camera: HalconCamera) -> str:
    x, y, z, alpha, beta, gamma = (repr(float(v)) for v in pose_tuple(camera.camera_from_rig))
    return (
        f"# {camera.camera}: the rig frame relative to the camera\n"
        "# 3D POSE PARAMETERS: rotation and translation\n\n"
        "# Used representation type:\nf 0\n\n"
        f"# Rotation angles [deg] or Rodriguez vector:\nr {alpha} {beta} {gamma}\n\n"
        f"# Translation vector (x y z [m]):\nt {x} {y} {z}\n"
    )


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else repr(float(value))


def _write(path: Path, text: str) -> str:
    path.write_text(text, encoding="utf-8")
    return path.name
