"""Spheroids that fit the outlines of bodies in any number of views.

Seen through the local Jacobian J of a camera, an ellipsoid with the moments Q has the outline
J Q J^T: n outlines are 3 n numbers, linear in the six of Q. Two views see their common direction
twice and leave one number to the prior; three views leave none. A bubble is nearly a spheroid, so Q
is that of a spheroid with two additional numbers t, the logarithmic deviations of the equatorial
semi-axes from each other. Their prior N(0, triaxial^2) is learned from the run, so that the
covariance holds what the views do not determine (docs/decisions/037-bubbles-from-outlines.md).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from telerig.arrays import Array
from telerig.estimator.bubbles.shape import kernels
from telerig.estimator.bubbles.shape.shapes import Shapes, degree_variance
from telerig.estimator.bubbles.shape.sightings import Sightings
from telerig.estimator.bubbles.shape.views import Views
from telerig.rig import silhouette

PARAMETERS = ("log_size", "log_aspect", "lean_1", "lean_2", "triaxial_1", "triaxial_2")
"""Of `Shape.covariance`: log of d_eq, log of the aspect ratio, the turn of the pole about the two
equatorial axes of `Shape.frame` (rad), and the deviation of these axes from each other."""

_ONE_OUTLINE_SD = 0.03
"""Error of a log diameter from one outline alone: of second order in the unknown lean of the pole,
so that the covariance of first order does not contain it (simulated bodies that lean to 30 deg)."""
_PROLATE_COST, _UPRIGHT_RAD, _LOG_ASPECT = 8.0, 0.4, 0.5
"""What decides between bodies with the same outlines: how much more an oblate body is expected (in
chi-square), and standard deviations of its pole from the vertical and of its log aspect ratio."""
_IMPROBABLE = 1e-3
"""Probability below which another local optimum does not count: of a prolate body that is a hundred
times farther away than the standard deviation, 1 in 50,000 would be most of the variance."""
_NEAR_SPHERE = 4.0
"""Bias of a log aspect ratio, times itself over its variance: near a sphere the five components of
its deformation are all noise, and the fit takes the largest for the flattening."""
_LOOSE = np.array([0.0, 0.25, 1.0, 1.0])
"""Prior precision of a single body's log size, log aspect ratio and pole."""
_STEPS, _SMALL_STEP = 15, 1e-4

UNSEEN_SQUARE = (2 / 3, 1.0)
"""How much larger log size and log aspect ratio are, over the mean square of the unseen t."""
_REPULSION = 1.5
"""How much larger a log aspect ratio is found, over itself times the variance of the pole's lean:
errors across the pole push the eigenvalues apart (second-order perturbation theory), the pole's by
the whole of this product, the mean of the equator's two by half of it."""
_RIM_EXCESS = {3: 15.3, 4: 37.4}
"""How much larger than the volume's the outlines' size is, over the variance of the coefficients
of a degree: a rim is where the body reaches farthest (decision 037)."""
_RUN_SHARE = 2.0  # harmonics' worth of the run's variances against a bubble's own four


@dataclass(frozen=True)
class Shape:
    """B fitted shapes.

    frame : (B, 3, 3).  value : (B, 4) log size, log aspect ratio, t.  covariance : (B, 6, 6).
    cost : (B,) twice the negative logarithm of the posterior.  chi2 : (B,) see `Bodies`.
    noise : (B, 6, 6) part of the covariance by the outlines' own noise.
    fixed : (B, 2) part of the variances of log size and log aspect ratio by the rims' excess and by
        the mean square of the unseen t. Both are 0 before `best_shape`.
    """

    frame: Array
    value: Array
    covariance: Array
    cost: Array
    chi2: Array
    noise: Array
    fixed: Array

    @property
    def moments(self) -> Array:
        """Moments (B, 3, 3) in mm^2."""
        return np.asarray(kernels.moments(self.frame, self.value))


def best_shape(views: Views, shapes: Shapes, up: Array) -> Shape:
    """Return the most probable local optimum; the covariance includes the others by probability.

    Size and aspect ratio are those of the volume: the excess of the rims and of what is open of t
    are subtracted.
    """
    weight = views.precision(shapes.excess)
    fits = [fit_spheroid(views, start, weight, shapes.triaxial) for start in starts(views)]
    cost = np.stack([f.cost + unusual(f, up) for f in fits])
    best, rows = np.argmin(cost, 0), np.arange(cost.shape[1])
    chosen = Shape(
        *(np.stack([getattr(f, n.name) for f in fits])[best, rows] for n in fields(Shape))
    )
    share = np.exp(-(cost - cost[best, rows]) / 2)
    share /= share.sum(0)
    share = np.where(share < _IMPROBABLE, 0.0, share)
    _, slope = kernels.outlines(views.measure, chosen.frame, chosen.value)
    gain = chosen.covariance @ slope.mT @ weight
    noise = gain @ views.white @ gain.mT
    covariance = chosen.covariance.copy()
    for fit, mine in zip(fits, share):
        sign = np.sign((fit.frame[:, :, 2] * chosen.frame[:, :, 2]).sum(-1, keepdims=True))
        lean = (chosen.frame.mT @ (sign * fit.frame[:, :, 2])[..., None])[:, :2, 0]
        apart = np.concatenate([fit.value[:, :2] - chosen.value[:, :2], lean], -1)
        covariance[:, :4, :4] += mine[:, None, None] * apart[:, :, None] * apart[:, None, :]
    # the sphere has no pole, and no flattening that could be negative
    aspect2 = chosen.value[:, 1] ** 2
    blur = np.minimum(_NEAR_SPHERE * chosen.covariance[:, 1, 1] / np.maximum(aspect2, 1e-12), 1.0)
    covariance[:, 1, 1] += blur**2 * aspect2
    covariance[:, [2, 3], [2, 3]] += blur[:, None] ** 2
    # a rim reaches farther than the body's mean surface, by an amount as uncertain as it is large
    excess = _rim_excess(views.sightings, shapes)
    covariance[:, 0, 0] += excess**2
    alone = views.sightings.entire.sum(-1) < 2
    covariance[:, 0, 0] += np.where(alone, _ONE_OUTLINE_SD**2, 0.0)
    # what t is left open makes the expected moments of the equator larger than those at its mean
    unseen = np.trace(chosen.covariance[:, 4:, 4:], axis1=1, axis2=2)
    wider = np.array(UNSEEN_SQUARE) * unseen[:, None]
    covariance[:, :2, :2] += 2 * wider[:, :, None] * wider[:, None, :]
    fixed = wider**2
    fixed[:, 0] += excess**2
    lean2 = np.trace(chosen.covariance[:, 2:4, 2:4], axis1=1, axis2=2)
    apart = _REPULSION * (1 - blur) * chosen.value[:, 1] * lean2
    moved = np.stack([excess + wider[:, 0], wider[:, 1] + apart, 0 * excess, 0 * excess], -1)
    chi2, _ = misfit(views, chosen, weight)
    return replace(
        chosen, value=chosen.value - moved, covariance=covariance, chi2=chi2, noise=noise,
        fixed=fixed,
    )  # fmt: skip


def fit_spheroid(
    views: Views, start: tuple[Array, Array, Array], weight: Array, triaxial: float
) -> Shape:
    """Maximise the posterior by Gauss-Newton steps.

    start : pole (B, 3), log size (B,), log aspect ratio (B,).  weight : `Views.precision`.
    """
    pole, size, aspect = start
    frame, value = _frame(pole), np.stack([size, aspect, 0 * size, 0 * size], -1)
    prior = np.concatenate([_LOOSE, np.full(2, triaxial**-2)])
    covariance = kernels.fit(
        views.measure, weight, prior, views.round, frame, value, _STEPS, _SMALL_STEP
    )
    g, _ = kernels.outlines(views.measure, frame, value)
    miss = views.round - g
    cost = np.einsum("mi,mij,mj->m", miss, weight, miss) + (prior[4:] * value[:, 2:] ** 2).sum(-1)
    return Shape(
        frame, value, covariance, cost, cost, np.zeros_like(covariance), np.zeros((len(cost), 2))
    )


def starts(views: Views) -> list[tuple[Array, Array, Array]]:
    """Return start values (pole, log size, log aspect ratio) of the local optima, the prolate one
    last."""
    oblate = _oblate_pair(views) if views.count == 2 else [views.free[0]]
    starts = []
    for moments, polar in (*((m, 0) for m in oblate), (views.free[0], 2)):
        squares, axes = silhouette.proper_axes(moments)
        logs = np.log(squares) / 2
        aspect = (3 * logs.mean(-1) - logs[:, polar]) / 2 - logs[:, polar]
        starts.append((axes[..., polar], logs.mean(-1), aspect))
    return starts


def _oblate_pair(views: Views) -> list[Array]:
    """Return the moments of the two oblate spheroids nearest to two outlines each.

    The long semi-axis of every outline is the radius R of the equator, so that R^2 I - Q has rank
    one. This gives the number that two views leave open but for a sign: one spheroid is the mirror
    image of the other about the direction that both views measure.
    """
    along = [np.cross(j[:, 0], j[:, 1]) for j in np.moveaxis(views.jacobian, 1, 0)]
    shared = np.cross(along[0], along[1])
    basis = np.stack([shared, *(np.cross(shared, d) for d in along)], -2)
    basis /= np.linalg.norm(basis, axis=-1, keepdims=True)
    inverse = np.linalg.inv(basis)
    extent = basis @ views.free[0] @ basis.mT
    planes = [extent[:, plane][:, :, plane] for plane in ([0, 1], [0, 2])]
    radius2 = np.mean([np.linalg.eigvalsh(p)[:, 1] for p in planes], 0)
    sphere = radius2[:, None, None] * (basis @ basis.mT)
    flat = np.sqrt(np.maximum((sphere - extent)[:, [1, 2], [1, 2]], 0.0).prod(-1))
    out = []
    for sign in (1, -1):
        extent[:, 1, 2] = extent[:, 2, 1] = sphere[:, 1, 2] - sign * flat
        out.append(inverse @ extent @ inverse.mT)
    return out


def oblate(fits: list[Shape]) -> list[Shape]:
    """Return the fits that began as oblate spheroids."""
    return fits[:-1]


def unusual(fit: Shape, up: Array) -> Array:
    """Return minus twice the log prior (B,) of aspect ratio and tilt, up to a constant."""
    aspect, upright = fit.value[:, 1], np.abs(fit.frame[:, :, 2] @ up)
    tilt = np.arccos(np.clip(upright, 0, 1))
    prolate = np.where(aspect < 0, _PROLATE_COST, 0.0)
    return np.asarray(prolate + (aspect / _LOG_ASPECT) ** 2 + (tilt / _UPRIGHT_RAD) ** 2)


def misfit(views: Views, fit: Shape, weight: Array) -> tuple[Array, Array]:
    """Return the chi-square (B,) of a spheroid with t = 0, and its slope (B,) by the variance
    of t."""
    g, slope = kernels.outlines(views.measure, fit.frame, fit.value * [1.0, 1.0, 0.0, 0.0])
    miss = views.round - g
    body, odd = slope[..., :4], slope[..., 4:]
    normal = np.linalg.inv(body.mT @ weight @ body + np.diag(_LOOSE))

    def left(part: Array) -> Array:
        weighted = weight @ part
        rest = part - body @ (normal @ (body.mT @ weighted))
        return np.asarray((weighted * rest).sum((-1, -2)))

    return left(miss[..., None]), left(odd)


def _frame(pole: Array) -> Array:
    """Return right-handed frames (B, 3, 3) whose third column is the pole (B, 3)."""
    start = np.where(np.abs(pole[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    first = start - pole * (start * pole).sum(-1, keepdims=True)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(pole, first), pole], -1)


def _rim_excess(sightings: Sightings, shapes: Shapes) -> Array:
    """Return by how much the outlines of B bubbles exceed the size of their volumes.

    The result (B,) is the logarithm of the diameter from the outlines over the volume-equivalent
    diameter; its standard deviation is as large as itself. It is 0 for outlines that are not whole.
    """
    excess = np.zeros(len(sightings.camera))
    whole, views = sightings.all_whole, sightings.camera.shape[1]
    for degree, sigma in ((3, shapes.third), (4, shapes.fourth)):
        own = 2 * degree_variance(sightings, degree).sum(-1)
        variance = (_RUN_SHARE * sigma**2 + own) / (_RUN_SHARE + 2 * views)
        excess += _RIM_EXCESS[degree] * np.where(whole, np.maximum(variance, 0), 0.0)
    return excess
