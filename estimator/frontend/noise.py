"""Image noise measured from the image itself: variance = alpha + beta * grey level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Differences of second differences: blind to any plane, unit gain for white noise (Immerkaer 1996).
_PLANE_KILLER = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]) / 6.0
_CLIP = 3.0
_CLIPPED_VARIANCE = 0.973337  # variance of a unit normal cut at +-3 sigma
_MAX_SAMPLES = 400_000


@dataclass(frozen=True)
class NoiseModel:
    """Variance of a pixel's grey level: ``alpha + beta * level``, at least that of rounding."""

    alpha: float
    beta: float
    step: float

    def variance(self, level: Array) -> Array:
        """Variance [grey^2] at the given grey levels."""
        floor = max(self.step**2 / 12.0, 1e-300)
        return np.maximum(self.alpha + self.beta * np.asarray(level, dtype=np.float64), floor)

    def sigma_at(self, level: float) -> float:
        """Standard deviation [grey] at one grey level."""
        return float(np.sqrt(self.variance(np.asarray(level))))


def grey_step(image: NDArray[np.generic]) -> float:
    """Distance between neighbouring grey levels (0 for floats): 16 for 12 bits held in 16."""
    if not np.issubdtype(image.dtype, np.integer):
        return 0.0
    levels = np.unique(image[:: max(1, image.shape[0] // 256)]).astype(np.int64)
    return float(np.gcd.reduce(np.diff(levels))) if levels.size > 1 else 1.0


def clipped_sigma(values: Array, *, rounds: int = 12) -> float:
    """Standard deviation without outliers; unlike a MAD it does not stick to rounded levels."""
    sigma = float(np.std(values))
    for _ in range(rounds):
        kept = values[np.abs(values) <= _CLIP * sigma]
        if kept.size < 8:
            return sigma
        updated = float(np.sqrt(np.mean(kept**2) / _CLIPPED_VARIANCE))
        if abs(updated - sigma) <= 1e-3 * sigma:
            return updated
        sigma = updated
    return sigma


def high_pass(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image minus anything locally plane, scaled to keep white noise's variance."""
    import cv2

    kernel = _PLANE_KILLER.astype(np.float32)
    filtered: NDArray[np.float32] = cv2.filter2D(
        image, cv2.CV_32F, kernel, borderType=cv2.BORDER_REFLECT
    )
    return filtered


def estimate_noise(
    image: NDArray[np.float32], flat: NDArray[np.bool_], *, step: float, bins: int = 8
) -> NoiseModel:
    """Noise of ``image`` (rows, columns) over the pixels marked ``flat``, which show no edges.

    Levels are grouped in ``bins`` of equal population; the line through their clipped variances
    is weighted by their accuracy and kept from falling below zero at either end.
    """
    response, level = high_pass(image)[flat], image[flat]
    if response.size > _MAX_SAMPLES:
        stride = response.size // _MAX_SAMPLES + 1
        response, level = response[::stride], level[::stride]
    if response.size < 32:
        response, level = high_pass(image).ravel(), image.ravel()
    edges = np.unique(np.quantile(level, np.linspace(0.0, 1.0, bins + 1)))
    index = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, max(edges.size - 2, 0))
    groups = [index == k for k in range(max(edges.size - 1, 1))]
    groups = [group for group in groups if np.count_nonzero(group) >= 200]
    if not groups:
        groups = [np.ones(level.shape, dtype=np.bool_)]
    variances = np.array([clipped_sigma(response[g].astype(np.float64)) ** 2 for g in groups])
    levels = np.array([float(np.mean(level[g])) for g in groups])
    return _line(levels, np.maximum(variances, step**2 / 12.0), step)


def _line(levels: Array, variances: Array, step: float) -> NoiseModel:
    mean = float(np.mean(variances))
    if levels.size < 3 or float(np.ptp(levels)) <= 4.0 * np.sqrt(mean):
        return NoiseModel(mean, 0.0, step)
    relative = 1.0 / np.maximum(variances, 0.05 * mean)
    design = np.stack([np.ones_like(levels), levels], axis=1) * relative[:, None]
    alpha, beta = np.linalg.lstsq(design, variances * relative, rcond=None)[0]
    if beta <= 0.0 or alpha + beta * levels.min() < 0.2 * variances.min():
        return NoiseModel(float(np.average(variances, weights=relative)), 0.0, step)
    return NoiseModel(float(alpha), float(beta), step)
