"""Least-squares fit of dots' grey levels by Levenberg-Marquardt, without outliers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.dots.fit.blurred_ellipse import approximate_distance_px, semi_axes
from telerig.estimator.dots.fit.luminance import (
    Pixels,
    gather,
    grey_levels,
    prior_rows,
)
from telerig.estimator.dots.fit.types import PARAMETERS, DotFit, Prior, Start, Window
from telerig.estimator.images.noise import NoiseModel

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

_MIN_SIGMA_PX = 0.3
_MIN_SEMI_AXIS_PX = 0.6
_INSIDE = 0.9
_OUTLIER_SIGMA = 5.0
_MAX_OUTLIER_SHARE = 0.15
_PIXELS_AT_ONCE = 8_000
"""Pixels of one chunk of dots, so that the arrays stay in a core's cache."""


def _admissible(theta: Array, radius: Array) -> Mask:
    """(D,) whether theta is near the start of the fit: no fit may run away over the image."""
    a, b = semi_axes(theta[:, 2:5])
    sigma = theta[:, 5]
    near = np.max(np.abs(theta[:, :2]), axis=1) < radius + 2.0
    size = (a < 2.0 * radius + 3.0) & (b > _MIN_SEMI_AXIS_PX)
    found: Mask = near & size & (sigma >= _MIN_SIGMA_PX) & (sigma <= 1.5 * a + 1.0)
    return found


@dataclass
class _State:
    """State of D iterations: parameters (D, 12), model, residual and weight (D, P), Jacobian
    (D, 12, P), chi-square (D,). A weight of 0 leaves a pixel out."""

    parameters: Array
    model: Array
    jacobian: Array
    residual: Array
    weight: Array
    chi2: Array

    def take(self, dots: Ints, other: _State, rows: Mask) -> None:
        """Replace the state of some dots by rows of another state."""
        for name, array in vars(self).items():
            array[dots] = getattr(other, name)[rows]


def _state(pixels: Pixels, theta: Array, levels: Array, weight: Array | None = None) -> _State:
    """weight : (D, P); None takes the inverse noise variance at the model's grey levels."""
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
    """Information (N, 12, 12) and gradient (N, 12) of some dots; ``pixels`` holds only those."""
    rows, gap = prior_rows(pixels, state.parameters[dots])
    jacobian = state.jacobian if len(dots) == len(state.chi2) else state.jacobian[dots]
    weighted = jacobian * state.weight[dots, None]
    information = weighted @ jacobian.mT + rows.mT @ rows
    gradient = weighted @ state.residual[dots, :, None] + rows.mT @ gap[..., None]
    return information, gradient[..., 0]


def _equilibrated(information: Array) -> tuple[Array, Array]:
    """Information with a unit diagonal, and the square roots (D, 12) of its own diagonal."""
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
    """Levenberg-Marquardt of some dots at fixed weights, in place; returns those that converged.

    A dot has converged when a step would reduce chi-square by less than ``tolerance``, relative to
    the chi-square per degree of freedom where that is above 1. The last step is taken without
    evaluating the model again, since it is small against the noise.
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
    pixels: Pixels, state: _State, dots: Ints, moved: Array, sound: Mask, damping: Array
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
    """Fit the luminance model of each dot to the pixels of its window, leaving outliers out.

    Pixels more than 5 sigma off (sigma widened by the fit's own spread, so that a rough print
    edge is kept) are dropped and the fit goes on, as long as they are few.
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
    """Positions of windows of similar size, as many as stay in the cache together."""
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
    """theta (D, 6) and levels (D, 6), NaN where there are none yet."""
    theta = [[*(s.centre_px - o), *s.shape_px, s.sigma_px] for s, o in zip(starts, pixels.origin)]
    before = (s.previous for s in starts)
    levels = [np.full(6, np.nan) if fit is None else fit.levels for fit in before]
    return np.array(theta, dtype=np.float64), np.array(levels)


def _fit(
    pixels: Pixels, state: _State, iterations: int, tolerance: float, outlier_rounds: int
) -> Mask:
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


def _outliers(pixels: Pixels, residual: Array, variance: Array, dots: Ints) -> Mask:
    """(N, P) which pixels of some dots are outliers."""
    whitened = np.abs(residual[dots]) / np.sqrt(variance[dots])
    limit = np.empty((len(dots), 1))
    for k, count in enumerate(np.maximum(pixels.counts[dots], 1)):
        places = [count // 2, int(0.95 * (count - 1))]
        middle, high = np.partition(whitened[k, :count], places)[places]
        limit[k] = _OUTLIER_SIGMA * max(1.0, 1.4826 * middle, 0.51 * high)
    bad: Mask = (whitened > limit) & pixels.there[dots]
    return bad


def _inverses(information: Array) -> Array:
    equilibrated, scale = _equilibrated(information)
    try:
        inverse = np.linalg.inv(equilibrated)
    except np.linalg.LinAlgError:
        inverse = np.linalg.pinv(equilibrated, hermitian=True)
    covariance: Array = inverse / (scale[:, :, None] * scale[:, None])
    return covariance


def _results(pixels: Pixels, state: _State, converged: Mask) -> list[DotFit]:
    information, _ = _normal_equations(pixels, state, np.arange(len(pixels.x)))
    covariance = _inverses(information)
    used = state.weight > 0.0
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
    chi2_dof = np.sum(state.weight * squared, axis=1) / dof
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


def _mean_where(values: Array, where: Mask, otherwise: float) -> Array:
    """(D,) means over the chosen pixels of (D, P); ``otherwise`` where none is chosen."""
    count = np.count_nonzero(where, axis=1)
    total = np.sum(np.where(where, values, 0.0), axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), otherwise)
