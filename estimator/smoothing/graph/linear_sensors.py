"""The linear factors of the stage's encoder and of the accelerometers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoothing.graph.blocks import Linear, log_det_of, repeated
from telerig.estimator.smoothing.graph.state import Frame, State
from telerig.estimator.smoothing.problem.problem import CARRIAGE, Accelerometer
from telerig.factors import measurements
from telerig.factors.measurements import whitener_of

Array = NDArray[np.float64]

_SLOPE_S = 2e-3


def encoder(frame: Frame, state: State) -> list[Linear]:
    """Readings of the stage's position: at their own times, or interpolated at the frames.

    The carriage's states are in units of the reading, so that its scale is not a factor of what
    the encoder pins: the mode of (states, scale) together would shrink the states' noise, by one
    nat in the log of the scale for every reading, where no data speak of the scale.
    """
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
    position = (state.shake[node] * rows).sum(-1) - state.encoder_delay_s(frame) * speed
    read = measurements.encoder_reading(position, speed)
    columns = np.stack([np.zeros_like(speed), read.by_delay], -1)[:, np.array(frame.encoder_flags)]
    sigma = model.encoder_sigma_mm
    by_shake = (read.by_position[:, None] * rows)[:, None] @ frame.shake_basis(node)
    columns = np.concatenate([columns, np.zeros((len(node), frame.share_size))], -1)
    blocks = (by_shake, columns[:, None])
    rhs = (reading - read.reading_mm)[:, None] / sigma
    log_det = np.full(len(rhs), -np.log(sigma))
    return [Linear((node, frame.base()[4]), tuple(b / sigma for b in blocks), rhs, log_det)]


def accelerometers(frame: Frame, state: State) -> list[Linear]:
    """Samples of all sensors, along the directions in which their mount's motion is modelled.

    What they say of the encoder's scale, by the carriage's own acceleration, is not used.
    """
    return [_accelerometer(frame, state, i) for i in range(len(frame.problem.accelerometers))]


def _accelerometer(frame: Frame, state: State, index: int) -> Linear:
    problem, layout = frame.problem, frame.shake
    sensor = problem.accelerometers[index]
    node, late = frame.nodes.of_accelerometers[index], frame.nodes.accelerometer_late_s[index]
    gain = 1 / (1 + state.encoder_scale(frame))
    jerk_rows = np.multiply.outer(gain * problem.axis, layout.jerk)
    jerk_rows += layout.offset_jerk[sensor.camera]
    rows = np.multiply.outer(gain * problem.axis, layout.acceleration)
    rows += layout.offset_acceleration[sensor.camera]
    bias = state.sensors[index, :3]
    clock = frame.clock_of[index]
    scale, delay = state.sensors[index, 3:].sum(), state.clocks[clock].sum()
    states = state.shake[node]
    acceleration = states @ rows.T + late[:, None] * (states @ jerk_rows.T)
    read = measurements.accelerometer_reading(
        acceleration, np.zeros_like(acceleration), problem.up, sensor.axes, bias, np.asarray(scale)
    )
    slope = _slope(sensor)
    project, white = felt(frame, index)
    by_shake = (project @ read.by_acceleration[0]) @ (
        (rows + late[:, None, None] * jerk_rows) @ frame.shake_basis(node)
    )
    has_scale, has_delay = frame.sensor_flags
    by_scale, by_clock = read.by_scale[..., None], -slope[..., None]
    by_sensor = np.concatenate([repeated(np.eye(3), len(node)), by_scale[..., :has_scale]], -1)
    blocks = (by_shake, project @ by_sensor, project @ by_clock[..., :has_delay])
    rhs = (sensor.reading_mm_s2 - read.reading_mm_s2 + delay * slope) @ project.T
    log_det = np.full(len(node), white)
    keys = (node, frame.base()[3] + index, frame.base()[6] + clock)
    return Linear(keys, blocks, rhs, log_det)


def _slope(sensor: Accelerometer) -> Array:
    """(N, 3) change of the readings per second over a few ms, by which a delay changes them.

    Of the readings, not of the states: the states' jerk is as rough as the model's force, readings
    moved along it would be rougher than the force allows, and the priors would hold the delay
    where it is. An odd filter of the readings themselves leaves their roughness alone.
    """
    from scipy.ndimage import gaussian_filter1d

    step = float(np.median(np.diff(sensor.t_s)))
    width = max(_SLOPE_S / step, 1.0)
    slope = gaussian_filter1d(sensor.reading_mm_s2, width, axis=0, order=1, mode="nearest")
    return np.asarray(slope / step, np.float64)


def felt(frame: Frame, index: int) -> tuple[Array, float]:
    """(k, 3) whitened rows that take a reading to the directions of modelled motion; log det."""
    sensor = frame.problem.accelerometers[index]
    directions = np.eye(3) if sensor.camera == CARRIAGE else frame.shake.seen[sensor.camera]
    rows = directions @ np.linalg.inv(sensor.axes)
    whitener = whitener_of(rows @ rows.T * sensor.sigma_mm_s2**2)
    return np.asarray(whitener @ rows), float(log_det_of(whitener))
