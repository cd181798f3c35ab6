"""Is anything left in the residuals? Autocorrelation of pixels, spectra of accelerometers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.smoothing.graph.linear import accelerometers, sensed_directions
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.estimator.smoothing.verdict.residual_draws import drawn_residuals, stretch_of

Array = NDArray[np.float64]

LAGS = 10
_LEAST_PAIRS = 25
_DRAWS = 32
_SURE = 1e-3
_LONGEST_SEGMENT = 2048
_MOST_BINS = 120


def pixel_whiteness(solution: Solution) -> dict[str, Any]:
    """By camera, of the bubbles' kept pixels: autocorrelation beside the model's, a test, a word.

    Residuals of one bubble a number of frames apart, both coordinates, in sigmas, in a stretch of
    the run. The fit follows part of the noise, so that those of a right model are not white;
    ``expected`` and the test's covariance (Hotelling, Ann. Math. Stat. 2:360, 1931) are drawn from
    the model. "as expected" where the test does not object, else "correlated". Empty where there
    are too few frames, or too much moves in them.
    """
    obs, kept = solution.frame.problem.observations, solution.weights[0] > 0.5
    if not kept.any():
        return {}
    middle = int(np.sort(obs.frame[kept])[np.count_nonzero(kept) // 2])
    stretch = stretch_of(solution.frame, middle)
    if stretch is None or stretch.inner[1] - stretch.inner[0] <= LAGS:
        return {}
    try:
        drawn = drawn_residuals(solution, stretch, _DRAWS, np.random.default_rng(0))
    except np.linalg.LinAlgError:
        return {}
    out: dict[str, Any] = {}
    for camera, (which, residuals) in zip(solution.frame.problem.cameras, drawn):
        both = np.concatenate([solution.residuals[0][which][..., None], residuals], -1)
        found = _lagged(both, obs.item[which], obs.frame[which])
        if found is not None:
            out[camera.name] = _compared(found[0], found[1:])
    return out


def _compared(seen: Array, model: Array) -> dict[str, Any]:
    """Mean products so many frames apart, (LAGS + 1,) of the residuals, (draws, ...) of drawn."""
    from scipy.stats import f as fisher

    rho, drawn = seen[1:] / seen[0], model[:, 1:] / model[:, :1]
    expected, draws = drawn.mean(0), len(drawn)
    off = rho - expected
    covariance = np.cov(drawn.T) * (1 + 1 / draws)
    distance = float(off @ np.linalg.solve(covariance, off))
    p = float(fisher.sf(distance * (draws - LAGS) / (LAGS * (draws - 1)), LAGS, draws - LAGS))
    return {
        "autocorrelation": rho.tolist(),
        "expected": expected.tolist(),
        "rms_sigmas": float(np.sqrt(seen[0])),
        "expected_rms_sigmas": float(np.sqrt(model[:, 0].mean())),
        "hotelling": distance,
        "lags": LAGS,
        "p": p,
        "verdict": "as expected" if p > _SURE else "correlated",
    }


def _lagged(residuals: Array, item: NDArray[np.int64], frame: NDArray[np.int64]) -> Array | None:
    """(K, LAGS + 1) mean products of residuals (m, 2, K) so many frames apart; None of too few."""
    if not len(item):
        return None
    items, row = np.unique(item, return_inverse=True)
    length = int(np.ptp(frame)) + 1
    table = np.zeros((len(items), length, *residuals.shape[1:]))
    there = np.zeros((len(items), length), bool)
    at = row.reshape(-1), frame - frame.min()
    table[at], there[at] = residuals, True
    out = np.zeros((LAGS + 1, residuals.shape[-1]))
    for lag in range(LAGS + 1):
        last = length - lag
        pairs = int((there[:, lag:] & there[:, :last]).sum()) if last > 0 else 0
        if pairs < _LEAST_PAIRS:
            return None
        out[lag] = np.einsum("bfck,bfck->k", table[:, lag:], table[:, :last]) / (2 * pairs)
    return out.T


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
        project, _ = sensed_directions(frame, index)
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
