"""A smoothed run of a simulator beside the truth. For the demo, never for estimators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from telerig.arrays import Array

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class MotionError:
    """Hold the RMS errors of positions and velocities over all axes and rows in which both are
    known.

    A constant shift of all positions is subtracted, because the images cannot determine it.

    predicted_um, predicted_mm_s : RMS of the stated standard deviations; NaN if there are none.
    """

    position_um: float
    velocity_mm_s: float
    predicted_um: float = float("nan")
    predicted_mm_s: float = float("nan")


def motion_error(trajectories: pd.DataFrame, truth: pd.DataFrame, prefix: str = "") -> MotionError:
    """Return the errors of smoothed trajectories against the truth of a simulated run.

    trajectories : table of one bubble, as in trajectories.csv.
    truth : the simulator's bubbles.csv with one bubble per frame.
    prefix : first part of the names of the columns to compare, "" for the smoothed ones.
    """
    joined = trajectories.merge(truth, on="frame", suffixes=("", "_true"))
    position = _columns(joined, prefix + "{}_mm") - _columns(joined, "{}_lab_mm")
    velocity = _columns(joined, prefix + "v{}_mm_s") - _columns(joined, "v{}_lab_mm_s")
    known = np.isfinite(position).all(1) & np.isfinite(velocity).all(1)
    position, velocity = position[known], velocity[known]
    sd = [np.nan, np.nan]
    if not prefix and "sx_mm" in joined:
        sd = [_rms(_columns(joined, name)[known]) for name in ("s{}_mm", "sv{}_mm_s")]
    return MotionError(
        1000 * _rms(position - position.mean(0)), _rms(velocity), 1000 * sd[0], sd[1]
    )


def _columns(table: pd.DataFrame, name: str) -> Array:
    return table[[name.format(x) for x in "xyz"]].to_numpy(float)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
