"""The spread of residuals of which a few may be outliers."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

SD_PER_MEDIAN = 1.4826
"""Standard deviation of a normal variable over the median of its absolute value."""


def robust_sd(residuals: ArrayLike) -> float:
    """Standard deviation about 0, from the median absolute value: up to half may be outliers."""
    return SD_PER_MEDIAN * float(np.median(np.abs(np.asarray(residuals))))
