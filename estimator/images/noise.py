"""What an image is like: whether it is a grey image at all, and its noise, measured from itself.

The noise model is variance = alpha + beta * grey level.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
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
_CLIPPED_SHARE = 0.01
_FLOAT_STEPS = 4096


@dataclass(frozen=True)
class NoiseModel:
    """The variance of a pixel's grey level is ``alpha + beta * level``, in grey levels squared.

    The variance is never less than that of rounding to whole steps, nor less than its smallest
    value between ``lowest`` and ``highest``.

    step : distance between grey levels, see `grey_step`.
    relative_error : relative standard deviation of the estimated variance.
    lowest, highest : range of the grey levels at which the noise was measured.
    black, white : grey levels at which the image is clipped; infinite where it is not.
    """

    alpha: float
    beta: float
    step: float
    relative_error: float
    lowest: float = -np.inf
    highest: float = np.inf
    black: float = -np.inf
    white: float = np.inf

    def variance(self, level: Array) -> Array:
        """Return the variance (grey levels squared) at the given grey levels, in the same shape."""
        level = np.asarray(level, dtype=np.float64)
        return np.maximum(self.alpha + self.beta * level, self.least_variance)

    @cached_property
    def least_variance(self) -> float:
        """The least variance of a grey level, in grey levels squared."""
        ends = [self.alpha + self.beta * e for e in (self.lowest, self.highest) if np.isfinite(e)]
        return float(max(self.step**2 / 12.0, min(ends, default=0.0), 1e-300))

    def sigma_at(self, level: float) -> float:
        """Return the standard deviation (in grey levels) at one grey level."""
        return float(np.sqrt(self.variance(np.asarray(level))))

    def scaled(self, factor: float) -> NoiseModel:
        """Return the same model with every variance multiplied by ``factor``."""
        return replace(self, alpha=self.alpha * factor, beta=self.beta * factor)


def with_inner_level(
    noise: NoiseModel, inner_level: float, outer_level: float, ratio: float, pixels: int
) -> NoiseModel:
    """Correct the noise model at the grey level of the dots, where the image may have no flat area.

    ratio : mean square of the whitened residuals of the dots' own ``pixels``. The model stays if
    the noise was measured near ``inner_level``, or if ``ratio`` differs from 1 by less than 4 sd.
    """
    unseen = max(noise.lowest - inner_level, inner_level - noise.highest)
    if unseen < _UNSEEN_SHARE * abs(inner_level - outer_level):
        return noise
    if pixels < _ENOUGH_PIXELS or abs(ratio - 1.0) < 4.0 * np.sqrt(2.0 / pixels) + 0.05:
        return noise
    inner, outer = (noise.sigma_at(level) ** 2 for level in (inner_level, outer_level))
    beta = (ratio * inner - outer) / (inner_level - outer_level)
    lowest, highest = min(noise.lowest, inner_level), max(noise.highest, inner_level)
    line = replace(noise, alpha=outer - beta * outer_level, beta=beta)
    return replace(line, lowest=min(lowest, outer_level), highest=max(highest, outer_level))


def agreed_factor(noise: NoiseModel, chi2_dof: Array, dof: Array) -> float:
    """Return the factor by which an image's noise variance has to be multiplied.

    An image with many edges has few flat areas from which the noise can be estimated, but the
    residuals of the dots' fits show the noise as well. If both agree within 3 standard deviations,
    the factor is their weighted mean. If they disagree, it is 1. Without flat areas it is the
    median of chi2_dof, or 1 if that is 0.

    chi2_dof, dof : (N,) chi-square per degree of freedom, and degrees of freedom, of N dots' fits.
    """
    if chi2_dof.size == 0:
        return 1.0
    if np.isinf(noise.relative_error):
        return float(np.median(chi2_dof)) or 1.0
    own = noise.relative_error**2
    error = 1.25**2 * 2.0 / (float(np.mean(dof)) * chi2_dof.size)
    excess = float(np.median(chi2_dof)) - 1.0
    if excess**2 > 9.0 * (own + error):
        return 1.0
    return 1.0 + excess * own / (own + error)


def grey_step(image: NDArray[np.generic]) -> float:
    """Return the distance between neighbouring grey levels of an image.

    It is 16 for 12-bit levels that are stored in the upper bits of 16-bit numbers. For floats it is
    the smallest distance, but at least that of 12 bits: an image without noise, such as a rendered
    one, is not exact.
    """
    whole = np.issubdtype(image.dtype, np.integer)
    levels = np.unique(image[:: max(1, image.shape[0] // 256)])
    if whole:
        return float(np.gcd.reduce(np.diff(levels.astype(np.int64)))) if levels.size > 1 else 1.0
    levels = np.unique(levels.astype(np.float32)).astype(np.float64)
    least = float(np.ptp(levels)) / _FLOAT_STEPS
    return max(float(np.diff(levels).min()), least) if levels.size > 1 else 0.0


def clipped_sigma(values: Array, *, rounds: int = 12) -> float:
    """Return the standard deviation about 0 of values (N,) without those beyond 3 sd.

    Unlike the median of absolute values, it does not take only discrete values if the grey levels
    are whole numbers. rounds : most iterations.
    """
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
    """Return the image after a filter of second differences along both axes.

    Grey levels that are locally a plane become 0; the variance of white noise stays the same.
    """
    kernel = _SECOND_DIFFERENCES.astype(np.float32)
    return np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel, borderType=cv2.BORDER_REFLECT))


def rough_sigma(response: Float32) -> float:
    """Return a first estimate of the standard deviation of the noise.

    The image is divided into 8 x 8 tiles, and the fifth of the tiles that vary least is used.

    response : the image after `high_pass`.
    """
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
    clip: tuple[float, float] = (-np.inf, np.inf),
    bins: int = 8,
) -> NoiseModel:
    """Estimate the noise of an image from its flat areas.

    response : the image after `high_pass`.
    flat : whether a pixel is far from all edges.
    step : see `grey_step`.
    clip : grey levels (black, white) at which the image is clipped.

    Pixels are grouped by the grey level of their surroundings. A line is fitted through the clipped
    variances of the groups if they differ significantly. Groups that the image's clipping touches
    are left out; if it touches all, the ``relative_error`` of the result is infinite.
    """
    level = cv2.blur(image, (5, 5))
    if np.count_nonzero(flat) >= 64:
        response, level, image = response[flat], level[flat], image[flat]
    stride = response.size // _MAX_SAMPLES + 1
    response, level = response.ravel()[::stride], level.ravel()[::stride]
    clipped = (image.ravel()[::stride] <= clip[0]) | (image.ravel()[::stride] >= clip[1])
    low, high = np.quantile(level, [0.002, 0.998])
    width = max((high - low) / bins, 6.0 * clipped_sigma(response.astype(np.float64)), 1e-12)
    index = np.clip((level - low) / width, 0, bins - 1).astype(int)
    groups = [index == k for k in range(bins)]
    groups = [group for group in groups if np.count_nonzero(group) >= 200]
    if not groups:
        groups = [np.ones(level.shape, dtype=np.bool_)]
    whole = [group for group in groups if np.mean(clipped[group]) < _CLIPPED_SHARE]
    groups = whole or groups
    variances = np.array([clipped_sigma(response[g].astype(np.float64)) ** 2 for g in groups])
    levels = np.array([float(np.mean(level[g])) for g in groups])
    counts = np.array([np.count_nonzero(g) for g in groups])
    line = _line(levels, np.maximum(variances, step**2 / 12.0), counts, step)
    error = line.relative_error if whole else np.inf
    return replace(line, relative_error=error, black=clip[0], white=clip[1])


def _line(levels: Array, variances: Array, counts: NDArray[np.int_], step: float) -> NoiseModel:
    """Fit a line to the variances over the grey levels; its slope is 0 unless significant."""
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
    """Raise InputError for anything but a finite 2-D image of ``least_size_px`` per side."""
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
