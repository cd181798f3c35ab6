"""The table of detections: its columns, what its rows enclose, and how other steps read it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.estimator.bubbles.outline.ellipse_geometry import HARMONICS, outline_moments, points_on

CENTRE_COLUMNS = ["u_px", "v_px"]
COVARIANCE_COLUMNS = ["suu_px2", "suv_px2", "svv_px2"]
AXES_COLUMNS = ["a_px", "b_px", "angle_rad"]
HARMONIC_COLUMNS = [f"{part}{k}_px" for k in HARMONICS for part in "cs"]

DETECTION_COLUMNS = [
    *CENTRE_COLUMNS,
    *COVARIANCE_COLUMNS,
    *AXES_COLUMNS,
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


def outline_points(row: pd.Series[Any] | dict[str, Any], n: int = 64) -> Array:
    """Outline (n, 2) [px] of one row of the detection table, evenly spaced in the anomaly."""
    ellipse = np.array([[row[name] for name in CENTRE_COLUMNS + AXES_COLUMNS]], dtype=float)
    harmonics = np.nan_to_num(np.array([[row[name] for name in HARMONIC_COLUMNS]], dtype=float))
    phi = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    return np.asarray(points_on(ellipse, harmonics, phi)[0])


def outline_centroid(table: pd.DataFrame) -> Array:
    """Centroid (N, 2) [px] of the area inside each outline of a detection table.

    It differs from the ellipse's centre by the products of the outline's harmonics with each
    other and with the ellipse's flattening.
    """
    ellipse = table[CENTRE_COLUMNS + AXES_COLUMNS].to_numpy(dtype=np.float64)
    harmonics = np.nan_to_num(table[HARMONIC_COLUMNS].to_numpy(dtype=np.float64))
    return outline_moments(ellipse, harmonics)[1]


def columns(table: pd.DataFrame, names: list[str]) -> Array:
    """(N, K) columns as numbers; NaN where there is none, or no number."""
    out = np.full((len(table), len(names)), np.nan)
    for k, name in enumerate(names):
        if name in table:
            values = table[name].to_numpy()
            if values.dtype.kind not in "fiu":
                values = pd.to_numeric(table[name], errors="coerce").to_numpy()
            out[:, k] = values
    return out


def centre_covariances(table: pd.DataFrame) -> Array:
    """(N, 2, 2) [px^2], NaN where unknown."""
    return columns(table, COVARIANCE_COLUMNS)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def flag_words(table: pd.DataFrame) -> list[list[str]]:
    """The words of each row's flags."""
    flags = table["flags"].tolist() if "flags" in table else [""] * len(table)
    return [text.split("|") if isinstance(text, str) and text else [] for text in flags]
