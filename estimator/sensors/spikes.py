"""Samples that stand apart from their neighbours: spikes, and shifted parts of a record."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.record_numbers import quantisation, runs
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
    for first, last in list(runs(hit)):
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
