"""Robust statistics, and parts of records, that every part of the program uses."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Ints

GAP_STEPS = 5.0
"""Steps longer than this many median steps are gaps of a record."""

NORMAL_FROM_MEDIAN = 1.4826
"""Ratio of a normal distribution's standard deviation to the median of its absolute deviations."""


def robust_sd(deviations: ArrayLike, axis: int | None = None) -> Array:
    """Return the standard deviation of ``deviations`` in a way that outliers hardly change.

    The result is 1.4826 times the median of the absolute values, which equals the standard
    deviation if the values are normally distributed about 0. Subtract the median first if their
    centre is not known.

    deviations : array of any shape.
    axis : the axis along which the median is taken; None takes all values together.
    """
    return np.asarray(NORMAL_FROM_MEDIAN * np.median(np.abs(deviations), axis=axis))


def median(values: Array) -> float | None:
    """Return the median of the finite values; None without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else None


def rms(values: Array) -> float | None:
    """Return the RMS of the finite values; None without any."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else None


def parts_without_gaps(t_s: Array) -> list[Ints]:
    """Return the places of increasing times (N,) between which there is no gap, part by part."""
    step = np.diff(t_s)
    usual = float(np.median(step)) if len(step) else 0.0
    return np.split(np.arange(len(t_s)), np.flatnonzero(step > GAP_STEPS * usual) + 1)
