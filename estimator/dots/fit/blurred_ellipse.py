"""The image of a uniform ellipse: how much of each pixel's blurred footprint it covers.

An ellipse is ``centre + M (cos t, sin t)`` with M symmetric and positive definite, so its three
numbers ``shape = (m11, m12, m22)`` stay smooth when the ellipse becomes a circle. The eigenvalues
of M are the semi-axes. The point spread (Gaussian blur and square pixel) is a Gaussian of
``sigma^2 = blur^2 + 1/12`` with the pixel box's fourth cumulant, -1/120 per axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from telerig.arrays import Array

PIXEL_VARIANCE_PX2 = 1.0 / 12.0
_FOURTH = -1.0 / 120.0 / 24.0
_ROOT_2PI = float(np.sqrt(2.0 * np.pi))
_NODE_SPACING_SIGMA = 1.1
_DEEP_SIGMA = 6.0


def shape_from_axes(a_px: ArrayLike, b_px: ArrayLike, angle_rad: ArrayLike) -> Array:
    """Return the shape numbers (m11, m12, m22) (..., 3) of ellipses.

    a_px, b_px : semi-axes (...). angle_rad : angle (...) of the semi-axis a, from +u towards +v.
    """
    a, b, angle = (np.asarray(x, dtype=np.float64) for x in (a_px, b_px, angle_rad))
    mean, half = 0.5 * (a + b), 0.5 * (a - b)
    c, s = half * np.cos(2.0 * angle), half * np.sin(2.0 * angle)
    return np.stack([mean + c, s + np.zeros_like(mean), mean - c], axis=-1)


def axes_from_shape(shape_px: ArrayLike) -> Array:
    """Return the semi-axes a >= b (px) and the angle of a in (-pi/2, pi/2], as one array (..., 3).

    shape_px : (..., 3) shape numbers (m11, m12, m22).
    """
    shape = np.asarray(shape_px, dtype=np.float64)
    angle = 0.5 * np.arctan2(shape[..., 1], 0.5 * (shape[..., 0] - shape[..., 2]))
    return np.stack([*semi_axes(shape), angle], axis=-1)


def extent_px(shape_px: Array) -> Array:
    """Return half the width and half the height (..., 2) in px of ellipses' bounding boxes.

    shape_px : (..., 3) shape numbers. The sides of the boxes are parallel to u and v.
    """
    return np.hypot(shape_px[..., :2], shape_px[..., 1:])


def approximate_distance_px(shape_px: Array, du_px: Array, dv_px: Array) -> Array:
    """Return the distances (px) of pixels from ellipses, to first order; positive outside.

    shape_px : (..., 3) shape numbers. du_px, dv_px : (..., P) offsets from the centre.
    """
    m11, m12, m22 = _columns(shape_px)
    determinant = m11 * m22 - m12 * m12
    x, y = (m22 * du_px - m12 * dv_px) / determinant, (m11 * dv_px - m12 * du_px) / determinant
    radius = np.sqrt(x * x + y * y) + 1e-12
    slope = np.hypot(m22 * x - m12 * y, m11 * y - m12 * x) / (determinant * radius) + 1e-12
    distance: Array = np.maximum((radius - 1.0) / slope, -0.5 * (m11 + m22))
    return distance


def _columns(shape_px: Array) -> tuple[Array, Array, Array]:
    """Return three (..., 1) shape numbers that broadcast with (..., P) pixels."""
    return shape_px[..., :1], shape_px[..., 1:2], shape_px[..., 2:]


def _column_kernel(z: Array, sigma: Array) -> tuple[Array, Array, Array]:
    """Return one-dimensional point spread at ``sigma z``: its integral, itself, its derivative."""
    k = _FOURTH / sigma**4
    z2 = z * z
    g = np.exp(-0.5 * z2) * (1.0 / (_ROOT_2PI * sigma))
    integral = ndtr(z) - (k * sigma) * (z * (z2 - 3.0)) * g
    derivative = (g * (-1.0 / sigma)) * z * (1.0 + k * (z2 * (z2 - 10.0) + 15.0))
    return integral, g * (1.0 + k * (z2 * (z2 - 6.0) + 3.0)), derivative


def _row_kernel(z: Array, sigma: Array) -> tuple[Array, Array]:
    """Return the one-dimensional point spread at ``sigma z`` and its second derivative."""
    k = _FOURTH / sigma**4
    z2 = z * z
    g = np.exp(-0.5 * z2) * (1.0 / (_ROOT_2PI * sigma))
    bent = z2 - 1.0 + k * (z2 * (z2 * (z2 - 15.0) + 45.0) - 15.0)
    return g * (1.0 + k * (z2 * (z2 - 6.0) + 3.0)), (g / sigma**2) * bent


def quadrature_nodes(a_sigma: float) -> int:
    """Return the number of nodes round a contour that make the trapezoid rule exact to about 1e-6.

    a_sigma : longest semi-axis in units of the blur's sigma.
    """
    return max(24, int(np.ceil(2.0 * np.pi * a_sigma / _NODE_SPACING_SIGMA)))


def coverage_on_grid(
    u_px: Array, v_px: Array, centre_px: ArrayLike, shape_px: ArrayLike, sigma_px: ArrayLike
) -> tuple[Array, Array]:
    """Return how much of each pixel's blurred footprint an ellipse covers, exactly.

    u_px, v_px : columns (..., U) and rows (..., V) of the pixels.
    centre_px : (..., 2).
    shape_px : (..., 3).
    sigma_px : (...) standard deviation of the blur.

    Returns the coverage F (..., V, U), 0 to 1, and its derivatives (..., 6, V, U) with respect to
    centre (2), shape (3) and sigma.

    By Gauss's theorem with the field (P(x - u) p(y - v), 0), p the one-dimensional point spread and
    P its integral, the convolution over the ellipse's area is an integral round its contour of a
    smooth periodic function: the trapezoid rule converges exponentially, and the sum of products of
    row and column functions is a matrix product.
    """
    centre, shape = np.asarray(centre_px, dtype=np.float64), np.asarray(shape_px, dtype=np.float64)
    sigma = np.asarray(sigma_px, dtype=np.float64)
    count = quadrature_nodes(float(np.max(semi_axes(shape)[0] / sigma)))
    t = 2.0 * np.pi / count * np.arange(count)
    c, s = np.cos(t), np.sin(t)
    m11, m12, m22 = (shape[..., i, None] for i in range(3))
    normal_u = (m22 * c - m12 * s) * (2.0 * np.pi / count)
    normal_v = (m11 * s - m12 * c) * (2.0 * np.pi / count)
    sigma3 = sigma[..., None, None]
    x = centre[..., 0, None] + m11 * c + m12 * s
    y = centre[..., 1, None] + m12 * c + m22 * s
    column_p, column_d, column_d1 = _column_kernel(
        (x[..., None, :] - u_px[..., None]) / sigma3, sigma3
    )
    row_d, row_d2 = _row_kernel((y[..., None, :] - v_px[..., None]) / sigma3, sigma3)

    motions = np.stack(
        (normal_u, normal_v, normal_u * c, normal_u * s + normal_v * c, normal_v * s), axis=-2
    )
    weighted = row_d[..., None, :, :] * motions[..., :, None, :]
    sizes = (v_px.shape[-1], u_px.shape[-1])
    moved = weighted.reshape(*weighted.shape[:-3], -1, count) @ column_d.mT
    flux = normal_u[..., None, :]
    integral = column_p.mT
    row = row_d * flux
    coverage = row @ integral
    gradient = np.empty((*coverage.shape[:-2], 6, *sizes))
    gradient[..., :5, :, :] = moved.reshape(*moved.shape[:-2], 5, *sizes)
    gradient[..., 5, :, :] = sigma3 * (row @ column_d1.mT + (row_d2 * flux) @ integral)
    return coverage, gradient


def foot_points(
    shape_px: Array, du_px: Array, dv_px: Array, *, steps: int = 2
) -> tuple[Array, Array]:
    """Return the point of an ellipse that is nearest to each given point.

    shape_px : (..., 3) shape numbers of M. du_px, dv_px : (..., P) the points, as offsets from the
    centre.

    Returns cos t and sin t (..., P) of the nearest points x(t) = M (cos t, sin t). Newton's method
    on (p - x(t)) . x'(t) = 0 starts in the direction of the point p. It converges for points that
    are nearer to the ellipse than its smallest radius of curvature. Its steps turn the unit vector
    (cos t, sin t), which saves the trigonometric functions.
    """
    m11, m12, m22 = _columns(shape_px)
    c, s = m22 * du_px - m12 * dv_px, m11 * dv_px - m12 * du_px
    length = np.sqrt(c * c + s * s)
    c = np.where(length > 0.0, c, 1.0)
    shrink = 1.0 / np.where(length > 0.0, length, 1.0)
    c, s = c * shrink, s * shrink
    g11, g12, g22 = m11 * m11 + m12 * m12, m12 * (m11 + m22), m12 * m12 + m22 * m22
    least = -(m11 * m22 - m12 * m12)
    pu, pv = m11 * du_px + m12 * dv_px, m12 * du_px + m22 * dv_px
    for _ in range(steps):
        cs, cos2 = c * s, 2.0 * c * c - 1.0
        value = pv * c - pu * s + (g11 - g22) * cs - g12 * cos2
        slope = (g11 - g22) * cos2 + 4.0 * g12 * cs - pu * c - pv * s
        turn = -value / np.where(slope < 0.0, slope, least)
        shrink = 1.0 / np.sqrt(1.0 + turn * turn)
        c, s = (c - turn * s) * shrink, (s + turn * c) * shrink
    return c, s


def coverage_near_edge(
    du_px: Array, dv_px: Array, shape_px: Array, sigma_px: ArrayLike
) -> tuple[Array, Array]:
    """Return the coverage of pixels as `coverage_on_grid` does, by a faster expansion.

    du_px, dv_px : (..., P) offsets of the pixels from the centre. shape_px : (..., 3). sigma_px :
    (...) standard deviation s of the blur.

    Returns the coverage F (..., P) and its derivatives (..., 6, P) with respect to centre (2),
    shape (3) and sigma.

    The expansion is of third order in the blur divided by the edge's radius of curvature. With
    z = d / s the exact signed distance from the edge over the blur, k the curvature and k''
    its second derivative along the edge, both in units of s, the edge lies h = k x^2 / 2
    + k' x^3 / 6 + (k'' + 3 k^3) x^4 / 24 inside its tangent, and F is the mean of Phi(-z - h) over
    a normal x:

    F = Phi(-z) - (k / 2) phi + (3/8) k^2 z phi - ((k'' + 3 k^3) / 8 + (5/16) k^3 (z^2 - 1)) phi

    Good to 5e-4 for k < 0.25 (see :func:`largest_curvature`); the error is nearly even about the
    centre, which it moves by 1e-5 px. By the envelope theorem the distance moves by minus the
    normal motion of the foot point; the curvature's own change is left out of the derivatives
    (relative error k^2 / 2). Points deeper than 6 sigma are simply inside: their foot point need
    not be the nearest one.
    """
    m11, m12, m22 = _columns(shape_px)
    sigma = np.asarray(sigma_px, dtype=np.float64)[..., None]
    deep = approximate_distance_px(shape_px, du_px, dv_px) < -_DEEP_SIGMA * sigma
    c, s = foot_points(shape_px, du_px, dv_px)
    normal_u, normal_v = m22 * c - m12 * s, m11 * s - m12 * c
    speed2 = normal_u * normal_u + normal_v * normal_v
    shrink = 1.0 / np.sqrt(speed2)
    normal_u *= shrink
    normal_v *= shrink
    distance = (du_px - m11 * c - m12 * s) * normal_u + (dv_px - m12 * c - m22 * s) * normal_v
    bend, bend_along = _bend(m11, m12, m22, c, s, shrink, sigma)
    z = distance / sigma
    z2 = z * z
    density = np.exp(-0.5 * z2) * (1.0 / _ROOT_2PI)
    across = normal_u * normal_v
    fourth = _FOURTH / sigma**4 * (1.0 - 2.0 * across * across)
    pixel = fourth * z * (z2 - 3.0)
    half, bend2, bend3 = 0.5 * bend, 0.375 * bend * bend, bend * bend * bend
    even, bowl = 0.125 * bend_along + 0.375 * bend3, 0.3125 * bend3
    third = even + bowl * (z2 - 1.0)
    coverage = ndtr(-z) + density * (bend2 * z - half - third + pixel)
    density /= sigma
    by_distance = density * (
        z * (half + even + bowl * (z2 - 3.0))
        - 1.0
        + bend2 * (1.0 - z2)
        - fourth * (z2 * (z2 - 6.0) + 3.0)
    )
    by_sigma = density * (2.0 * bend2 * z - half - 3.0 * third - 4.0 * pixel) - z * by_distance
    gradient = np.empty((*z.shape[:-1], 6, z.shape[-1]))
    centre_u, centre_v = -by_distance * normal_u, -by_distance * normal_v
    motions = (centre_u, centre_v, centre_u * c, centre_u * s + centre_v * c, centre_v * s)
    for k, motion in enumerate((*motions, by_sigma)):
        gradient[..., k, :] = np.where(deep, 0.0, motion)
    return np.where(deep, 1.0, coverage), gradient


def _bend(
    m11: Array, m12: Array, m22: Array, c: Array, s: Array, shrink: Array, sigma: Array
) -> tuple[Array, Array]:
    """Return curvature times sigma, and its second derivative by arc length times sigma^3."""
    g11, g12, g22 = m11 * m11 + m12 * m12, m12 * (m11 + m22), m12 * m12 + m22 * m22
    cs2, cos2 = 2.0 * c * s, 2.0 * c * c - 1.0
    slope = (g11 - g22) * cs2 - 2.0 * g12 * cos2
    second = 2.0 * (g11 - g22) * cos2 + 4.0 * g12 * cs2
    shrink2 = shrink * shrink
    bend = (m11 * m22 - m12 * m12) * sigma * (shrink2 * shrink)
    scaled = sigma * shrink2
    along = -1.5 * bend * scaled * scaled * (second - 3.0 * slope * slope * shrink2)
    return bend, along


def semi_axes(shape_px: Array) -> tuple[Array, Array]:
    """Return the semi-axes a >= b [px], each (...), of (..., 3) shape numbers."""
    m11, m12, m22 = shape_px[..., 0], shape_px[..., 1], shape_px[..., 2]
    mean, half = 0.5 * (m11 + m22), np.hypot(0.5 * (m11 - m22), m12)
    return mean + half, mean - half


def largest_curvature(shape_px: Array) -> Array:
    """Return the largest curvature a / b^2 [1/px], (...), of (..., 3) shape numbers."""
    a, b = semi_axes(shape_px)
    return a / (b * b)
