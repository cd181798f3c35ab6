"""The linear factors of the stage's encoder and of the accelerometers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoother.blocks import Linear, log_det_of, repeated
from telerig.estimator.smoother.model import CARRIAGE
from telerig.estimator.smoother.state import Frame, State
from telerig.factors import measurements
from telerig.factors.measurements import whitener_of

Array = NDArray[np.float64]


def encoder(frame: Frame, state: State) -> list[Linear]:
    """Readings of the stage's position: at their own times, or interpolated at the frames."""
    problem, model, layout = frame.problem, frame.model, frame.shake
    stage, nodes = problem.stage, frame.nodes
    if stage is None:
        return []
    if model.carriage.kind != "readings":
        node, reading = nodes.of_encoder, stage.position_mm
        rows, rates = (np.tile(r, (len(node), 1)) for r in (layout.position, layout.velocity))
        if frame.to_encoder is not None:
            rows = np.einsum("i,mij->mj", layout.position, frame.to_encoder)
            rates = np.einsum("i,mij->mj", layout.velocity, frame.to_encoder)
        speed = (state.shake[node] * rates).sum(-1)
    else:
        t = problem.t_s
        inside = (t >= stage.t_s[0] - 1e-9) & (t <= stage.t_s[-1] + 1e-9)
        node = nodes.of_frame[inside]
        reading = frame.nominal_mm[node]
        rows = np.tile(layout.position, (len(node), 1))
        speed = np.gradient(frame.nominal_mm, nodes.t_s)[node]
    scale, delay = _encoder_constants(frame, state)
    position = (state.shake[node] * rows).sum(-1) - delay * speed
    read = measurements.encoder_reading(position, speed, scale)
    columns = np.stack([read.by_scale, read.by_delay], -1)[:, np.array(frame.encoder_flags)]
    sigma = model.encoder_sigma_mm
    by_shake = (read.by_position[:, None] * rows)[:, None] @ frame.shake_basis(node)
    blocks = (by_shake, columns[:, None])
    rhs = (reading - read.reading_mm)[:, None] / sigma
    log_det = np.full(len(rhs), -np.log(sigma))
    return [Linear((node, frame.base()[4]), tuple(b / sigma for b in blocks), rhs, log_det)]


def _encoder_constants(frame: Frame, state: State) -> tuple[float, float]:
    values = iter(state.encoder.tolist())
    scale, delay = (next(values) if flag else 0.0 for flag in frame.encoder_flags)
    return scale, delay


def accelerometers(frame: Frame, state: State) -> list[Linear]:
    """Samples of all sensors, along the directions in which their mount's motion is modelled."""
    return [_accelerometer(frame, state, i) for i in range(len(frame.problem.accelerometers))]


def _accelerometer(frame: Frame, state: State, index: int) -> Linear:
    problem, layout = frame.problem, frame.shake
    sensor = problem.accelerometers[index]
    node, late = frame.nodes.of_accelerometers[index], frame.nodes.accelerometer_late_s[index]
    jerk_rows = np.multiply.outer(problem.axis, layout.jerk) + layout.offset_jerk[sensor.camera]
    rows = (
        np.multiply.outer(problem.axis, layout.acceleration)
        + layout.offset_acceleration[sensor.camera]
    )
    bias = state.sensors[index, :3]
    clock = frame.clock_of[index]
    scale, delay = state.sensors[index, 3:].sum(), state.clocks[clock].sum()
    states = state.shake[node]
    after = late - delay
    acceleration = states @ rows.T + after[:, None] * (states @ jerk_rows.T)
    read = measurements.accelerometer_reading(
        acceleration, states @ jerk_rows.T, problem.up, sensor.axes, bias, np.asarray(scale)
    )
    project, white = _felt(frame, index)
    by_shake = (project @ read.by_acceleration[0]) @ (
        (rows + after[:, None, None] * jerk_rows) @ frame.shake_basis(node)
    )
    has_scale, has_delay = frame.sensor_flags
    by_scale, by_clock = read.by_scale[..., None], read.by_delay[..., None]
    by_sensor = np.concatenate([repeated(np.eye(3), len(node)), by_scale[..., :has_scale]], -1)
    blocks = (by_shake, project @ by_sensor, project @ by_clock[..., :has_delay])
    rhs = (sensor.reading_mm_s2 - read.reading_mm_s2) @ project.T
    log_det = np.full(len(node), white)
    keys = (node, frame.base()[3] + index, frame.base()[7] + clock)
    return Linear(keys, blocks, rhs, log_det)


def _felt(frame: Frame, index: int) -> tuple[Array, float]:
    """(k, 3) whitened rows that take a reading to the directions of modelled motion; log det."""
    sensor = frame.problem.accelerometers[index]
    directions = np.eye(3) if sensor.camera == CARRIAGE else frame.shake.seen[sensor.camera]
    rows = directions @ np.linalg.inv(sensor.axes)
    whitener = whitener_of(rows @ rows.T * sensor.sigma_mm_s2**2)
    return np.asarray(whitener @ rows), float(log_det_of(whitener))
