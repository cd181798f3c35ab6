"""The image of a uniform ellipse: how much of each pixel's blurred footprint it covers.

An ellipse is ``centre + M (cos t, sin t)`` with M symmetric and positive definite, so its three
numbers ``shape = (m11, m12, m22)`` stay smooth when the ellipse becomes a circle. The eigenvalues
of M are the semi-axes. The point spread (Gaussian blur and square pixel) is a Gaussian of
``sigma^2 = blur^2 + 1/12`` with the pixel box's fourth cumulant, -1/120 per axis.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.estimator.dots.fit.kernels import coverages, ellipse_distances

PIXEL_VARIANCE_PX2 = 1.0 / 12.0


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


def matrix_from_shape(shape_px: ArrayLike) -> Array:
    """Return the symmetric matrices M (..., 2, 2) in px of shape numbers (..., 3)."""
    shape = np.asarray(shape_px, dtype=np.float64)
    return shape[..., [0, 1, 1, 2]].reshape(*shape.shape[:-1], 2, 2)


def extent_px(shape_px: Array) -> Array:
    """Return half the width and half the height (..., 2) in px of ellipses' bounding boxes.

    shape_px : (..., 3) shape numbers. The sides of the boxes are parallel to u and v.
    """
    return np.hypot(shape_px[..., :2], shape_px[..., 1:])


def approximate_distance_px(shape_px: Array, du_px: Array, dv_px: Array) -> Array:
    """Return the distances (P,) in px of pixels from an ellipse, to first order; positive outside.

    shape_px : (3,) shape numbers. du_px, dv_px : (P,) offsets from the centre.
    """
    out = np.empty(len(du_px))
    ellipse_distances(shape_px, du_px, dv_px, out)
    return out


def coverage_on_grid(
    u_px: Array, v_px: Array, centre_px: ArrayLike, shape_px: ArrayLike, sigma_px: ArrayLike
) -> tuple[Array, Array]:
    """Return how much of each pixel's blurred footprint an ellipse covers, exactly.

    u_px, v_px : columns (..., U) and rows (..., V) of the pixels, in steps of 1.
    centre_px : (..., 2).
    shape_px : (..., 3).
    sigma_px : (...) standard deviation of the blur.

    Returns the coverage F (..., V, U), 0 to 1, and its derivatives (..., 6, V, U) with respect to
    centre (2), shape (3) and sigma.

    By Gauss's theorem with the field (P(x - u) p(y - v), 0), p the one-dimensional point spread and
    P its integral, the convolution over the ellipse's area is an integral round its contour of a
    smooth periodic function: the trapezoid rule converges exponentially, here to about 1e-6.
    """
    centre, shape = np.asarray(centre_px, dtype=np.float64), np.asarray(shape_px, dtype=np.float64)
    sigma = np.asarray(sigma_px, dtype=np.float64)[..., None]
    theta = np.concatenate([centre, shape, sigma], -1)
    batch, size = theta.shape[:-1], (v_px.shape[-1], u_px.shape[-1])
    first = np.stack([u_px[..., 0], v_px[..., 0]], -1)
    first = np.array(np.broadcast_to(first, (*batch, 2)), np.float64).reshape(-1, 2)
    value, gradient = np.zeros((len(first), *size)), np.zeros((len(first), 6, *size))
    coverages(first, np.ascontiguousarray(theta.reshape(-1, 6)), value, gradient)
    return value.reshape(*batch, *size), gradient.reshape(*batch, 6, *size)


def semi_axes(shape_px: Array) -> tuple[Array, Array]:
    """Return the semi-axes a >= b [px], each (...), of (..., 3) shape numbers."""
    m11, m12, m22 = shape_px[..., 0], shape_px[..., 1], shape_px[..., 2]
    mean, half = 0.5 * (m11 + m22), np.hypot(0.5 * (m11 - m22), m12)
    return mean + half, mean - half
