"""The image of a uniform ellipse: how much of each pixel's blurred footprint it covers.

An ellipse is ``centre + M (cos t, sin t)`` with M symmetric and positive definite, so its three
numbers ``shape = (m11, m12, m22)`` stay smooth when the ellipse becomes a circle. The eigenvalues
of M are the semi-axes. The point spread (Gaussian blur and square pixel) is a Gaussian of
``sigma^2 = blur^2 + 1/12`` with the pixel box's fourth cumulant, -1/120 per axis.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

Array = NDArray[np.float64]

PIXEL_VARIANCE_PX2 = 1.0 / 12.0
_FOURTH = -1.0 / 120.0 / 24.0
_ROOT_2PI = float(np.sqrt(2.0 * np.pi))
_NODE_SPACING_SIGMA = 1.1
_DEEP_SIGMA = 6.0


def shape_from_axes(a_px: ArrayLike, b_px: ArrayLike, angle_rad: ArrayLike) -> Array:
    """(..., 3) numbers (m11, m12, m22) of M from semi-axes and the angle of a from +u to +v."""
    a, b, angle = (np.asarray(x, dtype=np.float64) for x in (a_px, b_px, angle_rad))
    mean, half = 0.5 * (a + b), 0.5 * (a - b)
    c, s = half * np.cos(2.0 * angle), half * np.sin(2.0 * angle)
    return np.stack([mean + c, s + np.zeros_like(mean), mean - c], axis=-1)


def axes_from_shape(shape_px: ArrayLike) -> Array:
    """(..., 3) semi-axes a >= b and angle in (-pi/2, pi/2] from (..., 3) shape numbers."""
    m11, m12, m22 = np.moveaxis(np.asarray(shape_px, dtype=np.float64), -1, 0)
    mean, half = 0.5 * (m11 + m22), np.hypot(0.5 * (m11 - m22), m12)
    angle = 0.5 * np.arctan2(m12, 0.5 * (m11 - m22))
    return np.stack([mean + half, mean - half, angle], axis=-1)


def _long_axis(shape_px: Array) -> Array:
    """(...) the larger semi-axis."""
    m11, m12, m22 = (shape_px[..., i] for i in range(3))
    longest: Array = 0.5 * (m11 + m22) + np.hypot(0.5 * (m11 - m22), m12)
    return longest


def extent_px(shape_px: Array) -> Array:
    """(..., 2) half width and half height of the ellipse's upright bounding box."""
    return np.hypot(shape_px[..., :2], shape_px[..., 1:])


def approximate_distance_px(shape_px: Array, du_px: Array, dv_px: Array) -> Array:
    """Signed distance to the ellipse to first order (positive outside), for choosing pixels.

    ``shape_px`` (3,); ``du_px, dv_px`` offsets from the centre, broadcast together.
    """
    m11, m12, m22 = shape_px
    determinant = m11 * m22 - m12 * m12
    x, y = (m22 * du_px - m12 * dv_px) / determinant, (m11 * dv_px - m12 * du_px) / determinant
    radius = np.sqrt(x * x + y * y) + 1e-12
    slope = np.hypot(m22 * x - m12 * y, m11 * y - m12 * x) / (determinant * radius) + 1e-12
    distance: Array = np.maximum((radius - 1.0) / slope, -0.5 * (m11 + m22))
    return distance


def _column_kernel(z: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """One-dimensional point spread at ``sigma z``: its integral, itself, its derivative."""
    k = _FOURTH / sigma**4
    z2 = z * z
    g = np.exp(-0.5 * z2) * (1.0 / (_ROOT_2PI * sigma))
    integral = ndtr(z) - (k * sigma) * (z * (z2 - 3.0)) * g
    derivative = (g * (-1.0 / sigma)) * z * (1.0 + k * (z2 * (z2 - 10.0) + 15.0))
    return integral, g * (1.0 + k * (z2 * (z2 - 6.0) + 3.0)), derivative


def _row_kernel(z: Array, sigma: Array) -> tuple[Array, Array]:
    """One-dimensional point spread at ``sigma z`` and its second derivative."""
    k = _FOURTH / sigma**4
    z2 = z * z
    g = np.exp(-0.5 * z2) * (1.0 / (_ROOT_2PI * sigma))
    bent = z2 - 1.0 + k * (z2 * (z2 * (z2 - 15.0) + 45.0) - 15.0)
    return g * (1.0 + k * (z2 * (z2 - 6.0) + 3.0)), (g / sigma**2) * bent


def quadrature_nodes(a_px: float, sigma_px: float) -> int:
    """Nodes round the contour that make the periodic trapezoid rule exact to about 1e-6."""
    return max(24, int(np.ceil(2.0 * np.pi * a_px / (_NODE_SPACING_SIGMA * sigma_px))))


def coverage_on_grid(
    u_px: Array, v_px: Array, centre_px: ArrayLike, shape_px: ArrayLike, sigma_px: ArrayLike
) -> tuple[Array, Array]:
    """Coverage of the pixels at columns ``u_px`` (U,) and rows ``v_px`` (V,), exactly.

    Returns ``F`` (..., V, U) and its derivatives (..., 6, V, U) by centre (2), shape (3), sigma.
    ``centre_px`` (..., 2), ``shape_px`` (..., 3), ``sigma_px`` (...).

    By Gauss's theorem with the field (P(x - u) p(y - v), 0), p the one-dimensional point spread
    and P its integral, the convolution over the ellipse's area is an integral round its contour
    of a smooth periodic function, so the trapezoid rule converges exponentially, and each node's
    term is a product of a function of the row and one of the column: the sum is a matrix product.
    """
    centre, shape = np.asarray(centre_px, dtype=np.float64), np.asarray(shape_px, dtype=np.float64)
    sigma = np.asarray(sigma_px, dtype=np.float64)
    longest = float(np.max(_long_axis(shape)))
    count = quadrature_nodes(longest, float(np.min(sigma)))
    t = 2.0 * np.pi / count * np.arange(count)
    c, s = np.cos(t), np.sin(t)
    m11, m12, m22 = (shape[..., i, None] for i in range(3))
    normal_u = (m22 * c - m12 * s) * (2.0 * np.pi / count)
    normal_v = (m11 * s - m12 * c) * (2.0 * np.pi / count)
    sigma3 = sigma[..., None, None]
    x = centre[..., 0, None] + m11 * c + m12 * s
    y = centre[..., 1, None] + m12 * c + m22 * s
    column_p, column_d, column_d1 = _column_kernel(
        (x[..., None, :] - u_px[:, None]) / sigma3, sigma3
    )
    row_d, row_d2 = _row_kernel((y[..., None, :] - v_px[:, None]) / sigma3, sigma3)

    motions = (normal_u, normal_v, normal_u * c, normal_u * s + normal_v * c, normal_v * s)
    weights = np.stack(motions, axis=-2)
    moved = (row_d[..., None, :, :] * weights[..., :, None, :]) @ _transpose(column_d)[
        ..., None, :, :
    ]
    flux = normal_u[..., None, :]
    integral = _transpose(column_p)
    coverage = (row_d * flux) @ integral
    widened = (row_d * flux) @ _transpose(column_d1) + (row_d2 * flux) @ integral
    gradient = np.concatenate([moved, (sigma3 * widened)[..., None, :, :]], axis=-3)
    return coverage, gradient


def _transpose(x: Array) -> Array:
    return np.swapaxes(x, -1, -2)


def foot_points(
    shape_px: Array, du_px: Array, dv_px: Array, *, steps: int = 2
) -> tuple[Array, Array]:
    """Nearest points of an ellipse: (cos t, sin t) with foot = M (cos t, sin t), each (P,).

    ``shape_px`` (3,); offsets from the centre (P,). Newton on (p - x(t)) . x'(t) = 0 from the
    radial start, for points nearer than the smallest radius of curvature. Steps turn the unit
    vector instead of its angle, which saves the trigonometry.
    """
    m11, m12, m22 = shape_px
    determinant = m11 * m22 - m12 * m12
    c, s = m22 * du_px - m12 * dv_px, m11 * dv_px - m12 * du_px
    length = np.hypot(c, s)
    c = np.where(length > 0.0, c, 1.0)
    shrink = 1.0 / np.where(length > 0.0, length, 1.0)
    c, s = c * shrink, s * shrink
    g11, g12, g22 = m11 * m11 + m12 * m12, m12 * (m11 + m22), m12 * m12 + m22 * m22
    pu, pv = m11 * du_px + m12 * dv_px, m12 * du_px + m22 * dv_px
    for _ in range(steps):
        cs, c2 = c * s, c * c
        value = pv * c - pu * s + (g11 - g22) * cs + g12 * (1.0 - 2.0 * c2)
        slope = -pu * c - pv * s + (g11 - g22) * (2.0 * c2 - 1.0) + 4.0 * g12 * cs
        turn = -value / np.where(slope < 0.0, slope, -determinant)
        shrink = 1.0 / np.sqrt(1.0 + turn * turn)
        c, s = (c - turn * s) * shrink, (s + turn * c) * shrink
    return c, s


def coverage_near_edge(
    du_px: Array, dv_px: Array, shape_px: Array, sigma_px: float
) -> tuple[Array, Array]:
    """Coverage (P,) and derivatives (6, P) at offsets from the centre of a large ellipse.

    An expansion in curvature times sigma, to second order, in the exact signed distance:
    F = Phi(-z) - (k s / 2) phi(z) + (3/8) (k s)^2 z phi(z), z = d / s. Good to 1e-4 for
    k s < 0.08 and to 2e-4 for 0.12 (see :func:`largest_curvature`). By the envelope theorem the
    distance moves by minus the normal motion of the foot point; the curvature's own change is
    left out of the derivatives (relative error (k s)^2 / 2). Points deeper than 6 sigma are
    simply inside: their foot point need not be the nearest one.
    """
    m11, m12, m22 = shape_px
    deep = approximate_distance_px(shape_px, du_px, dv_px) < -_DEEP_SIGMA * sigma_px
    c, s = foot_points(shape_px, du_px, dv_px)
    normal_u, normal_v = m22 * c - m12 * s, m11 * s - m12 * c
    shrink = 1.0 / np.sqrt(normal_u * normal_u + normal_v * normal_v)
    normal_u, normal_v = normal_u * shrink, normal_v * shrink
    distance = (du_px - m11 * c - m12 * s) * normal_u + (dv_px - m12 * c - m22 * s) * normal_v
    bend = (m11 * m22 - m12 * m12) * sigma_px * (shrink * shrink * shrink)
    z = distance / sigma_px
    z2 = z * z
    density = np.exp(-0.5 * z2) / _ROOT_2PI
    across = normal_u * normal_v
    fourth = _FOURTH / sigma_px**4 * (1.0 - 2.0 * across * across)
    third = fourth * z * (z2 - 3.0)
    half, bend2 = 0.5 * bend, 0.375 * bend * bend
    coverage = ndtr(-z) + density * (bend2 * z - half + third)
    by_distance = (
        density
        / sigma_px
        * (half * z - 1.0 + bend2 * (1.0 - z2) - fourth * (z2 * (z2 - 6.0) + 3.0))
    )
    by_sigma = density / sigma_px * (2.0 * bend2 * z - half - 4.0 * third) - z * by_distance
    gradient = np.empty((6, *z.shape))
    np.multiply(by_distance, -normal_u, out=gradient[0])
    np.multiply(by_distance, -normal_v, out=gradient[1])
    np.multiply(gradient[0], c, out=gradient[2])
    gradient[3] = gradient[0] * s + gradient[1] * c
    np.multiply(gradient[1], s, out=gradient[4])
    gradient[5] = by_sigma
    coverage[deep] = 1.0
    gradient[:, deep] = 0.0
    return coverage, gradient


def semi_axes(shape_px: Array) -> tuple[float, float]:
    """Semi-axes (a, b) [px] of one ellipse, as plain numbers."""
    m11, m12, m22 = shape_px.tolist()
    mean, half = 0.5 * (m11 + m22), math.hypot(0.5 * (m11 - m22), m12)
    return mean + half, mean - half


def largest_curvature(shape_px: Array) -> float:
    """One ellipse's largest curvature a / b^2 [1/px]."""
    a, b = semi_axes(shape_px)
    return a / (b * b)
