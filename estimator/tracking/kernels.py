"""Compiled loops over tracks and measurements; see `backtracking` and `association`."""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array
from telerig.compiled import compiled

_NOTHING = 1e-13
"""Share of an information matrix below which a pivot is rounding error."""


@compiled
def _rows(information: Array, pull: Array, rows: Array, values: Array) -> None:
    """Write up to three measurements of a point with unit noise: ``rows`` (3, 3), ``values`` (3,).

    They have the given information (3, 3) and pull (3,), of any rank (Cholesky's decomposition).
    """
    least = _NOTHING * (information[0, 0] + information[1, 1] + information[2, 2])
    for i in range(3):
        values[i] = 0.0
        for j in range(3):
            rows[i, j] = 0.0
        pivot, value = information[i, i], pull[i]
        for k in range(i):
            pivot -= rows[k, i] * rows[k, i]
            value -= rows[k, i] * values[k]
        if pivot <= least:
            continue
        root = np.sqrt(pivot)
        values[i] = value / root
        for j in range(i, 3):
            entry = information[i, j]
            for k in range(i):
                entry -= rows[k, i] * rows[k, j]
            rows[i, j] = entry / root


@compiled
def _product(left: Array, right: Array, out: Array) -> None:
    for i in range(left.shape[0]):
        for j in range(right.shape[1]):
            out[i, j] = 0.0
        for k in range(left.shape[1]):
            if left[i, k] != 0.0:  # most entries of a motion's matrix are 0
                for j in range(right.shape[1]):
                    out[i, j] += left[i, k] * right[k, j]


@compiled
def _divide(matrix: Array, right: Array) -> None:
    """Replace ``right`` (n, m) by inverse(matrix) @ right; ``matrix`` is used up."""
    n = len(matrix)
    for i in range(n):
        for j in range(i + 1):
            entry = matrix[i, j]
            for k in range(j):
                entry -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(entry) if i == j else entry / matrix[j, j]
    for turn in range(2):
        for step in range(n):
            i = step if turn == 0 else n - 1 - step
            for k in range(0 if turn == 0 else i + 1, i if turn == 0 else n):
                factor = matrix[i, k] if turn == 0 else matrix[k, i]
                for j in range(right.shape[1]):
                    right[i, j] -= factor * right[k, j]
            for j in range(right.shape[1]):
                right[i, j] /= matrix[i, i]


@compiled
def smooth(
    information: Array,
    pull: Array,
    matrices: Array,
    noises: Array,
    offsets: Array,
    start: Array,
    spread: Array,
) -> tuple[Array, Array]:
    """Return the smoothed points (F, K, 3) of K tracks and their covariances (F, K, 3, 3).

    Fixed-interval smoother of Rauch, Tung and Striebel (AIAA J. 3:1445, 1965), whose measurements
    are scalars, one after the other.

    information, pull : (F, K, 3, 3), (F, K, 3) as in `backtracking.Readings`.
    matrices, noises, offsets : (F, n, n), (F, n, n), (F, n) motion into each frame.
    start, spread : (K, n), (n, n) states before the first frame's measurements, and covariance.
    """
    frames, tracks, n = len(pull), pull.shape[1], len(spread)
    points, covariances = np.empty((frames, tracks, 3)), np.empty((frames, tracks, 3, 3))
    states, spreads = np.empty((2, frames, n)), np.empty((2, frames, n, n))
    rows, values, gain = np.empty((3, 3)), np.empty(3), np.empty(n)
    moved, work, apart = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for t in range(tracks):
        for f in range(frames):
            x, p = states[0, f], spreads[0, f]
            if f > 0:
                _product(matrices[f], spreads[0, f - 1], moved)
            for i in range(n):
                x[i] = start[t, i] if f == 0 else offsets[f, i]
                for j in range(n):
                    p[i, j] = spread[i, j] if f == 0 else noises[f, i, j]
                    if f > 0 and matrices[f, i, j] != 0.0:
                        x[i] += matrices[f, i, j] * states[0, f - 1, j]
                for j in range(n):
                    if f > 0 and matrices[f, i, j] != 0.0:
                        for k in range(n):
                            p[i, k] += moved[k, j] * matrices[f, i, j]
                states[1, f, i] = x[i]
                for j in range(n):
                    spreads[1, f, i, j] = p[i, j]
            _rows(information[f, t], pull[f, t], rows, values)
            for r in range(3):
                left, variance = values[r], 1.0
                for i in range(n):
                    gain[i] = p[i, 0] * rows[r, 0] + p[i, 1] * rows[r, 1] + p[i, 2] * rows[r, 2]
                for c in range(3):
                    left -= rows[r, c] * x[c]
                    variance += rows[r, c] * gain[c]
                for i in range(n):
                    x[i] += gain[i] * left / variance
                    for j in range(n):
                        p[i, j] -= gain[i] * gain[j] / variance
        for f in range(frames - 1, -1, -1):
            x, p = states[0, f], spreads[0, f]
            if f < frames - 1:
                _product(matrices[f + 1], p, moved)
                for i in range(n):
                    for j in range(n):
                        apart[i, j] = spreads[0, f + 1, i, j] - spreads[1, f + 1, i, j]
                _divide(spreads[1, f + 1], moved)
                _product(apart, moved, work)
                for i in range(n):
                    for k in range(n):
                        x[i] += moved[k, i] * (states[0, f + 1, k] - states[1, f + 1, k])
                        for j in range(n):
                            p[i, j] += moved[k, i] * work[k, j]
            for i in range(3):
                points[f, t, i] = x[i]
                for j in range(3):
                    covariances[f, t, i, j] = p[i, j]
    return points, covariances
