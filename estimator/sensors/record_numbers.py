"""Numbers of a record of samples: its rate, gaps, step and noise."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Bools
from telerig.rig.units import MICRO_G_M_S2

_SEGMENT = 256
_BAND = (0.125, 0.45)
_LEAST_UG_SQRT_HZ = 1.0


def sampling_rate(t_s: ArrayLike) -> float:
    """Return the sampling rate in Hz of times (N,), without their gaps."""
    steps = np.diff(np.asarray(t_s, float))
    return float(1 / steps[steps < 3 * np.median(steps)].mean())


def noise_density(t_s: ArrayLike, reading_m_s2: ArrayLike) -> float:
    """Return the noise density in micro-g per root hertz that a record (N, k) of k axes shows.

    It is the level of the spectrum between 1/8 and 0.45 of the sampling rate: the median over
    frequencies, and the lower quartile over parts of the record. An axis that never changes shows
    none.
    """
    from scipy.signal import spectrogram

    reading = np.asarray(reading_m_s2, float)
    reading = reading[:, np.ptp(reading, axis=0) > 0]
    if not reading.shape[1]:
        return _LEAST_UG_SQRT_HZ
    rate = sampling_rate(t_s)
    frequency, _, power = spectrogram(
        reading, rate, nperseg=min(_SEGMENT, len(reading)), axis=0, detrend="linear"
    )
    band = (frequency >= _BAND[0] * rate) & (frequency <= _BAND[1] * rate)
    if not band.any():
        return _LEAST_UG_SQRT_HZ
    level = np.quantile(np.median(power[band], axis=0) / np.log(2), 0.25, axis=-1)
    quantum = min(quantisation(axis) for axis in reading.T) ** 2 / 6 / rate
    density = float(np.sqrt(np.mean(np.maximum(level, quantum)))) / MICRO_G_M_S2
    return max(density, _LEAST_UG_SQRT_HZ)


def quantisation(values: ArrayLike) -> float:
    """Return the smallest step between different values (N,); 0 if there is only one value."""
    steps = np.diff(np.unique(np.asarray(values, float)))
    size = np.abs(values).max(initial=0.0) if len(steps) else 0.0
    steps = steps[steps > 1e-9 * size]
    return float(steps.min()) if len(steps) else 0.0


def runs(which: Bools) -> Iterator[tuple[int, int]]:
    """Return (first, last + 1) of each run of true values (N,)."""
    edges = np.diff(np.r_[0, which.astype(np.int8), 0])
    for first, last in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)):
        yield int(first), int(last)
