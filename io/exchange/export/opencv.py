"""Cameras as OpenCV's 3 x 4 projection matrices in a YAML file that cv2.FileStorage reads.

An undistorted camera of this library is exactly a 3 x 4 matrix, which is affine (last row 0 0 0 1)
if the lens is telecentric. The distortion is written separately, in OpenCV's own coefficients, so
that cv2.undistortPoints followed by cv2.triangulatePoints gives the same points as telerig.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.io.exchange.export.volume import (
    Misfit,
    Volume,
    refuse_unknown_parameters,
    seen_points,
    working_volume,
)
from telerig.io.files.atomic import write_text_atomic
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import COEFFICIENTS
from telerig.rig.projection import turned_wall
from telerig.rig.windows import ideal_jacobians

_OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "", "", "", "s1", "s2", "s3", "s4")
_POINTS_PER_EDGE = 25


@dataclass(frozen=True)
class Matrices:
    """Hold the matrices of one camera, which map (x, y, z, 1) in mm in the rig frame to pixels.

    undistorted : (3, 4) matrix of the camera without distortion
    undistorted_misfit : the effect of the distortion that is left out.
    affine : (3, 4) matrix with last row 0 0 0 1 that fits best
    affine_misfit : its error.
    camera_matrix, distortion : (3, 3), (12,) arguments of cv2.undistortPoints, with P =
        camera_matrix; None if OpenCV's model cannot express this camera's skew or sensor tilt.
    """

    camera: str
    image_size_px: tuple[int, int]
    undistorted: Array
    undistorted_misfit: Misfit
    affine: Array
    affine_misfit: Misfit
    camera_matrix: Array | None
    distortion: Array | None


def export_opencv(
    cameras: Sequence[Camera], out: Path, volume: Volume, *, remarks: Sequence[str] = ()
) -> list[str]:
    """Write the matrices of all cameras into the YAML file ``out``.

    Returns one line of text per camera. Raises InputError as `camera_matrices` does.
    """
    matrices = camera_matrices(cameras, volume)
    write_opencv(matrices, out, remarks)
    return [
        f"{m.camera}: affine matrix, {m.affine_misfit.words()}; "
        f"matrix without the distortion, {m.undistorted_misfit.words()}"
        for m in matrices
    ]


def undistorted_matrix(camera: Camera) -> Array:
    """Return the projection matrix (3, 4), mm to px, of the camera without its distortion.

    Behind a refractive window it is exact for kappa = 0 only.
    """
    q = np.array([camera["tilt_x"], camera["tilt_y"]])
    tilt = np.eye(3)
    tilt[:2, :2] += np.outer(q, q) / (1 + np.sqrt(1 + q @ q))
    tilt[2, :2] = -camera["image_convergence_per_mm"] * q
    scale = camera["scale_px_per_mm"]
    pixel = _pixel_matrix(camera, scale)
    pixel[0, 1] = scale * camera["skew"]
    pose = camera.camera_from_rig
    placed = np.vstack([np.c_[pose.rotation, pose.translation_mm], [0, 0, 0, 1]])
    return np.asarray(pixel @ tilt @ _telecentric_matrix(camera) @ placed)


def _pixel_matrix(camera: Camera, scale: float) -> Array:
    """Return (3, 3) scale, aspect and image centre, without skew."""
    return np.array(
        [
            [scale, 0, camera["centre_u_px"]],
            [0, scale * camera["aspect"], camera["centre_v_px"]],
            [0, 0, 1],
        ]
    )


def _telecentric_matrix(camera: Camera) -> Array:
    """Return (3, 4) telecentric coordinates of a camera point.

    Behind a refractive window it is linearised about the ray through the origin; the rays then
    diverge n_air / n_water times as fast.
    """
    kappa, out = camera["kappa_per_mm"], np.eye(3, 4)
    out[2] = [0, 0, kappa, 1]
    if camera.wall is not None:
        wall = turned_wall(camera.intrinsics, camera.wall)
        seen = ideal_jacobians(np.zeros(3), kappa, wall)
        spread = kappa * wall.ratios[1] * np.sqrt(np.linalg.det(seen.by_point[:, :2]))
        out[2, 2] = spread
        out[:2] = np.c_[seen.by_point + np.outer(seen.value, [0, 0, spread]), seen.value]
    return out


def projected(matrix: Array, points_mm: Array) -> Array:
    """Project points (..., 3) in mm to pixels (..., 2) in px by a projection matrix (3, 4)."""
    image = points_mm @ matrix[:, :3].T + matrix[:, 3]
    return np.asarray(image[..., :2] / image[..., 2:])


def camera_matrices(
    cameras: Sequence[Camera], volume: Volume | None = None
) -> tuple[Matrices, ...]:
    """Compute each camera's (3, 4) projection matrices and its arguments for OpenCV.

    volume : box in the rig frame. The misfits in px between matrices and cameras are computed over
        the part of it that all cameras see. None takes `working_volume`.

    Raises InputError if the cameras do not see the volume, or if a camera has a lens parameter that
    OpenCV's model lacks.
    """
    refuse_unknown_parameters(cameras, "OpenCV")
    points = seen_points(cameras, volume or working_volume(cameras), _POINTS_PER_EDGE)
    return tuple(_matrices(camera, points) for camera in cameras)


def _matrices(camera: Camera, points: Array) -> Matrices:
    seen, exact = camera.project(points), undistorted_matrix(camera)
    distorted = any(camera[name] != 0 for name in COEFFICIENTS)
    if np.array_equal(exact[2], [0, 0, 0, 1]) and not distorted:
        affine = exact
    else:
        design = np.c_[points, np.ones(len(points))]
        affine = np.vstack([np.linalg.lstsq(design, seen, rcond=None)[0].T, [0, 0, 0, 1]])
    matrix, distortion = _opencv_distortion(camera)
    return Matrices(
        camera.name,
        camera.image_size_px,
        exact,
        Misfit.between(projected(exact, points), seen),
        affine,
        Misfit.between(projected(affine, points), seen),
        matrix,
        distortion,
    )


def _opencv_distortion(camera: Camera) -> tuple[Array | None, Array | None]:
    if any(camera[name] != 0 for name in ("skew", "tilt_x", "tilt_y")):
        return None, None
    matrix = _pixel_matrix(camera, camera["scale_px_per_mm"] * camera.rho_mm)
    return matrix, np.array([camera[name] if name else 0.0 for name in _OPENCV_ORDER])


def write_opencv(
    matrices: Sequence[Matrices], path: str | PathLike[str], remarks: Sequence[str] = ()
) -> None:
    """Write one YAML file for OpenCV with an entry for each camera; floats keep every digit."""
    import cv2

    # in memory, because OpenCV does not say when it cannot write a file
    mode = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_FORMAT_YAML | cv2.FILE_STORAGE_MEMORY
    storage: Any = cv2.FileStorage("", mode)
    storage.write("frame", "rig: the first camera's frame, mm")
    storage.write("pixel_origin", "centre of the top-left pixel is (0, 0)")
    if remarks:
        storage.write("remarks", " ".join(remarks))
    storage.startWriteStruct("cameras", cv2.FILE_NODE_SEQ)
    for one in matrices:
        storage.startWriteStruct("", cv2.FILE_NODE_MAP)
        content: dict[str, Any] = {
            "name": one.camera,
            "image_width": one.image_size_px[0],
            "image_height": one.image_size_px[1],
            "undistorted": one.undistorted,
            "undistorted_rms_px": one.undistorted_misfit.rms_px,
            "undistorted_max_px": one.undistorted_misfit.max_px,
            "affine": one.affine,
            "affine_rms_px": one.affine_misfit.rms_px,
            "affine_max_px": one.affine_misfit.max_px,
        }
        if one.camera_matrix is not None and one.distortion is not None:
            content["camera_matrix"] = one.camera_matrix
            content["distortion_coefficients"] = one.distortion.reshape(1, -1)
        for name, value in content.items():
            storage.write(name, value)
        storage.endWriteStruct()
    storage.endWriteStruct()
    write_text_atomic(Path(path), storage.releaseAndGetString())
