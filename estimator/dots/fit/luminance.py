"""The luminance model of a dot (Lavest, Viala, Dhome, 1999) and its least-squares fit.

A pixel's grey level is ``B0 + B1 x + B2 y`` plus the blurred image of an ellipse of grey level
``C + C1 x + C2 y``, with (x, y) the offset from the window's middle in units of the dot's radius
(:mod:`telerig.estimator.dots.fit.blurred_ellipse`). A dot's contrast gradient (C1, C2) is nearly
indistinguishable from a shift of its centre, so it is never free: it has a Gaussian prior. The fit
is Levenberg-Marquardt; pixels that are outliers are left out.

The parameters (12,) are theta, which has centre (2), shape (3) and sigma, and the levels B0, B1,
B2, C, C1, C2. The contrast gradient acts before the blur: the Gaussian blur of x F_sharp is x F +
sigma^2 dF/dx. Without the second term a centre would shift by sigma^2 times the relative gradient;
its derivatives with respect to theta are neglected. The loops over pixels are in `kernels`.

A dot may have a heart, a disc inside it that is brighter or darker (:mod:`.hearts`). Four more
parameters are its centre (2), its size relative to the dot, and its contrast; it is as tilted and
as blurred as the dot.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np
from scipy.special import chdtri

from telerig.arrays import Array, Bools
from telerig.estimator.dots.fit.blurred_ellipse import approximate_distance_px, semi_axes
from telerig.estimator.dots.fit.kernels import (
    covariance_of,
    descend,
    normal_equations,
    predict,
    residual_sums,
)
from telerig.estimator.dots.fit.rim import NO_EDGE, edge_harmonics
from telerig.estimator.dots.thresholds import OUTLIER_SD, RARE
from telerig.estimator.images.noise import NoiseModel
from telerig.statistics import NORMAL_FROM_MEDIAN

_MOVED_SD = 0.1
PARAMETERS, HEART_PARAMETERS = 10, 4
"""Free parameters of a fit; the two of the contrast gradient are held by their prior."""


class Reason(StrEnum):
    """Why a blob is no dot, in words for the person who looks at the overlay."""

    TOUCHES_BORDER = "touches the image border"
    TOO_LARGE = "larger than the dots"
    TOO_SMALL = "smaller than the smallest dot asked for"
    MUCH_SMALLER = "much smaller than the other dots"
    NOT_ELLIPSE = "outline is not an ellipse: no dot, or merged with its neighbour"
    HIDDEN = "shows too few pixels of its own"
    FAINT = "much fainter than the other dots"
    MISPLACED = "does not look like a dot (the fit left its blob)"
    MISFIT = "does not look like a dot (residuals far above the noise)"


@dataclass(frozen=True)
class Prior:
    """Prior knowledge about one dot, from the image's other dots.

    u_per_px, v_per_px : relative gradient of the contrast, (dC/du)/C and (dC/dv)/C.
    sigma_per_px : standard deviation of both.
    edge_px : standard deviation of the edge's Gaussian blur.
    edge_spread_px : standard deviation of this number; infinite if it is unknown.
    heart_size, heart_light : radius and contrast of the dots' hearts, relative to the dot.
    heart_size_sd, heart_light_sd : their standard deviations; infinite if they are unknown.
    """

    u_per_px: float = 0.0
    v_per_px: float = 0.0
    sigma_per_px: float = 3e-4
    edge_px: float = 1.0
    edge_spread_px: float = np.inf
    heart_size: float = 0.5
    heart_size_sd: float = np.inf
    heart_light: float = 0.0
    heart_light_sd: float = np.inf

    @property
    def numbers(self) -> Array:
        """The fields (9,)."""
        return np.array(astuple(self), np.float64)


@dataclass(frozen=True)
class Window:
    """The part of an image to which one dot is fitted.

    grey : (V, U) grey levels.
    first_u, first_v : the image's pixel at grey[0, 0].
    mask : (V, U) whether a pixel is used in the fit.
    """

    grey: Array
    first_u: int
    first_v: int
    mask: Bools


@dataclass(frozen=True)
class Start:
    """Start values of a fit.

    centre_px : (2,).
    shape_px : (3,), see ``blurred_ellipse``.
    sigma_px : standard deviation of the edge's blur.
    previous : an earlier fit, whose grey levels are the start values of the levels.
    heart : (4,) centre, relative size and contrast of the dot's heart; None if it has none.
    """

    centre_px: Array
    shape_px: Array
    sigma_px: float
    previous: DotFit | None = None
    heart: Array | None = None


@dataclass(frozen=True)
class DotFit:
    """One fitted dot.

    centre_px : (2,).
    shape_px : (3,), see ``blurred_ellipse``.
    sigma_px : standard deviation of the edge's blur.
    levels : (6,) grey levels: background B0 + B1 x + B2 y and contrast C + C1 x + C2 y, where (x,
        y) is the offset from origin_px (2,), the middle of the window, divided by radius_px.
    covariance_px2 : (2, 2) of the centre.
    contrast_sigma : standard deviation of C.
    log_radius_sd : standard deviation of ln of the mean radius.
    chi2_dof : chi-square per degree of freedom.
    pixels : number of pixels in the mask.
    dof : degrees of freedom: pixels that were used less free parameters, at least 1.
    edge_residual : RMS residual near the edge, divided by C.
    inner_chi2 : mean squared whitened residual of the inner_pixels pixels that the dot covers.
    edge, edge_variance : harmonics of the edge in the residuals, see `rim.edge_harmonics`;
        `NO_EDGE` if they were not asked for.
    heart : (4,) as in `Start`.
    """

    centre_px: Array
    shape_px: Array
    sigma_px: float
    levels: Array
    origin_px: Array
    radius_px: float
    covariance_px2: Array
    contrast_sigma: float
    log_radius_sd: float
    chi2_dof: float
    pixels: int
    dof: int
    edge_residual: float
    inner_chi2: float
    inner_pixels: int
    converged: bool
    edge: Array
    edge_variance: Array
    heart: Array | None = None

    @property
    def start(self) -> Start:
        """Return the start of another fit of the dot."""
        return Start(self.centre_px, self.shape_px, self.sigma_px, self, self.heart)

    def has_moved_from(self, before: DotFit) -> bool:
        """Return whether the dot has moved so far that what depends on it is fitted again."""
        step = float(np.linalg.norm(self.centre_px - before.centre_px))
        return bool(step > _MOVED_SD * np.sqrt(np.trace(self.covariance_px2)))

    def inflated_covariance_px2(self, usual_chi2: float = 1.0) -> Array:
        """Return the centre's covariance (2, 2), multiplied by chi2_dof relative to that which is
        usual, if this is significantly above 1."""
        ratio = self.chi2_dof / usual_chi2
        return self.covariance_px2 * (ratio if ratio > self._by_chance else 1.0)

    @property
    def is_misfit(self) -> bool:
        """Whether chi2_dof is significantly above 1."""
        return self.chi2_dof > self._by_chance

    @property
    def misfit(self) -> float:
        """RMS of what the model leaves near the edge beyond the noise, divided by C; 0 if chi2_dof
        is not significantly above 1."""
        beyond = 1.0 - self._by_chance / self.chi2_dof
        return self.edge_residual * float(np.sqrt(beyond)) if beyond > 0.0 else 0.0

    @cached_property
    def _by_chance(self) -> float:
        """The largest chi2_dof that counts as noise."""
        return float(chdtri(self.dof, RARE)) / self.dof

    def under_noise(self, factor: float) -> DotFit:
        """Return the fit as it would be if the noise variance were ``factor`` times as large."""
        return replace(
            self,
            covariance_px2=self.covariance_px2 * factor,
            edge_variance=self.edge_variance * factor,
            contrast_sigma=self.contrast_sigma * np.sqrt(factor),
            log_radius_sd=self.log_radius_sd * np.sqrt(factor),
            chi2_dof=self.chi2_dof / factor,
        )

    @cached_property
    def contrast(self) -> float:
        """Contrast [grey] at the dot's centre (negative for a dark dot)."""
        return float(self.levels[3:] @ self._position)

    @property
    def heart_look(self) -> tuple[float, float]:
        """Size and contrast of the heart, relative to the dot; NaN if it has none."""
        if self.heart is None:
            return np.nan, np.nan
        return float(self.heart[2]), float(self.heart[3]) / self.contrast

    @cached_property
    def background(self) -> float:
        """Background [grey] extrapolated to the dot's centre."""
        return float(self.levels[:3] @ self._position)

    @cached_property
    def _position(self) -> Array:
        x, y = (self.centre_px - self.origin_px) / self.radius_px
        return np.array([1.0, x, y])


_FEW_PIXELS = 1e-9
"""Weight of a prior of 0 for each grey level, relative to one pixel, so that too few pixels still
have a solution."""
_INSIDE = 0.9
_CENTRE_SHAPE_CONTRAST = np.array([0, 1, 2, 3, 4, 9])
_MAX_OUTLIER_SHARE = 0.15


def _log_radius_sd(shape_px: Array, covariance: Array) -> float:
    """Return the standard deviation of half of ln(m11 m22 - m12^2)."""
    m11, m12, m22 = shape_px
    slope = 0.5 * np.array([m22, -2.0 * m12, m11]) / (m11 * m22 - m12 * m12)
    return float(np.sqrt(max(slope @ covariance @ slope, 0.0)))


class _Fit:
    """The fit of one dot to P pixels.

    x, y : (P,) offsets in px from the middle of the window. grey, weight : (P,) grey levels and
        inverse variances. parameters : (12,) theta and the levels, or (16,) with a heart.
    free : number of free parameters.
    residual, jacobian : (P,) grey levels less predicted ones, and (12 or 16, P) the derivatives of
        these.
    """

    def __init__(self, window: Window, start: Start, noise: NoiseModel, prior: Prior) -> None:
        before = start.previous
        self.noise = noise
        self.origin = np.round(start.centre_px) if before is None else before.origin_px
        self.radius = float(semi_axes(start.shape_px)[0] if before is None else before.radius_px)
        self.prior = prior.numbers
        self.at = np.argwhere(window.mask)
        self.first = np.array([(window.first_u, window.first_v)]) - self.origin
        self.y, self.x = (self.at + self.first[0, ::-1]).T
        self.grey = window.grey[window.mask]
        self.value = np.empty((1, *window.grey.shape))
        self.gradient = np.empty((1, 6, *window.grey.shape))
        theta = [*(start.centre_px - self.origin), *start.shape_px, start.sigma_px]
        levels = np.eye(6)[3] if before is None else before.levels
        heart = [] if start.heart is None else start.heart - np.r_[self.origin, 0.0, 0.0]
        self.parameters = np.array([*theta, *levels, *heart], np.float64)
        self.free = PARAMETERS + len(heart)
        self.jacobian = np.empty((len(self.parameters), len(self.at)))
        model = np.empty(len(self.at))
        predict(self.at, self.first, self.radius, self.parameters, self.value, self.gradient,
                model, self.jacobian)  # fmt: skip
        if before is None:
            model = self._with_first_levels()
        self.residual = self.grey - model
        self.weight = 1.0 / noise.variance(model)

    def _with_first_levels(self) -> Array:
        """Fit the levels linearly, and return the grey levels (P,) that are predicted then."""
        design = self.jacobian[6:10]
        information = design @ design.T + _FEW_PIXELS * np.eye(4)
        levels = np.linalg.solve(information, design @ self.grey)
        self.parameters[6:10] = levels
        self.jacobian[:6] *= levels[3]
        return np.asarray(levels @ design)

    @property
    def model(self) -> Array:
        """The predicted grey levels (P,)."""
        return self.grey - self.residual

    def minimise(self, iterations: int, tolerance: float, outlier_rounds: int) -> bool:
        """Bring the fit to its minimum; return whether it converged."""
        converged, enough = self._descend(iterations, tolerance), len(self.grey) > self.free
        for _ in range(outlier_rounds if enough else 0):
            variance = self.noise.variance(self.model)
            bad = self._outliers(variance)
            few = np.count_nonzero(bad) <= _MAX_OUTLIER_SHARE * len(bad)
            if not few or np.array_equal(bad, self.weight == 0.0):
                break
            self.weight = np.where(bad, 0.0, 1.0 / variance)
            converged = self._descend(iterations, tolerance)
        return converged and enough

    def _descend(self, iterations: int, tolerance: float) -> bool:
        return bool(
            descend(self.at, self.first, self.radius, self.prior, self.grey, self.weight,
                    self.value, self.gradient, self.parameters, self.residual, self.jacobian,
                    iterations, tolerance)
        )  # fmt: skip

    def _outliers(self, variance: Array) -> Bools:
        """Return which pixels (P,) are outliers."""
        whitened = np.abs(self.residual) / np.sqrt(variance)
        places = [len(whitened) // 2, int(0.95 * (len(whitened) - 1))]
        middle, high = np.partition(whitened, places)[places]
        limit = OUTLIER_SD * max(1.0, NORMAL_FROM_MEDIAN * middle, 0.51 * high)
        return np.asarray(whitened > limit)

    def result(self, converged: bool, edges: bool) -> DotFit:
        """Return the fit with its covariance and, if ``edges``, the harmonics of its edge."""
        size = len(self.parameters)
        information, pull = np.empty((size, size)), np.empty(size)
        normal_equations(self.prior, self.radius, self.parameters, self.residual, self.weight,
                         self.jacobian, information, pull)  # fmt: skip
        covariance = np.empty((6, 6))
        covariance_of(information, _CENTRE_SHAPE_CONTRAST, covariance)
        theta, noise, sums = self.parameters[:6], self.noise, np.empty(6)
        distance = approximate_distance_px(theta[2:5], self.x - theta[0], self.y - theta[1])
        residual_sums(
            np.array([noise.alpha, noise.beta, noise.least_variance]),
            np.array([noise.black, noise.white]), self.model, self.residual, self.weight, distance,
            self.jacobian[9], 2.0 * theta[5], _INSIDE, sums,
        )  # fmt: skip
        count, chi2, edge, edge_squares, inner, inner_chi2 = sums.tolist()
        contrast = max(abs(self.parameters[9]), 1e-12)
        offset = np.stack([self.x - theta[0], self.y - theta[1]])
        # Pixels left out as outliers count here: they are where an edge is farthest off.
        rows = self.jacobian, 1.0 / self.noise.variance(self.model), self.residual
        rim = edge_harmonics(*rows, information, theta, offset) if edges else NO_EDGE
        heart = None if size == 12 else self.parameters[12:] + np.r_[self.origin, 0.0, 0.0]
        return DotFit(
            theta[:2] + self.origin,
            theta[2:5],
            float(theta[5]),
            self.parameters[6:12],
            self.origin,
            self.radius,
            covariance[:2, :2],
            float(np.sqrt(max(covariance[5, 5], 0.0))),
            _log_radius_sd(theta[2:5], covariance[2:5, 2:5]),
            chi2 / max(count - self.free, 1),
            len(self.grey),
            max(int(count) - self.free, 1),
            float(np.sqrt(edge_squares / edge) / contrast) if edge else np.inf,
            inner_chi2 / inner if inner else 1.0,
            int(inner),
            converged,
            rim[0],
            rim[1],
            heart,
        )


def fit_dot(
    window: Window,
    start: Start,
    noise: NoiseModel,
    prior: Prior,
    *,
    iterations: int = 25,
    tolerance: float = 0.02,
    outlier_rounds: int = 3,
    edges: bool = False,
) -> DotFit:
    """Fit the luminance model of a dot to the pixels of its window.

    Pixels whose residual exceeds `OUTLIER_SD` are left out, if they are few; the standard
    deviation is enlarged if the fit as a whole is worse than the noise.

    iterations : largest number of steps.
    tolerance : the fit has converged if one more step would lower chi-square by less than this.
    outlier_rounds : how many times outliers are searched.
    edges : whether to compute the harmonics of the edge.
    """
    fit = _Fit(window, start, noise, prior)
    return fit.result(fit.minimise(iterations, tolerance, outlier_rounds), edges)
