"""Sub-pixel outlines: maximum-likelihood fit of ellipse and harmonics to the pixels at the rim.

The model of a pixel is ``outer + (inner - outer) F``, with F the profile of a blurred disc
(`rim_profile`) at the pixel's distance from the outline and the ellipse's curvature there;
the outline is an ellipse with normal displacements of orders 3 to 6 in the eccentric anomaly. In
that parametrisation the centre is orthogonal to the harmonics (b cos phi / h times cos k phi,
integrated along the arc h dphi, is zero), so fitting them costs a whole outline nothing. Where a
part is hidden it does, and the shapes of the frame's whole outlines serve as prior.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from telerig.arrays import Array, Bools, Float32
from telerig.estimator.bubbles.outline.ellipse_geometry import (
    ELLIPSE_PARAMETERS,
    Index,
    moved,
    spread,
    turned_harmonics,
)
from telerig.estimator.bubbles.outline.rim_model import (
    BLUR,
    FIRST_HARMONIC,
    INNER,
    OUTER,
    PARAMETERS,
    Linear,
    Pixels,
    RimState,
    linearised,
    normal_equations,
    rim_model,
    rim_pixels,
    unlike_rim,
)
from telerig.statistics import robust_sd

_LEVEL_SPREAD = 0.3
_FREE, _UNLEARNT, _LEAST, _HELD = 0.25, 0.02, 0.002, 1e-7
"""Spread of the harmonics' coefficients, as a share of the radius: too wide to affect whole
outlines; without whole outlines to learn from; the least that is learnt; tied to their start."""

_WIDENED = 1.5
_ENOUGH_WHOLE = 4


def learnt_spread(outlines: Outlines, partial: Bools) -> Array:
    """(B,) standard deviation of each outline's harmonics, as a share of its radius.

    ``partial`` (B,) outlines, which are hidden in part, get that of the frame's whole outlines.
    """
    whole = outlines.resolved & ~partial
    share = _UNLEARNT
    if np.count_nonzero(whole) >= _ENOUGH_WHOLE:
        radius = np.sqrt(outlines.ellipse[whole, 2] * outlines.ellipse[whole, 3])
        typical = np.median(np.mean((outlines.harmonics[whole] / radius[:, None]) ** 2, axis=1))
        share = max(_WIDENED * float(np.sqrt(typical)), _LEAST)
    return np.where(partial, share, _FREE)


def prior_equations(
    information: Array, pull: Array, state: RimState, shifts: Array, inner: Array, spread: Array
) -> None:
    """Add the prior at outlines ``shifts`` (B, 13) away from the state's ellipses.

    inner : (B,) expected level; spread : (B,) of the harmonics as a share of the radius.
    """
    level = 1.0 / _LEVEL_SPREAD**2
    information[:, OUTER, OUTER] += level
    information[:, INNER, INNER] += level
    pull[:, OUTER] -= level * (state.outer - 1.0)
    pull[:, INNER] -= level * (state.inner - inner)
    weight = 1.0 / (spread**2 * state.ellipse[:, 2] * state.ellipse[:, 3])
    places = np.arange(FIRST_HARMONIC, information.shape[1])
    information[:, places, places] += weight[:, None]
    gap = np.where((spread <= _HELD)[:, None], 0.0, shifts[:, ELLIPSE_PARAMETERS:])
    pull[:, FIRST_HARMONIC:] -= weight[:, None] * gap


_PIXEL_VARIANCE_PX2 = 1.0 / 12.0
_MIN_SIGMA_PX = 0.3
_OUTLIER_SIGMA = 4.5
_WHOLE = 0.9
_BINS = 32
_STEPS = 3
_FAR_SHIFT_PX, _CONVERGED_PX = 0.25, 0.02
_HIDING_SIGMA = 3.0
_MEAN_SLOPE = 0.35
"""RMS of the unit normal density within one sigma."""


@dataclass(frozen=True)
class Start:
    """Where the fits begin: ``ellipse`` (B, 5), ``harmonics`` (B, 8), ``blur_px`` and ``inner``
    level (B,), noise ``sigma_outer`` and ``sigma_inner`` (B,) as shares of the background."""

    ellipse: Array
    harmonics: Array
    blur_px: Array
    inner: Array
    sigma_outer: Array
    sigma_inner: Array

    def __len__(self) -> int:
        return int(self.ellipse.shape[0])

    def __getitem__(self, index: Index) -> Start:
        return Start(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass(frozen=True)
class Outlines:
    """Fitted outlines of B bubbles.

    ``ellipse`` (B, 5), ``harmonics`` (B, 8; 0 where ``resolved`` is False), ``sigma_px`` blur of
    optics and pixel, ``outer`` and ``inner`` levels, ``centre_covariance_px2`` (B, 2, 2),
    ``sigma_outline_px`` of a harmonic's coefficient, ``chi2_dof``, ``coverage`` (share of the
    outline that was seen), ``misfit_px`` (how far the rim strays from the outline, beyond noise)
    and ``shift_px`` (largest displacement since the linearisation).
    """

    ellipse: Array
    harmonics: Array
    resolved: Bools
    sigma_px: Array
    outer: Array
    inner: Array
    centre_covariance_px2: Array
    sigma_outline_px: Array
    chi2_dof: Array
    coverage: Array
    misfit_px: Array
    shift_px: Array

    @property
    def blur_px(self) -> Array:
        """Blur (B,) of the optics alone."""
        return np.asarray(np.sqrt(np.maximum(self.sigma_px**2 - _PIXEL_VARIANCE_PX2, 0.0)))

    def state(self, index: Index) -> RimState:
        """The outlines ``index`` as a point to go on from."""
        every = (self.ellipse, self.harmonics, self.sigma_px, self.outer, self.inner)
        return RimState(*(values[index] for values in every))

    def updated(self, index: Index, other: Outlines) -> Outlines:
        """These outlines with those at ``index`` replaced by ``other``."""
        changed = {}
        for field in fields(self):
            changed[field.name] = getattr(self, field.name).copy()
            changed[field.name][index] = getattr(other, field.name)
        return Outlines(**changed)


def fit_outlines(ratio: Float32, start: Start) -> Outlines:
    """Fit B outlines to the normalised image ``ratio`` (grey over background).

    Pixels inside or near another bubble of ``start`` are left out, and so are glare, dirt and
    whatever else is unlike a rim. A first look at some of the pixels brings blur and levels; the
    fit to all is repeated for outlines that moved far or are partly hidden.
    """
    everyone = np.arange(len(start))
    state = RimState(
        start.ellipse,
        start.harmonics,
        np.sqrt(start.blur_px**2 + _PIXEL_VARIANCE_PX2),
        np.ones(len(start)),
        start.inner,
    )
    state = _first_look(ratio, state, start)
    fit = _refined(ratio, state, start, state, everyone, np.full(len(start), _FREE))
    partial = fit.coverage < _WHOLE
    again = np.flatnonzero(partial | (fit.shift_px > _FAR_SHIFT_PX))
    for _ in range(2):
        if again.size == 0:
            break
        prior = learnt_spread(fit, partial)
        near = _refined(
            ratio, fit.state(again), start[again], fit.state(everyone), again, prior[again]
        )
        fit = fit.updated(again, near)
        again = again[near.shift_px > _FAR_SHIFT_PX]
    return fit


def _first_look(ratio: Float32, state: RimState, start: Start) -> RimState:
    """Ellipse, blur and levels from a share of the pixels within a narrow band."""
    pixels = rim_pixels(ratio, state.ellipse, state.sigma, _bulge(state), thin=True)
    linear = linearised(state, pixels)
    distance, sigma = _distance(state, pixels, linear), spread(state.sigma, pixels.counts)
    depth = np.minimum(2.0 * state.sigma + 0.5, 0.45 * state.ellipse[:, 3])
    used = (distance > -spread(depth, pixels.counts)) & (distance < 2.5 * sigma + 1.0)
    everyone = np.arange(len(start))
    used &= ~pixels.hidden(state.ellipse, state.ellipse, _HIDING_SIGMA * state.sigma, everyone)
    weight = spread(1.0 / start.sigma_outer**2, pixels.counts) * used.astype(np.float32)
    prior = np.full(len(start), _HELD)
    descent = _descend(state, pixels, linear, weight, start, prior, steps=2)
    return _moved(descent.state, descent.shifts)


def _bulge(state: RimState) -> Array:
    return np.asarray(np.sum(np.abs(state.harmonics), axis=1))


def _distance(state: RimState, pixels: Pixels, linear: Linear) -> Float32:
    bump = linear.displacements(pixels, _shifts(state))
    return np.asarray(linear.foot.distance - bump, dtype=np.float32)


def _shifts(state: RimState) -> Array:
    return np.concatenate([np.zeros_like(state.ellipse), state.harmonics], axis=1)


@dataclass(frozen=True)
class _Descent:
    """Where Gauss-Newton stands: ``shifts`` (B, 13) since the linearisation, covariance
    (B, 16, 16) and what is left of the grey levels (N,)."""

    state: RimState
    shifts: Array
    covariance: Array
    residual: Float32
    shift_px: Array


def _refined(
    ratio: Float32,
    state: RimState,
    start: Start,
    everyone: RimState,
    own: Index,
    prior: Array,
) -> Outlines:
    """One linearisation: pixels, window, steps, results of the bubbles ``own`` of everyone."""
    pixels = rim_pixels(ratio, state.ellipse, state.sigma, _bulge(state))
    linear = linearised(state, pixels)
    hidden = pixels.hidden(state.ellipse, everyone.ellipse, _HIDING_SIGMA * everyone.sigma, own)
    weight = _window(state, pixels, linear, start, hidden)
    prior = np.where(linear.resolved, prior, _HELD)
    descent = _descend(state, pixels, linear, weight, start, prior, steps=_STEPS)
    return _result(descent, pixels, linear, weight, hidden, start)


def _window(
    state: RimState, pixels: Pixels, linear: Linear, start: Start, hidden: Bools
) -> Float32:
    """Weights (N,): inverse variances, 0 for what must not be looked at."""
    counts = pixels.counts
    grey, _, inside = rim_model(state, pixels, linear, _shifts(state))
    outside, change = start.sigma_outer**2, start.sigma_inner**2 - start.sigma_outer**2
    inverse = 1.0 / (spread(outside, counts) + spread(change, counts) * inside)
    distance, sigma = _distance(state, pixels, linear), spread(state.sigma, counts)
    kept = (np.abs(distance) < 3.0 * sigma + 0.5) & ~hidden
    residual = (pixels.value - grey) * np.sqrt(inverse)
    contrast = (state.outer - state.inner) / start.sigma_outer
    kept &= ~unlike_rim(pixels, linear.foot, distance, residual, state.sigma, contrast)
    limit = _OUTLIER_SIGMA * np.maximum(_typical_residual(residual, pixels, kept), 1.0)
    kept &= np.abs(residual) < spread(limit, counts)
    return np.asarray((inverse * kept).astype(np.float32))


def _typical_residual(residual: Float32, pixels: Pixels, kept: Bools) -> Array:
    typical = np.ones(pixels.bubbles)
    for index, part in enumerate(pixels.parts()):
        own = np.abs(residual[part][kept[part]])
        if own.size > 8:
            typical[index] = robust_sd(own)
    return typical


def _descend(
    state: RimState,
    pixels: Pixels,
    linear: Linear,
    weight: Float32,
    start: Start,
    prior: Array,
    *,
    steps: int,
) -> _Descent:
    """Gauss-Newton at fixed feet."""
    first, shifts = state, _shifts(state)
    for index in range(steps):
        grey, jacobian, _ = rim_model(state, pixels, linear, shifts)
        residual = pixels.value - grey
        information, pull = normal_equations(jacobian, residual, weight, pixels)
        prior_equations(information, pull, state, shifts, start.inner, prior)
        step, covariance = _solved(information, pull)
        step = _limited(step, state)
        shifts = shifts + np.delete(step, (BLUR, OUTER, INNER), axis=1)
        state = replace(
            state,
            sigma=np.maximum(state.sigma + step[:, BLUR], _MIN_SIGMA_PX),
            outer=state.outer + step[:, OUTER],
            inner=state.inner + step[:, INNER],
        )
        reach = np.max(np.abs(step[:, :BLUR]), axis=1)
        if index + 1 == steps or float(np.max(reach)) < _CONVERGED_PX:
            break
    for part, own in zip(pixels.parts(), step.astype(np.float32), strict=True):
        residual[part] -= own @ jacobian[:, part]
    since = np.max(np.abs(shifts - _shifts(first)), axis=1)
    return _Descent(state, shifts, covariance, residual, since)


def _solved(information: Array, pull: Array) -> tuple[Array, Array]:
    """Steps (B, 16) and covariances (B, 16, 16)."""
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("bii->bi", information), 1e-12))
    equilibrated = information * scale[:, :, None] * scale[:, None, :]
    diagonal = np.arange(PARAMETERS)
    equilibrated[:, diagonal, diagonal] += 1e-7
    covariance = np.linalg.inv(equilibrated) * scale[:, :, None] * scale[:, None, :]
    step: Array = (covariance @ pull[..., None])[..., 0]
    return step, covariance


def _limited(step: Array, state: RimState) -> Array:
    """Steps that keep within the range where the linearisation holds."""
    reach = np.max(np.abs(step[:, :BLUR]), axis=1)
    share = np.minimum(1.0, np.minimum(1.5, 0.3 * state.ellipse[:, 3]) / (reach + 1e-12))
    share = np.minimum(share, 0.4 * state.sigma / (np.abs(step[:, BLUR]) + 1e-12))
    return np.asarray(step * share[:, None])


def _moved(state: RimState, shifts: Array) -> RimState:
    ellipse, turn = moved(state.ellipse, shifts[:, :BLUR])
    return replace(state, ellipse=ellipse, harmonics=turned_harmonics(shifts[:, BLUR:], turn))


def _coverage(pixels: Pixels, linear: Linear, weight: Float32, sigma: Array) -> Array:
    """Share of the outline (B,) at which pixels at the edge were looked at."""
    close = np.abs(linear.foot.distance) < spread(1.2 * sigma + 0.3, pixels.counts)
    near = np.flatnonzero(close & (weight > 0.0))
    angle = np.arctan2(linear.foot.sin[near], linear.foot.cos[near])
    slot = ((angle + np.pi) * (_BINS / (2.0 * np.pi))).astype(np.intp) % _BINS
    seen = np.bincount(pixels.owner[near] * _BINS + slot, minlength=pixels.bubbles * _BINS)
    return np.asarray(np.mean(seen.reshape(-1, _BINS) > 0, axis=1))


def _misfit(
    state: RimState, pixels: Pixels, linear: Linear, residual: Float32, hidden: Bools, start: Start
) -> Array:
    """RMS distance (B,) between rim and outline: grey residuals over the edge's slope.

    At the edge's steepest, outliers included, with the noise's share taken away.
    """
    counts = pixels.counts
    near = np.abs(_distance(state, pixels, linear)) < spread(state.sigma, counts)
    near &= ~hidden
    count = np.maximum(pixels.sums(near.astype(np.float32)), 1.0)
    excess = pixels.sums(near * residual**2) / count - start.sigma_outer**2
    slope = _MEAN_SLOPE * (state.outer - state.inner) / state.sigma
    return np.asarray(np.sqrt(np.maximum(excess, 0.0)) / np.maximum(slope, 1e-9))


def _result(
    descent: _Descent,
    pixels: Pixels,
    linear: Linear,
    weight: Float32,
    hidden: Bools,
    start: Start,
) -> Outlines:
    """Covariances are widened by chi2_dof where that exceeds 1 by 3 sigma."""
    state = _moved(descent.state, descent.shifts)
    fitted = np.where(linear.resolved, PARAMETERS, FIRST_HARMONIC)
    dof = np.maximum(pixels.sums((weight > 0.0).astype(np.float32)) - fitted, 1.0)
    chi2_dof = pixels.sums(weight * descent.residual**2) / dof
    misfit = np.where(chi2_dof > 1.0 + 3.0 * np.sqrt(2.0 / dof), chi2_dof, 1.0)
    covariance = descent.covariance * misfit[:, None, None]
    angle = descent.state.ellipse[:, 4]
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)
    variances = np.einsum("bii->bi", covariance)[:, FIRST_HARMONIC:]
    return Outlines(
        state.ellipse,
        np.where(linear.resolved[:, None], state.harmonics, 0.0),
        linear.resolved,
        state.sigma,
        state.outer,
        state.inner,
        turn @ covariance[:, :2, :2] @ np.swapaxes(turn, 1, 2),
        np.sqrt(np.maximum(np.mean(variances, axis=1), 0.0)),
        chi2_dof,
        _coverage(pixels, linear, weight, state.sigma),
        _misfit(state, pixels, linear, descent.residual, hidden, start),
        descent.shift_px,
    )
