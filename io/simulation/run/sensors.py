"""The tables of a simulated run's sensors: encoder and accelerometers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.random import Generator

from telerig.io.rig_file.description import CARRIAGE
from telerig.io.simulation.run.motion import accelerometer_readings
from telerig.io.simulation.run.scene import AXIS_RIG, RunScene


def stage_table(scene: RunScene, rng: Generator) -> pd.DataFrame:
    """Return the content of `stage.csv`: position of the carriage with the encoder's errors.

    The carriage's servo error is part of the true position.
    """
    carriage, stage = scene.carriage, scene.config.stage
    step = _thinning(scene, stage.encoder_rate_hz)
    position = carriage.position_mm[::step]
    noise = stage.encoder_sigma_mm * rng.standard_normal(len(position))
    reading = (1 + stage.encoder_scale) * position + noise
    return pd.DataFrame({"t_s": carriage.t_s[::step], "position_mm": reading})


def accelerometer_table(scene: RunScene, rng: Generator) -> pd.DataFrame:
    """Return the content of `accelerometer.csv`: readings along the rig's axes.

    The sensors are on the carriage or on the cameras' arms.
    """
    carriage, stage = scene.carriage, scene.config.stage
    step = _thinning(scene, stage.accelerometer_rate_hz)
    t = carriage.t_s[::step]
    names = list(scene.cameras)
    parts: list[pd.DataFrame] = []
    for mount in stage.accelerometers:
        acceleration = carriage.acceleration_mm_s2[:, None] * AXIS_RIG
        if mount != CARRIAGE:
            acceleration = acceleration + carriage.shake.acceleration_mm_s2[names.index(mount)]
        reading = accelerometer_readings(
            acceleration[::step],
            AXIS_RIG,
            np.eye(3),
            rng,
            rate_hz=1 / (t[1] - t[0]) if len(t) > 1 else stage.accelerometer_rate_hz,
            density_ug_sqrt_hz=stage.accelerometer_density_ug,
            bias_m_s2=stage.accelerometer_bias_m_s2 * rng.standard_normal(3),
            gravity_m_s2=stage.gravity_m_s2,
        )
        columns: dict[str, Any] = {
            "t_s": t + stage.accelerometer_delay_s,
            "sensor": mount if mount == CARRIAGE else f"arm_{mount}",
        }
        columns |= {f"a{axis}_m_s2": reading[:, i] for i, axis in enumerate("xyz")}
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def _thinning(scene: RunScene, rate_hz: float) -> int:
    """Take every so many-th fine sample to have at least the rate."""
    fine = scene.carriage.stride * scene.config.frame_rate_hz
    return max(1, int(np.floor(fine / rate_hz + 1e-9)))
