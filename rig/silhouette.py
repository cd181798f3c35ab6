"""Silhouettes of a nearly ellipsoidal body in affine cameras.

The body is x(s) = centre + A s (1 + h(s)). Here s lies on the unit sphere, A is a symmetric matrix
(an ellipsoid with the moments Q = A A^T), and h is a sum of spherical harmonics of degree 3 and
higher. An affine camera maps the silhouette of the body in the same way as the body itself, so
everything is computed in the space of s. There the body is a perturbed unit sphere. To first order
its rim is the great circle perpendicular to the viewing direction, and the radial displacement of
the outline equals h along this circle, which is called the trace of h. A point on the circle is
W (cos phi, sin phi), where the columns of W (3, 2) are orthonormal.

Let h be isotropic and Gaussian, of degree l, with variance sigma^2 for each coefficient (harmonics
of unit mean square). Its covariance along the circle is sigma^2 (2 l + 1) P_l(cos) by the addition
theorem, so the variance of harmonic k of the trace is (2 l + 1) times the coefficient of cos k phi
in P_l(cos phi).
"""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array

TRACE_VARIANCE = {
    (3, 1): 21 / 8,
    (3, 3): 35 / 8,
    (4, 0): 81 / 64,
    (4, 2): 45 / 16,
    (4, 4): 315 / 64,
}
"""Variance of the coefficient of cos k phi (and of sin k phi) for sigma = 1, by (degree, k)."""

SYMMETRIC = np.zeros((6, 3, 3))
"""The symmetric matrices (6, 3, 3) of a single 1 in the upper triangle, row by row."""
for _k, (_i, _j) in enumerate(zip(*np.triu_indices(3))):
    SYMMETRIC[_k, _i, _j] = SYMMETRIC[_k, _j, _i] = 1.0

_SAMPLES = 8
_THINNEST = 0.05


def rim_frames(moments_mm2: Array, jacobian: Array, axes_px: Array) -> Array:
    """Return W (..., n, 3, 2) of n views: the rim on the unit sphere is W (cos phi, sin phi).

    phi is counted from the semi-axes of the outline: the image of W (1, 0) is the end of the first.

    moments_mm2 : Q (..., 3, 3) of the body.
    jacobian : (..., n, 2, 3) derivatives of the pixels by the point, in px/mm.
    axes_px : (..., n, 2, 2) E, whose columns are the semi-axes. With E E^T = J Q J^T the frame is
        A J^T (E E^T)^-1 E = A J^T E^-T; where outline and body differ a little, the nearest
        orthonormal columns are taken.
    """
    squares, axes = np.linalg.eigh(moments_mm2)
    root = (axes * np.sqrt(np.maximum(squares, 0.0))[..., None, :]) @ axes.mT
    frames = root[..., None, :, :] @ jacobian.mT @ np.linalg.inv(axes_px).mT
    # polar decomposition: the root of S = W^T W (2, 2) is (S + sqrt(det S) I) / trace of the root
    square = frames.mT @ frames
    det = np.sqrt(np.linalg.det(square))[..., None, None]
    trace = np.sqrt(np.trace(square, axis1=-2, axis2=-1)[..., None, None] + 2 * det)
    return np.asarray(frames @ np.linalg.inv((square + det * np.eye(2)) / trace))


def third_degree(directions: Array) -> Array:
    """Return the values (..., 7) of the 7 real spherical harmonics of degree 3.

    Each has a mean square of 1 over the sphere.

    directions : (..., 3) unit vectors.
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    zonal = [np.sqrt(7) / 2 * c * (5 * c * c - 3) for c in (x, y, z)]
    planar = [p * (q * q - r * r) for p, q, r in ((x, y, z), (y, z, x), (z, x, y))]
    mixed = [np.sqrt(105) / 2 * p for p in planar] + [np.sqrt(105) * x * y * z]
    return np.stack(zonal + mixed, -1)


def third_degree_traces(frames: Array) -> tuple[Array, Array]:
    """Return the harmonics of `third_degree` along the great circle W (cos phi, sin phi).

    frames : W (..., 3, 2), whose columns are orthonormal.
    Returns two arrays (..., 2, 7) for the 7 functions: the coefficients of (cos phi, sin phi) and
    those of (cos 3 phi, sin 3 phi). A function of degree 3 has no other harmonics on a great
    circle.
    """
    phi = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    circle = np.stack([np.cos(phi), np.sin(phi)])
    values = third_degree((frames @ circle).mT)
    first, third = (
        2 / _SAMPLES * np.stack([np.cos(k * phi), np.sin(k * phi)]) @ values for k in (1, 3)
    )
    return np.asarray(first), np.asarray(third)


def zonal_traces(projection: Array) -> tuple[Array, Array]:
    """Return the harmonics of P_3(s . n) along the great circle s = W (cos phi, sin phi).

    P_3 is the Legendre polynomial of degree 3, so the function is axisymmetric about the unit
    vector n.

    projection : (..., 2) q = W^T n.
    Returns two arrays (..., 2): the coefficients of (cos phi, sin phi), (15/8 |q|^2 - 3/2) q, and
    those of (cos 3 phi, sin 3 phi), 5/8 q^3 with q taken as a complex number.
    """
    x, y = projection[..., 0], projection[..., 1]
    first = (1.875 * (x * x + y * y) - 1.5)[..., None] * projection
    third = 0.625 * np.stack([x * (x * x - 3 * y * y), y * (3 * x * x - y * y)], -1)
    return first, third


def largest(moments: Array, direction: Array) -> Array:
    """Return moments + t direction (..., 3, 3) where the determinant, a parabola in t, is largest.

    Two views leave one direction of the moments open, a shear that neither of them sees.
    """
    size = np.trace(moments, axis1=-2, axis2=-1)[..., None, None] / 3
    down, here, up = (np.linalg.det(moments + t * size * direction) for t in (-1.0, 0.0, 1.0))
    bend = up + down - 2 * here
    t = np.where(bend < 0, (down - up) / (2 * np.where(bend < 0, bend, -1.0)), 0.0)
    return np.asarray(moments + t[..., None, None] * size * direction)


def proper(moments: Array) -> Array:
    """Return second moments (..., 3, 3) of a body that exists: no principal axis is too thin.

    Moments that were fitted to outlines which do not fit together can have negative eigenvalues.
    """
    squares, axes = proper_axes(moments)
    return np.asarray((axes * squares[..., None, :]) @ axes.mT)


def proper_axes(moments: Array) -> tuple[Array, Array]:
    """Return the squares (..., 3), ascending, and the directions (..., 3, 3), as columns, of the
    principal semi-axes of `proper`."""
    squares, axes = np.linalg.eigh(moments)
    return np.maximum(squares, _THINNEST**2 * np.abs(squares).max(-1, keepdims=True)), axes
