"""The pixels along the rims of bubbles: gathered for all at once, cleared of hearts and dirt."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.frontend.bubble_geometry import Foot, Index, rough_distance

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_OCTANTS = 8
_UNLIKE_SHARE, _UNLIKE_SIGMA = 0.03, 3.0


@dataclass(frozen=True)
class Pixels:
    """Pixels (N,) of B bubbles, one bubble after the other: ``owner``, place and value.

    ``first`` (B + 1,) says where each bubble's begin.
    """

    owner: Index
    u: Array
    v: Array
    value: Array
    first: Index

    @property
    def bubbles(self) -> int:
        """How many bubbles."""
        return int(self.first.size - 1)

    def parts(self) -> Iterator[slice]:
        """The slice of each bubble."""
        edges = self.first.tolist()
        return (slice(low, high) for low, high in zip(edges[:-1], edges[1:], strict=True))

    def sums(self, values: Array) -> Array:
        """Sum (B,) of values (N,) over each bubble."""
        return np.bincount(self.owner, weights=values, minlength=self.bubbles)

    def hidden(self, ellipse: Array, reach_px: Array) -> Mask:
        """Pixels (N,) within ``reach_px`` (B,) of, or inside, a bubble that is not their own."""
        hidden = np.zeros(self.owner.size, dtype=np.bool_)
        edges = self.first
        for index, other in close_pairs(ellipse, 2.0 * reach_px):
            part = slice(edges[index], edges[index + 1])
            gap = rough_distance(ellipse[other], self.u[part], self.v[part])
            hidden[part] |= gap < reach_px[other]
        return hidden


def close_pairs(ellipse: Array, reach_px: Array) -> list[tuple[int, int]]:
    """Ordered pairs of ellipses (B, 5) whose surroundings of width ``reach_px`` (B,) may meet."""
    size = ellipse[:, 2] + reach_px
    gap = np.hypot(
        ellipse[:, None, 0] - ellipse[None, :, 0], ellipse[:, None, 1] - ellipse[None, :, 1]
    )
    near = gap < size[:, None] + size[None, :]
    np.fill_diagonal(near, False)
    return [(int(i), int(j)) for i, j in np.argwhere(near)]


def rim_pixels(ratio: NDArray[np.float32], ellipse: Array, sigma: Array) -> Pixels:
    """Pixels of ``ratio`` within 4 sigma and 2 px of the ellipses (B, 5)."""
    reach = 4.0 * sigma + 2.0
    rows, columns = ratio.shape
    cos, sin = np.cos(ellipse[:, 4]), np.sin(ellipse[:, 4])
    half_u = np.hypot(ellipse[:, 2] * cos, ellipse[:, 3] * sin) + reach
    half_v = np.hypot(ellipse[:, 2] * sin, ellipse[:, 3] * cos) + reach
    left = np.clip(np.ceil(ellipse[:, 0] - half_u), 0, columns).astype(np.intp)
    right = np.clip(np.floor(ellipse[:, 0] + half_u) + 1, 0, columns).astype(np.intp)
    top = np.clip(np.ceil(ellipse[:, 1] - half_v), 0, rows).astype(np.intp)
    bottom = np.clip(np.floor(ellipse[:, 1] + half_v) + 1, 0, rows).astype(np.intp)
    width, height = np.maximum(right - left, 0), np.maximum(bottom - top, 0)
    sizes = width * height
    owner = np.repeat(np.arange(sizes.size), sizes)
    place = np.arange(owner.size) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    row = place // width.take(owner)
    column = place - row * width.take(owner) + left.take(owner)
    row += top.take(owner)
    gap = rough_distance(ellipse.take(owner, axis=0), column, row)
    near = np.flatnonzero(np.abs(gap) < reach.take(owner))
    owner, row, column = owner[near], row[near], column[near]
    first = np.searchsorted(owner, np.arange(sizes.size + 1))
    value = ratio.ravel().take(row * columns + column).astype(np.float64)
    return Pixels(owner, column.astype(np.float64), row.astype(np.float64), value, first)


def unlike_rim(pixels: Pixels, foot: Foot, residual: Array, sigma: Array, contrast: Array) -> Mask:
    """Pixels (N,) at and beyond the first ring that departs from the model, in each octant.

    Rings are one pixel wide. Inside, a departure towards bright is a heart; outside, one towards
    dark is dirt or a neighbour. ``residual`` is in units of the noise, ``contrast`` (B,) too. A
    ring counts when its mean is off by 3 % of the contrast and by 3 sigma of its own error.
    """
    depth = np.abs(foot.distance)
    rings = int(np.max(depth, initial=0.0)) + 2
    cos_big = np.abs(foot.cos) > np.abs(foot.sin)
    octant = (foot.cos > 0) * 4 + (foot.sin > 0) * 2 + cos_big
    sector = (pixels.owner * _OCTANTS + octant) * 2 + (foot.distance > 0)
    ring = depth.astype(np.intp)
    shape = (pixels.bubbles * _OCTANTS * 2, rings)
    key = sector * rings + ring
    count = np.bincount(key, minlength=shape[0] * rings).reshape(shape)
    total = np.bincount(key, weights=residual, minlength=shape[0] * rings).reshape(shape)
    side = np.tile(np.array([1.0, -1.0]), pixels.bubbles * _OCTANTS)[:, None]
    mean = side * total / np.maximum(count, 1)
    limit = _UNLIKE_SHARE * np.repeat(contrast, _OCTANTS * 2)[:, None]
    first_ring = 1.3 * np.repeat(sigma, _OCTANTS * 2)[:, None]
    off = (mean > limit) & (mean * np.sqrt(count) > _UNLIKE_SIGMA) & (count > 1)
    off &= np.arange(rings) >= first_ring
    cut = np.where(np.any(off, axis=1), np.argmax(off, axis=1), rings)
    margin = 0.5 * sigma.take(pixels.owner)
    unlike: Mask = depth > cut.take(sector) - margin
    return unlike
