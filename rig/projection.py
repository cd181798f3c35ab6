"""Models the camera by pure functions, from camera coordinates to pixels and their derivatives.

The steps are residual perspective (kappa), distortion, sensor tilt and an affine map, all about
one centre. The tilt follows Steger (IJCV 123:121, 2017), in one formula for both kinds of
telecentric lens. Let x be the distorted coordinates, y the coordinates on the tilted sensor, q the
tangent vector of the tilt and w = 1 / image distance (1/mm, in object space):

    y = S(q) x / (1 - w q.x),    S(q) = I + q q^T / (1 + sqrt(1 + q.q))

A lens that is telecentric on both sides has w = 0. The map is then an affine stretch that is even
in q, so the sign of the tilt cannot be observed. A lens that is telecentric on the object side only
has w > 0, and the map is a homography.

For points behind a window the first step is `telerig.rig.windows`. The parameters wall_x_rad and
wall_y_rad turn the window's stated normal (`Wall.turned`). They have no effect without a window.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from telerig.arrays import Array
from telerig.rig import distortion, windows
from telerig.rig.distortion import components_first
from telerig.rig.lens_parameters import COEFFICIENTS, INDEX, LENS_PARAMETERS, PARAMETERS
from telerig.rig.windows import Wall

_SCALE, _ASPECT, _SKEW, _KAPPA = (
    INDEX[name] for name in ("scale_px_per_mm", "aspect", "skew", "kappa_per_mm")
)
_CU, _CV = INDEX["centre_u_px"], INDEX["centre_v_px"]
_DISTORTION = slice(INDEX[COEFFICIENTS[0]], INDEX[COEFFICIENTS[-1]] + 1)
_TX, _TY, _W = (INDEX[name] for name in ("tilt_x", "tilt_y", "image_convergence_per_mm"))
_WALL = slice(INDEX["wall_x_rad"], INDEX["wall_y_rad"] + 1)


def intrinsics_from(parameters: Mapping[str, float]) -> Array:
    """Return the intrinsics (20,) in the order of `PARAMETERS`, from a mapping from name to value.

    Raises KeyError if a parameter is missing that is not optional.
    """
    missing = {name: 0.0 for name, known in LENS_PARAMETERS.items() if known.optional}
    return np.array([(missing | dict(parameters))[name] for name in PARAMETERS], float)


def turned_wall(intrinsics: Array, wall: Wall) -> Wall:
    """Return the window after its normal has been turned by wall_x_rad and wall_y_rad of the
    intrinsics."""
    return wall.turned(intrinsics[_WALL])


def pixel_from_camera(
    points_mm: Array, intrinsics: Array, rho_mm: float, wall: Wall | None = None
) -> Array:
    """Return the pixels (..., 2) of points (..., 3) in camera coordinates.

    intrinsics : (20,) in the order of `PARAMETERS`.
    wall : the window between the camera and the points, which are then in the water; or None.

    Raises the errors of `windows.ideal_from_water`.
    """
    if wall is None:
        telecentric = points_mm[..., :2] / (1 + intrinsics[_KAPPA] * points_mm[..., 2:3])
    else:
        turned = turned_wall(intrinsics, wall)
        telecentric = windows.ideal_from_water(points_mm, float(intrinsics[_KAPPA]), turned)
    distorted = distortion.distort(telecentric / rho_mm, intrinsics[_DISTORTION]) * rho_mm
    return _pixel_from_sensor(sensor_from_distorted(distorted, intrinsics), intrinsics)


def ideal_from_pixel(uv_px: Array, intrinsics: Array, rho_mm: float) -> Array:
    """Return the telecentric coordinates (..., 2) in mm of pixels (..., 2).

    The telecentric coordinates of a pixel are the point at which its ray in air crosses depth 0.
    """
    v = (uv_px[..., 1] - intrinsics[_CV]) / (intrinsics[_SCALE] * intrinsics[_ASPECT])
    u = (uv_px[..., 0] - intrinsics[_CU]) / intrinsics[_SCALE] - intrinsics[_SKEW] * v
    distorted = distorted_from_sensor(np.stack([u, v], -1), intrinsics)
    return distortion.undistort(distorted / rho_mm, intrinsics[_DISTORTION]) * rho_mm


def sensor_from_distorted(xy_mm: Array, intrinsics: Array) -> Array:
    """Return the coordinates (..., 2) on the tilted sensor of distorted coordinates (..., 2), in
    mm.
    """
    q, w = intrinsics[_TX : _TY + 1], intrinsics[_W]
    if not q.any():
        return xy_mm
    along = xy_mm[..., 0] * q[0] + xy_mm[..., 1] * q[1]
    stretch = along / (1 + np.sqrt(1 + q @ q))
    out = components_first(along.shape, 2)
    for i in range(2):
        out[..., i] = (xy_mm[..., i] + stretch * q[i]) / (1 - w * along)
    return out


def distorted_from_sensor(xy_mm: Array, intrinsics: Array) -> Array:
    """Return the inverse of `sensor_from_distorted`, in closed form."""
    q = intrinsics[_TX : _TY + 1]
    root = np.sqrt(1 + q @ q)
    unstretched = xy_mm - ((xy_mm @ q) / (root * (1 + root)))[..., None] * q
    return np.asarray(unstretched / (1 + intrinsics[_W] * (unstretched @ q))[..., None])


def _pixel_from_sensor(xy_mm: Array, intrinsics: Array) -> Array:
    scale = intrinsics[_SCALE]
    out = components_first(xy_mm.shape[:-1], 2)
    out[..., 0] = scale * (xy_mm[..., 0] + intrinsics[_SKEW] * xy_mm[..., 1]) + intrinsics[_CU]
    out[..., 1] = scale * intrinsics[_ASPECT] * xy_mm[..., 1] + intrinsics[_CV]
    return out


def pixel_jacobians(
    points_mm: Array,
    intrinsics: Array,
    rho_mm: float,
    wall: Wall | None = None,
    free: Sequence[int] = range(len(PARAMETERS)),
) -> tuple[Array, Array, Array]:
    """Return the pixels of points and their derivatives.

    points_mm : (..., 3) in camera coordinates.
    free : indices into `PARAMETERS` of the F intrinsics for which derivatives are wanted.
    wall : as in `pixel_from_camera`.

    Returns the pixels (..., 2), their derivative (..., 2, 3) with respect to the point, and their
    derivative (..., 2, F) with respect to the free intrinsics.
    """
    kappa, batch = intrinsics[_KAPPA], points_mm.shape[:-1]
    if wall is None:
        nearness = 1 / (1 + kappa * points_mm[..., 2])
        ideal = components_first(batch, 2)
        for i in range(2):
            ideal[..., i] = points_mm[..., i] * nearness
        uv, by_ideal, by_free = _lens_jacobians(ideal, intrinsics, rho_mm, free)
        towards_axis = by_ideal[..., 0] * ideal[..., :1] + by_ideal[..., 1] * ideal[..., 1:]
        towards_axis *= nearness[..., None]
        by_point = components_first(batch, 2, 3)
        for i in range(2):
            by_point[..., i] = by_ideal[..., i] * nearness[..., None]
        by_point[..., 2] = -kappa * towards_axis
        by_kappa, by_turn = -towards_axis * points_mm[..., 2:], np.zeros((*batch, 2, 2))
    else:
        seen = windows.ideal_jacobians(points_mm, float(kappa), turned_wall(intrinsics, wall))
        uv, by_ideal, by_free = _lens_jacobians(seen.value, intrinsics, rho_mm, free)
        by_point = by_ideal @ seen.by_point
        by_kappa = np.einsum("...ij,...j->...i", by_ideal, seen.by_kappa)
        by_turn = by_ideal @ (seen.by_wall[..., :2] @ wall.turn_jacobian(intrinsics[_WALL]))
    for column, parameter in enumerate(free):
        if parameter == _KAPPA:
            by_free[..., column] = by_kappa
        elif parameter >= _WALL.start:
            by_free[..., column] = by_turn[..., parameter - _WALL.start]
    return uv, by_point, by_free


def _lens_jacobians(
    ideal: Array, intrinsics: Array, rho_mm: float, free: Sequence[int]
) -> tuple[Array, Array, Array]:
    """Return pixels (..., 2) and their derivatives, starting from telecentric coordinates (..., 2).

    The derivatives are (..., 2, 2) with respect to these coordinates and (..., 2, F) with respect
    to the F free intrinsics; the columns of kappa and of the window stay 0 for the caller to fill.
    """
    normal, coefficients = ideal / rho_mm, intrinsics[_DISTORTION]
    distorted = distortion.distort(normal, coefficients) * rho_mm
    scale, aspect, skew = intrinsics[[_SCALE, _ASPECT, _SKEW]]
    affine = scale * np.array([[1, skew], [0, aspect]])
    sensor, by_distorted = distorted, affine
    tilted, batch = [p for p in free if _TX <= p <= _W], ideal.shape[:-1]
    by_tilt = np.zeros((*batch, 2, 3))
    if tilted or intrinsics[_TX : _TY + 1].any():
        sensor, by_xy, by_tilt = tilt_jacobians(distorted, intrinsics)
        by_distorted, by_tilt = _product(affine, by_xy), _product(affine, by_tilt)
    by_ideal = _product(by_distorted, distortion.distortion_jacobian(normal, coefficients))

    by_free = components_first(batch, 2, len(free))
    wanted = [p - _DISTORTION.start for p in free if _DISTORTION.start <= p < _DISTORTION.stop]
    by_coefficients = distortion.coefficient_jacobian(normal, wanted) if wanted else normal
    for column, parameter in enumerate(free):
        out = by_free[..., column]
        if parameter == _SCALE:
            out[..., 0] = sensor[..., 0] + skew * sensor[..., 1]
            out[..., 1] = aspect * sensor[..., 1]
        elif parameter == _ASPECT:
            out[..., 1] = scale * sensor[..., 1]
        elif parameter == _SKEW:
            out[..., 0] = scale * sensor[..., 1]
        elif parameter in (_CU, _CV):
            out[..., parameter - _CU] = 1
        elif parameter in tilted:
            out[...] = by_tilt[..., parameter - _TX]
        elif _DISTORTION.start <= parameter < _DISTORTION.stop:
            step = by_coefficients[..., wanted.index(parameter - _DISTORTION.start)] * rho_mm
            out[...] = by_distorted[..., 0] * step[..., :1] + by_distorted[..., 1] * step[..., 1:]
    return _pixel_from_sensor(sensor, intrinsics), by_ideal, by_free


def _product(left: Array, right: Array) -> Array:
    """Return the product of matrices (..., 2, 2) and (..., 2, k), one component at a time."""
    batch = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])
    out = components_first(batch, *right.shape[-2:])
    for i in range(2):
        for j in range(right.shape[-1]):
            out[..., i, j] = left[..., i, 0] * right[..., 0, j] + left[..., i, 1] * right[..., 1, j]
    return out


def tilt_jacobians(xy_mm: Array, intrinsics: Array) -> tuple[Array, Array, Array]:
    """Return the coordinates on the tilted sensor and their derivatives, from distorted
    coordinates.

    Returns the coordinates (..., 2), their derivative (..., 2, 2) with respect to the distorted
    coordinates, and (..., 2, 3) with respect to tilt_x, tilt_y and w.
    """
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
