"""The dominant oscillation of a series: frequency and amplitude with standard deviations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array

_LEAST_PERIODS = 1.5
_LEAST_SAMPLES = 16
_PADDING, _FINER = 8, 8
_DENSEST = 16
_SIGNIFICANT = 6.0
LIKELY = 4.5
"""Least amplitude over its standard deviation of a line that is likely to be there, as a bubble's
zigzag, lower than for a line anywhere in a spectrum."""
_ANOTHER = 0.01
"""Probability of another fringe beside that of the best one, from which on no frequency is told."""
_ROUNDING = 1e-9
_NEAR_PERIODS, _FALL = 5.0, 3.0


@dataclass(frozen=True)
class Oscillation:
    """An oscillation of K components with one frequency, K = 1 or 2.

    frequency_hz, s_frequency_hz : frequency and its standard deviation.
    major, minor : semi-axes of the ellipse that two components describe, in their unit. For one
        component, major is the amplitude and minor is 0.
    s_major, s_minor : standard deviations of the semi-axes.
    amplitudes : (K,) of the components.
    """

    frequency_hz: float
    s_frequency_hz: float
    major: float
    minor: float
    s_major: float
    s_minor: float
    amplitudes: Array


def zigzag(
    t_s: Array, velocity_mm_s: Array, errors_mm_s: Array | None = None
) -> Oscillation | None:
    """Return the strongest oscillation of a bubble's lateral velocity, as a displacement in mm.

    The velocity's noise is white where a wandering path's is red, so that a slow drift is not taken
    for a zigzag.

    t_s : (N,).  velocity_mm_s : (N, K) components across the vertical.
    errors_mm_s : (N, M) draws of their errors, as ``alike`` of `dominant_oscillation`.
    """
    found = dominant_oscillation(t_s, velocity_mm_s, significant=LIKELY, alike=errors_mm_s)
    if found is None:
        return None
    w, relative = 2 * np.pi * found.frequency_hz, found.s_frequency_hz / found.frequency_hz
    return replace(
        found, major=found.major / w, minor=found.minor / w, amplitudes=found.amplitudes / w,
        s_major=float(np.hypot(found.s_major, found.major * relative)) / w,
        s_minor=float(np.hypot(found.s_minor, found.minor * relative)) / w,
    )  # fmt: skip


def dominant_oscillation(
    t_s: Array,
    values: Array,
    low_hz: float = 0.0,
    high_hz: float = np.inf,
    significant: float = _SIGNIFICANT,
    *,
    noise: float = 0.0,
    alike: Array | None = None,
) -> Oscillation | None:
    """Return the strongest sinusoid of a series between two frequencies.

    t_s : (N,) increasing times. Frequencies above 0.45 over the short steps between them (the 10 %
        quantile) are not sought.
    values : (N, K), K = 1 or 2 components of one common frequency.
    significant : least amplitude over its standard deviation.
    noise : standard deviation of the values' white noise, of which the density has at least.
    alike : (N, M) series with the spectrum of further errors, which may oscillate at f as the
        values do, so that the residuals do not show them.

    The series is modelled as a straight line, a sinusoid of frequency f, and coloured noise. The
    one-sided density S of the noise near f is taken from the residuals. In a record of T seconds a
    sinusoid of amplitude A (of two components: the root of the sum of their squares) then has the
    variances S / T of A and 3 S / (pi^2 A^2 T^3) of f, which are the Cramer-Rao bounds for white
    noise of this density.

    Returns None if the record is shorter than 1.5 periods or 16 samples, if the amplitude is not
    significant, or if a sinusoid of another frequency that is nearly alike at these times (another
    fringe of a gap) has more than 1 % of the likelihood.
    """
    good = np.isfinite(values).all(-1)
    t, y = np.asarray(t_s, float)[good], np.asarray(values, float)[good]
    if len(t) < _LEAST_SAMPLES:
        return None
    duration = (t[-1] - t[0]) * len(t) / (len(t) - 1)
    step = max(float(np.quantile(np.diff(t), 0.1)), duration / (_DENSEST * len(t)))
    lowest, highest = _LEAST_PERIODS / duration, 0.45 / step
    low, high = max(low_hz, lowest), min(high_hz, highest)
    if low >= high:
        return None
    line = np.stack([np.ones(len(t)), t - t[0]], -1)
    level = y - line @ np.linalg.lstsq(line, y, rcond=None)[0]
    start = _strongest(t, level, step, (low, high))
    if start is None:
        return None
    f, more = _fringe(t, y, start, step, (lowest, highest))
    coefficients, left = _fitted(t, y, f)
    stated = 2 * noise**2 * duration / len(t)
    density = max(_density(t, left, f, duration), stated)
    if not density > (_ROUNDING * np.abs(y).max()) ** 2 * duration:
        return None
    axes = np.linalg.svd(coefficients[2:])[1]
    minor = float(axes[1]) if len(axes) > 1 else 0.0
    waves = _basis(t, f)
    waves = np.concatenate([waves, (t - t.mean())[:, None] * waves[:, 2:]], -1)
    of_each = _variances(np.asarray(np.linalg.pinv(waves)[2:]), t, f, duration)
    of_level, of_slope = of_each.reshape(2, 2).mean(1)
    if axes[0] < significant * np.sqrt(density * of_level) or not low <= f <= high:
        return None
    if more * duration < -np.log(_ANOTHER) * density * len(t):
        return None
    total = float((axes**2).sum())
    of_amplitude, of_frequency = density * of_level, density * of_slope
    if alike is not None:
        # what the residuals show of these errors counts here alone
        others = _density(t, _fitted(t, alike[good], f)[1], f, duration)
        density = max(density - others, stated)
        # of unknown phase: the half of its square is in that of the sinusoid
        level, slope = np.linalg.lstsq(waves, alike[good], rcond=None)[0][2:].reshape(2, 2, -1)
        of_amplitude = density * of_level + float((level**2).sum(0).mean()) / 2
        of_frequency = density * of_slope + float((slope**2).sum(0).mean()) / 2
    s_amplitude = float(np.sqrt(of_amplitude))
    s_f = float(np.sqrt(of_frequency / total)) / (2 * np.pi)
    return Oscillation(
        f, s_f, float(axes[0]), minor, s_amplitude, s_amplitude * (len(axes) > 1),
        np.linalg.norm(coefficients[2:], axis=0),
    )  # fmt: skip


def _fringe(
    t: Array, y: Array, f: float, step: float, band: tuple[float, float]
) -> tuple[float, float]:
    """Return the frequency near f, or on another fringe, whose sinusoid leaves the least, and by
    how much the squares that the next best fringe leaves are larger.

    The window that finds f weights the samples about a gap in the middle most, between which a
    fringe too many hardly shows.
    """
    line = np.stack([np.ones(len(t)), t - t[0]], -1)
    period = (len(t) - 1) / ((t[-1] - t[0]) * len(t))
    f = _refined(t, y, f, period / 2)
    while True:
        left = _fitted(t, y, f)[1]
        wave = y - left - line @ np.linalg.lstsq(line, y - left, rcond=None)[0]
        found = (
            _strongest(t, wave, step, side)
            for side in ((band[0], f - period), (f + period, band[1]))
        )
        others = [_refined(t, y, other, period / 2) for other in found if other is not None]
        more = [float((_fitted(t, y, g)[1] ** 2).sum() - (left**2).sum()) for g in others]
        least = min(more, default=np.inf)
        if least >= 0:
            return f, least
        f = others[more.index(least)]


def _strongest(t: Array, y: Array, step: float, band: tuple[float, float]) -> float | None:
    """Return the frequency of the highest windowed periodogram in a band.

    The values stay at their times, to a fraction of the step: values interpolated over long steps
    would be those of a lower frequency.
    """
    place = np.rint((t - t[0]) * (_FINER / step)).astype(int)
    length = _FINER * round((t[-1] - t[0]) / step + 1)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * (t - t[0]) / (t[-1] - t[0]))
    grid = np.stack([np.bincount(place, column * window, length) for column in y.T], -1)
    power = (np.abs(np.fft.rfft(grid, _PADDING * length, axis=0)) ** 2).sum(-1)
    frequency = np.fft.rfftfreq(_PADDING * length, step / _FINER)
    power[(frequency < band[0]) | (frequency > band[1])] = 0
    return float(frequency[np.argmax(power)]) if power.any() else None


def _fitted(t: Array, y: Array, f: float) -> tuple[Array, Array]:
    """Coefficients (4, K) of 1, t, cos, sin by least squares, and what they leave (N, K)."""
    basis = _basis(t, f)
    found = np.linalg.lstsq(basis, y, rcond=None)[0]
    return np.asarray(found), np.asarray(y - basis @ found)


def _basis(t: Array, f: float) -> Array:
    phase = 2 * np.pi * f * t
    return np.asarray(np.stack([np.ones(len(t)), t - t.mean(), np.cos(phase), np.sin(phase)], -1))


def _refined(t: Array, y: Array, f: float, around: float) -> float:
    """Return the frequency near f whose sinusoid leaves the smallest residual."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        lambda x: float((_fitted(t, y, x)[1] ** 2).sum()),
        bounds=(max(f - around, 0.1 * f), f + around), method="bounded",
        options={"xatol": 1e-5 * f},
    )  # fmt: skip
    return float(found.x)


def _density(t: Array, left: Array, f: float, duration: float) -> float:
    """Return the one-sided density at f by component.

    From the periodogram within 5 periods of the record, taken to have the spectrum of `_noise`,
    over the share that the fit leaves of white noise there: it empties the bins about f, and others
    where the record has a gap. The density is known from k squares alone: the square of an error
    over it has the mean k / (k - 2).
    """
    periods = np.arange(1, np.ceil(f * duration + _NEAR_PERIODS))
    frequency = periods[np.abs(periods - f * duration) < _NEAR_PERIODS] / duration
    waves = np.exp(-2j * np.pi * np.outer(frequency, t))
    periodogram = _periodogram(t, left, frequency, duration)
    taken = (np.abs(waves @ np.linalg.qr(_basis(t, f))[0]) ** 2).sum(-1) / len(t)
    kept = (1 - taken).clip(0).sum()
    squares = 2 * left.shape[1] * kept
    each = periodogram / _noise(frequency / f)
    return float(each.sum() / kept * squares / max(squares - 2, 1))


def _noise(ratio: Array) -> Array:
    """Return the density of noise at ``ratio`` times the frequency f, over that at f.

    It is flat below f and falls with the power 3 above, as a bubble's velocity about its zigzag,
    between the square under a white force and the fourth power under a force that is correlated in
    time. Few periods of a slow oscillation look like such noise.
    """
    return np.asarray((2 / (1 + ratio**2)) ** (_FALL / 2))


def _variances(rows: Array, t: Array, f: float, duration: float) -> Array:
    """Return the variances (M,) of linear functions of the noise, over its density at f.

    rows : (M, N) the weights of the samples. Of frequencies within 5 periods of the record.
    """
    step = 1 / (4 * duration)
    frequency = step * np.arange(1, np.ceil(4 * (f * duration + _NEAR_PERIODS)))
    frequency = frequency[np.abs(frequency - f) * duration < _NEAR_PERIODS]
    passed = np.abs(rows @ np.exp(2j * np.pi * np.outer(t, frequency))) ** 2
    return np.asarray(passed @ _noise(frequency / f) * step)


def _periodogram(t: Array, y: Array, frequency: Array, duration: float) -> Array:
    """Return the one-sided densities (F,) of values (N, K) at frequencies (F,), by component."""
    waves = np.exp(-2j * np.pi * np.outer(frequency, t))
    return np.asarray(2 * duration / len(t) ** 2 * (np.abs(waves @ y) ** 2).mean(-1))
