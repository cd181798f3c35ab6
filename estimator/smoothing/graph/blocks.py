"""Covariances as an elimination returns them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Blocks:
    """Covariances of increments, in their bases.

    own : of each family of keys, (n, d, d); the shake's at the frames.
    cross : (rows, Ds, Db) of the shake with each bubble at the same frame.
    """

    own: list[Array]
    cross: Array
