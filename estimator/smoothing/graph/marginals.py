"""Marginal covariances of every variable of a chain-like Bayes net, by one backward sweep.

A conditional R x = d - S s gives, from the separator's covariance P, the variable's own
R^-1 R^-T + G P G^T and its cross covariance G P, G = -R^-1 S (Rauch-Tung-Striebel in square root
form; Takahashi's selected inverse). The separator lies within the clique of its first variable, so
nothing but blocks that the elimination made is ever needed. Sums of squares only: unlike GTSAM's
marginals it works on graphs whose posterior is far from round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Marginals:
    """own : (d, d) covariance of each wanted key.  cross : (d, e) of each wanted pair."""

    own: dict[int, Array]
    cross: dict[tuple[int, int], Array]


def marginal_covariances(
    net: Any, sizes: Sequence[int], wanted: set[int], pairs: Sequence[tuple[int, int]]
) -> Marginals:
    """Covariances out of a `gtsam.GaussianBayesNet` with one key a conditional.

    sizes : dimension of each key, keys counting from 0.  pairs : (key, later key) of one clique
    whose cross covariances are wanted too.
    """
    conditionals = [net.at(i) for i in range(int(net.size()))]
    keys = [list(c.keys()) for c in conditionals]
    when = {clique[0]: i for i, clique in enumerate(keys)}
    parents = [min(c[1:], key=when.__getitem__, default=-1) for c in keys]
    children = [0] * len(sizes)
    for parent in parents:
        children[parent] += parent >= 0
    seconds: dict[int, list[int]] = {}
    for first, second in pairs:
        seconds.setdefault(first, []).append(second)
    joint: dict[int, tuple[list[int], Array]] = {}
    patterns: dict[tuple[Any, ...], NDArray[np.int64]] = {}
    own_of: dict[int, Array] = {}
    cross_of: dict[tuple[int, int], Array] = {}
    for conditional, clique, parent in zip(conditionals[::-1], keys[::-1], parents[::-1]):
        own, size = clique[0], sizes[clique[0]]
        inverse, _ = dtrtri(conditional.R())
        block = inverse @ inverse.T
        if parent >= 0:
            block = _joined(
                block, inverse @ conditional.S(), _within(clique, joint[parent], sizes, patterns)
            )
            children[parent] -= 1
            if not children[parent]:
                del joint[parent]
        if own in wanted:
            own_of[own] = block[:size, :size].copy()
        for other in seconds.get(own, ()):
            at = sum([sizes[k] for k in clique[: clique.index(other)]])
            cross_of[own, other] = block[:size, at : at + sizes[other]].copy()
        if children[own]:
            joint[own] = (clique, block)
    return Marginals(own_of, cross_of)


def _joined(own: Array, gain: Array, above: Array) -> Array:
    """Covariance of x = -gain s + noise and s, from the noise's and that of s."""
    size, width = len(own), len(own) + len(above)
    block = np.empty((width, width))
    cross = gain @ above
    block[:size, :size] = own
    block[:size, :size] += cross @ gain.T
    block[:size, size:] = -cross
    block[size:, :size] = block[:size, size:].T
    block[size:, size:] = above
    return block


def _within(
    clique: list[int],
    parent: tuple[list[int], Array],
    sizes: Sequence[int],
    patterns: dict[tuple[Any, ...], NDArray[np.int64]],
) -> Array:
    """Covariance of a clique's separator, out of its parent's clique."""
    keys, block = parent
    separator = clique[1:]
    if separator == keys:
        return block
    shape = (*[keys.index(k) for k in separator], -1, *[sizes[k] for k in keys])
    flat = patterns.get(shape)
    if flat is None:
        starts = np.r_[0, np.cumsum([sizes[k] for k in keys])]
        places = [keys.index(k) for k in separator]
        index = np.concatenate([np.arange(starts[p], starts[p + 1]) for p in places])
        flat = index[:, None] * len(block) + index
        patterns[shape] = flat
    return block.take(flat)
