"""The noise of ray misses: a Gaussian process in time, whose hyper-parameters are learned.

It comes from pixels, differential shake and bubbles that change shape: white noise of each pair,
damped oscillations that are common to all pairs of a frame (shake), and an Ornstein-Uhlenbeck
process for each bubble, because the centre of its outline wanders about its centre of volume. Only
the spectral density near 0 Hz limits the estimate of a constant; the usual standard error of a mean
would be wrong, because ray misses are correlated in time.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.statistics import parts_without_gaps

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
    """M ray misses in time, which are linear in K unknown numbers of unit prior variance.

    The unknowns are the errors of the calibration and the movement.

    frame, bubble : (M,) indices.
    t_s : (M,) times.
    miss_mm : (M,) ray misses.
    relative : (M,) variance of each ray miss due to its pixels, divided by the median of these.
    by_unknowns : (M, K) derivative of the ray misses with respect to the unknowns, in mm.
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
        """Return the rows that are kept; keep : (N,)."""
        return Series(*(getattr(self, column.name)[keep] for column in fields(self)))

    def residuals(self) -> Array:
        """Return the ray misses (M,) in mm minus what a least-squares fit of the unknowns gives."""
        fit = np.linalg.lstsq(self.by_unknowns, self.miss_mm, rcond=None)[0]
        return np.asarray(self.miss_mm - self.by_unknowns @ fit)


@dataclass(frozen=True)
class Noise:
    """The hyper-parameters of the noise of ray misses.

    white_mm : standard deviation of each pair's white noise.
    wander_mm, wander_s : RMS and correlation time of each bubble's Ornstein-Uhlenbeck process, the
        wander of its outline's centre.
    shake : RMS (mm), decay time (s) and frequency (Hz) of each oscillation that all pairs of a
        frame share.
    """

    white_mm: float
    wander_mm: float
    wander_s: float
    shake: tuple[tuple[float, float, float], ...] = ()

    def own(self, lag_s: Array) -> Array:
        """Return the autocovariance (mm^2) of a bubble's wander at the lags (s), in their shape."""
        return np.asarray(self.wander_mm**2 * np.exp(-np.abs(lag_s) / self.wander_s))

    def common(self, lag_s: Array) -> Array:
        """Return the autocovariance (mm^2) of the shake at the lags (s), in their shape.

        The shake is a sum of damped resonators.
        """
        out = np.zeros_like(lag_s)
        for rms, decay, hz in self.shake:
            lag, turn = np.abs(lag_s), 2 * np.pi * hz
            wave = np.cos(turn * lag) + np.sin(turn * lag) / (turn * decay)
            out += rms**2 * np.exp(-lag / decay) * wave
        return out

    def slopes(self, lag_s: Array) -> tuple[Array, Array]:
        """Return the derivatives of `own` and `common` with respect to the hyper-parameters.

        They are with respect to the logarithms of (wander_mm, wander_s), as (2, L) at L lags, and
        of (RMS, decay time, frequency) of each of n oscillations, as (3 n, L).
        """
        lag, own = np.abs(lag_s), self.own(lag_s)
        common = []
        for rms, decay, hz in self.shake:
            turn = 2 * np.pi * hz
            cos, sin = np.cos(turn * lag), np.sin(turn * lag) / (turn * decay)
            scale = rms**2 * np.exp(-lag / decay)
            by_decay = lag / decay * (cos + sin) - sin
            by_hz = lag / decay * cos - sin - (turn * lag) * (turn * decay) * sin
            common += [2 * scale * (cos + sin), scale * by_decay, scale * by_hz]
        return np.array([2 * own, own * lag / self.wander_s]), np.reshape(common, (-1, len(lag)))

    def covariance(self, series: Series) -> Array:
        """Return the covariance (M, M) in mm^2 of M ray misses for fixed unknowns."""
        t, index = np.unique(series.t_s, return_inverse=True)
        at = np.ix_(index, index)
        lag = t[:, None] - t
        same = series.bubble[:, None] == series.bubble
        out = self.common(lag)[at] + np.where(same, self.own(lag)[at], 0.0)
        out[np.diag_indices(len(out))] += self.white_mm**2 * series.relative
        return np.asarray(out)


@dataclass(frozen=True)
class _Spectrum:
    """A tapered periodogram from bin `_FIRST_BIN` on, and what is needed for its expectation.

    overlap : autocorrelation of the taper.
    common, single : shares of the shake's and of a single bubble's variance in the series.
    """

    power: Array
    step_s: float
    overlap: Array
    common: float
    single: float

    def expected(self, noise: Noise) -> Array:
        """Return the expectation of the periodogram, which includes leakage and aliasing."""
        covariance = self.common * noise.common(self._lag_s) + self.single * noise.own(self._lag_s)
        covariance[0] += self.single * noise.white_mm**2
        turned = covariance * self.overlap
        density = 2 * np.fft.rfft(turned).real - turned[0]
        return np.asarray(density[self._bins].clip(1e-18))

    @property
    def _lag_s(self) -> Array:
        return np.asarray(np.arange(len(self.overlap)) * self.step_s, np.float64)

    @property
    def _bins(self) -> slice:
        return slice(_FIRST_BIN, _FIRST_BIN + len(self.power))

    def cost(self, noise: Noise) -> tuple[float, Array]:
        """Return the negative debiased Whittle log-likelihood, and its derivative by logarithms.

        Sykulski et al., Biometrika 106:251, 2019.
        """
        density = self.expected(noise)
        cost = float(_INDEPENDENT * (np.log(density) + self.power / density).sum())
        by_density = np.zeros(len(self.overlap))
        by_density[self._bins] = _INDEPENDENT * (1 - self.power / density) / density
        by_covariance = 2 * np.fft.fft(by_density).real * self.overlap
        by_covariance[0] /= 2
        own, common = noise.slopes(self._lag_s)
        white = self.single * 2 * noise.white_mm**2 * by_covariance[0]
        rest = np.concatenate([self.single * own, self.common * common]) @ by_covariance
        return cost, np.concatenate([[white], rest])


def learned_noise(parts: list[Series]) -> Noise:
    """Return the most probable noise model of the ray misses of a run.

    parts : stretches of the run; the spectra of their residuals are used. At most two oscillations
    (one for the arm of each camera) are added, as long as each raises the log posterior by
    `_LEAST_LOG_RATIO`.
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
    from scipy.optimize import minimize

    def cost(log: Array) -> tuple[float, Array]:
        noise, off = _noise(log), (log - prior[0]) / prior[1]
        costs, slopes = zip(*(s.cost(noise) for s in spectra))
        return 0.5 * float(off @ off) + sum(costs), np.sum(slopes, axis=0) + off / prior[1]

    box = [(s - 8.0, s + 4.0) for s in start]
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=box, options={"maxiter": 60})
    return np.asarray(found.x), float(found.fun)


def _noise(log: Array) -> Noise:
    white, wander, tau, *rest = (float(v) for v in np.exp(log))
    return Noise(white, wander, tau, tuple(zip(rest[0::3], rest[1::3], rest[2::3])))


def _spectra(part: Series) -> list[_Spectrum]:
    """Return spectra of each frame's mean ray miss, and of single bubbles' deviations from it.

    Those of the mean come first, the longest of them before the others.
    """
    left = part.residuals()
    t, index = np.unique(part.t_s, return_inverse=True)
    count = np.bincount(index)
    mean = np.bincount(index, left) / count
    out = [
        _spectrum(t[some], mean[some], 1.0, float((1 / count[some]).mean()))
        for some in _without_gaps(t)
    ]
    apart = left - mean[index]
    bubbles, seen = np.unique(part.bubble, return_counts=True)
    for bubble in bubbles[np.argsort(-seen)][:_MOST_APART] if count.max() > 1 else ():
        mine = np.flatnonzero((part.bubble == bubble) & (count[index] > 1))
        for some in _without_gaps(part.t_s[mine]):
            rows = mine[some]
            rest = float((1 - 1 / count[index[rows]]).mean())
            out.append(_spectrum(part.t_s[rows], apart[rows], 0.0, rest))
    return out


def _without_gaps(t_s: Array) -> list[Ints]:
    """Return the places of increasing times (N,) between which there is no gap, the longest part
    first, without short ones.

    Bubbles that come one by one leave gaps that are longer than the time in which they are seen:
    interpolated, these would have neither the noise of a pixel nor its frequencies.
    """
    parts = [some for some in parts_without_gaps(t_s) if len(some) >= _LEAST_FRAMES]
    return sorted(parts, key=len, reverse=True)


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
    """Return frequencies (Hz) apart that exceed the noise model's spectrum most."""
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
    """Return what a stretch of M ray misses says about the K unknowns.

    Returns the matrix (K, K) and right-hand side (K,) of the normal equations, without the prior,
    and the leave-one-out residuals (M,) in standard deviations, for the unknowns that fit this
    stretch best.
    """
    from scipy.linalg import cho_solve, cholesky

    lower = cholesky(noise.covariance(series), lower=True, check_finite=False)
    inverse = cho_solve((lower, True), np.eye(len(lower)), check_finite=False)
    matrix = series.by_unknowns.T @ inverse @ series.by_unknowns
    right = series.by_unknowns.T @ (inverse @ series.miss_mm)
    best = np.linalg.solve(matrix + np.eye(len(matrix)), right)
    off = inverse @ (series.miss_mm - series.by_unknowns @ best)
    return matrix, right, off / np.sqrt(np.diagonal(inverse))
