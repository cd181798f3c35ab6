"""The two rays of a pair miss each other along the common perpendicular n of both lines of sight.

If the second camera has moved by v and rotated by w, the ray miss at a rig point p is
n . (v + w x p), a constant plus a slope along both lines of sight. Ray misses therefore identify
three of the six components of the pose between two telecentric cameras: the shift along n, and the
two rotations about axes perpendicular to n (roll about the second camera's own axis, and pitch).
The others move the triangulated point but cause no ray miss.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array
from telerig.errors import CalibrationError
from telerig.rig.camera import Camera
from telerig.rig.triangulation import LEAST_SINE, midpoint, rig_jacobian, stacked_jacobian

Free = tuple[tuple[str, ...], ...]
Pair = tuple[Camera, Camera]


def common_perpendicular(cameras: Pair) -> tuple[Array, Array]:
    """Return the common perpendicular of the two lines of sight.

    Returns its unit vector n (3,), in the direction of first x second line of sight, and the point
    (3,) in mm midway between the two lines where they come closest, both in the rig frame. Raises
    CalibrationError for cameras that look along one line.
    """
    rays = [c.unproject((np.array(c.image_size_px, float)[None] - 1) / 2) for c in cameras]
    cross = np.cross(rays[0][1], rays[1][1])[0]
    sine = float(np.linalg.norm(cross))
    if sine < LEAST_SINE:
        raise CalibrationError(
            "both cameras have the same line of sight",
            todo="a movement can be found only between cameras with different lines of sight",
        )
    middle, _ = midpoint(*rays[0], *rays[1])
    return cross / sine, middle[0]


@dataclass(frozen=True)
class RayMisses:
    """M ray misses along the common perpendicular.

    miss_mm : (M,).
    variance_mm2 : (M,) variances due to the pixels' noise.
    by_rig : (M, P) derivatives with respect to the P parameters of the rig, see `rig_jacobian`.
    by_pixel : (M, 2, 2) derivatives with respect to the pixels (u, v) in both cameras.
    """

    miss_mm: Array
    variance_mm2: Array
    by_rig: Array
    by_pixel: Array


def ray_misses(
    cameras: Pair,
    free: Free,
    points_mm: Array,
    uv_px: Array | None = None,
    covariance_px2: Array | None = None,
) -> RayMisses:
    """Return the ray misses of M pairs of pixels.

    free : for each camera the names of its free intrinsics.
    points_mm : (M, 3) points in the rig frame near the pairs, at which the cameras are linearised.
    uv_px : (M, 2, 2) the pixels (u, v) of each pair in both cameras; None sets the misses to 0.
    covariance_px2 : (M, 2, 2, 2) of these pixels; None sets the variances to 0.

    The left null vector of the projection's Jacobian combines a pair's four pixel coordinates such
    that the position of the point has no effect. It is scaled such that the ray miss equals the
    shift of the second camera along the common perpendicular.
    """
    n, _ = common_perpendicular(cameras)
    predicted, by_point = stacked_jacobian(cameras, points_mm)
    null = np.linalg.svd(by_point)[0][..., :, 3]
    scale = -np.einsum("mi,mij,j->m", null[:, 2:], by_point[:, 2:], n)
    null = null / scale[:, None]
    by_rig = np.einsum("mi,mip->mp", null, rig_jacobian(cameras, free, points_mm))
    miss, variance = np.zeros(len(points_mm)), np.zeros(len(points_mm))
    if uv_px is not None:
        miss = np.einsum("mi,mi->m", null, uv_px.reshape(-1, 4) - predicted)
    by_pixel = null.reshape(-1, 2, 2)
    if covariance_px2 is not None:
        variance = np.einsum("mci,mcij,mcj->m", by_pixel, covariance_px2, by_pixel)
    return RayMisses(miss, variance, by_rig, by_pixel)


def offset_roll_pitch(cameras: Pair, place_mm: Array) -> Array:
    """Return the matrix (3, 6) that gives offset (mm), roll and pitch (rad) of a movement.

    It is applied to the movement's tangent (6,) of the second camera's pose rig_from_camera.
    place_mm : (3,) point in the rig frame to which the offset refers.
    """
    n, _ = common_perpendicular(cameras)
    pose = cameras[1].camera_from_rig
    across = pose.rotation @ n
    at = pose.apply(place_mm[None])[0]
    pitch = np.cross([0.0, 0.0, 1.0], across)
    offset = np.concatenate([np.cross(at, across), across])
    roll = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    return np.stack([offset, roll, np.concatenate([pitch / np.linalg.norm(pitch), np.zeros(3)])])
