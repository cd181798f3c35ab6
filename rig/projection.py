"""The camera model as pure functions: from camera coordinates to pixels, and its derivatives.

Steps (all about one centre): residual perspective kappa, distortion, sensor tilt, affine map.
Sensor tilt after Steger (IJCV 123:121, 2017), in one formula for both kinds of lens. With q the
tangent vector of the tilt and w = 1 / image distance (object-space mm):

    y = S(q) x / (1 - w q.x),    S(q) = I + q q^T / (1 + sqrt(1 + q.q))

w = 0 is the bilateral telecentric lens (an affine stretch, even in q: the sign of the tilt is
unobservable); w > 0 the object-side telecentric one (a homography).

For points behind a window the first step is `telerig.rig.windows`; wall_x_rad and wall_y_rad turn
the window's stated normal (`Wall.turned`) and have no effect without a window.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from telerig.rig import distortion, windows
from telerig.rig.windows import Wall

Array = NDArray[np.float64]

PARAMETERS = (
    "scale_px_per_mm", "aspect", "skew", "centre_u_px", "centre_v_px", "kappa_per_mm",
    "k1", "k2", "k3", "p1", "p2", "s1", "s2", "s3", "s4",
    "tilt_x", "tilt_y", "image_convergence_per_mm", "wall_x_rad", "wall_y_rad",
)  # fmt: skip
INDEX = {name: i for i, name in enumerate(PARAMETERS)}
_SCALE, _ASPECT, _SKEW, _CU, _CV, _KAPPA = range(6)
_DISTORTION = slice(6, 15)
_TX, _TY, _W = 15, 16, 17
_WALL = slice(18, 20)


def intrinsics_from(parameters: Mapping[str, float]) -> Array:
    """(20,) in the order of `PARAMETERS`; wall_x_rad and wall_y_rad are 0 where they are missing.

    Raises KeyError for any other parameter that is missing.
    """
    wall = dict.fromkeys(PARAMETERS[_WALL], 0.0)
    return np.array([(wall | dict(parameters))[name] for name in PARAMETERS], float)


def standing_wall(intrinsics: Array, wall: Wall) -> Wall:
    """The window with its normal turned by wall_x_rad and wall_y_rad of the intrinsics."""
    return wall.turned(intrinsics[_WALL])


def pixel_from_camera(
    points_mm: Array, intrinsics: Array, rho_mm: float, wall: Wall | None = None
) -> Array:
    """(..., 3) camera coordinates -> (..., 2) pixels; intrinsics (20,) ordered as `PARAMETERS`.

    wall : the points are in the water behind it; raises what `windows.ideal_from_water` raises.
    """
    if wall is None:
        telecentric = points_mm[..., :2] / (1 + intrinsics[_KAPPA] * points_mm[..., 2:3])
    else:
        turned = standing_wall(intrinsics, wall)
        telecentric = windows.ideal_from_water(points_mm, float(intrinsics[_KAPPA]), turned)
    distorted = distortion.distort(telecentric / rho_mm, intrinsics[_DISTORTION]) * rho_mm
    return _pixel_from_sensor(sensor_from_distorted(distorted, intrinsics), intrinsics)


def ideal_from_pixel(uv_px: Array, intrinsics: Array, rho_mm: float) -> Array:
    """(..., 2) pixels -> (..., 2) telecentric coordinates (mm) at depth 0: the ray's origin."""
    v = (uv_px[..., 1] - intrinsics[_CV]) / (intrinsics[_SCALE] * intrinsics[_ASPECT])
    u = (uv_px[..., 0] - intrinsics[_CU]) / intrinsics[_SCALE] - intrinsics[_SKEW] * v
    distorted = distorted_from_sensor(np.stack([u, v], -1), intrinsics)
    return distortion.undistort(distorted / rho_mm, intrinsics[_DISTORTION]) * rho_mm


def sensor_from_distorted(xy_mm: Array, intrinsics: Array) -> Array:
    """(..., 2) -> (..., 2): the tilted sensor plane."""
    q = intrinsics[_TX : _TY + 1]
    qx = xy_mm @ q
    stretched = xy_mm + (qx / (1 + np.sqrt(1 + q @ q)))[..., None] * q
    return np.asarray(stretched / (1 - intrinsics[_W] * qx)[..., None])


def distorted_from_sensor(xy_mm: Array, intrinsics: Array) -> Array:
    """(..., 2) -> (..., 2): inverse of `sensor_from_distorted`, in closed form."""
    q = intrinsics[_TX : _TY + 1]
    root = np.sqrt(1 + q @ q)
    unstretched = xy_mm - ((xy_mm @ q) / (root * (1 + root)))[..., None] * q
    return np.asarray(unstretched / (1 + intrinsics[_W] * (unstretched @ q))[..., None])


def _pixel_from_sensor(xy_mm: Array, intrinsics: Array) -> Array:
    scale = intrinsics[_SCALE]
    u = scale * (xy_mm[..., 0] + intrinsics[_SKEW] * xy_mm[..., 1]) + intrinsics[_CU]
    v = scale * intrinsics[_ASPECT] * xy_mm[..., 1] + intrinsics[_CV]
    return np.stack([u, v], -1)


def pixel_jacobians(
    points_mm: Array, intrinsics: Array, rho_mm: float, wall: Wall | None = None
) -> tuple[Array, Array, Array]:
    """Pixels with their derivatives.

    Returns (..., 2) pixels, (..., 2, 3) with respect to the camera point and (..., 2, 20) with
    respect to the intrinsics. wall : as in `pixel_from_camera`.
    """
    if wall is not None:
        return _behind_wall(points_mm, intrinsics, rho_mm, wall)
    kappa = intrinsics[_KAPPA]
    inverse_depth = 1 / (1 + kappa * points_mm[..., 2])
    ideal = points_mm[..., :2] * inverse_depth[..., None]
    uv, by_ideal, by_intrinsics = _lens_jacobians(ideal, intrinsics, rho_mm)
    by_point = np.empty((*ideal.shape, 3))
    by_point[..., :2] = by_ideal * inverse_depth[..., None, None]
    towards_axis = np.einsum("...ij,...j->...i", by_ideal, ideal) * inverse_depth[..., None]
    by_point[..., 2] = -kappa * towards_axis
    by_intrinsics[..., _KAPPA] = -towards_axis * points_mm[..., 2:3]
    return uv, by_point, by_intrinsics


def _behind_wall(
    points_mm: Array, intrinsics: Array, rho_mm: float, wall: Wall
) -> tuple[Array, Array, Array]:
    turned = standing_wall(intrinsics, wall)
    seen = windows.ideal_jacobians(points_mm, float(intrinsics[_KAPPA]), turned)
    uv, by_ideal, by_intrinsics = _lens_jacobians(seen.value, intrinsics, rho_mm)
    by_intrinsics[..., _KAPPA] = np.einsum("...ij,...j->...i", by_ideal, seen.by_kappa)
    by_turn = seen.by_wall[..., :2] @ wall.turn_jacobian(intrinsics[_WALL])
    by_intrinsics[..., _WALL] = by_ideal @ by_turn
    return uv, by_ideal @ seen.by_point, by_intrinsics


def _lens_jacobians(ideal: Array, intrinsics: Array, rho_mm: float) -> tuple[Array, Array, Array]:
    """Pixels, (..., 2, 2) by telecentric coordinates, (..., 2, 20) by all but kappa and wall."""
    normal = ideal / rho_mm
    coefficients = intrinsics[_DISTORTION]
    distorted = distortion.distort(normal, coefficients) * rho_mm
    sensor, sensor_jac, tilt_jac = tilt_jacobians(distorted, intrinsics)
    affine = intrinsics[_SCALE] * np.array([[1, intrinsics[_SKEW]], [0, intrinsics[_ASPECT]]])
    pixel_from_distorted = affine @ sensor_jac
    by_ideal = pixel_from_distorted @ distortion.distortion_jacobian(normal, coefficients)

    by_intrinsics = np.zeros((*ideal.shape, len(PARAMETERS)))
    by_intrinsics[..., 0, _SCALE] = sensor[..., 0] + intrinsics[_SKEW] * sensor[..., 1]
    by_intrinsics[..., 1, _SCALE] = intrinsics[_ASPECT] * sensor[..., 1]
    by_intrinsics[..., 1, _ASPECT] = intrinsics[_SCALE] * sensor[..., 1]
    by_intrinsics[..., 0, _SKEW] = intrinsics[_SCALE] * sensor[..., 1]
    by_intrinsics[..., 0, _CU] = by_intrinsics[..., 1, _CV] = 1
    by_coefficients = distortion.coefficient_jacobian(normal) * rho_mm
    by_intrinsics[..., _DISTORTION] = pixel_from_distorted @ by_coefficients
    by_intrinsics[..., _TX : _W + 1] = affine @ tilt_jac
    return _pixel_from_sensor(sensor, intrinsics), by_ideal, by_intrinsics


def tilt_jacobians(xy_mm: Array, intrinsics: Array) -> tuple[Array, Array, Array]:
    """Sensor coordinates, (..., 2, 2) by the coordinates, (..., 2, 3) by tilt_x, tilt_y, w."""
    q, w = intrinsics[_TX : _TY + 1], intrinsics[_W]
    root = np.sqrt(1 + q @ q)
    f = 1 / (1 + root)
    qx = xy_mm @ q
    denominator = 1 - w * qx
    stretch = np.eye(2) + f * np.outer(q, q)
    stretched = xy_mm @ stretch
    sensor = stretched / denominator[..., None]
    by_xy = (stretch + sensor[..., :, None] * (w * q)) / denominator[..., None, None]
    by_tilt = np.empty((*xy_mm.shape, 3))
    f_slope = -f * f / root
    by_q = f * (qx[..., None, None] * np.eye(2) + q[:, None] * xy_mm[..., None, :])
    by_q = by_q + f_slope * qx[..., None, None] * np.outer(q, q)
    by_q = by_q + w * sensor[..., :, None] * xy_mm[..., None, :]
    by_tilt[..., :2] = by_q / denominator[..., None, None]
    by_tilt[..., 2] = sensor * (qx / denominator)[..., None]
    return sensor, by_xy, by_tilt
