"""Models the noise of ray misses, which comes from pixels, differential shake and bubbles that
change shape.

The noise is a Gaussian process in time. Its hyper-parameters are learned from the ray misses
themselves. It is the sum of white noise of each pair, of damped oscillations that are common to all
pairs of a frame (shake), and of an Ornstein-Uhlenbeck process for each bubble, because the centre
of its outline wanders about its centre of volume. Only the spectral density near 0 Hz limits the
estimate of a constant, and an oscillation has little density there. The usual standard error of a
mean would be too large or too small, because ray misses are correlated in time.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.optimize import minimize

from telerig.arrays import Array, Bools, Ints

Prior = tuple[Array, Array]

_PEAKS = 3
_MOST_MODES = 2
_LEAST_LOG_RATIO = 3.0
_WANDER_S = 0.1
_CYCLES = 5.0
_FACTOR_3, _FACTOR_10 = np.log(3.0), np.log(10.0)
_INDEPENDENT = 0.5
"""Weight of each bin of a spectrum, because neighbouring bins of a tapered spectrum are
correlated."""

_FIRST_BIN = 2
_LEAST_FRAMES = 16
_LEAST_CYCLES = 4.0
"""An oscillation with fewer cycles in a stretch cannot be distinguished from a slow wander."""

_MOST_APART = 4


@dataclass(frozen=True)
class Series:
    """Holds M ray misses in time, which are linear in K unknowns of unit prior variance.

    frame, bubble : (M,) index of each frame and of each bubble.
    t_s, miss_mm : (M,).
    relative : (M,) variance of each ray miss divided by the median variance.
    by_unknowns : (M, K) derivative of each ray miss with respect to the unknowns.
    """

    frame: Ints
    bubble: Ints
    t_s: Array
    miss_mm: Array
    relative: Array
    by_unknowns: Array

    def __len__(self) -> int:
        return len(self.miss_mm)

    def of(self, keep: Bools) -> Series:
        return Series(*(getattr(self, column.name)[keep] for column in fields(self)))

    def residuals(self) -> Array:
        """Return the ray misses (M,) minus their least-squares fit by the unknowns."""
        fit = np.linalg.lstsq(self.by_unknowns, self.miss_mm, rcond=None)[0]
        return np.asarray(self.miss_mm - self.by_unknowns @ fit)


@dataclass(frozen=True)
class Noise:
    """Holds the hyper-parameters of the noise of ray misses.

    white_mm : standard deviation of the white noise of a pair.
    wander_mm, wander_s : standard deviation and correlation time of each bubble's
        Ornstein-Uhlenbeck process.
    shake : RMS (mm), decay time (s) and frequency (Hz) of each oscillation that all pairs share.
    """

    white_mm: float
    wander_mm: float
    wander_s: float
    shake: tuple[tuple[float, float, float], ...] = ()

    def own(self, lag_s: Array) -> Array:
        """Return the autocovariance of a bubble's wander at the lags, in mm^2."""
        return np.asarray(self.wander_mm**2 * np.exp(-np.abs(lag_s) / self.wander_s))

    def common(self, lag_s: Array) -> Array:
        """Return the autocovariance of the shake at the lags, in mm^2: damped resonators driven by
        white noise."""
        out = np.zeros_like(lag_s)
        for rms, decay, hz in self.shake:
            lag, turn = np.abs(lag_s), 2 * np.pi * hz
            wave = np.cos(turn * lag) + np.sin(turn * lag) / (turn * decay)
            out += rms**2 * np.exp(-lag / decay) * wave
        return out

    def covariance(self, series: Series) -> Array:
        """Return the covariance (M, M) of the ray misses, with the unknowns held fixed."""
        t, index = np.unique(series.t_s, return_inverse=True)
        at = np.ix_(index, index)
        lag = t[:, None] - t
        same = series.bubble[:, None] == series.bubble
        out = self.common(lag)[at] + np.where(same, self.own(lag)[at], 0.0)
        out[np.diag_indices(len(out))] += self.white_mm**2 * series.relative
        return np.asarray(out)


@dataclass(frozen=True)
class _Spectrum:
    """Holds a tapered periodogram, and what is needed for its expectation.

    power : periodogram from bin `_FIRST_BIN` on.
    step_s : interval of the samples.
    overlap : autocorrelation of the taper.
    common, single : shares of the shake's variance and of a single bubble's variance in the series.
    """

    power: Array
    step_s: float
    overlap: Array
    common: float
    single: float

    def expected(self, noise: Noise) -> Array:
        """Return the expectation of the periodogram, which includes leakage and aliasing."""
        lag = np.asarray(np.arange(len(self.overlap)) * self.step_s, np.float64)
        covariance = self.common * noise.common(lag) + self.single * noise.own(lag)
        covariance[0] += self.single * noise.white_mm**2
        turned = covariance * self.overlap
        both = np.concatenate([turned, [0.0], turned[:0:-1]])
        density = np.fft.fft(both).real[: len(self.overlap) + 1 : 2]
        return np.asarray(density[_FIRST_BIN : _FIRST_BIN + len(self.power)].clip(1e-18))

    def cost(self, noise: Noise) -> float:
        """Return the negative debiased Whittle log-likelihood (Sykulski et al., Biometrika 106:251,
        2019)."""
        density = self.expected(noise)
        return float(_INDEPENDENT * (np.log(density) + self.power / density).sum())


def learned_noise(parts: list[Series]) -> Noise:
    """Return the noise model with the largest posterior, from the spectra of the residuals of
    stretches.

    Oscillations are added as long as each raises the log posterior by `_LEAST_LOG_RATIO`, at most
    two (one for the arm of each camera).
    """
    spread = max(float(np.concatenate([p.residuals() for p in parts]).std()), 1e-7)
    start = np.log([spread / 2, spread / 4, _WANDER_S])
    spectra = [s for p in parts for s in _spectra(p)]
    if not spectra:
        return Noise(spread, spread / 4, _WANDER_S)
    prior: Prior = (start, np.array([_FACTOR_10, _FACTOR_10, _FACTOR_3]))
    best, score = _fitted(spectra, start, prior)
    for _ in range(_MOST_MODES):
        trials = []
        for hz in _peaks(spectra[0], _noise(best)):
            mode = np.log([spread / 2, _CYCLES / hz, hz])
            richer = (
                np.concatenate([prior[0], mode]),
                np.concatenate([prior[1], [_FACTOR_10, _FACTOR_3, 0.1]]),
            )
            trials.append((*_fitted(spectra, np.concatenate([best, mode]), richer), richer))
        found = min(trials, key=lambda t: t[1], default=None)
        if found is None or found[1] > score - _LEAST_LOG_RATIO:
            break
        best, score, prior = found
    return _noise(best)


def _fitted(spectra: list[_Spectrum], start: Array, prior: Prior) -> tuple[Array, float]:
    """Return the logarithms of the hyper-parameters, and the negative log posterior there."""

    def cost(log: Array) -> float:
        noise = _noise(log)
        pull = 0.5 * float((((log - prior[0]) / prior[1]) ** 2).sum())
        return pull + sum(s.cost(noise) for s in spectra)

    box = [(s - 8.0, s + 4.0) for s in start]
    found = minimize(cost, start, method="L-BFGS-B", bounds=box, options={"maxiter": 60})
    return np.asarray(found.x), float(found.fun)


def _noise(log: Array) -> Noise:
    white, wander, tau, *rest = (float(v) for v in np.exp(log))
    return Noise(white, wander, tau, tuple(zip(rest[0::3], rest[1::3], rest[2::3])))


def _spectra(part: Series) -> list[_Spectrum]:
    """Return the spectrum of each frame's mean ray miss, and those of single bubbles' deviations
    from it."""
    left = part.residuals()
    t, index = np.unique(part.t_s, return_inverse=True)
    if len(t) < _LEAST_FRAMES:
        return []
    count = np.bincount(index)
    mean = np.bincount(index, left) / count
    share = float((1 / count).mean())
    out = [_spectrum(t, mean, 1.0, share)]
    apart = left - mean[index]
    bubbles, seen = np.unique(part.bubble, return_counts=True)
    for bubble in bubbles[np.argsort(-seen)][:_MOST_APART] if share < 1 else ():
        mine = (part.bubble == bubble) & (count[index] > 1)
        if mine.sum() >= _LEAST_FRAMES:
            rest = float((1 - 1 / count[index[mine]]).mean())
            out.append(_spectrum(part.t_s[mine], apart[mine], 0.0, rest))
    return out


def _spectrum(t_s: Array, values: Array, common: float, single: float) -> _Spectrum:
    step = float(np.median(np.diff(t_s)))
    even = np.arange(t_s[0], t_s[-1] + step / 2, step)
    series = np.interp(even, t_s, values)
    taper = np.hanning(len(even) + 2)[1:-1]
    taper /= np.sqrt((taper**2).sum())
    power = np.abs(np.fft.rfft(series * taper)) ** 2
    overlap = np.correlate(taper, taper, "full")[len(taper) - 1 :]
    last = (len(even) - 1) // 2
    return _Spectrum(power[_FIRST_BIN : last + 1], step, np.asarray(overlap), common, single)


def _peaks(spectrum: _Spectrum, noise: Noise) -> list[float]:
    """Return frequencies (Hz) that exceed the noise model's spectrum most and are not close
    together.
    """
    ratio = spectrum.power / spectrum.expected(noise)
    length = len(spectrum.overlap) * spectrum.step_s
    hz = np.arange(_FIRST_BIN, _FIRST_BIN + len(ratio)) / length
    picked: list[float] = []
    for i in np.argsort(-ratio * spectrum.power):
        if hz[i] * length >= _LEAST_CYCLES and all(abs(hz[i] - p) > 0.15 * p for p in picked):
            picked.append(float(hz[i]))
        if len(picked) == _PEAKS:
            break
    return picked


def information(series: Series, noise: Noise) -> tuple[Array, Array, Array]:
    """Return the information on the unknowns, and the leave-one-out residuals.

    Returns the matrix (K, K) and the vector (K,) of the normal equations without prior, and the
    residuals (M,) in standard deviations. The residuals are computed at the best unknowns of this
    stretch; the uncertainty of these is neglected.
    """
    lower = cholesky(noise.covariance(series), lower=True, check_finite=False)
    inverse = cho_solve((lower, True), np.eye(len(lower)), check_finite=False)
    matrix = series.by_unknowns.T @ inverse @ series.by_unknowns
    right = series.by_unknowns.T @ (inverse @ series.miss_mm)
    best = np.linalg.solve(matrix + np.eye(len(matrix)), right)
    off = inverse @ (series.miss_mm - series.by_unknowns @ best)
    return matrix, right, off / np.sqrt(np.diagonal(inverse))
