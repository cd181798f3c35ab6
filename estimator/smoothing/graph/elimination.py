"""The smoothing graph in GTSAM: its factors, the order of elimination, its marginals.

The marginal covariances of all variables come from one backward sweep over the cliques. A clique
R x = d - S s gives, from the separator's covariance P, its own R^-1 R^-T + G P G^T and
its cross covariance G P, G = -R^-1 S (Rauch-Tung-Striebel in square root form; Takahashi's
selected inverse). The separator lies within the clique of its first variable, so that no other
blocks than those of the elimination are needed. Sums of squares only: unlike GTSAM's marginals it
works on graphs whose posterior is far from round.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from telerig.arrays import Array, Ints
from telerig.errors import CalibrationError
from telerig.estimator.smoothing.graph.layout import GraphLayout
from telerig.factors.linear_factors import LinearFactors, add_linear_factors

LEAST_PIVOT = 1e-9
"""Of the information's diagonal, what Cholesky's elimination has to leave of it; covariances are
then good to 1e-5."""

_KEYS_AT_ONCE = 500

_NOTHING = np.zeros(0, np.int64)


@dataclass(frozen=True)
class EliminatedGraph:
    """Hold a graph whose variables have been eliminated.

    cliques : the square root of the information, in the order of elimination.
    """

    graph: GraphLayout
    cliques: list[Clique]

    def log_det(self) -> float:
        """Return log |det R|; QR leaves signs on the diagonal."""
        return float(np.log(np.abs(_diagonal(self.cliques))).sum())

    @cached_property
    def _columns(self) -> list[tuple[Ints, Ints]]:
        """Of each clique, the columns of its own keys and of its separator."""
        starts = starts_of(self.graph)

        def of(keys: list[int]) -> Ints:
            return np.concatenate([_NOTHING, *(np.arange(starts[k], starts[k + 1]) for k in keys)])

        return [(of(c.fronts), of(c.separator)) for c in self.cliques]

    @cached_property
    def vector(self) -> Array:
        """The solution (D,) of all variables, in the order of their keys."""
        out = np.zeros(int(starts_of(self.graph)[-1]))
        for clique, (own, _) in zip(self.cliques, self._columns):
            out[own] = clique.side
        return self._substituted(out[:, None])[:, 0]

    def solved(self, side: Array) -> Array:
        """Return the solutions (D, N) of the normal equations for right sides (D, N)."""
        from scipy.linalg.lapack import dtrtrs

        out = side.copy()
        for clique, (own, above) in zip(self.cliques, self._columns):
            mine = out[own] = dtrtrs(clique.root, out[own], trans=1)[0]
            out[above] -= clique.right.T @ mine
        return self._substituted(out)

    def columns(self, at: Ints) -> Array:
        """Return columns (D, n) of the covariance at n of the D variables."""
        return self.solved(units(at, int(starts_of(self.graph)[-1])))

    def _substituted(self, out: Array) -> Array:
        """Solve for the roots' right sides (D, N), in place."""
        from scipy.linalg.lapack import dtrtrs

        for clique, (own, above) in zip(reversed(self.cliques), reversed(self._columns)):
            out[own] = dtrtrs(clique.root, out[own] - clique.right @ out[above])[0]
        return out

    def blocks(self) -> list[Array]:
        """Return the marginal covariances of the variables, each in the basis of `StateSpace.bases`
        that it is solved in.

        For each kind of variable (shake, bubbles, ...), (n, d, d) for its n variables of d numbers;
        that of the shake at the frames.
        """
        graph = self.graph
        base, counts = graph.base(), graph.counts()
        nodes, of_frame = np.unique(graph.nodes.of_frame, return_inverse=True)
        own = [np.zeros((n, d, d)) for n, d in counts]
        own[0] = np.zeros((len(nodes), *own[0].shape[1:]))
        keys = [nodes, *(base[i] + np.arange(n) for i, (n, _) in enumerate(counts) if i)]
        wanted = {
            key: block
            for some, blocks in zip(keys, own)
            if blocks.size
            for key, block in zip(some.tolist(), blocks)
        }
        fill_covariances(self.cliques, _sizes(graph), wanted)
        return [own[0][of_frame], *own[1:]]


def eliminate(
    graph: GraphLayout, factors: list[LinearFactors], *, cholesky: bool
) -> EliminatedGraph:
    """Eliminate all variables of a graph.

    cholesky : whether Cholesky's elimination is used; otherwise QR, which is slower and keeps more
    digits. Raises CalibrationError if the factors do not determine all variables.
    """
    import gtsam

    (order, when), sizes = _ordering(graph), _sizes(graph)
    if cholesky:
        try:
            cliques = _eliminated(factors, order, when, sizes)
            if _least_pivot(cliques, factors, sizes) > LEAST_PIVOT:
                return EliminatedGraph(graph, cliques)
        except RuntimeError:
            pass
    try:
        return EliminatedGraph(graph, _eliminated(factors, order, when, sizes, gtsam.EliminateQR))
    except RuntimeError as error:
        raise CalibrationError(
            f"the graph cannot be solved: {str(error).strip().splitlines()[0]}",
            todo="check the shake model: the noise of every process has to be above 0",
        ) from error


def _eliminated(
    factors: Sequence[LinearFactors], order: Ints, when: Ints, sizes: Sequence[int], *function: Any
) -> list[Clique]:
    """Return the cliques, from some thousand keys at a time, after which GTSAM's memory is free.

    order : (C,) keys as they are eliminated.  when : (C,) their times, at which alone it is cut.
    function : GTSAM's of elimination, for another than its default.
    """
    import gtsam

    place = np.full(len(sizes), len(order))
    place[order] = np.arange(len(order))
    first = [_first_place(linear, place) for linear in factors]
    begins = np.flatnonzero(np.diff(when, prepend=-1))
    cuts = [0]
    while cuts[-1] < len(order):
        later = begins[np.searchsorted(begins, cuts[-1] + _KEYS_AT_ONCE) :]
        cuts.append(int(later[0]) if len(later) else len(order))
    rest, cliques = gtsam.GaussianFactorGraph(), list[Clique]()
    for begin, end in pairwise(cuts):
        for linear, at in zip(factors, first):
            mine = np.flatnonzero((at >= begin) & (at < end))
            if len(mine):
                some = linear.of(mine)
                add_linear_factors(rest, some.keys, some.blocks, some.rhs)
        some_keys = gtsam.Ordering()
        for key in order[begin:end].tolist():
            some_keys.push_back(key)
        net, rest = rest.eliminatePartialSequential(some_keys, *function)
        cliques += cliques_of(net, sizes, when[begin:end])
        del net
    return cliques


def _first_place(linear: LinearFactors, place: Ints) -> Ints:
    """Return the place (M,) of each factor's variable that is eliminated first."""
    out = np.full(len(linear.rhs), len(place))
    for key, block in zip(linear.keys, linear.blocks):
        if block.shape[-1]:
            out = np.minimum(out, place[np.asarray(key)])
    return out


def _sizes(graph: GraphLayout) -> list[int]:
    """Dimension of each key."""
    return [d for n, d in graph.counts() for _ in range(n)]


def units(at: Ints, size: int) -> Array:
    """Return unit vectors (size, n) along n variables."""
    out = np.zeros((size, len(at)))
    out[at, np.arange(len(at))] = 1.0
    return out


def starts_of(graph: GraphLayout) -> Ints:
    """Return the first column of each key in the vector of all variables, and its length."""
    return np.asarray(np.r_[0, np.cumsum(_sizes(graph))], np.int64)


def _diagonal(cliques: Sequence[Clique]) -> Array:
    """Return the diagonals (D,) of the roots, in order of elimination."""
    return np.concatenate([np.zeros(0), *(np.diagonal(c.root) for c in cliques)])


def _least_pivot(
    cliques: Sequence[Clique], factors: Sequence[LinearFactors], sizes: Sequence[int]
) -> float:
    """Return the least ratio of a pivot to the information's diagonal."""
    starts = np.r_[0, np.cumsum(sizes)]
    before = np.zeros(starts[-1])
    for linear in factors:
        for key, block in zip(linear.keys, linear.blocks):
            own = starts[np.asarray(key)][..., None] + np.arange(block.shape[-1])
            square = np.broadcast_to((block**2).sum(-2), (len(linear.rhs), block.shape[-1]))
            before += np.bincount(
                np.broadcast_to(own, square.shape).ravel(), square.ravel(), len(before)
            )
    order = [np.arange(starts[k], starts[k + 1]) for c in cliques for k in c.fronts]
    return float(np.min(_diagonal(cliques) ** 2 / before[np.concatenate(order)], initial=1.0))


def _ordering(graph: GraphLayout) -> tuple[Ints, Ints]:
    """Keys in the order in which they are eliminated, with their times.

    What ends (a bubble's mean, a mark) follows right after it was last seen; the rest is last.
    """
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
    times = np.concatenate(when)
    order = np.lexsort((joined, rank, times))
    counts = graph.counts()
    rest = [base[i] + np.arange(counts[i].number * (counts[i].size > 0)) for i in (3, 4, 6)]
    last = np.full(sum(map(len, rest)), len(graph.nodes.t_s))
    return np.concatenate([joined[order], *rest]), np.append(times[order], last)


@dataclass(frozen=True)
class Clique:
    """Conditionals that are eliminated one after the other and end in the same separator.

    fronts : their own keys, in the order of elimination.
    separator : keys.
    root : (n, n) upper triangular R.
    right : (n, m) S, columns as in the separator.
    side : (n,) d.
    """

    fronts: list[int]
    separator: list[int]
    root: Array
    right: Array
    side: Array

    @property
    def keys(self) -> list[int]:
        """Return the keys of its variables: those that it eliminates, then the separator."""
        return self.fronts + self.separator


def cliques_of(net: Any, sizes: Sequence[int], when: Ints) -> list[Clique]:
    """Return the cliques of a `gtsam.GaussianBayesNet`, one per conditional, in elimination order.

    A conditional is joined to the next one where that is its parent and of the same time.
    sizes : dimension of each key, keys counting from 0.  when : (C,) times of the conditionals.
    """
    conditionals = [net.at(i) for i in range(int(net.size()))]
    keys = [list(c.keys()) for c in conditionals]
    ends = np.append(np.diff(when) != 0, True).tolist()
    last = [i for i, end in enumerate(ends) if end or keys[i + 1][0] not in keys[i][1:]]
    out, first = [], 0
    for end in last:
        mine = range(first, end + 1)
        first = end + 1
        if len(mine) == 1:
            # copies, since what GTSAM returns are views of memory that ends with the net
            root, right = conditionals[end].R().copy(), conditionals[end].S().copy()
            side = conditionals[end].d().copy()
            out.append(Clique(keys[end][:1], keys[end][1:], root, right, side))
            continue
        fronts, separator = [keys[i][0] for i in mine], keys[end][1:]
        every = fronts + separator
        starts, width = _starts(every, sizes)
        wide = sum([sizes[k] for k in fronts])
        both = np.zeros((wide, width))
        for i in mine:
            row = starts[keys[i][0]]
            below = row + sizes[keys[i][0]]
            both[row:below, row:below] = conditionals[i].R()
            right, column = conditionals[i].S(), 0
            for key in keys[i][1:]:
                end = column + sizes[key]
                both[row:below, starts[key] : starts[key] + sizes[key]] = right[:, column:end]
                column = end
        side = np.concatenate([conditionals[i].d() for i in mine])
        out.append(Clique(fronts, separator, both[:, :wide], both[:, wide:], side))
    return out


def fill_covariances(
    cliques: Sequence[Clique], sizes: Sequence[int], wanted: Mapping[int, Array]
) -> None:
    """Write marginal covariances into the arrays that are given.

    sizes : dimension of each key, keys counting from 0.
    wanted : (d, d) of keys.
    """
    from scipy.linalg.lapack import dtrtri

    where = {key: i for i, clique in enumerate(cliques) for key in clique.fronts}
    parents = [min(map(where.__getitem__, c.separator), default=-1) for c in cliques]
    children = [0] * len(cliques)
    for parent in parents:
        children[parent] += parent >= 0
    joint: dict[int, Array] = {}
    for i in range(len(cliques) - 1, -1, -1):
        clique, parent = cliques[i], parents[i]
        inverse, _ = dtrtri(clique.root)
        block = inverse @ inverse.T
        if parent >= 0:
            above, known = joint[parent], cliques[parent].keys
            if clique.separator != known:
                place = _starts(known, sizes)[0]
                at = np.concatenate(
                    [np.arange(place[k], place[k] + sizes[k]) for k in clique.separator]
                )
                above = above.take(at[:, None] * len(above) + at)
            block = _joined(block, inverse @ clique.right, above)
            children[parent] -= 1
            if not children[parent]:
                del joint[parent]
        starts, _ = _starts(clique.keys, sizes)
        for key in clique.fronts:
            mine = slice(starts[key], starts[key] + sizes[key])
            if key in wanted:
                wanted[key][...] = block[mine, mine]
        if children[i]:
            joint[i] = block


def _joined(own: Array, gain: Array, above: Array) -> Array:
    """Covariance of x = -gain s + noise and s, from the noise's and that of s.

    It is made symmetric, since a difference between both triangles, of rounding, may grow from
    clique to clique: by 10^14 in 300 frames, which left negative variances.
    """
    size, width = len(own), len(own) + len(above)
    block = np.empty((width, width))
    cross = gain @ above
    from_above = cross @ gain.T
    block[:size, :size] = own + 0.5 * (from_above + from_above.T)
    block[:size, size:] = -cross
    block[size:, :size] = block[:size, size:].T
    block[size:, size:] = above
    return block


def _starts(keys: list[int], sizes: Sequence[int]) -> tuple[dict[int, int], int]:
    """Return the first column of each key side by side, and the number of columns."""
    ends = list(accumulate([sizes[k] for k in keys], initial=0))
    return dict(zip(keys, ends)), ends[-1]
