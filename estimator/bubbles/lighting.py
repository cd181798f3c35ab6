"""Whether the outlines found are shadows on a lit screen, or the dark hearts of bright spots."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools
from telerig.rig.outline import points_on

_RINGS = np.linspace(1.1, 1.6, 6)
_INSIDE = 0.8
_AROUND = np.linspace(2.2, 4.0, 7)
_HIDDEN = 2.0
"""Surroundings are looked at so many radii from an outline, and no nearer to another one."""
_LEAST_AROUND = 0.1
"""Least share of an outline's surroundings that is free of others."""
_BRIGHTER = 0.5
"""A shadow's edge is as bright as the screen (0), a dark heart's as its spot (1): an edge that is
brighter than its surroundings by more than this share of the outline's depth is a spot's."""
FEWEST_OUTLINES = 5
"""Fewer outlines do not tell how a scene is lit."""
NOT_BACKLIT = 0.25
"""Share of dark hearts beyond which a scene is not backlit: at most 0.07 in six frames of real
bubbles, 0.8 to 1 in rendered bright spots."""
NOT_BACKLIT_WORDS = (
    "dark hearts of bright spots: the scene is not backlit, and bubbles are looked for as "
    "shadows on a lit screen; put the light behind the bubbles"
)


def on_bright_spots(
    image: NDArray[np.generic], field: Bools | None, ellipse: Array, others: Sequence[Array]
) -> tuple[Bools, Bools]:
    """Return which outlines are dark hearts of bright spots, and of which the surroundings are
    seen, so that this can be told.

    image : (rows, columns) grey levels. field : (rows, columns) of the lit screen, or None.
    ellipse : (B, 5) u, v, a, b (px) and angle. others : outlines (n, 2) of other dark regions.
    """
    free = np.ones(image.shape, np.uint8) if field is None else field.astype(np.uint8)
    for u, v, a, b, angle in ellipse:
        box = (u, v), (2 * _HIDDEN * a, 2 * _HIDDEN * b), float(np.degrees(angle))
        cv2.ellipse(free, box, 0, cv2.FILLED)
    for outline in others:
        known = outline[np.isfinite(outline).all(axis=1)]
        cv2.fillPoly(free, [np.rint(known).astype(np.int32)], 0)
    far = _light(image, free, ellipse, _AROUND)
    edge = np.fmax.reduce(_median(_light(image, None, ellipse, _RINGS)), -1)
    inside = _median(_light(image, None, ellipse, np.array([_INSIDE]))[:, 0])
    around = _median(far.reshape(len(far), len(_AROUND) * far.shape[-1]))
    seen = np.isfinite(edge + inside) & (np.isfinite(far).mean((1, 2)) > _LEAST_AROUND)
    return seen & (edge - around > _BRIGHTER * (edge - inside)), seen


def share_of_hearts(bright: Bools, seen: Bools) -> float:
    """Return the share of dark hearts among the outlines that `on_bright_spots` could judge, of one
    image or of several; 0 if these are too few to tell how the scene is lit."""
    few = np.count_nonzero(seen) < FEWEST_OUTLINES
    return 0.0 if few else float(np.mean(bright[seen]))


def _light(
    image: NDArray[np.generic], free: NDArray[np.uint8] | None, ellipse: Array, scales: Array
) -> Array:
    """Return grey levels (B, R, 32) on ellipses (B, 5) scaled by R numbers, NaN where none is."""
    phi = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    scaled = np.repeat(ellipse[:, None], len(scales), 1)
    scaled[..., 2:4] *= scales[:, None]
    flat = scaled.reshape(-1, 5)
    at = points_on(flat, np.zeros((len(flat), 8)), phi).reshape(len(ellipse), len(scales), 32, 2)
    u, v = np.moveaxis(np.rint(at).astype(int), -1, 0)
    rows, columns = image.shape
    there = (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    u, v = np.where(there, u, 0), np.where(there, v, 0)
    if free is not None:
        there &= free[v, u] > 0
    return np.where(there, image[v, u].astype(float), np.nan)


def _median(values: Array) -> Array:
    """Return the (lower) median along the last axis of what is not NaN; NaN where nothing is.

    `numpy.nanmedian` of many short rows takes fifty times as long.
    """
    middle = np.maximum(np.isfinite(values).sum(-1, keepdims=True) - 1, 0) // 2
    return np.take_along_axis(np.sort(values, -1), middle, -1)[..., 0]
