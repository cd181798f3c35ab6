"""Tests the residuals: autocorrelation of the pixels' residuals, spectra of the accelerometers.

Because the fit absorbs part of the noise, even a right model leaves residuals that are smaller than
the noise and correlated in time. The pixels' residuals are therefore compared with residuals drawn
for a right model, in a part of the run. With A the whitened factors and e ~ N(0, I) these are
(I - A (A^T A)^-1 A^T) e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator

from telerig.arrays import Array, Ints
from telerig.estimator.smoothing.graph.layout import GraphLayout
from telerig.estimator.smoothing.graph.linear import (
    accelerometers,
    all_factors,
    sensed_directions,
)
from telerig.estimator.smoothing.graph.solve import Solution
from telerig.factors.linear_factors import LinearFactors

LAGS = 10
_LEAST_PAIRS = 25
_DRAWS = 32
_SIGNIFICANT_P = 1e-3
_LONGEST_SEGMENT, _MOST_BINS = 2048, 120
_HALF_FRAMES, _EDGE = (100, 50, 30, 20), 12
_MOST_BAND = 1e6
_RIDGE = 1e-9
"""Of the diagonal: the smooth prior of a broad band has fewer digits than double precision. Single
residuals move by some hundredths of a standard deviation, their variance by less than 0.001."""


def pixel_whiteness(solution: Solution) -> dict[str, Any]:
    """Return by camera the autocorrelation of the pixel residuals, the expected one, and a test.

    ``autocorrelation`` is that of a bubble's whitened residuals at lags of 1 to 10 frames.
    ``expected`` and the covariance of the test (Hotelling, Ann. Math. Stat. 2:360, 1931) come from
    random draws of the model. ``verdict`` is "correlated" where p is below 0.001, else "as
    expected". The result is empty for few frames, and for more bubbles at once than the draws can
    hold.
    """
    obs, kept = solution.graph.problem.observations, solution.weights[0] > 0.5
    if not kept.any():
        return {}
    middle = int(np.sort(obs.frame[kept])[np.count_nonzero(kept) // 2])
    stretch = stretch_of(solution.graph, middle)
    if stretch is None or stretch.inner[1] - stretch.inner[0] <= LAGS:
        return {}
    try:
        drawn = drawn_residuals(solution, stretch, _DRAWS, np.random.default_rng(0))
    except np.linalg.LinAlgError:
        return {}
    out: dict[str, Any] = {}
    for camera, (which, residuals) in zip(solution.graph.problem.cameras, drawn):
        both = np.concatenate([solution.residuals[0][which][..., None], residuals], -1)
        found = _lagged(both, obs.item[which], obs.frame[which])
        if found is not None:
            out[camera.name] = _compared(found[0], found[1:])
    return out


def _compared(seen: Array, model: Array) -> dict[str, Any]:
    """Compare mean products by lag: (LAGS + 1,) of the residuals, (K, LAGS + 1) of K draws."""
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
        "verdict": "as expected" if p > _SIGNIFICANT_P else "correlated",
    }


def _lagged(residuals: Array, item: Ints, frame: Ints) -> Array | None:
    """Return mean products (K, LAGS + 1) by lag of K sets of residuals (m, 2, K).

    item, frame : (m,) bubble and frame of each residual.

    Returns None if a lag has less than 25 pairs.
    """
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


@dataclass(frozen=True)
class Stretch:
    """Consecutive frames whose states are drawn, while all other states are held fixed.

    graph : layout of the whole run.
    column : (keys,) first column of each state of shake and bubbles; -1 if it is fixed.
    size : number of columns.
    inner : first and last frame that are far enough from fixed states.
    """

    graph: GraphLayout
    column: Ints
    size: int
    inner: tuple[int, int]

    def columns(self, linear: LinearFactors) -> Ints:
        """Return the first column of each factor's blocks in the stacked Jacobian.

        The result is (M, K) for M factors of K variables each; it is -1 where a variable is held
        constant.
        """
        count = len(linear.rhs)
        moving = len(self.column)
        out = np.full((count, len(linear.keys)), -1)
        for i, (key, block) in enumerate(zip(linear.keys, linear.blocks)):
            keys = np.broadcast_to(np.asarray(key, np.int64), (count,))
            mine = (keys < moving) & (block.shape[-1] > 0)
            out[mine, i] = self.column[keys[mine]]
        return out


def stretch_of(graph: GraphLayout, middle: int) -> Stretch | None:
    """Return a stretch of 200 frames about a middle frame, down to 40 frames with many bubbles.

    Returns None if even 40 frames have too many states.
    """
    (nodes, shake), (_, bubble) = graph.counts()[:2]
    when = np.r_[np.arange(nodes), graph.node_of_row]
    sizes = np.repeat([shake, bubble], [nodes, graph.rows])
    count = len(graph.problem.t_s)
    for half in _HALF_FRAMES:
        first = int(np.clip(middle - half, 0, max(count - 2 * half, 0)))
        last = min(first + 2 * half, count) - 1
        low, high = graph.nodes.of_frame[[first, last]]
        inside = (when >= low) & (when <= high) & (sizes > 0)
        at_once = int(np.bincount(when[nodes:][inside[nodes:]], minlength=1).max())
        width = 2 * (shake + bubble * at_once)
        if 0 < int(sizes[inside].sum()) * width <= _MOST_BAND:
            break
    else:
        return None
    order = np.flatnonzero(inside)[np.argsort(when[inside], kind="stable")]
    starts = np.r_[0, np.cumsum(sizes[order])]
    column = np.full(len(when), -1)
    column[order] = starts[:-1]
    inner = (first + _EDGE * (first > 0), last - _EDGE * (last < count - 1))
    return Stretch(graph, column, int(starts[-1]), inner)


def drawn_residuals(
    solution: Solution, stretch: Stretch, draws: int, rng: Generator
) -> list[tuple[Ints, Array]]:
    """Draw random pixel residuals for each camera as a right model leaves them.

    draws : the number K of random draws.

    Returns for each camera the indices (m,) of its detections of bubbles among the observations of
    the problem, and their whitened residuals (m, 2, K). They are the detections in the inner part
    of the stretch that the fit has not rejected.

    Raises numpy.linalg.LinAlgError if a matrix is singular in floating point.
    """
    graph, observed = solution.graph, solution.graph.problem.observations
    factors = all_factors(graph, solution.state, solution.weights, solution.sample_weights)
    parts = [_Part.of(stretch, f) for f in factors]
    noise = [rng.standard_normal((*p.block.shape[:2], draws)) for p in parts]
    found = _fitted(stretch, parts, noise)
    inside = (observed.frame >= stretch.inner[0]) & (observed.frame <= stretch.inner[1])
    inside &= solution.weights[0] > 0.5
    pixels = iter(i for i, p in enumerate(parts) if p.of_bubbles)
    out = []
    for c in range(len(graph.problem.cameras)):
        mine = np.flatnonzero(observed.camera == c)
        residual = np.zeros((0, 2, draws))
        if len(mine):
            i = next(pixels)
            mine = mine[parts[i].which]
            residual = noise[i] - parts[i].block @ found[parts[i].column]
        out.append((mine[inside[mine]], residual[inside[mine]]))
    return out


@dataclass(frozen=True)
class _Part:
    """Factors (m,) of one kind that involve a stretch.

    which : (m,) indices of the factors.
    block : (m, rows, columns) derivatives, 0 where the state is fixed.
    column : (m, columns) columns of the stretch.
    of_bubbles : whether they are detections of bubbles.
    """

    which: Ints
    block: Array
    column: Ints
    of_bubbles: bool

    @classmethod
    def of(cls, stretch: Stretch, linear: LinearFactors) -> _Part:
        base, key = stretch.graph.base(), int(np.min(linear.keys[0]))
        of_bubbles = linear.weight is not None and base.bubbles <= key < base.means
        first = stretch.columns(linear)
        reached = first[:, 0] >= 0 if of_bubbles else np.any(first >= 0, axis=1)
        which = np.flatnonzero(reached)
        blocks, columns = [], []
        for start, block in zip(first[which].T, linear.blocks):
            if np.any(start >= 0):
                whole = np.broadcast_to(block, (len(linear.rhs), *block.shape[-2:]))[which]
                blocks.append(whole * (start >= 0)[:, None, None])
                columns.append(np.maximum(start, 0)[:, None] + np.arange(block.shape[-1]))
        if not blocks:
            blocks, columns = [np.zeros((0, linear.rhs.shape[1], 0))], [np.zeros((0, 0), np.int64)]
        return cls(which, np.concatenate(blocks, -1), np.concatenate(columns, -1), of_bubbles)


def _fitted(stretch: Stretch, parts: Sequence[_Part], noise: Sequence[Array]) -> Array:
    """Return least-squares solutions (columns, K) of the stretch for K draws of noise."""
    from scipy.linalg import cho_solve_banded, cholesky_banded

    places, values = [np.zeros(0, np.int64)], [np.zeros(0)]
    side = np.zeros((stretch.size, noise[0].shape[-1]))
    for part, one in zip(parts, noise):
        turned = np.swapaxes(part.block, -1, -2)
        gram = turned @ part.block
        below = part.column[:, :, None] - part.column[:, None]
        there = (below >= 0) & (gram != 0)
        right = np.broadcast_to(part.column[:, None], below.shape)
        places.append(below[there] * stretch.size + right[there])
        values.append(gram[there])
        np.add.at(side, part.column, turned @ one)
    place = np.concatenate(places)
    rows = int(place.max(initial=0)) // stretch.size + 1
    band = np.bincount(place, np.concatenate(values), rows * stretch.size).reshape(rows, -1)
    band[0] *= 1 + _RIDGE
    return np.asarray(cho_solve_banded((cholesky_banded(band, lower=True), True), side))
