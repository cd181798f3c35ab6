"""Smooth a crowd: the cost grows with the number of bubbles, not with its cube.

The joint graph's separator holds the states of all bubbles in sight. But bubbles meet only in the
shake (and in a few constants). Eliminated one by one (`bubble_chains`), they leave a Schur
complement on the rig that is applied, never formed, and the estimates follow from conjugate
gradients: they are those of the joint graph.

The preconditioner is a graph like the joint one with a single bubble, the mean of those in sight:
its noise, of motion and of pixels, is smaller by the root of their number. For bubbles alike in
noise that are all seen all the time it is the Schur complement itself, since the shake cancels in
differences between bubbles. Where bubbles come and go it is close. It gives the
covariances: that of bubble k is what it would be were the rig known, plus what not knowing the rig
adds to that of the mean bubble.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.errors import CalibrationError
from telerig.estimator.smoothing.graph.bubble_chains import BubbleChains, bubble_chains
from telerig.estimator.smoothing.graph.elimination import (
    EliminatedGraph,
    eliminate,
    starts_of,
    units,
)
from telerig.estimator.smoothing.graph.layout import (
    GraphLayout,
    State,
    first_guess,
    graph_layout,
    points_in_rig,
)
from telerig.estimator.smoothing.graph.linear import (
    MEANS,
    OF_BUBBLES,
    PIXELS,
    STEPS,
    bubble_priors,
)
from telerig.estimator.smoothing.problem.problem import Bubble, Observations
from telerig.factors.linear_factors import AT_ONCE, LinearFactors, product, transposed_product
from telerig.io.machine.parallel import give_back_freed_memory
from telerig.rig.triangulation import point_shift_jacobian

_FEW, _MORE, _SHORT_S = 3, 8, 0.2
"""So many bubbles in sight are eliminated jointly, and so many if their tracks are short."""
_LEFT = 1e-4
"""Squared distance, in posterior standard deviations summed over all states, at which the
conjugate gradients end."""
_ROUNDING = 1e-16
"""The same over that of the start, below which the residual's own rounding is what is left: the
refinements start again from a residual that is worked out anew."""
_MOST_STEPS = 60
_MOST_REFINEMENTS = 8


def eliminated(
    graph: GraphLayout, factors: list[LinearFactors]
) -> EliminatedGraph | EliminatedCrowd:
    """Return the solution of all factors, by Cholesky or by QR, which is four times slower.

    The normal equations of a broad band's smooth prior lose ten digits at 500 Hz (covariances are
    good to 3e-6), and more than double precision has with steps as short as a sensor's.
    """
    only_frames = len(graph.nodes.t_s) == len(graph.problem.t_s)
    quick = only_frames and not graph.model.broad_bands
    if jointly(graph):
        return eliminate(graph, factors, cholesky=quick)
    return eliminate_crowd(graph, factors, cholesky=quick)


def jointly(graph: GraphLayout) -> bool:
    """Return whether all bubbles are eliminated in one graph, which is exact.

    With a few bubbles that costs no more. The mean bubble's covariances are not good enough for
    short tracks that nothing but images separates from the shake.
    """
    sight, problem = int(np.bincount(graph.frame_of_row).max(initial=0)), graph.problem
    if sight <= _FEW:
        return True
    lasting = [float(problem.t_s[b.last] - problem.t_s[b.first]) for b in problem.bubbles]
    short = float(np.median(lasting)) < _SHORT_S
    return sight <= _MORE and short and not problem.measures_shake


@dataclass(frozen=True)
class EliminatedCrowd:
    """Hold the solution of a graph with many bubbles, in place of an `EliminatedGraph`.

    The graph is approximated by one with a single bubble, the mean of all bubbles. It serves as the
    preconditioner of a conjugate-gradient solution of the whole graph.

    chains : the bubbles, eliminated for a fixed rig.
    mean : the graph with the mean bubble.
    mean_chains : the mean bubble, eliminated for a fixed rig.
    rig : the factors without bubbles, with the keys of ``mean``.
    images_by_rig, images_by_bubble : the derivatives of the bubbles' pixels with respect to the
        rig, with the keys of ``mean``, and to the bubbles, with rows of ``chains`` in place of
        keys.
    starts : first column of each key of ``mean``, and of each row.
    vector : (D,) the solution of all variables, in the order of their keys.
    """

    graph: GraphLayout
    chains: BubbleChains
    mean: EliminatedGraph
    mean_chains: BubbleChains
    rig: list[LinearFactors]
    images_by_rig: list[LinearFactors]
    images_by_bubble: list[LinearFactors]
    starts: tuple[Ints, Ints]
    vector: Array

    def log_det(self) -> float:
        """Return the logarithm of the determinant of the square root of the information.

        The graph with the mean bubble replaces the Schur complement.
        """
        return self.chains.log_det + self.mean.log_det() - self.mean_chains.log_det

    def columns(self, at: Ints) -> Array:
        """Return columns (D, n) of the covariance at variables of the rig; each as good as the
        variance on its diagonal, which may be far smaller than `_LEFT`."""
        return self.solved(units(at, self.graph.columns().clocks.stop), relative=True)

    def solved(self, side: Array, *, relative: bool = False) -> Array:
        """Return the solutions (D, N) of the normal equations for right sides (D, N).

        relative : whether `_LEFT` is a share of the squared length that each solution has.
        """
        rig, rows, means = self._split(side)
        bubbles = self._bubbles(rows.copy(), means.copy())
        found = self._by_gradients(rig - self._pull(bubbles[0]), relative)
        pushed = self._push(found)
        rows, means = self._bubbles(rows - pushed, means)
        return self._joined(found, rows, means)

    def _by_gradients(self, side: Array, relative: bool) -> Array:
        """Solve the Schur complement for sides (R, N), all columns together."""
        found, rest = np.zeros_like(side), side.copy()
        way = ahead = self._preconditioned(rest)
        height = (rest * ahead).sum(0)
        enough = _LEFT * height if relative else np.maximum(_LEFT, _ROUNDING * height)
        for _ in range(_MOST_STEPS):
            if (height <= enough).all():
                return found
            image = self._schur(way)
            length = height / np.where(height > 0, (way * image).sum(0), 1.0)
            found += length * way
            rest -= length * image
            ahead = self._preconditioned(rest)
            before, height = height, (rest * ahead).sum(0)
            way = ahead + height / np.where(before > 0, before, 1.0) * way
        raise CalibrationError(
            "the bubbles and the rig cannot be solved together",
            where="smooth",
            todo="smooth fewer bubbles at a time: give a table of tracks with only some of the "
            "bubbles",
        )

    def _schur(self, way: Array) -> Array:
        of_rig, of_rows = self.starts
        seen = product(self.images_by_rig, of_rig, way)
        push = transposed_product(self.images_by_bubble, of_rows, seen)
        rows, _ = self._bubbles(push.reshape(*self.chains.own.shape[:2], -1), None)
        for whole, part in zip(seen, self._seen_by_bubbles(rows)):
            whole -= part
        image = transposed_product(self.images_by_rig, of_rig, seen)
        if self.rig:
            image += transposed_product(self.rig, of_rig, product(self.rig, of_rig, way))
        return image

    def _seen_by_bubbles(self, rows: Array) -> list[Array]:
        flat = rows.reshape(-1, rows.shape[-1])
        return product(self.images_by_bubble, self.starts[1], flat)

    def _preconditioned(self, side: Array) -> Array:
        out, theirs = self.mean.solved(side), self.mean.graph.columns()
        out[theirs.bubbles.start : theirs.means.stop] = 0.0
        return out

    def _bubbles(self, rows: Array, means: Array | None) -> tuple[Array, Array]:
        if means is None:
            means = np.zeros((len(self.chains.mean), 3, rows.shape[-1]))
        return self.chains.solved(rows, means)

    def _push(self, rig: Array) -> Array:
        """Return the effect of a change of the rig (R, N) on the bubbles' rows (rows, D, N)."""
        seen = product(self.images_by_rig, self.starts[0], rig)
        push = transposed_product(self.images_by_bubble, self.starts[1], seen)
        return push.reshape(*self.chains.own.shape[:2], -1)

    def _pull(self, rows: Array) -> Array:
        return transposed_product(self.images_by_rig, self.starts[0], self._seen_by_bubbles(rows))

    def _split(self, side: Array) -> tuple[Array, Array, Array]:
        """Split a vector (D, N) of the graph into rig (R, N), rows and means of the chains."""
        ours, theirs = self.graph.columns(), self.mean.graph.columns()
        size, places = self.graph.bubble.size, self.chains.places
        rig = np.zeros((theirs.clocks.stop, side.shape[1]))
        rig[theirs.shake], rig[theirs.means.stop :] = side[ours.shake], side[ours.means.stop :]
        rows = np.empty((self.graph.rows, size, side.shape[1]))
        rows[places.place_of_row] = side[ours.bubbles].reshape(rows.shape)
        means = side[ours.means].reshape(-1, 3, side.shape[1])
        return rig, rows, means[places.order]

    def _joined(self, rig: Array, rows: Array, means: Array) -> Array:
        ours, theirs = self.graph.columns(), self.mean.graph.columns()
        places, count = self.chains.places, rig.shape[1]
        out = np.empty((ours.clocks.stop, count))
        out[ours.shake], out[ours.means.stop :] = rig[theirs.shake], rig[theirs.means.stop :]
        out[ours.bubbles] = rows[places.place_of_row].reshape(-1, count)
        back = np.empty_like(means)
        back[places.order] = means
        out[ours.means] = back.reshape(-1, count)
        return out

    def blocks(self) -> list[Array]:
        """Return the marginal covariances; what the rig adds to a bubble's is the mean bubble's.

        All is used up: what is not needed any more makes room for what is worked out.
        """
        graph, mean = self.graph, self.mean.graph
        for factors in (self.rig, self.images_by_rig, self.images_by_bubble):
            factors.clear()
        found, chain = self.mean.blocks(), self.mean_chains
        self.mean.cliques.clear()
        row = _mean_row(mean)[graph.frame_of_row]
        added = found[1] - chain.covariances(chain.places.place_of_row)
        own = self.chains.covariances(self.chains.places.place_of_row)
        for first in range(0, graph.rows, AT_ONCE):
            mine = np.arange(first, min(first + AT_ONCE, graph.rows))
            own[mine] += _turned(added[row[mine]], _turn(mean, row[mine], graph, mine))
        segment = mean.bubble_of_row[row[graph.first_row[:-1]]]
        order = self.chains.places.order
        means = np.empty_like(self.chains.mean)
        means[order] = self.chains.mean
        mean_added = found[2] - self.mean_chains.mean[np.argsort(self.mean_chains.places.order)]
        means += mean_added[segment]
        return [found[0], own, means, *found[3:]]


def add_own_calibration(
    graph: GraphLayout, state: State, bubbles: Array, calibration: Array
) -> None:
    """Add to covariances of bubbles (rows, D, D) what the mean bubble does not have of the
    calibration.

    Its errors move each point of the field differently, and the mean bubble by their mean.
    calibration : (r, r) posterior covariance of its directions.
    """
    share = graph.problem.calibration
    if share is None or not len(calibration):
        return
    places, cameras = points_in_rig(graph, state), graph.problem.cameras
    equal = np.eye(2 * len(cameras))
    moved = np.empty((graph.rows, 3, len(calibration)))
    for first in range(0, graph.rows, AT_ONCE):
        mine = slice(first, first + AT_ONCE)
        moved[mine] = point_shift_jacobian(cameras, share.free, places[mine], equal) @ share.root
    mean = np.zeros((len(graph.problem.t_s), *moved.shape[1:]))
    np.add.at(mean, graph.frame_of_row, moved)
    seen = np.bincount(graph.frame_of_row, minlength=len(mean))
    moved -= (mean / np.maximum(seen, 1)[:, None, None])[graph.frame_of_row]
    at = graph.bubble.path_position
    bubbles[:, at[:, None], at] += moved @ calibration @ np.swapaxes(moved, -1, -2)


def eliminate_crowd(
    graph: GraphLayout, factors: list[LinearFactors], *, cholesky: bool
) -> EliminatedCrowd:
    """Return the solution of all factors; arguments as for `eliminate`, of the mean's graph."""
    chains = bubble_chains(graph, factors)
    mean, its_factors = mean_graph(graph, factors, chains)
    done = eliminate(mean, its_factors, cholesky=cholesky)
    give_back_freed_memory()
    out = EliminatedCrowd(
        graph, chains, done, bubble_chains(mean, its_factors),
        *_parts(graph, mean, factors, chains),
        (starts_of(mean), graph.bubble.size * np.arange(graph.rows + 1)), np.zeros(0),
    )  # fmt: skip
    starts, rest = starts_of(graph), [f.rhs[..., None] for f in factors]
    total = np.zeros((int(starts[-1]), 1))
    for _ in range(_MOST_REFINEMENTS):
        side = transposed_product(factors, starts, rest)
        found = out.solved(side)
        total += found
        if float((side * found).sum()) < _LEFT:
            break
        fitted = product(factors, starts, total)
        rest = [linear.rhs[..., None] - one for linear, one in zip(factors, fitted)]
    return replace(out, vector=total[:, 0])


def _mean_row(mean: GraphLayout) -> Ints:
    """Return the mean bubble's row (F,) at each frame."""
    out = np.zeros(len(mean.problem.t_s), np.int64)
    out[mean.frame_of_row] = np.arange(mean.rows)
    return out


def _turn(one: GraphLayout, row: Ints, other: GraphLayout, to: Ints) -> Array | None:
    """Return (n, D, D) from a basis of rows of one graph to another's; None for equal ones."""
    kind = one.row_basis[row] * (len(other.bubble_motion.basis) + 1) + other.row_basis[to]
    kinds, first, place = np.unique(kind, return_index=True, return_inverse=True)
    turns = np.linalg.solve(other.bubble_basis(to[first]), one.bubble_basis(row[first]))
    if len(kinds) == 1 and np.allclose(turns[0], np.eye(turns.shape[-1]), atol=1e-12):
        return None
    return np.asarray(turns[place])


def _turned(block: Array, turn: Array | None) -> Array:
    return block if turn is None else turn @ block @ np.swapaxes(turn, -1, -2)


def mean_graph(
    graph: GraphLayout, factors: Sequence[LinearFactors], chains: BubbleChains
) -> tuple[GraphLayout, list[LinearFactors]]:
    """Return the graph with the mean bubble, one for every time that a bubble is in sight.

    Where bubbles come or go, their mean jumps. By how much is known from the differences of the
    bubbles, as well as a bubble's state is known at the end of its track were the rig known.
    """
    problem = graph.problem
    firsts, lasts = (np.array([getattr(b, n) for b in problem.bubbles]) for n in ("first", "last"))
    count = len(problem.t_s)
    alive = np.zeros(count + 1, np.int64)
    np.add.at(alive, firsts, 1)
    np.add.at(alive, lasts + 1, -1)
    alive = np.cumsum(alive)[:count]
    staying = np.zeros(count + 1, np.int64)
    np.add.at(staying, firsts, 1)
    np.add.at(staying, lasts, -1)
    staying = np.cumsum(staying)[:count]
    there = np.flatnonzero(alive)
    cut = np.flatnonzero((np.diff(there) > 1) | (staying[there[:-1]] == 0))
    parts = np.split(there, cut + 1)
    bubbles = tuple(
        Bubble(i, int(p[0]), int(p[-1]), np.zeros(3), np.zeros((len(p), 3)))
        for i, p in enumerate(parts)
    )
    mean = graph_layout(
        replace(problem, bubbles=bubbles, observations=Observations.none()),
        graph.model, graph.delays_s,
    )  # fmt: skip
    out = [_in_mean_graph(graph, mean, f) for f in factors if f.kind not in OF_BUBBLES]
    typical = np.sqrt(np.array([alive[b.first : b.last + 1].mean() for b in bubbles]))
    begun = np.sqrt(alive[[b.first for b in bubbles]])
    for linear in bubble_priors(mean, first_guess(mean)):
        if linear.kind == STEPS:
            root = _step_roots(graph, mean, chains, linear, alive, staying)
        else:
            each = typical if linear.kind == MEANS else begun
            root = each[:, None, None] * np.eye(linear.rhs.shape[1])
        blocks = tuple(root @ b for b in linear.blocks)
        out.append(replace(linear, blocks=blocks, rhs=np.zeros_like(linear.rhs)))
    out += [_mean_image(graph, mean, f) for f in factors if f.kind == PIXELS]
    return mean, out


def _in_mean_graph(graph: GraphLayout, mean: GraphLayout, linear: LinearFactors) -> LinearFactors:
    """Return factors with the keys that their variables have in the graph of the mean bubble."""
    first = graph.base().sensors
    more, keys = mean.base().sensors - first, map(np.asarray, linear.keys)
    return replace(linear, keys=tuple(k + more * (k >= first) for k in keys))


def _step_roots(
    graph: GraphLayout, mean: GraphLayout, chains: BubbleChains, step: LinearFactors,
    alive: Ints, staying: Ints,
) -> Array:  # fmt: skip
    """Return matrices (M, D, D) from one bubble's whitened steps to those of the mean bubble."""
    frame = mean.frame_of_row[mean.moving_rows]
    size, stay = mean.bubble.size, staying[frame]
    noise = np.eye(size) / stay[:, None, None]
    number = np.full(len(alive), -1)
    number[frame] = np.arange(len(frame))
    rows = np.arange(graph.rows)
    for block, row, off in (
        (step.blocks[0], graph.first_row[1:] - 1, 0),
        (step.blocks[1], graph.first_row[:-1], -1),
    ):
        # those that end at the step's first frame, those that begin at its second
        which = number[graph.frame_of_row[row] + off]
        row, which = row[which >= 0], which[which >= 0]
        if not len(row):
            continue
        own = chains.covariances(chains.places.place_of_row[row])
        turn = _turn(graph, rows[row], mean, mean.moving_rows[which] - off)
        at = frame[which] - off
        share = 1 / (alive[at] * stay[which])
        jump = _turned(own * share[:, None, None], turn)
        np.add.at(noise, which, _turned(jump, block[which]))
    root = np.linalg.cholesky(noise)
    return np.asarray(np.linalg.inv(root))


def _mean_image(graph: GraphLayout, mean: GraphLayout, linear: LinearFactors) -> LinearFactors:
    """One camera's pixels of all bubbles of a frame as those of their mean: the information is
    the sum."""
    row = np.asarray(linear.keys[0]) - graph.base().bubbles
    frame = graph.frame_of_row[row]
    frames, place = np.unique(frame, return_inverse=True)
    rows = _mean_row(mean)[frames]
    of_bubble = linear.blocks[0]
    turn = _turn(mean, rows[place], graph, row)
    if turn is not None:
        of_bubble = of_bubble @ turn
    total = [_summed(b, place, len(frames)) for b in (of_bubble, *linear.blocks[1:])]
    square = np.bincount(place, (of_bubble**2).sum((1, 2)), len(frames))
    length = (total[0] ** 2).sum((1, 2))
    factor = np.sqrt(square / np.where(length > 0, length, 1.0))[:, None, None]
    theirs, nothing = mean.base(), np.zeros((len(frames), 2))
    keys = (theirs.bubbles + rows, mean.nodes.of_frame[frames], theirs.constants)
    blocks = tuple(t * factor for t in total)
    return LinearFactors(keys, blocks, nothing, nothing[:, 0], nothing[:, 0] + 1, PIXELS)


def _summed(block: Array, place: Ints, count: int) -> Array:
    order = np.argsort(place, kind="stable")
    first = np.searchsorted(place[order], np.arange(count))
    if not block.shape[-1]:
        return np.zeros((count, *block.shape[1:]))
    return np.asarray(np.add.reduceat(block[order], first, axis=0))


def _parts(
    graph: GraphLayout, mean: GraphLayout, factors: Sequence[LinearFactors], chains: BubbleChains
) -> tuple[list[LinearFactors], list[LinearFactors], list[LinearFactors]]:
    """Return the rig's factors, pixels by the rig, and pixels by the bubbles; nothing is copied."""
    rig, by_rig, by_bubble = [], [], []
    for linear in factors:
        moved = _in_mean_graph(graph, mean, linear)
        if linear.kind == PIXELS:
            place = chains.places.place_of_row[np.asarray(linear.keys[0]) - graph.base().bubbles]
            by_rig.append(replace(moved, keys=moved.keys[1:], blocks=linear.blocks[1:]))
            by_bubble.append(replace(linear, keys=(place,), blocks=linear.blocks[:1]))
        elif linear.kind not in OF_BUBBLES:
            rig.append(moved)
    return rig, by_rig, by_bubble
