"""Compiled smoother of `backtracking`."""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array
from telerig.compiled import compiled


@compiled
def smooth(
    measured: Array,
    covariance: Array,
    matrices: Array,
    noises: Array,
    offsets: Array,
    start: Array,
    spread: Array,
) -> tuple[Array, Array]:
    """Return the smoothed points (F, K, 3) of K tracks and their covariances (F, K, 3, 3).

    Fixed-interval smoother of Rauch, Tung and Striebel (AIAA J. 3:1445, 1965).

    measured, covariance : (F, K, 3), (F, K, 3, 3) points and their noise; NaN for none.
    matrices, noises, offsets : (F, n, n), (F, n, n), (F, n) motion into each frame.
    start, spread : (K, n), (n, n) states before the first frame's measurements, and covariance.
    """
    frames, tracks, n = len(measured), measured.shape[1], len(spread)
    points, covariances = np.empty((frames, tracks, 3)), np.empty((frames, tracks, 3, 3))
    before, x = np.empty((frames, n)), np.empty((frames, n))
    before_p, p = np.empty((frames, n, n)), np.empty((frames, n, n))
    for t in range(tracks):
        for f in range(frames):
            if f == 0:
                before[f], before_p[f] = start[t], spread
            else:
                before[f] = matrices[f] @ x[f - 1] + offsets[f]
                before_p[f] = matrices[f] @ p[f - 1] @ matrices[f].T + noises[f]
            x[f], p[f] = before[f], before_p[f]
            if np.isnan(measured[f, t, 0]):
                continue
            beside = before_p[f, :3]
            total = np.ascontiguousarray(beside[:, :3]) + covariance[f, t]
            gain = np.linalg.solve(total, beside).T
            x[f] += gain @ (measured[f, t] - before[f, :3])
            p[f] -= gain @ beside
        for f in range(frames - 2, -1, -1):
            gain = np.linalg.solve(before_p[f + 1], matrices[f + 1] @ p[f]).T
            x[f] += gain @ (x[f + 1] - before[f + 1])
            p[f] += gain @ (p[f + 1] - before_p[f + 1]) @ gain.T
        points[:, t], covariances[:, t] = x[:, :3], p[:, :3, :3]
    return points, covariances
