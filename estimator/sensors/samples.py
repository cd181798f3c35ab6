"""Finds the samples of an accelerometer that cannot be right: spikes, clipped and frozen ones.

`screened` masks them one by one; what it misses gets less weight in the smoothing graph.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.findings import Finding
from telerig.estimator.sensors.given import Sensor
from telerig.rig.units import MICRO_G_M_S2
from telerig.statistics import robust_sd

_NEIGHBOURS = 4
_LEAST_TO_LEARN, _MOST_TO_LEARN = 60, 8192
_BLOCK = 1 << 16

_SPIKE_SIGMAS = 20.0
LONGEST_SPIKE = 3
_ALONE, _QUIET = 12, 0.1
"""A spike stands alone: it exceeds the range of the 12 samples on each side, of which none is
predicted badly. An impact rings."""

_SHIFT_SIGMAS, _LONGEST_SHIFT = 12.0, 256
_SHIFT_TAPS = 5
_SHIFT_BACK, _SHIFT_QUIET = 0.15, 0.35
"""A shift ends with the opposite of the jump with which it begins, up to this share of it, and no
other jump nearby is larger than this share."""

_LOCAL = 64
_ROUNDS = 20

_CLIPPED_LEAST = 5
_CLIPPED_EXCESS = 3
_AT_LIMIT = 1e-3
_MOST_CLIPPED = 0.1

_LEAST_FROZEN = 4
_CHANCE = 1e-6
_WINDOWS = (16, 64)

_GAP_STEPS = 5.0
_MOST_MASKED = 0.5
_SEGMENT = 256
_BAND = (0.125, 0.45)
_LEAST_UG_SQRT_HZ = 1.0


@dataclass(frozen=True)
class Clipping:
    """One axis of a sensor that is clipped.

    axis : its index.
    value : limit in m/s^2 at which it is clipped.
    samples : (N,) which of the N samples are clipped.
    """

    axis: int
    value: float
    samples: Bools


def screened(sensor: Sensor) -> tuple[Sensor, list[Finding]]:
    """Return the sensor without samples that cannot be right, and warnings that count them.

    These samples are masked (``kept``), and their readings are interpolated, because filters need
    a complete record. An axis that is often clipped or never changes is not used. If the noise
    density is not stated, it is estimated.
    """
    t, reading, where = sensor.t_s, sensor.reading_m_s2, sensor.where
    findings: list[Finding] = []

    def warn(words: str, masked: Bools) -> None:
        first = float(t[np.argmax(masked)])
        findings.append(Finding(f"{words}, the first at {first:.6g} s", where))

    unused = set(np.flatnonzero(np.ptp(reading, axis=0) == 0).tolist())
    for axis in sorted(unused):
        words = f"a{'xyz'[axis]} never changes: the sensor is stuck, or not connected"
        findings.append(Finding(f"{words}, and the axis is not used", where))
    clipped = np.zeros(len(t), bool)
    for found in clippings(reading, sensor.range_m_s2):
        count, name = np.count_nonzero(found.samples), f"a{'xyz'[found.axis]}"
        often = count > _MOST_CLIPPED * len(t)
        words = f"{count} of {len(t)} samples of {name} are clipped at {found.value:.4g} m/s^2: "
        words += "the sensor's range is too small"
        if often:
            unused.add(found.axis)
        else:
            clipped |= found.samples
        warn(f"{words}, and {f'{name} is' if often else 'they are'} not used", found.samples)
    density = sensor.noise_density_ug_sqrt_hz
    if density is None:
        density = noise_density(t, reading)
        words = f"no noise density is given; {density:.3g} ug/sqrt(Hz) are estimated"
        todo = "give noise_density_ug_sqrt_hz from the data sheet"
        findings.append(Finding(words, where, todo, is_fault=False))
    sigma = density * MICRO_G_M_S2 * np.sqrt(sampling_rate(t) / 2)
    frozen = frozen_samples(reading, sigma) & ~clipped
    if frozen.any():
        words = f"{np.count_nonzero(frozen)} of {len(t)} samples repeat the one before: the sensor "
        warn(f"{words}had stopped, and they are not used", frozen)
    axes = [a for i, a in enumerate(reading.T) if i not in unused]
    spikes = np.any([np.zeros(len(t), bool), *map(spike_samples, axes)], axis=0)
    spikes &= ~clipped & ~frozen
    if spikes.any():
        warn(f"{np.count_nonzero(spikes)} of {len(t)} samples are spikes and are not used", spikes)
    shifted = shifted_samples(np.delete(reading, list(unused), axis=1)) & ~clipped & ~frozen
    if shifted.any():
        words = (
            f"{np.count_nonzero(shifted)} of {len(t)} samples are offset from the samples before "
        )
        warn(f"{words}and after them (a loose cable?): they are not used", shifted)
    findings += _gaps(t, where)
    kept = ~(clipped | frozen | spikes | shifted)
    filled = reading
    if not kept.all() and kept.any():
        filled = np.stack([np.interp(t, t[kept], a[kept]) for a in reading.T], -1)
    return replace(
        sensor, reading_m_s2=filled, kept=kept, noise_density_ug_sqrt_hz=density,
        unused_axes=tuple(sorted(unused)),
    ), findings  # fmt: skip


def mostly_masked(sensor: Sensor) -> Finding | None:
    """Return a warning if so much of the record is not used that the sensor has to be left out."""
    share = 1 - float(sensor.kept.mean())
    if share <= _MOST_MASKED and len(sensor.unused_axes) < 3:
        return None
    what = "none of its axes" if len(sensor.unused_axes) == 3 else f"{100 * share:.0f} % of its"
    words = f"{what} can be used" if "axes" in what else f"{what} samples cannot be used"
    todo = "record again with a wider range, or repair the sensor"
    return Finding(f"{words}, so the sensor is left out", sensor.where, todo)


def sampling_rate(t_s: ArrayLike) -> float:
    """Return the sampling rate in Hz of times (N,), without their gaps."""
    steps = np.diff(np.asarray(t_s, float))
    return float(1 / steps[steps < 3 * np.median(steps)].mean())


def noise_density(t_s: ArrayLike, reading_m_s2: ArrayLike) -> float:
    """Return the noise density in micro-g per root hertz that a record (N, 3) shows.

    It is the level of the spectrum between 1/8 and 0.45 of the sampling rate: the median over
    frequencies, and the lower quartile over parts of the record.
    """
    from scipy.signal import spectrogram

    reading = np.asarray(reading_m_s2, float)
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


def clippings(reading: ArrayLike, range_m_s2: float | None = None) -> list[Clipping]:
    """Return the limits at which samples (N, 3) are clipped.

    Without a range, an extreme value counts as a limit if it occurs at least 5 times, and at least
    3 times as often as the next value.
    """
    out = []
    for axis, a in enumerate(np.asarray(reading, float).T):
        beyond: Bools = np.zeros(len(a), bool)
        for limit in [] if range_m_s2 is None else [-range_m_s2, range_m_s2]:
            mine = a / limit >= 1 - _AT_LIMIT
            beyond |= mine
            out.append(Clipping(axis, limit, mine))
        values, counts = np.unique(a[~beyond], return_counts=True)
        for end, next_one in ((0, 1), (-1, -2)) if len(values) >= 3 else ():
            if counts[end] >= max(_CLIPPED_LEAST, _CLIPPED_EXCESS * int(counts[next_one])):
                out.append(Clipping(axis, float(values[end]), a == values[end]))
    return [found for found in out if found.samples.any()]


def frozen_samples(reading: ArrayLike, sigma: float) -> Bools:
    """Return which samples (N, 3) repeat the one before because the sensor had stopped.

    A run of identical samples counts if it is too long for coarse steps: by the noise, sigma, and
    the step, by repetitions elsewhere, or by the samples around the run, because a sensor that
    comes to rest does so gradually.
    """
    samples = np.asarray(reading, float)
    same = np.all(np.diff(samples, axis=0) == 0, axis=1)
    frozen = np.zeros(len(samples), bool)
    if not same.any():
        return frozen
    steps = np.array([quantisation(axis) for axis in samples.T])
    at_rest = float(np.prod(np.minimum(1.0, steps[steps > 0] / (2 * np.sqrt(np.pi) * sigma))))
    total, count = np.count_nonzero(same), len(same)
    needed = np.log(_CHANCE / count)
    for first, last in _runs(same):
        length = last - first
        if length < _LEAST_FROZEN:
            continue
        elsewhere = (total - length + 1) / (count - length + 2)
        chances = [max(at_rest, elsewhere)]
        if first > 0 and last < count:
            chances.append(max(_repeated(same, first, last)))
        if length * np.log(min(*chances, 1.0)) < needed:
            frozen[first + 1 : last + 1] = True
    return frozen


def _runs(which: Bools) -> Iterator[tuple[int, int]]:
    """Return (first, last + 1) of each run of true values (N,)."""
    edges = np.diff(np.r_[0, which.astype(np.int8), 0])
    for first, last in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)):
        yield int(first), int(last)


def _repeated(same: Bools, first: int, last: int) -> Iterator[float]:
    """Return the probability of a repetition in windows just before and just after a run."""
    for window in _WINDOWS:
        for part in (same[max(first - window, 0) : first], same[last : last + window]):
            yield (np.count_nonzero(part) + 1) / (len(part) + 2)


def spike_samples(values: ArrayLike) -> Bools:
    """Return which values (N,) are spikes: at most three wrong samples between good ones.

    They differ from the prediction by their neighbours by 20 standard deviations, both of the whole
    record and of the 64 samples around them.
    """
    signal = np.asarray(values, float)
    out = np.zeros(len(signal), bool)
    for first in range(0, len(signal), _BLOCK):
        part = slice(max(first - _LOCAL, 0), first + _BLOCK + _LOCAL)
        found = _spikes(signal[part])
        out[first : first + _BLOCK] = found[first - part.start :][:_BLOCK]
    return out


def _spikes(signal: Array) -> Bools:
    from scipy.ndimage import maximum_filter1d

    clean, hit = signal.copy(), np.zeros(len(signal), bool)
    predictor = _predictor(clean)
    residual = _residual(clean, predictor)
    bound = _SPIKE_SIGMAS * np.maximum(_local_sd(residual), quantisation(signal))
    for _ in range(_ROUNDS):
        size = np.abs(residual)
        peaks = (size > bound) & (size == maximum_filter1d(size, 2 * _NEIGHBOURS + 1))
        if not peaks.any():
            break
        clean[peaks] -= residual[peaks]
        hit |= peaks
        residual = _residual(clean, predictor)
    off = np.abs(signal - clean)
    for first, last in list(_runs(hit)):
        near = slice(max(first - _ALONE, 0), last + _ALONE)
        least, size = off[first:last].min(), np.abs(residual[near])
        quiet = size.max() <= max(_QUIET * least, bound[first:last].min() / 2)
        if last - first > LONGEST_SPIKE or least < np.ptp(clean[near]) or not quiet:
            hit[first:last] = False
    return hit


def shifted_samples(reading: ArrayLike) -> Bools:
    """Return which of N samples (N, k) along k axes belong to a shifted part of the record.

    A shifted part has at most 256 samples. It begins with a jump between two samples, of 12
    standard deviations over all axes, and ends with the opposite jump. No other jump nearby is a
    third as large; after an impact, which rings, there are such jumps. The size of a jump is the
    difference between straight lines through five samples on each side, extrapolated to the jump.
    """
    from scipy.ndimage import maximum_filter1d

    signal = np.asarray(reading, float)
    out = np.zeros(len(signal), bool)
    if len(signal) < 4 * _SHIFT_TAPS or not signal.shape[1]:
        return out
    distance = np.arange(_SHIFT_TAPS) + 0.5
    weights = np.linalg.pinv(np.stack([np.ones(_SHIFT_TAPS), distance], -1))[0]
    taps = np.concatenate([-weights[::-1], weights])
    jump = np.zeros_like(signal)
    inner = slice(_SHIFT_TAPS, len(signal) - _SHIFT_TAPS + 1)
    jump[inner] = np.stack([np.correlate(a, taps, "valid") for a in signal.T], -1)
    sd = np.stack([np.maximum(_local_sd(j), quantisation(a)) for j, a in zip(jump.T, signal.T)], -1)
    relative = np.divide(np.abs(jump), sd, out=np.zeros_like(jump), where=sd > 0)
    size = np.linalg.norm(relative, axis=1)
    peak = size == maximum_filter1d(size, 2 * _SHIFT_TAPS - 1)
    for first in np.flatnonzero(peak & (size > _SHIFT_SIGMAS)).tolist():
        near = slice(max(first - _LONGEST_SHIFT, 0), first + 2 * _LONGEST_SHIFT)
        others = size[near].copy()
        others[_about(first - near.start)] = 0
        last = near.start + int(others.argmax())
        others[_about(last - near.start)] = 0
        left = np.abs(jump[first] + jump[last])
        opposite = left <= _SHIFT_BACK * np.abs(jump[first]).max() + 5 * sd[[first, last]].max(0)
        quiet = others.max() < _SHIFT_QUIET * min(size[first], size[last])
        if first < last <= first + _LONGEST_SHIFT and opposite.all() and quiet:
            out[first:last] = True
    return out


def _about(jump: int) -> slice:
    """Return the places at which a jump is seen as well."""
    return slice(max(jump - _SHIFT_TAPS + 1, 0), jump + _SHIFT_TAPS)


def _local_sd(residual: Array) -> Array:
    """Return the larger of the robust standard deviations of the record and of 64 samples (N,)."""
    whole = float(robust_sd(residual))
    count = len(residual) // _LOCAL
    if count < 2:
        return np.full(len(residual), whole)
    each = robust_sd(residual[: count * _LOCAL].reshape(count, _LOCAL), axis=1)
    wide = np.max(sliding_window_view(np.pad(each, 1, mode="edge"), 3), axis=1)
    block = np.minimum(np.arange(len(residual)) // _LOCAL, count - 1)
    return np.asarray(np.maximum(whole, wide[block]))


def prediction_residual(values: Array) -> Array:
    """Return each value (N,) minus its prediction from eight neighbours; 0 at the ends."""
    return _residual(values, _predictor(values))


def _predictor(values: Array) -> Array | None:
    """Return weights (8,) of neighbours and a constant that predict a value; None if too short.

    They are fitted to the record without what they predict badly, so they follow an oscillation.
    """
    width = 2 * _NEIGHBOURS + 1
    if len(values) < _LEAST_TO_LEARN:
        return None
    near = sliding_window_view(np.pad(values, _NEIGHBOURS, mode="edge"), width)
    near = np.delete(near, _NEIGHBOURS, axis=1)
    near = np.concatenate([near, np.ones((len(values), 1))], -1)
    kept = np.ones(len(values), bool)
    for _ in range(4):
        some = np.flatnonzero(kept)[:: 1 + int(kept.sum()) // _MOST_TO_LEARN]
        weights = np.linalg.lstsq(near[some], values[some], rcond=None)[0]
        residual = values - near @ weights
        clean = np.abs(residual) <= 5 * robust_sd(residual)
        kept = np.convolve(~clean, np.ones(width), "same") < 0.5
        if kept.sum() < _LEAST_TO_LEARN // 2:
            return None
    return np.asarray(weights)


def _residual(values: Array, predictor: Array | None) -> Array:
    if predictor is None:
        return np.zeros(len(values))
    taps = np.insert(-predictor[:-1], _NEIGHBOURS, 1.0)
    residual = np.correlate(np.pad(values, _NEIGHBOURS, mode="edge"), taps, "valid") - predictor[-1]
    residual[:_NEIGHBOURS] = residual[-_NEIGHBOURS:] = 0.0
    return np.asarray(residual)


def _gaps(t: Array, where: str) -> list[Finding]:
    """Return a warning about steps in which samples are missing."""
    steps = np.diff(t)
    gaps = np.flatnonzero(steps > _GAP_STEPS * np.median(steps))
    if not len(gaps):
        return []
    words = (
        f"samples are missing in {len(gaps)} gap{'s' * (len(gaps) > 1)}, the first of "
        f"{1000 * steps[gaps[0]]:.3g} ms at {t[gaps[0]]:.6g} s, the longest of "
        f"{1000 * steps[gaps].max():.3g} ms"
    )
    return [Finding(words, where)]
