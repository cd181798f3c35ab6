"""Sightings: one bubble's outline in one image, as arrays over all outlines of any cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools, Ints, Rows
from telerig.estimator.bubbles.outline.ellipse_geometry import (
    AXES_COLUMNS,
    CENTRE_COLUMNS,
    HARMONIC_COLUMNS,
    centre_covariances,
    columns,
    flag_words,
)
from telerig.rig.camera import Camera
from telerig.rig.outline import waves

_SAMPLES = 32
_LEAST_PX2 = 1e-12
_FLOOR_PX2 = 1e-6  # no outline is known better; keeps the algebra regular
UNKNOWN = 1e4
"""Variance of a coefficient of the trace that was not measured."""
BLOCKING = ("border", "overlap", "merged")
"""Flags of outlines of which a part was not seen."""
_TRACE_ORDERS = (1, 3, 4)
THIRD, FOURTH = slice(2, 4), slice(4, 6)
"""Coefficients of cos and sin of 3 phi and of 4 phi in `Sightings.trace`."""


@dataclass(frozen=True)
class Sightings(Rows):
    """N outlines; a row of nothing but unknown values stands for a view that is missing.

    camera : (N,) index of the camera.
    uv_px, covariance_px2 : (N, 2), (N, 2, 2) centres of the ellipses and their covariances.
    axes_px : (N, 2, 2) E, whose columns are the semi-axes; E E^T are the second moments.
    trace : (N, 6) coefficients of cos and sin of 1, 3 and 4 phi of the radial displacement of the
        unit circle (relative to the semi-axes); 0 if unknown.
    trace_covariance : (N, 6, 6).
    located : (N,) whether centre and covariance are usable.
    shaped : (N,) and the axes, too.
    entire : (N,) and no flag says that part of the outline is missing.
    whole : (N,) and the harmonics are usable.
    """

    camera: Ints
    uv_px: Array
    covariance_px2: Array
    axes_px: Array
    trace: Array
    trace_covariance: Array
    located: Bools
    shaped: Bools
    entire: Bools
    whole: Bools

    @property
    def all_whole(self) -> Bools:
        """Whether the outlines of (..., n) views are all whole (...)."""
        return np.asarray(np.all(self.whole, axis=-1))

    @property
    def all_entire(self) -> Bools:
        """Whether the outlines of (..., n) views are all entire (...)."""
        return np.asarray(np.all(self.entire, axis=-1))


def sightings_from_table(table: pd.DataFrame, camera: int, cameras: Sequence[Camera]) -> Sightings:
    """Return the outlines of a detection table of one camera.

    Values that are missing or not numbers count as unknown. So do centres far outside the image,
    axes with a ratio above 20, and harmonics above 30 % of the smaller axis.

    camera : its index in ``cameras``.
    """
    uv, covariance = columns(table, CENTRE_COLUMNS), centre_covariances(table)
    suu, suv, svv = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    size = np.asarray(cameras[camera].image_size_px, float)
    located = (np.abs(uv - size / 2) < 1.5 * size).all(-1)
    located &= np.isfinite(suu) & np.isfinite(svv) & (suu > _LEAST_PX2) & (svv > _LEAST_PX2)
    located &= suu * svv - suv**2 > 1e-6 * suu * svv
    a, b, angle = columns(table, AXES_COLUMNS).T
    shaped = located & np.isfinite(angle) & np.isfinite(a) & (b > 0.05 * a) & (a >= b)
    rotation = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1)
    axes = rotation.reshape(-1, 2, 2) * np.stack([a, b], -1)[:, None, :]
    displacement = columns(table, HARMONIC_COLUMNS)
    sigma = columns(table, ["sigma_outline_px"])[:, 0]
    blocked = np.array([any(word in BLOCKING for word in row) for row in flag_words(table)], bool)
    whole = shaped & ~blocked & (np.abs(displacement) < 0.3 * b[:, None]).all(-1)
    whole &= (sigma**2 > _LEAST_PX2) & (sigma < b)
    gain = _trace_from_displacement(*(np.where(whole, axis, 1.0) for axis in (a, b)))
    gain = np.where(whole[:, None, None], gain, 0.0)
    spread = gain @ gain.mT * (np.where(whole, sigma, 0.0) ** 2 + _FLOOR_PX2)[:, None, None]
    return Sightings(
        np.full(len(table), camera),
        uv,
        covariance + _FLOOR_PX2 * np.eye(2),
        axes,
        np.einsum("mij,mj->mi", gain, np.where(whole[:, None], displacement, 0.0)),
        spread + np.where(whole, 0.0, UNKNOWN)[:, None, None] * np.eye(6),
        located,
        shaped,
        shaped & ~blocked,
        whole,
    )


def _trace_from_displacement(a_px: Array, b_px: Array) -> Array:
    """Return the matrix (M, 6, 8) from normal displacements (px) to radial harmonics of the unit
    circle.

    To first order, a displacement d along the ellipse's normal is d sqrt(b^2 cos^2 + a^2 sin^2) /
    (a b) along the radius of the circle.
    """
    phi = 2 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    inward, outward = waves(phi), waves(phi, _TRACE_ORDERS)
    weights = (2 / _SAMPLES * outward[:, None] * inward[None]).reshape(-1, _SAMPLES)
    speed = np.hypot(np.outer(b_px, np.cos(phi)), np.outer(a_px, np.sin(phi)))
    factor = speed / (a_px * b_px)[:, None]
    return np.asarray((factor @ weights.T).reshape(-1, len(outward), len(inward)))
