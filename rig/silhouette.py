"""Computes the shape of a nearly ellipsoidal body from its silhouettes in two cameras.

The body is x(s) = centre + A s (1 + h(s)). Here s lies on the unit sphere, A is a symmetric matrix
(an ellipsoid), and h is a sum of spherical harmonics of degree 3 and higher. An affine camera maps
the silhouette of the body in the same way as the body itself, so everything is computed in the
space of s. There the body is a perturbed unit sphere. To first order its rim is the great circle
perpendicular to the viewing direction, and the radial displacement of the outline equals h along
this circle, which is called the trace of h. A point on the circle is W (cos phi, sin phi), where
the columns of W (3, 2) are orthonormal.

Let h be isotropic and Gaussian, of degree l, with variance sigma^2 for each coefficient (harmonics
of unit mean square). Its covariance along the circle is sigma^2 (2 l + 1) P_l(cos) by the addition
theorem, so the variance of harmonic k of the trace is (2 l + 1) times the coefficient of cos k phi
in P_l(cos phi).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array
from telerig.rig.camera import Camera

TRACE_VARIANCE = {
    (3, 1): 21 / 8,
    (3, 3): 35 / 8,
    (4, 0): 81 / 64,
    (4, 2): 45 / 16,
    (4, 4): 315 / 64,
}
"""Variance of the coefficient of cos k phi (and of sin k phi) for sigma = 1, by (degree, k)."""

_SAMPLES = 8
_FLATTEST = 0.9
_STEP_MM = 0.01
_THINNEST = 0.05


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


@dataclass(frozen=True)
class EllipsePair:
    """The elliptic silhouettes of one ellipsoid in two affine cameras, in mm.

    shared : (..., 3) unit vector perpendicular to both viewing directions; both cameras measure the
        coordinate along it.
    sides : two arrays (..., 3) of unit vectors, perpendicular to ``shared`` and to the viewing
        direction of each camera.
    moments_mm2 : two arrays (..., 2, 2), for each camera the matrix M of its ellipse x^T M^-1 x = 1
        in the axes (shared, side).
    rims : two arrays (..., 2, 2). In each camera the body's rim is the image of a great circle of
        the unit sphere with the angle phi; the columns are two of its points as (cos phi, sin phi).
        Column 0 is the point that reaches farthest along the shared coordinate. Column 1 lies a
        quarter turn from it, on the positive side.
    """

    shared: Array
    sides: tuple[Array, Array]
    moments_mm2: tuple[Array, Array]
    rims: tuple[Array, Array]

    def frames(self, coupling: Array) -> tuple[Array, Array]:
        """Return for each camera W (..., 3, 2): its rim on the unit sphere is W (cos phi, sin phi).

        The axes of the sphere are chosen such that the first one is the shared coordinate and the
        rim of the first camera lies in the plane of (1, 0, 0) and (0, 1, 0). That of the second
        camera lies in the plane of (1, 0, 0) and (0, r, sqrt(1 - r^2)).

        coupling : (...) the number r, see `coupling_of`.
        """
        zero, one = np.zeros_like(coupling), np.ones_like(coupling)
        second = np.stack([zero, coupling, np.sqrt(1 - coupling**2)], -1)
        across = (np.stack([zero, one, zero], -1), second)
        first = np.stack([one, zero, zero], -1)
        left, right = (np.stack([first, a], -1) @ rim.mT for a, rim in zip(across, self.rims))
        return left, right

    def coupling_of(self, moments_mm2: Array) -> Array:
        """Return the coupling (...) of ellipsoids x^T M^-1 x = 1 with M (..., 3, 3) in mm^2.

        It is the partial correlation of the two side coordinates, given the shared coordinate, if M
        is read as a covariance.
        """
        basis = np.stack([self.shared, *self.sides], -2)
        return _coupling(basis @ moments_mm2 @ basis.mT)


def ellipse_pair(jacobians: tuple[Array, Array], axes_px: tuple[Array, Array]) -> EllipsePair:
    """Return the pair of silhouettes that one ellipsoid has in two cameras.

    jacobians : for each camera (..., 2, 3), the derivative of the pixel with respect to the point,
    in px/mm.
    axes_px : for each camera (..., 2, 2), whose columns are the semi-axes of the ellipse in the
    image.
    """
    across = [np.cross(j[..., 0, :], j[..., 1, :]) for j in jacobians]
    view = [d / np.linalg.norm(d, axis=-1, keepdims=True) for d in across]
    shared = np.cross(view[0], view[1])
    shared /= np.linalg.norm(shared, axis=-1, keepdims=True)
    side = [np.cross(shared, d) for d in view]
    rims, moments = [], []
    for jacobian, axes, alpha in zip(jacobians, axes_px, side):
        back = jacobian.mT @ np.linalg.inv(jacobian @ jacobian.mT)
        extents = np.stack([shared, alpha], -2) @ back @ axes
        rims.append(_rim(extents))
        moments.append(extents @ extents.mT)
    return EllipsePair(shared, (side[0], side[1]), (moments[0], moments[1]), (rims[0], rims[1]))


def most_spherical(pair: EllipsePair) -> Array:
    """Return the most spherical of all ellipsoids that have these silhouettes.

    Two silhouettes determine five of the six parameters of an ellipsoid. Both give the extent along
    the shared coordinate; their geometric mean is used. The sixth parameter is chosen such that
    det(M) / trace(M)^3 is largest.

    Returns M (..., 3, 3) in mm^2 of the ellipsoid x^T M^-1 x = 1, in the axes of the rig frame.
    """
    inverse = np.linalg.inv(np.stack([pair.shared, *pair.sides], -2))
    moments = _joined(pair.moments_mm2)
    moments[..., 1, 2] = _most_spherical(moments, inverse.mT @ inverse)
    moments[..., 2, 1] = moments[..., 1, 2]
    return np.asarray(inverse @ moments @ inverse.mT)


def oblate_spheroid(pair: EllipsePair) -> tuple[Array, Array]:
    """Return the oblate spheroid whose silhouettes are nearest to the given ones.

    The long semi-axis of every silhouette is the radius of the equator. The short one gives the
    inclination of the pole in that view except for its sign, which follows from the shared
    coordinate.

    Returns the polar semi-axis (..., 3) in mm as a vector in the rig frame, and M (..., 3, 3) in
    mm^2 of the spheroid x^T M^-1 x = 1.
    """
    equator2, leaning = [], []
    for moments in pair.moments_mm2:
        values, vectors = np.linalg.eigh(moments)
        equator2.append(values[..., 1])
        leaning.append(np.sqrt(values[..., 1] - values[..., 0])[..., None] * vectors[..., 0])
    radius2 = (equator2[0] + equator2[1]) / 2
    sign = np.where(leaning[0][..., 0] * leaning[1][..., 0] < 0, -1.0, 1.0)
    second = sign[..., None] * leaning[1]
    right = [(leaning[0][..., 0] + second[..., 0]) / 2, leaning[0][..., 1], second[..., 1]]
    basis = np.stack([pair.shared, *pair.sides], -2)
    lean = np.linalg.solve(basis, np.stack(right, -1)[..., None])[..., 0]
    raw2 = (lean * lean).sum(-1)
    length2 = np.minimum(raw2, _FLATTEST * radius2)
    axis = lean / np.sqrt(raw2 + 1e-12 * radius2)[..., None]
    flat = length2[..., None, None] * axis[..., :, None] * axis[..., None, :]
    moments = radius2[..., None, None] * np.eye(3) - flat
    return axis * np.sqrt(radius2 - length2)[..., None], moments


def _coupling(moments: Array) -> Array:
    partial = (
        moments[..., 1:, 1:] - moments[..., 1:, :1] * moments[..., :1, 1:] / moments[..., :1, :1]
    )
    return np.asarray(partial[..., 0, 1] / np.sqrt(partial[..., 0, 0] * partial[..., 1, 1]))


def _rim(extents: Array) -> Array:
    """Return `EllipsePair.rims` (..., 2, 2) from extents along shared coordinate and side."""
    shared = extents[..., 0, :] / np.linalg.norm(extents[..., 0, :], axis=-1, keepdims=True)
    across = np.stack([-shared[..., 1], shared[..., 0]], -1)
    sign = np.sign((across * extents[..., 1, :]).sum(-1, keepdims=True))
    return np.stack([shared, sign * across], -1)


def _joined(flat: tuple[Array, Array]) -> Array:
    """Return second moments (..., 3, 3) in the axes (shared, first side, second side)."""
    shared2 = np.sqrt(flat[0][..., 0, 0] * flat[1][..., 0, 0])
    moments = np.zeros((*shared2.shape, 3, 3))
    moments[..., 0, 0] = shared2
    for c, own in enumerate(flat, start=1):
        moments[..., c, c] = own[..., 1, 1]
        moments[..., 0, c] = own[..., 0, 1] * np.sqrt(shared2 / own[..., 0, 0])
        moments[..., c, 0] = moments[..., 0, c]
    return moments


def _most_spherical(moments: Array, gram: Array) -> Array:
    """Return the second moment between both sides that makes the ellipsoid most spherical.

    It makes det(moments) / trace(gram moments)^3 stationary, with a positive determinant. moments :
    (..., 3, 3) as `_joined`. gram : (..., 3, 3), because these axes are not orthogonal.
    """
    p, b, c = moments[..., 0, 0], moments[..., 0, 1], moments[..., 0, 2]
    d, e = moments[..., 1, 1], moments[..., 2, 2]
    det0, det1, det2 = p * d * e - b * b * e - c * c * d, 2 * b * c, -p
    trace0, trace1 = (gram * moments).sum((-1, -2)), 2 * gram[..., 1, 2]
    square = -trace1 * det2
    linear = 2 * (det2 * trace0 - det1 * trace1)
    constant = det1 * trace0 - 3 * trace1 * det0
    root = np.sqrt(np.maximum(linear**2 - 4 * square * constant, 0))
    return np.asarray(-2 * constant / (linear + np.copysign(root, linear)))


def ellipsoids_from_outlines(
    cameras: tuple[Camera, Camera], points_mm: Array, ellipses: Array
) -> Array:
    """Return the ellipsoids x^T Q^-1 x = 1 that have the given outlines in two cameras.

    points_mm : (N, 3) centres in the rig frame.
    ellipses : (N, 2, 3) for each point and camera the two semi-axes in px and the angle in rad.

    Returns Q (N, 3, 3) in mm^2, in the axes of the rig frame.

    A parallel projection P maps an ellipsoid Q to the ellipse P Q P^T, so the two outlines are six
    linear equations. They leave one of the six numbers of Q undetermined, a shear that neither
    camera sees. Of all ellipsoids that fit, the one of largest volume is taken (the determinant is
    quadratic along that direction).
    """
    upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    basis = np.zeros((6, 3, 3))
    for k, (i, j) in enumerate(upper):
        basis[k, i, j] = basis[k, j, i] = 1.0
    rows, targets = [], []
    for index, camera in enumerate(cameras):
        steps = _STEP_MM * np.eye(3)
        plus, minus = (camera.project(points_mm[:, None] + s * steps) for s in (1, -1))
        by_point = np.swapaxes(plus - minus, 1, 2) / (2 * _STEP_MM)
        seen = by_point[:, None] @ basis @ np.swapaxes(by_point, 1, 2)[:, None]
        rows.append(seen[..., [0, 0, 1], [0, 1, 1]].swapaxes(1, 2))
        targets.append(_ellipse_matrix(ellipses[:, index])[..., [0, 0, 1], [0, 1, 1]])
    system, target = np.concatenate(rows, 1), np.concatenate(targets, 1)
    fitted = (np.linalg.pinv(system, rcond=1e-3) @ target[..., None])[..., 0]
    open_direction = np.linalg.svd(system)[2][:, -1]
    body = np.einsum("nk,kij->nij", fitted, basis)
    return _proper(_largest(body, np.einsum("nk,kij->nij", open_direction, basis)))


def _ellipse_matrix(ellipse: Array) -> Array:
    cos, sin = np.cos(ellipse[:, 2]), np.sin(ellipse[:, 2])
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    return np.asarray(turn * ellipse[:, None, :2] ** 2 @ np.swapaxes(turn, 1, 2))


def _largest(body: Array, direction: Array) -> Array:
    """Return body + t direction where its determinant, a parabola in t, is largest."""
    unit = np.trace(body, axis1=1, axis2=2)[:, None, None] / 3 * direction
    down, here, up = (np.linalg.det(body + t * unit) for t in (-1.0, 0.0, 1.0))
    bend = up + down - 2 * here
    t = np.where(bend < 0, (down - up) / (2 * np.where(bend < 0, bend, -1.0)), 0.0)
    return np.asarray(body + t[:, None, None] * unit)


def _proper(body: Array) -> Array:
    """Return the body with its thinnest axis limited: outlines may not fit together."""
    squares, axes = np.linalg.eigh(body)
    squares = np.maximum(squares, _THINNEST**2 * np.abs(squares).max(1, keepdims=True))
    return np.asarray(axes * squares[:, None] @ np.swapaxes(axes, 1, 2))
