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

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from telerig.arrays import Array, Bools, Float32, Ints, Rows
from telerig.estimator.bubbles.outline import kernels
from telerig.estimator.bubbles.outline.ellipse_geometry import Index
from telerig.rig.outline import HARMONICS, points_on
from telerig.statistics import robust_sd

_NODES = 96


@dataclass(frozen=True)
class Outlines(Rows):
    """Hold the outlines of B bubbles: their parameters, and what a fit has shown of them.

    parameters : (B, 16) ellipse, blur, outer and inner level, harmonics; see `kernels`.
    shown : (B, 9).
    """

    parameters: Array
    shown: Array

    @property
    def ellipse(self) -> Array:
        """(B, 5) ellipses."""
        return self.parameters[:, : kernels.ELLIPSE]

    @property
    def sigma_px(self) -> Array:
        """(B,) standard deviation of the blur of optics and pixel together (px)."""
        return self.parameters[:, kernels.BLUR]

    @property
    def outer(self) -> Array:
        """(B,) grey level outside, as a share of the background."""
        return self.parameters[:, kernels.OUTER]

    @property
    def inner(self) -> Array:
        """(B,) grey level inside, as a share of the background."""
        return self.parameters[:, kernels.INNER]

    @property
    def harmonics(self) -> Array:
        """(B, 8) coefficients (px); 0 where they are not resolved."""
        return self.parameters[:, kernels.HARMONIC :]

    @property
    def covariance_px2(self) -> Array:
        """(B, 2, 2) covariance of the ellipse's centre (px^2)."""
        return self.shown[:, kernels.COVARIANCE : kernels.SIGMA_OUTLINE].reshape(-1, 2, 2)

    @property
    def sigma_outline_px(self) -> Array:
        """(B,) standard deviation of a harmonic's coefficient (px), NaN if the bubble is too small
        for its blur to have harmonics."""
        return self.shown[:, kernels.SIGMA_OUTLINE]

    @property
    def chi2_dof(self) -> Array:
        """(B,) chi-square per degree of freedom."""
        return self.shown[:, kernels.CHI2]

    @property
    def coverage(self) -> Array:
        """(B,) share of the outline that is visible, 0 to 1."""
        return self.shown[:, kernels.COVERAGE]

    @property
    def misfit_px(self) -> Array:
        """(B,) RMS distance between the rim in the image and the outline, beyond the noise."""
        return self.shown[:, kernels.MISFIT]

    @property
    def shift_px(self) -> Array:
        """(B,) largest displacement since the linearisation (px)."""
        return self.shown[:, kernels.SHIFT]

    def changed(self, **values: Array | float) -> Outlines:
        """Return a copy with other values of some properties."""
        copy = Outlines(self.parameters.copy(), self.shown.copy())
        for name, value in values.items():
            getattr(copy, name)[:] = value
        return copy

    def updated(self, index: Index | Bools, other: Outlines) -> Outlines:
        """Return a copy with the outlines at the positions ``index`` replaced by ``other``."""
        copy = Outlines(self.parameters.copy(), self.shown.copy())
        copy.parameters[index], copy.shown[index] = other.parameters, other.shown
        return copy


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


_FREE, _UNLEARNT, _LEAST = 0.25, 0.02, 0.001
"""Prior standard deviations of the harmonics' coefficients, as shares of the radius. The first is
so wide that it does not affect whole outlines. The second holds if there are no whole outlines to
learn from. The third is the least value that is learnt."""
_UNLEARNT_FLATTENING, _LEAST_FLATTENING = 0.08, 0.01
"""The same two for the flattening (a - b) / (a + b)."""
_WIDENED = 1.5
"""What is learnt from a few outlines holds for others within so much."""
_MEDIAN_OF_TWO = 0.693
"""Median of the mean of two squares of unit variance."""
_ENOUGH_WHOLE, _ENOUGH_OUTLINES = 4, 8
_WHOLE = 0.9
_FAR_SHIFT_PX = 0.25
_STEPS = 3
_ANGLES, _BEYOND_CHANCE = 64, 3.0
_MISFIT_PX, _MISFIT_SHARE = 0.15, 0.005
_ODD, _BAD_FIT = 4.0, 1.5
"""Standard deviations of the shapes of an image, and chi2_dof, beyond which it is no bubble."""


def start_outlines(ellipse: Array, blur_px: Array, inner: Array) -> Outlines:
    """Return outlines (B,) before the fit: ellipses (B, 5), blur of the optics (B,) in px, and grey
    level inside (B,), as a share of the background."""
    many = len(ellipse)
    sigma = np.sqrt(blur_px**2 + kernels.PIXEL_VARIANCE_PX2)
    levels, harmonics = [sigma, np.ones(many), inner], np.zeros((many, 2 * len(HARMONICS)))
    return Outlines(np.column_stack([ellipse, *levels, harmonics]), _nothing_shown(many))


def _nothing_shown(many: int) -> Array:
    shown = np.zeros((many, kernels.SHOWN))
    shown[:, kernels.SIGMA_OUTLINE] = np.nan
    return shown


def blur_px(outlines: Outlines) -> Array:
    """Return the blur (B,) of the optics alone (standard deviation, px)."""
    return np.asarray(np.sqrt(np.maximum(outlines.sigma_px**2 - kernels.PIXEL_VARIANCE_PX2, 0.0)))


def radius_px(outlines: Outlines) -> Array:
    """Return the radius (B,) of the circle of an ellipse's area (px)."""
    return np.asarray(np.sqrt(np.abs(outlines.ellipse[:, 2] * outlines.ellipse[:, 3])))


def _whole(outlines: Outlines) -> Bools:
    return np.asarray((outlines.coverage >= _WHOLE) & np.isfinite(outlines.sigma_outline_px))


def shape_spread(outlines: Outlines) -> Array | None:
    """Return the standard deviation (4,) of the coefficients of each order over the whole outlines
    of an image, as shares of the radius; None if these are too few.
    """
    whole = outlines.take(_whole(outlines))
    if len(whole) < _ENOUGH_WHOLE:
        return None
    square = np.median(_power(whole), axis=0) / _MEDIAN_OF_TWO
    return np.maximum(np.sqrt(square), _LEAST)


def _power(outlines: Outlines) -> Array:
    """Return the mean squares (B, 4) of both coefficients of each order, as shares of the radius's
    square."""
    share = (outlines.harmonics / radius_px(outlines)[:, None]).reshape(-1, len(HARMONICS), 2)
    return np.asarray(np.mean(share**2, axis=2))


def implausible_outlines(outlines: Outlines) -> tuple[Bools, Array]:
    """Return which outlines (B,) of an image cannot belong to a single bubble, and the variance
    (B,) in px^2 of the centres of those that may.

    They miss the rim, or they fit badly and turn inwards or have a shape that is unlike the others
    of the image: an order of their coefficients is many standard deviations off. What bends an
    outline that fits badly beyond the shapes of the image has moved it as much: this is the
    variance.
    """
    learnt, radius2 = shape_spread(outlines), radius_px(outlines) ** 2
    spread = np.full(len(HARMONICS), _UNLEARNT) if learnt is None else learnt
    own2 = np.nan_to_num(outlines.sigma_outline_px, nan=np.inf)[:, None] ** 2 / radius2[:, None]
    power = _power(outlines)
    odd = np.max(power / (spread**2 + own2), axis=1) > _ODD**2
    bad = fits_badly(outlines)
    beyond = 2.0 * np.sum(np.maximum(power - spread**2, 0.0), axis=1) * radius2
    if np.any(bad):
        odd[bad] |= _concave(outlines.take(bad))
    return (odd & bad) | missed_rims(outlines), np.where(bad, beyond, 0.0)


def _concave(outlines: Outlines) -> Bools:
    """Return which outlines (B,) turn inwards somewhere, beyond what their errors allow.

    The outline of one bubble is convex; that of two turns inwards where their rims meet.
    """
    phi = np.linspace(0.0, 2.0 * np.pi, _ANGLES, endpoint=False)
    points = points_on(outlines.ellipse, outlines.harmonics, phi) @ np.array([1.0, 1j])
    edge = np.roll(points, -1, axis=1) - points
    after = np.roll(edge, -1, axis=1)
    # Curvature times radius, 1 on a circle; a wave of order k changes it by (k^2 - 1) of its share.
    turn = 2.0 * np.angle(after / edge) / (np.abs(edge) + np.abs(after))
    order = np.array(HARMONICS)
    sd = float(np.linalg.norm(order**2 - 1)) * outlines.sigma_outline_px / radius_px(outlines)
    return np.asarray(np.min(turn, axis=1) * radius_px(outlines) < -_BEYOND_CHANCE * sd)


def fits_badly(outlines: Outlines, usual: float = 1.0) -> Bools:
    """Return which outlines (B,) leave more than noise unexplained.

    usual : chi-square per degree of freedom that most outlines of the image have at least.
    """
    return np.asarray(outlines.chi2_dof > _BAD_FIT * usual)


def usual_misfit(outlines: Outlines) -> float:
    """Return the median chi-square per degree of freedom, at least 1; 1 if outlines are few."""
    many = len(outlines) >= _ENOUGH_OUTLINES
    return max(float(np.median(outlines.chi2_dof)), 1.0) if many else 1.0


def missed_rims(outlines: Outlines) -> Bools:
    """Return which outlines (B,) do not follow the rim that they were fitted to."""
    allowed = _MISFIT_PX + _MISFIT_SHARE * radius_px(outlines)
    return np.asarray(outlines.misfit_px > allowed)


def learnt_prior(outlines: Outlines, inner: Array, partial: Bools) -> Array:
    """Return a prior of each outline's shape (B, 8), see `kernels`.

    That of outlines that are partly hidden is learnt from the whole ones of the same image, order
    by order, because the coefficients fall with the order. All others have a weak prior.

    inner : (B,) prior mean of the grey level inside; partial : (B,) which are partly hidden.
    """
    prior = np.zeros((len(inner), kernels.PRIOR_HARMONICS + len(HARMONICS)))
    flattening = slice(kernels.PRIOR_FLATTENING, kernels.PRIOR_SPREAD)
    prior[:, kernels.PRIOR_INNER] = inner
    prior[:, kernels.PRIOR_SPREAD] = np.where(partial, _UNLEARNT_FLATTENING, np.inf)
    prior[:, kernels.PRIOR_HARMONICS :] = np.where(partial, _UNLEARNT, _FREE)[:, None]
    spread = shape_spread(outlines)
    if spread is not None:
        prior[partial, kernels.PRIOR_HARMONICS :] = _WIDENED * spread
        a, b, angle = outlines.ellipse[_whole(outlines), 2:].T
        own = np.stack([np.cos(2.0 * angle), np.sin(2.0 * angle)], 1) * ((a - b) / (a + b))[:, None]
        middle = np.median(own, axis=0)
        sd = max(_WIDENED * float(robust_sd(own - middle)), _LEAST_FLATTENING)
        prior[partial, flattening], prior[partial, kernels.PRIOR_SPREAD] = middle, sd
    return prior


def fit_outlines(
    ratio: Float32,
    start: Outlines,
    noise: Array,
    *,
    beside: Outlines | None = None,
    shadows: bool = False,
) -> Outlines:
    """Fit the outlines of B bubbles to an image.

    ratio : (rows, columns) grey levels divided by the background.
    start : see `start_outlines`.
    noise : (2,) standard deviation of a pixel outside and inside, as shares of the background.
    beside : outlines of the image that are fitted already and stay.
    shadows : whether the image has shadows of bubbles out of focus or behind others, so that the
        covariance of whole outlines has that, too.

    Pixels inside or near another bubble are left out, and so are glare, dirt and other pixels that
    do not look like a rim. A first fit to some of the pixels yields blur and levels. The fit to all
    pixels is repeated for outlines that moved far or are partly hidden. The covariance of the
    latter, and of outlines that fit worse than the noise explains, has what their residuals show of
    neighbours that mislead them.
    """
    image, below = np.ascontiguousarray(ratio, np.float32), 2.0 if shadows else _WHOLE
    others = start.take(slice(0, 0)) if beside is None else beside

    def fitted(outlines: Outlines, own: Index, prior: Array, steps: int) -> Outlines:
        fit = Outlines(outlines.parameters[own], _nothing_shown(len(own)))
        every = Outlines.concat([outlines, others]).parameters
        rims = np.ascontiguousarray(every[:, : kernels.BLUR + 1])
        kernels.fitted(
            image, profile_table(), noise, rims, own, prior[own], fit.parameters, fit.shown,
            steps, below,
        )  # fmt: skip
        return fit

    own = np.arange(len(start))
    prior = learnt_prior(start, start.inner, np.zeros(own.size, np.bool_))
    fit = fitted(fitted(start, own, prior, 0), own, prior, _STEPS)
    again = (fit.coverage < _WHOLE) | (fit.shift_px > _FAR_SHIFT_PX)
    for _ in range(2):
        own = np.flatnonzero(again)
        if own.size == 0:
            break
        known = Outlines.concat([fit, others])
        prior = learnt_prior(known, start.inner, fit.coverage < _WHOLE)
        fit = fit.updated(own, fitted(fit, own, prior, _STEPS))
        again = fit.shift_px > _FAR_SHIFT_PX
    return fit


def ellipses_along(points: Array, sizes: Ints) -> tuple[Array, Array]:
    """Fit an ellipse robustly to each of B arcs of points.

    points : (N, 2) the arcs' points (px), one arc after the other; sizes : (B,) their numbers.

    Returns the ellipses (B, 5) and the RMS distance (B,) of their points. A prior of 12 % of the
    radius on a - b and on the shear keeps ellipses through short arcs nearly circular.
    """
    ellipses, rms = np.empty((len(sizes), kernels.ELLIPSE)), np.empty(len(sizes))
    kernels.fitted_arcs(points, sizes, ellipses, rms)
    return ellipses, rms
