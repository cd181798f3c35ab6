"""One camera's outlines, re-expressed as displacements of the unit circle under its ellipse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.estimator.bubbles.outline.detection_table import (
    AXES_COLUMNS,
    CENTRE_COLUMNS,
    HARMONIC_COLUMNS,
    centre_covariances,
    columns,
    flag_words,
)
from telerig.estimator.bubbles.outline.ellipse_geometry import HARMONICS

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SAMPLES = 32
_LEAST_PX2 = 1e-12
_FLOOR_PX2 = 1e-6  # no outline is known better; keeps the algebra regular
_BLOCKING = ("border", "overlap", "merged")
_TRACE_ORDERS = (1, 3, 4)


@dataclass(frozen=True)
class Outlines:
    """M outlines of one camera.

    uv_px : (M, 2), covariance_px2 : (M, 2, 2), of the ellipses' centres.  axes_px : (M, 2, 2),
    columns are the semi-axes.  trace : (M, 6) coefficients of cos and sin of 1, 3 and 4 phi of the
    radial displacement of the unit circle (semi-axes are 1), trace_covariance : (M, 6, 6); NaN
    where no harmonics are known.  located : (M,) centre and covariance are usable; shaped : axes
    are too; whole : harmonics are too, and no flag says that part of the outline is missing.
    """

    uv_px: Array
    covariance_px2: Array
    axes_px: Array
    trace: Array
    trace_covariance: Array
    located: Mask
    shaped: Mask
    whole: Mask

    def rows(self, keep: Mask) -> Outlines:
        """Some of the rows."""
        return Outlines(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


def outlines_from_table(table: pd.DataFrame, image_size_px: tuple[int, int]) -> Outlines:
    """A detection table's rows; missing columns and words that are no numbers count as unknown.

    So do centres farther out than the image is large, axes of a ratio above 20, and harmonics
    above 30 % of the smaller axis.
    """
    uv, covariance = columns(table, CENTRE_COLUMNS), centre_covariances(table)
    suu, suv, svv = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    size = np.asarray(image_size_px, float)
    located = (np.abs(uv - size / 2) < 1.5 * size).all(-1)
    located &= np.isfinite(suu) & np.isfinite(svv) & (suu > _LEAST_PX2) & (svv > _LEAST_PX2)
    located &= suu * svv - suv**2 > 1e-6 * suu * svv
    a, b, angle = columns(table, AXES_COLUMNS).T
    shaped = located & np.isfinite(angle) & np.isfinite(a) & (b > 0.05 * a) & (a >= b)
    rotation = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1)
    axes = rotation.reshape(-1, 2, 2) * np.stack([a, b], -1)[:, None, :]
    displacement = columns(table, HARMONIC_COLUMNS)
    sigma = columns(table, ["sigma_outline_px"])[:, 0]
    known = (np.abs(displacement) < 0.3 * b[:, None]).all(-1)
    known &= (sigma**2 > _LEAST_PX2) & (sigma < b)
    blocked = np.array([any(word in _BLOCKING for word in row) for row in flag_words(table)], bool)
    gain = _trace_from_displacement(*(np.where(shaped, axis, np.nan) for axis in (a, b)))
    return Outlines(
        uv,
        covariance + _FLOOR_PX2 * np.eye(2),
        axes,
        np.einsum("mij,mj->mi", gain, displacement),
        gain @ np.swapaxes(gain, -1, -2) * (sigma**2 + _FLOOR_PX2)[:, None, None],
        located,
        shaped,
        shaped & known & ~blocked,
    )


def _trace_from_displacement(a_px: Array, b_px: Array) -> Array:
    """(M, 6, 8): radial harmonics on the unit circle from normal displacements in px.

    A displacement d along the ellipse's normal is d sqrt(b^2 cos^2 + a^2 sin^2) / (a b) along the
    radius of the circle, to first order.
    """
    phi = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    inward = np.stack([f(k * phi) for k in HARMONICS for f in (np.cos, np.sin)])
    outward = np.stack([f(k * phi) for k in _TRACE_ORDERS for f in (np.cos, np.sin)])
    weights = (2 / _SAMPLES * outward[:, None] * inward[None]).reshape(-1, _SAMPLES)
    speed = np.hypot(np.outer(b_px, np.cos(phi)), np.outer(a_px, np.sin(phi)))
    factor = speed / (a_px * b_px)[:, None]
    return np.asarray((factor @ weights.T).reshape(-1, len(outward), len(inward)))
