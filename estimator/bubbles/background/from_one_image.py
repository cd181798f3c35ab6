"""The smooth level of a backlit screen behind dark compact things."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Level = NDArray[np.float32]
Mask = NDArray[np.bool_]

CELL_PX = 4
"""Cells of this size are averaged before anything else."""

DARK = 0.05
"""Relative depth from which on something may be a bubble."""

_LEVEL_SCALE_CELLS = 3.0
_EDGE_SHARE = 1 / 3


def level_of_image(image: NDArray[np.generic]) -> tuple[Level, Mask]:
    """(H, W) level in grey values, and (H, W) where it is interpolated under something dark.

    The screen is a surface of degree 4 (log level), fitted to the bright side, then the smoothed
    image itself where that is not dark. A dark band along more than a third of the border is the
    screen's edge, not a bubble.
    """
    import cv2

    height, width = image.shape
    size = (max(4, width // CELL_PX), max(4, height // CELL_PX))
    log = np.log(np.maximum(cv2.resize(image.astype(np.float32), size, None, 0, 0, 3), 0.5))
    surface = bright_surface(log, 4)
    for _ in range(3):
        dark = _dark_things(log, surface)
        filled = np.where(dark, surface + _carried(log - surface, ~dark), log).astype(np.float32)
        surface = cv2.GaussianBlur(filled, (0, 0), _LEVEL_SCALE_CELLS)
    level = np.exp(cv2.resize(surface, (width, height), interpolation=cv2.INTER_CUBIC))
    covered = cv2.resize(dark.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return level.astype(np.float32), covered.astype(bool)


def fill_masked(
    log: Level, mask: Mask, usable: Mask, across: tuple[float, float] | None = None
) -> Level:
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


def _holes(mask: Mask) -> Iterator[tuple[tuple[slice, slice], Mask]]:
    """Windows about the connected parts of a mask, with a margin of half their size."""
    import cv2

    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    for k in range(1, count):
        left, top, width, height, _ = (int(n) for n in stats[k])
        margin = max(12, max(width, height) // 2)
        window = (
            slice(max(0, top - margin), top + height + margin),
            slice(max(0, left - margin), left + width + margin),
        )
        yield window, labels[window] == k


def _carried(residual: Level, known: Mask, across: tuple[float, float] | None = None) -> Level:
    """Weighted means of what is known nearby, the finest scale that reaches a pixel first."""
    import cv2

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


def bright_surface(log: Level, degree: int, known: Mask | None = None) -> Level:
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


def _terms(shape: tuple[int, ...], degree: int) -> NDArray[np.float64]:
    v, u = (np.linspace(-1, 1, n) for n in shape)
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.stack([np.outer(v**i, u**j).ravel() for i, j in powers], axis=1)


def _dark_things(log: Level, surface: Level) -> Mask:
    """Dark against the surface, hearts filled, grown by two cells; the screen's edge left out."""
    import cv2
    from scipy import ndimage

    depth = surface - log
    noise = 1.4826 * float(np.median(np.abs(depth - np.median(depth))))
    dark = depth > max(DARK, 5 * noise)
    dark = without_screen_edge(ndimage.binary_fill_holes(dark))
    grown = cv2.dilate(dark.astype(np.uint8), np.ones((5, 5), np.uint8))
    return np.asarray(grown, bool)


def without_screen_edge(dark: Mask) -> Mask:
    """``dark`` less what covers more than a third of a border: the screen's edge, no bubble."""
    import cv2

    kept = dark.copy()
    count, labels, stats, _ = cv2.connectedComponentsWithStats(dark.astype(np.uint8))
    for k in range(1, count):
        left, top, width, height, _ = stats[k]
        at_side = left == 0 or left + width == dark.shape[1]
        at_top = top == 0 or top + height == dark.shape[0]
        if (at_side and height > _EDGE_SHARE * dark.shape[0]) or (
            at_top and width > _EDGE_SHARE * dark.shape[1]
        ):
            kept[labels == k] = False
    return kept
