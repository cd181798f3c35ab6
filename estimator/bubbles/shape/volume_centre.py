"""Centre of volume of bodies from their outlines in any number of views.

An outline's centre is that of the volume but for modes of degree 3, which displace it by their
first harmonic along the rim and show in its third (`rig.silhouette`). Two models of these modes are
weighted by their evidence: seven independent coefficients, and one mode that is axisymmetric about
the pole. Two views at right angles show the displacement along the direction that both measure,
three and more views show all of it (docs/decisions/007-volume-centroid.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array
from telerig.estimator.bubbles.shape.shapes import Shapes, degree_variance
from telerig.estimator.bubbles.shape.sightings import FOURTH, THIRD, UNKNOWN
from telerig.estimator.bubbles.shape.spheroid import Shape
from telerig.estimator.bubbles.shape.views import Views
from telerig.rig import silhouette

_RUN_WEIGHT = 4.0  # the same for the bubble's sd of degree 3
_ZONAL_SHARE = 0.2  # prior probability of modes that are axisymmetric about the pole
_KNOWN_AXIS = 0.15  # rad: beyond this uncertainty of the pole that model is left out
_FOURTH_TERM, _TRIAXIAL_TERM = 8.0, 4.0
"""Second order: of the third harmonic, times degree 4 and times what no spheroid holds."""


@dataclass(frozen=True)
class Centre:
    """Centres of volume of B bodies.

    step_mm : (B, 3) from the triangulated point to the centre of volume.
    covariance_mm2 : (B, 3, 3) of the step.
    shift_px, shift_covariance_px2 : (B, n, 2), (B, n, 2, 2) projected centre of volume minus the
        outline's centre, and its covariance.
    """

    step_mm: Array
    covariance_mm2: Array
    shift_px: Array
    shift_covariance_px2: Array


def volume_centre(views: Views, shape: Shape, shapes: Shapes, gap_sigma_px: float) -> Centre:
    """Estimate centres of volume: the mean over both models of degree 3 by their evidence."""
    measured, noise, conversion = _measured(views, shapes)
    n, count = views.count, len(measured)
    jacobian = np.zeros((count, 4 * n, 3))
    jacobian[:, : 2 * n] = views.jacobian.reshape(count, 2 * n, 3)
    noise[:, : 2 * n, : 2 * n] += _gap_covariance(jacobian[:, : 2 * n], gap_sigma_px)
    whole = views.sightings.whole  # of other outlines no harmonics are known
    own = 2 * np.where(whole, degree_variance(views.sightings, 3, less=2.0), 0.0).sum(-1)
    squares = _RUN_WEIGHT * shapes.third**2 + np.maximum(own, 0.0)
    sigma2 = squares / (_RUN_WEIGHT + np.maximum(2 * whole.sum(-1) - 2, 0))
    frames = silhouette.rim_frames(shape.moments, views.jacobian, views.axes_px)
    effect = _effect(views.axes_px, *silhouette.third_degree_traces(frames))
    isotropic = _estimate(measured, noise, jacobian, sigma2[:, None, None] * (effect @ effect.mT))
    along = _zonal_effect(views.axes_px, frames, shape.frame[:, :, 2])
    prior = along @ along.mT
    axis_sd = np.sqrt(np.maximum(shape.covariance[:, 2:4, 2:4], 0.0))
    for axis in range(2):
        sd = np.minimum(axis_sd[:, axis, axis], 0.7)
        pole = shape.frame[:, :, 2] + sd[:, None] * shape.frame[:, :, axis]
        pole /= np.linalg.norm(pole, axis=-1, keepdims=True)
        change = _zonal_effect(views.axes_px, frames, pole) - along
        prior = prior + change @ change.mT
    zonal = _estimate(measured, noise, jacobian, 49 * sigma2[:, None, None] * prior)
    known = np.maximum(axis_sd[:, 0, 0], axis_sd[:, 1, 1]) < _KNOWN_AXIS
    share = np.where(known, _ZONAL_SHARE, 1e-9)
    log_odds = zonal[3] - isotropic[3] + np.log(share / (1 - share))
    weight = np.stack([1 / (1 + np.exp(np.clip(s * log_odds, -700, 700))) for s in (1, -1)])
    step, covariance = _mixed(weight, (isotropic[0], zonal[0]), (isotropic[1], zonal[1]))
    effect_px, spread = _mixed(weight, (isotropic[2], zonal[2]), (isotropic[4], zonal[4]))
    each = np.arange(n)
    blocks = spread[:, : 2 * n, : 2 * n].reshape(count, n, 2, n, 2)[:, each, :, each]
    shift = (conversion - effect_px[:, : 2 * n]).reshape(count, n, 2)
    return Centre(step, covariance, shift, np.moveaxis(blocks, 0, 1))


def _mixed(
    weight: Array, values: tuple[Array, Array], covariances: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Return mean (B, k) and covariance (B, k, k) of two models with weights (2, B)."""
    every = np.stack(values)
    mean = (weight[..., None] * every).sum(0)
    apart = every - mean
    second = np.stack(covariances) + apart[..., :, None] * apart[..., None, :]
    return mean, (weight[..., None, None] * second).sum(0)


def _measured(views: Views, shapes: Shapes) -> tuple[Array, Array, Array]:
    """Return measurements (B, 4 n), their covariance (B, 4 n, 4 n) and a part (B, 2 n) of them.

    The measurements are the pixel residuals (u, v) of all views, then the coefficients of cos 3 phi
    and sin 3 phi of all views. The part is what the harmonics add to the ellipses' centres.
    """
    sightings, n = views.sightings, views.count
    count = len(views.noise)
    trace, whole = sightings.trace, sightings.whole[..., None, None]
    known = np.maximum(sightings.whole.sum(-1), 1)  # the others are 0
    third2, fourth2 = ((trace[..., p] ** 2).mean(-1).sum(-1) / known for p in (THIRD, FOURTH))
    cross2 = _FOURTH_TERM**2 * fourth2 + (_TRIAXIAL_TERM * shapes.triaxial) ** 2
    second_order2 = third2 * cross2
    error = sightings.trace_covariance[..., :4, :4] + second_order2[:, None, None, None] * np.eye(4)
    error = np.where(whole, error, np.diag([0.0, 0.0, UNKNOWN, UNKNOWN]))
    mix = np.zeros((count, n, 4, 4))
    mix[..., :2, :2], mix[..., 2:, 2:] = views.axes_px, np.eye(2)
    error = mix @ error @ mix.mT
    error[..., :2, :2] += sightings.covariance_px2
    conversion = np.einsum("bnij,bnj->bni", views.axes_px, trace[..., :2])
    residual = sightings.uv_px + conversion - views.pixels
    noise = np.zeros((count, 2, n, 2, 2, n, 2))
    each = np.arange(n)
    for i in range(2):
        for j in range(2):
            part = error[..., 2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
            noise[:, i, each, :, j, each] = np.moveaxis(part, 1, 0)
    measured = np.stack([residual, trace[..., THIRD]], 1).reshape(count, 4 * n)
    return measured, noise.reshape(count, 4 * n, 4 * n), conversion.reshape(count, 2 * n)


def _gap_covariance(jacobian: Array, gap_sigma_px: float) -> Array:
    """Return the covariance (B, 2 n, 2 n) of shifts of the views that no motion of the body causes.

    gap_sigma_px : standard deviation of the difference between two views.
    """
    inside = jacobian @ np.linalg.solve(jacobian.mT @ jacobian, jacobian.mT)
    return np.asarray(gap_sigma_px**2 / 2 * (np.eye(jacobian.shape[1]) - inside))


def _effect(axes_px: Array, first: Array, third: Array) -> Array:
    """Return the derivative (B, 4 n, k) of the measurements by k modes.

    first, third : (B, n, 2, k) coefficients of their first and third harmonics along the rims.
    """
    count, _, _, modes = first.shape
    both = np.stack([axes_px @ first, third], 1)
    return np.asarray(both.reshape(count, -1, modes))


def _zonal_effect(axes_px: Array, frames: Array, pole: Array) -> Array:
    """Return the derivative (B, 4 n, 1) of the measurements by an axisymmetric mode's amplitude."""
    traces = silhouette.zonal_traces((frames.mT @ pole[:, None, :, None])[..., 0])
    return _effect(axes_px, *(t[..., None] for t in traces))


def _estimate(
    measured: Array, noise: Array, jacobian: Array, prior: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Estimate points by generalised least squares.

    prior : (B, 4 n, 4 n) covariance that the shape adds to the noise.

    Returns the steps (B, 3), their covariances (B, 3, 3), the expected effect (B, 4 n) of the
    shape, the log evidence (B,), and the covariance (B, 4 n, 4 n) of the effect.
    """
    total = noise + prior
    inverse = np.linalg.inv(total)
    weighted = jacobian.mT @ inverse
    normal = weighted @ jacobian
    covariance = np.asarray(np.linalg.inv(normal))
    step = (covariance @ weighted @ measured[..., None])[..., 0]
    misfit = (inverse @ (measured - (jacobian @ step[..., None])[..., 0])[..., None])[..., 0]
    log_det = -np.linalg.slogdet(total)[1] - np.linalg.slogdet(normal)[1]
    evidence = 0.5 * (log_det - (measured * misfit).sum(-1))
    told = inverse - weighted.mT @ covariance @ weighted
    effect = (prior @ misfit[..., None])[..., 0]
    return step, covariance, effect, evidence, prior - prior @ told @ prior
