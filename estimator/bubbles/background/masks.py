"""Where each frame's bubbles are, before any background is known; dirt is left out.

A bubble that the rig follows hides the same pixels in most frames, so no quantile over frames can
see behind it. It is far darker than any screen is uneven, and that is seen in single frames. Dirt
is as dark, but stays still: in the image, or in the lab.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.bubbles.background.from_one_image import (
    bright_surface,
    compact_things,
    log_cells,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CELL_PX = 2

DEEP = 0.2
"""Depth (of log grey) from which on a dark thing is a bubble, or dirt."""

OFTEN = 0.4
"""Share of frames that hide a pixel from which on quantiles over frames are in danger."""

_STILL, _GONE, _RING_SHARE = 0.9, 0.3, 0.7
_CHANGES = 0.25
_LEAST_SEEN, _FEW = 5, 10


def first_masks(stack: NDArray[np.generic], shifts_px: Array | None, gains: Array) -> Mask:
    """(n, H, W) pixels of n images that a bubble probably hides, where that happens often.

    Elsewhere quantiles over frames do better, as they need no threshold.

    shifts_px : (n, 2) travel (u, v) of what is fixed in the lab; None when nothing moves.
    gains : (n,) log brightness of the frames.
    """
    import cv2

    height, width = stack.shape[1:]
    log = np.stack([log_cells(image, _CELL_PX) - gain for image, gain in zip(stack, gains)])
    surface = bright_surface(np.quantile(log, 0.8, axis=0).astype(np.float32), 4)
    dark = np.stack([compact_things(surface - frame > DEEP) for frame in log])
    keep = dark & ~_still(dark.mean(0), np.ones(dark.shape[1:], bool), 2)
    places = _lab_places(shifts_px, dark.shape)
    if places:
        share, seen = _share_in_lab(dark, places)
        still = _still(share, seen >= min(_LEAST_SEEN, len(dark)), 3)
        keep &= ~np.stack([still[place] for place in places])
    grow = np.ones((5, 5), np.uint8)
    grown = np.stack([cv2.dilate(mask.astype(np.uint8), grow) for mask in keep])
    often = np.broadcast_to(grown.mean(0) > OFTEN, grown.shape)
    if places:
        share, seen = _share_in_lab(grown, places)
        hidden = (share > OFTEN) & (seen < _FEW)
        often = often | np.stack([hidden[place] for place in places])
    grown *= often
    masks = np.stack([cv2.resize(m, (width, height), interpolation=0) for m in grown]) > 0
    masks &= ~_fringe(stack, gains, masks)
    return masks


def _fringe(stack: NDArray[np.generic], gains: Array, masks: Mask) -> Mask:
    """(H, W) pixels at the border of what is always hidden that hardly change: dirt beside it.

    A bubble's own border moves, if only by a pixel, and parts its still inside from the outside.
    """
    import cv2

    never = masks.mean(0) > 1 - 1.5 / len(masks)
    values = np.log(np.maximum(stack[:, never].astype(np.float32), 0.5)) - gains[:, None]
    low, high = np.quantile(values, (0.1, 0.9), axis=0)
    steady = ~never
    steady[never] = high - low < _CHANGES
    _, labels = cv2.connectedComponents(steady.astype(np.uint8), connectivity=4)
    outside = np.unique(labels[~never])
    return np.asarray(never & np.isin(labels, outside[outside > 0]), bool)


def _still(share: Array, known: Mask, margin: int) -> Mask:
    """Things dark in nearly all frames, grown by ``margin`` cells, beyond which few are dark."""
    import cv2

    core = (share >= _STILL) & known
    count, labels = cv2.connectedComponents(core.astype(np.uint8))
    still = np.zeros(share.shape, np.uint8)
    for k in range(1, count):
        thing = (labels == k).astype(np.uint8)
        near = cv2.dilate(thing, np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))
        ring = (cv2.dilate(near, np.ones((3, 3), np.uint8)) > near) & known
        if ring.any() and np.quantile(share[ring], _RING_SHARE) < _GONE:
            still |= near
    return still.astype(bool)


def _lab_places(shifts_px: Array | None, shape: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """Where each frame's cells lie on a canvas of the lab; empty when nothing moves."""
    if shifts_px is None:
        return []
    shifts = np.rint(shifts_px / _CELL_PX).astype(int)
    return [(slice(v, v + shape[1]), slice(u, u + shape[2])) for u, v in shifts - shifts.min(0)]


def _share_in_lab(marks: Mask, places: list[tuple[slice, slice]]) -> tuple[Array, Array]:
    """On the canvas: the share of the frames that see a cell which mark it, and their number."""
    size = [max(place[axis].stop for place in places) for axis in (0, 1)]
    total, seen = np.zeros(size), np.zeros(size)
    for mask, place in zip(marks, places):
        total[place] += mask
        seen[place] += 1
    return total / np.maximum(seen, 1), seen
