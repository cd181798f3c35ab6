"""The tables that stand beside a simulated run's images: encoder, accelerometers, marks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.rig_file.description import CARRIAGE
from telerig.io.simulation.run.mark_strip import strip_places
from telerig.io.simulation.run.mark_strip_config import MARKS_AT, MARKS_JITTER
from telerig.io.simulation.run.motion import accelerometer_readings
from telerig.io.simulation.run.scene import AXIS_RIG, RunScene

if TYPE_CHECKING:
    import pandas as pd
    from numpy.random import Generator

Array = NDArray[np.float64]


def stage_table(scene: RunScene, rng: Generator) -> pd.DataFrame:
    """`stage.csv`: the carriage, servo error included, with the encoder's noise."""
    import pandas as pd

    carriage, stage = scene.carriage, scene.config.stage
    step = _thinning(scene, stage.encoder_rate_hz)
    position = carriage.position_mm[::step]
    noise = stage.encoder_sigma_mm * rng.standard_normal(len(position))
    reading = (1 + stage.encoder_scale) * position + noise
    return pd.DataFrame({"t_s": carriage.t_s[::step], "position_mm": reading})


def accelerometer_table(scene: RunScene, rng: Generator) -> pd.DataFrame:
    """`accelerometer.csv`: sensors on the carriage or on camera arms, axes those of the rig."""
    import pandas as pd

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
        )
        columns: dict[str, Any] = {
            "t_s": t + stage.accelerometer_delay_s,
            "sensor": mount if mount == CARRIAGE else f"arm_{mount}",
        }
        columns |= {f"a{axis}_m_s2": reading[:, i] for i, axis in enumerate("xyz")}
        parts.append(pd.DataFrame(columns))
    return pd.concat(parts, ignore_index=True)


def references_table(scene: RunScene, rng: Generator) -> pd.DataFrame:
    """`references.csv`: marks fixed to the tank, which pass through the image as the stage moves.

    Each camera has a strip of its own, at unknown uneven heights, so many in view at a time as
    the configuration says.
    """
    import pandas as pd

    return pd.concat(
        [_camera_marks(scene, j, rng) for j in range(len(scene.cameras))], ignore_index=True
    )


def _camera_marks(scene: RunScene, index: int, rng: Generator) -> pd.DataFrame:
    import pandas as pd

    name, camera = list(scene.cameras.items())[index]
    table = scene.config.table
    lab_mm = strip_places(
        camera, scene.position_mm, table.references, rng, at=MARKS_AT, jitter=MARKS_JITTER
    )
    frames, marks, pixels = [], [], []
    size = np.array(camera.image_size_px) - 1
    half_mm = size[1] / 2 / camera["scale_px_per_mm"]
    for frame in range(scene.config.frames):
        rig = lab_mm + scene.rig_from_lab_mm(index, frame)
        near = np.flatnonzero(np.abs(rig @ AXIS_RIG) < 1.2 * half_mm)
        uv = camera.project(rig[near])
        seen = np.all((uv > 0) & (uv < size), -1)
        noise = table.reference_sigma_px * rng.standard_normal(uv[seen].shape)
        pixels.append(np.clip(uv[seen] + noise, 0, size))
        marks.append(near[seen])
        frames.append(np.full(len(near[seen]), frame))
    uv = np.concatenate(pixels)
    return pd.DataFrame(
        {
            "frame": np.concatenate(frames),
            "camera": name,
            "mark": [f"{name}{k}" for k in np.concatenate(marks)],
            "u_px": uv[:, 0],
            "v_px": uv[:, 1],
            "sigma_px": max(table.reference_sigma_px, 1e-4),
        }
    )


def _thinning(scene: RunScene, rate_hz: float) -> int:
    """Take every so many-th fine sample to have at least the rate."""
    fine = scene.carriage.stride * scene.config.frame_rate_hz
    return max(1, int(np.floor(fine / rate_hz + 1e-9)))
