"""Samples of a sensor at its limit, and of one that had stopped."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Bools
from telerig.estimator.sensors.record_numbers import quantisation, runs

_CLIPPED_LEAST = 5
_CLIPPED_EXCESS = 3
_AT_LIMIT = 1e-3

_LEAST_FROZEN = 4
_CHANCE = 1e-6
_WINDOWS = (16, 64)


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
    for first, last in runs(same):
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


def _repeated(same: Bools, first: int, last: int) -> Iterator[float]:
    """Return the probability of a repetition in windows just before and just after a run."""
    for window in _WINDOWS:
        for part in (same[max(first - window, 0) : first], same[last : last + window]):
            yield (np.count_nonzero(part) + 1) / (len(part) + 2)
