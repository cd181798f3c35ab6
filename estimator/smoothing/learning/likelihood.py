"""Evidence of several signals: its maximum, its curvature, and the effect on the covariances.

The covariances of a solution contain the uncertainty of learned hyper-parameters by Laplace's
approximation: each parameter is moved by plus and minus one standard deviation, and the square of
half the change of the smoothed positions, velocities and offsets is added to their variances. The
parameters count as independent, which overestimates the variances if they are correlated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.smoothing.graph.solve import Covariances, Solution
from telerig.estimator.smoothing.learning.evidence import (
    signal_evidence,
    signal_gradient,
    signal_posterior,
)
from telerig.estimator.smoothing.learning.lines_of_sight import (
    Signal,
    contrasts,
    pooled,
)
from telerig.estimator.smoothing.learning.parameters import (
    depends_on,
    log_prior,
    prior_of,
    processes,
    value_of,
    with_values,
)
from telerig.estimator.smoothing.learning.window import learning_signals
from telerig.estimator.smoothing.problem.problem import ShakeModel

_IMPOSSIBLE = -1e12


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    log_evidence : log density of the data under the model.
    log_posterior : the same plus the log prior density of the fitted hyper-parameters.
    """

    model: ShakeModel
    log_evidence: float
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
        found = evidence(signals, model)
        return Fit(model, found, found)
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
    best, top = at(result.x), -float(result.fun)
    return Fit(best, top - log_prior(best, names), top)


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


_FARTHEST = 0.5
_AT_ONCE = 8192
_Triple = tuple[Array, Array, Array]
"""Of positions, velocities and offsets."""


def with_hyperparameter_uncertainty(solution: Solution) -> Solution:
    """Return the solution with the uncertainty of learned hyper-parameters in its covariances.

    Bubbles and frames that learning did not use get the mean increase. The solution is unchanged
    without covariances, learned parameters or measurements of positive weight.
    """
    found, model, problem = solution.covariances, solution.graph.model, solution.graph.problem
    if found is None or not model.learned or not problem.bubbles:
        return solution
    signals = list(learning_signals(problem, solution.weights))
    if not signals:
        return solution
    directions = np.array([c.direction for c in signals])
    spreads = [_spread(c, model) for c in signals]
    if len(signals[0].t_s) < len(problem.t_s):
        spreads = [(_mean(p), _mean(v), _mean(o)) for p, v, o in spreads]
    # coordinates along the signals, which need not be at right angles, back into the lab
    lab = np.linalg.pinv(directions)
    bubbles = found.bubbles.copy()
    for kind, rows in ((0, solution.graph.bubble.position), (1, solution.graph.bubble.velocity)):
        along = np.stack([_rows(solution, c, s[kind]) for c, s in zip(signals, spreads)], -1)
        into = np.linalg.pinv(rows) @ lab
        each = np.einsum("ik,jk->kij", into, into).reshape(along.shape[-1], -1)
        for first in range(0, len(bubbles), _AT_ONCE):
            mine = slice(first, first + _AT_ONCE)
            bubbles[mine] += (along[mine] @ each).reshape(-1, *bubbles.shape[1:])
    shake = _shaken(solution, signals, [s[2] for s in spreads], found)
    return replace(solution, covariances=replace(found, bubbles=bubbles, shake=shake))


def _spread(signal: Signal, model: ShakeModel) -> _Triple:
    """Return variances of position and velocity (B, F), NaN off the tracks, and offsets (J, F)."""
    parts = pooled(signal)
    total = [np.zeros((1, len(signal.t_s)))] * 3
    for name, sigma in model.learned.items():
        at, step = value_of(model, name), min(sigma, _FARTHEST)
        up, down = (with_values(model, [name], [at * np.exp(s * step)]) for s in (1, -1))
        same = [name != "pixel_inflation" and _same(part, up, model) for part in parts]
        if all(same):
            continue
        moved = [_still(p) if s else _moved(p, up, down) for p, s in zip(parts, same)]
        for i, change in enumerate(_of_bubbles(moved, int(signal.moving.sum()))):
            total[i] = total[i] + (change / 2 * (sigma / step)) ** 2
    if signal.value_mm.ndim == 2 and len(total[0]) == signal.moving.sum():
        there = _there(signal)
        total[:2] = [np.where(there, variance, np.nan) for variance in total[:2]]
    return total[0], total[1], total[2]


def _there(signal: Signal) -> Bools:
    """Return whether each moving item's track covers each frame (B, F)."""
    seen = np.array(
        [(signal.weight[:, signal.item == i] > 0).any(1) for i in np.flatnonzero(signal.moving)]
    )
    before, after = (np.logical_or.accumulate(a, axis=1) for a in (seen, seen[:, ::-1]))
    return np.asarray(before & after[:, ::-1])


def _same(signal: Signal, one: ShakeModel, two: ShakeModel) -> bool:
    """Return whether two models have the same processes for a signal."""
    return all(a is b for a, b in zip(processes(signal, one), processes(signal, two)))


def _moved(signal: Signal, up: ShakeModel, down: ShakeModel) -> _Triple:
    """Return the difference of the posterior means under two models."""
    one, two = signal_posterior(signal, up), signal_posterior(signal, down)
    return (
        one.position_mm - two.position_mm,
        one.velocity_mm_s - two.velocity_mm_s,
        one.offset_mm - two.offset_mm,
    )


def _still(signal: Signal) -> _Triple:
    nothing = np.zeros((1, len(signal.t_s)))
    return nothing, nothing, nothing


def _of_bubbles(moved: list[_Triple], count: int) -> _Triple:
    """Return the signals of each bubble from those of the mean and the differences."""
    if len(moved) == 1:
        return moved[0]
    (position, velocity, offset), apart = moved
    pieces, frames = max(len(position), len(apart[0]) // (count - 1)), position.shape[1]
    place, speed = (
        np.tensordot(
            contrasts(count).T,
            np.broadcast_to(a, ((count - 1) * pieces, frames)).reshape(-1, pieces, frames), 1,
        ).reshape(count * pieces, frames)
        for a in apart[:2]
    )  # fmt: skip
    own = (np.tile(np.broadcast_to(a, (pieces, frames)), (count, 1)) for a in (position, velocity))
    return next(own) + place, next(own) + speed, offset


def _rows(solution: Solution, signal: Signal, variance: Array) -> Array:
    """Return values (rows,) for all states of bubbles from (B, F) of the signal's bubbles, or (1,
    1).
    """
    graph = solution.graph
    if variance.size == 1:
        return np.full(graph.rows, variance.item())
    number = np.full(len(graph.problem.bubbles), -1)
    movers = signal.bubble[signal.moving]
    number[movers] = np.arange(len(movers))
    mine = number[graph.bubble_of_row]
    variance = np.broadcast_to(variance, (len(movers), variance.shape[-1]))
    each = np.where(mine >= 0, variance[mine, graph.frame_of_row], np.nan)
    known = np.isfinite(variance)
    count = known.sum(0)
    typical = np.where(known, variance, 0.0).sum(0) / np.maximum(count, 1)
    typical = np.where(count > 0, typical, _mean(variance).item())[graph.frame_of_row]
    return np.asarray(np.where(np.isfinite(each), each, typical))


def _mean(variance: Array) -> Array:
    """Return the mean (1, 1) of the finite values."""
    return np.asarray(np.mean(variance[np.isfinite(variance)])).reshape(1, 1)


def _shaken(
    solution: Solution, signals: list[Signal], spreads: list[Array], found: Covariances
) -> Array:
    """Return the covariance (F, D, D) of the shake, increased along the signals' directions."""
    layout, out = solution.graph.shake, found.shake.copy()
    for signal, variance in zip(signals, spreads):
        rows = np.einsum("i,cid->cd", signal.direction, layout.offset[list(signal.cameras)])
        if not np.any(rows):
            continue
        into = np.linalg.pinv(rows)
        variance = np.broadcast_to(variance, (len(rows), len(out)))
        out += np.einsum("dk,kf,ek->fde", into, variance, into, optimize=True)
    return out
