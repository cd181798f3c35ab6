"""The smoothing graph in GTSAM: its factors, the order of elimination, its marginals.

The marginal covariances of all variables come from one backward sweep. A conditional
R x = d - S s gives, from the separator's covariance P, the variable's own R^-1 R^-T + G P G^T and
its cross covariance G P, G = -R^-1 S (Rauch-Tung-Striebel in square root form; Takahashi's
selected inverse). The separator lies within the clique of its first variable, so that no other
blocks than those of the elimination are needed. Sums of squares only: unlike GTSAM's marginals it
works on graphs whose posterior is far from round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg.lapack import dtrtri

from telerig.arrays import Array, Ints
from telerig.errors import CalibrationError
from telerig.estimator.smoothing.graph.blocks import Blocks
from telerig.estimator.smoothing.graph.state import GraphLayout
from telerig.factors.linear_factors import Linear, add_linear_factors

_NOTHING = np.zeros(0, np.int64)


@dataclass(frozen=True)
class EliminatedGraph:
    """net : `gtsam.GaussianBayesNet`, one key a conditional.  vector : the solution."""

    graph: GraphLayout
    net: Any
    vector: Array

    def log_det(self) -> float:
        """log |R|; QR leaves signs on the diagonal."""
        diagonals = (np.diagonal(self.net.at(i).R()) for i in range(self.net.size()))
        return float(sum(np.log(np.abs(d)).sum() for d in diagonals))

    def blocks(self) -> Blocks:
        """Marginal covariances of all increments, and of shake with bubbles at the same frame."""
        graph = self.graph
        base, counts = graph.base(), graph.counts()
        families = [range(base[i], base[i] + n * (d > 0)) for i, (n, d) in enumerate(counts)]
        at_frames = graph.nodes.of_frame.tolist() if counts.shake.size else []
        rows = base.bubbles + np.arange(graph.rows)
        pairs = list(zip(graph.node_of_row.tolist(), rows.tolist())) if counts.shake.size else []
        sizes = [d for n, d in counts for _ in range(n)]
        wanted = set(at_frames).union(*families[1:])
        found, found_cross = marginal_covariances(self.net, sizes, wanted, pairs)
        own = []
        for keys, (number, size) in zip([at_frames, *families[1:]], counts):
            number = number if keys is not at_frames else len(graph.nodes.of_frame)
            own.append(np.array([found[k] for k in keys]).reshape(number, size, size))
        cross = np.array([found_cross[pair] for pair in pairs])
        return Blocks(own, cross.reshape(graph.rows, counts.shake.size, counts.bubbles.size))


def eliminate(graph: GraphLayout, factors: list[Linear], *, cholesky: bool) -> EliminatedGraph:
    """The graph of all factors, solved: by QR, or by Cholesky where that does not refuse.

    Raises CalibrationError where it is undetermined.
    """
    import gtsam

    factor_graph = gtsam.GaussianFactorGraph()
    for linear in factors:
        add_linear_factors(factor_graph, linear.keys, linear.blocks, linear.rhs)
    _add_bonds(factor_graph, graph)
    net, solution = _eliminated(factor_graph, _ordering(graph), cholesky)
    return EliminatedGraph(graph, net, solution.vector())


def _add_bonds(factor_graph: Any, graph: GraphLayout) -> None:
    """Empty factors between shake and bubbles where no image joins them.

    Their cross covariance is read from a clique that holds both, and a bubble that is unseen from
    its first row on would share none.
    """
    size = graph.counts().shake.size
    seen = graph.row(graph.problem.observations.item, graph.problem.observations.frame)
    alone = np.setdiff1d(np.arange(graph.rows), seen)
    if not size or not len(alone):
        return
    keys = (graph.node_of_row[alone], graph.base().bubbles + alone)
    blocks = tuple(np.zeros((len(alone), 1, d)) for d in (size, graph.bubble.size))
    add_linear_factors(factor_graph, keys, blocks, np.zeros((len(alone), 1)))


def _eliminated(factor_graph: Any, ordering: Any, cholesky: bool) -> tuple[Any, Any]:
    """Bayes net and solution."""
    import gtsam

    try:
        if cholesky:
            try:
                net = factor_graph.eliminateSequential(ordering)
                return net, net.optimize()
            except RuntimeError:
                pass
        net = factor_graph.eliminateSequential(ordering, gtsam.EliminateQR)
        return net, net.optimize()
    except RuntimeError as error:
        raise CalibrationError(
            f"the graph cannot be solved: {str(error).strip().splitlines()[0]}",
            todo="check the priors: every component needs a positive intensity",
        ) from error


def _ordering(graph: GraphLayout) -> Any:
    """Time order; what ends (a bubble's mean, a mark) right after it was last seen; rest last."""
    import gtsam

    base, problem = graph.base(), graph.problem
    nodes = np.arange(len(graph.nodes.t_s)) if graph.shake.size else np.zeros(0, np.int64)
    rows = np.arange(graph.rows)
    last_row = graph.node_of_row[graph.first_row[1:] - 1] if len(problem.bubbles) else _NOTHING
    last_mark = np.zeros(len(problem.marks), np.int64)
    seen = graph.nodes.of_frame[problem.references.frame]
    np.maximum.at(last_mark, problem.references.item, seen)
    keys = [nodes, base.bubbles + rows, base.means + np.arange(len(problem.bubbles))]
    when = [nodes, graph.node_of_row, last_row]
    keys.append(base.marks + np.arange(len(problem.marks)))
    when.append(last_mark)
    rank = np.repeat(np.arange(4), [len(k) for k in keys])
    joined = np.concatenate(keys).astype(np.int64)
    order = np.lexsort((joined, rank, np.concatenate(when)))
    out = gtsam.Ordering()
    for key in joined[order].tolist():
        out.push_back(key)
    counts = graph.counts()
    for family in (3, 4, 6):
        number, size = counts[family]
        for key in range(base[family], base[family] + number * (size > 0)):
            out.push_back(key)
    return out


def marginal_covariances(
    net: Any, sizes: Sequence[int], wanted: set[int], pairs: Sequence[tuple[int, int]]
) -> tuple[dict[int, Array], dict[tuple[int, int], Array]]:
    """Covariances (d, d) of the wanted keys and (d, e) of the pairs, from a `GaussianBayesNet`.

    net : one key a conditional.  sizes : dimension of each key, keys counting from 0.
    pairs : (key, later key) of one clique.
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
    patterns: dict[tuple[Any, ...], Ints] = {}
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
    return own_of, cross_of


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
    patterns: dict[tuple[Any, ...], Ints],
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
