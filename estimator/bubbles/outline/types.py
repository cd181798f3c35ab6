"""What the steps from images to tracks hand to each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HARMONICS = (3, 4, 5, 6)
"""Orders of the outline's normal displacement about its ellipse, see `bubble_outline`."""

HARMONIC_COLUMNS = [f"{part}{k}_px" for k in HARMONICS for part in "cs"]

DETECTION_COLUMNS = [
    "u_px",
    "v_px",
    "suu_px2",
    "suv_px2",
    "svv_px2",
    "a_px",
    "b_px",
    "angle_rad",
    "area_px2",
    "d_eq_px",
    "contrast",
    "edge_px",
    "chi2_dof",
    *HARMONIC_COLUMNS,
    "sigma_outline_px",
    "flags",
]

FLAGS = ("border", "defocus", "overlap", "merged", "small", "saturated")
"""The words of the column ``flags``, joined by ``|``."""


@dataclass(frozen=True)
class Prediction:
    """Where the live tracks are expected in a frame, in the rig frame.

    ids : (K,); points_mm : (K, 3); covariance_mm2 : (K, 3, 3); d_eq_mm : (K,).
    """

    ids: NDArray[np.int64]
    points_mm: Array
    covariance_mm2: Array
    d_eq_mm: Array
