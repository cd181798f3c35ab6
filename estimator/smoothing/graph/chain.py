"""The smoothing graph as a chain of frames: its normal equations eliminated by arrays.

Where nothing but frames carries states (no sensor between them), the graph is a chain: everything
of one frame side by side, x_t, joined to x_{t+1} and to what is constant over the run, c. Forward,

    L_t L_t^T = H_t,   [w, W_c, W_n] = L_t^-1 [g_t, H_tc, H_t,t+1],   H_{t+1} -= W_n^T W_n, ...

and backward the Rauch-Tung-Striebel recursion with the gain L_t^-T [W_c, W_n]. It is the
elimination that GTSAM makes on the same factors (tests compare them), without an object a factor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg.blas import dtrsv
from scipy.linalg.lapack import dpotrf

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.block_tridiagonal import eliminate_forward, inverses
from telerig.estimator.smoothing.graph.blocks import Blocks
from telerig.estimator.smoothing.graph.state import GraphLayout
from telerig.factors.linear_factors import Linear

MOST_CONSTANTS = 60
"""Columns for what is constant ride along in every frame; with more GTSAM drops what has ended."""

LEAST_PIVOT = 1e-9
"""Of a diagonal, what elimination leaves of it; covariances then are good to 1e-5."""

_CHUNK = 1000


@dataclass(frozen=True)
class Places:
    """Where each family's increments sit: frame and first column, or a column of the constants.

    slot : (rows,) of each bubble's row; bubbles that live at different times share one.
    width : columns of a frame.  constants : columns of what is constant.
    """

    graph: GraphLayout
    slot: Ints
    width: int
    constant_start: Ints
    constants: int

    def of_keys(self, keys: Ints) -> tuple[Ints, Ints]:
        """(M,) frame, -1 for constants, and (M,) first column."""
        base, counts = self.graph.base(), self.graph.counts()
        when = np.full(len(keys), -1)
        column = np.zeros(len(keys), np.int64)
        node = keys < base.bubbles
        row = (keys >= base.bubbles) & (keys < base.means)
        rest = keys >= base.means
        when[node] = keys[node]
        at = keys[row] - base.bubbles
        when[row] = self.graph.node_of_row[at]
        column[row] = counts.shake.size + self.slot[at] * counts.bubbles.size
        column[rest] = self.constant_start[keys[rest] - base.means]
        return when, column


def is_chain_of_frames(graph: GraphLayout) -> bool:
    """Whether a graph of frames alone has states to chain, and few constants."""
    constants = sum(n * d for n, d in graph.counts()[2:])
    return graph.shake.size > 0 and constants <= MOST_CONSTANTS


def places_of(graph: GraphLayout) -> Places:
    counts = graph.counts()
    bubbles = graph.problem.bubbles
    slot_of, free_from = np.zeros(len(bubbles), np.int64), list[int]()
    for k in sorted(range(len(bubbles)), key=lambda k: bubbles[k].first):
        free = [i for i, f in enumerate(free_from) if f <= bubbles[k].first]
        slot_of[k] = free[0] if free else len(free_from)
        if not free:
            free_from.append(0)
        free_from[slot_of[k]] = bubbles[k].last + 1
    sizes = np.repeat([d for _, d in counts[2:]], [n for n, _ in counts[2:]]).astype(np.int64)
    starts = np.r_[0, np.cumsum(sizes)].astype(np.int64)
    width = counts.shake.size + len(free_from) * counts.bubbles.size
    return Places(graph, slot_of[graph.bubble_of_row], width, starts[:-1], int(starts[-1]))


@dataclass(frozen=True)
class NormalEquations:
    """own : (F, D, D).  joined : (F, 1 + C + D, D), rows: right side, constants, next frame.

    constant : (C, C + 1), the last column its right side.
    """

    own: Array
    joined: Array
    constant: Array


def normal_equations(places: Places, factors: list[Linear]) -> NormalEquations:
    count, width, constants = len(places.graph.nodes.t_s), places.width, places.constants
    out = NormalEquations(
        np.zeros((count, width, width)),
        np.zeros((count, 1 + constants + width, width)),
        np.zeros((constants, constants + 1)),
    )
    for linear in factors:
        for keys, blocks, rhs in _pieces(linear):
            _add(out, places, keys, blocks, rhs)
    _fill_unused(out, places)
    return out


def _pieces(linear: Linear) -> Iterator[tuple[list[Ints], list[Array], Array]]:
    """Keys, blocks with columns and right sides, so many factors at a time."""
    count = len(linear.rhs)
    kept = [(k, b) for k, b in zip(linear.keys, linear.blocks) if b.shape[-1]]
    keys = [np.broadcast_to(np.asarray(k, np.int64), (count,)) for k, _ in kept]
    blocks = [np.broadcast_to(b, (count, *b.shape[-2:])) for _, b in kept]
    for i in range(0, count, _CHUNK):
        some = slice(i, i + _CHUNK)
        yield [k[some] for k in keys], [b[some] for b in blocks], linear.rhs[some]


def _add(
    out: NormalEquations, places: Places, keys: list[Ints], blocks: list[Array], rhs: Array
) -> None:
    located = [places.of_keys(k) for k in keys]
    columns = np.stack([c for _, c in located])
    rows = np.concatenate([*blocks, rhs[..., None]], -1)
    gram = np.swapaxes(rows, -1, -2) @ rows
    edges = np.cumsum([0, *(b.shape[-1] for b in blocks)])
    spans = [slice(a, b) for a, b in pairwise(edges)]
    groups = _alike(columns)
    whole = len(groups) == 1
    for mine in groups:
        at = columns[:, mine[0]]
        whens = [w[mine] for w, _ in located]
        for a, span in enumerate(spans):
            _add_side(out, whens[a], at[a], gram[mine, span, -1])
            for b, other in enumerate(spans):
                pair = (whens[a], whens[b]), (int(at[a]), int(at[b]))
                _add_block(out, *pair, gram[:, span, other] if whole else gram[mine, span, other])


def _alike(columns: Ints) -> list[Ints]:
    """Groups of factors whose keys sit in the same columns."""
    if np.all(columns == columns[:, :1]):
        return [np.arange(columns.shape[1])]
    _, group = np.unique(columns, axis=1, return_inverse=True)
    return [np.flatnonzero(group == g) for g in range(group.max() + 1)]


def _add_side(out: NormalEquations, when: Ints, column: int, side: Array) -> None:
    size = side.shape[-1]
    if when[0] < 0:
        out.constant[column : column + size, -1] += side.sum(0)
    else:
        frames, total = _summed(when, side)
        out.joined[frames, 0, column : column + size] += total


def _add_block(
    out: NormalEquations, whens: tuple[Ints, Ints], columns: tuple[int, int], block: Array
) -> None:
    """Add (M, a, b) blocks of J_a^T J_b: rows of the first key, columns of the second.

    Of a frame's own block only the upper triangle with its diagonal, which Cholesky reads.
    """
    (one, two), (i, j) = whens, columns
    a, b = slice(i, i + block.shape[1]), slice(j, j + block.shape[2])
    if one[0] < 0 and two[0] < 0:
        out.constant[a, b] += block.sum(0)
    elif one[0] < 0:
        frames, total = _summed(two, block)
        out.joined[frames, 1 + a.start : 1 + a.stop, b] += total
    elif two[0] >= 0 and i <= j and np.array_equal(one, two):
        frames, total = _summed(two, block)
        out.own[frames, a, b] += total
    elif two[0] >= 0 and np.array_equal(one, two + 1):
        frames, total = _summed(two, block)
        after = 1 + len(out.constant)
        out.joined[frames, after + a.start : after + a.stop, b] += total


def _summed(when: Ints, values: Array) -> tuple[Ints, Array]:
    """Sums of the values of each frame."""
    if len(when) < 2 or np.all(np.diff(when) > 0):
        return when, values
    order = np.argsort(when, kind="stable")
    frames, first = np.unique(when[order], return_index=True)
    return frames, np.add.reduceat(values[order], first, axis=0)


def _fill_unused(out: NormalEquations, places: Places) -> None:
    """One on the diagonal of the slots that no bubble has at a frame."""
    shake, bubble = (d for _, d in places.graph.counts()[:2])
    slots = (places.width - shake) // bubble if bubble else 0
    used = np.zeros((len(out.own), slots), bool)
    used[places.graph.node_of_row, places.slot] = True
    for frames, slot in ((np.flatnonzero(~used[:, s]), s) for s in range(slots)):
        for i in range(shake + slot * bubble, shake + (slot + 1) * bubble):
            out.own[frames, i, i] = 1.0


@dataclass(frozen=True)
class EliminatedChain:
    """upper : (F, D, D) L^T.  whitened : (F, 1 + C + D, D) as `NormalEquations.joined`, whitened.

    constant_root : (C, C) lower.  vector : the solution, keys in their order.
    """

    places: Places
    upper: Array
    whitened: Array
    constant_root: Array
    vector: Array

    def log_det(self) -> float:
        """log |R| of the square root of the information."""
        diagonals = np.diagonal(self.upper, axis1=-2, axis2=-1), np.diagonal(self.constant_root)
        return float(sum(np.log(np.abs(d)).sum() for d in diagonals))

    def blocks(self) -> Blocks:
        """Marginal covariances of all increments, and of shake with bubbles at the same frame."""
        graph, places = self.places.graph, self.places
        counts, constants = graph.counts(), places.constants
        shake, bubble = counts.shake.size, counts.bubbles.size
        rows = np.arange(graph.rows)
        at = shake + places.slot[:, None] * bubble + np.arange(bubble)
        own = [np.zeros((len(self.upper), shake, shake)), np.zeros((len(rows), bubble, bubble))]
        cross = np.zeros((len(rows), shake, bubble))
        inverse = np.linalg.inv(self.constant_root)
        of_constants = inverse.T @ inverse
        for first, found in _backward(self, of_constants):
            own[0][first : first + len(found)] = found[:, :shake, :shake]
            inside = (graph.node_of_row >= first) & (graph.node_of_row < first + len(found))
            mine = np.flatnonzero(inside)
            node, columns = graph.node_of_row[mine] - first, at[mine]
            own[1][mine] = found[node[:, None, None], columns[:, :, None], columns[:, None]]
            cross[mine] = found[node[:, None], :shake, columns].swapaxes(-1, -2)
        starts = np.r_[places.constant_start, constants]
        key = 0
        for number, size in counts[2:]:
            spans = [slice(starts[k], starts[k] + size) for k in range(key, key + number)]
            blocks = np.array([of_constants[s, s] for s in spans])
            own.append(blocks.reshape(number, size, size))
            key += number
        own[0] = own[0][graph.nodes.of_frame]
        return Blocks(own, cross)


def eliminate(places: Places, equations: NormalEquations) -> EliminatedChain:
    """Forward over the frames, the constants, and back for the solution. The input is used up.

    Raises numpy's LinAlgError where Cholesky's pivots run out of digits.
    """
    own, joined, constants = equations.own, equations.joined, places.constants
    after = 1 + constants
    before = np.diagonal(own, axis1=-2, axis2=-1).copy()
    eliminate_forward(own, joined)
    if np.min(np.diagonal(own, axis1=-2, axis2=-1) ** 2 / before) < LEAST_PIVOT:
        raise np.linalg.LinAlgError("too few digits are left")
    rows = joined[:, :after].transpose(1, 0, 2).reshape(after, -1)
    reduced = equations.constant - rows[1:] @ np.roll(rows, -1, 0).T
    root, fault = dpotrf(reduced[:, :-1], lower=1, clean=1) if constants else (np.eye(0), 0)
    if fault:
        raise np.linalg.LinAlgError("the constants")
    fixed = np.linalg.solve(root @ root.T, reduced[:, -1]) if constants else np.zeros(0)
    states = _back_substituted(own, joined, fixed)
    return EliminatedChain(places, own, joined, root, _in_key_order(places, states, fixed))


def _back_substituted(upper: Array, whitened: Array, constants: Array) -> Array:
    """(F, D) increments of the frames."""
    after = 1 + len(constants)
    side = whitened[:, 0] - np.einsum("tcd,c->td", whitened[:, 1:after], constants)
    following = np.zeros(upper.shape[-1])
    out = np.empty(side.shape)
    for t in range(len(upper) - 1, -1, -1):
        right = side[t] - following @ whitened[t, after:]
        out[t] = following = np.asarray(dtrsv(upper[t].T, right, lower=1, trans=1))
    return out


def _in_key_order(places: Places, states: Array, constants: Array) -> Array:
    graph = places.graph
    shake, bubble = (d for _, d in graph.counts()[:2])
    columns = shake + places.slot[:, None] * bubble + np.arange(bubble)
    of_rows = states[graph.node_of_row[:, None], columns]
    return np.concatenate([states[:, :shake].ravel(), of_rows.ravel(), constants])


def _backward(chain: EliminatedChain, of_constants: Array) -> Iterator[tuple[int, Array]]:
    """(first frame, (m, D, D) covariances) of one stretch of frames after another, last first."""
    constants, count = len(of_constants), len(chain.upper)
    width = chain.upper.shape[-1]
    joint = np.zeros((constants + width, constants + width))
    joint[:constants, :constants] = of_constants
    for stop in range(count, 0, -_CHUNK):
        first = max(stop - _CHUNK, 0)
        inverse = inverses(chain.upper[first:stop])
        found = inverse @ inverse.swapaxes(-1, -2)
        gains = chain.whitened[first:stop, 1:] @ inverse.swapaxes(-1, -2)
        for own, gain in zip(found[::-1], gains[::-1]):
            carried = joint @ gain
            own += gain.T @ carried
            joint[constants:, constants:] = own
            joint[:constants, constants:] = -carried[:constants]
            joint[constants:, :constants] = -carried[:constants].T
        yield first, found
