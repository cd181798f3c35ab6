"""Least-squares fit of a dot's grey levels: the luminance model of Lavest, Viala, Dhome (1999).

A pixel's grey level is ``B0 + B1 x + B2 y + (C + C1 x + C2 y) F`` with F the blurred ellipse of
:mod:`telerig.estimator.frontend.blurred_ellipse` and (x, y) the offset from the window's middle in
units of the dot's radius. A dot's contrast gradient (C1, C2) can hardly be told from a shift of
its centre, so it never floats freely: it carries a Gaussian prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from telerig.estimator.frontend.blurred_ellipse import (
    approximate_distance_px,
    axes_from_shape,
    coverage_near_edge,
    coverage_on_grid,
    largest_curvature,
)
from telerig.estimator.frontend.noise import NoiseModel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

EDGE_EXPANSION_LIMIT = 0.08
_MIN_SIGMA_PX = 0.3
_MIN_SEMI_AXIS_PX = 0.6
_OUTLIER_SIGMA = 5.0
_MAX_OUTLIER_SHARE = 0.15


@dataclass(frozen=True)
class GradientPrior:
    """Relative contrast gradient (dC/du)/C, (dC/dv)/C [1/px] expected at a dot, and its sigma.

    ``tie_to_background`` instead expects the same relative gradient as the background's (light
    falls on both), up to ``sigma_per_px``.
    """

    u_per_px: float = 0.0
    v_per_px: float = 0.0
    sigma_per_px: float = 3e-4
    tie_to_background: bool = False


@dataclass(frozen=True)
class Window:
    """Pixels that a fit looks at: grey levels (V, U) of a crop, its first pixel, a mask (V, U)."""

    grey: Array
    first_u: int
    first_v: int
    mask: Mask


@dataclass(frozen=True)
class Start:
    """Where a fit begins: centre (2,) and shape (3,) in image px, edge sigma [px]."""

    centre_px: Array
    shape_px: Array
    sigma_px: float


@dataclass(frozen=True)
class DotFit:
    """One fitted dot.

    ``centre_px`` (2,), ``shape_px`` (3,) (see ``blurred_ellipse``), ``sigma_px`` of the edge,
    ``levels`` (6,): B0, B1, B2, C, C1, C2 about the window's middle ``origin_px`` (2,) in units of
    ``radius_px``; ``covariance_px2`` (2, 2) of the centre, ``contrast_sigma`` of C; ``dropped``
    pixels were outliers; ``edge_residual`` is the residual's RMS over C in the edge's band.
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
    converged: bool


@dataclass(frozen=True)
class _Problem:
    """Pixels of one fit, flattened: coordinates relative to the origin pixel, data, weights."""

    columns: Array
    rows: Array
    mask: Mask
    x: Array
    y: Array
    grey: Array
    radius: float

    def without(self, bad: Mask) -> _Problem:
        mask = self.mask.copy()
        mask[self.mask] = ~bad
        return replace(self, mask=mask, x=self.x[~bad], y=self.y[~bad], grey=self.grey[~bad])


def _problem(window: Window, origin: Array, radius: float) -> _Problem:
    columns = np.arange(window.grey.shape[1]) + window.first_u - origin[0]
    rows = np.arange(window.grey.shape[0]) + window.first_v - origin[1]
    y_index, x_index = np.nonzero(window.mask)
    return _Problem(
        columns,
        rows,
        window.mask,
        columns[x_index],
        rows[y_index],
        window.grey[window.mask],
        radius,
    )


def _coverage(problem: _Problem, theta: Array) -> tuple[Array, Array]:
    centre, shape, sigma = theta[:2], theta[2:5], float(theta[5])
    if largest_curvature(shape) * sigma < EDGE_EXPANSION_LIMIT:
        return coverage_near_edge(problem.x - centre[0], problem.y - centre[1], shape, sigma)
    value, gradient = coverage_on_grid(problem.columns, problem.rows, centre, shape, sigma)
    return value[problem.mask], gradient[:, problem.mask]


def _model(problem: _Problem, theta: Array, levels: Array) -> tuple[Array, Array, Array]:
    """Grey levels (P,), their derivatives (12, P) by theta and levels, and the coverage (P,)."""
    coverage, gradient = _coverage(problem, theta)
    x, y = problem.x / problem.radius, problem.y / problem.radius
    contrast = levels[3] + levels[4] * x + levels[5] * y
    grey = levels[0] + levels[1] * x + levels[2] * y + contrast * coverage
    jacobian = np.empty((12, coverage.size))
    np.multiply(gradient, contrast, out=jacobian[:6])
    jacobian[6], jacobian[7], jacobian[8] = 1.0, x, y
    jacobian[9] = coverage
    np.multiply(coverage, x, out=jacobian[10])
    np.multiply(coverage, y, out=jacobian[11])
    return grey, jacobian, coverage


def _prior_rows(prior: GradientPrior, levels: Array, radius: float) -> tuple[Array, Array]:
    """Two whitened prior rows: Jacobian (2, 6) by the levels, and residual (2,)."""
    weight = 1.0 / (prior.sigma_per_px * radius * max(abs(levels[3]), 1e-12))
    rows = np.zeros((2, 6))
    rows[0, 4] = rows[1, 5] = weight
    if prior.tie_to_background:
        ratio = levels[3] / levels[0] * weight
        rows[0, 1] = rows[1, 2] = -ratio
    else:
        rows[0, 3] = -prior.u_per_px * radius * weight
        rows[1, 3] = -prior.v_per_px * radius * weight
    return rows, -rows @ levels


def _first_levels(problem: _Problem, theta: Array) -> Array:
    coverage, _ = _coverage(problem, theta)
    design = np.stack(
        [np.ones_like(coverage), problem.x / problem.radius, problem.y / problem.radius, coverage]
    )
    b0, b1, b2, c = np.linalg.lstsq(design.T, problem.grey, rcond=None)[0]
    return np.array([b0, b1, b2, c, 0.0, 0.0])


def _admissible(theta: Array) -> bool:
    a, b, _ = axes_from_shape(theta[2:5])
    return bool(b > _MIN_SEMI_AXIS_PX and _MIN_SIGMA_PX <= theta[5] <= 1.5 * a + 1.0)


@dataclass(frozen=True)
class _Solution:
    theta: Array
    levels: Array
    information: Array
    residual: Array
    variance: Array
    coverage: Array
    chi2: float
    converged: bool


def _solve(
    problem: _Problem,
    theta: Array,
    levels: Array,
    noise: NoiseModel,
    prior: GradientPrior,
    *,
    iterations: int,
) -> _Solution:
    """Levenberg-Marquardt over the 12 parameters; the weights follow the model's grey level."""
    damping, converged = 1e-3, False
    best = _evaluate(
        problem, theta, levels, noise.variance(_model(problem, theta, levels)[0]), prior
    )
    for _ in range(iterations):
        information, pull, solution = best
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        equilibrated = information / np.outer(scale, scale)
        equilibrated[np.diag_indices(12)] += damping
        step = np.linalg.solve(equilibrated, pull / scale) / scale
        gain = float(step @ pull)
        floor = max(1.0, solution.chi2 / max(problem.grey.size - 12, 1))
        if gain < 1e-3 * floor and damping <= 1e-3:
            converged = True
            break
        moved = np.concatenate([solution.theta, solution.levels]) + step
        trial = None
        if _admissible(moved[:6]):
            trial = _evaluate(problem, moved[:6], moved[6:], solution.variance, prior)
        if trial is not None and trial[2].chi2 <= solution.chi2 * (1.0 + 1e-12):
            damping = max(damping / 10.0, 1e-9)
            best = trial
        else:
            damping = max(damping, 1e-4) * 10.0
            if damping > 1e8:
                break
    return replace(best[2], converged=converged)


def _evaluate(
    problem: _Problem, theta: Array, levels: Array, variance: Array, prior: GradientPrior
) -> tuple[Array, Array, _Solution]:
    grey, jacobian, coverage = _model(problem, theta, levels)
    residual = problem.grey - grey
    weighted = jacobian / variance
    rows, gap = _prior_rows(prior, levels, problem.radius)
    information = weighted @ jacobian.T
    information[6:, 6:] += rows.T @ rows
    pull = weighted @ residual
    pull[6:] += rows.T @ gap
    chi2 = float(residual @ (residual / variance) + gap @ gap)
    return (
        information,
        pull,
        _Solution(theta, levels, information, residual, variance, coverage, chi2, False),
    )


def fit_dot(
    window: Window,
    start: Start,
    noise: NoiseModel,
    prior: GradientPrior,
    *,
    levels: Array | None = None,
    iterations: int = 20,
) -> DotFit:
    """Fit one dot's luminance model to the pixels of ``window``, leaving outliers out.

    Pixels more than 5 sigma off (sigma widened by the fit's own chi-square, so that a rough print
    edge is kept) are dropped and the fit repeated, as long as they are few. The covariance is
    widened by chi2_dof where that is significantly above 1.
    """
    origin = np.round(start.centre_px)
    radius = float(axes_from_shape(start.shape_px)[0])
    problem = _problem(window, origin, radius)
    theta = np.concatenate([start.centre_px - origin, start.shape_px, [start.sigma_px]])
    first = _first_levels(problem, theta) if levels is None else levels
    solution = _solve(problem, theta, first, noise, prior, iterations=iterations)
    dropped = 0
    for _ in range(3):
        bad = _outliers(solution)
        count = int(np.count_nonzero(bad))
        if count == 0 or count + dropped > _MAX_OUTLIER_SHARE * np.count_nonzero(window.mask):
            break
        dropped += count
        problem = problem.without(bad)
        solution = _solve(
            problem, solution.theta, solution.levels, noise, prior, iterations=iterations
        )
    return _result(problem, solution, origin, dropped)


def _outliers(solution: _Solution) -> Mask:
    whitened = np.abs(solution.residual) / np.sqrt(solution.variance)
    spread = max(1.0, 1.4826 * float(np.median(whitened)), 0.5 * float(np.quantile(whitened, 0.95)))
    bad: Mask = whitened > _OUTLIER_SIGMA * spread
    return bad


def _result(problem: _Problem, solution: _Solution, origin: Array, dropped: int) -> DotFit:
    dof = max(problem.grey.size - 12, 1)
    chi2_dof = float(np.sum(solution.residual**2 / solution.variance)) / dof
    scale = np.sqrt(np.maximum(np.diag(solution.information), 1e-300))
    inverse = np.linalg.pinv(solution.information / np.outer(scale, scale), hermitian=True)
    covariance = inverse / np.outer(scale, scale)
    inflation = chi2_dof if chi2_dof > 1.0 + 3.0 * np.sqrt(2.0 / dof) else 1.0
    theta, contrast = solution.theta, abs(float(solution.levels[3]))
    distance = approximate_distance_px(theta[2:5], problem.x - theta[0], problem.y - theta[1])
    band = solution.residual[np.abs(distance) < 2.0 * theta[5]]
    edge = float(np.sqrt(np.mean(band**2))) / max(contrast, 1e-12) if band.size else np.inf
    return DotFit(
        theta[:2] + origin,
        theta[2:5],
        float(theta[5]),
        solution.levels,
        origin,
        problem.radius,
        covariance[:2, :2] * inflation,
        float(np.sqrt(covariance[9, 9])),
        chi2_dof,
        problem.grey.size,
        dropped,
        edge,
        solution.converged,
    )
