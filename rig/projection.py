"""Models the camera by pure functions, from camera coordinates to pixels and their derivatives.

The steps are residual perspective (kappa), distortion, sensor tilt and an affine map, all about
one centre.

The distortion is that of OpenCV (Weng, Cohen and Herniou, PAMI 14:965, 1992): radial, tangential
and thin-prism terms. It maps normalised ideal coordinates (x, y) to distorted ones (x', y'), with
r2 = x^2 + y^2, r4 = r2^2 and r6 = r2^3:

    x' = x (1 + k1 r2 + k2 r4 + k3 r6) + 2 p1 x y + p2 (r2 + 2 x^2) + s1 r2 + s2 r4
    y' = y (1 + k1 r2 + k2 r4 + k3 r6) + p1 (r2 + 2 y^2) + 2 p2 x y + s3 r2 + s4 r4

The radial polynomial has as many terms as `telerig.rig.lens_parameters` has radial parameters.

The tilt follows Steger (IJCV 123:121, 2017), in one formula for both kinds of telecentric lens. Let
x be the distorted coordinates, y the coordinates on the tilted sensor, q the tangent vector of the
tilt and w = 1 / image distance (1/mm, in object space):

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
from telerig.errors import GeometryError
from telerig.rig import windows
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
    """Return the intrinsics (20,) from a mapping by name. Raises KeyError if one is missing."""
    missing = {name: 0.0 for name, known in LENS_PARAMETERS.items() if known.optional}
    return np.array([(missing | dict(parameters))[name] for name in PARAMETERS], float)


def turned_wall(intrinsics: Array, wall: Wall) -> Wall:
    """Return the window with its normal turned by wall_x_rad and wall_y_rad of the intrinsics."""
    return wall.turned(intrinsics[_WALL])


def pixel_from_camera(
    points_mm: Array, intrinsics: Array, rho_mm: float, wall: Wall | None = None
) -> Array:
    """Return the pixels (..., 2) of points (..., 3) in camera coordinates.

    With a window the points are in the water behind it. Raises the errors of
    `windows.ideal_from_water`.
    """
    if wall is None:
        telecentric = points_mm[..., :2] / (1 + intrinsics[_KAPPA] * points_mm[..., 2:3])
    else:
        turned = turned_wall(intrinsics, wall)
        telecentric = windows.ideal_from_water(points_mm, float(intrinsics[_KAPPA]), turned)
    distorted = distort(telecentric / rho_mm, intrinsics[_DISTORTION]) * rho_mm
    return _pixel_from_sensor(sensor_from_distorted(distorted, intrinsics), intrinsics)


def ideal_from_pixel(uv_px: Array, intrinsics: Array, rho_mm: float) -> Array:
    """Return the telecentric coordinates (..., 2) in mm: where a ray in air crosses depth 0."""
    v = (uv_px[..., 1] - intrinsics[_CV]) / (intrinsics[_SCALE] * intrinsics[_ASPECT])
    u = (uv_px[..., 0] - intrinsics[_CU]) / intrinsics[_SCALE] - intrinsics[_SKEW] * v
    distorted = distorted_from_sensor(np.stack([u, v], -1), intrinsics)
    return undistort(distorted / rho_mm, intrinsics[_DISTORTION]) * rho_mm


def sensor_from_distorted(xy_mm: Array, intrinsics: Array) -> Array:
    """Return tilted-sensor coordinates (..., 2) of distorted coordinates (..., 2), in mm."""
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

    points_mm : (..., 3) in camera coordinates. free : indices into `PARAMETERS` of the F intrinsics
    for which derivatives are wanted.
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
    """Return pixels (..., 2) of telecentric coordinates (..., 2), and their derivatives.

    These are (..., 2, 2) by the coordinates and (..., 2, F) by the free intrinsics; the columns of
    kappa and of the window stay 0 for the caller to fill.
    """
    normal, coefficients = ideal / rho_mm, intrinsics[_DISTORTION]
    distorted = distort(normal, coefficients) * rho_mm
    scale, aspect, skew = intrinsics[[_SCALE, _ASPECT, _SKEW]]
    affine = scale * np.array([[1, skew], [0, aspect]])
    sensor, by_distorted = distorted, affine
    tilted, batch = [p for p in free if _TX <= p <= _W], ideal.shape[:-1]
    by_tilt = np.zeros((*batch, 2, 3))
    if tilted or intrinsics[_TX : _TY + 1].any():
        sensor, by_xy, by_tilt = tilt_jacobians(distorted, intrinsics)
        by_distorted, by_tilt = _product(affine, by_xy), _product(affine, by_tilt)
    by_ideal = _product(by_distorted, distortion_jacobian(normal, coefficients))

    by_free = components_first(batch, 2, len(free))
    wanted = [p - _DISTORTION.start for p in free if _DISTORTION.start <= p < _DISTORTION.stop]
    by_coefficients = coefficient_jacobian(normal, wanted) if wanted else normal
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
    """Return coordinates (..., 2) on the tilted sensor and their derivatives.

    These are (..., 2, 2) by the distorted coordinates and (..., 2, 3) by tilt_x, tilt_y and w.
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


_RADIAL, _TANGENTIAL, _PRISM = (
    [i for i, name in enumerate(COEFFICIENTS) if LENS_PARAMETERS[name].term == term]
    for term in ("radial", "tangential", "prism")
)
_NEWTON_STEPS = 40


def components_first(batch: tuple[int, ...], *components: int) -> Array:
    """Return zeros (*batch, *components); each component is contiguous, for faster arithmetic."""
    first, last = len(components), len(components) + len(batch)
    return np.zeros((*components, *batch)).transpose(*range(first, last), *range(first))


def _split(coefficients: Array) -> tuple[list[Array], list[Array], list[Array]]:
    """Return the coefficients (...) of the radial, the tangential and the prism terms; [] for terms
    whose coefficients are all 0. Radial terms end with the last that is not 0."""
    if coefficients.ndim == 1:
        values = coefficients.tolist()
        used = [value != 0 for value in values]
    else:
        values = list(np.moveaxis(coefficients, -1, 0))
        used = [bool(np.any(value)) for value in values]
    radial, tangential, prism = (
        [values[i] for i in which] if any(used[i] for i in which) else []
        for which in (_RADIAL, _TANGENTIAL, _PRISM)
    )
    last = max((k for k, i in enumerate(_RADIAL) if used[i]), default=-1)
    return radial[: last + 1], tangential, prism


def distort(xy: Array, coefficients: Array) -> Array:
    """Return distorted coordinates (..., 2) of ideal ones, with coefficients (..., 9)."""
    x, y = xy[..., 0], xy[..., 1]
    radial, tangential, prism = _split(coefficients)
    r2 = x * x + y * y
    xd, yd = x, y
    if radial:
        total = radial[-1]
        for k in radial[-2::-1]:
            total = k + r2 * total
        factor = 1 + r2 * total
        xd, yd = x * factor, y * factor
    if tangential:
        p1, p2 = tangential
        cross = 2 * x * y
        xd = xd + p1 * cross + p2 * (r2 + 2 * x * x)
        yd = yd + p1 * (r2 + 2 * y * y) + p2 * cross
    if prism:
        s1, s2, s3, s4 = prism
        xd = xd + r2 * (s1 + s2 * r2)
        yd = yd + r2 * (s3 + s4 * r2)
    out = components_first(np.broadcast_shapes(xd.shape, yd.shape), 2)
    out[..., 0], out[..., 1] = xd, yd
    return out


def distortion_jacobian(xy: Array, coefficients: Array) -> Array:
    """Return the derivative (..., 2, 2) of `distort` with respect to the ideal coordinates."""
    x, y = xy[..., 0], xy[..., 1]
    radial, tangential, prism = _split(coefficients)
    r2 = x * x + y * y
    out = components_first(np.broadcast_shapes(x.shape, coefficients.shape[:-1]), 2, 2)
    out[..., 0, 0] = out[..., 1, 1] = 1
    if radial:
        total, rise = radial[-1], len(radial) * radial[-1]
        for power, k in reversed(list(enumerate(radial[:-1], 1))):
            total = k + r2 * total
            rise = power * k + r2 * rise
        slope = 2 * rise
        total, cross = r2 * total, slope * x * y
        out[..., 0, 0] += total + slope * x * x
        out[..., 0, 1] += cross
        out[..., 1, 0] += cross
        out[..., 1, 1] += total + slope * y * y
    if tangential:
        p1, p2 = tangential
        cross = 2 * (p1 * x + p2 * y)
        out[..., 0, 0] += 2 * p1 * y + 6 * p2 * x
        out[..., 0, 1] += cross
        out[..., 1, 0] += cross
        out[..., 1, 1] += 6 * p1 * y + 2 * p2 * x
    if prism:
        s1, s2, s3, s4 = prism
        prism_x, prism_y = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
        out[..., 0, 0] += prism_x * x
        out[..., 0, 1] += prism_x * y
        out[..., 1, 0] += prism_y * x
        out[..., 1, 1] += prism_y * y
    return out


def coefficient_jacobian(xy: Array, which: Sequence[int] = range(len(COEFFICIENTS))) -> Array:
    """Return the derivative (..., 2, k) of `distort`, which is linear, by k of its coefficients.

    xy : (..., 2) ideal coordinates. which : the k indices into `COEFFICIENTS`.
    """
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    out = components_first(r2.shape, 2, len(which))
    for column, i in enumerate(which):
        if i in _RADIAL:
            power = r2 ** (1 + _RADIAL.index(i))
            out[..., 0, column], out[..., 1, column] = x * power, y * power
        elif i in _TANGENTIAL:
            axis = _TANGENTIAL.index(i)
            square = x if axis else y
            out[..., axis, column] = 2 * x * y
            out[..., 1 - axis, column] = r2 + 2 * square * square
        else:
            axis, power_of_two = divmod(_PRISM.index(i), 2)
            out[..., axis, column] = r2 * r2 if power_of_two else r2
    return out


def undistort(xy_distorted: Array, coefficients: Array) -> Array:
    """Return the ideal coordinates (..., 2) of distorted ones (..., 2), to machine precision.

    Newton's method. Raises GeometryError beyond the radius at which the map folds over.
    """
    target = np.asarray(xy_distorted, float)
    if not np.any(coefficients):
        return target.copy()
    xy = target.copy()
    for _ in range(_NEWTON_STEPS):
        residual = target - distort(xy, coefficients)
        slope = distortion_jacobian(xy, coefficients)
        determinant = _determinant(slope)
        singular = (np.abs(determinant) <= 1e-12)[..., None]
        across = slope[..., 1, 1] * residual[..., 0] - slope[..., 0, 1] * residual[..., 1]
        down = slope[..., 0, 0] * residual[..., 1] - slope[..., 1, 0] * residual[..., 0]
        step = np.stack([across, down], -1) / np.where(singular, 1.0, determinant[..., None])
        step = np.where(singular, residual, step)
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        xy = xy + step * np.minimum(1.0, 0.3 / np.maximum(length, 1e-300))
        if np.max(length, initial=0.0) < 1e-15:
            break
    _check_inverse(target, xy, coefficients)
    return xy


def _determinant(matrix: Array) -> Array:
    return np.asarray(matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0])


def _check_inverse(target: Array, xy: Array, coefficients: Array) -> None:
    error = np.linalg.norm(target - distort(xy, coefficients), axis=-1)
    fold = _determinant(distortion_jacobian(xy, coefficients)) <= 0
    bad = ~(error <= 1e-12 * (1 + np.linalg.norm(target, axis=-1))) | fold
    if np.any(bad):
        where = np.linalg.norm(target[bad], axis=-1).min()
        raise GeometryError(
            f"the distortion cannot be inverted for {int(np.sum(bad))} of {bad.size} points, "
            f"the nearest of which is {where:.2f} half-diagonals of the image from its centre",
            todo="use pixels inside the image only, or fit a simpler distortion model",
        )
