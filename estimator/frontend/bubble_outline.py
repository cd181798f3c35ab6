"""Sub-pixel outlines: maximum-likelihood fit of ellipse and harmonics to the pixels at the rim.

The model of a pixel is ``outer + (inner - outer) F``, with F the profile of a blurred disc
(:mod:`bubble_profile`) at the pixel's distance from the outline and the ellipse's curvature there;
the outline is an ellipse with normal displacements of orders 3 to 6 in the eccentric anomaly. In
that parametrisation the centre is orthogonal to the harmonics (b cos phi / h times cos k phi,
integrated along the arc h dphi, is zero), so fitting them costs a whole outline nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.frontend.bubble_geometry import (
    ELLIPSE_PARAMETERS,
    Foot,
    ellipse_basis,
    foot_points,
    harmonic_basis,
    moved,
    turned_harmonics,
)
from telerig.estimator.frontend.bubble_pixels import Pixels, rim_pixels, unlike_rim
from telerig.estimator.frontend.bubble_profile import rim_profile
from telerig.estimator.frontend.bubble_types import HARMONICS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

PIXEL_VARIANCE_PX2 = 1.0 / 12.0
_BLUR, _OUTER, _INNER, _FIRST_HARMONIC = 5, 6, 7, 8
_PARAMETERS = _FIRST_HARMONIC + 2 * len(HARMONICS)
_MIN_SIGMA_PX = 0.3
_INNER_SPREAD = 0.3
_OUTER_SPREAD = 0.3
_WHOLE_HARMONIC, _PARTIAL_HARMONIC = 0.25, 0.02
_RESOLVED = 3.0
_OUTLIER_SIGMA = 4.5
_FULL_COVERAGE = 0.9
_BINS = 32


@dataclass(frozen=True)
class Start:
    """Where the fits begin: ``ellipse`` (B, 5), ``blur_px`` and ``inner`` level (B,), noise
    ``sigma_outer`` and ``sigma_inner`` (B,) as shares of the background's level."""

    ellipse: Array
    blur_px: Array
    inner: Array
    sigma_outer: Array
    sigma_inner: Array

    def __len__(self) -> int:
        return int(self.ellipse.shape[0])


@dataclass(frozen=True)
class Outlines:
    """Fitted outlines of B bubbles.

    ``ellipse`` (B, 5), ``harmonics`` (B, 8; NaN where not fitted), ``blur_px`` without the pixel,
    ``outer`` and ``inner`` levels, ``centre_covariance_px2`` (B, 2, 2), ``sigma_outline_px``,
    ``chi2_dof``, ``coverage`` (share of the outline that was seen), ``misfit_px`` (spread of the
    edge about the outline), ``converged``; ``inner_ratio``, the variance of what is left inside
    relative to that outside.
    """

    ellipse: Array
    harmonics: Array
    blur_px: Array
    outer: Array
    inner: Array
    centre_covariance_px2: Array
    sigma_outline_px: Array
    chi2_dof: Array
    coverage: Array
    misfit_px: Array
    converged: Mask


@dataclass(frozen=True)
class _State:
    ellipse: Array
    harmonics: Array
    sigma: Array
    outer: Array
    inner: Array


@dataclass(frozen=True)
class _Linear:
    """Everything about one linearisation point that stays while the outline moves a little."""

    foot: Foot
    shape: Array
    curvature: Array


def fit_outlines(ratio: NDArray[np.float32], start: Start, *, rounds: int = 3) -> Outlines:
    """Fit B outlines to the normalised image ``ratio`` (grey over background).

    Pixels inside or near another bubble of ``start`` are left out, and so are hearts, dirt and
    whatever else is unlike a rim.
    """
    sigma = np.sqrt(start.blur_px**2 + PIXEL_VARIANCE_PX2)
    state = _State(
        start.ellipse,
        np.zeros((len(start), 2 * len(HARMONICS))),
        sigma,
        np.ones(len(start)),
        start.inner,
    )
    pixels = rim_pixels(ratio, start.ellipse, 1.2 * sigma)
    for index in range(rounds):
        last = index == rounds - 1
        linear = _linearised(state, pixels)
        used = _window(state, pixels, linear, start, first=index == 0)
        state, step = _descend(
            state, pixels, linear, used, start, harmonics=index > 0, steps=1 if last else 2
        )
    return _result(state, step, pixels, linear, used, start)


def _linearised(state: _State, pixels: Pixels) -> _Linear:
    foot = foot_points(state.ellipse, pixels.owner, pixels.u, pixels.v)
    order = np.repeat(np.array(HARMONICS, dtype=np.float64), 2)
    radius = np.sqrt(state.ellipse[:, 2] * state.ellipse[:, 3])
    gain = np.exp(-(order**2 - 1.0) * ((state.sigma / radius) ** 2)[:, None] / 2.0)
    shape = np.empty((ELLIPSE_PARAMETERS + order.size, pixels.owner.size))
    shape[:ELLIPSE_PARAMETERS] = ellipse_basis(state.ellipse, pixels.owner, foot)
    shape[ELLIPSE_PARAMETERS:] = harmonic_basis(foot.cos, foot.sin)
    shape[ELLIPSE_PARAMETERS:] *= gain.T.take(pixels.owner, axis=1)
    return _Linear(foot, shape, foot.curvature)


def _model(
    state: _State, pixels: Pixels, linear: _Linear, moved_by: Array
) -> tuple[Array, Array, Array]:
    """Grey (N,), its Jacobian (16, N) and the share of light lost F (N,).

    ``moved_by`` (B, 13): outline displacements since the linearisation.
    """
    owner = pixels.owner
    shift = np.einsum("kn,kn->n", linear.shape, moved_by.T.take(owner, axis=1))
    per = np.stack([1.0 / state.sigma, state.inner - state.outer, state.outer])
    inverse_sigma, contrast, outer = per.take(owner, axis=1)
    distance = (linear.foot.distance - shift) * inverse_sigma
    curvature = linear.curvature / inverse_sigma
    profile = rim_profile(distance, curvature)
    jacobian = np.empty((_PARAMETERS, owner.size))
    slope = contrast * profile.by_distance * inverse_sigma
    np.multiply(linear.shape[:ELLIPSE_PARAMETERS], -slope, out=jacobian[:ELLIPSE_PARAMETERS])
    np.multiply(linear.shape[ELLIPSE_PARAMETERS:], -slope, out=jacobian[_FIRST_HARMONIC:])
    jacobian[_BLUR] = contrast * inverse_sigma * (
        profile.by_curvature * curvature - profile.by_distance * distance
    )
    jacobian[_OUTER] = 1.0 - profile.value
    jacobian[_INNER] = profile.value
    return outer + contrast * profile.value, jacobian, profile.value


def _window(
    state: _State, pixels: Pixels, linear: _Linear, start: Start, *, first: bool
) -> Array:
    """Weights (N,): inverse variances, 0 for what must not be looked at."""
    owner = pixels.owner
    none = np.zeros((len(start), linear.shape.shape[0]))
    none[:, ELLIPSE_PARAMETERS:] = state.harmonics
    grey, _, inside = _model(state, pixels, linear, none)
    variance_out, variance_in = start.sigma_outer**2, start.sigma_inner**2
    variance = variance_out[owner] + (variance_in - variance_out)[owner] * inside
    sigma, minor = state.sigma[owner], state.ellipse[:, 3].take(owner)
    distance = linear.foot.distance
    if first:
        depth = np.minimum(2.0 * sigma + 0.5, 0.45 * minor)
        kept = (distance > -depth) & (distance < 2.5 * sigma + 1.0)
    else:
        kept = (distance > -(3.0 * sigma + 0.5)) & (distance < 3.0 * sigma + 0.5)
    residual = (pixels.value - grey) / np.sqrt(variance)
    kept &= ~pixels.hidden(state.ellipse, 3.0 * state.sigma)
    if not first:
        contrast = (state.outer - state.inner) / np.sqrt(variance_out)
        kept &= ~unlike_rim(pixels, linear.foot, residual, state.sigma, contrast)
        spread = _per_bubble_spread(residual, pixels, kept)
        kept &= np.abs(residual) < _OUTLIER_SIGMA * np.maximum(spread, 1.0)[owner]
    return np.where(kept, 1.0 / variance, 0.0)


def _per_bubble_spread(residual: Array, pixels: Pixels, kept: Mask) -> Array:
    spread = np.ones(pixels.bubbles)
    for index, part in enumerate(pixels.parts()):
        own = np.abs(residual[part][kept[part]])
        if own.size > 8:
            spread[index] = 1.4826 * np.partition(own, own.size // 2)[own.size // 2]
    return spread


def _coverage(pixels: Pixels, linear: _Linear, used: Array, sigma: Array) -> Array:
    """Share of the outline (B,) at which pixels at the edge were looked at."""
    near = (used > 0.0) & (np.abs(linear.foot.distance) < 1.2 * sigma[pixels.owner] + 0.3)
    angle = np.arctan2(linear.foot.sin[near], linear.foot.cos[near])
    slot = ((angle + np.pi) * (_BINS / (2.0 * np.pi))).astype(np.intp) % _BINS
    seen = np.bincount(pixels.owner[near] * _BINS + slot, minlength=pixels.bubbles * _BINS)
    share: Array = np.mean(seen.reshape(-1, _BINS) > 0, axis=1)
    return share


def _prior(state: _State, start: Start, coverage: Array, *, harmonics: bool) -> Array:
    """Information (B, 16) of the weak priors; infinite stands for a parameter held at zero."""
    information = np.zeros((len(start), _PARAMETERS))
    information[:, _OUTER] = 1.0 / _OUTER_SPREAD**2
    information[:, _INNER] = 1.0 / _INNER_SPREAD**2
    radius = np.sqrt(state.ellipse[:, 2] * state.ellipse[:, 3])
    share = np.where(coverage >= _FULL_COVERAGE, _WHOLE_HARMONIC, _PARTIAL_HARMONIC)
    information[:, _FIRST_HARMONIC:] = (1.0 / (share * radius) ** 2)[:, None]
    if not harmonics:
        information[:, _FIRST_HARMONIC:] = 1e12
    information[~_resolved(state), _FIRST_HARMONIC:] = 1e12
    return information


def _resolved(state: _State) -> Mask:
    resolved: Mask = state.ellipse[:, 3] > _RESOLVED * state.sigma
    return resolved


def _normal_equations(
    jacobian: Array, residual: Array, weight: Array, pixels: Pixels
) -> tuple[Array, Array]:
    information = np.empty((pixels.bubbles, _PARAMETERS, _PARAMETERS))
    pull = np.empty((pixels.bubbles, _PARAMETERS))
    weighted = jacobian * weight
    for index, part in enumerate(pixels.parts()):
        information[index] = weighted[:, part] @ jacobian[:, part].T
        pull[index] = weighted[:, part] @ residual[part]
    return information, pull


def _descend(
    state: _State,
    pixels: Pixels,
    linear: _Linear,
    used: Array,
    start: Start,
    *,
    harmonics: bool,
    steps: int,
) -> tuple[_State, Array]:
    """Gauss-Newton at fixed feet, then the outline moved; also the size of the last step (B,)."""
    shifts = np.zeros((len(start), linear.shape.shape[0]))
    shifts[:, ELLIPSE_PARAMETERS:] = state.harmonics
    prior = _prior(
        state, start, _coverage(pixels, linear, used, state.sigma), harmonics=harmonics
    )
    for _ in range(steps):
        grey, jacobian, _ = _model(state, pixels, linear, shifts)
        information, pull = _normal_equations(jacobian, pixels.value - grey, used, pixels)
        pull[:, _OUTER] -= prior[:, _OUTER] * (state.outer - 1.0)
        pull[:, _INNER] -= prior[:, _INNER] * (state.inner - start.inner)
        pull[:, _FIRST_HARMONIC:] -= prior[:, _FIRST_HARMONIC:] * shifts[:, ELLIPSE_PARAMETERS:]
        step = _limited(_solved(information, prior, pull), state)
        shifts[:, :ELLIPSE_PARAMETERS] += step[:, :ELLIPSE_PARAMETERS]
        shifts[:, ELLIPSE_PARAMETERS:] += step[:, _FIRST_HARMONIC:]
        state = replace(
            state,
            sigma=np.maximum(state.sigma + step[:, _BLUR], _MIN_SIGMA_PX),
            outer=state.outer + step[:, _OUTER],
            inner=state.inner + step[:, _INNER],
        )
    ellipse, turn = moved(state.ellipse, shifts[:, :ELLIPSE_PARAMETERS])
    turned = turned_harmonics(shifts[:, ELLIPSE_PARAMETERS:], turn)
    size = np.max(np.abs(step[:, :ELLIPSE_PARAMETERS]), axis=1)
    return replace(state, ellipse=ellipse, harmonics=turned), size


def _solved(information: Array, prior: Array, pull: Array) -> Array:
    diagonal = np.arange(_PARAMETERS)
    information = information.copy()
    information[:, diagonal, diagonal] += prior + 1e-6 * (
        information[:, diagonal, diagonal] + 1.0
    )
    scale = 1.0 / np.sqrt(information[:, diagonal, diagonal])
    equilibrated = information * scale[:, :, None] * scale[:, None, :]
    solution: Array = np.linalg.solve(equilibrated, (pull * scale)[..., None])[..., 0] * scale
    return solution


def _limited(step: Array, state: _State) -> Array:
    """Steps that keep within the range where the linearisation holds."""
    reach = np.max(np.abs(step[:, :ELLIPSE_PARAMETERS]), axis=1)
    share = np.minimum(1.0, np.minimum(1.5, 0.3 * state.ellipse[:, 3]) / (reach + 1e-12))
    share = np.minimum(share, 0.4 * state.sigma / (np.abs(step[:, _BLUR]) + 1e-12))
    return step * share[:, None]


def _result(
    state: _State, step: Array, pixels: Pixels, linear: _Linear, used: Array, start: Start
) -> Outlines:
    """Covariances and residuals at the last linearisation (the last step is small)."""
    shifts = np.zeros((len(start), linear.shape.shape[0]))
    ellipse = state.ellipse
    linear = _linearised(state, pixels)
    shifts[:, ELLIPSE_PARAMETERS:] = state.harmonics
    grey, jacobian, _ = _model(state, pixels, linear, shifts)
    residual = pixels.value - grey
    information, _ = _normal_equations(jacobian, residual, used, pixels)
    coverage = _coverage(pixels, linear, used, state.sigma)
    prior = _prior(state, start, coverage, harmonics=True)
    diagonal = np.arange(_PARAMETERS)
    information[:, diagonal, diagonal] += prior + 1e-12
    scale = 1.0 / np.sqrt(information[:, diagonal, diagonal])
    covariance = np.linalg.inv(information * scale[:, :, None] * scale[:, None, :])
    covariance *= scale[:, :, None] * scale[:, None, :]
    resolved = _resolved(state)
    fitted = np.where(resolved, _PARAMETERS, _FIRST_HARMONIC)
    count = pixels.sums((used > 0.0).astype(np.float64))
    chi2_dof = pixels.sums(used * residual**2) / np.maximum(count - fitted, 1.0)
    covariance *= np.maximum(chi2_dof, 1.0)[:, None, None]
    turn_cos, turn_sin = np.cos(ellipse[:, 4]), np.sin(ellipse[:, 4])
    turn = np.stack([turn_cos, -turn_sin, turn_sin, turn_cos], axis=1).reshape(-1, 2, 2)
    variances = covariance[:, diagonal, diagonal][:, _FIRST_HARMONIC:]
    return Outlines(
        ellipse,
        np.where(resolved[:, None], state.harmonics, np.nan),
        np.sqrt(np.maximum(state.sigma**2 - PIXEL_VARIANCE_PX2, 0.0)),
        state.outer,
        state.inner,
        turn @ covariance[:, :2, :2] @ np.swapaxes(turn, 1, 2),
        np.where(resolved, np.sqrt(np.mean(variances, axis=1)), np.nan),
        chi2_dof,
        coverage,
        _misfit(residual, jacobian, used, pixels, state),
        (step < 0.05) & (count > 2 * _PARAMETERS),
    )


def _misfit(
    residual: Array, jacobian: Array, used: Array, pixels: Pixels, state: _State
) -> Array:
    """Spread of the edge about the fitted outline (B,), in px.

    The residual grey over the edge's slope, where it is steep, with the part that the noise
    explains taken away.
    """
    slope = np.abs(jacobian[_FIRST_HARMONIC] / 1.0) + np.abs(jacobian[_FIRST_HARMONIC + 1])
    steep = (used > 0.0) & (slope > 0.0)
    weight = np.where(steep, slope**2, 0.0)
    noise = np.where(used > 0.0, 1.0 / np.maximum(used, 1e-300), 0.0)
    excess = pixels.sums(np.where(steep, residual**2 - noise, 0.0))
    return np.sqrt(np.maximum(excess, 0.0) / np.maximum(pixels.sums(weight), 1e-12))
