"""How the variables of one smoothing problem are laid out, and their values.

Which component sits where in a node's vector, when nodes are, the keys of all variables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.problem.problem import (
    ARMS,
    CARRIAGE,
    BroadBand,
    RigMode,
    ShakeModel,
    SmoothingProblem,
)
from telerig.factors.bubble_motion import (
    BubbleModel,
    bubble_processes,
    inertial_bubble_path,
)
from telerig.factors.linear_factors import AT_ONCE
from telerig.factors.motion import Motion, motion
from telerig.factors.state_space import (
    Component,
    block_diagonal,
    broad_band,
    driven_mode,
    forced_mass,
    independent,
    resonance,
    slow_ou,
)
from telerig.rig.camera import Camera

BROAD_BAND = "broad band"
"""Label of the processes of the broad bands."""

_SAME = 0.05
_NEAR, _NEAR_S = 0.6, 1e-3
_TERMS = 9
_READING_SIGMA_MM, _UNREAD_SIGMA_MM = 10.0, 1e3
"""Of a carriage at rest in the model about its readings, and where frames are outside the encoder's
record: what it moves there is not known, and must not be taken for motion of the bubbles."""
_ALIGNED = 1 - 1e-9
_FEW_KINDS = 16


@dataclass(frozen=True)
class ShakeLayout:
    """The meaning of the D states of carriage and cameras at one time.

    components : independent processes, whose states stand one after the other.
    labels : their names.
    position, acceleration, jerk : (D,) rows that give the motion of the carriage along the travel
        axis from the states.
    offset, offset_velocity, offset_acceleration, offset_jerk : (C + 1, 3, D) rows that give the
        offset of each of the C cameras in rig axes, and its derivatives; the last one is that of
        the carriage itself, which all cameras share and a sensor on the carriage measures.
    seen : for each camera (k, 3), the directions in which the shake of its own arm is modelled.
    unseen_variance_mm2 : (C, 3, 3) prior covariance of the arm's shake along the camera's depth.
    """

    components: tuple[Component, ...]
    labels: tuple[str, ...]
    position: Array
    acceleration: Array
    jerk: Array
    offset: Array
    offset_velocity: Array
    offset_acceleration: Array
    offset_jerk: Array
    seen: tuple[Array, ...]
    unseen_variance_mm2: Array

    @property
    def size(self) -> int:
        """Return the number of states of the shake at one time."""
        return len(self.position)


@dataclass(frozen=True)
class BubbleLayout:
    """The meaning of the D states of a bubble in one frame.

    position, velocity, acceleration : (3, D) rows that give the motion in the laboratory, in rig
        axes; those of the acceleration are 0 if it is no state.
    wander : (C, 2, D) rows that give the wander of the outline's centre in each camera, in px.
    path_position, path_velocity : (3,) indices of the states of the Ornstein-Uhlenbeck path along
        each axis.
    """

    components: tuple[Component, ...]
    position: Array
    velocity: Array
    acceleration: Array
    wander: Array
    path_position: Ints
    path_velocity: Ints

    @property
    def size(self) -> int:
        """Return the number of states of a bubble at one time."""
        return int(self.position.shape[1])


@dataclass(frozen=True)
class Nodes:
    """The N times (nodes) at which carriage and cameras have states.

    t_s : (N,).
    of_frame, of_encoder, of_accelerometers : index of the node of each frame or reading.
    frame_late_s, encoder_late_s, accelerometer_late_s : how much later than its node each is.
    """

    t_s: Array
    of_frame: Ints
    frame_late_s: Array
    of_encoder: Ints
    encoder_late_s: Array
    of_accelerometers: tuple[Ints, ...]
    accelerometer_late_s: tuple[Array, ...]


def seen_directions(camera: Camera) -> Array:
    """Return two unit vectors (2, 3) across a camera's line of sight, in rig axes.

    An axis of the rig is taken if it is nearly perpendicular to the line of sight.
    """
    rotation = camera.camera_from_rig.rotation
    along = int(np.argmax(np.abs(rotation[2])))
    if abs(rotation[2, along]) > _ALIGNED:
        return np.delete(np.eye(3), along, 0)
    return np.asarray(rotation[:2])


@dataclass(frozen=True)
class _Placed:
    component: Component
    label: str
    direction: Array
    camera: int
    kind: str = "offset"


def shake_layout(problem: SmoothingProblem, model: ShakeModel) -> ShakeLayout:
    """Return the states of carriage and cameras for a model."""
    placed = _carriage(problem, model) + _offsets(problem.cameras, model)
    parts = [p.component for p in placed]
    size, cameras = sum(c.size for c in parts), len(problem.cameras)
    carriage = np.zeros((4, size))
    offset = np.zeros((4, cameras + 1, 3, size))
    at = 0
    for p in placed:
        c, columns = p.component, slice(at, at + p.component.size)
        rows = (c.position, c.velocity, c.acceleration, c.jerk)
        if p.kind == "carriage":
            carriage[:, columns] = rows
        else:
            block = np.einsum("rn,i->rin", np.array(rows), p.direction)
            if p.camera == CARRIAGE:
                offset[..., columns] += block[:, None]
            elif p.camera == ARMS:
                offset[:, :-1, :, columns] += block[:, None]
            else:
                offset[:, p.camera, :, columns] += block
        at += c.size
    return ShakeLayout(
        tuple(parts), tuple(p.label for p in placed),
        carriage[0], carriage[2], carriage[3],
        offset[0], offset[1], offset[2], offset[3],
        tuple(seen_directions(c) for c in problem.cameras), _unseen(problem.cameras, model),
    )  # fmt: skip


def _carriage(problem: SmoothingProblem, model: ShakeModel) -> list[_Placed]:
    if problem.stage is None:
        return []
    if model.carriage.kind == "force":
        part = forced_mass(model.carriage.acceleration_rms_mm_s2, force_hz=model.carriage.corner_hz)
    else:
        whole = bool(problem.in_encoder_record.all())
        part = independent(_READING_SIGMA_MM if whole else _UNREAD_SIGMA_MM)
    placed = [_Placed(part, "carriage", problem.axis, CARRIAGE, "carriage")]
    if model.carriage.servo is not None:
        rms, frequency, damping = model.carriage.servo
        servo = driven_mode(rms, frequency, damping)
        placed.append(_Placed(servo, "servo", problem.axis, CARRIAGE, "carriage"))
    return placed


def _offsets(cameras: Sequence[Camera], model: ShakeModel) -> list[_Placed]:
    placed: list[_Placed] = []
    for mode in model.modes:
        for direction, rms in directed(mode.rms_mm, mode.camera, cameras):
            where, label = mode.camera, f"mode {mode.frequency_hz:.4g} Hz"
            part = resonance(rms, mode.frequency_hz, mode.damping, mode.force_hz)
            placed.append(_Placed(part, label, direction, where))
    for band in model.broad_bands:
        for direction, rms in directed(band.rms_mm, band.camera, cameras):
            part = broad_band(
                rms, low_hz=band.low_hz, high_hz=band.high_hz, floor=band.floor, tail=band.tail
            )
            placed.append(_Placed(part, BROAD_BAND, direction, band.camera))
    return placed


def directed(
    rms_mm: Sequence[float], camera: int, cameras: Sequence[Camera]
) -> list[tuple[Array, float]]:
    """Directions that some camera sees, with the RMS along them; none where the RMS is 0."""
    directions = np.eye(3) if camera < 0 else seen_directions(cameras[camera])
    rms = np.sqrt((directions * np.asarray(rms_mm)) ** 2 @ np.ones(3))
    return [(d, float(r)) for d, r in zip(directions, rms) if r > 0]


def _unseen(cameras: Sequence[Camera], model: ShakeModel) -> Array:
    out = np.zeros((len(cameras), 3, 3))
    parts: list[RigMode | BroadBand] = [*model.modes, *model.broad_bands]
    for own in parts:
        if own.camera >= 0:
            depth = cameras[own.camera].camera_from_rig.rotation[2]
            variance = float(((depth * np.asarray(own.rms_mm)) ** 2).sum())
            out[own.camera] += variance * np.outer(depth, depth)
    return out


def bubble_layout(model: BubbleModel, cameras: int) -> BubbleLayout:
    """Return the layout, which is the same for all bubbles. Each axis begins with its path."""
    if model.inertia is None:
        processes = [
            (process, axis, number == 0)
            for axis, direction in enumerate(np.eye(3))
            for number, process in enumerate(bubble_processes(model, direction))
        ]
        processes.sort(key=lambda one: one[0].stem)
        parts = [(process.component, axis, is_path) for process, axis, is_path in processes]
    else:
        parts = [
            (inertial_bubble_path(model, direction, model.inertia), axis, True)
            for axis, direction in enumerate(np.eye(3))
        ]
    motion = sum(c.size for c, *_ in parts)
    extra: list[Component] = []
    if model.wander_px > 0:
        extra = [slow_ou(model.wander_px, model.wander_tau_s)] * (2 * cameras)
    size = motion + len(extra)
    rows = np.zeros((3, 3, size))
    at, path = 0, np.zeros(3, int)
    for part, axis, is_path in parts:
        path[axis] = at if is_path else path[axis]
        rows[:, axis, at : at + part.size] = part.position, part.velocity, part.acceleration
        at += part.size
    shifts = np.zeros((cameras, 2, size))
    for i in range(len(extra)):
        shifts[i // 2, i % 2, motion + i] = 1.0
    components = tuple(c for c, *_ in parts) + tuple(extra)
    return BubbleLayout(components, rows[0], rows[1], rows[2], shifts, path, path + 1)


def nodes_of(problem: SmoothingProblem, model: ShakeModel, delays_s: Sequence[float]) -> Nodes:
    """Return the times at which carriage and cameras have states.

    There is one at every sample of an accelerometer (its time minus the sensor's delay), and at
    every frame that is far from such a sample. A frame or an encoder reading near a node takes its
    state from there, carried to its own time by the drift (`carry`), because positions are smooth.
    So do, without accelerometers, readings at the times of frames that are stated to other digits,
    and readings that arrived together: what moves in a step between such nodes is lost in rounding.

    delays_s : delay of each accelerometer.
    """
    rough = [a.t_s - d for a, d in zip(problem.accelerometers, delays_s)]
    times = np.sort(np.concatenate([*rough, np.zeros(0)]))
    step = min((float(np.median(np.diff(r))) for r in rough), default=0.0)
    times = _apart(times, step)
    encoder = np.zeros(0)
    if problem.stage is not None and model.carriage.kind != "readings":
        encoder = problem.stage.t_s
    smooth = [
        (source, float(np.median(np.diff(source))) if len(source) > 1 else 0.0)
        for source in (problem.t_s, encoder)
    ]
    reach = min(_NEAR * step if rough else _SAME * min(pace for _, pace in smooth if pace), _NEAR_S)
    for source, pace in smooth:
        _, late = _nearest(times, source)
        times = np.sort(np.concatenate([times, _apart(source[np.abs(late) > reach], pace)]))
    placed = [_nearest(times, source) for source in (problem.t_s, encoder, *rough)]
    node, late_s = [p[0] for p in placed], [p[1] for p in placed]
    return Nodes(times, node[0], late_s[0], node[1], late_s[1], tuple(node[2:]), tuple(late_s[2:]))


def _apart(t_s: Array, pace_s: float) -> Array:
    """Return those of increasing times (n,) that do not nearly equal the one before."""
    return t_s[np.diff(t_s, prepend=-np.inf) > _SAME * pace_s]


def _nearest(nodes: Array, t_s: Array) -> tuple[Ints, Array]:
    """Nearest node of each time, and by how much later than it the time is."""
    if not len(nodes):
        return np.zeros(len(t_s), np.int64), np.full(len(t_s), np.inf)
    after = np.clip(np.searchsorted(nodes, t_s), 1, max(len(nodes) - 1, 1)).clip(max=len(nodes) - 1)
    before = np.maximum(after - 1, 0)
    node = np.where(t_s - nodes[before] <= nodes[after] - t_s, before, after)
    late = t_s - nodes[node]
    return node, np.where(np.abs(late) < 1e-12, 0.0, late)


def carry(components: Sequence[Component], late_s: Array) -> Array | None:
    """Return the matrices (M, D, D) exp(F late) from states to states slightly later or earlier.

    late_s : (M,) time differences. The noise of so short a time is left out. Returns None if all
    differences are 0.
    """
    if not np.any(late_s):
        return None
    digits, index = np.unique(np.round(late_s * 1e9), return_inverse=True)
    late = digits[:, None, None] / 1e9
    blocks = []
    for component in components:
        term = np.tile(np.eye(component.size), (len(late), 1, 1))
        total = term.copy()
        for i in range(1, _TERMS):
            term = term @ component.drift * late / i
            total += term
        blocks.append(total)
    return block_diagonal(blocks)[index.ravel()]


T = TypeVar("T")


class Family(NamedTuple):
    """Variables of one kind: their number and their dimension."""

    number: int
    size: int


class Families(NamedTuple, Generic[T]):
    """One value for each kind of variable, in the order of their keys.

    constants : that of the encoder's and the calibration's constants, which share one key, because
        a factor of GTSAM has three keys at most.
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
    """The values of all variables of a smoothing.

    shake : (N, Ds) states of carriage and cameras at N nodes; the carriage is in units of the
        encoder's reading.
    bubbles : (rows, Db) states of the bubbles, a row for each frame of a bubble, one bubble after
        the other.
    means : (K, 3) mean velocities of K bubbles.
    sensors : (A, 3 or 4) biases of A accelerometers, and their scale errors if these are estimated.
    encoder : (0 or 1,) scale error of the encoder, if it is estimated.
    calibration : (r,) error along r directions.
    marks : (Q, 3) positions of Q marks.
    clocks : (G, 0 or 1) delay of G accelerometers' clocks beyond that at which the nodes are
        placed.
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
        """Return the scale error of the encoder; 0 if it is held."""
        return float(self.encoder[0]) if graph.encoder_size else 0.0


@dataclass(frozen=True)
class GraphLayout:
    """The fixed part of one linearisation: the states' meaning, the nodes and the keys' order.

    shake, bubble : meaning of the states.
    nodes : times of the states of carriage and cameras.
    nominal_mm : (N,) prior mean of the carriage's position.
    delays_s : (A,) delays of the accelerometers at which the nodes are placed.
    clock_of : (A,) index of each accelerometer's clock; sensors with the same times share one.
    first_row : (K + 1,) first row of each bubble.
    node_of_row, bubble_of_row, frame_of_row : node, bubble and frame of each row.
    moving_rows : the rows that have a row after them.
    shake_motion, bubble_motion : the whitened steps of both kinds of states.
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
        """Return the basis (..., D, D) of the increments of the shake at nodes (...)."""
        return np.asarray(self.shake_motion.basis[self.node_basis[np.asarray(node)]])

    @cached_property
    def to_frames(self) -> Array | None:
        """The matrices (F, D, D) from the shake's state at a frame's node to that at the frame.

        None if the frames are at their nodes.
        """
        return carry(self.shake.components, self.nodes.frame_late_s)

    @cached_property
    def to_encoder(self) -> Array | None:
        """The matrices (E, D, D) from the shake's state at a node to that at each encoder reading.

        None if the readings are at their nodes.
        """
        return carry(self.shake.components, self.nodes.encoder_late_s)

    def shake_at_frames(self, shake: Array) -> Array:
        """Return the shake's states (F, D) at the frames. shake : (N, D) states at the nodes."""
        states = shake[self.nodes.of_frame]
        if self.to_frames is None:
            return np.asarray(states)
        return np.asarray((self.to_frames @ states[..., None])[..., 0])

    def offsets(self, shake: Array) -> Array:
        """Return the cameras' offsets (F, C, 3) at the frames. shake : as in `shake_at_frames`."""
        states = self.shake_at_frames(shake)
        return np.asarray(np.einsum("cid,fd->fci", self.shake.offset[:-1], states))

    def in_shake_basis(self, block: Array, node: Ints) -> Array:
        """Return derivatives (n, r, D) with respect to increments of the shake at nodes (n,).

        block : (n, r, D) derivatives with respect to the states.
        """
        return times_chosen(block, self.shake_motion.basis, self.node_basis[node])

    def in_bubble_basis(self, block: Array, row: Ints) -> Array:
        """Return derivatives (n, r, D) with respect to increments of bubbles in rows (n,).

        block : (n, r, D) derivatives with respect to the states.
        """
        return times_chosen(block, self.bubble_motion.basis, self.row_basis[row])

    def out_of_bubble_basis(self, block: Array, row: Ints) -> Array:
        """Return the covariances (n, r, D) of something with the states of bubbles in rows (n,).

        block : (n, r, D) covariances with the increments of these states.
        """
        turned = np.swapaxes(self.bubble_motion.basis, -1, -2)
        return times_chosen(block, turned, self.row_basis[row])

    def bubble_covariances(self, block: Array) -> Array:
        """Return the covariances (rows, D, D) of bubbles' states, in the place of those of their
        increments, which are used up."""
        for first in range(0, self.rows, AT_ONCE):
            mine = np.arange(first, min(first + AT_ONCE, self.rows))
            half = np.swapaxes(self.out_of_bubble_basis(block[mine], mine), -1, -2)
            block[mine] = self.out_of_bubble_basis(half, mine)
        return block

    def shake_moved(self, increments: Array) -> Array:
        """Return the changes (N, D) of the shake's states for increments (N, D) at all nodes."""
        turned = np.swapaxes(self.shake_motion.basis, -1, -2)
        return times_chosen(increments[:, None], turned, self.node_basis)[:, 0]

    def bubbles_moved(self, increments: Array) -> Array:
        """Return the changes (rows, D) of the bubbles' states for increments (rows, D)."""
        turned = np.swapaxes(self.bubble_motion.basis, -1, -2)
        return times_chosen(increments[:, None], turned, self.row_basis)[:, 0]

    @cached_property
    def node_basis(self) -> Ints:
        """(N,) which basis of the shake's motion each node has; the last that of the one before.

        So equal steps have equal factors, which are kept once.
        """
        index = self.shake_motion.index
        return np.append(index, index[-1:] if len(index) else -1).astype(np.int64)

    @cached_property
    def row_basis(self) -> Ints:
        """(rows,) which basis of the bubbles' motion each row has; the last of a bubble that of the
        one before."""
        out = np.full(self.rows, len(self.bubble_motion.basis) - 1)
        out[self.moving_rows] = self.bubble_motion.index
        last = self.first_row[1:] - 1
        last = last[np.diff(self.first_row) > 1]
        out[last] = out[last - 1]
        return out

    def bubble_basis(self, row: ArrayLike) -> Array:
        """Return the basis (..., D, D) of the increments of bubbles in rows (...)."""
        return np.asarray(self.bubble_motion.basis[self.row_basis[np.asarray(row)]])

    @property
    def rows(self) -> int:
        """Return the number of (bubble, time) pairs."""
        return int(self.first_row[-1])

    def row(self, bubble: Ints, graph: Ints) -> Ints:
        """Return the rows of bubbles (N,) at times of the graph (N,)."""
        first = np.array([b.first for b in self.problem.bubbles], np.int64)
        return np.asarray(self.first_row[bubble] + graph - first[bubble])

    @property
    def sensor_flags(self) -> tuple[bool, bool]:
        """Return whether scale and delay of the accelerometers are estimated."""
        model = self.model
        return model.accelerometer_scale_sigma > 0, model.accelerometer_delay_sigma_s > 0

    @property
    def encoder_size(self) -> int:
        """Return 1 if the encoder's scale is a variable, else 0."""
        return int(self.problem.stage is not None and self.model.encoder_scale_sigma > 0)

    @property
    def share_size(self) -> int:
        """The number of directions of the calibration's uncertainty."""
        share = self.problem.calibration
        return 0 if share is None else int(share.root.shape[1])

    def counts(self) -> Families[Family]:
        """Return number and size of the variables of each family."""
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
        """Return the first key of each family."""
        numbers = [family.number for family in self.counts()]
        return Families(0, *np.cumsum(numbers)[:-1].tolist())

    def columns(self) -> Families[slice]:
        """Return the place of each family in the vector of all variables."""
        ends = [0, *np.cumsum([n * d for n, d in self.counts()]).tolist()]
        return Families(*map(slice, ends[:-1], ends[1:]))


def graph_layout(problem: SmoothingProblem, model: ShakeModel, delays_s: Array) -> GraphLayout:
    """Return the layout of a problem's graph for given delays of the accelerometers (A,)."""
    nodes = nodes_of(problem, model, delays_s.tolist())
    stage = problem.stage
    nominal = np.zeros(len(nodes.t_s))
    if stage is not None:
        nominal = np.interp(nodes.t_s, stage.t_s, stage.position_mm)
    shake = shake_layout(problem, model)
    bubble = bubble_layout(model.bubble, len(problem.cameras))
    lengths = np.array([len(b) for b in problem.bubbles], np.int64)
    first_row = np.r_[0, np.cumsum(lengths)].astype(np.int64)
    frames = [np.arange(b.first, b.last + 1) for b in problem.bubbles]
    frame_of_row = np.concatenate([*frames, np.zeros(0, np.int64)]).astype(np.int64)
    moving = np.setdiff1d(np.arange(len(frame_of_row)), first_row[1:] - 1)
    t = problem.t_s[frame_of_row]
    return GraphLayout(
        problem, model, shake, bubble, nodes, delays_s, clocks_of(problem), nominal, first_row,
        node_of_row=nodes.of_frame[frame_of_row],
        bubble_of_row=np.repeat(np.arange(len(lengths)), lengths), frame_of_row=frame_of_row,
        shake_motion=motion(shake.components, np.diff(nodes.t_s)),
        bubble_motion=motion(bubble.components, t[moving + 1] - t[moving]), moving_rows=moving,
    )  # fmt: skip


def clocks_of(problem: SmoothingProblem) -> Ints:
    """Return the index (A,) of each accelerometer's clock.

    Sensors whose samples have the same times were sampled together and share a clock.
    """
    known: dict[Any, int] = {}
    numbers = [
        known.setdefault(
            (a.t_s.tobytes(), a.delay_s) if a.clock_number is None else a.clock_number, len(known)
        )
        for a in problem.accelerometers
    ]
    return np.array(numbers, np.int64)


def first_guess(graph: GraphLayout) -> State:
    """Return a first guess of all variables: bubbles at their triangulated positions, the carriage
    at the encoder's readings, no shake."""
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
    """Return the values of all variables after an increment (D,), in the order of their keys."""
    shake, bubbles, means, sensors, constants, marks, clocks = (
        step[mine].reshape(family) for mine, family in zip(graph.columns(), graph.counts())
    )
    encoder, calibration = np.split(constants[0], [graph.encoder_size])
    return State(
        state.shake + graph.shake_moved(shake),
        state.bubbles + graph.bubbles_moved(bubbles),
        state.means + means,
        state.sensors + sensors,
        state.encoder + encoder,
        state.calibration + calibration,
        state.marks + marks,
        state.clocks + clocks,
    )


def points_in_rig(graph: GraphLayout, state: State) -> Array:
    """Return the positions (rows, 3) of the bubbles in mm in the rig frame.

    The rig frame is taken to be displaced by the mean of the cameras' offsets.
    """
    shake = graph.shake_at_frames(state.shake)
    moved = shake @ graph.shake.offset[:-1].mean(0).T
    travel = shake @ graph.shake.position / (1 + state.encoder_scale(graph))
    moved += travel[:, None] * graph.problem.axis
    return np.asarray(state.bubbles @ graph.bubble.position.T - moved[graph.frame_of_row])


def variances(rows: Array, covariance: Array) -> Array:
    """Return the variances (n, k) of k linear combinations of n states.

    rows : (k, D) or (n, k, D) coefficients.  covariance : (n, D, D) of the states.
    """
    return np.asarray(((rows @ covariance) * rows).sum(-1))


def times_chosen(blocks: Array, matrices: Array, which: Ints) -> Array:
    """Return the products (n, r, E) of n blocks with a matrix each.

    blocks : (n, r, D), or (1, r, D) for equal blocks.
    matrices : (U, D, E).
    which : (n,) index of each block's matrix. The matrices are not copied for each block.
    """
    out = np.empty((len(which), blocks.shape[-2], matrices.shape[-1]))
    blocks = np.broadcast_to(blocks, (len(which), *blocks.shape[-2:]))
    values = np.unique(which)
    if len(values) == 1:
        np.matmul(blocks, matrices[values[0]], out=out)
    elif len(values) <= _FEW_KINDS:
        for value in values:
            mine = which == value
            out[mine] = blocks[mine] @ matrices[value]
    else:
        for first in range(0, len(which), AT_ONCE):
            mine = slice(first, first + AT_ONCE)
            np.matmul(blocks[mine], matrices[which[mine]], out=out[mine])
    return out
