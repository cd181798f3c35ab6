"""Propose the lines of rig.toml for a sensor that it does not know yet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.io.exchange.importing.accelerometer import AXES
from telerig.io.rig_file.writer import toml_key
from telerig.rig.units import STANDARD_GRAVITY_M_S2
from telerig.statistics import robust_sd

_UP_RIG = [0, -1, 0]
_MOSTLY = 0.9
"""The share of gravity that a sensor's axis must read to be taken for the vertical one."""


def sensor_toml(name: str, table: pd.DataFrame, cameras: Sequence[str]) -> str:
    """Return a proposal for the table [accelerometers.<name>] of rig.toml.

    The sensor's axis that reads gravity is taken to point up, which is -y in the rig frame of a
    level first camera. The user has to correct the directions of the other two axes and the place
    of the sensor.

    table : readings as `read_accelerations` returns them. cameras : names of the cameras.
    """
    readings = table[AXES].to_numpy()
    rows = ", ".join(str(row) for row in _axes(readings.mean(0)))
    places = ", ".join(f'"{place}"' for place in (*cameras, "carriage"))
    return "\n".join(
        [
            f"[accelerometers.{toml_key(name)}]",
            f'mounted_on = "{cameras[0]}"  # one of {places}',
            f"axes = [{rows}]  # rows: its x, y, z in rig coordinates; check them",
            f"noise_density_ug_sqrt_hz = {_noise_density(table['t_s'].to_numpy(), readings):.3g}"
            "  # of this record; better the data sheet's",
            'clock = "unknown"  # "frames" if the recorder of the frames gave the times',
        ]
    )


def _axes(mean_m_s2: Array) -> list[list[int]]:
    """Return the sensor's axes in rig coordinates as a rotation by multiples of 90 degrees."""
    axes = np.eye(3, dtype=int)
    up = int(np.argmax(np.abs(mean_m_s2)))
    size = float(np.linalg.norm(mean_m_s2))
    if size > 0 and abs(mean_m_s2[up]) > _MOSTLY * size and up != 1:
        axes[[up, 1]] = axes[[1, up]]
    if axes[up] @ _UP_RIG * mean_m_s2[up] < 0:
        axes[up] *= -1
    if np.linalg.det(axes) < 0:
        axes[(up + 1) % 3] *= -1
    return [[int(value) for value in row] for row in axes]


def _noise_density(t_s: Array, readings_m_s2: Array) -> float:
    """Return the noisiest axis' density in micro-g per root hertz, from second differences."""
    if len(t_s) < 4:
        return 100.0
    bend = np.abs(np.diff(readings_m_s2, 2, axis=0)) / np.sqrt(6)
    sigma = float(np.max(robust_sd(bend, axis=0))) or float(np.sqrt(np.mean(bend**2)))
    half_rate_hz = 0.5 / float(np.median(np.diff(t_s)))
    return max(1.0, float(1e6 * sigma / STANDARD_GRAVITY_M_S2 / np.sqrt(half_rate_hz)))
