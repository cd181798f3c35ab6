"""The luminance model of a dot (Lavest, Viala, Dhome, 1999) and its least-squares fit.

A pixel's grey level is ``B0 + B1 x + B2 y`` plus the blurred image of an ellipse of grey level
``C + C1 x + C2 y``, with (x, y) the offset from the window's middle in units of the dot's radius
(:mod:`telerig.estimator.dots.fit.blurred_ellipse`). A dot's contrast gradient (C1, C2) is nearly
indistinguishable from a shift of its centre, so it is never free: it has a Gaussian prior. The fit
is Levenberg-Marquardt; pixels that are outliers are left out.

Many dots are computed at once, as arrays with a leading axis of D dots whose pixels are padded to
the largest number P: one dot's arrays are so small that the calls would take most of the time.

theta (D, 6) holds centre (2), shape (3) and sigma; levels (D, 6) holds B0, B1, B2, C, C1, C2; the
parameters (D, 12) are both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from functools import partial
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.dots.fit.blurred_ellipse import (
    approximate_distance_px,
    coverage_on_grid,
    semi_axes,
)
from telerig.estimator.images.noise import NoiseModel
from telerig.statistics import NORMAL_FROM_MEDIAN

PARAMETERS = 10
"""Free parameters of a fit; the two of the contrast gradient are held by their prior."""
SIGNIFICANT = 1e-4
"""A fit is worse than the noise if noise alone gives a chi-square as large with less than this
probability."""


class Reason(StrEnum):
    """Why a blob is no dot, in words for the person who looks at the overlay."""

    TOUCHES_BORDER = "touches the image border"
    TOO_LARGE = "larger than the dots"
    TOO_SMALL = "smaller than the smallest dot asked for"
    MUCH_SMALLER = "much smaller than the other dots"
    MERGED = "merged with its neighbour"
    NOT_ELLIPSE = "outline is not an ellipse"
    HIDDEN = "shows too few pixels of its own"
    FAINT = "much fainter than the other dots"
    WRONG_SIGN = "does not look like a dot (contrast has the wrong sign)"
    FIT_FAILED = "does not look like a dot (fit failed)"
    MISPLACED = "does not look like a dot (the fit left its blob)"
    MISFIT = "does not look like a dot (residuals far above the noise)"


@dataclass(frozen=True)
class Prior:
    """Prior knowledge about one dot, from the image's other dots.

    u_per_px, v_per_px : relative gradient of the contrast, (dC/du)/C and (dC/dv)/C.
    sigma_per_px : standard deviation of both.
    tie_to_background : whether the background's relative gradient is taken instead, because the
        same light falls on both.
    edge_px : standard deviation of the edge's Gaussian blur.
    edge_spread_px : standard deviation of this number; infinite if it is unknown.
    """

    u_per_px: float = 0.0
    v_per_px: float = 0.0
    sigma_per_px: float = 3e-4
    tie_to_background: bool = False
    edge_px: float = 1.0
    edge_spread_px: float = np.inf


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
    """

    centre_px: Array
    shape_px: Array
    sigma_px: float
    previous: DotFit | None = None


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
    chi2_dof : chi-square per degree of freedom.
    pixels : number of pixels in the mask.
    dropped : how many of these were left out as outliers or as clipped.
    edge_residual : RMS residual near the edge, divided by C.
    inner_chi2 : mean squared whitened residual of the inner_pixels pixels that the dot covers.
    """

    centre_px: Array
    shape_px: Array
    sigma_px: float
    levels: Array
    origin_px: Array
    radius_px: float
    covariance_px2: Array
    contrast_sigma: float
    chi2_dof: float
    pixels: int
    dropped: int
    edge_residual: float
    inner_chi2: float
    inner_pixels: int
    converged: bool

    @property
    def dof(self) -> int:
        return max(self.pixels - self.dropped - PARAMETERS, 1)

    @property
    def inflated_covariance_px2(self) -> Array:
        """The centre's covariance (2, 2), multiplied by chi2_dof if chi2_dof is significantly above
        1."""
        significant = self.chi2_dof > self._by_chance
        return self.covariance_px2 * (self.chi2_dof if significant else 1.0)

    @property
    def misfit(self) -> float:
        """RMS of what the model leaves near the edge beyond the noise, divided by C; 0 if chi2_dof
        is not significantly above 1."""
        beyond = 1.0 - self._by_chance / self.chi2_dof
        return self.edge_residual * float(np.sqrt(beyond)) if beyond > 0.0 else 0.0

    @property
    def _by_chance(self) -> float:
        """The largest chi2_dof that counts as noise."""
        return float(chdtri(self.dof, SIGNIFICANT)) / self.dof

    def under_noise(self, factor: float) -> DotFit:
        """Return the fit as it would be if the noise variance were ``factor`` times as large."""
        return replace(
            self,
            covariance_px2=self.covariance_px2 * factor,
            contrast_sigma=self.contrast_sigma * np.sqrt(factor),
            chi2_dof=self.chi2_dof / factor,
        )

    @property
    def contrast(self) -> float:
        """Contrast [grey] at the dot's centre (negative for a dark dot)."""
        return float(self.levels[3:] @ self._position)

    @property
    def background(self) -> float:
        """Background [grey] extrapolated to the dot's centre."""
        return float(self.levels[:3] @ self._position)

    @property
    def _position(self) -> Array:
        x, y = (self.centre_px - self.origin_px) / self.radius_px
        return np.array([1.0, x, y])


_FEW_PIXELS = 1e-9
"""Weight of a prior of 0 for each grey level, relative to one pixel, so that too few pixels still
have a solution."""
_PRIOR = np.dtype([(f.name, type(f.default)) for f in fields(Prior)])
_prior_values = attrgetter(*(f.name for f in fields(Prior)))


@dataclass(frozen=True)
class Pixels:
    """The pixels of D fits, padded to the largest number P of pixels in one fit.

    x, y : (D, P) offsets in px from the middle of the window.
    grey : (D, P) grey levels.
    there : (D, P) True for pixels, False for padding.
    counts : (D,) number of pixels of each fit.
    columns, rows : (D, U), (D, V) offsets in px of the windows' columns and rows; in smaller
        windows they go on in steps of 1 px.
    cell : (D, P) index of each pixel in the grid of rows and columns, row by row.
    origin : (D, 2) middle of the window in px.
    radius : (D,) radius of the dot in px.
    prior : (D,) structured array with the fields of `Prior`.
    """

    x: Array
    y: Array
    grey: Array
    there: Bools
    counts: Ints
    columns: Array
    rows: Array
    cell: Ints
    origin: Array
    radius: Array
    noise: NoiseModel
    prior: NDArray[np.void]

    def of(self, dots: Ints) -> Pixels:
        """Return the pixels of some of the dots."""
        if len(dots) == len(self.x):
            return self
        arrays = {name: value[dots] for name, value in vars(self).items() if name != "noise"}
        return replace(self, **arrays)


def gather(
    windows: Sequence[Window], starts: Sequence[Start], noise: NoiseModel, priors: Sequence[Prior]
) -> Pixels:
    """Return the pixels of all windows that are True in the windows' masks, as padded arrays."""
    counts = np.array([np.count_nonzero(w.mask) for w in windows])
    sizes = np.array([w.mask.shape for w in windows])
    height, width = sizes.max(axis=0)
    grey = np.zeros((len(windows), max(int(counts.max()), 1)))
    cell = np.zeros(grey.shape, np.int64)
    origin, radius = np.empty((len(windows), 2)), np.empty(len(windows))
    for i, (window, start) in enumerate(zip(windows, starts)):
        before = start.previous
        origin[i] = np.round(start.centre_px) if before is None else before.origin_px
        radius[i] = semi_axes(start.shape_px)[0] if before is None else before.radius_px
        at_row, at_column = np.nonzero(window.mask)
        cell[i, : counts[i]] = at_row * width + at_column
        grey[i, : counts[i]] = window.grey[window.mask]
    first = np.array([(w.first_u, w.first_v) for w in windows]) - origin
    columns, rows = first[:, :1] + np.arange(width), first[:, 1:] + np.arange(height)
    there = np.arange(grey.shape[1]) < counts[:, None]
    at_row, at_column = np.divmod(cell, width)
    x = np.where(there, first[:, :1] + at_column, 0.0)
    y = np.where(there, first[:, 1:] + at_row, 0.0)
    prior = np.array([_prior_values(p) for p in priors], _PRIOR)
    return Pixels(x, y, grey, there, counts, columns, rows, cell, origin, radius, noise, prior)


def _coverage(pixels: Pixels, theta: Array) -> tuple[Array, Array]:
    """Return the coverage (D, P) and its derivatives (D, 6, P) by theta (D, 6)."""
    exact, slopes = coverage_on_grid(
        pixels.columns, pixels.rows, theta[:, :2], theta[:, 2:5], theta[:, 5]
    )
    value = np.take_along_axis(exact.reshape(len(theta), -1), pixels.cell, axis=1)
    gradient = np.take_along_axis(slopes.reshape(len(theta), 6, -1), pixels.cell[:, None], axis=2)
    return value, gradient


def grey_levels(pixels: Pixels, theta: Array, levels: Array) -> tuple[Array, Array, Array]:
    """Return the grey levels that the luminance model predicts for the pixels of D fits.

    theta : (D, 6) centre (2), shape (3) and sigma. levels : (D, 6); rows of NaN are replaced by a
    linear fit to the pixels.

    Returns grey levels (D, P), their derivatives (D, 12, P) with respect to theta and the levels,
    and the levels (D, 6).

    The contrast gradient acts before the blur: the Gaussian blur of x F_sharp is x F + sigma^2
    dF/dx. Without the second term a centre would shift by sigma^2 times the relative gradient. The
    derivatives of this term with respect to theta are neglected.
    """
    coverage, gradient = _coverage(pixels, theta)
    radius = pixels.radius[:, None]
    x, y = pixels.x / radius, pixels.y / radius
    spread = theta[:, 5:] ** 2 / radius
    jacobian = np.empty((len(x), 12, x.shape[1]))
    jacobian[:, 6], jacobian[:, 7], jacobian[:, 8] = 1.0, x, y
    jacobian[:, 9] = coverage
    jacobian[:, 10] = coverage * x - spread * gradient[:, 0]
    jacobian[:, 11] = coverage * y - spread * gradient[:, 1]
    unknown = np.isnan(levels[:, 0])
    if np.any(unknown):
        levels = np.where(unknown[:, None], _first_levels(pixels, jacobian), levels)
    grey = (levels[:, None] @ jacobian[:, 6:])[:, 0]
    contrast = levels[:, 3:4] + levels[:, 4:5] * x + levels[:, 5:6] * y
    np.multiply(gradient, contrast[:, None], out=jacobian[:, :6])
    return grey, jacobian, levels


def _first_levels(pixels: Pixels, jacobian: Array) -> Array:
    design = jacobian[:, 6:10] * pixels.there[:, None]
    pull = design @ pixels.grey[..., None]
    information = design @ design.mT + _FEW_PIXELS * np.eye(4)
    levels = np.linalg.solve(information, pull)[..., 0]
    return np.concatenate([levels, np.zeros((len(levels), 2))], axis=1)


def prior_rows(pixels: Pixels, parameters: Array) -> tuple[Array, Array]:
    """Return the whitened equations of the priors on two contrast gradients and the edge's blur.

    parameters : (D, 12) theta and the levels. Returns Jacobians (D, 3, 12) and the right-hand sides
    (D, 3), prior minus present value.
    """
    prior, radius, levels = pixels.prior, pixels.radius, parameters[:, 6:]
    tied = prior["tie_to_background"]
    weight = 1.0 / (prior["sigma_per_px"] * radius * np.maximum(np.abs(levels[:, 3]), 1e-12))
    rows = np.zeros((len(parameters), 3, 12))
    rows[:, 0, 10] = rows[:, 1, 11] = weight
    tie = np.where(tied, levels[:, 3] / np.where(tied, levels[:, 0], 1.0), 0.0)
    rows[:, 0, 7] = rows[:, 1, 8] = -tie * weight
    slope_weight = np.where(tied, 0.0, radius * weight)
    rows[:, 0, 9] = -prior["u_per_px"] * slope_weight
    rows[:, 1, 9] = -prior["v_per_px"] * slope_weight
    rows[:, 2, 5] = 1.0 / prior["edge_spread_px"]
    gap = -(rows @ parameters[..., None])[..., 0]
    gap[:, 2] += prior["edge_px"] / prior["edge_spread_px"]
    return rows, gap


_MIN_SIGMA_PX = 0.3
_MIN_SEMI_AXIS_PX = 0.6
_INSIDE = 0.9
_OUTLIER_SIGMA = 5.0
_MAX_OUTLIER_SHARE = 0.15
_PIXELS_AT_ONCE = 16_000
"""Pixels of one chunk of dots, so that the arrays stay in a core's cache."""


def _admissible(theta: Array, radius: Array) -> Bools:
    """Return (D,) whether theta is near the start; no fit may run away over the image."""
    a, b = semi_axes(theta[:, 2:5])
    sigma = theta[:, 5]
    near = np.max(np.abs(theta[:, :2]), axis=1) < radius + 2.0
    size = (a < 2.0 * radius + 3.0) & (b > _MIN_SEMI_AXIS_PX)
    found: Bools = near & size & (sigma >= _MIN_SIGMA_PX) & (sigma <= 1.5 * a + 1.0)
    return found


@dataclass
class _State:
    """Parameters (D, 12), model, residual, weight (D, P), Jacobian (D, 12, P), chi-square (D,)."""

    parameters: Array
    model: Array
    jacobian: Array
    residual: Array
    weight: Array
    chi2: Array

    def take(self, dots: Ints, other: _State, rows: Bools) -> None:
        """Replace the state of some dots by rows of another state."""
        for name, array in vars(self).items():
            array[dots] = getattr(other, name)[rows]


def _state(pixels: Pixels, theta: Array, levels: Array, weight: Array | None = None) -> _State:
    """Return the state; weight (D, P): None takes the inverse noise variance at the model."""
    model, jacobian, levels = grey_levels(pixels, theta, levels)
    if weight is None:
        weight = pixels.there / pixels.noise.variance(model)
    parameters = np.concatenate([theta, levels], axis=1)
    residual = pixels.grey - model
    return _State(
        parameters, model, jacobian, residual, weight, _chi2(pixels, parameters, residual, weight)
    )  # fmt: skip


def _chi2(pixels: Pixels, parameters: Array, residual: Array, weight: Array) -> Array:
    _, gap = prior_rows(pixels, parameters)
    chi2: Array = np.sum(weight * residual * residual, axis=1) + np.sum(gap * gap, axis=1)
    return chi2


def _normal_equations(pixels: Pixels, state: _State, dots: Ints) -> tuple[Array, Array]:
    """Return information (N, 12, 12) and gradient (N, 12) of the dots that ``pixels`` holds."""
    rows, gap = prior_rows(pixels, state.parameters[dots])
    jacobian = state.jacobian if len(dots) == len(state.chi2) else state.jacobian[dots]
    weighted = jacobian * state.weight[dots, None]
    information = weighted @ jacobian.mT + rows.mT @ rows
    gradient = weighted @ state.residual[dots, :, None] + rows.mT @ gap[..., None]
    return information, gradient[..., 0]


def _equilibrated(information: Array) -> tuple[Array, Array]:
    """Return information with a unit diagonal, and the square roots (D, 12) of its own diagonal."""
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    scale: Array = np.sqrt(np.maximum(diagonal, 1e-300))
    return information / (scale[:, :, None] * scale[:, None]), scale


def _damped_steps(information: Array, gradient: Array, damping: Array) -> Array:
    equilibrated, scale = _equilibrated(information)
    equilibrated += damping[:, None, None] * np.eye(information.shape[-1])
    step: Array = np.linalg.solve(equilibrated, (gradient / scale)[..., None])[..., 0] / scale
    return step


def _descend(
    pixels: Pixels, state: _State, dots: Ints, *, iterations: int, tolerance: float
) -> Ints:
    """Take Levenberg-Marquardt steps in place at fixed weights; return dots that converged.

    A dot has converged when a step would reduce chi-square by less than ``tolerance``, relative to
    chi-square per degree of freedom above 1; that step is taken without another evaluation.
    """
    damping = np.full(len(state.chi2), 1e-4)
    done_parts: list[Ints] = []
    for _ in range(iterations):
        if not len(dots):
            break
        some = pixels.of(dots)
        information, gradient = _normal_equations(some, state, dots)
        step = _damped_steps(information, gradient, damping[dots])
        moved = state.parameters[dots] + step
        sound = _admissible(moved[:, :6], some.radius)
        gain = np.sum(step * gradient, axis=1)
        small = gain < tolerance * np.maximum(1.0, state.chi2[dots] / np.maximum(some.counts, 1))
        last = small & (damping[dots] <= 1e-3) & sound
        done = dots[last]
        state.parameters[done] = moved[last]
        state.residual[done] -= (step[last, None] @ state.jacobian[done])[:, 0]
        done_parts.append(done)
        _try(pixels, state, dots, moved, sound & ~last, damping)
        dots = dots[~last]
        dots = dots[damping[dots] <= 1e8]
    return np.concatenate(done_parts) if done_parts else dots


def _try(
    pixels: Pixels, state: _State, dots: Ints, moved: Array, sound: Bools, damping: Array
) -> None:
    """Take the steps that reduce chi-square; increase the damping of the others."""
    tried = dots[sound]
    better = np.zeros(len(dots), dtype=np.bool_)
    if len(tried):
        some = pixels.of(tried)
        trial = _state(some, moved[sound, :6], moved[sound, 6:], state.weight[tried])
        gained = trial.chi2 <= state.chi2[tried] * (1.0 + 1e-12)
        better[np.flatnonzero(sound)[gained]] = True
        state.take(tried[gained], trial, gained)
    damping[dots] = np.where(
        better, np.maximum(damping[dots] / 10.0, 1e-9), np.maximum(damping[dots], 1e-4) * 10.0
    )


def fit_dots(
    windows: Sequence[Window],
    starts: Sequence[Start],
    noise: NoiseModel,
    priors: Sequence[Prior],
    *,
    iterations: int = 25,
    tolerance: float = 0.02,
    outlier_rounds: int = 3,
) -> list[DotFit]:
    """Fit the luminance model of each dot to the pixels of its window.

    windows, starts, priors : one for each dot. Pixels whose residual exceeds 5 standard deviations
        are left out, if they are few; the standard deviation is enlarged if the fit as a whole is
        worse than the noise.
    iterations : largest number of steps.
    tolerance : a fit has converged if one more step would lower chi-square by less than this.
    outlier_rounds : how many times outliers are searched.
    """
    fits: dict[int, DotFit] = {}
    for some in _chunks(windows):
        pixels = gather(
            [windows[i] for i in some], [starts[i] for i in some], noise, [priors[i] for i in some]
        )
        state = _state(pixels, *_first(pixels, [starts[i] for i in some]))
        converged = _fit(pixels, state, iterations, tolerance, outlier_rounds)
        fits |= zip(some, _results(pixels, state, converged))
    return [fits[i] for i in range(len(windows))]


def _chunks(windows: Sequence[Window]) -> Iterator[list[int]]:
    """Return the positions of windows of similar size, as many as stay in the cache together."""
    counts = [int(np.count_nonzero(w.mask)) for w in windows]
    chunk: list[int] = []
    for i in sorted(range(len(windows)), key=counts.__getitem__):
        if chunk and (
            counts[i] * (len(chunk) + 1) > _PIXELS_AT_ONCE or counts[i] > 2 * counts[chunk[0]]
        ):
            yield chunk
            chunk = []
        chunk.append(i)
    if chunk:
        yield chunk


def _first(pixels: Pixels, starts: Sequence[Start]) -> tuple[Array, Array]:
    """Return theta (D, 6) and levels (D, 6), NaN where there are none yet."""
    theta = [[*(s.centre_px - o), *s.shape_px, s.sigma_px] for s, o in zip(starts, pixels.origin)]
    before = (s.previous for s in starts)
    levels = [np.full(6, np.nan) if fit is None else fit.levels for fit in before]
    return np.array(theta, dtype=np.float64), np.array(levels)


def _fit(
    pixels: Pixels, state: _State, iterations: int, tolerance: float, outlier_rounds: int
) -> Bools:
    """Bring the state to its minimum; returns (D,) which dots converged."""
    converged = np.zeros(len(pixels.x), dtype=np.bool_)
    dots: Ints = np.arange(len(pixels.x))
    descend = partial(_descend, pixels, state, iterations=iterations, tolerance=tolerance)
    converged[descend(dots)] = True
    for _ in range(outlier_rounds):
        variance = pixels.noise.variance(state.model)
        bad = _outliers(pixels, state.residual, variance, dots)
        few = np.count_nonzero(bad, axis=1) <= _MAX_OUTLIER_SHARE * pixels.counts[dots]
        known = (state.weight[dots] == 0.0) & pixels.there[dots]
        again = few & np.any(bad != known, axis=1)
        dots = dots[again]
        if not len(dots):
            break
        kept = pixels.there[dots] & ~bad[again]
        state.weight[dots] = kept / variance[dots]
        state.chi2[dots] = _chi2(
            pixels.of(dots), state.parameters[dots], state.residual[dots], state.weight[dots]
        )
        converged[dots] = False
        converged[descend(dots)] = True
    return converged & (pixels.counts > PARAMETERS)


def _outliers(pixels: Pixels, residual: Array, variance: Array, dots: Ints) -> Bools:
    """Return (N, P) which pixels of some dots are outliers."""
    whitened = np.abs(residual[dots]) / np.sqrt(variance[dots])
    limit = np.empty((len(dots), 1))
    for k, count in enumerate(np.maximum(pixels.counts[dots], 1)):
        places = [count // 2, int(0.95 * (count - 1))]
        middle, high = np.partition(whitened[k, :count], places)[places]
        limit[k] = _OUTLIER_SIGMA * max(1.0, NORMAL_FROM_MEDIAN * middle, 0.51 * high)
    bad: Bools = (whitened > limit) & pixels.there[dots]
    return bad


def _inverses(information: Array) -> Array:
    equilibrated, scale = _equilibrated(information)
    try:
        inverse = np.linalg.inv(equilibrated)
    except np.linalg.LinAlgError:
        inverse = np.linalg.pinv(equilibrated, hermitian=True)
    covariance: Array = inverse / (scale[:, :, None] * scale[:, None])
    return covariance


def _results(pixels: Pixels, state: _State, converged: Bools) -> list[DotFit]:
    information, _ = _normal_equations(pixels, state, np.arange(len(pixels.x)))
    covariance = _inverses(information)
    used = state.weight > 0.0
    used &= ~pixels.noise.is_clipped(pixels.grey, state.model)
    dropped = pixels.counts - np.count_nonzero(used, axis=1)
    dof = np.maximum(pixels.counts - dropped - PARAMETERS, 1)
    squared = state.residual**2
    theta, contrast = state.parameters[:, :6], np.abs(state.parameters[:, 9])
    distance = approximate_distance_px(
        theta[:, 2:5], pixels.x - theta[:, :1], pixels.y - theta[:, 1:2]
    )
    edge = np.sqrt(_mean_where(squared, (np.abs(distance) < 2.0 * theta[:, 5:]) & used, np.inf))
    inside = used & (state.jacobian[:, 9] > _INSIDE)
    inner = _mean_where(state.weight * squared, inside, 1.0)
    chi2_dof = np.sum(state.weight * squared, axis=1, where=used) / dof
    return [
        DotFit(
            theta[i, :2] + pixels.origin[i],
            theta[i, 2:5],
            float(theta[i, 5]),
            state.parameters[i, 6:],
            pixels.origin[i],
            float(pixels.radius[i]),
            covariance[i, :2, :2],
            float(np.sqrt(max(covariance[i, 9, 9], 0.0))),
            float(chi2_dof[i]),
            int(pixels.counts[i]),
            int(dropped[i]),
            float(edge[i] / max(contrast[i], 1e-12)),
            float(inner[i]),
            int(np.count_nonzero(inside[i])),
            bool(converged[i]),
        )
        for i in range(len(theta))
    ]


def _mean_where(values: Array, where: Bools, otherwise: float) -> Array:
    """Return (D,) means over the chosen pixels of (D, P); ``otherwise`` where none is chosen."""
    count = np.count_nonzero(where, axis=1)
    total = np.sum(np.where(where, values, 0.0), axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), otherwise)
