"""Defines the robust losses: how the weight of a measurement falls with its distance from the
prediction, in standard deviations.

All fits start with a limit above the largest distance and lower it, so that the largest outliers
lose their weight first (graduated non-convexity; Yang, Antonante, Tzoumas and Carlone, RA-L 5:1127,
2020). A measurement counts as left out if its weight is 0.
"""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array

_FIRM = 1e3
"""Control beyond which `truncation_weights` is truncated least squares."""


def next_limit(limit: float, largest: float, last: float) -> float:
    """Return half of the limit or of the largest distance, whichever is less; at least ``last``."""
    return max(last, min(limit, largest) / 2)


def calibration_weights(distance: Array, before: Array, limit: float, last: float) -> Array:
    """Return the weights (M,) of the dots of a calibration.

    They fall smoothly (Geman-McClure) as long as the limit is above ``last``. Then they are 0 or 1
    (truncated least squares), and a dot that was left out is taken back only well inside the limit,
    so that no dot alternates.

    distance : (M,).  before : (M,) weights of the iteration before.
    """
    if limit > last:
        return (limit**2 / (limit**2 + distance**2)) ** 2
    return (distance <= np.where(before < 0.01, 0.9 * limit, limit)).astype(float)


def travel_weights(squares: Array, limit: float) -> Array:
    """Return the weights (limit / z)^4 for distances z beyond the limit, otherwise 1: the weights
    of the dots and readings of the travel axis.

    squares : (M,) values of z^2.
    """
    return np.minimum(1.0, limit**4 / np.maximum(squares, 1.0) ** 2)


def truncation_weights(squares: Array, bound: float, control: float) -> Array:
    """Return the weights (M,) of the pixels of a smoothing.

    squares : (M,) squared distances.
    bound : the square of the limit.
    control : grows from near 0 (convex loss) to infinity (truncated least squares).
    """
    low, high = control / (control + 1) * bound, (control + 1) / control * bound
    if control > _FIRM:
        return (squares <= bound).astype(float)
    between = np.sqrt(bound * control * (control + 1) / np.maximum(squares, 1e-12)) - control
    return np.where(squares <= low, 1.0, np.where(squares >= high, 0.0, np.clip(between, 0, 1)))
