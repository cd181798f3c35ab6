"""Size, aspect ratio and pole of a bubble from its two outlines.

Two outlines determine five of an ellipsoid's six parameters: each gives three, and both measure the
extent along the shared coordinate. A bubble is nearly a spheroid, which has four. The model is a
spheroid with two additional numbers t, the logarithmic deviations of the equatorial semi-axes from
each other. Their prior N(0, triaxial^2) is learned from all bubbles of a run (`learn_deviations`).
The covariance then contains what two views do not determine, and a chi-square with 2 degrees of
freedom tests the spheroid.

An outline that is mapped to the unit circle by the axes of its ellipse deviates from another
ellipse by a radial displacement g0 + g1 cos 2 phi + g2 sin 2 phi. White noise along the outline
gives all coefficients of cos and sin the same variance v, and g0 half of it. Modes of degree 4 of
the body do nearly the same (81/64 and 45/16 of their variance), but are correlated between the
views. v follows from the stated covariance of the centre, which is of order 1.

Two effects of second order make outlines larger than the volume. They are corrected in `_best`
(docs/decisions/037-bubbles-from-two-outlines.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array
from telerig.estimator.bubbles.shape.volume_centroid import (
    Outlines,
    learned_sigma,
    outlines_from_table,
    rim_excess,
)
from telerig.rig import silhouette
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian

PARAMETERS = ("log_size", "log_aspect", "lean_1", "lean_2", "triaxial_1", "triaxial_2")
"""Columns of `Spheroids.covariance`: log of d_eq, log of the aspect ratio, the turn of the pole
about two axes (rad), and the deviation of the equatorial axes."""

DEFAULT_TRIAXIAL = 0.01
_DEFAULT_WEIGHT = 1.0  # in outlines' pairs, of the default in what a run learns
_LEAST_EXCESS = 1.5e-4
_WHITE = np.diag([0.5, 1.0, 1.0, 0.5, 1.0, 1.0])
_BODY = np.array(
    [
        [324.0, 0.0, 0.0, 121.5, -270.0, 0.0],
        [0.0, 720.0, 0.0, -270.0, 360.0, 0.0],
        [0.0, 0.0, 720.0, 0.0, 0.0, 0.0],
        [121.5, -270.0, 0.0, 324.0, 0.0, 0.0],
        [-270.0, 360.0, 0.0, 0.0, 720.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0, 720.0],
    ]
) / 735.0  # fmt: skip
"""Covariances of g0, g1, g2 of both outlines: of white noise in each of them, and of independent
modes of degree 4 seen at right angles, from 9 P4(cos phi cos phi'). Extents along the shared
coordinate differ by a variance of 3 in both."""
_LEAST_FOR_LEARNING = 8
_TRIM, _TRIMMED = 0.02, 0.873
"""Share of squares that is left out, and the mean of the others for normal errors."""
_CONTRADICTION = 4.0
_STEPS, _SMALL_STEP = 15, 1e-5
_MOST_FOR_LEARNING, _PIECE = 4_000, 20_000
_PROLATE_COST = 8.0
_UPRIGHT_RAD = 0.4
_LOG_ASPECT = 0.5
"""What decides between bodies with the same outlines: how much more an oblate body is expected, and
standard deviations of its pole from the vertical and of its log aspect ratio."""

_NEAR_SPHERE = 4.0
"""Bias of a log aspect ratio, times itself over its variance: near a sphere the five components of
its deformation are all noise, and the fit takes the largest for the flattening."""

_LOOSE = np.array([0.0, 0.25, 1.0, 1.0])
"""Prior precision of a single body's log size, log aspect ratio and pole."""


@dataclass(frozen=True)
class Deviations:
    """Standard deviations of a run's bubbles from spheroids, and of their outlines from ellipses.

    triaxial : of both numbers t.
    excess : of the coefficients of cos 2 phi and sin 2 phi beyond the stated noise, relative to the
        radius.
    pairs : number of pairs of outlines that were used.
    """

    triaxial: float = DEFAULT_TRIAXIAL
    excess: float = _LEAST_EXCESS
    pairs: int = 0


@dataclass(frozen=True)
class Spheroids:
    """Fitted spheroids of M bubbles in the rig frame; NaN if an outline is missing or incomplete.

    d_eq_mm : (M,) diameter of the sphere of equal volume.
    aspect : (M,) equatorial over polar semi-axis.
    pole : (M, 3) unit vector along the polar axis, of arbitrary sign.
    frame : (M, 3, 3) columns: two equatorial axes and the pole; ``lean_1`` and ``lean_2`` of
        `PARAMETERS` are rotations of the pole about the equatorial axes.
    covariance : (M, 6, 6) of `PARAMETERS`.
    chi2 : (M,) misfit of a spheroid with t = 0, with 2 degrees of freedom.
    """

    d_eq_mm: Array
    aspect: Array
    pole: Array
    frame: Array
    covariance: Array
    chi2: Array

    @property
    def equator_mm(self) -> Array:
        """Geometric mean of the two equatorial semi-axes (M,)."""
        return np.asarray(self.d_eq_mm / 2 * np.cbrt(self.aspect))

    @property
    def polar_mm(self) -> Array:
        """Polar semi-axis (M,)."""
        return np.asarray(self.equator_mm / self.aspect)


def paired_outlines(
    first: pd.DataFrame, second: pd.DataFrame, cameras: tuple[Camera, Camera]
) -> tuple[Outlines, Outlines]:
    """Return the outlines of two detection tables, in which equal rows belong to one bubble."""
    left, right = (
        outlines_from_table(table, camera.image_size_px)
        for table, camera in zip((first, second), cameras)
    )
    return left, right


def fit_spheroids(
    outlines: tuple[Outlines, Outlines],
    points_mm: Array,
    cameras: tuple[Camera, Camera],
    up: Array,
    deviations: Deviations | None = None,
) -> tuple[Spheroids, Deviations]:
    """Fit a spheroid to both outlines of each of M bubbles.

    An oblate spheroid with vertical pole can have the same two outlines as a prolate one with
    horizontal pole midway between the views; the one that is more probable for a rising bubble is
    returned.

    points_mm : (M, 3) positions of the bubbles in the rig frame.
    up : (3,) unit vector against gravity in the rig frame.
    deviations : None to learn them from these outlines.

    Returns the spheroids, and the deviations that were used.
    """
    good = np.flatnonzero(outlines[0].entire & outlines[1].entire & np.isfinite(points_mm).all(-1))
    sigma = learned_sigma(outlines)

    def views_of(rows: NDArray[Any]) -> _Views:
        pair = (outlines[0].rows(rows), outlines[1].rows(rows))
        _, jacobian = stacked_jacobian(cameras, points_mm[rows])
        return _Views.of(pair, (jacobian[:, :2], jacobian[:, 2:]), sigma)

    if deviations is None:
        some = np.linspace(0, len(good) - 1, min(len(good), _MOST_FOR_LEARNING)).astype(int)
        deviations = learn_deviations(views_of(good[some]), up)
    pieces = np.array_split(good, max(1, -(-len(good) // _PIECE)))
    found = [_best(views_of(piece), deviations, up) for piece in pieces]
    return _scattered(found, good, len(points_mm)), deviations


@dataclass(frozen=True)
class _Views:
    """M pairs of outlines.

    measure : (M, 6, 9) linear map from the moments A A^T of a body to g0, g1, g2 of both outlines,
        in the unit circles of the measured ones.
    noise : two (M,) variances of g1.
    ellipses : the pairs in mm.
    rim_excess : (M,) see `rim_excess`.
    """

    measure: Array
    noise: tuple[Array, Array]
    ellipses: silhouette.EllipsePair
    rim_excess: Array

    @staticmethod
    def of(pair: tuple[Outlines, Outlines], jacobians: tuple[Array, Array], sigma: Array) -> _Views:
        inverse = [np.linalg.inv(o.axes_px) for o in pair]
        noise = [
            np.einsum("mij,mjk,mik->m", a, o.covariance_px2, a) / 2 for a, o in zip(inverse, pair)
        ]
        parts = []
        for a, j in zip(inverse, jacobians):
            u, v = np.moveaxis(a @ j, -2, 0)
            uu, vv, uv = (p[:, :, None] * q[:, None, :] for p, q in ((u, u), (v, v), (u, v)))
            parts += [(uu + vv) / 4, (uu - vv) / 4, uv / 2]
        measure = np.stack(parts, 1).reshape(-1, 6, 9)
        ellipses = silhouette.ellipse_pair(jacobians, (pair[0].axes_px, pair[1].axes_px))
        return _Views(measure, (noise[0], noise[1]), ellipses, rim_excess(pair, sigma))

    def extents(self) -> tuple[Array, Array]:
        """Return the log ratio (M,) of the extents along the shared coordinate, and its noise
        variance.

        A displacement along one direction is g0 plus a unit combination of g1 and g2, with variance
        3/2 v.
        """
        first, second = (np.log(m[..., 0, 0]) / 2 for m in self.ellipses.moments_mm2)
        return first - second, 1.5 * (self.noise[0] + self.noise[1])

    def precision(self, deviations: Deviations) -> Array:
        """Return the inverse covariance (M, 6, 6) of g of both outlines.

        If the two extents contradict each other, for example because part of an outline belongs to
        another bubble, the noise is enlarged accordingly.
        """
        ratio, variance = self.extents()
        contradicted = ratio**2 > _CONTRADICTION**2 * (variance + 3 * deviations.excess**2)
        noise = np.stack(self.noise, -1) + np.where(contradicted, ratio**2 / 3, 0.0)[:, None]
        noise = np.repeat(noise, 3, -1)
        covariance = noise[:, None, :] * _WHITE + deviations.excess**2 * _BODY
        return np.asarray(np.linalg.inv(covariance))

    def deviation(self, moments: Array) -> Array:
        """Return g of both outlines (M, 6) for bodies with moments A A^T (M, 3, 3).

        For k changes of the moments (M, k, 3, 3) it returns (M, 6, k).
        """
        if moments.ndim == 3:
            return np.asarray((self.measure @ moments.reshape(-1, 9, 1))[..., 0])
        return np.asarray(self.measure @ moments.reshape(*moments.shape[:2], 9).mT)


_ROUND = np.array([0.5, 0.0, 0.0, 0.5, 0.0, 0.0])
"""`_Views.deviation` of a body whose outlines are those that were measured."""


def _moments(frame: Array, value: Array) -> Array:
    """Return the moments A A^T (M, 3, 3) of bodies.

    frame : (M, 3, 3).  value : (M, 4) log size, log aspect ratio, t.
    """
    size, aspect, t1, t2 = value.T
    t = np.hypot(t1, t2) + 1e-300
    even, odd = np.cosh(2 * t), np.sinh(2 * t) / t
    plane = np.exp(2 * (size + aspect / 3))
    body = np.zeros((len(value), 3, 3))
    body[:, 0, 0], body[:, 1, 1] = plane * (even + odd * t1), plane * (even - odd * t1)
    body[:, 0, 1] = body[:, 1, 0] = plane * odd * t2
    body[:, 2, 2] = np.exp(2 * (size - 2 * aspect / 3))
    return np.asarray(frame @ body @ frame.mT)


def _tangents(frame: Array, moments: Array) -> Array:
    """Return derivatives (M, 6, 3, 3) of the moments by the `PARAMETERS`, for small t."""
    e1, e2, n = (frame[:, :, i] for i in range(3))

    def outer(a: Array, b: Array) -> Array:
        product = a[:, :, None] * b[:, None, :]
        return np.asarray(product + product.mT) / 2

    shape = (outer(e1, e1) + outer(e2, e2) - 2 * outer(n, n)) / 3
    stretches = [np.broadcast_to(np.eye(3), moments.shape), shape]
    stretches += [outer(e1, e1) - outer(e2, e2), 2 * outer(e1, e2)]
    changes = [s @ moments + moments @ s for s in stretches]
    # the pole moves towards an equatorial axis, and that axis away from it
    for axis in (e2, e1):
        turn = axis[:, :, None] * n[:, None, :] - n[:, :, None] * axis[:, None, :]
        changes.insert(2, turn @ moments - moments @ turn)
    return np.stack(changes, 1)


def _frame(pole: Array) -> Array:
    """Return right-handed frames (M, 3, 3) whose third column is the pole (M, 3)."""
    start = np.where(np.abs(pole[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    first = start - pole * (start * pole).sum(-1, keepdims=True)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(pole, first), pole], -1)


@dataclass(frozen=True)
class _Fit:
    """A fit of M bodies: frame (M, 3, 3), value (M, 4) of `_moments`, covariance (M, 6, 6), cost
    (M,).
    """

    frame: Array
    value: Array
    covariance: Array
    cost: Array


def _fit(views: _Views, start: tuple[Array, Array, Array], deviations: Deviations) -> _Fit:
    """Maximise the posterior by Gauss-Newton steps.

    start : pole (M, 3), log size (M,), log aspect ratio (M,).
    """
    pole, size, aspect = start
    frame = _frame(pole)
    value = np.stack([size, aspect, 0 * size, 0 * size], -1)
    weight = views.precision(deviations)
    prior = np.concatenate([_LOOSE, np.full(2, deviations.triaxial**-2)])
    covariance = np.zeros((len(pole), 6, 6))
    live = np.arange(len(pole))
    for _ in range(_STEPS):
        some = replace(views, measure=views.measure[live])
        moments = _moments(frame[live], value[live])
        miss, certain = _ROUND - some.deviation(moments), weight[live]
        slope = some.deviation(_tangents(frame[live], moments))
        weighted = slope.mT @ certain
        covariance[live] = np.linalg.inv(weighted @ slope + np.diag(prior))
        right = (weighted @ miss[..., None])[..., 0]
        right[:, 1] -= prior[1] * value[live, 1]
        right[:, 4:] -= prior[4:] * value[live, 2:]
        step = np.clip((covariance[live] @ right[..., None])[..., 0], -0.5, 0.5)
        value[live] += step[:, [0, 1, 4, 5]]
        lean = np.concatenate([step[:, 2:4], np.ones((len(step), 1))], -1)
        leaned = (frame[live] @ lean[..., None])[..., 0]
        leaned /= np.linalg.norm(leaned, axis=-1, keepdims=True)
        frame[live] = _carried(frame[live], leaned)
        live = live[np.abs(step).max(-1) > _SMALL_STEP]
        if not len(live):
            break
    miss = _ROUND - views.deviation(_moments(frame, value))
    cost = np.einsum("mi,mij,mj->m", miss, weight, miss) + (prior[4:] * value[:, 2:] ** 2).sum(-1)
    return _Fit(frame, value, covariance, cost)


def _carried(frame: Array, pole: Array) -> Array:
    """Rotate frames by the smallest angle that makes their third column the pole."""
    first = frame[:, :, 0] - pole * (frame[:, :, 0] * pole).sum(-1, keepdims=True)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(pole, first), pole], -1)


def _starts(ellipses: silhouette.EllipsePair) -> list[tuple[Array, Array, Array]]:
    """Return start values (pole, log size, log aspect ratio) of three local optima.

    They are an oblate spheroid, its mirror image about the shared coordinate in the second view,
    and a prolate spheroid.
    """
    pole, moments = silhouette.oblate_spheroid(ellipses)
    pole = pole / np.linalg.norm(pole, axis=-1, keepdims=True)
    basis = np.stack([ellipses.shared, *ellipses.sides], -2)
    lean = (basis @ pole[..., None])[..., 0] * [1.0, 1.0, -1.0]
    mirrored = np.linalg.solve(basis, lean[..., None])[..., 0]
    mirrored /= np.linalg.norm(mirrored, axis=-1, keepdims=True)
    values = np.log(np.linalg.eigvalsh(moments)) / 2
    size, flat = values.mean(-1), values[:, 2] - values[:, 0]
    values, vectors = np.linalg.eigh(silhouette.most_spherical(ellipses))
    logs = np.log(values) / 2
    long = logs[:, :2].mean(-1) - logs[:, 2]
    return [(pole, size, flat), (mirrored, size, flat), (vectors[..., 2], logs.mean(-1), long)]


def _best(views: _Views, deviations: Deviations, up: Array) -> Spheroids:
    """Return the most probable local optimum; the covariance includes the others by probability."""
    fits = [_fit(views, start, deviations) for start in _starts(views.ellipses)]
    cost = np.stack([f.cost + _unusual(f, up) for f in fits])
    best = np.argmin(cost, 0)
    rows = np.arange(len(best))
    chosen = _Fit(
        *(np.stack([getattr(f, name) for f in fits])[best, rows] for name in _Fit.__annotations__)
    )
    weight = np.exp(-(cost - cost[best, rows]) / 2)
    weight /= weight.sum(0)
    covariance = chosen.covariance.copy()
    for fit, share in zip(fits, weight):
        sign = np.sign((fit.frame[:, :, 2] * chosen.frame[:, :, 2]).sum(-1, keepdims=True))
        lean = (chosen.frame.mT @ (sign * fit.frame[:, :, 2])[..., None])[:, :2, 0]
        apart = np.concatenate([fit.value[:, :2] - chosen.value[:, :2], lean], -1)
        covariance[:, :4, :4] += share[:, None, None] * apart[:, :, None] * apart[:, None, :]
    size, aspect = chosen.value[:, 0], chosen.value[:, 1]
    # the sphere has no pole, and no flattening that could be negative
    blur = _NEAR_SPHERE * chosen.covariance[:, 1, 1] / np.maximum(aspect**2, 1e-12)
    covariance[:, 1, 1] += np.minimum(blur, 1.0) ** 2 * aspect**2
    covariance[:, [2, 3], [2, 3]] += np.minimum(blur, 1.0)[:, None] ** 2
    # a rim reaches farther than the body's mean surface, by an amount as uncertain as it is large
    covariance[:, 0, 0] += views.rim_excess**2
    # what t is left open makes the expected moments of the equator larger than those at its mean
    unseen = np.trace(chosen.covariance[:, 4:, 4:], axis1=1, axis2=2)
    wider = np.array([2 / 3, 1.0]) * unseen[:, None]
    covariance[:, :2, :2] += 2 * wider[:, :, None] * wider[:, None, :]
    size, aspect = size - views.rim_excess - wider[:, 0], aspect - wider[:, 1]
    chi2 = np.min([_spheroid_misfit(views, f, deviations)[0] for f in fits[:2]], 0)
    return Spheroids(
        2 * np.exp(size), np.exp(aspect), chosen.frame[:, :, 2], chosen.frame, covariance, chi2
    )


def _unusual(fit: _Fit, up: Array) -> Array:
    """Return minus twice the log prior (M,) of aspect ratio and tilt, up to a constant."""
    aspect, upright = fit.value[:, 1], np.abs(fit.frame[:, :, 2] @ up)
    tilt = np.arccos(np.clip(upright, 0, 1))
    prolate = np.where(aspect < 0, _PROLATE_COST, 0.0)
    return np.asarray(prolate + (aspect / _LOG_ASPECT) ** 2 + (tilt / _UPRIGHT_RAD) ** 2)


def _spheroid_misfit(views: _Views, fit: _Fit, deviations: Deviations) -> tuple[Array, Array]:
    """Return the chi-square (M,) of a spheroid with t = 0, and its slope (M,) by the
    variance of t."""
    weight = views.precision(deviations)
    value = fit.value * [1.0, 1.0, 0.0, 0.0]
    moments = _moments(fit.frame, value)
    miss = _ROUND - views.deviation(moments)
    changes = _tangents(fit.frame, moments)
    slope = views.deviation(changes)
    body, odd = slope[..., :4], slope[..., 4:]
    normal = np.linalg.inv(body.mT @ weight @ body + np.diag(_LOOSE))

    def left(part: Array) -> Array:
        weighted = weight @ part
        rest = part - body @ (normal @ (body.mT @ weighted))
        return np.asarray((weighted * rest).sum((-1, -2)))

    return left(miss[..., None]), left(odd)


def learn_deviations(views: _Views, up: Array) -> Deviations:
    """Learn from M pairs how far outlines deviate from ellipses, and bodies from spheroids.

    An ellipsoid has the same extent along the shared coordinate in both views, so that the
    difference shows the errors of the outlines alone. The remaining misfit of spheroids then gives
    the variance of t (method of moments).

    up : (3,) unit vector against gravity in the rig frame.
    """
    count = len(views.noise[0])
    if count < _LEAST_FOR_LEARNING:
        return Deviations(pairs=count)
    ratio, noise = views.extents()
    excess2 = _excess_variance(ratio**2, noise, np.full(count, 3.0))
    excess = float(np.sqrt(max(excess2, _LEAST_EXCESS**2)))
    strict, rough = Deviations(1e-5, excess, count), Deviations(excess=excess)
    # a prolate body on its side would explain any t of an upright one
    fits = [_fit(views, start, strict) for start in _starts(views.ellipses)[:2]]
    misfits = [_spheroid_misfit(views, f, rough) for f in fits]
    better = np.argmin([m[0] + _unusual(f, up) for m, f in zip(misfits, fits)], 0)
    chi2, gain = (np.choose(better, [m[i] for m in misfits]) for i in range(2))
    variance = _excess_variance(chi2, np.full(count, 2.0), gain)
    total = variance * count + _DEFAULT_WEIGHT * DEFAULT_TRIAXIAL**2
    triaxial2 = total / (count + _DEFAULT_WEIGHT)
    return Deviations(float(np.sqrt(max(triaxial2, 1e-6))), excess, count)


def _excess_variance(squares: Array, expected: Array, gain: Array) -> float:
    """Return the s >= 0 for which squares (M,) have the means expected + gain s.

    Squares are weighted by the inverse of their variance. The largest 2 % are left out, because
    wrong pairs and covered outlines cause them.
    """
    excess = 0.0
    for _ in range(20):
        total = expected + gain * excess
        kept = squares / total <= np.quantile(squares / total, 1 - _TRIM)
        weight = np.where(kept, gain / total**2, 0.0)
        mean = (weight * squares).sum() / _TRIMMED
        excess = max(float((mean - (weight * expected).sum()) / (weight * gain).sum()), 0.0)
    return excess


def _scattered(found: list[Spheroids], rows: NDArray[Any], count: int) -> Spheroids:
    """Return the spheroids in their rows of a longer array, NaN in the other rows."""
    parts = []
    for name in Spheroids.__annotations__:
        values = np.concatenate([getattr(piece, name) for piece in found])
        out = np.full((count, *values.shape[1:]), np.nan)
        out[rows] = values
        parts.append(out)
    return Spheroids(*parts)
