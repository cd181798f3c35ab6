"""The smooth level of a backlit screen behind dark compact things."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Float32
from telerig.statistics import robust_sd

_CELL_PX = 4
DARK = 0.05
"""Relative depth from which on something may be a bubble."""

_LEVEL_SCALE_CELLS = 3.0
_EDGE_SHARE = 1 / 3


def level_of_image(image: NDArray[np.generic]) -> tuple[Float32, Bools]:
    """(H, W) level in grey values, and (H, W) where it is interpolated under something dark.

    The screen is a surface of degree 4 (log level), fitted to the bright side, then the smoothed
    image itself where that is not dark. A dark band along more than a third of the border is the
    screen's edge, not a bubble.
    """
    height, width = image.shape
    log = log_cells(image, _CELL_PX)
    surface = bright_surface(log, 4)
    for _ in range(3):
        dark = _dark_things(log, surface)
        filled = np.where(dark, surface + _carried(log - surface, ~dark), log).astype(np.float32)
        surface = cv2.GaussianBlur(filled, (0, 0), _LEVEL_SCALE_CELLS)
    level = np.exp(cv2.resize(surface, (width, height), interpolation=cv2.INTER_CUBIC))
    covered = cv2.resize(dark.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return level.astype(np.float32), covered.astype(bool)


def log_cells(image: NDArray[np.generic], cell_px: int) -> Float32:
    """Logarithm of the image, averaged over square cells first."""
    size = [max(4, extent // cell_px) for extent in reversed(image.shape)]
    cells = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(np.log(np.maximum(cells, 0.5)))


def fill_masked(
    log: Float32, mask: Bools, usable: Bools, across: tuple[float, float] | None = None
) -> Float32:
    """``log`` with the masked pixels interpolated from the usable ones around them.

    A surface of degree 2 through each hole's neighbourhood, and what is left of it around the
    hole carried over it, in all directions, or along an image axis only: ``across`` is then the
    reach (u, v) px of a pixel, small across the axis.
    """
    surface = log.copy()
    for window, hole in _holes(mask):
        known = usable[window] & ~mask[window]
        if known.sum() > 30:
            smooth = bright_surface(log[window], 2, known)
            carried = smooth + _carried(log[window] - smooth, known, across)
            surface[window] = np.where(hole, carried, surface[window])
    return surface


def _holes(mask: Bools) -> Iterator[tuple[tuple[slice, slice], Bools]]:
    """Windows about the connected parts of a mask, with a margin of half their size."""
    from skimage.measure import label, regionprops

    labels = label(mask)
    for region in regionprops(labels):
        extent = max(side.stop - side.start for side in region.slice)
        margin = max(12, extent // 2)
        rows, columns = (slice(max(0, s.start - margin), s.stop + margin) for s in region.slice)
        yield (rows, columns), labels[rows, columns] == region.label


def _carried(residual: Float32, known: Bools, across: tuple[float, float] | None = None) -> Float32:
    """Weighted means of what is known nearby, the finest scale that reaches a pixel first."""
    weight, value = known.astype(np.float32), np.where(known, residual, 0).astype(np.float32)
    result, left = np.zeros_like(value), np.ones_like(value)
    scale = 2.0
    while scale < max(known.shape) and float(left.max()) > 1e-3:
        su, sv = (min(scale, most) for most in across or (scale, scale))
        total, mean = (
            cv2.GaussianBlur(part, (0, 0), sigmaX=su, sigmaY=sv, borderType=cv2.BORDER_REPLICATE)
            for part in (weight, value)
        )
        share = left * np.minimum(1.0, 4 * total)
        result += share * mean / np.maximum(total, 1e-6)
        left -= share
        scale *= 2
    return result


def bright_surface(log: Float32, degree: int, known: Bools | None = None) -> Float32:
    """Least squares over what is known and not much darker than the fit."""
    flat = log.ravel().astype(np.float64)
    usable = np.ones(flat.shape, bool) if known is None else known.ravel()
    terms = _terms(log.shape, degree)
    keep = usable & (flat > np.quantile(flat[usable], 0.3))
    fit = np.zeros(flat.shape)
    for _ in range(12):
        coefficients, *_ = np.linalg.lstsq(terms[keep], flat[keep], rcond=None)
        fit = terms @ coefficients
        residual = flat - fit
        above = residual[usable & (residual > 0)]
        spread = float(np.median(above)) / 0.6745 if above.size else 0.01
        keep = usable & (residual > -max(2.5 * spread, 0.01))
    return fit.reshape(log.shape).astype(np.float32)


def _terms(shape: tuple[int, ...], degree: int) -> Array:
    v, u = (np.linspace(-1, 1, n) for n in shape)
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.stack([np.outer(v**i, u**j).ravel() for i, j in powers], axis=1)


def _dark_things(log: Float32, surface: Float32) -> Bools:
    """Dark against the surface, grown by two cells."""
    depth = surface - log
    noise = float(robust_sd(depth - np.median(depth)))
    dark = compact_things(depth > max(DARK, 5 * noise))
    grown = cv2.dilate(dark.astype(np.uint8), np.ones((5, 5), np.uint8))
    return np.asarray(grown, bool)


def compact_things(dark: Bools) -> Bools:
    """``dark`` with bright centres filled; what covers a third of a border is the screen's edge."""
    from scipy.ndimage import binary_fill_holes
    from skimage.measure import label, regionprops

    kept = np.asarray(binary_fill_holes(dark), bool)
    height, width = kept.shape
    for region in regionprops(label(kept)):
        top, left, bottom, right = region.bbox
        along_side = (left == 0 or right == width) and bottom - top > _EDGE_SHARE * height
        along_top = (top == 0 or bottom == height) and right - left > _EDGE_SHARE * width
        if along_side or along_top:
            kept[region.slice] &= ~region.image
    return kept
