"""The camera model as pure functions: from camera coordinates to pixels, and its derivatives.

Steps (all about one centre): residual perspective kappa, distortion, sensor tilt, affine map.
Sensor tilt after Steger (IJCV 123:121, 2017), in one formula for both kinds of lens. With q the
tangent vector of the tilt and w = 1 / image distance (object-space mm):

    y = S(q) x / (1 - w q.x),    S(q) = I + q q^T / (1 + sqrt(1 + q.q))

w = 0 is the bilateral telecentric lens (an affine stretch, even in q: the sign of the tilt is
unobservable); w > 0 the object-side telecentric one (a homography).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.rig import distortion

Array = NDArray[np.float64]

PARAMETERS = (
    "scale_px_per_mm", "aspect", "skew", "centre_u_px", "centre_v_px", "kappa_per_mm",
    "k1", "k2", "k3", "p1", "p2", "s1", "s2", "s3", "s4",
    "tilt_x", "tilt_y", "image_convergence_per_mm",
)  # fmt: skip
INDEX = {name: i for i, name in enumerate(PARAMETERS)}
_SCALE, _ASPECT, _SKEW, _CU, _CV, _KAPPA = range(6)
_DISTORTION = slice(6, 15)
_TX, _TY, _W = 15, 16, 17


def pixel_from_camera(points_mm: Array, intrinsics: Array, rho_mm: float) -> Array:
    """(..., 3) camera coordinates -> (..., 2) pixels; intrinsics (18,) ordered as `PARAMETERS`."""
    telecentric = points_mm[..., :2] / (1 + intrinsics[_KAPPA] * points_mm[..., 2:3])
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
    points_mm: Array, intrinsics: Array, rho_mm: float
) -> tuple[Array, Array, Array]:
    """Pixels with their derivatives.

    Returns (..., 2) pixels, (..., 2, 3) with respect to the camera point and (..., 2, 18) with
    respect to the intrinsics.
    """
    kappa = intrinsics[_KAPPA]
    inverse_depth = 1 / (1 + kappa * points_mm[..., 2])
    ideal = points_mm[..., :2] * inverse_depth[..., None]
    normal = ideal / rho_mm
    coefficients = intrinsics[_DISTORTION]
    distorted = distortion.distort(normal, coefficients) * rho_mm
    sensor, sensor_jac, tilt_jac = _tilt_jacobians(distorted, intrinsics)
    affine = intrinsics[_SCALE] * np.array([[1, intrinsics[_SKEW]], [0, intrinsics[_ASPECT]]])

    pixel_from_distorted = affine @ sensor_jac
    pixel_from_ideal = pixel_from_distorted @ distortion.distortion_jacobian(normal, coefficients)
    by_point = np.empty((*ideal.shape, 3))
    by_point[..., :2] = pixel_from_ideal * inverse_depth[..., None, None]
    towards_axis = np.einsum("...ij,...j->...i", pixel_from_ideal, ideal) * inverse_depth[..., None]
    by_point[..., 2] = -kappa * towards_axis

    by_intrinsics = np.zeros((*ideal.shape, len(PARAMETERS)))
    by_intrinsics[..., 0, _SCALE] = sensor[..., 0] + intrinsics[_SKEW] * sensor[..., 1]
    by_intrinsics[..., 1, _SCALE] = intrinsics[_ASPECT] * sensor[..., 1]
    by_intrinsics[..., 1, _ASPECT] = intrinsics[_SCALE] * sensor[..., 1]
    by_intrinsics[..., 0, _SKEW] = intrinsics[_SCALE] * sensor[..., 1]
    by_intrinsics[..., 0, _CU] = by_intrinsics[..., 1, _CV] = 1
    by_intrinsics[..., _KAPPA] = -towards_axis * points_mm[..., 2:3]
    by_coefficients = distortion.coefficient_jacobian(normal) * rho_mm
    by_intrinsics[..., _DISTORTION] = pixel_from_distorted @ by_coefficients
    by_intrinsics[..., _TX:] = affine @ tilt_jac
    return _pixel_from_sensor(sensor, intrinsics), by_point, by_intrinsics


def _tilt_jacobians(xy_mm: Array, intrinsics: Array) -> tuple[Array, Array, Array]:
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
