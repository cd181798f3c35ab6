"""Pinhole cameras of other programs as cameras of this library, exactly.

A pinhole camera is the model of `telerig.rig.projection` with kappa = 1 / working distance. R of
other programs is often not orthonormal (rounded digits, or a fit of nine numbers). So K R is
decomposed anew into an upper triangular map and a rotation (RQ decomposition): shear of R becomes
skew and aspect of the camera, and every pixel stays the one that the other program computes.

Where images are left-handed with respect to the world (fy < 0 with a proper R), the *world* is
mirrored, because the images were recorded: `rig_from_world` is then a rotation with a reflection
(determinant -1), and the cameras are ordinary ones, x right, y down, z away.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.rig_file.camera_names import check_camera_names
from telerig.io.rig_file.description import rotvec_key
from telerig.io.rig_file.writer import toml_key
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, nearest_rotation
from telerig.short_text import counted

_LEAST_SCALE = 1e-12
_SHEAR_BESIDE_DISTORTION = 1e-5
_RATIONAL, _TILT = slice(5, 8), slice(12, 14)


@dataclass(frozen=True)
class Pinhole:
    """One pinhole camera: pixel = camera_matrix (rotation X + translation_mm), homogeneous.

    X is a point in mm in the world of the program that made the file.

    where : the file, for errors.
    camera_matrix, rotation : (3, 3).
    translation_mm : (3,).
    distortion : up to 14 coefficients in OpenCV's order.
    """

    where: str
    image_size_px: tuple[int, int]
    camera_matrix: Array
    rotation: Array
    translation_mm: Array
    distortion: Array

    @property
    def mirrored(self) -> bool:
        """Whether the image is left-handed with respect to the world."""
        return bool(np.linalg.det(self.camera_matrix @ self.rotation) < 0)

    def error(self, what: str, todo: str) -> InputError:
        """Return the error of this camera's file."""
        return InputError(what, where=self.where, todo=todo)


class ImportedCameras(NamedTuple):
    """Cameras that were imported from another program.

    rig_from_world : pose for points in the other program's world; its rotation has the determinant
        -1 if that world is mirrored.
    notes : sentences for the user on what is not exact.
    """

    cameras: tuple[Camera, ...]
    rig_from_world: Pose
    notes: tuple[str, ...] = ()


def cameras_from_pinholes(pinholes: Sequence[Pinhole], names: Sequence[str]) -> ImportedCameras:
    """Return cameras of telerig that give the same pixels as pinhole cameras.

    The rig frame is that of the first camera; its origin is where the first two optical axes come
    closest (for one camera: at the depth of the world's origin).

    names : of the cameras, as rig.toml allows them.
    Raises InputError if the number of names differs, for names that rig.toml cannot have, if some
    cameras are mirrored, for a matrix that is not that of a pinhole camera, and for distortion that
    telerig's model cannot express exactly.
    """
    if len(names) != len(pinholes):
        raise InputError(
            f"the files hold {counted(len(pinholes), 'camera')}, but the names are {list(names)}",
            todo=f"give {len(pinholes)} names, one for each camera",
        )
    check_camera_names(names, "names of the cameras", "--names")
    mirror = np.diag([1.0, 1.0, -1.0 if pinholes[0].mirrored else 1.0])
    for one in pinholes:
        _check(one)
        if one.mirrored != pinholes[0].mirrored:
            raise one.error(
                f"its image is mirrored with respect to that of {pinholes[0].where}",
                "flip one camera's images and calibrate again",
            )
    split = [_split(one, mirror) for one in pinholes]
    distances = _working_distances([pose for _, pose in split])
    poses = [
        Pose(pose.rotation, pose.translation_mm - np.array([0, 0, distance]))
        for (_, pose), distance in zip(split, distances)
    ]
    rig_from_world = Pose(poses[0].rotation @ mirror, poses[0].translation_mm)
    world_from_rig = poses[0].inverse()
    cameras = [
        _camera(name, one, matrix, distance, pose @ world_from_rig if i else Pose.identity())
        for i, (name, one, (matrix, _), distance, pose) in enumerate(
            zip(names, pinholes, split, distances, poses)
        )
    ]
    return ImportedCameras(tuple(cameras), rig_from_world)


def _check(one: Pinhole) -> None:
    k, r = one.camera_matrix, one.rotation
    if min(one.image_size_px) < 1:
        raise one.error(f"image size {one.image_size_px}", "give a size > 0")
    if not np.array_equal(k[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]) or not k[0, 0] > 0:
        raise one.error(
            "the camera matrix is not [fx 0 cx; 0 fy cy; 0 0 1] with fx > 0",
            "export the camera again",
        )
    focal = np.abs(np.diag(k)[:2])
    if not focal.min() > _LEAST_SCALE * focal.max():
        raise one.error(
            f"the camera matrix, with fx {k[0, 0]:g} and fy {k[1, 1]:g}, cannot be inverted",
            "export the camera again",
        )
    deviation = float(np.abs(r @ r.T - np.eye(3)).max())
    if deviation > 0.05 or np.linalg.det(r) < 0:
        raise one.error(
            f"the rotation matrix R is not a rotation (R R^T differs by {deviation:.2g} from the "
            f"unit matrix, det R = {np.linalg.det(r):.3f})",
            "export the camera again",
        )
    if np.any(one.distortion[_RATIONAL]) or np.any(one.distortion[_TILT]):
        raise one.error(
            "distortion coefficients k4 k5 k6 and tau have no exact counterpart here",
            "calibrate with k1 k2 p1 p2 k3 (and s1 to s4), or with telerig",
        )
    if np.any(one.distortion) and deviation > _SHEAR_BESIDE_DISTORTION:
        raise one.error(
            f"a camera with distortion whose rotation matrix has shear ({deviation:.2g}) has no "
            "exact counterpart here",
            "export the camera again, with an orthonormal rotation matrix",
        )


def _split(one: Pinhole, mirror: Array) -> tuple[Array, Pose]:
    """Return an upper triangular map (3, 3) with positive diagonal, and camera_from_world."""
    from scipy.linalg import rq

    rotation = nearest_rotation(one.rotation) if np.any(one.distortion) else one.rotation
    upper, proper = rq(one.camera_matrix @ rotation @ mirror)
    signs = np.sign(np.diag(upper))
    upper, proper = upper * signs, signs[:, None] * proper
    translation = np.linalg.solve(upper, one.camera_matrix @ one.translation_mm)
    return upper, Pose(proper, translation)


def _working_distances(camera_from_world: list[Pose]) -> list[float]:
    """Return each camera's distance to Z = 0, where its axis is closest to another camera's."""
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


def _camera(name: str, one: Pinhole, upper: Array, distance_mm: float, pose: Pose) -> Camera:
    if not distance_mm > 0:
        raise one.error(
            f"the point that it looks at lies {-distance_mm:.1f} mm behind the camera",
            "check the translation vector's sign",
        )
    upper = upper / upper[2, 2]
    scale = upper[0, 0] / distance_mm
    width, height = one.image_size_px
    rho = float(np.hypot(width, height) / 2 / scale)
    ratio = rho / distance_mm
    k1, k2, p1, p2, k3, *_, s1, s2, s3, s4 = np.concatenate([one.distortion, np.zeros(12)])[:12]
    turn = -1.0 if one.camera_matrix[1, 1] < 0 else 1.0
    return Camera.create(
        name,
        one.image_size_px,
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
        s1=s1 * ratio,
        s2=s2 * ratio**3,
        s3=turn * s3 * ratio,
        s4=turn * s4 * ratio**3,
    )


def nominal_toml(cameras: Sequence[Camera]) -> str:
    """Return the tables [cameras.*] and [stereo] of rig.toml, for a calibration to start from.

    cameras : at most as many as rig.toml describes, with names that it allows.
    """
    lines = []
    for camera in cameras:
        width, height = camera.image_size_px
        lines += [
            f"[cameras.{toml_key(camera.name)}]",
            f"image_size_px = [{width}, {height}]",
            f"scale_px_per_mm = {camera['scale_px_per_mm']:.9g}",
            f"telecentricity_per_mm = {camera['kappa_per_mm']:.9g}",
        ]
    lines += ["[stereo]"] if len(cameras) > 1 else []
    for camera in cameras[1:]:
        rotvec_deg = np.degrees(camera.camera_from_rig.rotvec_rad)
        numbers = ", ".join(f"{value:.6f}" for value in rotvec_deg)
        lines.append(f"{toml_key(rotvec_key(camera.name, cameras[0].name))} = [{numbers}]")
    return "\n".join(lines) + "\n"
