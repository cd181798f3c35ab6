"""Power spectral densities of the bubbles' velocities and of the shake."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError

LEAST_FRAMES = 32
_LONGEST_SEGMENT = 1024
_MOST_TRACKS = 20
_FINITE_SHARE = 0.7


@dataclass(frozen=True)
class Spectrum:
    """One-sided power densities (F, 3) per axis at (F,) Hz."""

    frequency_hz: Array
    density: Array

    @property
    def step_hz(self) -> float:
        """How finely frequencies are told apart."""
        return float(self.frequency_hz[1])


def velocity_spectrum(trajectories: pd.DataFrame, kind: str = "") -> Spectrum:
    """Return the mean density of the velocity of the longest tracks, in (mm/s)²/Hz.

    kind : "", "naive_" or "rts_". Raises InputError when no track is long enough.
    """
    names = [f"{kind}v{axis}_mm_s" for axis in "xyz"]
    tracks = sorted((mine for _, mine in trajectories.groupby("particle")), key=len, reverse=True)[
        :_MOST_TRACKS
    ]
    found: list[Array] = []
    weights, frequencies = [], np.zeros(0)
    length = segment(len(tracks[0])) if tracks else 0
    for track in tracks if length and set(names) <= set(trajectories) else []:
        values = track[names].to_numpy(float)
        if len(track) < max(length, LEAST_FRAMES):
            break
        if np.isfinite(values).all(1).mean() >= _FINITE_SHARE:
            frequency, density = welch_density(track["t_s"].to_numpy(float), values, length)
            if not found or density.shape == found[0].shape:
                frequencies = frequency
                found.append(density)
                weights.append(len(track))
    if not found:
        what = f"no track has {LEAST_FRAMES} frames with a velocity"
        raise InputError(what, where="telerig.plot.spectra", todo="give a longer run")
    return Spectrum(frequencies, np.asarray(np.average(found, axis=0, weights=weights)))


def shake_spectrum(shake: pd.DataFrame, camera: str) -> Spectrum | None:
    """Return the density of a camera's shake in shake.csv, in µm²/Hz; None for a short run."""
    if len(shake) < LEAST_FRAMES:
        return None
    values = 1e3 * shake[[f"{camera}_{axis}_mm" for axis in "xyz"]].to_numpy(float)
    return Spectrum(*welch_density(shake["t_s"].to_numpy(float), values, segment(len(values))))


def segment(frames: int) -> int:
    """Return the frames per segment of Welch's estimate: about five, half overlapping."""
    return min(frames, _LONGEST_SEGMENT, max(64, frames // 3))


def welch_density(t_s: Array, values: Array, length: int) -> tuple[Array, Array]:
    """Return frequencies (F,) and one-sided densities (F, K) of detrended columns (N, K)."""
    from scipy.signal import detrend, welch

    even, rate_hz = evenly(t_s, values)
    level = np.asarray(detrend(even, axis=0))
    frequency, density = welch(level, rate_hz, nperseg=min(length, len(even)), axis=0)
    return np.asarray(frequency), np.asarray(density)


def evenly(t_s: Array, values: Array) -> tuple[Array, float]:
    """Return columns (N, K) interpolated to even times, and the rate in Hz."""
    step = float(np.median(np.diff(t_s)))
    count = min(round((t_s[-1] - t_s[0]) / step) + 1, 4 * len(t_s))
    wanted = np.linspace(t_s[0], t_s[-1], count)
    columns = []
    for one in values.T:
        there = np.isfinite(one)
        columns.append(np.interp(wanted, t_s[there], one[there]) if there.any() else 0 * wanted)
    return np.stack(columns, 1), (count - 1) / (t_s[-1] - t_s[0])
