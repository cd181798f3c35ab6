"""Marginal covariances of every variable of a chain-like Bayes net, by one backward sweep.

A conditional R x = d - S s gives, from the separator's covariance P, the variable's own
R^-1 R^-T + G P G^T and its cross covariance G P, G = -R^-1 S (Rauch-Tung-Striebel in square root
form; Takahashi's selected inverse). The separator lies within the clique of its first variable, so
nothing but blocks that the elimination made is ever needed. Sums of squares only: unlike GTSAM's
marginals it works on graphs whose posterior is far from round.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri

Array = NDArray[np.float64]


def marginal_covariances(
    net: Any, sizes: Sequence[int], wanted: set[int], pairs: set[tuple[int, int]]
) -> tuple[dict[int, Array], dict[tuple[int, int], Array]]:
    """Covariance (d, d) of each wanted key of a `gtsam.GaussianBayesNet` (one key a conditional).

    sizes : dimension of each key, keys counting from 0.  pairs : (key, later key) of one clique
    whose cross covariances (d, e) are wanted too.
    """
    count = int(net.size())
    conditionals = [net.at(i) for i in range(count)]
    keys = [list(c.keys()) for c in conditionals]
    when = {clique[0]: i for i, clique in enumerate(keys)}
    parents = [min(c[1:], key=when.__getitem__, default=-1) for c in keys]
    children = [0] * len(sizes)
    for parent in parents:
        children[parent] += parent >= 0
    joint: dict[int, tuple[list[int], Array]] = {}
    patterns: dict[tuple[Any, ...], NDArray[np.int64]] = {}
    out: dict[int, Array] = {}
    crossed: dict[tuple[int, int], Array] = {}
    of_first: dict[int, list[int]] = {}
    for first, second in pairs:
        of_first.setdefault(first, []).append(second)
    for conditional, clique, parent in zip(conditionals[::-1], keys[::-1], parents[::-1]):
        own, size = clique[0], sizes[clique[0]]
        inverse, _ = dtrtri(conditional.R())
        width = size + sum(sizes[k] for k in clique[1:])
        block = np.empty((width, width))
        block[:size, :size] = inverse @ inverse.T
        if width > size:
            above = _within(clique, joint[parent], sizes, patterns)
            gain = inverse @ conditional.S()
            cross = gain @ above
            block[:size, :size] += cross @ gain.T
            block[:size, size:], block[size:, :size] = -cross, -cross.T
            block[size:, size:] = above
            children[parent] -= 1
            if not children[parent]:
                del joint[parent]
        if own in wanted:
            out[own] = block[:size, :size].copy()
        for other in of_first.get(own, ()):
            at = sum(sizes[k] for k in clique[: clique.index(other)])
            crossed[own, other] = block[:size, at : at + sizes[other]].copy()
        if children[own]:
            joint[own] = (clique, block)
    return out, crossed


def _within(
    clique: list[int],
    parent: tuple[list[int], Array],
    sizes: Sequence[int],
    patterns: dict[tuple[Any, ...], NDArray[np.int64]],
) -> Array:
    """Covariance of a clique's separator, out of its parent's clique."""
    keys, block = parent
    if clique[1:] == keys:
        return block
    place = tuple(keys.index(k) for k in clique[1:])
    shape = (place, tuple(sizes[k] for k in keys))
    index = patterns.get(shape)
    if index is None:
        starts = np.r_[0, np.cumsum(shape[1])]
        index = np.concatenate([np.arange(starts[p], starts[p + 1]) for p in place])
        patterns[shape] = index
    return np.asarray(block[index[:, None], index])
