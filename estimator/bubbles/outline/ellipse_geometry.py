"""Distances from outlines, the areas and centroids of what they enclose, and the table of them.

Ellipses and harmonics are those of `telerig.rig.outline`. Outlines leave this folder as the rows of
a detection table, whose columns are named here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array
from telerig.rig.outline import HARMONICS, points_on

Floats = NDArray[np.floating[Any]]
Index = NDArray[np.intp]

_SAMPLES = 64


def rough_distance(ellipse: Array, u: Floats, v: Floats) -> Array:
    """Return the approximate distance of points from ellipses (px), positive outside.

    ellipse : (..., 5) ellipses; u, v : (...) pixels of the points. The shapes are broadcast.
    """
    cos, sin = np.cos(ellipse[..., 4]), np.sin(ellipse[..., 4])
    du, dv = u - ellipse[..., 0], v - ellipse[..., 1]
    x, y = du * cos + dv * sin, dv * cos - du * sin
    return np.asarray(axis_distance(ellipse[..., 2], ellipse[..., 3], x, y))


def axis_distance(a: Any, b: Any, x: Any, y: Any) -> Any:
    """Return the approximate distance of a point (x, y) along an ellipse's axes from it.

    It is the first-order value (g - 1) / |grad g|, where g is 1 on the ellipse.
    """
    x, y = x / a, y / b
    level = np.sqrt(x * x + y * y) + 1e-12
    x, y = x / a, y / b
    return (level - 1.0) * level / (np.sqrt(x * x + y * y) + 1e-12)


def outline_moments(ellipse: Array, harmonics: Array) -> tuple[Array, Array]:
    """Return the areas (B,) in px^2 and the centroids (B, 2) in px of what outlines enclose.

    ellipse : (B, 5) ellipses; harmonics : (B, 8) coefficients (px), see `points_on`.
    """
    phi = np.linspace(0.0, 2.0 * np.pi, _SAMPLES, endpoint=False)
    points = points_on(ellipse * [0.0, 0.0, 1.0, 1.0, 1.0], harmonics, phi)
    place, step = points[..., 0] + 1j * points[..., 1], np.pi / _SAMPLES
    # The derivative by the anomaly, without truncation error.
    turn = 1j * np.fft.fftfreq(_SAMPLES, 1.0 / _SAMPLES)
    slope = np.fft.ifft(np.fft.fft(place, axis=1) * turn, axis=1)
    area = step * np.sum((np.conj(place) * slope).imag, axis=1)
    u = step * np.sum(place.real**2 * slope.imag, axis=1) / area
    v = -step * np.sum(place.imag**2 * slope.real, axis=1) / area
    return area, ellipse[:, :2] + np.stack([u, v], axis=1)


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
    """Return n points on the outline of one detected bubble.

    row : one row of a detection table.
    n : number of points; they are evenly spaced in the eccentric anomaly.

    Returns (n, 2) pixels (u, v).
    """
    ellipse = np.array([[row[name] for name in CENTRE_COLUMNS + AXES_COLUMNS]], dtype=float)
    harmonics = np.nan_to_num(np.array([[row[name] for name in HARMONIC_COLUMNS]], dtype=float))
    phi = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    return np.asarray(points_on(ellipse, harmonics, phi)[0])


def outline_centroid(table: pd.DataFrame) -> Array:
    """Return the centroids of the areas inside the outlines of a detection table.

    table : a detection table with N rows.

    Returns (N, 2) pixels. A centroid differs from the ellipse's centre because of the outline's
    harmonics.
    """
    ellipse = table[CENTRE_COLUMNS + AXES_COLUMNS].to_numpy(dtype=np.float64)
    harmonics = np.nan_to_num(table[HARMONIC_COLUMNS].to_numpy(dtype=np.float64))
    return outline_moments(ellipse, harmonics)[1]


def columns(table: pd.DataFrame, names: list[str]) -> Array:
    """Return some columns of a table as numbers.

    table : a table with N rows; names : the K names of the columns.

    Returns (N, K) numbers; they are NaN where the column does not exist or holds no number.
    """
    out = np.full((len(table), len(names)), np.nan)
    for k, name in enumerate(names):
        if name in table:
            values = table[name].to_numpy()
            if values.dtype.kind not in "fiu":
                values = pd.to_numeric(table[name], errors="coerce").to_numpy()
            out[:, k] = values
    return out


def centre_covariances(table: pd.DataFrame) -> Array:
    """Return the covariances (N, 2, 2) in px^2 of the detected centres, NaN if unknown."""
    return columns(table, COVARIANCE_COLUMNS)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)


def flag_words(table: pd.DataFrame) -> list[list[str]]:
    """Return for each row of a detection table the list of its flags; see `FLAGS`."""
    flags = table["flags"].tolist() if "flags" in table else [""] * len(table)
    return [text.split("|") if isinstance(text, str) and text else [] for text in flags]
