"""All bubbles at once, the rig held: the root of their information, by one batched sweep.

Given shake and constants the bubbles are independent of each other. Each is a chain of states with
its mean velocity at the end. All chains begin at their bubble's own first frame, so that the loop
is as long as the longest track and every pass of it takes all bubbles that are that old. QR of the
stacked factors (square root information filter; Bierman, Factorization Methods for Discrete
Sequential Estimation, 1977) keeps the digits that stiff priors need.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.layout import GraphLayout
from telerig.estimator.smoothing.graph.linear import MEANS, PIXELS, STARTS, STEPS
from telerig.factors.linear_factors import LinearFactors


@dataclass(frozen=True)
class Places:
    """The order in which the rows of K bubbles' states are stored here.

    A row is one bubble in one frame. The rows are sorted by age, the number of frames since the
    bubble's first one, and within an age by the bubble, the longest track first.

    order : (K,) indices of the bubbles, the longest track first.
    ends : for each age the index after its last row.
    active : for each age the number of bubbles that reach it.
    place_of_row : (rows,) place of each row of the graph in this order.
    """

    order: Ints
    ends: Ints
    active: Ints
    place_of_row: Ints

    @staticmethod
    def of(graph: GraphLayout) -> Places:
        """Return the places of the states of all bubbles in a graph."""
        lengths = np.diff(graph.first_row)
        order = np.argsort(-lengths, kind="stable").astype(np.int64)
        ages = np.arange(int(lengths.max(initial=0)))
        active = len(lengths) - np.searchsorted(np.sort(lengths), ages, "right")
        ends = np.cumsum(active)
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        age = np.arange(graph.rows) - graph.first_row[graph.bubble_of_row]
        place = (ends - active)[age] + rank[graph.bubble_of_row]
        return Places(order, ends, active.astype(np.int64), place)

    def stretches(self) -> list[slice]:
        """Return for each age the slice of its rows."""
        return [slice(int(e - a), int(e)) for e, a in zip(self.ends, self.active)]


@dataclass(frozen=True)
class BubbleChains:
    """Hold the eliminated states of all bubbles, with D states in each row.

    Elimination gives R x_i = d - S (x_i+1, U) for the state x_i of a bubble in one frame, the next
    one x_i+1 and its mean velocity U.

    own : (rows, D, D) R^-1 R^-T.
    gain : (rows, D, D + 3) R^-1 S.
    mean : (K, 3, 3) covariances of the mean velocities of K bubbles. Rows and bubbles are in the
        order of ``places``.
    log_det : logarithm of the determinant of the square root of the information.
    """

    places: Places
    own: Array
    gain: Array
    mean: Array
    log_det: float

    def solved(self, rows: Array, means: Array) -> tuple[Array, Array]:
        """Return the solutions for right sides (rows, D, N) and (K, 3, N) of normal equations.

        The right sides are used up.
        """
        stretches, size = self.places.stretches(), self.own.shape[-1]
        turned = np.swapaxes(self.gain, -1, -2)
        for i, mine in enumerate(stretches):
            carried = turned[mine] @ rows[mine]
            if i + 1 < len(stretches):
                after = stretches[i + 1]
                rows[after] -= carried[: after.stop - after.start, :size]
            means[: len(carried)] -= carried[:, size:]
        rows, means = self.own @ rows, self.mean @ means
        rest = np.zeros((len(means), size + 3, rows.shape[-1]))
        rest[:, size:] = means
        for mine in reversed(stretches):
            count = mine.stop - mine.start
            rows[mine] -= self.gain[mine] @ rest[:count]
            rest[:count, :size] = rows[mine]
        return rows, means

    def covariances(self, place: Ints) -> Array:
        """Return the covariances (n, D, D) of the states of n rows. place : (n,) their places."""
        size = self.own.shape[-1]
        order = np.argsort(place, kind="stable")
        sought = place[order]
        out = np.empty((len(place), size, size))
        joint = np.zeros((len(self.mean), size + 3, size + 3))
        joint[:, size:, size:] = self.mean
        for mine in reversed(self.places.stretches()):
            count, gain = mine.stop - mine.start, self.gain[mine]
            cross = gain @ joint[:count]
            block = self.own[mine] + cross @ np.swapaxes(gain, -1, -2)
            joint[:count, :size, :size] = block
            joint[:count, :size, size:] = -cross[..., size:]
            joint[:count, size:, :size] = -np.swapaxes(cross[..., size:], -1, -2)
            low, high = np.searchsorted(sought, [mine.start, mine.stop])
            out[order[low:high]] = block[sought[low:high] - mine.start]
        return out


def bubble_chains(graph: GraphLayout, factors: Sequence[LinearFactors]) -> BubbleChains:
    """Return the eliminated states of the bubbles, with all other variables held fixed."""
    base, size = graph.base(), graph.bubble.size
    places = Places.of(graph)
    rank = np.empty(len(places.order), np.int64)
    rank[places.order] = np.arange(len(rank))
    seen = np.zeros((graph.rows, 2 * len(graph.problem.cameras), size))
    start = np.zeros((len(rank), size + 3, size + 3))
    step: LinearFactors | None = None
    used = np.zeros(graph.rows, np.int64)
    for linear in factors:
        key = np.asarray(linear.keys[0])
        if linear.kind == MEANS:
            start[rank[key - base.means], size:, size:] = linear.blocks[0]
        elif linear.kind == PIXELS:
            row = places.place_of_row[key - base.bubbles]
            at = used[row][:, None] + np.arange(2)
            seen[row[:, None], at] = linear.blocks[0]
            used[row] += 2
        elif linear.kind == STEPS:
            step = linear
        elif linear.kind == STARTS:
            mine = rank[graph.bubble_of_row[key - base.bubbles]]
            start[mine, :size, :size] = linear.blocks[0]
            start[mine, :size, size:] = linear.blocks[1]
    return _swept(graph, places, start, seen, step)


def _swept(
    graph: GraphLayout, places: Places, start: Array, seen: Array, step: LinearFactors | None
) -> BubbleChains:
    """start : (K, D + 3, D + 3) on (x_0, U).  seen : (rows, m, D).  step : on (x, x', U)."""
    size, images = graph.bubble.size, seen.shape[1]
    own = np.empty((graph.rows, size, size))
    gain = np.zeros((graph.rows, size, size + 3))
    mean = np.empty((len(start), 3, 3))
    number = np.full(graph.rows, -1)
    if step is not None:
        number[places.place_of_row[graph.moving_rows]] = np.arange(len(graph.moving_rows))
    stretches, log_det, carried = places.stretches(), 0.0, start
    for i, mine in enumerate(stretches):
        count = mine.stop - mine.start
        on = 0 if i + 1 == len(stretches) else stretches[i + 1].stop - stretches[i + 1].start
        if on < count:
            stack = np.zeros((count - on, size + 3 + images, size + 3))
            stack[:, : size + 3] = carried[on:count]
            stack[:, size + 3 :, :size] = seen[mine][on:]
            root, inverse = _root(stack, size + 3)
            last, state, above = slice(mine.start + on, mine.stop), inverse[:, :size, :size], size
            own[last] = _square(state)
            gain[last, :, size:] = state @ root[:, :size, above:]
            mean[on:count] = _square(inverse[:, above:, above:])
            log_det += _log_diagonal(root)
        if on:
            assert step is not None
            which = number[mine][:on]
            stack = np.zeros((on, 2 * size + 3 + images, 2 * size + 3))
            stack[:, : size + 3, :size] = carried[:on, :, :size]
            stack[:, : size + 3, 2 * size :] = carried[:on, :, size:]
            stack[:, size + 3 : size + 3 + images, :size] = seen[mine][:on]
            moves = stack[:, size + 3 + images :]
            moves[..., :size] = step.blocks[0][which]
            moves[..., size : 2 * size] = step.blocks[1][which]
            moves[..., 2 * size :] = step.blocks[2][which]
            root, inverse = _root(stack, size)
            first = slice(mine.start, mine.start + on)
            own[first] = _square(inverse)
            gain[first] = inverse @ root[:, :size, size:]
            log_det += _log_diagonal(root[:, :size, :size])
            carried = root[:, size:, size:]
    return BubbleChains(places, own, gain, mean, log_det)


def _root(stack: Array, size: int) -> tuple[Array, Array]:
    """Return R of stacks of rows, and the inverse of its first ``size`` rows and columns."""
    root: Array = np.asarray(np.linalg.qr(stack, mode="r"))
    return root, np.asarray(np.linalg.inv(root[:, :size, :size]), np.float64)


def _square(root: Array) -> Array:
    return np.asarray(root @ np.swapaxes(root, -1, -2))


def _log_diagonal(root: Array) -> float:
    return float(np.log(np.abs(np.diagonal(root, axis1=-2, axis2=-1))).sum())
