"""Models lens distortion in normalised coordinates by radial, tangential and thin-prism terms.

The definitions are those of OpenCV (Weng, Cohen and Herniou, PAMI 14:965, 1992). They map ideal
coordinates (x, y) to distorted ones (x', y'), with r2 = x^2 + y^2, r4 = r2^2 and r6 = r2^3:

    x' = x (1 + k1 r2 + k2 r4 + k3 r6) + 2 p1 x y + p2 (r2 + 2 x^2) + s1 r2 + s2 r4
    y' = y (1 + k1 r2 + k2 r4 + k3 r6) + p1 (r2 + 2 y^2) + 2 p2 x y + s3 r2 + s4 r4

The radial polynomial has as many terms as `telerig.rig.lens_parameters` has radial parameters.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from telerig.arrays import Array
from telerig.errors import GeometryError
from telerig.rig.lens_parameters import COEFFICIENTS, LENS_PARAMETERS

_RADIAL, _TANGENTIAL, _PRISM = (
    [i for i, name in enumerate(COEFFICIENTS) if LENS_PARAMETERS[name].term == term]
    for term in ("radial", "tangential", "prism")
)
_NEWTON_STEPS = 40


def components_first(batch: tuple[int, ...], *components: int) -> Array:
    """Return zeros of shape (*batch, *components) in which each component is contiguous in memory.

    Arithmetic on one component of many points is then faster, because it reads memory in order.
    """
    first, last = len(components), len(components) + len(batch)
    return np.zeros((*components, *batch)).transpose(*range(first, last), *range(first))


def _split(coefficients: Array) -> tuple[list[Array], list[Array], list[Array]]:
    """Return the coefficients (...) of the radial, the tangential and the prism terms; [] for terms
    whose coefficients are all 0."""
    return tuple(  # type: ignore[return-value]
        [coefficients[..., i] for i in which] if np.any(coefficients[..., which]) else []
        for which in (_RADIAL, _TANGENTIAL, _PRISM)
    )


def distort(xy: Array, coefficients: Array) -> Array:
    """Return the distorted coordinates (..., 2) of ideal coordinates (..., 2), both normalised.

    coefficients : (..., 9) in the order of `COEFFICIENTS`.
    """
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
        total, rise = radial[-1], r2 * len(radial) * radial[-1]
        for power, k in reversed(list(enumerate(radial[:-1], 1))):
            total = k + r2 * total
            rise = power * k + rise if power == 1 else r2 * (power * k + rise)
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
    """Return the derivative (..., 2, k) of `distort` with respect to k of its coefficients.

    `distort` is linear in its coefficients, so the derivative does not depend on their values.

    xy : (..., 2) ideal coordinates.
    which : the k indices into `COEFFICIENTS`.
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

    `distort` is inverted by Newton's method. Raises GeometryError where it cannot be inverted,
    which is beyond the radius at which the map folds over.
    """
    target = np.asarray(xy_distorted, float)
    if not np.any(coefficients):
        return target.copy()
    xy = target.copy()
    for _ in range(_NEWTON_STEPS):
        residual = target - distort(xy, coefficients)
        slope = distortion_jacobian(xy, coefficients)
        singular = (np.abs(np.linalg.det(slope)) <= 1e-12)[..., None, None]
        slope = np.where(singular, np.eye(2), slope)
        step = np.linalg.solve(slope, residual[..., None])[..., 0]
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        xy = xy + step * np.minimum(1.0, 0.3 / np.maximum(length, 1e-300))
        if np.max(length, initial=0.0) < 1e-15:
            break
    _check_inverse(target, xy, coefficients)
    return xy


def _check_inverse(target: Array, xy: Array, coefficients: Array) -> None:
    error = np.linalg.norm(target - distort(xy, coefficients), axis=-1)
    fold = np.linalg.det(distortion_jacobian(xy, coefficients)) <= 0
    bad = ~(error <= 1e-12 * (1 + np.linalg.norm(target, axis=-1))) | fold
    if np.any(bad):
        where = np.linalg.norm(target[bad], axis=-1).min()
        raise GeometryError(
            f"the distortion cannot be inverted for {int(np.sum(bad))} of {bad.size} points, "
            f"the nearest {where:.2f} half-diagonals from the image centre",
            todo="use pixels inside the image only, or fit a simpler distortion model",
        )
