"""Finds the offset of a sensor's clock by comparison with images and encoder at every possible lag.

Each channel (an acceleration of a camera's images along one direction, or of the carriage) is
regressed on the readings of the sensors that explain it, at every lag at which the records overlap.
The offset is the lag with the largest sum of log-likelihood ratios over the channels. Because the
regression coefficients are free, a wrong unit or axis does no harm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.accelerations import Accelerations, Grid

LEAST_LOG_RATIO, BEYOND, REFUSED = 8.0, 1.4, 2.5
"""Least log-likelihood ratio of a hypothesis, also as a multiple of the largest that is due to
chance, and of one by which a run is refused. Chance has exponential tails of unknown scale: the
largest of 24 values is exceeded so many times by one more in 1.3 and 0.1 % of all cases. See
docs/decisions/025."""

_LONG_RECORD, _MOST_SENSORS = 200_000, 1
"""In longer records, channels that several sensors explain take gigabytes and bring little."""

_LEAST_OVERLAP = 0.3
LEAST_SAMPLES = 60
_RIPPLE_LOG_RATIO = 0.5
_MOST_LAG_SHARE = 0.25
_ORDER = 16
_RIDGE = 1e-5


@dataclass(frozen=True)
class Channel:
    """Hold one component of an acceleration that was derived from the images or the encoder.

    The readings of some accelerometers are fitted to it, to find their clocks, units and axes.

    values : (n,) acceleration in mm/s^2 at the times of the frames.
    known : (n,) True where it is valid, at every ``pace``-th time at most.
    sensors : indices of the accelerometers whose readings are fitted to it.
    """

    values: Array
    known: Bools
    sensors: tuple[int, ...]
    pace: int = 1

    def fitted(
        self,
        readings: Sequence[Accelerations],
        at: int,
        whitening: Array | None = None,
    ) -> tuple[Array, Array]:
        """Return the known values (m,) and their fit at a lag, both without means.

        whitening : filter that is applied to both first, or None.
        """
        x = np.concatenate([readings[s].values for s in self.sensors], axis=1)
        index = np.arange(len(self.values)) + at - (len(self.values) - 1)
        inside = (index >= 0) & (index < len(x)) & self.known
        both = np.column_stack([self.values, x[np.clip(index, 0, len(x) - 1)]])
        if whitening is not None:
            both, inside = filtered(both, inside, whitening, self.pace)
        y, design = both[inside, 0], both[inside, 1:]
        y, design = y - y.mean(), design - design.mean(0)
        return y, np.asarray(design @ np.linalg.lstsq(design, y, rcond=None)[0])


@dataclass(frozen=True)
class Alignment:
    """The offset of a clock: a sample with time stamp t was measured at t - offset_s.

    offset_s : the lag at which the readings explain the images best.
    sd_s : its standard deviation, which includes the disagreement of the channels.
    log_ratio : log-likelihood ratio at this lag to the hypothesis of unrelated records.
    runner_up_log_ratio, runner_up_s : the same at the second-best lag, and this lag.
    reversed_log_ratio : the largest value with the record reversed in time, which is due to chance.
    at_zero_log_ratio : the largest value at lags that are possible for the clock of the frames.
    at_end : whether the best lag is the first or the last one that was tried.
    lags_s, lag_log_ratio : all lags, and the log-likelihood ratio at each; -inf if not tried.
    """

    offset_s: float
    sd_s: float
    log_ratio: float
    runner_up_log_ratio: float
    runner_up_s: float
    reversed_log_ratio: float
    at_zero_log_ratio: float
    at_end: bool
    lags_s: Array
    lag_log_ratio: Array

    @property
    def connected(self) -> bool:
        """Whether the record explains the images clearly better than the reversed record does."""
        return beyond_chance(self.log_ratio, self.reversed_log_ratio)

    @property
    def unique(self) -> bool:
        """Whether the images can be explained at one lag only."""
        alone = beyond_chance(self.log_ratio, self.runner_up_log_ratio)
        return self.connected and alone and not self.at_end

    @property
    def clear(self) -> bool:
        """Whether a clock that is said to be the frames' is refused by this offset."""
        others = max(self.runner_up_log_ratio, self.reversed_log_ratio)
        return self.unique and beyond_chance(self.log_ratio, others, REFUSED)

    @property
    def at_zero(self) -> bool:
        """Whether the record explains the images at the clock of the frames, and at no lag clearly
        better.
        """
        return self.connected and not beyond_chance(self.log_ratio, self.at_zero_log_ratio)


def beyond_chance(log_ratio: float, chance: float, times: float = BEYOND) -> bool:
    """Return whether a hypothesis is better than another by more than chance.

    log_ratio : log-likelihood ratio of both.
    chance : the largest of those that are due to chance.
    times : so many times as large it has to be.
    """
    return log_ratio > max(LEAST_LOG_RATIO, times * chance)


def align(
    frames: Grid, channels: Sequence[Channel], readings: Sequence[Accelerations], near_s: float
) -> Alignment | None:
    """Return the offset of the clock of one or more sensors from the clock of the frames.

    frames : time grid of the channels.
    channels : accelerations that the sensors have to explain.
    readings : smoothed readings of each sensor, on one grid with the same steps.
    near_s : largest offset that still counts as the clock of the frames.

    Returns None if the records do not overlap enough for any lag.
    """
    own = readings[0].grid
    shift = round((frames.start_s - own.start_s) / frames.step_s)
    lags = np.arange(-(frames.count - 1), own.count) - shift
    most = _MOST_SENSORS if own.count > _LONG_RECORD else len(readings)
    used = [c for c in channels if c.pace * np.count_nonzero(c.known) > LEAST_SAMPLES]
    used = [c for c in used if len(c.sensors) <= most] or used
    if not used:
        return None
    first = [_Profile.of(c, readings, whitening_filter(c.values[c.known])) for c in used]
    tried = np.min([p.overlap for p in first], axis=0) >= _LEAST_OVERLAP
    if np.count_nonzero(tried) < 3:
        return None
    total = _total(first, [float(np.count_nonzero(p.channel.known)) for p in first], tried)
    peak = int(np.argmax(total))
    filters = [whitening_filter(np.subtract(*p.channel.fitted(readings, peak))) for p in first]
    forward = [_Profile.of(c, readings, f) for c, f in zip(used, filters)]
    total = _total(forward, [float(np.count_nonzero(c.known)) for c in used], tried)
    peak = int(np.argmax(total))
    sizes = [p.effective_size(readings, peak) for p in forward]
    total = _total(forward, sizes, tried)
    peak = int(np.argmax(total))
    others = total.copy()
    others[_lobe(total, peak)] = -np.inf
    second = int(np.argmax(others))
    backward = [_Profile.of(c, readings, f, reverse=True) for c, f in zip(used, filters)]
    place, sd = refined(total, peak)
    sd *= _disagreement(forward, sizes, tried, peak + place, 2 * frames.knots)
    offsets = np.asarray(lags * frames.step_s, np.float64)
    ends = np.flatnonzero(tried)[[0, -1]]
    near = np.abs(offsets) <= near_s + frames.step_s / 2
    return Alignment(
        float(offsets[peak] + place * frames.step_s), float(sd * frames.step_s),
        float(total[peak]), float(others[second]), float(offsets[second]),
        float(_total(backward, sizes, tried[::-1]).max()),
        float(total[near].max(initial=-np.inf)),
        bool(np.abs(peak - ends).min() <= frames.knots),
        offsets, total,
    )  # fmt: skip


@dataclass(frozen=True)
class _Profile:
    """Explained share of a channel's variance, and overlap, at each lag (lags,)."""

    channel: Channel
    explained: Array
    overlap: Array
    whitening: Array

    @classmethod
    def of(
        cls,
        channel: Channel,
        readings: Sequence[Accelerations],
        whitening: Array,
        *,
        reverse: bool = False,
    ) -> _Profile:
        turn = slice(None, None, -1 if reverse else 1)
        x = np.concatenate([readings[s].values for s in channel.sensors], axis=1)[turn]
        there = np.all([readings[s].known for s in channel.sensors], axis=0)[turn]
        x, usable = filtered(x, there, whitening, channel.pace)
        whole, there = filtered(channel.values[:, None], channel.known, whitening, channel.pace)
        known = there.astype(float)
        if not there.any():
            none = np.zeros(len(x) + len(known) - 1)
            return cls(channel, none, none, whitening)
        y = np.where(there, whole[:, 0] - whole[there, 0].mean(), 0.0)
        ok = usable.astype(float)
        width = x.shape[1]
        pairs = [(i, j) for i in range(width) for j in range(i, width)]
        series = np.array([ok, *x.T, *(x[:, i] * x[:, j] for i, j in pairs)])
        n, *sums = _sliding(series, known)
        over_y = _sliding(series[: 1 + width], y)
        safe = np.maximum(n, 1.0)
        mean_x, mean_y = np.stack(sums[:width], -1) / safe[:, None], over_y[0] / safe
        yy = _sliding(ok[None], y**2)[0] / safe - mean_y**2
        xy = over_y[1:].T / safe[:, None] - mean_x * mean_y[:, None]
        xx = np.empty((len(n), width, width))
        for (i, j), total in zip(pairs, sums[width:]):
            xx[:, i, j] = xx[:, j, i] = total / safe
        xx -= mean_x[:, :, None] * mean_x[:, None]
        size = float((x**2).mean()) + 1e-12
        xx += 1e-6 * size * np.eye(width)
        overlap = n / known.sum()
        used = overlap >= _LEAST_OVERLAP
        share = np.zeros(len(n))
        gain = np.linalg.solve(xx[used], xy[used][..., None])[..., 0]
        share[used] = (gain * xy[used]).sum(-1) / np.maximum(yy[used], 1e-12)
        return cls(channel, np.clip(share, 0.0, 1 - 1e-6), overlap, whitening)

    def effective_size(self, readings: Sequence[Accelerations], at: int) -> float:
        """Return the effective number of independent samples of the regression at a lag."""
        y, fit = self.channel.fitted(readings, at, self.whitening)
        return effective_size(y - fit, fit)


def filtered(values: Array, known: Bools, whitening: Array, pace: int = 1) -> tuple[Array, Bools]:
    """Filter columns (n, D); also return where all samples under the filter are known (n,).

    pace : the filter's coefficients are so many samples apart.
    """
    reach = pace * (len(whitening) - 1)
    taps, under = np.zeros((2, reach + 1))
    taps[::pace], under[::pace] = whitening, 1.0
    out = np.stack([np.convolve(c, taps)[: len(c)] for c in values.T], -1)
    unknown = np.convolve(~known, under)[: len(known)] > 0.5
    unknown[:reach] = True
    return np.where(unknown[:, None], 0.0, out), ~unknown


def effective_size(residual: Array, fit: Array) -> float:
    """Return the effective number of independent samples of a regression with n samples.

    It is n over the sum of the products of the autocorrelations of residual and fit (Bartlett, J.
    R. Stat. Soc. Suppl. 8:27, 1946).
    """
    count = len(fit)
    products = _autocorrelation(residual) * _autocorrelation(fit)
    longest = max(int(_MOST_LAG_SHARE * count), 1)
    spread = 1 + 2 * float(products[1:longest].sum())
    return count / float(np.clip(spread, 1.0, count / 4))


def whitening_filter(residual: Array) -> Array:
    """Return the prediction-error filter of a residual, by an autoregression (Yule-Walker).

    Least squares on filtered data are generalised least squares (Yule, Phil. Trans. R. Soc. A
    226:267, 1927).
    """
    from scipy.linalg import solve_toeplitz

    order = min(_ORDER, len(residual) // 10)
    covariance = _sliding(residual[None], residual)[0, len(residual) - 1 :][: order + 1]
    if order < 1 or not covariance[0] > 0:
        return np.ones(1)
    column = covariance[:order].copy()
    column[0] *= 1 + _RIDGE
    return np.concatenate([[1.0], -solve_toeplitz(column, covariance[1:])])


def _sliding(series: Array, weight: Array) -> Array:
    """Return sum_i weight_i x_(i + l), (K, N + n - 1), of rows x (K, N) at lags l from 1 - n."""
    from scipy.fft import irfft, next_fast_len, rfft

    count = series.shape[1] + len(weight) - 1
    size = next_fast_len(count, real=True)
    product = rfft(series, size, axis=1) * rfft(weight[::-1], size)
    return np.asarray(irfft(product, size, axis=1)[:, :count])


def _autocorrelation(x: Array) -> Array:
    """Return the autocorrelation (n,) of a series, 1 at lag 0."""
    full = _sliding(x[None], x)[0, len(x) - 1 :]
    return np.asarray(full / max(float(full[0]), 1e-300))


def _total(profiles: Sequence[_Profile], sizes: Sequence[float], tried: Bools) -> Array:
    """Return the log-likelihood ratio (lags,) of all channels, -inf at lags that are not tried."""
    total = np.zeros(len(tried))
    for profile, size in zip(profiles, sizes):
        total -= 0.5 * size * np.minimum(profile.overlap, 1.0) * np.log1p(-profile.explained)
    return np.where(tried, total, -np.inf)


def _lobe(total: Array, peak: int) -> slice:
    """Return the lags about the peak down to the nearest valleys on both sides."""
    ends = []
    for step in (-1, 1):
        at, lowest = peak, peak
        while 0 <= at + step < len(total) and np.isfinite(total[at + step]):
            at += step
            if total[at] < total[lowest]:
                lowest = at
            elif total[at] > total[lowest] + _RIPPLE_LOG_RATIO:
                break
        ends.append(lowest)
    return slice(ends[0], ends[1] + 1)


def _disagreement(
    profiles: Sequence[_Profile], sizes: Sequence[float], tried: Bools, place: float, reach: int
) -> float:
    """Return the Birge ratio of the channels' own offsets, at least 1 (Phys. Rev. 40:207, 1932).

    Different low-pass filters of a sensor's axes make it larger than 1.
    """
    squares = []
    for profile, size in zip(profiles, sizes):
        own = _total([profile], [size], tried)
        low = max(round(place) - reach, 0)
        peak = low + int(np.argmax(own[low : round(place) + reach + 1]))
        if own[peak] > LEAST_LOG_RATIO and abs(peak - round(place)) < reach:
            shift, sd = refined(own, peak)
            squares.append(((peak + shift - place) / sd) ** 2)
    if len(squares) < 2:
        return 1.0
    return max(1.0, float(np.sqrt(np.sum(squares) / (len(squares) - 1))))


def refined(total: Array, peak: int) -> tuple[float, float]:
    """Return position and sd of a peak in steps, by a parabola through three values."""
    if not 0 < peak < len(total) - 1 or not np.isfinite(total[[peak - 1, peak + 1]]).all():
        return 0.0, float("inf")
    before, at, after = total[peak - 1 : peak + 2]
    bend = before - 2 * at + after
    if not bend < 0:
        return 0.0, float("inf")
    return float((before - after) / (2 * bend)), float(1 / np.sqrt(-bend))
