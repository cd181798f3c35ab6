"""Finds the drift of a clock: a straight line through its offsets in parts of a run.

A single part may fit best at a lag that is wrong by one period of the shake. The line is therefore
the one with the largest sum of the parts' log-likelihood ratios.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from telerig.arrays import Array
from telerig.estimator.sensors.alignment import (
    BEYOND,
    LEAST_LOG_RATIO,
    LEAST_SAMPLES,
    Alignment,
    Channel,
    align,
    refined,
)
from telerig.estimator.sensors.findings import Finding
from telerig.estimator.smoothing.problem.problem import Accelerometer, SmoothingProblem
from telerig.estimator.smoothing.problem.sensor_records import MARGIN_S, near_frames
from telerig.estimator.smoothing.sensor_alignment.clocks import (
    MOST_REFINEMENTS,
    SAME_CLOCK_S,
    aligned_by,
)
from telerig.estimator.smoothing.sensor_alignment.images import Images, readings_on

_LEAST_PARTS = 3
_REACH = 2
"""So many lags from the best line, each part has its own peak."""

_WINDOW_S = 3.0
_MOST_DRIFT = 0.02
"""No clock's rate is off by a larger share."""


def without_drift(
    sensors: Sequence[Accelerometer], group: list[int], problem: SmoothingProblem, images: Images
) -> tuple[Sequence[Accelerometer], list[Finding]]:
    """Correct the drift of a clock if this explains the images clearly better, and by more than
    chance if it is said to be that of the frames."""
    t = problem.t_s
    channels = images.channels(problem, group)

    def log_ratio(some: Sequence[Accelerometer]) -> float:
        """At the offset that fits best, which may lie between two steps of the grid."""
        near, best = [near_frames(s, t) for s in some], -np.inf
        for _ in range(2):
            found = aligned_by(images, channels, near)
            if found is None:
                break
            best = max(best, found.log_ratio)
            near = [replace(s, t_s=s.t_s - found.offset_s) for s in near]
        return best

    best, shared = sensors, any(s.clock == "frames" for s in sensors)
    reached = log_ratio(sensors)
    needed = max(reached + LEAST_LOG_RATIO, BEYOND * reached if shared else -np.inf)
    for _ in range(MOST_REFINEMENTS):
        corrected = _corrected_drift(best, t, channels, images)
        if corrected is None or not (reached := log_ratio(corrected)) > needed:
            break
        best, needed = corrected, reached
    if best is sensors:
        return sensors, []
    words = (
        f"its clock drifts by {best[0].drift_ppm:+.0f} ppm against that of the frames; corrected"
    )
    return best, [Finding(words, f"accelerometer {s.name}") for s in best]


def _corrected_drift(
    sensors: Sequence[Accelerometer],
    t_s: Array,
    channels: Sequence[Channel],
    images: Images,
) -> list[Accelerometer] | None:
    """Return the sensors corrected for the drift of their offsets over the run, or None without
    one.
    """
    length_s, stamps = float(t_s[-1] - t_s[0]), sensors[0].t_s
    windows = max(round(length_s / _WINDOW_S), _LEAST_PARTS)
    edges = np.linspace(t_s[0], t_s[-1], windows + 1)
    middles, found = [], []
    for low, high in pairwise(edges):
        near = (stamps > low - MARGIN_S) & (stamps < high + MARGIN_S)
        first, last = (round((e - t_s[0]) / images.grid.step_s) for e in (low, high))
        grid = replace(images.grid, start_s=t_s[0] + first * images.grid.step_s, count=last - first)
        parts = [
            replace(c, values=c.values[first:last], known=c.known[first:last]) for c in channels
        ]
        if np.count_nonzero(near) < LEAST_SAMPLES:
            continue
        readings = [readings_on(grid, s.of(near)) for s in sensors]
        one = align(grid, parts, readings, SAME_CLOCK_S)
        if one is not None:
            middles.append((low + high) / 2)
            found.append(one)
    line = _line(np.array(middles), found, images.grid.step_s)
    if line is None or abs(line[1]) < line[2]:
        return None
    shift, drift, _ = line
    middle = float(np.mean(middles))
    return [
        replace(
            s, t_s=s.t_s - shift - drift * (s.t_s - middle),
            drift_ppm=s.drift_ppm + float(1e6 * drift), offset_s=s.offset_s + float(shift),
        )
        for s in sensors
    ]  # fmt: skip


def _line(
    middle_s: Array, parts: Sequence[Alignment], step_s: float
) -> tuple[float, float, float] | None:
    """Return offset and drift of a clock from alignments of K parts of a run.

    middle_s : (K,) middle time of each part.
    parts : K alignments, whose lags are multiples of ``step_s``.

    Returns the offset (s) at the mean of ``middle_s``, the drift, and the standard deviation of the
    drift; None if no line fits all parts.
    """
    if len(parts) < _LEAST_PARTS:
        return None
    tau = middle_s - middle_s.mean()
    count = int(_MOST_DRIFT * np.abs(tau).max() / step_s)
    drifts = np.arange(-count, count + 1) * step_s / np.abs(tau).max()
    shifts = np.round(drifts[:, None] * tau / step_s).astype(int)
    first = np.array([round(p.lags_s[0] / step_s) for p in parts])
    pad = count + _REACH
    start = int(first.min()) - pad
    log_ratio = np.zeros(
        (len(parts), max(f + len(p.lags_s) for f, p in zip(first, parts)) + pad - start)
    )
    for row, part, begin in zip(log_ratio, parts, first - start):
        row[begin : begin + len(part.lags_s)] = np.maximum(part.lag_log_ratio, 0.0)
    rows, inner = np.arange(len(parts))[:, None], np.arange(pad, log_ratio.shape[1] - pad)
    totals = [log_ratio[rows, inner + s[:, None]].sum(0) for s in shifts]
    best, lag = np.unravel_index(int(np.argmax(totals)), (len(drifts), len(inner)))
    places, offsets, sds = [], [], []
    for place, row, at in zip(tau, log_ratio, inner[lag] + shifts[best]):
        peak = at - _REACH + int(np.argmax(row[at - _REACH : at + _REACH + 1]))
        shift, sd = refined(row, peak)
        if np.isfinite(sd):
            places.append(place)
            offsets.append((start + peak + shift) * step_s)
            sds.append(sd * step_s)
    if len(places) < _LEAST_PARTS:
        return None
    design = np.stack([np.ones(len(places)), places], -1) / np.array(sds)[:, None]
    normal = np.linalg.inv(design.T @ design)
    offset, drift = normal @ design.T @ (np.array(offsets) / sds)
    return float(offset), float(drift), float(np.sqrt(normal[1, 1]))
