"""Represents whitened linear factors as arrays, and converts them to GTSAM.

A factor is |sum_k A_k x_k - b|^2 with unit noise. Many factors of equal shape are computed together
in NumPy and then given to GTSAM one by one. GTSAM's `JacobianFactor` takes up to three keys.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Ints

AT_ONCE = 4096
"""Number of factors, or of states, that are worked on together: what is between stays in the cache
and takes little memory."""


@dataclass(frozen=True)
class LinearFactors:
    """Holds M whitened linear factors of equal shape.

    keys : for each variable of the factors an array of keys (M,).
    blocks : for each variable its Jacobians A_k (M, rows, columns).
    rhs : (M, rows) the right-hand sides b.
    log_det : (M,) logarithm of the determinant of each factor's whitening matrix.
    weight : (M,) weights from 0 to 1 of a robust fit, with which blocks and rhs are already
        multiplied; None for no weights.
    kind : name by which some of a graph's factors are found; "" for all others.
    """

    keys: tuple[ArrayLike, ...]
    blocks: tuple[Array, ...]
    rhs: Array
    log_det: Array
    weight: Array | None = None
    kind: str = ""

    def of(self, which: Ints) -> LinearFactors:
        """Return the factors with the indices (m,)."""
        count = len(self.rhs)
        keys = tuple(np.asarray(k)[which] if np.ndim(k) else k for k in self.keys)
        blocks = tuple(np.broadcast_to(b, (count, *b.shape[-2:]))[which] for b in self.blocks)
        weight = None if self.weight is None else self.weight[which]
        return LinearFactors(keys, blocks, self.rhs[which], self.log_det[which], weight, self.kind)

    def log_norm(self) -> float:
        """Return the sum of the logarithms of the factors' normalisation constants."""
        share = np.ones(len(self.rhs)) if self.weight is None else self.weight
        each = self.log_det - self.rhs.shape[1] * 0.5 * np.log(2 * np.pi)
        return float((share * each).sum())


def prior_factors(keys: ArrayLike, deviation: Array, sigma: ArrayLike) -> LinearFactors:
    """Return the factors of M Gaussian priors on vectors of n independent components.

    keys : (M,).
    deviation : (M, n) current values minus the mean of the prior.
    sigma : standard deviations, of any shape that broadcasts to (M, n).
    """
    count, width = deviation.shape
    scale = np.broadcast_to(1 / np.asarray(sigma, float), (count, width))
    block = scale[:, :, None] * np.eye(width)
    return LinearFactors((keys,), (block,), -deviation * scale, np.log(scale).sum(-1))


@lru_cache(maxsize=64)
def _unit_noise(rows: int) -> Any:
    import gtsam

    return gtsam.noiseModel.Unit.Create(rows)


def add_linear_factors(
    graph: Any, keys: Sequence[ArrayLike], blocks: Sequence[Array], rhs: Array
) -> None:
    """Add M factors |sum_k blocks[k] x_keys[k] - rhs|^2 with unit noise to a GaussianFactorGraph.

    keys : for each of up to three variables the keys (M,), or one key for all factors.
    blocks : for each variable (M, rows, columns), or (rows, columns) for all factors. A block
        without columns is left out.
    rhs : (M, rows).
    """
    import gtsam

    count, rows = rhs.shape
    kept = [(k, b) for k, b in zip(keys, blocks) if b.shape[-1]]
    noise, factor = _unit_noise(rows), cast(Any, gtsam.JacobianFactor)
    columns: list[Any] = []
    for key, block in kept:
        columns.append(np.asarray(key).tolist() if np.ndim(key) else [key] * count)
        columns.append(block if block.ndim == 3 and len(block) == count else [block] * count)
    push_back = graph.push_back
    for parts in zip(*columns, rhs):
        push_back(factor(*parts, noise))


def product(factors: Sequence[LinearFactors], starts: Ints, values: Array) -> list[Array]:
    """Return the product A x of the factors' Jacobians and K vectors.

    starts : for each key, counted from 0, the row of ``values`` at which its variable begins.
    values : (D, K) the vectors x in columns, D the total size of all variables.

    Returns for each element of ``factors`` the products (M, rows, K) of its M factors.
    """
    out = []
    for linear in factors:
        total = np.zeros((*linear.rhs.shape, values.shape[1]))
        for mine, at, block in _places(linear, starts):
            total[mine] += block @ values[at]
        out.append(total)
    return out


def transposed_product(
    factors: Sequence[LinearFactors], starts: Ints, values: Sequence[Array]
) -> Array:
    """Return the product A^T y (D, K) of the factors' transposed Jacobians and K vectors.

    starts : for each key, counted from 0, the row of the result at which its variable begins.
    values : for each element of ``factors`` the vectors y (M, rows, K), for its M factors of
        ``rows`` residuals each.
    """
    out = np.zeros((int(starts[-1]), values[0].shape[-1]))
    for linear, given in zip(factors, values):
        for mine, at, block in _places(linear, starts):
            share = np.swapaxes(block, -1, -2) @ given[mine]
            if np.any(np.diff(at[:, 0]) < 0):
                order = np.argsort(at[:, 0], kind="stable")
                share, at = share[order], at[order]
            first = np.flatnonzero(np.diff(at[:, 0], prepend=-1))
            if len(first) < len(at):
                share, at = np.add.reduceat(share, first, axis=0), at[first]
            out[at] += share
    return out


def _places(linear: LinearFactors, starts: Ints) -> Iterator[tuple[slice, Ints, Array]]:
    """Yield some of the factors, the rows (m, columns) of a variable of theirs, and its block."""
    count = len(linear.rhs)
    for key, block in zip(linear.keys, linear.blocks):
        if not count or not block.shape[-1]:
            continue
        first = starts[np.broadcast_to(np.asarray(key, np.int64), (count,))]
        for begin in range(0, count, AT_ONCE):
            mine = slice(begin, min(begin + AT_ONCE, count))
            part = block[mine] if len(block) == count and block.ndim == 3 else block
            yield mine, first[mine, None] + np.arange(block.shape[-1]), part
