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
_ENOUGH_PIXELS = 10_000


def level_of_image(image: NDArray[np.generic]) -> tuple[Float32, Bools]:
    """Estimate the level of the lit screen from a single image with bubbles in front of it.

    Returns the level (H, W) in grey values, and (H, W) where it was interpolated because something
    dark hides the screen.

    A surface of degree 4 is fitted to the logarithm of the brighter pixels. Where the image is not
    dark in comparison with it, the level is the smoothed image itself. A dark band along more than
    a third of the border is the screen's edge and not a bubble.
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
    """Return the logarithm of the image after averaging over square cells of cell_px pixels."""
    size = [max(4, extent // cell_px) for extent in reversed(image.shape)]
    cells = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(np.log(np.maximum(cells, 0.5)))


def fill_masked(
    log: Float32, mask: Bools, usable: Bools, across: tuple[float, float] | None = None
) -> Float32:
    """Return an image with the masked pixels interpolated from the usable ones around them.

    log : (H, W) logarithm of grey levels. mask, usable : (H, W).
    A surface of degree 2 is fitted to the neighbourhood of each masked region. Its residuals around
    the region are interpolated over the region, too, in all directions. If ``across`` is given,
    they are interpolated along one axis of the image only; it is then the distance (u, v) in px
    over which a pixel has influence, small across this axis.
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
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    for k in range(1, count):
        left, top, width, height = boxes[k, :4].tolist()
        margin = max(12, max(width, height) // 2)
        rows = slice(max(0, top - margin), top + height + margin)
        columns = slice(max(0, left - margin), left + width + margin)
        yield (rows, columns), labels[rows, columns] == k


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
    """Return a polynomial surface (H, W) of a degree that is fitted to the brighter pixels.

    Pixels that are much darker than the fit, or not ``known``, are left out. Of a large image only
    every second, third, ... pixel is used.
    """
    thin = (slice(None, None, max(1, int(np.sqrt(log.size / _ENOUGH_PIXELS)))),) * 2
    flat = log[thin].ravel().astype(np.float64)
    usable = np.ones(flat.shape, bool) if known is None else known[thin].ravel()
    powers = [np.linspace(-1, 1, n)[:, None] ** np.arange(degree + 1) for n in log.shape]
    of_v, of_u = np.nonzero(np.add.outer(np.arange(degree + 1), np.arange(degree + 1)) <= degree)
    along_v, along_u = (p[t] for p, t in zip(powers, thin))
    terms = (along_v[:, None, of_v] * along_u[None, :, of_u]).reshape(flat.size, -1)
    keep = usable & (flat > np.quantile(flat[usable], 0.3))
    coefficients: Array = np.zeros(terms.shape[1])
    for _ in range(12):
        chosen = terms[keep]
        normal, right = chosen.T @ chosen, chosen.T @ flat[keep]
        coefficients = np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], np.float64)
        residual = flat - terms @ coefficients
        above = residual[usable & (residual > 0)]
        spread = float(np.median(above)) / 0.6745 if above.size else 0.01
        before, keep = keep, usable & (residual > -max(2.5 * spread, 0.01))
        if np.array_equal(keep, before):
            break
    square = np.zeros((degree + 1, degree + 1))
    square[of_v, of_u] = coefficients
    return (powers[0] @ square @ powers[1].T).astype(np.float32)


def _dark_things(log: Float32, surface: Float32) -> Bools:
    """Dark against the surface, grown by two cells."""
    depth = surface - log
    noise = float(robust_sd(depth - np.median(depth)))
    dark = compact_things(depth > max(DARK, 5 * noise))
    grown = cv2.dilate(dark.astype(np.uint8), np.ones((5, 5), np.uint8))
    return np.asarray(grown, bool)


def compact_things(dark: Bools) -> Bools:
    """Return the dark regions (H, W) that may be bubbles, with bright centres filled.

    A region that covers a third of a border of the image is the screen's edge and is left out.
    """
    kept = dark.astype(np.uint8)
    outlines, _ = cv2.findContours(kept, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(kept, outlines, -1, 1, cv2.FILLED)
    things, rows = kept > 0, len(kept)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(kept)
    for k in range(1, count):
        left, top, width, height = boxes[k, :4].tolist()
        along_side = (left == 0 or left + width == kept.shape[1]) and height > _EDGE_SHARE * rows
        along_top = (top == 0 or top + height == rows) and width > _EDGE_SHARE * kept.shape[1]
        if along_side or along_top:
            things[labels == k] = False
    return things
