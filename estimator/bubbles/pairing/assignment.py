"""One-to-one assignment with the option to leave out: the best one, and each pair's probability.

An assignment's probability is proportional to the product of exp(log odds) of its pairs.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]

NEGLIGIBLE = -9.0
"""Log odds below which a pair is never considered: its probability stays under exp(-9)."""

_EXACT_SIDE = 11
_PASSES = 500


def best_assignment(log_odds: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the assignment of highest probability; what is left out is not named."""
    from scipy.optimize import linear_sum_assignment

    gain = np.where(log_odds > 0, log_odds, 0.0)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    kept = gain[rows, columns] > 0
    return rows[kept].astype(np.int64), columns[kept].astype(np.int64)


def marginals(log_odds: Array) -> Array:
    """(N1, N2) log odds -> (N1, N2) posterior probability of each pair.

    Exact per connected component with up to 11 detections on its smaller side (sum over all
    assignments by dynamic programming over subsets); above that loopy belief propagation
    (Williams and Lau, IEEE Trans. AES 50:2942, 2014), which always converges.
    """
    out = np.zeros(log_odds.shape)
    possible = log_odds > NEGLIGIBLE
    lone = possible & (possible.sum(1) == 1)[:, None] & (possible.sum(0) == 1)
    out[lone] = 1 / (1 + np.exp(-log_odds[lone]))
    for i, j in _components(possible & ~lone):
        block = np.ix_(i, j)
        part = np.where(possible[block], log_odds[block], -np.inf)
        if min(len(i), len(j)) > _EXACT_SIDE:
            out[block] = _belief_propagation(part)
        elif len(j) <= len(i):
            out[block] = _exact(part)
        else:
            out[block] = _exact(part.T).T
    return out


def _components(possible: NDArray[np.bool_]) -> Iterator[tuple[Index, Index]]:
    """Rows and columns that are connected by possible pairs.

    The smallest row's number spreads over each component; on such small graphs this takes a tenth
    of the time of `scipy.sparse.csgraph.connected_components`.
    """
    rows, none = np.arange(len(possible)), len(possible)
    while True:
        columns = np.min(np.where(possible, rows[:, None], none), axis=0, initial=none)
        spread = np.minimum(rows, np.min(np.where(possible, columns, none), axis=1, initial=none))
        if np.array_equal(spread, rows):
            break
        rows = spread
    for label in np.unique(columns[columns < none]):
        yield np.flatnonzero(rows == label), np.flatnonzero(columns == label)


@lru_cache(maxsize=16)
def _without(columns: int) -> tuple[NDArray[np.int64], ...]:
    """For each column the subsets that do not hold it."""
    subsets = np.arange(1 << columns)
    return tuple(subsets[(subsets >> j) & 1 == 0] for j in range(columns))


def _exact(log_odds: Array) -> Array:
    n, m = log_odds.shape
    peak = np.maximum(log_odds.max(axis=1, initial=0.0), 0.0)
    weight = np.exp(log_odds - peak[:, None])
    alone = np.exp(-peak)
    free = _without(m)
    forward, backward = np.zeros((n + 1, 1 << m)), np.zeros((n + 1, 1 << m))
    forward[0, 0], backward[n] = 1.0, 1.0
    for i in range(n):
        forward[i + 1] = alone[i] * forward[i]
        for j in np.flatnonzero(weight[i]):
            forward[i + 1, free[j] | (1 << j)] += weight[i, j] * forward[i, free[j]]
    for i in reversed(range(n)):
        backward[i] = alone[i] * backward[i + 1]
        for j in np.flatnonzero(weight[i]):
            backward[i, free[j]] += weight[i, j] * backward[i + 1, free[j] | (1 << j)]
    out = np.zeros((n, m))
    for i in range(n):
        for j in np.flatnonzero(weight[i]):
            out[i, j] = weight[i, j] * (forward[i, free[j]] @ backward[i + 1, free[j] | (1 << j)])
    return np.asarray(out / backward[0, 0])


def _belief_propagation(log_odds: Array) -> Array:
    weight = np.exp(np.minimum(log_odds, 50.0))
    back = np.ones_like(weight)
    for _ in range(_PASSES):
        incoming = weight * back
        forth = weight / (1 + _others(incoming, 1))
        new = 1 / (1 + _others(forth, 0))
        change = np.abs(new - back).max()
        back = new
        if change < 1e-9:
            break
    incoming = weight * back
    return np.asarray(incoming / (1 + incoming.sum(1, keepdims=True)))


def _others(values: Array, axis: int) -> Array:
    """Sums along the axis less each element, never below 0 by rounding."""
    return np.asarray(np.maximum(values.sum(axis, keepdims=True) - values, 0.0))
