"""Tests the residuals: autocorrelation of the pixels' residuals, spectra of the accelerometers.

Because the fit absorbs part of the noise, even a right model leaves residuals that are smaller than
the noise and correlated in time. The pixels' residuals are therefore compared with the draws of a
right model (`graph.draws`), by sums that the pieces of a long run add up to.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from telerig.arrays import Array, Bools
from telerig.estimator.smoothing.graph.draws import Draws
from telerig.estimator.smoothing.graph.linear import accelerometers, sensed_directions
from telerig.estimator.smoothing.graph.solve import Solution

LAGS = 10
_LEAST_PAIRS = 25
_BLOCK = 50
"""Frames whose sums count as independent of those of others; what they have in common, the pairs
across their ends, is a tenth of them."""

_SIGNIFICANT_P = 1e-3
_LONGEST_SEGMENT, _MOST_BINS = 2048, 120


@dataclass(frozen=True)
class Lagged:
    """Sums of products of a bubble's residuals some frames apart, of one camera.

    pairs : (LAGS + 1,) number of the products at lags of 0 to `LAGS` frames.
    seen, expected : (LAGS + 1,) their sums, and the means of these over draws of a right model.
    covariance : (LAGS + 1, LAGS + 1) of ``seen`` less ``expected`` for a right model.
    degrees : degrees of freedom of ``covariance``.
    """

    pairs: Array
    seen: Array
    expected: Array
    covariance: Array
    degrees: int

    def __add__(self, other: Lagged) -> Lagged:
        return Lagged(*(getattr(self, name) + getattr(other, name) for name in vars(self)))

    def compared(self) -> dict[str, Any]:
        """Return the autocorrelation, the expected one, and a test; {} for too few frames.

        ``autocorrelation`` is that of a bubble's whitened residuals at lags of 1 to 10 frames. The
        test is Hotelling's (Ann. Math. Stat. 2:360, 1931); ``verdict`` is "correlated" where p is
        below 0.001, else "as expected".
        """
        from scipy.stats import f as fisher

        rest = self.degrees - LAGS + 1
        if self.pairs.min() < _LEAST_PAIRS or rest < 1:
            return {}
        seen, expected = self.seen / self.pairs, self.expected / self.pairs
        rho = expected[1:] / expected[0]
        turn = np.column_stack([-rho, np.eye(LAGS)]) / self.pairs
        off = turn @ self.seen
        distance = float(off @ np.linalg.solve(turn @ self.covariance @ turn.T, off))
        p = float(fisher.sf(distance * rest / (LAGS * self.degrees), LAGS, rest))
        return {
            "autocorrelation": (seen[1:] / seen[0]).tolist(),
            "expected": rho.tolist(),
            "rms_sigmas": float(np.sqrt(seen[0] / 2)),
            "expected_rms_sigmas": float(np.sqrt(expected[0] / 2)),
            "hotelling": distance,
            "lags": LAGS,
            "p": p,
            "verdict": "as expected" if p > _SIGNIFICANT_P else "correlated",
        }


def lagged(solution: Solution, draws: Draws, own: Bools) -> dict[str, Lagged]:
    """Return the sums by camera.  own : (M,) which detections count; rejected ones do not."""
    graph, observed = solution.graph, solution.graph.problem.observations
    own = own & (solution.weights[0] > 0.5)
    rows, out = graph.row(observed.item, observed.frame), {}
    for index, camera in enumerate(graph.problem.cameras):
        mine = np.flatnonzero(own & (observed.camera == index))
        if not len(mine):
            continue
        both = np.concatenate([solution.residuals[0][mine, :, None], draws.pixels[mine]], -1)
        at = np.full(graph.rows + LAGS, -1)
        at[rows[mine]] = np.arange(len(mine))
        block = observed.frame[mine] // _BLOCK
        block -= block.min()
        total = np.zeros((int(block.max()) + 1, LAGS + 1, both.shape[-1]))
        pairs = np.zeros(LAGS + 1)
        for lag in range(LAGS + 1):
            later = at[rows[mine] + lag]
            there = (later >= 0) & (observed.item[mine] == observed.item[mine][later])
            pairs[lag] = np.count_nonzero(there)
            np.add.at(total[:, lag], block[there], (both[there] * both[later[there]]).sum(1))
        drawn = total[..., 1:]
        mean, count = drawn.mean(-1), drawn.shape[-1]
        off = drawn - mean[..., None]
        spread = np.einsum("blk,bmk->lm", off, off) * (1 + 1 / count) / max(count - 1, 1)
        degrees = np.count_nonzero(total[:, 0, 0]) * (count - 1)
        out[camera.name] = Lagged(pairs, total[..., 0].sum(0), mean.sum(0), spread, degrees)
    return out


def accelerometer_spectra(solution: Solution) -> dict[str, Any]:
    """Return power spectral densities by sensor, one-sided, (m/s^2)^2/Hz.

    ``reading``, ``residual`` and ``noise`` are sums over the directions in which the motion of the
    sensor's mount is modelled.
    """
    graph, state = solution.graph, solution.state
    out: dict[str, Any] = {}
    for index, linear in enumerate(accelerometers(graph, state, solution.sample_weights)):
        sensor = graph.problem.accelerometers[index]
        if len(sensor.t_s) < LAGS:
            continue
        project, _ = sensed_directions(graph, index)
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
    """Return Welch's estimate, summed over columns and averaged in up to 120 bands."""
    from scipy.signal import welch

    length = min(len(values), _LONGEST_SEGMENT)
    frequency, each = welch(values - values.mean(0), rate_hz, nperseg=length, axis=0)
    total = each.sum(-1)[1:]
    edges = np.unique(np.geomspace(1, len(total) + 1, _MOST_BINS + 1).astype(np.int64)) - 1
    share = np.diff(edges)
    means = [np.add.reduceat(a, edges[:-1]) / share for a in (frequency[1:], total)]
    return np.asarray(means[0]), np.asarray(means[1])
