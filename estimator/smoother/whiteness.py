"""Is anything left in the residuals? Autocorrelation of pixels, spectra of accelerometers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoother.linear_sensors import accelerometers, felt
from telerig.estimator.smoother.solve import Solution

Array = NDArray[np.float64]

LAGS = 10
_LEAST_PAIRS = 50
_SURE = 1e-3
_SLIGHT = 0.15
_LONGEST_SEGMENT = 2048
_MOST_BINS = 120


def pixel_whiteness(solution: Solution) -> dict[str, Any]:
    """By camera, of the bubbles' kept pixels: autocorrelation, Ljung-Box test, a word.

    Residuals of one bubble a number of frames apart, both coordinates, in sigmas. The fit takes up
    the slow part of the noise, which leaves small negative correlations in what is right: "white"
    where the test does not object, "nearly white" where it does to correlations below 0.15 (long
    runs make the test sharp), else "correlated". Ljung and Box, Biometrika 65:297, 1978.
    """
    from scipy.stats import chi2

    problem = solution.frame.problem
    obs, kept = problem.observations, solution.weights[0] > 0.5
    out: dict[str, Any] = {}
    for c, camera in enumerate(problem.cameras):
        mine = kept & (obs.camera == c)
        table = _table(solution.residuals[0][mine], obs.item[mine], obs.frame[mine])
        found = [_lagged(table, lag) for lag in range(1, LAGS + 1)]
        if min(pairs for _, pairs in found) < _LEAST_PAIRS:
            continue
        rho = np.array([r for r, _ in found])
        count = int(2 * mine.sum())
        terms = count * (count + 2) * rho**2 / (count - np.arange(1, LAGS + 1))
        p = float(chi2.sf(terms.sum(), LAGS))
        largest = float(np.abs(rho).max())
        slight = "nearly white" if largest < _SLIGHT else "correlated"
        out[camera.name] = {
            "autocorrelation": rho.tolist(),
            "ljung_box": float(terms.sum()),
            "lags": LAGS,
            "p": p,
            "verdict": "white" if p > _SURE else slight,
        }
    return out


def _table(residuals: Array, item: NDArray[np.int64], frame: NDArray[np.int64]) -> Array:
    """(items, frames, 2), NaN where there is none, about each bubble's mean."""
    if not len(item):
        return np.zeros((0, 0, 2))
    items, row = np.unique(item, return_inverse=True)
    table = np.full((len(items), int(np.ptp(frame)) + 1, 2), np.nan)
    table[row.reshape(-1), frame - frame.min()] = residuals
    return np.asarray(table - np.nanmean(table, axis=1, keepdims=True))


def _lagged(table: Array, lag: int) -> tuple[float, int]:
    """Autocorrelation over all pairs that far apart, and their number."""
    if table.shape[1] <= lag:
        return 0.0, 0
    product = table[:, lag:] * table[:, :-lag]
    pairs = int(np.isfinite(product).sum())
    variance = float(np.nanmean(table**2))
    return (float(np.nanmean(product)) / variance if pairs and variance > 0 else 0.0), pairs


def accelerometer_spectra(solution: Solution) -> dict[str, Any]:
    """By sensor: one-sided densities, (m/s^2)^2/Hz, of readings and of what the model leaves.

    Summed over the directions in which its mount's motion is modelled; ``noise`` as stated.
    """
    frame, state = solution.frame, solution.state
    out: dict[str, Any] = {}
    for index, linear in enumerate(accelerometers(frame, state)):
        sensor = frame.problem.accelerometers[index]
        if len(sensor.t_s) < LAGS:
            continue
        project, _ = felt(frame, index)
        unit = sensor.sigma_mm_s2 / 1000
        rate = 1 / float(np.median(np.diff(sensor.t_s)))
        frequency, before = _density(unit * sensor.reading_mm_s2 @ project.T, rate)
        _, after = _density(unit * linear.rhs, rate)
        out[sensor.name] = {
            "frequency_hz": frequency.tolist(),
            "reading": before.tolist(),
            "residual": after.tolist(),
            "noise": float(2 * len(project) * unit**2 / rate),
        }
    return out


def _density(values: Array, rate_hz: float) -> tuple[Array, Array]:
    """Welch's estimate, columns summed, averaged into bands where there are many bins."""
    from scipy.signal import welch

    length = min(len(values), _LONGEST_SEGMENT)
    frequency, each = welch(values - values.mean(0), rate_hz, nperseg=length, axis=0)
    total = each.sum(-1)[1:]
    edges = np.unique(np.geomspace(1, len(total) + 1, _MOST_BINS + 1).astype(np.int64)) - 1
    share = np.diff(edges)
    means = [np.add.reduceat(a, edges[:-1]) / share for a in (frequency[1:], total)]
    return np.asarray(means[0]), np.asarray(means[1])
