"""How states are laid out: which component sits where in a node's vector, and when nodes are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    BroadBand,
    RigMode,
    ShakeModel,
    SmoothingProblem,
)
from telerig.factors.bubble_motion import BubbleModel, bubble_processes
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

_SAME = 0.05
_NEAR, _NEAR_S = 0.6, 1e-3
_TERMS = 9
_READING_SIGMA_MM = 10.0
_ALIGNED = 1 - 1e-9


@dataclass(frozen=True)
class ShakeLayout:
    """The vector of carriage and camera offsets at a node.

    components : independent, one after the other.
    position, velocity, acceleration, jerk : (D,) of the carriage along the axis.
    offset, offset_velocity, offset_acceleration, offset_jerk : (C + 1, 3, D) of each camera in
        rig axes; the last is what all share, measured by a sensor on the carriage.
    seen : per camera (k, 3), the directions in which its own arm is modelled.
    unseen_variance_mm2 : (C, 3, 3) of the arm's own shake along the camera's depth.
    """

    components: tuple[Component, ...]
    labels: tuple[str, ...]
    position: Array
    velocity: Array
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
        return len(self.position)


@dataclass(frozen=True)
class BubbleLayout:
    """The vector of a bubble at a frame.

    position, velocity : (3, D) lab, rig axes.  wander : (C, 2, D) px.
    path_position, path_velocity : (3,) columns of the Ornstein-Uhlenbeck path along each axis.
    """

    components: tuple[Component, ...]
    position: Array
    velocity: Array
    wander: Array
    path_position: Ints
    path_velocity: Ints

    @property
    def size(self) -> int:
        return int(self.position.shape[1])


@dataclass(frozen=True)
class Nodes:
    """When the carriage's and the cameras' states are: frames and sensor samples together.

    t_s : (N,).  of_frame, of_encoder, of_accelerometers : node of each frame or reading, and by how
    much later than the node it is (..._late_s).
    """

    t_s: Array
    of_frame: Ints
    frame_late_s: Array
    of_encoder: Ints
    encoder_late_s: Array
    of_accelerometers: tuple[Ints, ...]
    accelerometer_late_s: tuple[Array, ...]


def seen_directions(camera: Camera) -> Array:
    """(2, 3) unit vectors across the camera's line of sight, in rig axes; those where they fit."""
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
    """All components of carriage and cameras."""
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
            else:
                offset[:, p.camera, :, columns] += block
        at += c.size
    return ShakeLayout(
        tuple(parts), tuple(p.label for p in placed),
        carriage[0], carriage[1], carriage[2], carriage[3],
        offset[0], offset[1], offset[2], offset[3],
        tuple(seen_directions(c) for c in problem.cameras), _unseen(problem.cameras, model),
    )  # fmt: skip


def _carriage(problem: SmoothingProblem, model: ShakeModel) -> list[_Placed]:
    if problem.stage is None:
        return []
    if model.carriage.kind == "force":
        part = forced_mass(
            model.carriage.acceleration_rms_mm_s2, corner_hz=model.carriage.corner_hz
        )
    else:
        part = independent(_READING_SIGMA_MM)
    placed = [_Placed(part, "carriage", problem.axis, CARRIAGE, "carriage")]
    if model.carriage.servo is not None:
        rms, frequency, damping = model.carriage.servo
        servo = driven_mode(rms, frequency, damping)
        placed.append(_Placed(servo, "servo", problem.axis, CARRIAGE, "carriage"))
    return placed


def _offsets(cameras: Sequence[Camera], model: ShakeModel) -> list[_Placed]:
    placed: list[_Placed] = []
    for mode in model.modes:
        for direction, rms in _directed(mode.rms_mm, mode.camera, cameras):
            where, label = mode.camera, f"mode {mode.frequency_hz:.4g} Hz"
            part = resonance(rms, mode.frequency_hz, mode.damping, mode.force_hz)
            placed.append(_Placed(part, label, direction, where))
    for band in model.broad_bands:
        for direction, rms in _directed(band.rms_mm, band.camera, cameras):
            part = broad_band(
                rms, low_hz=band.low_hz, high_hz=band.high_hz, floor=band.floor, tail=band.tail
            )
            placed.append(_Placed(part, "broad band", direction, band.camera))
            if band.slow_rms_mm > 0:
                slow = slow_ou(band.slow_rms_mm, band.slow_tau_s)
                placed.append(_Placed(slow, "slow", direction, band.camera))
    return placed


def _directed(
    rms_mm: Sequence[float], camera: int, cameras: Sequence[Camera]
) -> list[tuple[Array, float]]:
    """Directions that some camera sees, with the RMS along them; none where the RMS is 0."""
    directions = np.eye(3) if camera == CARRIAGE else seen_directions(cameras[camera])
    rms = np.sqrt((directions * np.asarray(rms_mm)) ** 2 @ np.ones(3))
    return [(d, float(r)) for d, r in zip(directions, rms) if r > 0]


def _unseen(cameras: Sequence[Camera], model: ShakeModel) -> Array:
    out = np.zeros((len(cameras), 3, 3))
    parts: list[RigMode | BroadBand] = [*model.modes, *model.broad_bands]
    for own in parts:
        if own.camera != CARRIAGE:
            depth = cameras[own.camera].camera_from_rig.rotation[2]
            variance = float(((depth * np.asarray(own.rms_mm)) ** 2).sum())
            out[own.camera] += variance * np.outer(depth, depth)
    return out


def bubble_layout(model: BubbleModel, cameras: int) -> BubbleLayout:
    """The same for all bubbles."""
    processes = [
        (process, axis)
        for axis, direction in enumerate(np.eye(3))
        for process in bubble_processes(model, direction)
    ]
    processes.sort(key=lambda one: one[0].stem)
    parts = [(process.component, axis) for process, axis in processes]
    motion = sum(c.size for c, _ in parts)
    extra: list[Component] = []
    if model.wander_px > 0:
        extra = [slow_ou(model.wander_px, model.wander_tau_s)] * (2 * cameras)
    size = motion + len(extra)
    position, velocity = np.zeros((3, size)), np.zeros((3, size))
    at = 0
    for part, axis in parts:
        position[axis, at : at + part.size] = part.position
        velocity[axis, at : at + part.size] = part.velocity
        at += part.size
    shifts = np.zeros((cameras, 2, size))
    for i in range(len(extra)):
        shifts[i // 2, i % 2, motion + i] = 1.0
    components = tuple(c for c, _ in parts) + tuple(extra)
    path = np.arange(3) * parts[0][0].size
    return BubbleLayout(components, position, velocity, shifts, path, path + 1)


def nodes_of(problem: SmoothingProblem, model: ShakeModel, delays_s: Sequence[float]) -> Nodes:
    """When states are: at every accelerometer sample (stamp - delay), and at frames far from one.

    Accelerations are rough and have their own nodes. Positions are smooth: a frame or an encoder
    reading within a step of a node takes its state from there, carried by the drift (`carry`).
    """
    rough = [a.t_s - d for a, d in zip(problem.accelerometers, delays_s)]
    times = np.sort(np.concatenate([*rough, np.zeros(0)]))
    step = min((float(np.median(np.diff(r))) for r in rough), default=0.0)
    if len(times):
        times = times[np.r_[True, np.diff(times) > _SAME * step]]
    reach = min(_NEAR * step, _NEAR_S)
    encoder = np.zeros(0)
    if problem.stage is not None and model.carriage.kind != "readings":
        encoder = problem.stage.t_s
    for smooth in (problem.t_s, encoder):
        _, late = _nearest(times, smooth)
        times = np.sort(np.concatenate([times, smooth[np.abs(late) > reach]]))
    placed = [_nearest(times, source) for source in (problem.t_s, encoder, *rough)]
    node, late_s = [p[0] for p in placed], [p[1] for p in placed]
    return Nodes(times, node[0], late_s[0], node[1], late_s[1], tuple(node[2:]), tuple(late_s[2:]))


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
    """(M, D, D) exp(F late), from states to those slightly later or earlier; None: all the same.

    The noise of so short a time is left out.
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
