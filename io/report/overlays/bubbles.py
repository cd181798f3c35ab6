"""Outlines of bubbles drawn over their image, and filled as a binary picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.io.report.overlays.dots import (
    GREEN,
    RED,
    Picture,
    fixed,
    grey_picture,
    legend,
    write_label,
)

Array = NDArray[np.float64]
Colour = tuple[int, int, int]
Rejected = tuple[float, float, float, str]

_FRACTION_BITS = 4
_LEAST_CONTRAST = 0.6
_ROOM_PX = 9
"""An outline wider than twice this has its label inside."""

_FINEST_PX = 2.0
"""A circle round what was rejected is at least so large, to be seen."""


def draw_bubble_overlay(
    image: NDArray[Any],
    outlines: Sequence[Array],
    labels: Sequence[str],
    colours: Sequence[Colour] | Colour = GREEN,
    *,
    rejected: Sequence[Rejected] = (),
    max_width_px: int = 900,
) -> Picture:
    """The image, not wider than max_width_px, with its bubbles: an RGB picture (h, w, 3).

    image : grey (H, W), 8 or 16 bit or float. outlines : each (N, 2) px of the image, closed;
    points that are not finite are passed over. labels : one each, "" for none; a label stands in
    the outline's middle, or beside it where other text is, or nowhere. colours : RGB, one each or
    one for all. rejected : (u, v, radius, reason) is circled in red with the number of its reason,
    which the legend underneath spells out with its count.

    Raises InputError for what is no grey image, and for labels or colours that do not fit.
    """
    shades = _checked(image, outlines, labels, colours)
    factor = min(1.0, max_width_px / image.shape[1])
    picture = grey_picture(image, factor, _LEAST_CONTRAST)
    reasons = Counter(reason for *_, reason in rejected)
    numbers = {reason: i + 1 for i, (reason, _) in enumerate(reasons.most_common())}
    circles = [_circle(u, v, radius, factor) for u, v, radius, _ in rejected]
    for circle in circles:
        _draw(picture, circle, factor, RED)
    for outline, shade in zip(outlines, shades):
        _draw(picture, outline, factor, shade)
    taken = np.zeros(picture.shape[:2], bool)
    for outline, label, shade in zip(outlines, labels, shades):
        _write(picture, outline, label, factor, shade, taken)
    for circle, (*_, reason) in zip(circles, rejected):
        _write(picture, circle, str(numbers[reason]), factor, RED, taken)
    lines = [f"{len(outlines)} bubbles, {len(rejected)} rejected"]
    lines += [f"{n}: {reason} ({reasons[reason]})" for reason, n in numbers.items()]
    return np.concatenate([picture, legend(lines, picture.shape[1])])


def draw_binary(
    shape: tuple[int, int], outlines: Sequence[Array], max_width_px: int = 900
) -> NDArray[np.uint8]:
    """(h, w), 255 where at least half of the pixel lies inside an outline, else 0.

    shape : (H, W) of the image, whose pixels the outlines (N, 2) are in.
    """
    from telerig.io.images.outline_raster import cell_coverage

    factor = min(1.0, max_width_px / shape[1])
    picture = np.zeros([max(1, round(n * factor)) for n in shape[:2]], np.uint8)
    for outline in outlines:
        corners = (_finite(outline) + 0.5) * factor
        if len(corners) < 3:
            continue
        low = np.floor(corners.min(axis=0)).astype(int)
        columns, rows = np.ceil(corners.max(axis=0)).astype(int) - low + 1
        inside = cell_coverage(corners - low, (int(rows), int(columns))) >= 0.5
        row, column = np.nonzero(inside)
        row, column = row + low[1], column + low[0]
        seen = (row >= 0) & (row < picture.shape[0]) & (column >= 0) & (column < picture.shape[1])
        picture[row[seen], column[seen]] = 255
    return picture


def _checked(
    image: NDArray[Any],
    outlines: Sequence[Array],
    labels: Sequence[str],
    colours: Sequence[Colour] | Colour,
) -> list[Colour]:
    """One colour per outline."""
    if image.ndim != 2 or min(image.shape) < 1:
        raise InputError(
            f"an overlay is drawn on a grey image, this one has shape {image.shape}",
            todo="pass one channel, (height, width)",
        )
    alike = len(colours) == 3 and all(np.ndim(part) == 0 for part in colours)
    shades: list[Any] = [colours] * len(outlines) if alike else list(colours)
    if not len(outlines) == len(labels) == len(shades):
        raise InputError(
            f"{len(outlines)} outlines, {len(labels)} labels and {len(shades)} colours",
            todo="pass one label and one colour for each outline",
        )
    return [tuple(int(part) for part in shade) for shade in shades]  # type: ignore[misc]


def _finite(outline: Array) -> Array:
    points = np.asarray(outline, float).reshape(-1, 2)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def _circle(u: float, v: float, radius: float, factor: float) -> Array:
    size = max(radius, _FINEST_PX / factor) if np.isfinite(radius) else 4 * _FINEST_PX / factor
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    return np.stack([u + size * np.cos(turn), v + size * np.sin(turn)], -1)


def _draw(picture: Picture, outline: Array, factor: float, colour: Colour) -> None:
    import cv2

    points = (_finite(outline) + 0.5) * factor - 0.5
    if len(points) > 1:
        corners = np.array([fixed(p) for p in points], np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [corners], True, colour, 1, cv2.LINE_AA, _FRACTION_BITS)


def _write(
    picture: Picture,
    outline: Array,
    label: str,
    factor: float,
    colour: Colour,
    taken: NDArray[np.bool_],
) -> None:
    points = (_finite(outline) + 0.5) * factor
    if not label or not len(points):
        return
    low, high = points.min(axis=0), points.max(axis=0)
    middle, reach = (low + high) / 2, (high - low) / 2
    steps = [(1, 0), (-1, 0), (0, -1), (0, 1)]
    if reach.min() > _ROOM_PX:
        steps = [(0, 0), *steps]
    places = [middle + (reach + _ROOM_PX) * step for step in steps]
    any(write_label(picture, label, place, colour, taken) for place in places)
