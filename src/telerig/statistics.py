"""Robust statistics that every part of the program uses."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array

NORMAL_FROM_MEDIAN = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute deviations."""


def robust_sd(deviations: ArrayLike, axis: int | None = None) -> Array:
    """Standard deviation of normal ``deviations`` from a known centre, whatever outliers do.

    Returns 1.4826 times their median absolute value along ``axis``, or of all of them. Subtract
    the median first where the centre is not known.
    """
    return np.asarray(NORMAL_FROM_MEDIAN * np.median(np.abs(deviations), axis=axis))
