"""Host time of readings that a device stamps with its own clock, which drifts, wraps and restarts.

The host receives reading i at h_i = a + b d_i + delay_i, with d_i the device's own stamp and
delay_i >= 0 the wait in the device, the adapter (up to 16 ms) and the host. The estimate is the
line that lies below every (d_i, h_i) with the least sum of distances: the linear programme of Moon,
Skelly, Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM
1999, eq. 7-8, solved on the lower convex hull (Zhang, Liu, Xia, "Clock synchronization algorithms
for network measurements", INFOCOM 2002). The least delay is part of a: one-way stamps cannot
distinguish it from an offset.

Where the rate of a clock changes (with the temperature, over minutes, by a part in a million) the
line becomes a piecewise linear curve, by the same linear programme with a value at each knot.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.io.rig_file.description import DeviceDescription
from telerig.statistics import robust_sd

RESTART_S = 0.5
"""A stamp that differs by more from the expected one belongs to another count."""
_FEWEST = 5
"""A restarted clock must give so many readings in a row; fewer are wrong stamps."""
_WINDOWS = 64
_BLOCKS = 8
_SHORT_S = 10.0
_LEAST_WANDER_S = 100e-6
"""The line gets knots only where the least delays wander by more than this."""
_CURVE_WINDOW_S = 3.0
_KNOT_S = 30.0
_WINDOWS_PER_KNOT = 8
_LEAST_SPAN_S = 0.2
"""Within a shorter time arrivals do not determine a clock's rate: its nominal one is assumed."""
_MOST_DRIFT = 0.1
"""No clock that counts in the stated unit is wrong by a larger share of the time."""
_RATE_READINGS = 16
"""Fewer readings do not show in which unit a clock counts."""
_RATE_S = 0.05
"""The rate of a clock is that between readings so far apart: several times the adapter's delay."""
_WRONG_UNIT = 0.5
"""A clock whose rate differs from the host's by a larger share counts in another unit."""
_TREND = 0.5
"""Mean squared step between neighbours over the variance: 2 for noise, near 0 for a slow change."""


@dataclass(frozen=True)
class ClockFit:
    """Describe how the host's time follows from the time of a device's clock.

    host_s = host_mean_s + offset_s + (device_s - device_mean_s) / (1 + drift_ppm * 1e-6), all times
    in s, and ``bend_s``, a correction at knots_s (from device_mean_s) where the rate changed.

    sd_offset_us : standard deviation of the least delays in parts of the record.
    wander_us : range of these least delays.
    sd_drift_ppm : standard deviation of the drift, by a jackknife or by the scatter of the least
        delays, whichever is larger; NaN for a drift that was taken from a longer record.
    delay_median_ms, delay_max_ms : delay of the readings beyond the least delay.
    """

    device_mean_s: float
    host_mean_s: float
    offset_s: float
    drift_ppm: float
    sd_offset_us: float
    sd_drift_ppm: float
    delay_median_ms: float
    delay_max_ms: float
    wander_us: float
    readings: int
    knots_s: tuple[float, ...] = ()
    bend_s: tuple[float, ...] = ()

    def host_s(self, device_s: Array) -> Array:
        """Return the host times in s of unwrapped device times in s, in the same shape."""
        slope = 1 / (1 + 1e-6 * self.drift_ppm)
        x = device_s - self.device_mean_s
        line = self.host_mean_s + self.offset_s + x * slope
        return line + np.interp(x, self.knots_s, self.bend_s) if self.knots_s else line


@dataclass(frozen=True)
class ClockRecord:
    """Hold the times of a device's readings on the host's clock.

    t_s : (readings,) times, NaN for a wrong time stamp.
    segment : (readings,) index of the fit that was used, -1 for a wrong stamp.
    fits : one clock fit for each uninterrupted count.
    wraps : how often the counter wrapped.
    wrong : number of wrong stamps.
    """

    t_s: Array
    segment: Ints
    fits: tuple[ClockFit, ...]
    wraps: int
    wrong: int


def host_times(host_s: Array, device_s: Array, wrap_s: float = 0.0) -> ClockRecord:
    """Compute the host times of readings that a device stamps with its own clock.

    host_s : (readings,) times of arrival in s, not decreasing. device_s : (readings,) the stamps in
    s, modulo ``wrap_s`` (0: they never wrap).
    A stamp is wrong if it repeats the previous one, or if it is neither between its neighbours nor
    the first of a clock that has restarted.
    """
    t_s = np.full(len(host_s), np.nan)
    segment = np.full(len(host_s), -1, np.int64)
    kept = _plausible(host_s, device_s, wrap_s)
    if not kept.size:
        return ClockRecord(t_s, segment, (), 0, len(host_s))
    unwrapped = unwrap(host_s[kept], device_s[kept], wrap_s)
    number = np.cumsum(_breaks(host_s[kept], unwrapped)) - 1
    wraps = int(np.sum(np.diff(device_s[kept]) < -wrap_s / 2)) if wrap_s else 0
    fits = fit_counts(host_s[kept], unwrapped, number)
    for k, fit in enumerate(fits):
        own = number == k
        t_s[kept[own]] = fit.host_s(unwrapped[own])
    segment[kept] = number
    return ClockRecord(t_s, segment, fits, wraps, len(host_s) - len(kept))


def stamp_rate(host_s: Array, device_s: Array, wrap_s: float = 0.0) -> float | None:
    """Return how many seconds of a device's time stamps pass in one second of the host's time.

    It is the rate of the majority of readings, so that restarts, lost readings and wrong stamps do
    not matter. Returns None if there are too few readings, or if the stamps wrap so often that they
    seem to go back.

    host_s, device_s : (readings,) times of arrival and stamps. wrap_s : as for `host_times`; wraps
    are undone without the host's times, which would hide a wrong unit.
    """
    device_s = unwrap(np.zeros(len(device_s)), device_s, wrap_s)
    lag = 1
    while 2 * lag + _RATE_READINGS <= len(host_s):
        apart = host_s[lag:] - host_s[:-lag]
        if np.median(apart) > _RATE_S:
            counted = device_s[lag:] - device_s[:-lag]
            valid = (counted > 0) & (apart > _RATE_S / 2)
            return float(np.median(counted[valid] / apart[valid])) if valid.any() else None
        lag *= 2
    return None


def check_unit(host_s: Array, stamps: Array, device: DeviceDescription) -> None:
    """Raise InputError if a device's time stamps count in another unit than rig.toml states.

    host_s, stamps : (readings,) times of arrival in s, and the stamps as they were sent.
    """
    rate = stamp_rate(host_s, stamps * device.time_unit_s, device.wrap_s)
    if rate is None or 1 - _WRONG_UNIT < rate < 1 / (1 - _WRONG_UNIT):
        return
    power = 10.0 ** round(np.log10(rate))
    decimal = abs(rate / power - 1) < _MOST_DRIFT
    times = power if decimal else float(f"{rate:.3g}")
    unit = device.time_unit_s / (power if decimal else rate)
    raise InputError(
        f"its time stamps run {times:g} times as fast as the host's clock",
        where=f"devices.{device.name}",
        todo=f"set time_unit_s = {unit:.3g} in [devices.{device.name}] of rig.toml (now "
        f"{device.time_unit_s:g}); what was recorded can be read with `telerig record --replay RUN "
        "--rig rig.toml`",
    )


def unwrap(host_s: Array, device_s: Array, wrap_s: float) -> Array:
    """Return the device's times (readings,) in s with all wraps of its counter undone.

    The number of wraps between two readings follows from the host's times.
    """
    if not wrap_s or not len(device_s):
        return np.array(device_s)
    ahead = device_s - host_s
    turns = -np.round(np.diff(ahead, prepend=ahead[:1]) / wrap_s)
    return np.asarray(device_s + wrap_s * np.cumsum(turns))


def lower_line(x: Array, y: Array, at: float | None = None) -> tuple[float, float]:
    """Return the line that lies below all points and is highest at ``at``: its y there, its slope.

    x, y : (points,); x must increase. at : None takes the mean of x; the line is then the one with
    the least sum of distances to the points.
    """
    hull = _lower_hull(x, y)
    middle = float(np.mean(x)) if at is None else at
    if len(hull) < 2:
        return float(y[hull[0]]), 0.0
    right = int(np.clip(np.searchsorted(x[hull], middle), 1, len(hull) - 1))
    i, j = hull[right - 1], hull[right]
    slope = float((y[j] - y[i]) / (x[j] - x[i]))
    return float(y[i] + slope * (middle - x[i])), slope


def _lower_hull(x: Array, y: Array) -> list[int]:
    """Return the indices of the lower convex hull, x increasing (Andrew's algorithm)."""
    hull: list[int] = []
    for k in range(len(x)):
        while len(hull) > 1:
            i, j = hull[-2], hull[-1]
            if (x[j] - x[i]) * (y[k] - y[i]) > (y[j] - y[i]) * (x[k] - x[i]):
                break
            hull.pop()
        hull.append(k)
    return hull


def _plausible(host_s: Array, device_s: Array, wrap_s: float) -> Ints:
    """Return indices of the readings whose stamps are consistent with those of their neighbours."""
    kept: Ints = np.arange(len(host_s))
    while kept.size:
        u = unwrap(host_s[kept], device_s[kept], wrap_s)
        starts = np.flatnonzero(_breaks(host_s[kept], u))
        length = np.diff(np.append(starts, kept.size))
        good = np.repeat(length >= min(_FEWEST, kept.size), length)
        good &= _in_order(u, np.repeat(np.arange(len(starts)), length))
        if good.all():
            break
        kept = kept[good]
    return kept


def _breaks(host_s: Array, u: Array) -> Bools:
    """Return (N,) where a count begins: the stamp follows neither the last nor the host time."""
    step = np.diff(u)
    apart = np.abs(step - np.diff(host_s)) > RESTART_S
    follows = (step > 0) & (step < RESTART_S)
    return np.concatenate([[True], apart & ~follows])


def _in_order(u: Array, part: Ints) -> Bools:
    """Return (N,) False for a stamp that jumps ahead of its successor, falls back, or repeats."""
    good = np.ones(len(u), bool)
    if len(u) < 2:
        return good
    same = part[1:] == part[:-1]
    falls = (u[1:] <= u[:-1]) & same
    before = np.concatenate([[-np.inf], np.where(same[:-1], u[:-2], -np.inf)])
    spike = falls & (u[1:] > before) & (u[1:] < u[:-1])
    good[:-1] &= ~spike
    good[1:] &= ~(falls & ~spike)
    return good


def fit_counts(host_s: Array, device_s: Array, number: Ints) -> tuple[ClockFit, ...]:
    """Fit each uninterrupted count of a clock; short counts take the drift of the longest one.

    host_s, device_s : (readings,) in s. number : (readings,) number of the count to which each
    reading belongs.
    """
    edges = np.searchsorted(number, np.arange(int(number[-1]) + 2))
    parts = [slice(begin, end) for begin, end in pairwise(edges.tolist())]
    spans = [float(np.ptp(device_s[p])) for p in parts]
    longest = int(np.argmax(spans))
    best = fit_clock(host_s[parts[longest]], device_s[parts[longest]])
    return tuple(
        best
        if k == longest
        else fit_clock(host_s[p], device_s[p], None if spans[k] > _SHORT_S else best.drift_ppm)
        for k, p in enumerate(parts)
    )


def fit_clock(host_s: Array, device_s: Array, drift_ppm: float | None = None) -> ClockFit:
    """Fit the clock of one uninterrupted count: the line below all arrivals.

    host_s, device_s : (readings,) in s. drift_ppm : known drift of the clock; None estimates it.
    """
    x_mean, y_mean = float(np.mean(device_s)), float(np.mean(host_s))
    x, late = device_s - x_mean, (host_s - y_mean) - (device_s - x_mean)
    edge, least = _least_delays(x, late)
    used = np.flatnonzero(~_too_early(x, late, edge, least))
    if drift_ppm is None and np.ptp(x) > _LEAST_SPAN_S:
        at_mean, slope = _lower_line_of_many(x[used], late[used])
        if not abs(slope) < _MOST_DRIFT:
            drift_ppm = 0.0
    else:
        drift_ppm = drift_ppm or 0.0
    if drift_ppm is not None:
        slope = 1 / (1 + 1e-6 * drift_ppm) - 1
        at_mean = float(np.min(late[used] - slope * x[used]))
    delay = late[used] - at_mean - slope * x[used]
    curve = None if drift_ppm is not None else _curve(x[used], delay)
    if curve is not None:
        delay = delay - np.interp(x[used], *curve)
    low = np.array([np.min(p) for p in np.array_split(delay, _parts(delay.size))])
    scatter = float(np.std(low)) if len(low) > 1 else float(np.median(delay))
    known = drift_ppm is not None or len(used) < _WINDOWS
    even = scatter * float(np.sqrt(12 / len(low))) / max(float(np.ptp(x)), 1e-9)
    sd_slope = float("nan") if known else max(even, _sd_slope(x[used], late[used]))
    return ClockFit(
        device_mean_s=x_mean,
        host_mean_s=y_mean,
        offset_s=at_mean,
        drift_ppm=1e6 * (1 / (1 + slope) - 1),
        sd_offset_us=1e6 * scatter,
        sd_drift_ppm=1e6 * sd_slope,
        delay_median_ms=1e3 * float(np.median(delay)),
        delay_max_ms=1e3 * float(np.max(delay)),
        wander_us=1e6 * float(np.ptp(low)),
        readings=len(host_s),
        knots_s=tuple(curve[0].tolist()) if curve else (),
        bend_s=tuple(curve[1].tolist()) if curve else (),
    )


def _lower_line_of_many(x: Array, late: Array) -> tuple[float, float]:
    """Return `lower_line` at x = 0, computed from the few points that can touch it."""
    edge, least = _least_delays(x, late, parts=4 * _WINDOWS)
    _, slope = lower_line(x[edge], least)
    height = late - slope * x
    near = np.flatnonzero(height <= np.min(height) + np.ptp(least - slope * x[edge]) + 1e-9)
    if len(near) < 2:
        return float(height[near[0]]), slope
    return lower_line(x[near], late[near], at=0.0)


def _curve(x: Array, delay: Array) -> tuple[Array, Array] | None:
    """Return knots (s) and corrections (s) below the delays; None where a straight line serves."""
    parts = int(np.clip(np.ptp(x) / _CURVE_WINDOW_S, 1, len(x) // 20 + 1))
    edge, least = _least_delays(x, delay, parts)
    if len(edge) < 4 * _WINDOWS_PER_KNOT or np.ptp(least) < _LEAST_WANDER_S:
        return None
    if float(np.mean(np.diff(least) ** 2)) > _TREND * float(np.var(least)):
        return None
    at = x[edge]
    count = 1 + int(np.clip(float(np.ptp(at)) / _KNOT_S, 2, len(at) // _WINDOWS_PER_KNOT))
    knots = np.linspace(at[0], at[-1], count)
    return knots, _highest_curve_below(at, least, knots)


def _highest_curve_below(x_s: Array, least_s: Array, knots: Array) -> Array:
    """Return the knots' values (K,) of the highest piecewise linear curve below all points."""
    from scipy.optimize import linprog
    from scipy.sparse import csr_array

    left = np.clip(np.searchsorted(knots, x_s, "right") - 1, 0, len(knots) - 2)
    share = (x_s - knots[left]) / np.diff(knots)[left]
    row = np.arange(len(x_s))
    places = np.concatenate([row, row]), np.concatenate([left, left + 1])
    shape = (len(x_s), len(knots))
    weights: Any = csr_array((np.concatenate([1 - share, share]), places), shape=shape)
    unit = max(float(np.ptp(least_s)), 1e-12)
    found = linprog(
        -np.asarray(weights.sum(axis=0)).ravel(), A_ub=weights, b_ub=least_s / unit,
        bounds=(-10.0, 10.0), method="highs",
    )  # fmt: skip
    if not found.success or found.x is None:
        return np.zeros(len(knots))
    return np.asarray(unit * np.asarray(found.x))


def _sd_slope(x: Array, late: Array) -> float:
    """Return the slope's sd by a jackknife over `_BLOCKS` parts of the line below the delays."""
    edge, least = _least_delays(x, late)
    block = np.arange(len(edge)) * _BLOCKS // len(edge)
    kept = [block != k for k in range(_BLOCKS)]
    slopes = [lower_line(x[edge][keep], least[keep])[1] for keep in kept]
    return float(np.sqrt((_BLOCKS - 1) * np.var(slopes)))


def _parts(count: int) -> int:
    return int(np.clip(count // 20, 1, _WINDOWS))


def _least_delays(x: Array, late: Array, parts: int | None = None) -> tuple[Ints, Array]:
    """Return the index and value of the least ``late`` in each of the parts of the record."""
    bounds = np.array_split(np.arange(len(x)), min(parts or _parts(len(x)), len(x)))
    edge = np.array([p[0] + int(np.argmin(late[p])) for p in bounds if p.size])
    return edge, late[edge]


def _too_early(x: Array, late: Array, edge: Ints, least: Array) -> Bools:
    """Return the readings (N,) that came before they were made, far below other least delays."""
    if len(edge) < 8:
        return np.zeros(len(x), bool)
    i, j = np.triu_indices(len(edge), len(edge) // 2)
    slope = float(np.median((least[j] - least[i]) / (x[edge[j]] - x[edge[i]])))
    level = least - slope * x[edge]
    middle = float(np.median(level))
    spread = float(robust_sd(level - middle))
    return np.asarray(late - slope * x < middle - max(8 * spread, 2e-4))
