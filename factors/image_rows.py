"""Measured dots on padded grids, a few images at a time: the layout of the fast evaluation.

Images stand in the order camera, view. Where most images see most dots the columns of the grid are
the dots themselves; elsewhere each image's dots stand side by side. Components come first and dots
last, so that every operation runs along memory; a chunk is small enough to stay in the cache.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from telerig.factors.projection import Observations
from telerig.rig.windows import Wall

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

CHUNK = 4000
"""Measured dots evaluated at once, about: fewer cost calls, more leave the cache."""
DENSE = 0.6
"""Share of the dots that images see on average, above which columns are dots."""


@dataclass(frozen=True)
class Entries:
    """The measured dots of one camera in a chunk, image by image.

    image, slot, dot : (r,) which of the camera's images, its column, its dot.
    order : (r,) sorts them by dot.  distinct : the dots there are.  first : where each begins.
    """

    image: Ints
    slot: Ints
    dot: Ints
    order: Ints
    distinct: Ints
    first: Ints


@dataclass(frozen=True)
class ImageRows:
    """I images of up to m dots.

    camera, view : (I,).  cameras : (camera, its images) of every camera present.
    dot : (I, m); where nothing was measured, one that the image does see.
    entries : per camera present, where its dots stand; None when the columns are the dots.
    uv_px : (2, I, m).  whitener : (2, 2, I, m), zero where nothing was measured.
    plate_shift : (I,).  plate, walls : as in `Observations`.
    """

    camera: Ints
    view: Ints
    cameras: tuple[tuple[int, slice], ...]
    dot: Ints
    entries: tuple[Entries, ...] | None
    uv_px: Array
    whitener: Array
    plate_shift: Array
    plate: tuple[float, float]
    walls: tuple[Wall | None, ...]


def in_chunks(obs: Observations, dot_count: int, chunk: int | None = None) -> list[ImageRows]:
    """All measurements in chunks of whole images, `CHUNK` unless said otherwise."""
    chunk = CHUNK if chunk is None else chunk
    views = int(obs.view.max(initial=-1)) + 1
    image = obs.camera * views + obs.view
    order = np.argsort(image, kind="stable")
    present, first, size = np.unique(image[order], return_index=True, return_counts=True)
    dense = len(obs) > DENSE * len(present) * dot_count and not any(obs.walls)
    width = np.full(len(present), dot_count) if dense else size
    # of about equal size, so that none costs its calls for a few dots
    parts = max(1, round(int(width.sum()) / chunk))
    chunk = int(np.ceil(-(-len(present) // parts) * width.mean())) if len(present) else chunk
    out, start = [], 0
    while start < len(present):
        stop = start + 1
        while stop < len(present) and width[start : stop + 1].max() * (stop + 1 - start) <= chunk:
            stop += 1
        rows = order[first[start] : first[start] + size[start:stop].sum()]
        out.append(_padded(obs, rows, first[start:stop] - first[start], size[start:stop], dot_count,
                           dense))  # fmt: skip
        start = stop
    return out


def _padded(
    obs: Observations, rows: Ints, first: Ints, size: Ints, dot_count: int, dense: bool
) -> ImageRows:
    images = len(size)
    image = np.repeat(np.arange(images), size)
    slot = obs.dot[rows] if dense else np.arange(len(rows)) - np.repeat(first, size)
    shape = (images, dot_count if dense else int(size.max()))
    dot = np.repeat(obs.dot[rows[first]][:, None], shape[1], 1)
    dot[image, slot] = obs.dot[rows]
    uv, whitener = np.zeros((2, *shape)), np.zeros((2, 2, *shape))
    uv[:, image, slot] = obs.uv_px[rows].T
    whitener[:, :, image, slot] = np.moveaxis(obs.whitener[rows], 0, -1)
    camera, view = obs.camera[rows[first]], obs.view[rows[first]]
    shift = obs.plate_shift[view, camera]
    distinct, edges = np.unique(camera, return_index=True)
    edges = np.append(edges, images)
    cameras = tuple((int(c), slice(int(a), int(b))) for c, (a, b) in zip(distinct, pairwise(edges)))
    entries = None
    if not dense:
        of_camera = [np.flatnonzero(obs.camera[rows] == c) for c, _ in cameras]
        entries = tuple(_entries(image[r], slot[r], obs.dot[rows[r]]) for r in of_camera)
    return ImageRows(camera, view, cameras, dot, entries, uv, whitener, shift, obs.plate, obs.walls)


def _entries(image: Ints, slot: Ints, dot: Ints) -> Entries:
    order = np.argsort(dot, kind="stable")
    distinct, first = np.unique(dot[order], return_index=True)
    return Entries(image - image.min(), slot, dot, order, distinct, first)
