"""The level of a backlit screen behind dark compact things."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Bools, Float32

_SHRINK, _CLOSED_SHARE, _PASSES = 8, 4, 3
"""The level is looked for in an image so many times smaller; what is dark and up to a quarter of
its size is closed; the mean is taken so many times."""
_LIT = 0.93
"""Share of the level from which on a pixel shows the screen."""
_OUTSIDE, _LEAST_LEVEL = 0.3, 0.2
"""Level outside of a field, so that it is closed; least level within it; shares of the median."""
_WITHIN = 0.999
"""Share of a pixel of the smaller image that lies in a field of which it shows the screen."""
_TRIMMED_SD, _DEGREE = 2.5, 2
_ENOUGH_PIXELS = 30
_EDGE_SHARE = 1 / 3
"""What is dark along such a share of the border is the edge of the screen, no bubble."""


def screen_level(
    image: NDArray[Any], field: Bools | None = None, *, falls_off: bool = False
) -> Float32:
    """Return the level of the lit screen (rows, columns), from an image with bubbles before it.

    field : (rows, columns) where the image shows the screen; None for everywhere.
    falls_off : whether the light falls off at the field's edge, which the level follows.

    In the image at an eighth of its size, dark things up to a quarter of the image are closed. Then
    a broad mean over all pixels that are not darker than this is taken. This works if every quarter
    of the image shows some of the screen.
    """
    rows, columns = image.shape
    seen, least = image.astype(np.float32, copy=False), np.float32(0.0)
    small_size = (max(columns // _SHRINK, 4), max(rows // _SHRINK, 4))
    within = np.ones(small_size[::-1], bool)
    if field is not None:
        middle = float(np.median(image[field]))
        seen = np.where(field, seen, np.float32(_OUTSIDE * middle))
        least = np.float32(_LEAST_LEVEL * middle)
    if field is not None and not falls_off:
        share = cv2.resize(field.astype(np.float32), small_size, interpolation=cv2.INTER_AREA)
        within = share > _WITHIN
    small = cv2.resize(seen, small_size, interpolation=cv2.INTER_AREA)
    reach = max(3, min(small_size) // _CLOSED_SHARE | 1)
    kernel = np.ones((reach, reach), np.uint8)
    level = cv2.morphologyEx(small, cv2.MORPH_CLOSE, kernel, borderType=cv2.BORDER_REFLECT)
    width = (2 * (reach // 3) + 1,) * 2
    for _ in range(_PASSES):
        lit = ((small > _LIT * level) & within).astype(np.float32)
        lit = cv2.erode(lit, np.ones((3, 3), np.uint8))
        weight = cv2.GaussianBlur(lit, width, 0) + 1e-3 * cv2.GaussianBlur(lit, (0, 0), reach)
        total = cv2.GaussianBlur(lit * small, width, 0)
        total += 1e-3 * cv2.GaussianBlur(lit * small, (0, 0), reach)
        level = np.where(weight > 1e-9, total / np.maximum(weight, 1e-9), level).astype(np.float32)
    whole = cv2.resize(level, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.maximum(whole, least), np.float32)


def log_cells(image: NDArray[np.generic], cell_px: int) -> Float32:
    """Return the logarithm of the image after averaging over square cells of cell_px pixels."""
    size = [max(4, extent // cell_px) for extent in reversed(image.shape)]
    cells = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(np.log(np.maximum(cells, 0.5)))


def fill_masked(log: Float32, mask: Bools, usable: Bools) -> Float32:
    """Return an image with the masked pixels interpolated from the usable ones around them.

    log : (H, W) logarithm of grey levels. mask, usable : (H, W).
    A surface of degree 2 is fitted to the neighbourhood of each masked region. Its residuals around
    the region are interpolated over the region, too.
    """
    surface = log.copy()
    for window, hole in _holes(mask):
        known = usable[window] & ~mask[window]
        if known.sum() > _ENOUGH_PIXELS:
            smooth = _surface(log[window], known)
            carried = smooth + _carried(log[window] - smooth, known)
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


def _carried(residual: Float32, known: Bools) -> Float32:
    """Weighted means of what is known nearby, the finest scale that reaches a pixel first."""
    weight, value = known.astype(np.float32), np.where(known, residual, 0).astype(np.float32)
    result, left = np.zeros_like(value), np.ones_like(value)
    scale = 2.0
    while scale < max(known.shape) and float(left.max()) > 1e-3:
        total, mean = (
            cv2.GaussianBlur(part, (0, 0), scale, borderType=cv2.BORDER_REPLICATE)
            for part in (weight, value)
        )
        share = left * np.minimum(1.0, 4 * total)
        result += share * mean / np.maximum(total, 1e-6)
        left -= share
        scale *= 2
    return result


def _surface(log: Float32, known: Bools) -> Float32:
    """Return a polynomial surface (H, W) fitted to the known pixels, without much darker ones."""
    v, u = (np.linspace(-1.0, 1.0, n) for n in log.shape)
    terms = np.stack(
        [np.outer(v**i, u**j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)], axis=-1
    )
    keep, values = known, log.astype(np.float64)
    for _ in range(2):
        solution = np.linalg.lstsq(terms[keep], values[keep], rcond=None)[0]
        residual = values - terms @ solution
        keep = known & (residual > -_TRIMMED_SD * np.std(residual[keep]))
    return (terms @ solution).astype(np.float32)


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
