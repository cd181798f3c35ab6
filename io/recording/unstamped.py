"""Times of readings that carry no stamps, from arrivals that come in bunches.

An adapter keeps bytes for up to 16 ms and then passes them on together. A device that samples
regularly makes reading k at a + T k; the line below all (k, arrival) gives a and T, as it gives
offset and drift of a stamped clock (`clock`). Lines that are missing shift k: where the least delay
of the readings before and after differs by more than half of T, a new count begins.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import minimum_filter1d

from telerig.arrays import Array, Ints
from telerig.io.recording.clock import fit_counts

ADAPTER_S = 0.016
"""Longest time in s for which a USB adapter keeps bytes."""
_FEWEST = 50
_SHORTEST_S = 0.5
_WINDOW = 200
"""Among so many readings there is one that hardly waited."""
_LONGEST_WAIT_S = 0.1
_MOST = 0.8
"""The share of the record that decides: at other times the host may have been too busy to read."""
_MOST_DRIFT = 5e-4
"""The period is known at least so well, as a share of it."""
_SEGMENT = 20
"""A regular device gives at least so many readings, on average, between two that are missing."""


@dataclass(frozen=True)
class Spread:
    """Hold the times of N readings of a device that sends no time stamps.

    t_s : (N,) times in s, strictly increasing.
    sd_s : standard deviation of the times.
    regular : whether the device samples regularly; if not, the readings of one arrival are spread
        evenly over the time since the previous arrival.
    """

    t_s: Array
    sd_s: float
    regular: bool


def spread_arrivals(arrived_s: Array, slot: Ints) -> Spread:
    """Estimate when readings were made that arrive several at a time.

    arrived_s : (N,) times of arrival. slot : (N,) number of the line of each reading, increasing;
    malformed lines are counted, too.
    """
    regular, even = _by_regular_clock(arrived_s, slot), _evenly(arrived_s)
    return regular if regular is not None and regular.sd_s < even.sd_s else even


def _by_regular_clock(arrived_s: Array, slot: Ints) -> Spread | None:
    """Return times of a device that samples regularly; None where arrivals do not show that."""
    if len(slot) < _FEWEST or np.ptp(arrived_s) < _SHORTEST_S:
        return None
    period_s = _period_s(arrived_s, slot)
    if not period_s > 0:
        return None
    count = np.cumsum(_begins(arrived_s, slot, period_s)) - 1
    device_s = np.asarray(period_s * slot, np.float64)
    clocks = fit_counts(arrived_s, device_s, count)
    parts = np.split(device_s, np.flatnonzero(np.diff(count)) + 1)
    t_s = np.concatenate([clock.host_s(part) for clock, part in zip(clocks, parts)])
    waited_s = arrived_s - t_s
    often_s = float(np.quantile(waited_s, _MOST))
    if len(clocks) > 1 + len(slot) // _SEGMENT or not often_s < max(_LONGEST_WAIT_S, 2 * period_s):
        return None
    part = np.floor((arrived_s - arrived_s[0]) / (_FEWEST * period_s))
    least_s = np.minimum.reduceat(waited_s, np.unique(part, return_index=True)[1])
    return Spread(_increasing(t_s), float(np.quantile(np.abs(least_s), _MOST)), True)


def _period_s(arrived_s: Array, slot: Ints) -> float:
    """Return the time from one line to the next, from the least delays in parts of the record."""
    lag = max(len(slot) // 3, 1)
    rate = (arrived_s[lag:] - arrived_s[:-lag]) / (slot[lag:] - slot[:-lag])
    period_s = float(np.median(rate))
    for _ in range(2):
        late = arrived_s - period_s * slot
        parts = np.array_split(np.arange(len(slot)), max(len(slot) // _WINDOW, 3))
        edge = np.array([part[np.argmin(late[part])] for part in parts])
        period_s += float(np.median(np.diff(late[edge]) / np.diff(slot[edge])))
    return period_s


def _begins(arrived_s: Array, slot: Ints, period_s: float) -> Ints:
    """Return (N,) 1 where a count begins.

    Arrival minus period times the line's number is a constant in each count, plus the delay.
    Missing lines raise the constant; malformed ones that were no line lower it.
    """
    late_s = arrived_s - period_s * slot
    waited_least = np.diff(arrived_s, append=np.inf) > period_s / 2
    surplus = (slot - np.arange(len(slot))).tolist()
    begins = np.zeros(len(late_s), np.int64)
    begins[0] = 1
    flush = int(2 * _usual_wait_s(arrived_s) / period_s) + 1
    window = min(max(_WINDOW, 4 * flush), len(late_s) - 1)
    ahead = minimum_filter1d(late_s, 2 * window + 1, origin=-window, mode="nearest")
    late, least = late_s.tolist(), deque([0])
    begin, former, i, last = 0, 0, 1, len(late) - flush
    previous, level = -np.inf, late[0]
    while i < len(late):
        if late[i] < previous + period_s / 2:
            # Nothing was missing: the host was too busy to read for a while, and has caught up.
            begins[begin] = 0
            begin, level, previous = former, previous, -np.inf
        before = late[least[0]]
        raised = i < last and ahead[i] - before > period_s / 2
        short = begin > 0 and i - begin < flush
        first = max(i - window, begin)
        lowered = bool(waited_least[i]) and surplus[i] > surplus[first]
        # The first reading of the lower count may itself have waited.
        lowered &= late[i] - level < -period_s / 4 and ahead[i] - level < -period_s / 2
        # A lower count's readings came too early for the one before: it does not end at once.
        if (raised or lowered) and not (short and np.isneginf(previous)):
            if raised:
                # What came with a delay just before the missing lines is still of the old count.
                higher = ahead[min(i + flush, last)] - period_s / 4
                i += int(np.max(np.flatnonzero(late_s[i : i + flush] < higher), initial=-1)) + 1
                late_by = 0
            else:
                # The lower count begins after the most malformed lines; what waited comes before i.
                steps = np.diff(surplus[first : i + 1])[::-1]
                late_by = int(np.argmax(steps))
            if short:
                begins[begin] = 0  # too short to contain a reading that hardly waited
            former = former if short else begin
            begin, previous = i - late_by, before if raised else -np.inf
            begins[begin] = 1
            least.clear()
            level = late[i]
        level = min(level + _MOST_DRIFT * period_s, late[i])
        while least and late[least[-1]] >= late[i]:
            least.pop()
        least.append(i)
        if least[0] <= i - window:
            least.popleft()
        i += 1
    return begins


def _usual_wait_s(arrived_s: Array) -> float:
    """Return the longest usual wait, from the time between arrivals during most of the record."""
    silence = np.sort(np.diff(arrived_s))
    half = silence[np.searchsorted(np.cumsum(silence), silence.sum() / 2)]
    return float(np.clip(1.5 * half, ADAPTER_S, _LONGEST_WAIT_S))


def _evenly(arrived_s: Array) -> Spread:
    """Return the readings of one arrival spread over the time since the arrival before.

    They are spread over at most 16 ms, or as long as so many readings take on average.
    """
    if not len(arrived_s):
        return Spread(arrived_s, 0.0, False)
    usual_s = float(np.ptp(arrived_s)) / max(len(arrived_s) - 1, 1)
    arrivals, which, size = np.unique(arrived_s, return_inverse=True, return_counts=True)
    most = np.maximum(ADAPTER_S, usual_s * size)
    width = np.minimum(np.diff(arrivals, prepend=arrivals[0] - most[0]), most)
    place = np.arange(len(arrived_s)) - (np.cumsum(size) - size)[which]
    t_s = arrived_s - width[which] * (1 - (place + 1) / size[which])
    return Spread(_increasing(t_s), float(np.sqrt(np.mean(width[which] ** 2) / 12)), False)


def _increasing(t_s: Array) -> Array:
    """Return the times, each at least a microsecond after the one before."""
    ramp = 1e-6 * np.arange(len(t_s))
    return np.asarray(np.maximum.accumulate(t_s - ramp) + ramp)
