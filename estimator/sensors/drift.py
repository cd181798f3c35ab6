"""Finds the drift of a clock: a straight line through its offsets in parts of a run.

A single part may fit best at a lag that is wrong by one period of the shake. The line is therefore
the one with the largest sum of the parts' log-likelihood ratios.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from telerig.arrays import Array
from telerig.estimator.sensors.alignment import Alignment, refined

LEAST_PARTS = 3
_REACH = 2
"""So many lags from the best line, each part has its own peak."""


def drift_of(
    middle_s: Array, parts: Sequence[Alignment], step_s: float, most: float
) -> tuple[float, float, float] | None:
    """Return offset and drift of a clock from alignments of K parts of a run.

    middle_s : (K,) middle time of each part.
    parts : K alignments, whose lags are multiples of ``step_s``.
    most : largest absolute drift.

    Returns the offset (s) at the mean of ``middle_s``, the drift, and the standard deviation of the
    drift; None if no line fits all parts.
    """
    if len(parts) < LEAST_PARTS:
        return None
    tau = middle_s - middle_s.mean()
    count = int(most * np.abs(tau).max() / step_s)
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
    if len(places) < LEAST_PARTS:
        return None
    design = np.stack([np.ones(len(places)), places], -1) / np.array(sds)[:, None]
    normal = np.linalg.inv(design.T @ design)
    offset, drift = normal @ design.T @ (np.array(offsets) / sds)
    return float(offset), float(drift), float(np.sqrt(normal[1, 1]))
