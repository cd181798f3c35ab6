"""The linear factors of one Gauss-Newton pass, as arrays: motion, images, sensors, priors.

Every factor is whitened and stated for increments: |sum_k A_k d_k - b|^2, where the increments of
shake and bubble states are in their whitening basis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.layout import GraphLayout, State
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    Accelerometer,
    Observations,
    SmoothingProblem,
)
from telerig.factors import measurements
from telerig.factors.linear_factors import AT_ONCE, LinearFactors, prior_factors
from telerig.factors.motion import start_factors
from telerig.factors.state_space import log_det_of, whitener_of
from telerig.rig.triangulation import rig_jacobian, stacked_jacobian

STARTS, STEPS, MEANS, PIXELS = OF_BUBBLES = ("starts", "steps", "means", "pixels")
"""Kinds of the factors of the bubbles' states: priors of the first ones, motion, priors of the mean
velocities, images. `MARKS` and `ENCODER` are those of the rig that are found by their kind, too."""
MARKS, ENCODER = "marks", "encoder"

SampleWeights = tuple[Array | None, ...]
"""Weights (N,) of the samples of each accelerometer; None where all are 1."""

_LEAST_RISE = 1e-6

_UNUSED = 1e8
"""Variance of an axis that is not used, in units of the others'."""

_SLOPE_S = 2e-3
"""Width of the filter that takes the readings' rate of change for the delay."""


def priors_and_motion(graph: GraphLayout, state: State) -> list[LinearFactors]:
    """Return the factors of all priors and of the motion, without the measurements."""
    out = _shake_motion(graph, state) + bubble_priors(graph, state)
    return out + constant_priors(graph, state) + _known(graph, state)


def _shake_motion(graph: GraphLayout, state: State) -> list[LinearFactors]:
    layout = graph.shake
    if not layout.size:
        return []
    keys = np.arange(len(graph.nodes.t_s))
    steps = graph.shake_motion
    deviation = state.shake.copy()
    at = 0
    for i, component in enumerate(layout.components):
        if component.memoryless:
            deviation[:, at] -= graph.nominal_mm
        elif i == 0 and graph.problem.stage is not None:
            deviation[:, at] -= graph.nominal_mm[0]
        at += component.size
    still = np.zeros((len(keys), 0))
    return [
        start_factors(
            layout.components, (keys[:1],), deviation[:1], graph.shake_basis(keys[:1]), still[:1]
        ),
        steps.factors(
            (keys[:-1], keys[1:]), (deviation[:-1], deviation[1:]), still[1:], graph.node_basis[1:]
        ),
    ]


def bubble_priors(graph: GraphLayout, state: State) -> list[LinearFactors]:
    """Return the factors of the bubbles' motion and of the priors of their mean velocities."""
    problem, layout = graph.problem, graph.bubble
    if not problem.bubbles:
        return []
    base = graph.base()
    firsts, rows = graph.first_row[:-1], graph.moving_rows
    places = np.array([b.start_mm for b in problem.bubbles])
    deviation = state.bubbles[firsts]
    deviation[:, layout.path_position] -= places
    begin = start_factors(
        layout.components,
        (base.bubbles + firsts, base.means + np.arange(len(firsts))),
        deviation,
        graph.bubble_basis(firsts),
        state.means,
    )
    begin = replace(begin, kind=STARTS)
    means = _priors(base.means, state.means, graph.model.bubble.mean_sigma_mm_s)
    means = replace(means, kind=MEANS)
    if not len(rows):
        return [begin, means]
    owner = graph.bubble_of_row[rows]
    between = graph.bubble_motion.factors(
        (base.bubbles + rows, base.bubbles + rows + 1, base.means + owner),
        (state.bubbles[rows], state.bubbles[rows + 1]),
        state.means[owner],
        graph.row_basis[rows + 1],
    )
    return [begin, replace(between, kind=STEPS), means]


def constant_values(graph: GraphLayout, state: State) -> dict[str, Array]:
    """Return the estimates of all variables that are constant in time, by their kind.

    Each value is an array (N, n) of N variables with n components. Those of clocks are delays in s,
    to be added to the stated ones.
    """
    clocks = state.clocks
    if graph.sensor_flags[1] and len(clocks):
        given = np.array([a.delay_s for a in graph.problem.accelerometers])
        _, first = np.unique(graph.clock_of, return_index=True)
        clocks = clocks + (graph.delays_s - given)[first, None]
    constants = np.concatenate([state.encoder, state.calibration])[None]
    return {
        "sensors": state.sensors, "constants": constants, "marks": state.marks, "clocks": clocks
    }  # fmt: skip


def constant_priors(graph: GraphLayout, state: State) -> list[LinearFactors]:
    """Return the factors of the constants' priors: sensors, encoder, calibration, marks, clocks."""
    model, problem, base = graph.model, graph.problem, graph.base()
    scale, delay = graph.sensor_flags
    values, out = constant_values(graph, state), list[LinearFactors]()
    if problem.accelerometers:
        extra = [model.accelerometer_scale_sigma] * scale
        sigma = np.array([[a.bias_sigma_mm_s2] * 3 + extra for a in problem.accelerometers])
        out.append(_priors(base.sensors, state.sensors, sigma))
        if delay:
            out.append(_priors(base.clocks, values["clocks"], model.accelerometer_delay_sigma_s))
    sigmas = np.r_[[model.encoder_scale_sigma] * graph.encoder_size, np.ones(graph.share_size)]
    out.append(_priors(base.constants, values["constants"], sigmas))
    if problem.marks:
        guess = np.array([m.guess_mm for m in problem.marks])
        sigma = np.array([[m.sigma_mm] for m in problem.marks])
        out.append(_priors(base.marks, state.marks - guess, sigma))
    return [p for p in out if p.rhs.size]


def _known(graph: GraphLayout, state: State) -> list[LinearFactors]:
    """Yield the information of other pieces of the run about the constants."""
    values, base, out = constant_values(graph, state), graph.base(), list[LinearFactors]()
    for known in graph.problem.known:
        keys = tuple(np.array([getattr(base, family) + i]) for family, i in known.keys)
        now = sum(b @ values[f][i] for b, (f, i) in zip(known.blocks, known.keys))
        blocks = tuple(block[None] for block in known.blocks)
        out.append(LinearFactors(keys, blocks, (known.side - now)[None], np.zeros(1)))
    return out


def _priors(base: int, deviation: Array, sigma: ArrayLike) -> LinearFactors:
    return prior_factors(base + np.arange(len(deviation)), deviation, sigma)


@dataclass(frozen=True)
class Seen:
    """The factors of M pixels, and their whitened residuals (M, 2).

    linear : empty if only the residuals were asked for.
    """

    linear: list[LinearFactors]
    residual: Array


def white_noise(graph: GraphLayout, most: float = np.inf) -> Array:
    """Return for each camera (C, 2, 2) the factor from the stated noise of a bubble's pixels to
    the part of it that is white; what changes slowly is left out.

    most : limit of the factors along the rise and across it.
    """
    cameras, inertia = graph.problem.cameras, graph.model.bubble.inertia
    along, across = np.minimum((1.0, 1.0) if inertia is None else inertia.noise, most).tolist()
    out = np.tile(across * np.eye(2), (len(cameras), 1, 1))
    for factor, camera in zip(out, cameras, strict=True):
        rise = stacked_jacobian((camera,), np.zeros((1, 3)))[1][0] @ graph.problem.up
        length = np.linalg.norm(rise)
        if length > _LEAST_RISE:
            factor += (along - across) * np.outer(rise, rise) / length**2
    return out


def pixel_whiteners(
    graph: GraphLayout, covariance_px2: Array, noise: Array, *, marks: bool
) -> Array:
    """Return the matrices (n, 2, 2) that whiten pixels with stated covariances (n, 2, 2).

    noise : (n or none, 2, 2) factor from the stated noise to that which is white. What is whitened
    times this factor is in units of the stated noise, however a camera is turned.
    marks : whether they are those of marks.
    """
    inflation = graph.model.mark_inflation if marks else graph.model.pixel_inflation
    return whitener_of(covariance_px2) @ np.linalg.inv(noise) / inflation


def images(graph: GraphLayout, state: State, weight: Array | None) -> Seen:
    """Return the factors of the bubbles' M pixels.

    weight : (M,) weights of a robust fit; None for the residuals alone.
    """
    problem, layout, white = graph.problem, graph.bubble, white_noise(graph)
    obs = problem.observations
    rows = graph.row(obs.item, obs.frame)

    def states(mine: Ints) -> _Moving:
        row = rows[mine]
        each = state.bubbles[row]
        shift = np.zeros((len(mine), 2))
        by_state = graph.in_bubble_basis(layout.position[None], row)
        by_shift = np.zeros((1, 2, layout.size))
        if np.any(layout.wander):
            wander = layout.wander[obs.camera[mine]]
            shift = np.einsum("mid,md->mi", wander, each)
            by_shift = graph.in_bubble_basis(wander, row)
        noise = white[obs.camera[mine]]
        return _Moving(each @ layout.position.T, by_state, shift, by_shift, noise)

    return _seen(graph, state, obs, weight, (PIXELS, graph.base().bubbles + rows), states)


def references(graph: GraphLayout, state: State, weight: Array | None) -> Seen:
    """Return the factors of the R pixels of marks that are fixed to the tank.

    weight : (R,) weights of a robust fit; None for the residuals alone.
    """
    obs = graph.problem.references

    def states(mine: Ints) -> _Moving:
        by_state = np.broadcast_to(np.eye(3), (len(mine), 3, 3))
        shift = np.zeros((len(mine), 2))
        return _Moving(state.marks[obs.item[mine]], by_state, shift, np.zeros((1, 2, 3)), np.eye(2))

    return _seen(graph, state, obs, weight, (MARKS, graph.base().marks + obs.item), states)


class _Moving(NamedTuple):
    """What is seen: points (n, 3) in the lab, and by how much images are shifted (n, 2) px.

    by_state (n, 3, d), by_shift (n or 1, 2, d) : their derivatives by a state.
    noise : (n or none, 2, 2) white noise over the stated one.
    """

    point_mm: Array
    by_state: Array
    shift_px: Array
    by_shift: Array
    noise: Array


def _seen(
    graph: GraphLayout, state: State, obs: Observations, weight: Array | None,
    items: tuple[str, Ints], states: Callable[[Ints], _Moving],
) -> Seen:  # fmt: skip
    """``states`` returns what is seen in some of the observations.

    items : kind of the factors, and keys (M,) of the states of what is seen.

    The cameras' pixels are worked out some thousand at a time, since what is worked out on the way
    takes several times the memory of the factors.
    """
    problem, base, (kind, keys) = graph.problem, graph.base(), items
    out, residual = [], np.zeros((len(obs), 2))
    at_frames = graph.shake_at_frames(state.shake)
    for c in range(len(problem.cameras)):
        mine = np.flatnonzero(obs.camera == c)
        if not len(mine):
            continue
        blocks: list[Array] = []
        rhs, log_det = np.empty((len(mine), 2)), np.empty(len(mine))
        for first in range(0, len(mine), AT_ONCE):
            part = slice(first, first + AT_ONCE)
            which = mine[part]
            moving = states(which)
            w = pixel_whiteners(graph, obs.covariance_px2[which], moving.noise, marks=kind == MARKS)
            found = _one_camera(graph, state, obs, c, which, at_frames, moving, w)
            residual[which] = -found.rhs
            if weight is None:
                continue
            root = np.sqrt(weight[which])
            blocks = blocks or [np.empty((len(mine), *b.shape[1:])) for b in found.blocks]
            for whole, block in zip(blocks, found.blocks):
                whole[part] = block * root[:, None, None]
            rhs[part], log_det[part] = found.rhs * root[:, None], found.log_det
        if weight is None:
            continue
        node = graph.nodes.of_frame[obs.frame[mine]]
        every = (keys[mine], node, base.constants)
        out.append(LinearFactors(every, tuple(blocks), rhs, log_det, weight[mine], kind))
    return Seen(out, residual)


def _one_camera(
    graph: GraphLayout, state: State, obs: Observations, camera: int, mine: Ints,
    at_frames: Array, moving: _Moving, w: Array,
) -> LinearFactors:  # fmt: skip
    """Return factors of some pixels of one camera.

    at_frames : (F, D) states of the shake. w : (n, 2, 2) what whitens the pixels.
    """
    problem, layout, frame = graph.problem, graph.shake, obs.frame[mine]
    shake = at_frames[frame]
    gain = 1 / (1 + state.encoder_scale(graph))
    position = gain * (shake @ layout.position)
    seen = measurements.image_of_point(
        problem.cameras[camera], moving.point_mm, position, problem.axis,
        shake @ layout.offset[camera].T,
    )  # fmt: skip
    by_shake = seen.by_offset @ layout.offset[camera]
    by_shake += seen.by_position[..., None] * (gain * layout.position)
    if graph.to_frames is not None:
        by_shake = by_shake @ graph.to_frames[frame]
    off = seen.uv_px + moving.shift_px - obs.uv_px[mine]
    by_rig = np.zeros((len(mine), 2, 0))
    if problem.calibration is not None and len(state.calibration):
        by_rig = _by_calibration(graph, camera, moving.point_mm, position, shake)
        off += by_rig @ state.calibration
    by_encoder = (seen.by_position * (-gain * position)[:, None])[..., None]
    node = graph.nodes.of_frame[frame]
    blocks = (
        w @ (seen.by_point @ moving.by_state + moving.by_shift),
        graph.in_shake_basis(w @ by_shake, node),
        w @ np.concatenate([by_encoder[..., : graph.encoder_size], by_rig], -1),
    )
    log_det = np.linalg.slogdet(w)[1]
    return LinearFactors((), blocks, -np.einsum("mij,mj->mi", w, off), log_det)


def _by_calibration(
    graph: GraphLayout, camera: int, points: Array, position: Array, shake: Array
) -> Array:
    """Return the derivative (M, 2, r) of pixels by the calibration's unit directions."""
    problem, share = graph.problem, graph.problem.calibration
    assert share is not None
    rig = points - position[:, None] * problem.axis - shake @ graph.shake.offset[camera].T
    rows = rig_jacobian(problem.cameras, share.free, rig)[..., 2 * camera : 2 * camera + 2, :]
    return np.asarray(rows @ share.root)


def encoder(graph: GraphLayout, state: State) -> list[LinearFactors]:
    """Return the factors of the encoder's readings, at their own times or interpolated at frames.

    The carriage's states are in units of the reading, so that its scale is not a factor of what
    the encoder determines: the joint mode of (states, scale) would shrink the states' noise, by one
    unit of log-likelihood per reading and unit of log scale, where no data inform on the scale.
    """
    problem, model, layout = graph.problem, graph.model, graph.shake
    stage, nodes = problem.stage, graph.nodes
    if stage is None:
        return []
    if model.carriage.kind != "readings":
        node, reading = nodes.of_encoder, stage.position_mm
        rows = np.tile(layout.position, (len(node), 1))
        if graph.to_encoder is not None:
            rows = np.einsum("i,mij->mj", layout.position, graph.to_encoder)
    else:
        inside = problem.in_encoder_record
        if not inside.any():
            return []
        node = nodes.of_frame[inside]
        reading = graph.nominal_mm[node]
        rows = np.tile(layout.position, (len(node), 1))
    position = (state.shake[node] * rows).sum(-1)
    nothing = np.zeros((len(node), 1, graph.encoder_size + graph.share_size))
    by_shake = rows[:, None] @ graph.shake_basis(node)
    sigma = model.encoder_sigma_mm
    blocks = (by_shake / sigma, nothing)
    log_det = np.full(len(node), -np.log(sigma))
    keys, rhs = (node, graph.base().constants), (reading - position)[:, None] / sigma
    return [LinearFactors(keys, blocks, rhs, log_det, kind=ENCODER)]


def accelerometers(
    graph: GraphLayout, state: State, weights: SampleWeights | None = None
) -> list[LinearFactors]:
    """Return the factors of all accelerometers' samples.

    Only the directions in which the motion of a sensor's mount is modelled are used. The samples'
    information on the encoder's scale, through the carriage's acceleration, is not used.

    weights : of each sensor's samples; None for those of the record.
    """
    given = weights or sample_weights(graph.problem)
    return [_accelerometer(graph, state, i, weight) for i, weight in enumerate(given)]


def sample_weights(problem: SmoothingProblem) -> SampleWeights:
    """Return for each sensor the weights (N,) of its samples: 1, or 0 if a sample is not used."""
    return tuple(None if a.kept is None else a.kept.astype(float) for a in problem.accelerometers)


def sample_residuals(graph: GraphLayout, state: State) -> tuple[Array, ...]:
    """Return for each sensor the whitened residuals (N, k) of its N samples along k directions."""
    out = []
    for index, sensor in enumerate(graph.problem.accelerometers):
        read = _predicted_reading(graph, state, index).reading_mm_s2
        delay = state.clocks[graph.clock_of[index]].sum()
        project, _ = sensed_directions(graph, index)
        late = delay * _slope(sensor) if delay else 0.0
        out.append((read - sensor.reading_mm_s2 - late) @ project.T)
    return tuple(out)


def _acceleration_rows(graph: GraphLayout, state: State, index: int) -> tuple[Array, Array]:
    """Return rows (3, D) that give the mount's acceleration and jerk from a node's state."""
    layout, sensor = graph.shake, graph.problem.accelerometers[index]
    along = graph.problem.axis / (1 + state.encoder_scale(graph))
    rows = np.multiply.outer(along, layout.acceleration)
    rows += layout.offset_acceleration[sensor.camera]
    jerk_rows = np.multiply.outer(along, layout.jerk) + layout.offset_jerk[sensor.camera]
    return rows, jerk_rows


def _predicted_reading(
    graph: GraphLayout, state: State, index: int
) -> measurements.AccelerometerPrediction:
    problem, sensor = graph.problem, graph.problem.accelerometers[index]
    node, late = graph.nodes.of_accelerometers[index], graph.nodes.accelerometer_late_s[index]
    rows, jerk_rows = _acceleration_rows(graph, state, index)
    states = state.shake[node]
    acceleration = states @ rows.T + late[:, None] * (states @ jerk_rows.T)
    return measurements.accelerometer_reading(
        acceleration, problem.gravity_mm_s2, sensor.axes, state.sensors[index, :3],
        state.sensors[index, 3:].sum(),
    )  # fmt: skip


def _accelerometer(
    graph: GraphLayout, state: State, index: int, weight: Array | None
) -> LinearFactors:
    sensor = graph.problem.accelerometers[index]
    node, late = graph.nodes.of_accelerometers[index], graph.nodes.accelerometer_late_s[index]
    rows, jerk_rows = _acceleration_rows(graph, state, index)
    clock = graph.clock_of[index]
    delay = state.clocks[clock].sum()
    read = _predicted_reading(graph, state, index)
    slope = _slope(sensor)
    project, white = sensed_directions(graph, index)
    by_shake = (project @ read.by_acceleration[0]) @ (
        (rows + late[:, None, None] * jerk_rows) @ graph.shake_basis(node)
    )
    has_scale, has_delay = graph.sensor_flags
    by_scale, by_clock = read.by_scale[..., None], -slope[..., None]
    by_sensor = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(node), 3, 3)), by_scale[..., :has_scale]], -1
    )
    blocks = (by_shake, project @ by_sensor, project @ by_clock[..., :has_delay])
    rhs = (sensor.reading_mm_s2 - read.reading_mm_s2 + delay * slope) @ project.T
    log_det = np.full(len(node), white)
    keys = (node, graph.base().sensors + index, graph.base().clocks + clock)
    if weight is not None:
        root = np.sqrt(weight)
        by_shake, by_sensor, by_clock = (block * root[:, None, None] for block in blocks)
        blocks = (by_shake, by_sensor, by_clock)
        rhs = rhs * root[:, None]
    return LinearFactors(keys, blocks, rhs, log_det, weight)


def _slope(sensor: Accelerometer) -> Array:
    """Return the change (N, 3) of the readings per second, for their delay.

    Of the readings, not of the states: the states' jerk is as rough as the model's force, readings
    moved along it would be rougher than the force allows, and the priors would hold the delay
    where it is. An odd filter of the readings themselves leaves their roughness alone.
    """
    from scipy.ndimage import gaussian_filter1d

    step = float(np.median(np.diff(sensor.t_s)))
    width = max(_SLOPE_S / step, 1.0)
    reading, at = sensor.reading_mm_s2, np.arange(len(sensor.t_s))
    steps = np.rint(np.diff(sensor.t_s) / step).astype(np.int64)
    if np.any(steps > 1):
        at = np.r_[0, np.cumsum(np.maximum(steps, 1))]
        every = np.arange(at[-1] + 1)
        reading = np.stack([np.interp(every, at, column) for column in reading.T], -1)
    slope = gaussian_filter1d(reading, width, axis=0, order=1, mode="nearest")[at]
    return np.asarray(slope / step, np.float64)


def sensed_directions(graph: GraphLayout, index: int) -> tuple[Array, float]:
    """Return the matrix (k, 3) from a reading of a sensor to its whitened components along the k
    directions of modelled motion, and the logarithm of its determinant.

    index : of the sensor.
    """
    sensor = graph.problem.accelerometers[index]
    directions = np.eye(3) if sensor.camera == CARRIAGE else graph.shake.seen[sensor.camera]
    rows = directions @ np.linalg.inv(sensor.axes)
    variance = np.ones(3)
    variance[list(sensor.unused_axes)] = _UNUSED
    whitener = whitener_of((rows * variance) @ rows.T * sensor.sigma_mm_s2**2)
    return np.asarray(whitener @ rows), float(log_det_of(whitener))


def all_factors(
    graph: GraphLayout,
    state: State,
    weights: tuple[Array, Array],
    samples: SampleWeights | None = None,
) -> list[LinearFactors]:
    """Return all factors of the graph.

    weights : (M,) and (R,) of the bubbles' and of the marks' pixels. samples : weights of each
    sensor's samples; None for those of the record.
    """
    out = priors_and_motion(graph, state)
    out += images(graph, state, weights[0]).linear + references(graph, state, weights[1]).linear
    return out + encoder(graph, state) + accelerometers(graph, state, samples)


def pixel_residuals(graph: GraphLayout, state: State) -> tuple[Array, Array]:
    """Return the whitened residuals of the bubbles' pixels (M, 2) and of the marks' (R, 2)."""
    return images(graph, state, None).residual, references(graph, state, None).residual
