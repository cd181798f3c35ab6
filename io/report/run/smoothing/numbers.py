"""What the tables of a smoothed run add up to: standard deviations and spectra."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.io.report.run.smoothing.results import AXES, PLACE, SPEED, SmoothingResults
from telerig.io.report.run.tracking.numbers import median, rms

LEAST_FRAMES = 32
_LONGEST_SEGMENT = 1024
_MOST_TRACKS = 20
_FINITE_SHARE = 0.7


@dataclass(frozen=True)
class Spectrum:
    """One-sided power densities (F, 3) per axis at (F,) Hz; ``step_hz`` as far as it resolves."""

    frequency_hz: Array
    density: Array
    step_hz: float


def column(table: pd.DataFrame, name: str) -> Array:
    """The column's values, NaN where the file has none."""
    if name not in table:
        return np.full(len(table), np.nan)
    return table[name].to_numpy(float)


def known_parts(results: SmoothingResults, part: str, needed: str) -> dict[str, Mapping[str, Any]]:
    """The objects of a part of smoothing.json that hold what is needed, by name."""
    return {
        str(name): found
        for name, found in results.part(part).items()
        if isinstance(found, Mapping) and needed in found
    }


def axis_sd(results: SmoothingResults, pattern: str = PLACE) -> list[float | None]:
    """Median sd of the bubbles per axis, in mm or mm/s; None where it is not known."""
    return [median(column(results.trajectories, "s" + pattern.format(axis))) for axis in AXES]


def taken_away(
    results: SmoothingResults, kind: str = "naive_", pattern: str = PLACE
) -> list[float | None]:
    """RMS of a baseline minus smoothed per axis, in mm or mm/s."""
    table = results.trajectories
    return [
        rms(column(table, kind + pattern.format(a)) - column(table, pattern.format(a)))
        for a in AXES
    ]


def shake_rms_um(results: SmoothingResults, camera: str, axis: str) -> float | None:
    """Of the estimate about its mean; None where the camera does not see it."""
    if axis in results.unseen(camera) or not len(results.shake):
        return None
    return float(1e3 * np.std(column(results.shake, f"{camera}_{axis}_mm")))


def segment(frames: int) -> int:
    """Frames of a segment of Welch's estimate: about five of them, half overlapping."""
    return min(frames, _LONGEST_SEGMENT, max(64, frames // 3))


def velocity_spectrum(results: SmoothingResults, kind: str = "") -> Spectrum | None:
    """Mean over the longest tracks of the velocity's density, (mm/s)²/Hz.

    kind : "", "naive_" or "rts_". None where no track is long enough or the columns are empty.
    """
    tracks = [results.track(k) for k in results.bubbles[:_MOST_TRACKS]]
    if not tracks or len(tracks[0]) < LEAST_FRAMES:
        return None
    length = segment(len(tracks[0]))
    names = [kind + SPEED.format(axis) for axis in AXES]
    found, weights = [], []
    for track in tracks:
        values = np.stack([column(track, name) for name in names], 1)
        if len(track) >= length and np.isfinite(values).all(1).mean() >= _FINITE_SHARE:
            frequency, density = _welch(track["t_s"].to_numpy(float), values, length)
            found.append(density)
            weights.append(len(track))
    if not found:
        return None
    same = [d for d in found if d.shape == found[0].shape]
    mean = np.average(same, axis=0, weights=weights[: len(same)])
    return Spectrum(frequency, np.asarray(mean), float(frequency[1]))


def shake_spectrum(results: SmoothingResults, camera: str) -> Spectrum | None:
    """Density of a camera's shake per axis, µm²/Hz. None for a short run."""
    values = 1e3 * np.stack([column(results.shake, f"{camera}_{axis}_mm") for axis in AXES], 1)
    if len(values) < LEAST_FRAMES:
        return None
    time = results.shake["t_s"].to_numpy(float)
    frequency, density = _welch(time, values, segment(len(values)))
    return Spectrum(frequency, density, float(frequency[1]))


def _welch(t_s: Array, values: Array, length: int) -> tuple[Array, Array]:
    from scipy.signal import detrend, welch

    even, rate_hz = evenly(t_s, values)
    level = np.asarray(detrend(even, axis=0))
    frequency, density = welch(level, rate_hz, nperseg=min(length, len(even)), axis=0)
    return np.asarray(frequency), np.asarray(density)


def evenly(t_s: Array, values: Array) -> tuple[Array, float]:
    """Columns of (N, K) at even times, straight lines over what is missing; and the rate in Hz."""
    step = float(np.median(np.diff(t_s)))
    count = min(round((t_s[-1] - t_s[0]) / step) + 1, 4 * len(t_s))
    wanted = np.linspace(t_s[0], t_s[-1], count)
    columns = []
    for one in values.T:
        there = np.isfinite(one)
        columns.append(np.interp(wanted, t_s[there], one[there]) if there.any() else 0 * wanted)
    return np.stack(columns, 1), (count - 1) / (t_s[-1] - t_s[0])
