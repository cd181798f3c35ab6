"""The shape of a nearly ellipsoidal body from its silhouettes in two cameras.

The body is x(s) = centre + A s (1 + h(s)), s on the unit sphere, A symmetric (an ellipsoid), h a
sum of spherical harmonics of degree 3 and more. An affine camera maps the body's silhouette as it
maps the body, so everything is computed in the space of s. There the body is a perturbed unit
sphere. To first order its rim is the great circle perpendicular to the viewing direction, and the
outline's radial displacement is h along that circle (the trace of h). A point of the circle is
W (cos phi, sin phi).

An isotropic Gaussian h of degree l with variance sigma^2 per (unit mean square) coefficient has the
covariance sigma^2 (2 l + 1) P_l(cos) along the circle (addition theorem), so the variance of its
harmonic k is (2 l + 1) times the coefficient of cos k phi in P_l(cos phi).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array

TRACE_VARIANCE = {
    (3, 1): 21 / 8,
    (3, 3): 35 / 8,
    (4, 0): 81 / 64,
    (4, 2): 45 / 16,
    (4, 4): 315 / 64,
}
"""(degree, k) -> variance of cos k phi's (and sin k phi's) coefficient for sigma = 1."""

_SAMPLES = 8
_FLATTEST = 0.9


def third_degree(directions: Array) -> Array:
    """(..., 3) unit vectors -> (..., 7) real harmonics of degree 3, each of unit mean square."""
    x, y, z = np.moveaxis(directions, -1, 0)
    zonal = [np.sqrt(7) / 2 * c * (5 * c * c - 3) for c in (x, y, z)]
    planar = [p * (q * q - r * r) for p, q, r in ((x, y, z), (y, z, x), (z, x, y))]
    mixed = [np.sqrt(105) / 2 * p for p in planar] + [np.sqrt(105) * x * y * z]
    return np.stack(zonal + mixed, -1)


def third_degree_traces(frames: Array) -> tuple[Array, Array]:
    """Traces of `third_degree` on the circle W (cos phi, sin phi).

    frames : (..., 3, 2) orthonormal columns.  Returns two (..., 2, 7): the coefficients of
    (cos phi, sin phi) and of (cos 3 phi, sin 3 phi); the trace has no other harmonics.
    """
    phi = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    circle = np.stack([np.cos(phi), np.sin(phi)])
    values = third_degree((frames @ circle).mT)
    first, third = (
        2 / _SAMPLES * np.stack([np.cos(k * phi), np.sin(k * phi)]) @ values for k in (1, 3)
    )
    return np.asarray(first), np.asarray(third)


def zonal_traces(projection: Array) -> tuple[Array, Array]:
    """Traces of h(s) = P_3(s . n), axisymmetric about n.

    projection : (..., 2) q = W^T n, where the pole appears in the unit circle.  Returns two
    (..., 2) as `third_degree_traces`: (15/8 |q|^2 - 3/2) q, and 5/8 q^3, q taken as complex.
    """
    x, y = projection[..., 0], projection[..., 1]
    first = (1.875 * (x * x + y * y) - 1.5)[..., None] * projection
    third = 0.625 * np.stack([x * (x * x - 3 * y * y), y * (3 * x * x - y * y)], -1)
    return first, third


@dataclass(frozen=True)
class EllipsePair:
    """The silhouettes' ellipses of one ellipsoid in two affine cameras, in mm.

    shared : (..., 3) unit vector perpendicular to both viewing directions.
    sides : two (..., 3) unit vectors, each perpendicular to it and to one viewing direction.
    moments_mm2 : two (..., 2, 2), the ellipse's A A^T in (shared, side).
    rims : two (..., 2, 2), in (cos phi, sin phi): column 0 is where the rim on the unit sphere
        reaches farthest along the shared coordinate, column 1 a quarter turn from it, on the
        positive side.
    """

    shared: Array
    sides: tuple[Array, Array]
    moments_mm2: tuple[Array, Array]
    rims: tuple[Array, Array]

    def frames(self, coupling: Array) -> tuple[Array, Array]:
        """Two (..., 3, 2) W: a rim is W (cos phi, sin phi).

        Both rims contain the direction of the shared coordinate, the first unit vector here. The
        other direction is (0, 1, 0) for the first rim and (0, r, sqrt(1 - r^2)) for the second.
        Silhouettes do not determine the coupling r (...), see `coupling_of`.
        """
        zero, one = np.zeros_like(coupling), np.ones_like(coupling)
        second = np.stack([zero, coupling, np.sqrt(1 - coupling**2)], -1)
        across = (np.stack([zero, one, zero], -1), second)
        first = np.stack([one, zero, zero], -1)
        left, right = (np.stack([first, a], -1) @ rim.mT for a, rim in zip(across, self.rims))
        return left, right

    def coupling_of(self, moments_mm2: Array) -> Array:
        """(...): partial correlation of the two sides, given the shared coordinate, of A A^T."""
        basis = np.stack([self.shared, *self.sides], -2)
        return _coupling(basis @ moments_mm2 @ basis.mT)


def ellipse_pair(jacobians: tuple[Array, Array], axes_px: tuple[Array, Array]) -> EllipsePair:
    """The pair of silhouettes of one ellipsoid.

    jacobians : two (..., 2, 3), px per mm.  axes_px : two (..., 2, 2) whose columns are the
    ellipse's semi-axes.
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
    """(..., 3, 3) A A^T in mm^2 of the most spherical ellipsoid with these silhouettes.

    They determine five of its six parameters; both give the extent along the shared coordinate, of
    which the geometric mean is taken. The sixth parameter is the one with the largest
    det / trace^3.
    """
    inverse = np.linalg.inv(np.stack([pair.shared, *pair.sides], -2))
    moments = _joined(pair.moments_mm2)
    moments[..., 1, 2] = _most_spherical(moments, inverse.mT @ inverse)
    moments[..., 2, 1] = moments[..., 1, 2]
    return np.asarray(inverse @ moments @ inverse.mT)


def oblate_spheroid(pair: EllipsePair) -> tuple[Array, Array]:
    """The oblate spheroid nearest to these silhouettes: its pole (..., 3) from its centre, A A^T.

    The long semi-axis of every silhouette is the equator's radius; the short one gives the pole's
    inclination in that view up to a sign, which follows from the shared coordinate. Units mm.
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
    """(..., 2, 2) rows: extents along the shared coordinate and across -> `EllipsePair.rims`."""
    shared = extents[..., 0, :] / np.linalg.norm(extents[..., 0, :], axis=-1, keepdims=True)
    across = np.stack([-shared[..., 1], shared[..., 0]], -1)
    sign = np.sign((across * extents[..., 1, :]).sum(-1, keepdims=True))
    return np.stack([shared, sign * across], -1)


def _joined(flat: tuple[Array, Array]) -> Array:
    """(..., 3, 3) second moments in the basis (shared, first's side, second's side)."""
    shared2 = np.sqrt(flat[0][..., 0, 0] * flat[1][..., 0, 0])
    moments = np.zeros((*shared2.shape, 3, 3))
    moments[..., 0, 0] = shared2
    for c, own in enumerate(flat, start=1):
        moments[..., c, c] = own[..., 1, 1]
        moments[..., 0, c] = own[..., 0, 1] * np.sqrt(shared2 / own[..., 0, 0])
        moments[..., c, 0] = moments[..., 0, c]
    return moments


def _most_spherical(moments: Array, gram: Array) -> Array:
    """The entry (1, 2) that makes det(moments) / trace(gram moments)^3 stationary, det > 0."""
    p, b, c = moments[..., 0, 0], moments[..., 0, 1], moments[..., 0, 2]
    d, e = moments[..., 1, 1], moments[..., 2, 2]
    det0, det1, det2 = p * d * e - b * b * e - c * c * d, 2 * b * c, -p
    trace0, trace1 = (gram * moments).sum((-1, -2)), 2 * gram[..., 1, 2]
    square = -trace1 * det2
    linear = 2 * (det2 * trace0 - det1 * trace1)
    constant = det1 * trace0 - 3 * trace1 * det0
    root = np.sqrt(np.maximum(linear**2 - 4 * square * constant, 0))
    return np.asarray(-2 * constant / (linear + np.copysign(root, linear)))
