"""OpenLPT's camera text files (`cam1.txt`, ...) as cameras of this library, exactly.

A pinhole camera is the model of `telerig.rig.projection` with kappa = 1 / working distance. The
file's matrix K [R | t] is split anew into an upper triangular map and a rotation (RQ), because
its R is often not orthonormal (printed digits, or a fit of nine numbers): what R has of shear
becomes the camera's skew and aspect, and every pixel stays what OpenLPT computes.

OpenLPT's images are often left-handed against its world (fy < 0 with a proper R). Images are what
was recorded, so the *world* is mirrored: `rig_from_world` is then a rotation with a reflection
(determinant -1), and the cameras are ordinary ones, x right, y down, z away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, nearest_rotation

Array = NDArray[np.float64]

_SHEAR_BESIDE_DISTORTION = 1e-5
_LINES = ("calibration error", "pose error", "image size", "camera matrix", "camera matrix",
          "camera matrix", "distortion coefficients", "rotation vector", "rotation matrix",
          "rotation matrix", "rotation matrix", "inverse rotation", "inverse rotation",
          "inverse rotation", "translation vector")  # fmt: skip
_WIDTHS = {"image size": 2, "camera matrix": 3, "rotation matrix": 3, "translation vector": 3}


@dataclass(frozen=True)
class _Pinhole:
    """One file. matrix (3, 3) = K R, shift (3,) = K t; pixel = (matrix X + shift), homogeneous."""

    path: Path
    image_size_px: tuple[int, int]
    camera_matrix: Array
    rotation: Array
    translation_mm: Array
    distortion: Array

    @property
    def mirrored(self) -> bool:
        return bool(np.linalg.det(self.camera_matrix @ self.rotation) < 0)


def read_openlpt_cameras(
    paths: Sequence[str | PathLike[str]], names: Sequence[str] | None = None
) -> tuple[tuple[Camera, ...], Pose]:
    """Cameras of OpenLPT text files, and `rig_from_world` for points in OpenLPT's world.

    The rig frame is the first camera's, its origin where the first two optical axes come closest
    (for one camera: at the depth of the world's origin). names : default the files' stems.
    `rig_from_world.rotation` has determinant -1 where the files' world is mirrored.

    Raises InputError for files that cannot be read or are of another camera model, for distortion
    that this library's model cannot express exactly, and for cameras of unequal handedness.
    """
    files = [_read(Path(p)) for p in paths]
    if not files:
        raise InputError("no camera files", todo="name at least one, such as cam1.txt")
    labels = [f.path.stem for f in files] if names is None else list(names)
    if len(labels) != len(files) or len(set(labels)) != len(labels):
        raise InputError(
            f"{len(files)} camera files with the names {labels}",
            todo="give one name for each file, no two alike",
        )
    mirror = np.diag([1.0, 1.0, -1.0 if files[0].mirrored else 1.0])
    for file in files:
        if file.mirrored != files[0].mirrored:
            raise InputError(
                f"its image is mirrored against that of {files[0].path.name}",
                where=str(file.path),
                todo="flip one camera's images and calibrate again",
            )
    split = [_split(f, mirror) for f in files]
    distances = _working_distances([pose for _, pose in split])
    poses = [
        Pose(pose.rotation, pose.translation_mm - np.array([0, 0, distance]))
        for (_, pose), distance in zip(split, distances)
    ]
    rig_from_world = Pose(poses[0].rotation @ mirror, poses[0].translation_mm)
    world_from_rig = poses[0].inverse()
    cameras = [
        _camera(name, file, matrix, distance, pose @ world_from_rig if i else Pose.identity())
        for i, (name, file, (matrix, _), distance, pose) in enumerate(
            zip(labels, files, split, distances, poses)
        )
    ]
    return tuple(cameras), rig_from_world


def _read(path: Path) -> _Pinhole:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read ({error})", where=str(path), todo="check it") from error
    numbered = [(i, line.strip()) for i, line in enumerate(text.splitlines(), 1)]
    lines = [(i, line) for i, line in numbered if line and not line.startswith("#")]
    if not lines or lines[0][1] != "PINHOLE":
        kind = lines[0][1] if lines else "nothing"
        raise InputError(
            f"holds {kind[:40]!r} where 'PINHOLE' should stand",
            where=str(path),
            todo="only OpenLPT's pinhole cameras can be imported; calibrate others with telerig",
        )
    if len(lines) <= len(_LINES):
        raise InputError(
            f"ends after {len(lines)} lines of values; the next would be the "
            f"{_LINES[len(lines) - 1]}",
            where=str(path),
            todo="export it again with OpenLPT 2 (with the image's size)",
        )
    found: dict[str, list[Array]] = {}
    for what, (row, line) in zip(_LINES, lines[1:]):
        if what in _WIDTHS or what == "distortion coefficients":
            found.setdefault(what, []).append(_numbers(line, what, f"{path}:{row}"))
    rows, columns = (int(v) for v in found["image size"][0])
    return _checked(
        _Pinhole(
            path,
            (columns, rows),
            np.array(found["camera matrix"]),
            np.array(found["rotation matrix"]),
            found["translation vector"][0],
            found["distortion coefficients"][0],
        )
    )


def _numbers(line: str, what: str, where: str) -> Array:
    try:
        values = np.array([float(word) for word in line.split(",")])
    except ValueError:
        values = np.array([np.nan])
    if not np.isfinite(values).all() or len(values) != _WIDTHS.get(what, len(values)):
        raise InputError(
            f"{line[:60]!r} is not the {what}: {_WIDTHS.get(what, 'some')} numbers, commas between",
            where=where,
            todo="export the camera again",
        )
    return values


def _checked(file: _Pinhole) -> _Pinhole:
    k, r = file.camera_matrix, file.rotation
    where = str(file.path)
    if min(file.image_size_px) < 1:
        raise InputError(f"image size {file.image_size_px}", where=where, todo="it must be > 0")
    if not np.array_equal(k[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]) or not k[0, 0] > 0:
        raise InputError("the camera matrix is not [f 0 c; 0 f c; 0 0 1], f > 0 first", where=where)
    deviation = float(np.abs(r @ r.T - np.eye(3)).max())
    if deviation > 0.05 or np.linalg.det(r) < 0 or k[1, 1] == 0:
        raise InputError(
            f"the rotation matrix is none (R R' is {deviation:.2g} from the unit matrix, "
            f"det {np.linalg.det(r):.3f})",
            where=where,
            todo="export the camera again",
        )
    if not np.any(file.distortion):
        return file
    if len(file.distortion) > 5 and np.any(file.distortion[5:]):
        raise InputError(
            "distortion coefficients beyond k1 k2 p1 p2 k3 have no exact counterpart here",
            where=where,
            todo="calibrate with these five, or with telerig",
        )
    if deviation > _SHEAR_BESIDE_DISTORTION:
        raise InputError(
            f"distortion and a rotation matrix with shear ({deviation:.2g}) have no exact "
            "counterpart together",
            where=where,
            todo="export the camera again, with an orthonormal rotation matrix",
        )
    return file


def _split(file: _Pinhole, mirror: Array) -> tuple[Array, Pose]:
    """(3, 3) upper triangular map with positive diagonal, and camera_from_world (unmirrored)."""
    rotation = nearest_rotation(file.rotation) if np.any(file.distortion) else file.rotation
    total = file.camera_matrix @ rotation @ mirror
    flip = np.eye(3)[::-1]
    q, r = np.linalg.qr((flip @ total).T)
    upper, proper = flip @ r.T @ flip, flip @ q.T
    signs = np.sign(np.diag(upper))
    upper, proper = upper * signs, signs[:, None] * proper
    translation = np.linalg.solve(upper, file.camera_matrix @ file.translation_mm)
    return upper, Pose(proper, translation)


def _working_distances(camera_from_world: list[Pose]) -> list[float]:
    """Depth of each camera's plane Z = 0: where its axis is closest to the first's (second's)."""
    back = [p.inverse() for p in camera_from_world]
    out = [float(p.translation_mm[2]) for p in camera_from_world]
    for i in range(len(back) if len(back) > 1 else 0):
        mine, other = back[i], back[1 if i == 0 else 0]
        a, b = mine.rotation[:, 2], other.rotation[:, 2]
        cross = np.cross(a, b)
        if cross @ cross > 1e-4:
            between = other.translation_mm - mine.translation_mm
            out[i] = float(np.cross(between, b) @ cross / (cross @ cross))
    return out


def _camera(name: str, file: _Pinhole, upper: Array, distance_mm: float, pose: Pose) -> Camera:
    if not distance_mm > 0:
        raise InputError(
            f"its subject lies {distance_mm:.1f} mm behind the camera",
            where=str(file.path),
            todo="check the translation vector's sign",
        )
    upper = upper / upper[2, 2]
    scale = upper[0, 0] / distance_mm
    width, height = file.image_size_px
    rho = float(np.hypot(width, height) / 2 / scale)
    ratio = rho / distance_mm
    k1, k2, p1, p2, k3 = np.concatenate([file.distortion, np.zeros(5)])[:5]
    turn = -1.0 if file.camera_matrix[1, 1] < 0 else 1.0
    return Camera.create(
        name,
        file.image_size_px,
        scale,
        camera_from_rig=pose,
        rho_mm=rho,
        aspect=upper[1, 1] / upper[0, 0],
        skew=upper[0, 1] / upper[0, 0],
        centre_u_px=upper[0, 2],
        centre_v_px=upper[1, 2],
        kappa_per_mm=1 / distance_mm,
        k1=k1 * ratio**2,
        k2=k2 * ratio**4,
        k3=k3 * ratio**6,
        p1=turn * p1 * ratio,
        p2=p2 * ratio,
    )
