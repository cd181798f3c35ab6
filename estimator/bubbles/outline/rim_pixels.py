"""The pixels along the rims of bubbles: gathered for all at once, without glare and dirt."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.bubbles.outline.ellipse_geometry import Foot, Index, rough_distance, spread

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]

_OCTANTS = 8
_UNLIKE_SHARE, _UNLIKE_SIGMA = 0.015, 3.0
_MARGIN_SIGMA = 0.9
_REACH_SIGMA, _REACH_PX = 3.2, 1.2
_THIN_ABOVE_PX = 10.0


@dataclass(frozen=True)
class Pixels:
    """Pixels (N,) of B bubbles, one bubble after the other: ``owner``, place and value.

    ``u`` and ``v`` count from ``origin`` (B, 2), a pixel near the bubble's centre, so that single
    precision serves; ``counts`` (B,) says how many are whose.
    """

    owner: Index
    counts: Index
    origin: Array
    u: Single
    v: Single
    value: Single

    @property
    def bubbles(self) -> int:
        """How many bubbles."""
        return int(self.counts.size)

    def parts(self) -> Iterator[slice]:
        """The slice of each bubble."""
        edges = np.concatenate([[0], np.cumsum(self.counts)]).tolist()
        return (slice(low, high) for low, high in itertools.pairwise(edges))

    def sums(self, values: Single) -> Array:
        """Sum (B,) of values (N,) over each bubble."""
        weights = values.astype(np.float64)
        return np.bincount(self.owner, weights, self.bubbles).astype(np.float64)

    def local(self, ellipse: Array) -> Array:
        """Ellipses (B, 5) with their centres counted from ``origin``."""
        moved = ellipse.copy()
        moved[:, :2] -= self.origin
        return moved

    def hidden(self, ellipse: Array, everyone: Array, reach_px: Array, own: Index) -> Mask:
        """Pixels (N,) within ``reach_px`` (A,) of, or inside, any of the ellipses ``everyone``
        (A, 5) that is not their own, number ``own`` (B,) of these."""
        hidden = np.zeros(self.owner.size, dtype=np.bool_)
        parts = list(self.parts())
        for index, other in close_pairs(ellipse, everyone, reach_px[own], reach_px, own):
            part = parts[index]
            shifted = everyone[other].copy()
            shifted[:2] -= self.origin[index]
            gap = rough_distance(shifted, self.u[part], self.v[part])
            hidden[part] |= gap < reach_px[other]
        return hidden


def close_pairs(
    ellipse: Array, everyone: Array, reach_px: Array, reach_everyone_px: Array, own: Index
) -> list[tuple[int, int]]:
    """Pairs (of B, of A) of ellipses whose surroundings may meet; ``own`` (B,) is left out."""
    size, other_size = ellipse[:, 2] + 2.0 * reach_px, everyone[:, 2] + 2.0 * reach_everyone_px
    gap = np.hypot(
        ellipse[:, None, 0] - everyone[None, :, 0], ellipse[:, None, 1] - everyone[None, :, 1]
    )
    near = gap < size[:, None] + other_size[None, :]
    near[np.arange(own.size), own] = False
    return [(int(i), int(j)) for i, j in np.argwhere(near)]


def rim_pixels(
    ratio: NDArray[np.float32], ellipse: Array, sigma: Array, slack_px: Array, *, thin: bool = False
) -> Pixels:
    """Pixels of ``ratio`` within 3 sigma and ``slack_px`` (B,) of the ellipses (B, 5).

    ``thin``: one in two, one in four round large bubbles.
    """
    reach = _REACH_SIGMA * sigma + _REACH_PX + slack_px
    columns = ratio.shape[1]
    cos, sin = np.cos(ellipse[:, 4]), np.sin(ellipse[:, 4])
    a, b = ellipse[:, 2], ellipse[:, 3]
    half = np.stack([np.hypot(a * cos, b * sin), np.hypot(a * sin, b * cos)], axis=1)
    half += reach[:, None]
    size = ratio.shape[::-1]
    low = np.clip(np.ceil(ellipse[:, :2] - half), 0, size).astype(np.intp)
    high = np.clip(np.floor(ellipse[:, :2] + half) + 1, 0, size).astype(np.intp)
    origin = np.round(ellipse[:, :2])
    step = np.where(thin & (b > _THIN_ABOVE_PX), 2, 1)
    rings = [
        _ring(
            ellipse[k],
            origin[k],
            np.arange(low[k, 0], high[k, 0], step[k]),
            np.arange(low[k, 1], high[k, 1], step[k]),
            float(reach[k]),
        )
        for k in range(len(ellipse))
    ]
    counts = np.array([len(ring[0]) for ring in rings], dtype=np.intp)
    u, v = (np.concatenate([ring[k] for ring in rings]) for k in (0, 1))
    start = (origin[:, 1] * columns + origin[:, 0]).astype(np.intp)
    place = np.repeat(start, counts)
    place += v.astype(np.intp) * columns + u.astype(np.intp)
    owner = np.repeat(np.arange(counts.size), counts)
    return Pixels(owner, counts, origin, u, v, ratio.ravel().take(place))


def _ring(
    ellipse: Array, origin: Array, columns: Index, rows: Index, reach: float
) -> tuple[Single, Single]:
    """Places (n,), counted from ``origin``, of the pixels within ``reach`` of one ellipse."""
    local = ellipse.copy()
    local[:2] -= origin
    u = (columns - origin[0]).astype(np.float32)
    v = (rows - origin[1]).astype(np.float32)
    cos, sin = np.cos(local[4]), np.sin(local[4])
    du, dv = (u - np.float32(local[0]))[None, :], (v - np.float32(local[1]))[:, None]
    a, b = local[2], local[3]
    x = du * np.float32(cos / a) + dv * np.float32(sin / a)
    y = dv * np.float32(cos / b) - du * np.float32(sin / b)
    x *= x
    y *= y
    square = x + y
    x *= np.float32(1.0 / a**2)
    y *= np.float32(1.0 / b**2)
    x += y
    # |g - 1| g / |grad| < reach, with square = g^2 and x = |grad|^2 / 4
    level = np.sqrt(square)
    near = np.flatnonzero((np.abs(level - 1.0) * level) < np.float32(reach) * np.sqrt(x))
    row = near // max(u.size, 1)
    return u.take(near - row * u.size), v.take(row)


def unlike_rim(
    pixels: Pixels, foot: Foot, distance: Single, residual: Single, sigma: Array, contrast: Array
) -> Mask:
    """Pixels (N,) at and beyond the first ring that departs from the model, in each octant.

    Rings are one pixel wide. Inside, a departure towards bright is glare; outside, one towards
    dark is dirt or a neighbour. ``residual`` is in units of the noise, ``contrast`` (B,) too. A
    ring counts when its mean is off by 1.5 % of the contrast and by 3 sigma of its own error.
    """
    depth = np.abs(distance)
    rings = int(np.max(depth, initial=0.0)) + 2
    octant = (foot.cos > 0) * np.intp(4)
    octant += (foot.sin > 0) * np.intp(2)
    octant += np.abs(foot.cos) > np.abs(foot.sin)
    sector = (pixels.owner * _OCTANTS + octant) * 2 + (distance > 0)
    shape = (pixels.bubbles * _OCTANTS * 2, rings)
    key = sector * rings + depth.astype(np.intp)
    count = np.bincount(key, minlength=shape[0] * rings).reshape(shape)
    total = np.bincount(key, weights=residual, minlength=shape[0] * rings).reshape(shape)
    side = np.tile(np.array([1.0, -1.0]), pixels.bubbles * _OCTANTS)[:, None]
    mean = side * total / np.maximum(count, 1)
    limit = _UNLIKE_SHARE * np.repeat(contrast, _OCTANTS * 2)[:, None]
    first_ring = 1.3 * np.repeat(sigma, _OCTANTS * 2)[:, None]
    off = (mean > limit) & (mean * np.sqrt(count) > _UNLIKE_SIGMA) & (count > 1)
    off &= np.arange(rings) >= first_ring
    cut = np.where(np.any(off, axis=1), np.argmax(off, axis=1), rings).astype(np.float32)
    return np.asarray(depth > cut.take(sector) - spread(_MARGIN_SIGMA * sigma, pixels.counts))
