"""Values of all variables of the graph, and their keys."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.layout import (
    BubbleLayout,
    Nodes,
    ShakeLayout,
    bubble_layout,
    carry,
    nodes_of,
    shake_layout,
)
from telerig.estimator.smoothing.problem.problem import ShakeModel, SmoothingProblem
from telerig.factors.motion import Motion, motion

T = TypeVar("T")


class Family(NamedTuple):
    """Variables of one kind: their number and their dimension."""

    number: int
    size: int


class Families(NamedTuple, Generic[T]):
    """Something of each family of variables, in the order of their keys.

    constants : one key for encoder and calibration, since a factor takes three keys at most.
    """

    shake: T
    bubbles: T
    means: T
    sensors: T
    constants: T
    marks: T
    clocks: T


@dataclass(frozen=True)
class State:
    """shake : (N, Ds), the carriage in units of the encoder's reading.

    bubbles : (sum of lengths, Db), one bubble after the other.
    means : (K, 3) velocities over the run.  sensors : (A, 3 or 4) bias, scale.
    encoder : (0..2,) scale, delay.  calibration : (r,).  marks : (Q, 3).  clocks : (G, 0 or 1)
    delay of the accelerometers' clocks beyond that at which the nodes are placed.
    """

    shake: Array
    bubbles: Array
    means: Array
    sensors: Array
    encoder: Array
    calibration: Array
    marks: Array
    clocks: Array

    def encoder_scale(self, graph: GraphLayout) -> float:
        """0 where it is held."""
        return float(self.encoder[0]) if graph.encoder_flags[0] else 0.0

    def encoder_delay_s(self, graph: GraphLayout) -> float:
        """0 where it is held."""
        return float(self.encoder[-1]) if graph.encoder_flags[1] else 0.0


@dataclass(frozen=True)
class GraphLayout:
    """The fixed part of one linearisation: layouts, nodes and the keys' order.

    nominal_mm : (N,) the carriage's prior mean.  delays_s : (A,) at which the nodes are placed.
    clock_of : (A,) sensors with the same stamps share a clock.
    first_row : (K + 1,) where each bubble's rows begin.  sizes : dimension of each family of keys.
    """

    problem: SmoothingProblem
    model: ShakeModel
    shake: ShakeLayout
    bubble: BubbleLayout
    nodes: Nodes
    delays_s: Array
    clock_of: Ints
    nominal_mm: Array
    first_row: Ints
    node_of_row: Ints
    bubble_of_row: Ints
    frame_of_row: Ints
    shake_motion: Motion
    bubble_motion: Motion
    moving_rows: Ints

    def shake_basis(self, node: ArrayLike) -> Array:
        """(..., D, D) basis of the increments at nodes (...)."""
        return np.asarray(self.shake_motion.basis[_basis_index(self.shake_motion.index, node)])

    @cached_property
    def to_frames(self) -> Array | None:
        """(F, D, D) from the shake's state at its node to that at the frame; None: the same."""
        return carry(self.shake.components, self.nodes.frame_late_s)

    @cached_property
    def to_encoder(self) -> Array | None:
        """(E, D, D) from the shake's state at its node to that at each reading."""
        return carry(self.shake.components, self.nodes.encoder_late_s)

    def shake_at_frames(self, shake: Array) -> Array:
        """(F, D) states at the frames from those at the nodes (N, D)."""
        states = shake[self.nodes.of_frame]
        if self.to_frames is None:
            return np.asarray(states)
        return np.asarray((self.to_frames @ states[..., None])[..., 0])

    @cached_property
    def row_basis(self) -> Ints:
        """(rows,) which basis of the bubbles' motion each row has."""
        out = np.full(self.rows, len(self.bubble_motion.basis) - 1)
        out[self.moving_rows] = self.bubble_motion.index
        return out

    def bubble_basis(self, row: ArrayLike) -> Array:
        """(..., D, D) basis of the increments of bubble rows (...)."""
        return np.asarray(self.bubble_motion.basis[self.row_basis[np.asarray(row)]])

    @property
    def rows(self) -> int:
        return int(self.first_row[-1])

    def row(self, bubble: Ints, graph: Ints) -> Ints:
        first = np.array([b.first for b in self.problem.bubbles], np.int64)
        return np.asarray(self.first_row[bubble] + graph - first[bubble])

    @property
    def sensor_flags(self) -> tuple[bool, bool]:
        model = self.model
        return model.accelerometer_scale_sigma > 0, model.accelerometer_delay_sigma_s > 0

    @property
    def encoder_flags(self) -> tuple[bool, bool]:
        """Whether the encoder's scale and its delay are variables."""
        read = self.problem.stage is not None
        model = self.model
        return read and model.encoder_scale_sigma > 0, read and model.encoder_delay_sigma_s > 0

    def by_encoder(self, by_scale: Array, by_delay: Array) -> Array:
        """(..., n, 0 to 2) derivatives by those of the encoder's constants that are variables."""
        return np.asarray(np.stack([by_scale, by_delay], -1)[..., np.array(self.encoder_flags)])

    @property
    def encoder_size(self) -> int:
        return sum(self.encoder_flags)

    @property
    def share_size(self) -> int:
        """Directions of the calibration's uncertainty."""
        share = self.problem.calibration
        return 0 if share is None else int(share.root.shape[1])

    def counts(self) -> Families[Family]:
        problem = self.problem
        return Families(
            Family(len(self.nodes.t_s), self.shake.size),
            Family(self.rows, self.bubble.size),
            Family(len(problem.bubbles), 3),
            Family(len(problem.accelerometers), 3 + self.sensor_flags[0]),
            Family(1, self.encoder_size + self.share_size),
            Family(len(problem.marks), 3),
            Family(int(self.clock_of.max(initial=-1)) + 1, int(self.sensor_flags[1])),
        )

    def base(self) -> Families[int]:
        """The first key of each family."""
        numbers = [family.number for family in self.counts()]
        return Families(0, *np.cumsum(numbers)[:-1].tolist())


def graph_layout(problem: SmoothingProblem, model: ShakeModel, delays_s: Array) -> GraphLayout:
    """Lay everything out for given delays of the accelerometers."""
    nodes = nodes_of(problem, model, delays_s.tolist())
    stage = problem.stage
    nominal = np.zeros(len(nodes.t_s))
    if stage is not None:
        nominal = np.interp(nodes.t_s, stage.t_s, stage.position_mm)
    lengths = np.array([len(b) for b in problem.bubbles], np.int64)
    first_row = np.r_[0, np.cumsum(lengths)].astype(np.int64)
    frames = [np.arange(b.first, b.last + 1) for b in problem.bubbles]
    frame_of_row = np.concatenate([*frames, np.zeros(0, np.int64)]).astype(np.int64)
    shake = shake_layout(problem, model)
    bubble = bubble_layout(model.bubble, len(problem.cameras))
    moving = np.setdiff1d(np.arange(len(frame_of_row)), first_row[1:] - 1)
    t = problem.t_s[frame_of_row]
    return GraphLayout(
        problem, model, shake, bubble, nodes, delays_s, clocks_of(problem), nominal, first_row,
        nodes.of_frame[frame_of_row],
        np.repeat(np.arange(len(lengths)), lengths),
        frame_of_row,
        motion(shake.components, np.diff(nodes.t_s)),
        motion(bubble.components, t[moving + 1] - t[moving]),
        moving,
    )  # fmt: skip


def clocks_of(problem: SmoothingProblem) -> Ints:
    """(A,) number of each sensor's clock: those with the same stamps were sampled together."""
    known: dict[tuple[bytes, float], int] = {}
    numbers = [
        known.setdefault((a.t_s.tobytes(), a.delay_s), len(known)) for a in problem.accelerometers
    ]
    return np.array(numbers, np.int64)


def _basis_index(index: Ints, node: ArrayLike) -> Ints:
    return np.asarray(np.append(index, -1)[np.asarray(node)])


def first_guess(graph: GraphLayout) -> State:
    """Bubbles where the cameras first saw them, the carriage where the encoder was, no shake."""
    problem = graph.problem
    shake, bubbles, means, sensors, constants, marks, clocks = (
        np.zeros(family) for family in graph.counts()
    )
    if problem.stage is not None:
        _guess_carriage(graph, shake)
    for k, bubble in enumerate(problem.bubbles):
        rows = slice(graph.first_row[k], graph.first_row[k + 1])
        t = problem.t_s[bubble.first : bubble.last + 1]
        slope = np.zeros(3)
        if len(bubble) > 1:
            slope = np.polyfit(t - t.mean(), bubble.guess_mm, 1)[0]
        bubbles[rows, graph.bubble.path_position] = bubble.guess_mm
        bubbles[rows, graph.bubble.path_velocity] = slope
        means[k] = slope
    if len(problem.marks):
        marks[:] = [m.guess_mm for m in problem.marks]
    encoder, calibration = np.split(constants[0], [graph.encoder_size])
    return State(shake, bubbles, means, sensors, encoder, calibration, marks, clocks)


def _guess_carriage(graph: GraphLayout, shake: Array) -> None:
    t, s = graph.nodes.t_s, graph.nominal_mm
    shake[:, 0] = s
    if not graph.shake.components[0].memoryless:
        shake[:, 1] = np.gradient(s, t)


def moved(graph: GraphLayout, state: State, step: Array) -> State:
    """The state after an increment, keys in their order."""
    families = graph.counts()
    parts = np.split(step, np.cumsum([n * d for n, d in families])[:-1])
    shake, bubbles, means, sensors, constants, marks, clocks = (
        p.reshape(family) for p, family in zip(parts, families)
    )
    encoder, calibration = np.split(constants[0], [graph.encoder_size])
    return State(
        state.shake + times(graph.shake_basis(np.arange(len(shake))), shake),
        state.bubbles + times(graph.bubble_basis(np.arange(len(bubbles))), bubbles),
        state.means + means,
        state.sensors + sensors,
        state.encoder + encoder,
        state.calibration + calibration,
        state.marks + marks,
        state.clocks + clocks,
    )


def times(matrices: Array, vectors: Array) -> Array:
    return np.asarray((matrices @ vectors[..., None])[..., 0])
