"""Evidence of several signals: its maximum, its curvature, and the effect on the covariances.

The covariances of a solution contain the uncertainty of learned hyper-parameters by Laplace's
approximation: each parameter is moved by plus and minus one standard deviation, and the mean square
of half the change of the smoothed positions, velocities and offsets is added to their variances.
The parameters count as independent, which overestimates the variances if they are correlated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.learning.evidence import (
    signal_evidence,
    signal_gradient,
    signal_posterior,
)
from telerig.estimator.smoothing.learning.lines_of_sight import Signal, pooled
from telerig.estimator.smoothing.learning.parameters import (
    depends_on,
    log_prior,
    prior_of,
    value_of,
    with_values,
)
from telerig.estimator.smoothing.learning.window import learning_signals
from telerig.estimator.smoothing.problem.problem import ShakeModel

_IMPOSSIBLE = -1e12
_FARTHEST = 0.5
"""Largest change of a logarithm; of a parameter that is less sure what it moves is scaled."""


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    log_posterior : log density of the data under the model, plus the log prior density of the
        fitted hyper-parameters.
    """

    model: ShakeModel
    log_posterior: float


def evidence(signals: Sequence[Signal], model: ShakeModel) -> float:
    """Return the log evidence of all signals together; -1e12 if it cannot be computed."""
    try:
        total = sum(signal_evidence(c, model) for c in signals)
    except np.linalg.LinAlgError:
        return _IMPOSSIBLE
    return float(total) if np.isfinite(total) else _IMPOSSIBLE


def evidence_gradient(
    signals: Sequence[Signal], model: ShakeModel, names: Sequence[str]
) -> tuple[float, Array]:
    """Return the log evidence and its derivatives (n,) by the logarithms of parameters."""
    try:
        each = [signal_gradient(c, model, names) for c in signals]
    except np.linalg.LinAlgError:
        return _IMPOSSIBLE, np.zeros(len(names))
    total, slope = float(sum(e for e, _ in each)), sum((s for _, s in each), np.zeros(len(names)))
    if not (np.isfinite(total) and np.all(np.isfinite(slope))):
        return _IMPOSSIBLE, np.zeros(len(names))
    return total, slope


def _posterior_gradient(
    signals: Sequence[Signal], model: ShakeModel, names: Sequence[str]
) -> tuple[float, Array]:
    """Return the log posterior density and its derivatives: `evidence_gradient` plus the log
    priors.
    """
    found, slope = evidence_gradient(signals, model, names)
    priors = [prior_of(n) for n in names]
    of_prior = [p.log_gradient(value_of(model, n)) for n, p in zip(names, priors)]
    return found + log_prior(model, names), slope + np.array(of_prior)


def maximise(
    signals: Sequence[Signal], model: ShakeModel, names: Sequence[str], *, steps: int = 25
) -> Fit:
    """Maximise the posterior over the logarithms of the named parameters (L-BFGS-B, within bounds).

    steps : largest number of iterations.
    """
    from scipy.optimize import minimize

    if not names:
        return Fit(model, evidence(signals, model))
    priors = [prior_of(n) for n in names]
    scale = np.array([p.step for p in priors])
    bounds = [(float(np.log(p.low) / s), float(np.log(p.high) / s)) for p, s in zip(priors, scale)]
    start: Array = np.log([value_of(model, n) for n in names]) / scale

    moving = [c for c in signals if depends_on(c, model, names)]
    still = evidence([c for c in signals if all(c is not m for m in moving)], model)

    def at(x: Array) -> ShakeModel:
        return with_values(model, names, np.exp(x * scale).tolist())

    def cost(x: Array) -> tuple[float, Array]:
        value, slope = _posterior_gradient(moving, at(x), names)
        return -value - still, -slope * scale

    options: Any = {"maxiter": steps, "ftol": 1e-6, "gtol": 3e-2}
    low, high = np.array(bounds).T
    result = minimize(
        cost, np.clip(start, low + 1e-6, high - 1e-6), jac=True, method="L-BFGS-B",
        bounds=bounds, options=options,
    )  # fmt: skip
    return Fit(at(result.x), -float(result.fun))


def laplace_covariance(signals: Sequence[Signal], model: ShakeModel, names: Sequence[str]) -> Array:
    """Return the covariance (n, n) of the logarithms of the parameters by Laplace's approximation.

    No direction has less curvature than the prior gives it.
    """
    scale = np.array([prior_of(n).step for n in names])
    values = np.log([value_of(model, n) for n in names])

    def change(name: str, step: Array) -> Array:
        own = [c for c in signals if depends_on(c, model, [name])]
        down, up = (
            with_values(model, names, np.exp(values + sign * step * scale).tolist())
            for sign in (-1, 1)
        )
        both = [_posterior_gradient(own, moved, names)[1] for moved in (down, up)]
        return np.asarray((both[0] - both[1]) * scale)

    h = 0.25
    rows = np.array([change(n, h * row) for n, row in zip(names, np.eye(len(names)))]) / (2 * h)
    curvature = (rows + rows.T) / 2
    least = np.array([(s / prior_of(n).log_sigma) ** 2 for n, s in zip(names, scale)])
    roots = np.sqrt(least)
    values_, vectors = np.linalg.eigh(curvature / roots[:, None] / roots)
    inner = (vectors / np.maximum(values_, 1.0)) @ vectors.T
    return np.asarray(inner / roots[:, None] / roots * scale[:, None] * scale)


def with_hyperparameter_uncertainty(solution: Solution) -> Solution:
    """Return the solution with the uncertainty of learned hyper-parameters in its covariances.

    All bubbles and frames get the mean increase of those that learning used. The solution is
    unchanged without covariances, learned parameters or measurements of positive weight.
    """
    found, graph = solution.covariances, solution.graph
    model, problem = graph.model, graph.problem
    if found is None or not model.learned or not problem.bubbles:
        return solution
    signals = learning_signals(problem, solution.weights)
    if not signals:
        return solution
    spreads = [_spread(signal, model) for signal in signals]
    # coordinates along the signals, which need not be at right angles, back into the lab
    lab = np.linalg.pinv(np.array([signal.direction for signal in signals]))
    bubbles, shake = np.zeros_like(found.bubbles[0]), np.zeros_like(found.shake[0])
    for kind, rows in enumerate((graph.bubble.position, graph.bubble.velocity)):
        into = np.linalg.pinv(rows) @ lab
        bubbles += (into * [spread[kind] for spread in spreads]) @ into.T
    for signal, (*_, of_offsets) in zip(signals, spreads):
        offset = graph.shake.offset[list(signal.cameras)]
        into = np.linalg.pinv(np.einsum("i,cid->cd", signal.direction, offset))
        shake += of_offsets * into @ into.T
    wider = replace(found, bubbles=found.bubbles + bubbles, shake=found.shake + shake)
    return replace(solution, covariances=wider)


def _spread(signal: Signal, model: ShakeModel) -> Array:
    """Return the mean variances (3,) of the moving items' positions and velocities on their tracks,
    and of the cameras' offsets."""
    total, count = np.zeros(3), int(signal.moving.sum())
    for part in pooled(signal):
        # of bubbles, whose differences are one fewer than they are
        share = 1.0 if part.shaken else (count - 1) / count
        there = _there(part)
        for name, sigma in model.learned.items():
            if not depends_on(part, model, [name]):
                continue
            at, step = value_of(model, name), min(sigma, _FARTHEST)
            up, down = (
                signal_posterior(part, with_values(model, [name], [at * np.exp(s * step)]))
                for s in (1, -1)
            )
            on_track = np.repeat(there, len(up.position_mm) // max(len(there), 1), axis=0)
            moved = (
                (up.position_mm - down.position_mm)[on_track],
                (up.velocity_mm_s - down.velocity_mm_s)[on_track],
                up.offset_mm - down.offset_mm,
            )
            each = [(m**2).mean() if m.size else 0.0 for m in moved]
            total += share * (sigma / step / 2) ** 2 * np.array(each)
    return total


def _there(signal: Signal) -> Bools:
    """Return whether each moving item's track covers each frame (B, F)."""
    movers = np.flatnonzero(signal.moving)
    seen = np.zeros((len(movers), len(signal.t_s)), bool)
    for mine, item in zip(seen, movers):
        mine[:] = (signal.weight[:, signal.item == item] > 0).any(1)
    before, after = (np.logical_or.accumulate(a, axis=1) for a in (seen, seen[:, ::-1]))
    return np.asarray(before & after[:, ::-1])
