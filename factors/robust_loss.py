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
"""Value of ``control`` beyond which `truncation_weights` gives truncated least squares."""


def next_limit(limit: float, largest: float, last: float) -> float:
    """Return the limit of the next iteration, which is lowered step by step to ``last``.

    It is half of the present limit or of the largest distance, whichever is less, but not less than
    ``last``. All are in standard deviations.
    """
    return max(last, min(limit, largest) / 2)


def calibration_weights(distance: Array, before: Array, limit: float, last: float) -> Array:
    """Return the weights (M,) of the dots of a calibration.

    The weights fall smoothly with the distance (Geman-McClure) as long as the limit is above
    ``last``. Then they are 0 or 1 (truncated least squares). A dot that was left out is then taken
    back only if its distance is below 0.9 times the limit, so that no dot alternates.

    distance : (M,) distance of each dot from its prediction, in standard deviations.
    before : (M,) weights of the iteration before.
    limit, last : limit of this iteration and of the last ones, in standard deviations.
    """
    if limit > last:
        return (limit**2 / (limit**2 + distance**2)) ** 2
    return (distance <= np.where(before < 0.01, 0.9 * limit, limit)).astype(float)


def travel_weights(squares: Array, limit: float) -> Array:
    """Return the weights (M,) of dots and encoder readings when the travel axis is measured.

    The weight is 1 up to the limit and (limit / z)^4 beyond it, with z the distance from the
    prediction in standard deviations.

    squares : (M,) values of z^2.
    """
    return np.minimum(1.0, limit**4 / np.maximum(squares, 1.0) ** 2)


def truncation_weights(squares: Array, bound: float, control: float) -> Array:
    """Return the weights (M,) of detections, from 0 to 1, when a run is smoothed.

    squares : (M,) squared distances of the detections from their predictions, in variances.
    bound : square of the distance beyond which a detection is an outlier.
    control : sharpness of the loss; the caller raises it from near 0 (convex loss) towards infinity
        (truncated least squares).
    """
    low, high = control / (control + 1) * bound, (control + 1) / control * bound
    if control > _FIRM:
        return (squares <= bound).astype(float)
    between = np.sqrt(bound * control * (control + 1) / np.maximum(squares, 1e-12)) - control
    return np.where(squares <= low, 1.0, np.where(squares >= high, 0.0, np.clip(between, 0, 1)))
