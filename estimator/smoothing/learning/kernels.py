"""The loop of a Kalman filter, compiled."""

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
