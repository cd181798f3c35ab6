"""Least-squares fit of a dot's grey levels: the luminance model of Lavest, Viala, Dhome (1999).

A pixel's grey level is ``B0 + B1 x + B2 y`` plus the blurred image of an ellipse of grey level
``C + C1 x + C2 y``, with (x, y) the offset from the window's middle in units of the dot's radius
(:mod:`telerig.estimator.frontend.blurred_ellipse`). A dot's contrast gradient (C1, C2) can hardly
be told from a shift of its centre, so it never floats freely: it carries a Gaussian prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.frontend.blurred_ellipse import (
    approximate_distance_px,
    coverage_near_edge,
    coverage_on_grid,
    largest_curvature,
    semi_axes,
)
from telerig.estimator.frontend.dot_types import PARAMETERS, DotFit, Prior, Start, Window
from telerig.estimator.frontend.noise import NoiseModel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

EDGE_EXPANSION_LIMIT = 0.12  # centres agree with the exact sum to 3e-6 px, levels to 2e-4
ROUGH_EXPANSION_LIMIT = 0.3  # levels to 3e-3: enough to start a finer fit from
_MIN_SIGMA_PX = 0.3
_MIN_SEMI_AXIS_PX = 0.6
_INSIDE = 0.9
_OUTLIER_SIGMA = 5.0
_MAX_OUTLIER_SHARE = 0.15


@dataclass(frozen=True)
class _Problem:
    """Pixels of one fit, flattened: coordinates relative to the origin pixel, and data."""

    columns: Array
    rows: Array
    mask: Mask
    x: Array
    y: Array
    grey: Array
    origin: Array
    radius: float
    noise: NoiseModel
    prior: Prior
    expansion_limit: float


def _problem(
    window: Window, start: Start, noise: NoiseModel, prior: Prior, expansion_limit: float
) -> _Problem:
    origin, radius = np.round(start.centre_px), semi_axes(start.shape_px)[0]
    if start.previous is not None:
        origin, radius = start.previous.origin_px, start.previous.radius_px
    columns = np.arange(window.grey.shape[1]) + window.first_u - origin[0]
    rows = np.arange(window.grey.shape[0]) + window.first_v - origin[1]
    at_row, at_column = np.nonzero(window.mask)
    return _Problem(
        columns,
        rows,
        window.mask,
        columns[at_column],
        rows[at_row],
        window.grey[window.mask],
        origin,
        radius,
        noise,
        prior,
        expansion_limit,
    )


def _coverage(problem: _Problem, theta: Array) -> tuple[Array, Array]:
    centre, shape, sigma = theta[:2], theta[2:5], float(theta[5])
    if largest_curvature(shape) * sigma < problem.expansion_limit:
        return coverage_near_edge(problem.x - centre[0], problem.y - centre[1], shape, sigma)
    value, gradient = coverage_on_grid(problem.columns, problem.rows, centre, shape, sigma)
    return value[problem.mask], gradient[:, problem.mask]


def _model(problem: _Problem, theta: Array, levels: Array | None) -> tuple[Array, Array, Array]:
    """Grey levels (P,), their derivatives (12, P) by theta and levels, and the levels.

    Without ``levels``, those that fit best.

    The light's slope acts before the blur: the Gaussian of x F_sharp is x F + sigma^2 dF/dx.
    Left out, this shifts a centre by sigma^2 times the relative slope. (How that small term
    itself changes with theta is left out of the derivatives.)
    """
    coverage, gradient = _coverage(problem, theta)
    x, y = problem.x / problem.radius, problem.y / problem.radius
    spread = theta[5] ** 2 / problem.radius
    jacobian = np.empty((12, coverage.size))
    jacobian[6], jacobian[7], jacobian[8] = 1.0, x, y
    jacobian[9] = coverage
    jacobian[10] = coverage * x - spread * gradient[0]
    jacobian[11] = coverage * y - spread * gradient[1]
    if levels is None:
        levels = _first_levels(problem, coverage)
    grey: Array = levels @ jacobian[6:]
    contrast = levels[3] + levels[4] * x + levels[5] * y
    np.multiply(gradient, contrast, out=jacobian[:6])
    return grey, jacobian, levels


def _prior_rows(prior: Prior, parameters: Array, radius: float) -> tuple[Array, Array]:
    """Three whitened prior rows: Jacobian (3, 12) by the parameters, and residual (3,)."""
    levels = parameters[6:]
    weight = 1.0 / (prior.sigma_per_px * radius * max(abs(levels[3]), 1e-12))
    rows = np.zeros((3, 12))
    rows[0, 10] = rows[1, 11] = weight
    if prior.tie_to_background:
        ratio = levels[3] / levels[0] * weight
        rows[0, 7] = rows[1, 8] = -ratio
    else:
        rows[0, 9] = -prior.u_per_px * radius * weight
        rows[1, 9] = -prior.v_per_px * radius * weight
    rows[2, 5] = 1.0 / prior.edge_spread_px
    gap = -rows @ parameters
    gap[2] += prior.edge_px / prior.edge_spread_px
    return rows, gap


def _first_levels(problem: _Problem, coverage: Array) -> Array:
    design = np.stack(
        [np.ones_like(coverage), problem.x / problem.radius, problem.y / problem.radius, coverage]
    )
    b0, b1, b2, c = np.linalg.solve(design @ design.T, design @ problem.grey)
    return np.array([b0, b1, b2, c, 0.0, 0.0])


def _admissible(theta: Array, radius: float) -> bool:
    """Near where the fit began, whose radius it was: a fit must not run away over the image."""
    a, b = semi_axes(theta[2:5])
    near = max(abs(theta[0]), abs(theta[1])) < radius + 2.0 and a < 2.0 * radius + 3.0
    return bool(near and b > _MIN_SEMI_AXIS_PX and _MIN_SIGMA_PX <= theta[5] <= 1.5 * a + 1.0)


@dataclass(frozen=True)
class _State:
    """One point of the iteration: parameters (12,), model, Jacobian (12, P), chi-square."""

    parameters: Array
    model: Array
    jacobian: Array
    residual: Array
    weight: Array
    chi2: float


def _state(problem: _Problem, theta: Array, levels: Array | None) -> _State:
    model, jacobian, levels = _model(problem, theta, levels)
    parameters = np.concatenate([theta, levels])
    weight = 1.0 / problem.noise.variance(model)
    return _State(parameters, model, jacobian, problem.grey - model, weight, 0.0)


def _weighted(problem: _Problem, state: _State, weight: Array) -> _State:
    """The same point under other pixel weights (0 leaves a pixel out)."""
    _, gap = _prior_rows(problem.prior, state.parameters, problem.radius)
    chi2 = float(state.residual @ (weight * state.residual) + gap @ gap)
    return replace(state, weight=weight, chi2=chi2)


def _normal_equations(problem: _Problem, state: _State) -> tuple[Array, Array]:
    rows, gap = _prior_rows(problem.prior, state.parameters, problem.radius)
    weighted = state.jacobian * state.weight
    information = weighted @ state.jacobian.T
    information += rows.T @ rows
    pull = weighted @ state.residual
    pull += rows.T @ gap
    return information, pull


def _damped_step(information: Array, pull: Array, damping: float) -> Array:
    scale = np.sqrt(np.maximum(information.diagonal(), 1e-300))
    equilibrated = information / (scale[:, None] * scale)
    equilibrated.flat[:: len(scale) + 1] += damping
    step: Array = np.linalg.solve(equilibrated, pull / scale) / scale
    return step


def _descend(
    problem: _Problem, state: _State, *, iterations: int, tolerance: float
) -> tuple[_State, bool]:
    """Levenberg-Marquardt at fixed weights, until a step would gain less than ``tolerance``.

    The gain is in chi-square, relative to the chi-square per degree of freedom where that is
    above 1. The last step is taken without looking again: it is small against the noise.
    """
    damping = 1e-4
    for _ in range(iterations):
        information, pull = _normal_equations(problem, state)
        step = _damped_step(information, pull, damping)
        moved = state.parameters + step
        small = float(step @ pull) < tolerance * max(1.0, state.chi2 / max(problem.grey.size, 1))
        if small and damping <= 1e-3 and _admissible(moved[:6], problem.radius):
            residual = state.residual - step @ state.jacobian
            return replace(state, parameters=moved, residual=residual), True
        trial = None
        if _admissible(moved[:6], problem.radius):
            trial = _weighted(problem, _state(problem, moved[:6], moved[6:]), state.weight)
        if trial is not None and trial.chi2 <= state.chi2 * (1.0 + 1e-12):
            damping, state = max(damping / 10.0, 1e-9), trial
        else:
            damping = max(damping, 1e-4) * 10.0
            if damping > 1e8:
                break
    return state, False


def fit_dot(
    window: Window,
    start: Start,
    noise: NoiseModel,
    prior: Prior,
    *,
    iterations: int = 25,
    tolerance: float = 0.02,
    outlier_rounds: int = 3,
    rough: bool = False,
) -> DotFit:
    """Fit one dot's luminance model to the pixels of ``window``, leaving outliers out.

    Pixels more than 5 sigma off (sigma widened by the fit's own spread, so that a rough print
    edge is kept) are dropped and the fit goes on, as long as they are few.

    rough : the model may be a few thousandths off, for a first look.
    """
    limit = ROUGH_EXPANSION_LIMIT if rough else EDGE_EXPANSION_LIMIT
    problem = _problem(window, start, noise, prior, limit)
    theta = np.concatenate([start.centre_px - problem.origin, start.shape_px, [start.sigma_px]])
    state = _state(problem, theta, None if start.previous is None else start.previous.levels)
    state = _weighted(problem, state, state.weight)
    state, converged = _descend(problem, state, iterations=iterations, tolerance=tolerance)
    for _ in range(outlier_rounds):
        variance = noise.variance(state.model)
        bad = _outliers(state.residual, variance)
        if np.mean(bad) > _MAX_OUTLIER_SHARE or np.array_equal(bad, state.weight == 0.0):
            break
        state = _weighted(problem, state, np.where(bad, 0.0, 1.0 / variance))
        state, converged = _descend(problem, state, iterations=iterations, tolerance=tolerance)
    return _result(problem, state, converged)


def _outliers(residual: Array, variance: Array) -> Mask:
    whitened = np.abs(residual) / np.sqrt(variance)
    places = [whitened.size // 2, int(0.95 * (whitened.size - 1))]
    middle, high = np.partition(whitened, places)[places]
    bad: Mask = whitened > _OUTLIER_SIGMA * max(1.0, 1.4826 * middle, 0.51 * high)
    return bad


def _inverse(information: Array) -> Array:
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    equilibrated = information / np.outer(scale, scale)
    try:
        inverse = np.linalg.inv(equilibrated)
    except np.linalg.LinAlgError:
        inverse = np.linalg.pinv(equilibrated, hermitian=True)
    covariance: Array = inverse / np.outer(scale, scale)
    return covariance


def _result(problem: _Problem, state: _State, converged: bool) -> DotFit:
    information, _ = _normal_equations(problem, state)
    used = state.weight > 0.0
    dropped = int(problem.grey.size - np.count_nonzero(used))
    dof = max(int(np.count_nonzero(used)) - PARAMETERS, 1)
    chi2_dof = float(np.sum(state.weight * state.residual**2)) / dof
    covariance = _inverse(information)
    theta, contrast = state.parameters[:6], abs(float(state.parameters[9]))
    distance = approximate_distance_px(theta[2:5], problem.x - theta[0], problem.y - theta[1])
    band = state.residual[(np.abs(distance) < 2.0 * theta[5]) & used]
    inside = used & (state.jacobian[9] > _INSIDE)
    inner = state.weight[inside] * state.residual[inside] ** 2
    edge = float(np.sqrt(np.mean(band**2))) / max(contrast, 1e-12) if band.size else np.inf
    return DotFit(
        theta[:2] + problem.origin,
        theta[2:5],
        float(theta[5]),
        state.parameters[6:],
        problem.origin,
        problem.radius,
        covariance[:2, :2],
        float(np.sqrt(covariance[9, 9])),
        chi2_dof,
        int(problem.grey.size),
        dropped,
        edge,
        float(np.mean(inner)) if inner.size else 1.0,
        int(inner.size),
        converged,
    )
