"""OpenCV's stereo calibrations (YAML, XML or JSON of cv2.FileStorage) as cameras of this library.

Names are those of OpenCV's samples (stereo_calib: M1 D1 M2 D2 R T; calibration: camera_matrix,
distortion_coefficients) and a few common others. R and T take points of the first camera into the
second.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.exchange.importing.pinhole import ImportedCameras, Pinhole, cameras_from_pinholes
from telerig.io.files.text import LARGEST_NUMBER, need_file
from telerig.io.machine.parallel import isolated
from telerig.rig.pose import rotation_from_rotvec

_MATRIX = ("M{}", "K{}", "cameraMatrix{}", "camera_matrix_{}", "camera_matrix{}", "mtx{}")
_DISTORTION = ("D{}", "distCoeffs{}", "dist_coeffs_{}", "dist_coeffs{}", "dist{}",
               "distortion_coefficients_{}", "distortion_coefficients{}")  # fmt: skip
_ROTATION = ("R", "rotation_matrix", "rotation", "R12")
_TRANSLATION = ("T", "translation_vector", "translation", "T12", "t")


def read_opencv_cameras(
    paths: Sequence[str | PathLike[str]],
    *,
    image_size_px: tuple[int, int] | None = None,
    unit_mm: float = 1.0,
    names: Sequence[str] = ("left", "right"),
) -> ImportedCameras:
    """Read a stereo calibration of OpenCV (YAML, XML or JSON): two pinhole cameras.

    paths : one file with everything, or several: intrinsics and extrinsics, or one file for each
        camera (in their order) and one with R and T.
    image_size_px : (width, height) in px; None where a file has image_width and image_height; a
        file of one camera states that of its own.
    unit_mm : the length in mm that was given to OpenCV as 1 (1000 for metres).

    Raises InputError when something is missing, and for distortion beyond k1 k2 p1 p2 k3 s1..s4.
    """
    if not unit_mm > 0:
        raise InputError(
            f"unit_mm is {unit_mm}, which is no positive length",
            todo="give the length in mm of the unit of T: --unit-mm 1000 if T is in metres",
        )
    files = [Path(p) for p in paths]
    contents = [_content(file) for file in files]
    joint = {name: value for content in contents for name, value in content.items()}
    where = ", ".join(str(file) for file in files)
    single = [c for c in contents if "camera_matrix" in c]
    alone = len(single) == 2
    of_each = single if alone else [joint, joint]
    matrices: list[Array] = []
    distortions: list[Array] = []
    notes: list[str] = []
    for i, content in enumerate(of_each, 1):
        matrices.append(content["camera_matrix"] if alone else _one(joint, _MATRIX, i, where))
        known = ["distortion_coefficients"] if alone else [name.format(i) for name in _DISTORTION]
        found = [content[name] for name in known if name in content]
        distortions.append(found[0] if found else np.zeros(5))
        if not found:
            notes.append(
                f"camera {i}: there is no {' or '.join(known)}, so it has no distortion; the names "
                f"found are: {', '.join(content)}"
            )
    rotation = _one(joint, _ROTATION, 0, where)
    if rotation.size == 3:
        rotation = rotation_from_rotvec(rotation.reshape(3))
    shift = _one(joint, _TRANSLATION, 0, where).reshape(-1) * unit_mm
    sizes = [image_size_px or _size(joint | content, where) for content in of_each]
    if rotation.shape != (3, 3) or shift.shape != (3,) or any(m.shape != (3, 3) for m in matrices):
        raise InputError(
            "R, T or a camera matrix does not have its size",
            where=where,
            todo="give R as (3, 3) or a rotation vector, T with 3 numbers, matrices (3, 3)",
        )
    pinholes = [
        Pinhole(f"{where} camera {i}", size, matrix, *pose, np.asarray(d, float).reshape(-1))
        for i, size, matrix, pose, d in zip(
            (1, 2), sizes, matrices, [(np.eye(3), np.zeros(3)), (rotation, shift)], distortions
        )
    ]
    return cameras_from_pinholes(pinholes, list(names))._replace(notes=tuple(notes))


def _content(file: Path) -> dict[str, Array]:
    """Return every matrix and number at the root of the file."""
    need_file(file)
    try:
        out = isolated(_root_of, str(file))
    except Exception as error:  # cv2.error, what Python makes of it, and crashes
        raise InputError(
            f"OpenCV cannot read it ({error})",
            where=str(file),
            todo="write it with cv2.FileStorage: YAML, XML or JSON",
        ) from error
    for key, values in out.items():
        if not (np.abs(values) <= LARGEST_NUMBER).all():
            what = f"{key!r} holds what is no number up to {LARGEST_NUMBER:g}"
            raise InputError(what, where=str(file), todo="correct it, or calibrate again")
    return out


def _root_of(file: str) -> dict[str, Array]:
    import cv2

    storage = cv2.FileStorage(file, cv2.FILE_STORAGE_READ)
    root = storage.root()
    out = {}
    for name in root.keys():  # noqa: SIM118
        node = root.getNode(name)
        if node.isInt() or node.isReal():
            out[name] = np.array(node.real())
        elif node.isMap() and node.mat() is not None:
            out[name] = np.asarray(node.mat(), float)
        elif node.isSeq():
            out[name] = np.array([node.at(i).real() for i in range(node.size())])
    storage.release()
    return out


def _one(
    content: dict[str, Array],
    names: Sequence[str],
    number: int,
    where: str,
) -> Array:
    wanted = [name.format(number) for name in names]
    found = [content[name] for name in wanted if name in content]
    if found:
        return found[0]
    raise InputError(
        f"has no matrix with one of the names {', '.join(wanted)}",
        where=where,
        todo="give this matrix one of these names, or give also the file that holds it; the names "
        f"found are: {', '.join(content)}",
    )


def _size(content: dict[str, Array], where: str) -> tuple[int, int]:
    for name in ("image_size", "imageSize", "size"):
        if name in content and content[name].size == 2:
            width, height = content[name].reshape(-1)
            return int(width), int(height)
    if {"image_width", "image_height"} <= set(content):
        stated = [content[name].reshape(-1) for name in ("image_width", "image_height")]
        if all(one.size == 1 for one in stated):
            return int(stated[0][0]), int(stated[1][0])
    raise InputError(
        "does not state the image size",
        where=where,
        todo="give the width and height in px: image_size_px=(width, height) in Python, "
        "--image-size on the command line",
    )
