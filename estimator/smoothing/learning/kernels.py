"""The loops of a Kalman filter and of a chain's elimination, compiled."""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array, Ints
from telerig.compiled import compiled


@compiled
def filtered(
    mean: Array, covariance: Array, transition: Array, noise: Array, index: Ints, values: Array,
    variance: Array, squares: Array,
) -> float:  # fmt: skip
    """Return minus the sum of log standard deviations of the innovations of a scalar series.

    Their whitened squares are added to ``squares`` (K,), of each column of the values.

    mean (n, K), covariance (n, n) : of the first state, whose first element is what is measured;
    they are used up.

    transition, noise : (U, n, n) of steps.
    index : (N - 1,) which of them.
    values : (N, K).
    variance : (N,) of their noise; infinite where nothing was measured.
    """
    size, columns = mean.shape
    total = 0.0
    carried = np.empty((size, size))
    ahead = np.empty((size, columns))
    gain = np.empty(size)
    for t in range(len(variance)):
        if t > 0:
            step, extra = transition[index[t - 1]], noise[index[t - 1]]
            for i in range(size):
                for j in range(size):
                    each = 0.0
                    for k in range(size):
                        each += step[i, k] * covariance[k, j]
                    carried[i, j] = each
                for c in range(columns):
                    each = 0.0
                    for k in range(size):
                        each += step[i, k] * mean[k, c]
                    ahead[i, c] = each
            for i in range(size):
                for j in range(i + 1):
                    each = extra[i, j]
                    for k in range(size):
                        each += carried[i, k] * step[j, k]
                    covariance[i, j] = each
                    covariance[j, i] = each
                for c in range(columns):
                    mean[i, c] = ahead[i, c]
        if variance[t] < np.inf:
            expected = covariance[0, 0] + variance[t]
            for i in range(size):
                gain[i] = covariance[i, 0] / expected
            total -= 0.5 * np.log(expected)
            for c in range(columns):
                innovation = values[t, c] - mean[0, c]
                squares[c] += innovation * innovation / expected
                for i in range(size):
                    mean[i, c] += gain[i] * innovation
            for i in range(size):
                for j in range(i + 1):
                    each = covariance[i, j] - gain[i] * gain[j] * expected
                    covariance[i, j] = each
                    covariance[j, i] = each
    return total


@compiled
def factorised(lower: Array, rows: Array) -> int:
    """Factorise a block tridiagonal precision matrix in place, frame by frame.

    lower : (F, D, D) diagonal blocks, replaced by their Cholesky factors L_t.
    rows : (F, S + D, D) right-hand sides, then the blocks below the diagonal, 0 in the last frame;
        both are replaced by what they are times L_t^-T.

    Returns the first frame whose block is not positive definite; -1 if all are.
    """
    frames, size = lower.shape[:2]
    count = rows.shape[1] - size
    for t in range(frames):
        block, mine = lower[t], rows[t]
        for j in range(size):
            for i in range(j, size):
                each = block[i, j]
                for k in range(j):
                    each -= block[i, k] * block[j, k]
                if i > j:
                    block[i, j] = each / block[j, j]
                elif each > 0:
                    block[j, j] = np.sqrt(each)
                else:
                    return t
            block[j, j + 1 :] = 0.0
        for r in range(len(mine)):
            for j in range(size):
                each = mine[r, j]
                for k in range(j):
                    each -= mine[r, k] * block[j, k]
                mine[r, j] = each / block[j, j]
        if t + 1 < frames:
            for i in range(size):
                for j in range(i + 1):
                    each = 0.0
                    for k in range(size):
                        each += mine[count + i, k] * mine[count + j, k]
                    lower[t + 1, i, j] -= each
            for r in range(count):
                for j in range(size):
                    each = 0.0
                    for k in range(size):
                        each += mine[r, k] * mine[count + j, k]
                    rows[t + 1, r, j] -= each
    return -1


@compiled
def swept_back(lower: Array, rows: Array, mean: Array, own: Array, below: Array) -> None:
    """Solve for means and covariances of a factorised chain, from its last frame to its first.

    lower, rows : as `factorised` leaves them.
    mean : (F, K, D) right-hand sides times L_t^-T, replaced by the solutions.
    own, below : (F, D, D) and (F - 1, D, D) that are filled with the covariances of the states, and
        with those of a frame's states (rows) with the states one frame before.
    """
    frames, size = lower.shape[:2]
    sides, count = mean.shape[1], rows.shape[1] - size
    inverse = np.zeros((size, size))
    gain = np.empty((size, size))
    carried = np.empty((sides, size))
    for t in range(frames - 1, -1, -1):
        for j in range(size):
            inverse[j, j] = 1 / lower[t, j, j]
            for i in range(j + 1, size):
                each = 0.0
                for k in range(j, i):
                    each -= lower[t, i, k] * inverse[k, j]
                inverse[i, j] = each / lower[t, i, i]
        own[t] = 0.0
        carried[:] = 0.0
        for k in range(size):
            for i in range(k + 1):
                for j in range(k + 1):
                    own[t, i, j] += inverse[k, i] * inverse[k, j]
            for r in range(sides):
                for j in range(k + 1):
                    carried[r, j] += mean[t, r, k] * inverse[k, j]
        mean[t] = carried
        if t + 1 == frames:
            continue
        gain[:] = 0.0
        below[t] = 0.0
        for i in range(size):
            for k in range(size):
                for j in range(k + 1):
                    gain[i, j] += rows[t, count + i, k] * inverse[k, j]
        for i in range(size):
            for k in range(size):
                for j in range(size):
                    below[t, i, j] -= own[t + 1, i, k] * gain[k, j]
        for k in range(size):
            for i in range(size):
                for j in range(size):
                    own[t, i, j] -= gain[k, i] * below[t, k, j]
            for r in range(sides):
                for j in range(size):
                    mean[t, r, j] -= mean[t + 1, r, k] * gain[k, j]
