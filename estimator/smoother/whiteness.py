"""Is anything left in the residuals? Autocorrelation of pixels, spectra of accelerometers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoother.linear_sensors import accelerometers, felt
from telerig.estimator.smoother.residual_draws import drawn_residuals
from telerig.estimator.smoother.solve import Solution

Array = NDArray[np.float64]

LAGS = 10
_LEAST_PAIRS, _LEAST_DRAWN = 25, 10
_DRAWS = 8, 32
_SURE = 1e-3
_SLIGHT = 0.04
_LONGEST_SEGMENT = 2048
_MOST_BINS = 120


def pixel_whiteness(solution: Solution) -> dict[str, Any]:
    """By camera, of the bubbles' kept pixels: autocorrelation beside the model's, a test, a word.

    Residuals of one bubble a number of frames apart, both coordinates, in sigmas. The fit follows
    part of the noise, so that those of a right model are not white; ``expected`` is drawn from the
    model. "as expected" where a test of the difference does not object, "nearly" where it does to
    little (long runs make it sharp: chi-square below 0.04 a value), else "correlated".
    """
    obs, kept = solution.frame.problem.observations, solution.weights[0] > 0.5
    if not kept.any():
        return {}
    draws = int(np.clip(kept.sum() / 100, *_DRAWS))
    middle = int(np.median(obs.frame[kept]))
    drawn = drawn_residuals(solution, middle, draws, np.random.default_rng(0))
    out: dict[str, Any] = {}
    for c, camera in enumerate(solution.frame.problem.cameras):
        mine, (which, residuals) = np.flatnonzero(kept & (obs.camera == c)), drawn[c]
        here, there = ((obs.item[i], obs.frame[i]) for i in (mine, which))
        seen = _lagged(solution.residuals[0][mine], *here, _LEAST_PAIRS)
        each = [_lagged(r, *there, _LEAST_DRAWN) for r in np.moveaxis(residuals, -1, 0)]
        if seen is not None and each and all(e is not None for e in each):
            model = np.mean(np.array(each), 0)
            out[camera.name] = _compared(seen, model, len(mine), len(which) * draws)
    return out


def _compared(seen: Array, model: Array, count: int, drawn: int) -> dict[str, Any]:
    """Mean products (2, LAGS + 1) of both coordinates of so many pixels, and of the model's."""
    from scipy.stats import chi2

    rho, expected = seen.sum(0) / seen[:, 0].sum(), model.sum(0) / model[:, 0].sum()
    share = model[:, 0] / model[:, 0].sum()
    covariance = sum(s**2 * bartlett(m[1:] / m[0]) for s, m in zip(share, model))
    covariance = covariance * (1 / count + 1 / drawn)
    off = (rho - expected)[1:]
    distance = float(off @ np.linalg.solve(covariance, off))
    p = float(chi2.sf(distance, LAGS))
    slight = "nearly" if distance < _SLIGHT * 2 * count else "correlated"
    return {
        "autocorrelation": rho[1:].tolist(),
        "expected": expected[1:].tolist(),
        "rms_sigmas": float(np.sqrt(seen[:, 0].mean())),
        "expected_rms_sigmas": float(np.sqrt(model[:, 0].mean())),
        "chi_square": distance,
        "lags": LAGS,
        "p": p,
        "verdict": "as expected" if p > _SURE else slight,
    }


def bartlett(rho: Array) -> Array:
    """(L, L) covariance, times the number of values, of autocorrelations at lags 1 to L.

    rho : (L,) the true ones, zero beyond. Bartlett, J. R. Stat. Soc. Suppl. 8:27, 1946.
    """
    count = len(rho)
    whole = np.zeros(6 * count + 1)
    middle = 3 * count
    whole[middle] = 1.0
    whole[middle + 1 : middle + count + 1] = whole[middle - count : middle][::-1] = rho
    k = np.arange(-2 * count, 2 * count + 1)
    lag = np.arange(1, count + 1)
    after, before = whole[middle + k + lag[:, None]], whole[middle + k - lag[:, None]]
    here = whole[middle + k]
    crossed = np.outer(after @ here, rho)
    return np.asarray(
        after @ after.T + before @ after.T + 2 * np.outer(rho, rho) * (here @ here)
        - 2 * crossed - 2 * crossed.T
    )  # fmt: skip


def _lagged(
    residuals: Array, item: NDArray[np.int64], frame: NDArray[np.int64], least: int
) -> Array | None:
    """(2, LAGS + 1) mean products of residuals (m, 2) so many frames apart; None of too few."""
    if not len(item):
        return None
    items, row = np.unique(item, return_inverse=True)
    table = np.zeros((len(items), int(np.ptp(frame)) + 1, 2))
    there = np.zeros(table.shape[:2], bool)
    at = row.reshape(-1), frame - frame.min()
    table[at], there[at] = residuals, True
    table -= (table.sum(1) / there.sum(1)[:, None])[:, None]
    table[~there] = 0.0
    out = np.zeros((2, LAGS + 1))
    for lag in range(LAGS + 1):
        last = table.shape[1] - lag
        pairs = int((there[:, lag:] & there[:, :last]).sum()) if last > 0 else 0
        if pairs < least:
            return None
        out[:, lag] = (table[:, lag:] * table[:, :last]).sum((0, 1)) / pairs
    return out


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
