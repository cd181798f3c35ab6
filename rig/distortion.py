"""Lens distortion in normalised coordinates: radial, tangential, thin prism.

OpenCV's definitions (Weng, Cohen and Herniou, PAMI 14:965, 1992), forward from ideal to distorted:

    x' = x (1 + k1 r2 + k2 r4 + k3 r6) + 2 p1 x y + p2 (r2 + 2 x2) + s1 r2 + s2 r4
    y' = y (1 + k1 r2 + k2 r4 + k3 r6) + p1 (r2 + 2 y2) + 2 p2 x y + s3 r2 + s4 r4
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.errors import GeometryError

Array = NDArray[np.float64]

COEFFICIENTS = ("k1", "k2", "k3", "p1", "p2", "s1", "s2", "s3", "s4")
_NEWTON_STEPS = 40


def distort(xy: Array, coefficients: Array) -> Array:
    """(..., 2) ideal -> (..., 2) distorted; coefficients (..., 9) in the order `COEFFICIENTS`."""
    x, y = xy[..., 0], xy[..., 1]
    k1, k2, k3, p1, p2, s1, s2, s3, s4 = np.moveaxis(coefficients, -1, 0)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + s2 * r2)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + s4 * r2)
    return np.stack([xd, yd], -1)


def distortion_jacobian(xy: Array, coefficients: Array) -> Array:
    """(..., 2, 2) derivative of `distort` with respect to the ideal coordinates."""
    x, y = xy[..., 0], xy[..., 1]
    k1, k2, k3, p1, p2, s1, s2, s3, s4 = np.moveaxis(coefficients, -1, 0)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    prism_x, prism_y = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
    out = np.empty((*radial.shape, 2, 2))
    cross = slope * x * y
    out[..., 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x + prism_x * x
    out[..., 0, 1] = cross + 2 * p1 * x + 2 * p2 * y + prism_x * y
    out[..., 1, 0] = cross + 2 * p1 * x + 2 * p2 * y + prism_y * x
    out[..., 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x + prism_y * y
    return out


def coefficient_jacobian(xy: Array) -> Array:
    """(..., 2, 9) derivative of `distort` by the coefficients, in which it is linear."""
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    out = np.zeros((*r2.shape, 2, 9))
    power = r2
    for i in range(3):
        out[..., 0, i], out[..., 1, i] = x * power, y * power
        power = power * r2
    out[..., 0, 3] = out[..., 1, 4] = 2 * x * y
    out[..., 1, 3], out[..., 0, 4] = r2 + 2 * y * y, r2 + 2 * x * x
    out[..., 0, 5] = out[..., 1, 7] = r2
    out[..., 0, 6] = out[..., 1, 8] = r2 * r2
    return out


def undistort(xy_distorted: Array, coefficients: Array) -> Array:
    """(..., 2) distorted -> (..., 2) ideal, by Newton's method to machine precision.

    Raises
    ------
    GeometryError
        Where the distortion cannot be inverted: beyond the radius at which the map folds over.
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
