"""Power spectral densities of series in time, by Welch's method."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array

LEAST_FRAMES = 32
LEAST_HZ = 3.0
_LONGEST_SEGMENT = 1024


@dataclass(frozen=True)
class Spectrum:
    """One-sided power densities (F, 3) per axis at (F,) Hz."""

    frequency_hz: Array
    density: Array

    @property
    def step_hz(self) -> float:
        """How finely frequencies are told apart."""
        return float(self.frequency_hz[1] - self.frequency_hz[0])


def motion_spectrum(t_s: Array, readings_m_s2: Array) -> Spectrum | None:
    """Return the density of an accelerometer's motion in µm²/Hz; None of too few readings.

    It is that of the readings (N, 3) divided by (2 pi f)^4, from `LEAST_HZ` on: below it the noise
    of the sensor is larger than most motion.
    """
    if len(t_s) < LEAST_FRAMES:
        return None
    length = max(LEAST_FRAMES, round(1 / float(np.median(np.diff(t_s)))))
    frequency, density = welch_density(t_s, 1e6 * readings_m_s2, length)
    seen = frequency >= LEAST_HZ
    frequency = frequency[seen]
    return Spectrum(frequency, density[seen] / (2 * np.pi * frequency[:, None]) ** 4)


def segment(frames: int) -> int:
    """Return the frames per segment of Welch's estimate, for about five half overlapping ones."""
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
