"""The climb to the most probable hyper-parameters, and how sharp the top is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.shake_channels import Channel
from telerig.estimator.shake_evidence import channel_evidence
from telerig.estimator.shake_parameters import log_prior, prior_of, value_of, with_values
from telerig.estimator.smoother.model import ShakeModel

Array = NDArray[np.float64]

_DIFFERENCE = 1e-3
_IMPOSSIBLE = -1e12


@dataclass(frozen=True)
class Fit:
    """log_evidence : at the model.  log_posterior : with the priors of what was fitted."""

    model: ShakeModel
    log_evidence: float
    log_posterior: float


def evidence(channels: Sequence[Channel], model: ShakeModel) -> float:
    """Sum over the channels; very low where a model is not numerically sound."""
    try:
        total = sum(channel_evidence(c, model) for c in channels)
    except np.linalg.LinAlgError:
        return _IMPOSSIBLE
    return float(total) if np.isfinite(total) else _IMPOSSIBLE


def maximise(
    channels: Sequence[Channel], model: ShakeModel, names: Sequence[str], *, steps: int = 25
) -> Fit:
    """Quasi-Newton on the logarithms of the named parameters, within their bounds."""
    from scipy.optimize import minimize

    if not names:
        found = evidence(channels, model)
        return Fit(model, found, found)
    priors = [prior_of(n) for n in names]
    scale = np.array([p.step for p in priors])
    bounds = [(float(np.log(p.low) / s), float(np.log(p.high) / s)) for p, s in zip(priors, scale)]
    start: Array = np.log([value_of(model, n) for n in names]) / scale

    def cost(x: Array) -> float:
        moved = with_values(model, names, np.exp(x * scale).tolist())
        return -evidence(channels, moved) - log_prior(moved, names)

    def slope(x: Array) -> tuple[float, Array]:
        at = cost(x)
        each = [cost(x + _DIFFERENCE * row) - at for row in np.eye(len(x))]
        return at, np.array(each) / _DIFFERENCE

    options: Any = {"maxiter": steps, "ftol": 1e-6, "gtol": 3e-2}
    low, high = np.array(bounds).T
    start = np.clip(start, low + 1e-6, high - 2 * _DIFFERENCE)
    result = minimize(
        slope, start, args=(), jac=True, method="L-BFGS-B", bounds=bounds, options=options
    )
    best = with_values(model, names, np.exp(result.x * scale).tolist())
    return Fit(best, evidence(channels, best), -float(result.fun))


def laplace_sigma(channels: Sequence[Channel], model: ShakeModel, names: Sequence[str]) -> Array:
    """(n, n) covariance of the log-parameters: the inverse curvature of the log posterior.

    Curvature that is not positive (a flat or bounded direction) is filled up by the prior's.
    """
    scale = np.array([prior_of(n).step for n in names])
    values = np.log([value_of(model, n) for n in names])

    def cost(step: Array) -> float:
        moved = with_values(model, names, np.exp(values + step * scale).tolist())
        return -evidence(channels, moved) - log_prior(moved, names)

    h, unit, at = 0.25, np.eye(len(names)), cost(np.zeros(len(names)))
    up = np.array([cost(h * row) for row in unit])
    down = np.array([cost(-h * row) for row in unit])
    curvature = np.diag((up + down - 2 * at) / h**2)
    for i in range(len(names)):
        for j in range(i):
            both = cost(h * (unit[i] + unit[j]))
            curvature[i, j] = curvature[j, i] = (both - up[i] - up[j] + at) / h**2
    least = np.array([(s / prior_of(n).log_sigma) ** 2 for n, s in zip(names, scale)])
    roots = np.sqrt(least)
    values_, vectors = np.linalg.eigh(curvature / roots[:, None] / roots)
    inner = (vectors / np.maximum(values_, 1.0)) @ vectors.T
    return np.asarray(inner / roots[:, None] / roots * scale[:, None] * scale)
