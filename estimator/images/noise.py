"""What an image is like: whether it is a grey image at all, and its noise, measured from itself.

The noise model is variance = alpha + beta * grey level.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Float32
from telerig.errors import InputError

# Second differences along both axes: zero on any plane, unit gain for white noise (Immerkaer 1996).
_SECOND_DIFFERENCES = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]) / 6.0
_CLIP = 3.0
_CLIPPED_VARIANCE = 0.973337  # variance of a unit normal cut at +-3 sigma
_CORRELATED = 3.8  # sum of the filter's squared autocorrelation: neighbours share pixels
_MAX_SAMPLES = 100_000
_ENOUGH_PIXELS = 100
_UNSEEN_SHARE = 0.2


@dataclass(frozen=True)
class NoiseModel:
    """Variance of a pixel's grey level: ``alpha + beta * level``, at least that of rounding.

    step : between grey levels. relative_error : of the variance. lowest, highest : range of the
    grey levels at which the noise was measured.
    """

    alpha: float
    beta: float
    step: float
    relative_error: float
    lowest: float = -np.inf
    highest: float = np.inf

    def variance(self, level: Array) -> Array:
        """Variance [grey^2] at the given grey levels."""
        floor = max(self.step**2 / 12.0, 1e-300)
        return np.maximum(self.alpha + self.beta * np.asarray(level, dtype=np.float64), floor)

    def sigma_at(self, level: float) -> float:
        """Standard deviation [grey] at one grey level."""
        return float(np.sqrt(self.variance(np.asarray(level))))

    def scaled(self, factor: float) -> NoiseModel:
        """The same model with every variance times ``factor``."""
        return replace(self, alpha=self.alpha * factor, beta=self.beta * factor)


def with_inner_level(
    noise: NoiseModel, inner_level: float, outer_level: float, ratio: float, pixels: int
) -> NoiseModel:
    """The noise corrected at the dots' own grey level, where the image may have no flat pixels.

    ratio : mean whitened square of ``pixels`` residuals at ``inner_level``. The slope between both
    levels follows from it where it differs from 1 by more than 4 standard deviations.
    """
    unseen = max(noise.lowest - inner_level, inner_level - noise.highest)
    if unseen < _UNSEEN_SHARE * abs(inner_level - outer_level):
        return noise
    if pixels < _ENOUGH_PIXELS or abs(ratio - 1.0) < 4.0 * np.sqrt(2.0 / pixels) + 0.05:
        return noise
    inner, outer = (noise.sigma_at(level) ** 2 for level in (inner_level, outer_level))
    beta = (ratio * inner - outer) / (inner_level - outer_level)
    return replace(noise, alpha=outer - beta * outer_level, beta=beta)


def agreed_factor(noise: NoiseModel, chi2_dof: Array, dof: Array) -> float:
    """Factor on the noise variance from the fits' own chi2_dof (N,) with dof (N,).

    Where edges are dense, few flat pixels show the noise, but the fits' residuals do. Their median
    is averaged with the estimate by inverse variance if both agree to 3 standard deviations; if
    not, the excess is misfit rather than noise and the factor is 1.
    """
    if chi2_dof.size == 0:
        return 1.0
    own = noise.relative_error**2
    error = 1.25**2 * 2.0 / (float(np.mean(dof)) * chi2_dof.size)
    excess = float(np.median(chi2_dof)) - 1.0
    if excess**2 > 9.0 * (own + error):
        return 1.0
    return 1.0 + excess * own / (own + error)


def grey_step(image: NDArray[np.generic]) -> float:
    """Distance between neighbouring grey levels (0 for floats): 16 for 12 bits held in 16."""
    if not np.issubdtype(image.dtype, np.integer):
        return 0.0
    levels = np.unique(image[:: max(1, image.shape[0] // 256)]).astype(np.int64)
    return float(np.gcd.reduce(np.diff(levels))) if levels.size > 1 else 1.0


def clipped_sigma(values: Array, *, rounds: int = 12) -> float:
    """Standard deviation without outliers; unlike a MAD it is not quantised to the grey levels."""
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


def high_pass(image: Float32) -> Float32:
    """The image without its locally plane part, scaled to keep the variance of white noise."""
    kernel = _SECOND_DIFFERENCES.astype(np.float32)
    return np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel, borderType=cv2.BORDER_REFLECT))


def rough_sigma(response: Float32) -> float:
    """A first guess of the noise: the quietest fifth of 8 x 8 tiles of the high-passed image."""
    rows, columns = (n // 8 * 8 for n in response.shape)
    tiles = response[:rows, :columns].reshape(rows // 8, 8, columns // 8, 8)
    tiles = tiles[:: max(1, response.size // _MAX_SAMPLES)]
    spread = np.sqrt(np.mean(tiles**2, axis=(1, 3)))
    return float(np.mean(spread[spread <= np.quantile(spread, 0.2)]))


def estimate_noise(
    image: Float32,
    response: Float32,
    flat: Bools,
    *,
    step: float,
    bins: int = 8,
) -> NoiseModel:
    """Noise of ``image`` (rows, columns) over the pixels marked ``flat``, which show no edges.

    ``response`` is the :func:`high_pass` of the image.

    Pixels are grouped by the grey level of their surroundings, as their own level holds the noise.
    A line is fitted through the clipped variances of the groups if they differ significantly.
    """
    level = cv2.blur(image, (5, 5))
    if np.count_nonzero(flat) >= 64:
        response, level = response[flat], level[flat]
    stride = response.size // _MAX_SAMPLES + 1
    response, level = response.ravel()[::stride], level.ravel()[::stride]
    low, high = np.quantile(level, [0.002, 0.998])
    width = max((high - low) / bins, 6.0 * clipped_sigma(response.astype(np.float64)), 1e-12)
    index = np.clip((level - low) / width, 0, bins - 1).astype(int)
    groups = [index == k for k in range(bins)]
    groups = [group for group in groups if np.count_nonzero(group) >= 200]
    if not groups:
        groups = [np.ones(level.shape, dtype=np.bool_)]
    variances = np.array([clipped_sigma(response[g].astype(np.float64)) ** 2 for g in groups])
    levels = np.array([float(np.mean(level[g])) for g in groups])
    counts = np.array([np.count_nonzero(g) for g in groups])
    return _line(levels, np.maximum(variances, step**2 / 12.0), counts, step)


def _line(levels: Array, variances: Array, counts: NDArray[np.int_], step: float) -> NoiseModel:
    """Line through the variances against grey level; constant unless its slope is significant."""
    relative = np.sqrt(2.0 * _CORRELATED / counts)
    total = float(np.sqrt(2.0 * _CORRELATED / np.sum(counts)))
    mean = float(np.average(variances, weights=counts))
    seen = (float(levels.min()), float(levels.max()))
    level_free = NoiseModel(mean, 0.0, step, total, *seen)
    if levels.size < 2 or float(np.ptp(levels)) <= 4.0 * np.sqrt(mean):
        return level_free
    precision = 1.0 / ((relative + 0.01) * np.maximum(variances, 0.05 * mean))
    design = np.stack([np.ones_like(levels), levels], axis=1) * precision[:, None]
    covariance = np.linalg.inv(design.T @ design)
    alpha, beta = covariance @ (design.T @ (variances * precision))
    if beta <= 4.0 * np.sqrt(covariance[1, 1]) or alpha + beta * levels.min() <= 0.0:
        return level_free
    return NoiseModel(float(alpha), float(beta), step, total, *seen)


def check_grey_image(image: NDArray[Any], least_size_px: int, wanted: str) -> None:
    """Raise InputError for anything but a finite 2-D image of at least ``least_size_px`` per side.

    wanted : what is looked for in the image, in the plural, for the message.
    """
    if image.ndim != 2:
        raise InputError(
            f"a grey image has 2 dimensions, this array has {image.ndim}: {image.shape}",
            where="image",
            todo="convert colour images to grey first (cv2.cvtColor, or one channel of the array)",
        )
    if min(image.shape) < least_size_px or image.dtype.kind not in "uif":
        raise InputError(
            f"cannot look for {wanted} in an array of shape {image.shape} and type {image.dtype}",
            where="image",
            todo=f"give at least {least_size_px} x {least_size_px} pixels of an integer or float "
            "type",
        )
    if image.dtype.kind == "f" and not np.all(np.isfinite(image.astype(np.float32))):
        raise InputError(
            "the image has pixels that are not finite",
            where="image",
            todo="replace NaN and infinity",
        )
