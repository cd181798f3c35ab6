"""The climb to the most probable hyper-parameters, and how sharp the top is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.learning.evidence import signal_evidence, signal_gradient
from telerig.estimator.smoothing.learning.lines_of_sight import Signal
from telerig.estimator.smoothing.learning.parameters import (
    depends_on,
    log_prior,
    prior_of,
    value_of,
    with_values,
)
from telerig.estimator.smoothing.problem.problem import ShakeModel

_IMPOSSIBLE = -1e12


@dataclass(frozen=True)
class Fit:
    """log_evidence : at the model.  log_posterior : with the priors of what was fitted."""

    model: ShakeModel
    log_evidence: float
    log_posterior: float


def evidence(signals: Sequence[Signal], model: ShakeModel) -> float:
    """Sum over the signals; very low where a model is not numerically sound."""
    try:
        total = sum(signal_evidence(c, model) for c in signals)
    except np.linalg.LinAlgError:
        return _IMPOSSIBLE
    return float(total) if np.isfinite(total) else _IMPOSSIBLE


def evidence_gradient(
    signals: Sequence[Signal], model: ShakeModel, names: Sequence[str]
) -> tuple[float, Array]:
    """The evidence, and (n,) its derivatives by the logarithms of the named parameters."""
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
    """As `evidence_gradient`, the parameters' priors added."""
    found, slope = evidence_gradient(signals, model, names)
    priors = [prior_of(n) for n in names]
    of_prior = [p.log_gradient(value_of(model, n)) for n, p in zip(names, priors)]
    return found + log_prior(model, names), slope + np.array(of_prior)


def maximise(
    signals: Sequence[Signal], model: ShakeModel, names: Sequence[str], *, steps: int = 25
) -> Fit:
    """Quasi-Newton on the logarithms of the named parameters, within their bounds."""
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
    """(n, n) covariance of the log-parameters: the inverse curvature of the log posterior.

    Curvature that is not positive (a flat or bounded direction) is filled up by the prior's.
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
