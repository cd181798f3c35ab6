"""The records of encoder and accelerometers as a smoothing problem has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.estimator.sensors.checks import Encoder
from telerig.estimator.sensors.given import CARRIAGE as ON_CARRIAGE
from telerig.estimator.sensors.given import Sensor
from telerig.estimator.sensors.record_numbers import sampling_rate
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    DELAY_SIGMA_S,
    Accelerometer,
    Stage,
)
from telerig.rig.camera import Camera
from telerig.rig.units import MICRO_G_M_S2

MARGIN_S = 0.25
"""So much of a record before and after the frames is used."""


def stage_of(encoder: Encoder | None, t_s: Array, described: Any = None) -> Stage | None:
    """Return the encoder's readings near the frames; None without an encoder.

    t_s : (F,) times of the frames.
    described : what rig.toml states of the stage; None for nothing.
    """
    if encoder is None:
        return None
    stated = getattr(described, "delay_sigma_s", None)
    sigma = DELAY_SIGMA_S if stated is None else float(stated)
    return stage_near(Stage(encoder.t_s, encoder.position_mm, sigma), t_s)


def stage_near(stage: Stage, t_s: Array) -> Stage:
    """Return the readings near frames at t_s (F,), and one more on each side: the frames of a slow
    encoder lie between two readings."""
    low = int(np.searchsorted(stage.t_s, t_s[0] - MARGIN_S)) - 1
    high = int(np.searchsorted(stage.t_s, t_s[-1] + MARGIN_S)) + 1
    near = slice(max(low, 0), high)
    return replace(stage, t_s=stage.t_s[near], position_mm=stage.position_mm[near])


def accelerometers_of(
    sensors: Sequence[Sensor], cameras: Sequence[Camera]
) -> tuple[Accelerometer, ...]:
    """Return the accelerometers with their complete records, converted to mm/s^2."""
    names = [c.name for c in cameras]
    out = []
    for sensor in sensors:
        assert sensor.noise_density_ug_sqrt_hz is not None, "screening estimates it"
        rate = sampling_rate(sensor.t_s)
        sigma = sensor.noise_density_ug_sqrt_hz * 1e3 * MICRO_G_M_S2 * np.sqrt(rate / 2)
        camera = CARRIAGE if sensor.mounted_on == ON_CARRIAGE else names.index(sensor.mounted_on)
        out.append(
            Accelerometer(
                sensor.name, camera, sensor.t_s, 1000 * sensor.reading_m_s2, sensor.axes,
                float(sigma), 1000 * sensor.bias_sigma_m_s2, clock=sensor.clock,
                kept=None if sensor.kept.all() else sensor.kept, unused_axes=sensor.unused_axes,
            )
        )  # fmt: skip
    return tuple(out)


def near_frames(sensor: Accelerometer, t_s: Array, margin_s: float = MARGIN_S) -> Accelerometer:
    """Return the sensor with the samples from before the first frame to after the last one.

    t_s : (F,) times of the frames.
    margin_s : how long before and after. If there is no such sample, the result has none.
    """
    t = sensor.t_s - sensor.delay_s
    return sensor.of((t >= t_s[0] - margin_s) & (t <= t_s[-1] + margin_s))


def thinned(sensors: tuple[Accelerometer, ...], step_s: float) -> tuple[Accelerometer, ...]:
    """Return the sensors with samples averaged in blocks of at most ``step_s``, none across gaps.

    The average over a block of length T reduces a motion of angular frequency w by (w T)^2 / 24,
    for example by 0.6 % at 60 Hz and 1 ms.
    """
    return tuple(_thinned(sensor, step_s) for sensor in sensors)


def _thinned(sensor: Accelerometer, step_s: float) -> Accelerometer:
    """Return the sensor with block averages; blocks with an unused sample are left out."""
    block = int(step_s / np.median(np.diff(sensor.t_s)) + 1e-6)
    count = len(sensor.t_s) // block if block > 1 else 0
    if count < 2:
        return sensor
    used = count * block
    t = sensor.t_s[:used].reshape(count, block)
    whole = np.ptp(t, axis=1) < 1.5 * step_s
    if sensor.kept is not None:
        whole &= sensor.kept[:used].reshape(count, block).all(1)
    if whole.sum() < 2:
        return sensor
    reading = sensor.reading_mm_s2[:used].reshape(count, block, 3)
    return replace(
        sensor,
        t_s=t.mean(1)[whole],
        reading_mm_s2=reading.mean(1)[whole],
        sigma_mm_s2=sensor.sigma_mm_s2 / float(np.sqrt(block)),
        kept=None,
    )
