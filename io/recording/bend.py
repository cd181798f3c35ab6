"""A clock whose rate changes: with the temperature, over minutes, by a part in a million.

The line below all stamps becomes a chain of straight pieces below the least delays, nearest to
them in the sum: the same linear programme with a value for each knot.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_S = 100e-6
"""The line is bent only where the least delays wander by more than this."""
_KNOT_S = 30.0
_PER_KNOT = 8
_TREND = 0.5
"""Squared steps between neighbours over the variance: 2 for noise, towards 0 for a slow change."""


def bend(x_s: Array, least_s: Array) -> tuple[Array, Array] | None:
    """(knots_s, offset_s at them) of the chain, or None where a straight line serves.

    x_s : (W,) increasing, times of least delays; least_s : (W,) above the straight line.
    """
    spread = float(np.var(least_s))
    if len(x_s) < 4 * _PER_KNOT or np.ptp(least_s) < LEAST_S:
        return None
    if float(np.mean(np.diff(least_s) ** 2)) > _TREND * spread:
        return None
    span = float(np.ptp(x_s))
    count = 1 + int(np.clip(span / _KNOT_S, 2, len(x_s) // _PER_KNOT))
    knots = np.linspace(x_s[0], x_s[-1], count)
    return knots, _lower_chain(x_s, least_s, knots)


def _lower_chain(x_s: Array, least_s: Array, knots: Array) -> Array:
    """(K,) values at the knots of the highest chain, in the sum, that no point lies below."""
    from scipy.optimize import linprog
    from scipy.sparse import csr_array

    left = np.clip(np.searchsorted(knots, x_s, "right") - 1, 0, len(knots) - 2)
    share = (x_s - knots[left]) / np.diff(knots)[left]
    row = np.arange(len(x_s))
    weights: Any = csr_array(
        (
            np.concatenate([1 - share, share]),
            (np.concatenate([row, row]), np.concatenate([left, left + 1])),
        ),
        shape=(len(x_s), len(knots)),
    )
    unit = max(float(np.ptp(least_s)), 1e-12)
    found = linprog(
        -np.asarray(weights.sum(axis=0)).ravel(), A_ub=weights, b_ub=least_s / unit,
        bounds=(-10.0, 10.0), method="highs",
    )  # fmt: skip
    if not found.success or found.x is None:
        return np.zeros(len(knots))
    return np.asarray(unit * np.asarray(found.x))
