"""Sub-pixel outlines: maximum-likelihood fit of ellipse and harmonics to the pixels at the rim.

The pixels along the rims of all bubbles are gathered first, without glare and dirt. The model of a
pixel is ``outer + (inner - outer) F``, with F the profile of a blurred disc (`rim_profile`) at the
pixel's distance from the outline and the ellipse's curvature there. A straight edge blurred by a
Gaussian is an error function. Where the blur is not small against the radius of curvature the
profile is shifted inwards and skewed; with the osculating circle in place of the outline it is a
function of two numbers only, tabulated here.

The outline is an ellipse with normal displacements of orders 3 to 6 in the eccentric anomaly. In
that parametrisation the centre is orthogonal to the harmonics (b cos phi / h times cos k phi,
integrated along the arc h dphi, is zero), so fitting them costs a whole outline nothing. Where a
part is hidden it does, and the harmonics of the frame's whole outlines serve as prior.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np

from telerig.arrays import Array, Bools, Float32
from telerig.estimator.bubbles.outline import kernels
from telerig.estimator.bubbles.outline.ellipse_geometry import Index, moved, turned_harmonics
from telerig.statistics import robust_sd

_NODES = 96


def close_pairs(
    ellipse: Array, everyone: Array, reach_px: Array, reach_everyone_px: Array, own: Index
) -> list[tuple[int, int]]:
    """Find pairs of ellipses that may be near each other.

    ellipse : (B, 5) ellipses
    everyone : (A, 5) ellipses with which they are compared.
    reach_px, reach_everyone_px : (B,), (A,) widths (px) of the surroundings of each ellipse.
    own : (B,) positions of the B ellipses in ``everyone``; these pairs are left out.

    Returns pairs (position in ``ellipse``, position in ``everyone``).
    """
    size, other_size = ellipse[:, 2] + 2.0 * reach_px, everyone[:, 2] + 2.0 * reach_everyone_px
    gap = np.hypot(
        ellipse[:, None, 0] - everyone[None, :, 0], ellipse[:, None, 1] - everyone[None, :, 1]
    )
    near = gap < size[:, None] + other_size[None, :]
    near[np.arange(own.size), own] = False
    return [(int(i), int(j)) for i, j in np.argwhere(near)]


def blurred_disc(distance: Array, radius: Array) -> Array:
    """Return the share (0 to 1) that a disc covers after a Gaussian blur of standard deviation 1.

    distance : distance of the place from the disc's rim, positive outside, in units of the blur.
    radius : radius of the disc, in units of the blur.

    The chord integral int phi(y) [Phi(c - r) - Phi(-c - r)] dy with c^2 = R^2 - y^2, by
    Gauss-Legendre quadrature. Shapes broadcast.
    """
    from scipy.special import ndtr

    node, weight = np.polynomial.legendre.leggauss(_NODES)
    radius, distance = np.asarray(radius)[..., None], np.asarray(distance)[..., None]
    reach = np.minimum(radius, 7.0)
    angle = np.arcsin(np.minimum(reach / radius, 1.0)) * node
    y = radius * np.sin(angle)
    sagitta = 2.0 * radius * np.sin(angle / 2.0) ** 2
    density = np.exp(-(y**2) / 2.0) / np.sqrt(2.0 * np.pi) * radius * np.cos(angle)
    density = density * np.arcsin(np.minimum(reach / radius, 1.0)) * weight
    near, far = -distance - sagitta, -2.0 * radius - distance + sagitta
    return np.asarray(np.sum(density * (ndtr(near) - ndtr(far)), axis=-1))


@lru_cache(maxsize=1)
def profile_table() -> Array:
    """Return the profile of a blurred disc (curvatures, distances), see `blurred_disc`."""
    from scipy.special import ndtr

    limit, step = kernels.DISTANCE_LIMIT, kernels.DISTANCE_STEP
    t = np.arange(-limit, limit + step / 2, step)
    limit, step = kernels.CURVATURE_LIMIT, kernels.CURVATURE_STEP
    q = np.arange(step, limit + step / 2, step)
    return np.stack([ndtr(-t), *(blurred_disc(t, np.full(1, 1.0 / value)) for value in q)])


_FREE, _UNLEARNT, _LEAST = 0.25, 0.02, 0.002
"""Prior standard deviations of the harmonics' coefficients, as shares of the radius. The first is
so wide that it does not affect whole outlines. The second holds if there are no whole outlines to
learn from. The third is the least value that is learnt."""

_WIDENED = 1.5
_ENOUGH_WHOLE = 4


_UNLEARNT_FLATTENING, _LEAST_FLATTENING = 0.08, 0.01
"""The same two for the flattening (a - b) / (a + b)."""


@dataclass(frozen=True)
class Prior:
    """Hold what is known of B outlines before the fit.

    harmonics : (B,) standard deviation of the harmonics' coefficients, as a share of the radius.
    flattening : (B, 2) mean of (a - b) / (a + b) times cosine and sine of twice the angle.
    flattening_spread : (B,) standard deviation of both; infinite for none.
    """

    harmonics: Array
    flattening: Array
    flattening_spread: Array

    @staticmethod
    def weak(harmonics: Array) -> Prior:
        """Return the prior without information on the flattening."""
        count = len(harmonics)
        return Prior(harmonics, np.zeros((count, 2)), np.full(count, np.inf))

    def taken(self, index: Index) -> Prior:
        """Return that of the outlines at the positions ``index``."""
        return Prior(*(getattr(self, field.name)[index] for field in fields(self)))


def learnt_prior(outlines: Outlines, partial: Bools, *, flattening: bool) -> Prior:
    """Return a prior of each outline's shape.

    That of partly hidden outlines is estimated from the whole outlines of the same frame. All
    others get a weak prior, and all do if too few outlines are whole.

    partial : (B,) True for outlines that are partly hidden.
    flattening : whether the flattening is estimated from the whole outlines, too.
    """
    prior = Prior.weak(np.where(partial, learnt_spread(outlines), _FREE))
    if flattening:
        middle, spread = np.zeros(2), _UNLEARNT_FLATTENING
        a, b, angle = outlines.ellipse[outlines.resolved & ~partial, 2:].T
        if len(a) >= _ENOUGH_WHOLE:
            share = ((a - b) / (a + b))[:, None]
            own = share * np.stack([np.cos(2.0 * angle), np.sin(2.0 * angle)], axis=1)
            middle = np.median(own, axis=0)
            spread = max(_WIDENED * float(robust_sd(own - middle)), _LEAST_FLATTENING)
        prior.flattening[partial], prior.flattening_spread[partial] = middle, spread
    return prior


def learnt_spread(outlines: Outlines) -> float:
    """Return the prior standard deviation of partly hidden outlines' harmonics, in radii.

    It is learnt from the frame's whole outlines. The prior of these has no effect.
    """
    whole = outlines.resolved & (outlines.coverage >= _WHOLE)
    if np.count_nonzero(whole) < _ENOUGH_WHOLE:
        return _UNLEARNT
    radius = np.sqrt(outlines.ellipse[whole, 2] * outlines.ellipse[whole, 3])
    typical = np.median(np.mean((outlines.harmonics[whole] / radius[:, None]) ** 2, axis=1))
    return max(_WIDENED * float(np.sqrt(typical)), _LEAST)


_PIXEL_VARIANCE_PX2 = 1.0 / 12.0
_RESOLVED_BLURS = 3.0
_WHOLE = 0.9
_FIRST_STEPS = 2
_FAR_SHIFT_PX = 0.25
_CHANCE = 1.75
"""Three standard deviations above 1 of the mean of 32 squares: two coordinates, 16 sectors."""
_UNEVEN_LIGHT = np.pi / 4.0
_SHAPE_TO_CENTRE = 8.0
_MEAN_SLOPE = 0.35
"""RMS of the unit normal density within one sigma."""


@dataclass(frozen=True)
class Start:
    """Hold the start values of the fits of B outlines.

    ellipse : (B, 5) ellipses
    harmonics : (B, 8) coefficients (px).
    blur_px : (B,) standard deviation of the optical blur (px).
    inner : (B,) grey level inside the bubble, as a share of the background.
    sigma_outer, sigma_inner : (B,) standard deviation of a pixel's noise outside and inside the
        bubble, as shares of the background.
    """

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
class RimState:
    """Hold the outlines of B bubbles during a fit.

    ellipse : (B, 5) ellipses
    harmonics : (B, 8) coefficients (px).
    sigma : (B,) standard deviation of the edges' blur, including the pixel (px).
    outer, inner : (B,) grey levels outside and inside the bubble, as shares of the background.
    """

    ellipse: Array
    harmonics: Array
    sigma: Array
    outer: Array
    inner: Array

    def rims(self, start: Start, prior: Prior) -> kernels.Rims:
        """Return the outlines as the fit takes them."""
        every = (
            *(getattr(self, field.name) for field in fields(self)),
            *(start.inner, start.sigma_outer, start.sigma_inner),
            *(prior.harmonics, prior.flattening, prior.flattening_spread),
        )
        return kernels.Rims(*(np.ascontiguousarray(values, np.float64) for values in every))


@dataclass(frozen=True)
class Outlines:
    """Hold the fitted outlines of B bubbles.

    ellipse : (B, 5) ellipses.
    harmonics : (B, 8) coefficients (px); they are 0 where ``resolved`` is False.
    resolved : (B,) whether the bubble is large enough, compared with its blur, to fit harmonics.
    sigma_px : (B,) standard deviation of the blur of optics and pixel together (px).
    outer, inner : (B,) grey levels outside and inside, as shares of the background.
    centre_covariance_px2 : (B, 2, 2) covariance of the ellipse's centre (px^2).
    misled_px2 : (B, 2, 2) what pixels that err together and uneven light add to it (px^2).
    sigma_outline_px : (B,) standard deviation of a harmonic's coefficient (px).
    chi2_dof : (B,) chi-square per degree of freedom.
    coverage : (B,) share of the outline that is visible, 0 to 1.
    misfit_px : (B,) RMS distance between the rim in the image and the outline, beyond the noise
        (px).
    shift_px : (B,) largest displacement since the linearisation (px).
    """

    ellipse: Array
    harmonics: Array
    resolved: Bools
    sigma_px: Array
    outer: Array
    inner: Array
    centre_covariance_px2: Array
    misled_px2: Array
    sigma_outline_px: Array
    chi2_dof: Array
    coverage: Array
    misfit_px: Array
    shift_px: Array

    @property
    def blur_px(self) -> Array:
        """Return the blur (B,) of the optics alone (standard deviation, px)."""
        return np.asarray(np.sqrt(np.maximum(self.sigma_px**2 - _PIXEL_VARIANCE_PX2, 0.0)))

    def state(self, index: Index) -> RimState:
        """Return the outlines at the positions ``index`` as the state from which a fit goes on."""
        every = (self.ellipse, self.harmonics, self.sigma_px, self.outer, self.inner)
        return RimState(*(values[index] for values in every))

    def taken(self, index: Index) -> Outlines:
        """Return the outlines at the positions ``index``."""
        return Outlines(*(getattr(self, field.name)[index] for field in fields(self)))

    def updated(self, index: Index, other: Outlines) -> Outlines:
        """Return a copy with the outlines at the positions ``index`` replaced by ``other``."""
        changed = {}
        for field in fields(self):
            changed[field.name] = getattr(self, field.name).copy()
            changed[field.name][index] = getattr(other, field.name)
        return Outlines(**changed)


def fit_outlines(ratio: Float32, start: Start, *, crowded: bool = False) -> Outlines:
    """Fit the outlines of B bubbles to an image.

    ratio : (rows, columns) grey levels divided by the background.
    start : start values of the B outlines.
    crowded : whether to measure what misleads fits in a crowd; without it ``misled_px2`` is 0.

    Pixels inside or near another bubble of ``start`` are left out, and so are glare, dirt and other
    pixels that do not look like a rim. A first fit to some of the pixels yields blur and levels.
    The fit to all pixels is repeated for outlines that moved far or are partly hidden.
    """
    ratio = np.ascontiguousarray(ratio, np.float32)
    everyone = np.arange(len(start))
    state = RimState(
        start.ellipse,
        start.harmonics,
        np.sqrt(start.blur_px**2 + _PIXEL_VARIANCE_PX2),
        np.ones(len(start)),
        start.inner,
    )
    state = _first_look(ratio, state, start)
    prior = Prior.weak(np.full(len(start), _FREE))
    fit = _refined(ratio, state, start, state, everyone, prior, crowded)
    partial = fit.coverage < _WHOLE
    again = np.flatnonzero(partial | (fit.shift_px > _FAR_SHIFT_PX))
    for _ in range(2):
        if again.size == 0:
            break
        prior = learnt_prior(fit, partial, flattening=not crowded).taken(again)
        near = _refined(
            ratio, fit.state(again), start[again], fit.state(everyone), again, prior, crowded
        )
        fit = fit.updated(again, near)
        again = again[near.shift_px > _FAR_SHIFT_PX]
    return fit


def widened(fit: Outlines) -> Outlines:
    """Add to the centres' covariances what misleads fits in a crowd.

    Besides ``misled_px2``: what bends an outline in the orders 3 to 6 shifts its centre, too,
    unless it is the bubble's own shape. The variance of the coefficients beyond noise and
    `learnt_spread` is added, times a factor found on rendered swarms: the variance falls with the
    order.
    """
    radius = np.sqrt(np.abs(fit.ellipse[:, 2] * fit.ellipse[:, 3]))
    own = learnt_spread(fit) * radius
    excess = np.mean(fit.harmonics**2, axis=1) - 2.0 * fit.sigma_outline_px**2 - own**2
    excess = _SHAPE_TO_CENTRE * np.where(fit.resolved, np.maximum(excess, 0.0), 0.0)
    covariance = fit.centre_covariance_px2 + fit.misled_px2 + excess[:, None, None] * np.eye(2)
    return replace(fit, centre_covariance_px2=covariance)


def _first_look(ratio: Float32, state: RimState, start: Start) -> RimState:
    """Fit ellipse, blur and levels to some of the pixels in a narrow band at the rim."""
    everyone = np.arange(len(start))
    rims = state.rims(start, Prior.weak(np.zeros(len(start))))
    found = kernels.fitted(
        ratio, profile_table(), rims, everyone, rims.ellipse, rims.sigma, _FIRST_STEPS, False
    )
    return _moved(state, found)


def _refined(
    ratio: Float32,
    state: RimState,
    start: Start,
    everyone: RimState,
    own: Index,
    prior: Prior,
    crowded: bool,
) -> Outlines:
    """Fit the outlines of some bubbles with one linearisation.

    state, start : the bubbles to fit; own : their positions in ``everyone``.
    everyone : the outlines of all bubbles in the image.
    """
    resolved = state.ellipse[:, 3] > _RESOLVED_BLURS * state.sigma
    rims = state.rims(start, replace(prior, harmonics=np.where(resolved, prior.harmonics, 0.0)))
    table = profile_table()
    found = kernels.fitted(
        ratio, table, rims, own, everyone.ellipse, everyone.sigma, kernels.STEPS, crowded
    )
    return _result(_moved(state, found), found, state, start, resolved)


def _moved(state: RimState, found: kernels.Fits) -> RimState:
    shifts = found.shifts
    ellipse, turn = moved(state.ellipse, shifts[:, : kernels.ELLIPSE])
    harmonics = turned_harmonics(shifts[:, kernels.ELLIPSE :], turn)
    return RimState(ellipse, harmonics, found.sigma, found.outer, found.inner)


def _misfit(state: RimState, found: kernels.Fits, start: Start) -> Array:
    """Return the RMS distance (B,) between the rim in the image and the outline (px).

    It is the RMS of the grey residuals near the steepest part of the edge, divided by the edge's
    slope. Outliers are included; the variance of the noise is subtracted.
    """
    excess = found.near_square / np.maximum(found.near, 1) - start.sigma_outer**2
    slope = _MEAN_SLOPE * (state.outer - state.inner) / state.sigma
    return np.asarray(np.sqrt(np.maximum(excess, 0.0)) / np.maximum(slope, 1e-9))


def _result(
    state: RimState, found: kernels.Fits, before: RimState, start: Start, resolved: Bools
) -> Outlines:
    """Make the public result of the fits.

    Covariances are multiplied by chi2_dof if this exceeds 1 by 3 standard deviations. What
    misleads multiplies that of the centre by `kernels.Fits.clustered`, if that is no chance, and
    uneven light moves a piece of rim by sqrt(pi / 2) sigma times its share of the contrast, and the
    centre by half of the variance (found on rendered swarms).
    """
    fitted = np.where(resolved, kernels.PARAMETERS, kernels.FIRST_HARMONIC)
    dof = np.maximum(found.used - fitted, 1.0)
    chi2_dof = found.chi2 / dof
    misfit = np.where(chi2_dof > 1.0 + 3.0 * np.sqrt(2.0 / dof), chi2_dof, 1.0)
    covariance = found.covariance * misfit[:, None, None]
    angle = before.ellipse[:, 4]
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)
    shared = np.where(found.clustered > _CHANCE, found.clustered, 1.0)
    misled = covariance[:, :2, :2] * (shared - 1.0)[:, None, None]
    misled += (_UNEVEN_LIGHT * found.light * state.sigma**2)[:, None, None] * np.eye(2)
    variances = np.einsum("bii->bi", covariance)[:, kernels.FIRST_HARMONIC :]
    return Outlines(
        state.ellipse,
        state.harmonics,
        resolved,
        state.sigma,
        state.outer,
        state.inner,
        turn @ covariance[:, :2, :2] @ np.swapaxes(turn, 1, 2),
        turn @ misled @ np.swapaxes(turn, 1, 2),
        np.sqrt(np.maximum(np.mean(variances, axis=1), 0.0)),
        chi2_dof,
        found.coverage,
        _misfit(state, found, start),
        found.moved_px,
    )
