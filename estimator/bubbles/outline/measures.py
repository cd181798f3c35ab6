"""What a detection table's outlines enclose, and how they bend."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.bubbles.outline.ellipse_geometry import points_on
from telerig.estimator.bubbles.outline.types import HARMONIC_COLUMNS

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_SAMPLES = 64
_ELLIPSE_COLUMNS = ["u_px", "v_px", "a_px", "b_px", "angle_rad"]


def outline_points(row: pd.Series[Any] | dict[str, Any], n: int = 64) -> Array:
    """Outline (n, 2) [px] of one row of the detection table, evenly spaced in the anomaly."""
    ellipse = np.array([[row[name] for name in _ELLIPSE_COLUMNS]])
    harmonics = np.nan_to_num(np.array([[row[name] for name in HARMONIC_COLUMNS]], dtype=float))
    phi = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    points: Array = points_on(ellipse.astype(float), harmonics, phi)[0]
    return points


def _sampled(ellipse: Array, harmonics: Array) -> tuple[Complex, Complex, Complex]:
    """Outlines about their ellipses' centres as complex numbers (B, 64), and their first and
    second derivatives by the anomaly, spectral and so exact to rounding."""
    phi = np.linspace(0.0, 2.0 * np.pi, _SAMPLES, endpoint=False)
    centred = ellipse.copy()
    centred[:, :2] = 0.0
    points = points_on(centred, harmonics, phi)
    place = points[..., 0] + 1j * points[..., 1]
    turn = 1j * np.fft.fftfreq(_SAMPLES, 1.0 / _SAMPLES)
    waves = np.fft.fft(place, axis=1) * turn
    return place, np.fft.ifft(waves, axis=1), np.fft.ifft(waves * turn, axis=1)


def outline_moments(ellipse: Array, harmonics: Array) -> tuple[Array, Array]:
    """Area (B,) and area centroid (B, 2) inside outlines, by Green's theorem."""
    place, slope, _ = _sampled(ellipse, harmonics)
    step = np.pi / _SAMPLES
    area = step * np.sum((np.conj(place) * slope).imag, axis=1)
    u = step * np.sum(place.real**2 * slope.imag, axis=1) / area
    v = -step * np.sum(place.imag**2 * slope.real, axis=1) / area
    return area, ellipse[:, :2] + np.stack([u, v], axis=1)


def outline_curvature(ellipse: Array, harmonics: Array) -> tuple[Array, Array]:
    """Points (B, 64, 2) and curvature (B, 64) of outlines, positive where convex."""
    place, slope, bend = _sampled(ellipse, harmonics)
    curvature = (np.conj(slope) * bend).imag / np.abs(slope) ** 3
    return ellipse[:, None, :2] + np.stack([place.real, place.imag], axis=-1), curvature


def deepest_dent(ellipse: Array, harmonics: Array) -> Array:
    """Most inward curvature (B,) of outlines in units of 1 / radius, 0 where all is convex."""
    _, curvature = outline_curvature(ellipse, harmonics)
    radius = np.sqrt(ellipse[:, 2] * ellipse[:, 3])
    dent: Array = np.maximum(-np.min(curvature, axis=1) * radius, 0.0)
    return dent


def outline_centroid(table: pd.DataFrame) -> Array:
    """Centroid (N, 2) [px] of the area inside each outline of a detection table.

    It differs from the ellipse's centre by the products of the outline's harmonics with each
    other and with the ellipse's flattening.
    """
    ellipse = table[_ELLIPSE_COLUMNS].to_numpy(dtype=np.float64)
    harmonics = np.nan_to_num(table[HARMONIC_COLUMNS].to_numpy(dtype=np.float64))
    return outline_moments(ellipse, harmonics)[1]
