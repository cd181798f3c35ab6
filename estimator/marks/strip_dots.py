"""Dots of a strip that is fixed to the tank: where in the image they may be, and each frame's dots.

The luminance fit of `dots` measures them. Blobs that are not as large, as dark and as well fitted
as the strip's dots are left out: bubbles, dirt, and dots that a bubble covers or the border cuts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Ints
from telerig.estimator.dots.fit.candidates import is_unlike
from telerig.estimator.dots.locate import measure_dots
from telerig.statistics import robust_sd

if TYPE_CHECKING:
    from telerig.estimator.dots.fit.candidates import Polarity

Window = tuple[slice, slice]

BORDER_PX = 1.5
"""Least distance between a dot's blurred edge and the image's border."""

_FIRST_SIZE = (0.7, 1.35)
_LEAST_SPREAD = (0.03, 0.03, 0.05, 0.15)
"""Least standard deviations of the `_features` of a strip's dots from frame to frame."""
_LEAST_ROUND, _LEAST_CONTRAST = 0.5, 0.2
_LEAST_FRAMES, _LEAST_SHARE = 3, 0.25
_SYSTEMATIC_PX = 0.005
_RING_TAIL, _RING_STEP = 0.1, 0.25


@dataclass(frozen=True)
class DotLook:
    """The appearance of a strip's dots in one camera, and where in the image they may be.

    windows : parts of the image through which the strip passes.
    diameter_px : nominal diameter.
    a_px, blur_px : medians over the dots of the longer semi-axis and of the blur's standard
        deviation.
    usual, spread : (4,) medians and standard deviations of the `_features`.
    """

    polarity: Polarity
    diameter_px: float
    windows: tuple[Window, ...]
    a_px: float
    blur_px: float
    usual: Array
    spread: Array

    @property
    def margin_px(self) -> float:
        """Least distance of a whole dot's centre from the image's border."""
        return self.a_px + 2 * self.blur_px + BORDER_PX


@dataclass(frozen=True)
class DotSightings:
    """The n dots of one frame: centres uv_px (n, 2), and sigma_px (n,), the standard deviation of
    each centre along u and along v."""

    uv_px: Array
    sigma_px: Array


def learn_look(
    images: Iterable[NDArray[Any]],
    travel_px: Array,
    *,
    polarity: Polarity,
    diameter_px: float,
) -> DotLook | None:
    """Return how the strip's dots look in a sample of images; None if no strip is seen.

    Dots of a strip move along the travel, so they lie at the same distance across it in several
    images.

    travel_px : (2,) direction in which the tank moves through the image.
    polarity, diameter_px : nominal ones of the dots.
    """
    across = np.array([-travel_px[1], travel_px[0]]) / np.linalg.norm(travel_px)
    rows, shape, count = [], (0, 0), 0
    for image in images:
        found = _round_dots(image, polarity, diameter_px)
        rows.append(np.column_stack([np.full(len(found), count), found]))
        shape, count = image.shape, count + 1
    seen = np.concatenate(rows) if rows else np.zeros((0, 1 + len(_COLUMNS)))
    groups = _bands(seen, across, diameter_px)
    if not groups:
        return None
    kept = seen[np.concatenate(groups)]
    features = _features(kept[:, 1:])
    windows = tuple(
        _window(seen[group, 1:3] @ across, across, diameter_px, shape) for group in groups
    )
    usual = np.median(features, axis=0)
    spread = np.maximum(robust_sd(features - usual, axis=0), _LEAST_SPREAD)
    a_px, blur_px = np.median(kept[:, [5, 9]], axis=0)
    return DotLook(polarity, diameter_px, windows, float(a_px), float(blur_px), usual, spread)


def _features(dots: Array) -> Array:
    """Return logs (n, 4) of both semi-axes, of the contrast and of chi2_dof (of 1 where it is less)
    of dots (n, 11), `_COLUMNS`."""
    return np.asarray(np.log(np.column_stack([dots[:, 4:7], np.maximum(dots[:, 7], 1.0)])))


def find_dots(image: NDArray[Any], look: DotLook) -> DotSightings:
    """Return the dots of one frame that look like the strip's and are whole in the image."""
    parts = [np.zeros((0, len(_COLUMNS)))]
    for window in look.windows:
        found = _round_dots(image[window], look.polarity, look.diameter_px)
        free = [_is_free(image[window], dot, look) for dot in found]
        found = found[np.array(free, bool)]
        found[:, :2] += (window[1].start, window[0].start)
        parts.append(found)
    dots = np.concatenate(parts)
    off = (_features(dots) - look.usual) / look.spread
    off[:, 3] = np.maximum(off[:, 3], 0.0)
    good = ~is_unlike(off)
    size = np.array(image.shape[::-1]) - 1
    margin = look.margin_px - 0.5
    good &= np.all((dots[:, :2] > margin) & (dots[:, :2] < size - margin), axis=1)
    kept = _single(dots[good], look.diameter_px)
    sigma = np.sqrt((kept[:, 2] + kept[:, 3]) / 2)
    return DotSightings(kept[:, :2], np.hypot(sigma, _SYSTEMATIC_PX))


_COLUMNS = (
    *("u_px", "v_px", "suu_px2", "svv_px2", "a_px", "b_px", "contrast", "chi2_dof", "blur_px"),
    *("inner_level", "outer_level"),
)


def _is_free(image: NDArray[Any], dot: Array, look: DotLook) -> bool:
    """Whether the screen is seen all round a dot: neither a bubble's edge nor its bright middle."""
    u, v, inner, outer = dot[0], dot[1], dot[9], dot[10]
    first = look.a_px + 3 * look.blur_px
    last = first + max(3.0, 0.8 * look.a_px)
    low = np.maximum(np.floor(np.array([u, v]) - last).astype(int), 0)
    high = np.ceil(np.array([u, v]) + last).astype(int) + 1
    window = image[low[1] : high[1], low[0] : high[0]]
    rows, columns = np.indices(window.shape)
    distance = np.hypot(columns + low[0] - u, rows + low[1] - v)
    ring = window[(distance > first) & (distance < last)]
    off = np.abs(np.quantile(ring, (_RING_TAIL, 1 - _RING_TAIL)) - outer)
    return bool(ring.size > 0 and off.max() < _RING_STEP * abs(outer - inner))


def _round_dots(image: NDArray[Any], polarity: Polarity, diameter_px: float) -> Array:
    """Return (n, 11) _COLUMNS of the dots of about the right size."""
    low, high = (share * diameter_px for share in _FIRST_SIZE)
    if min(image.shape) < 8:
        return np.zeros((0, len(_COLUMNS)))
    dots = measure_dots(
        image, polarity=polarity, min_diameter_px=max(low, 3.0), max_diameter_px=high + 2.0
    ).dots
    inner, outer = (dots[name].to_numpy(float) for name in ("inner_level", "outer_level"))
    contrast = np.abs(outer - inner) / np.maximum(np.maximum(inner, outer), 1e-9)
    table = dots.assign(contrast=contrast)[list(_COLUMNS)].to_numpy(float)
    size = 2 * np.sqrt(table[:, 4] * table[:, 5])
    good = (size > low) & (size < high) & (table[:, 5] > _LEAST_ROUND * table[:, 4])
    good &= (contrast > _LEAST_CONTRAST) & ~dots["ring"].to_numpy(bool)
    return np.asarray(table[good & np.isfinite(table).all(1)])


def _bands(seen: Array, across: Array, diameter_px: float) -> list[Ints]:
    """Return rows of ``seen`` by strip: dots at one distance from the line of travel."""
    if not len(seen):
        return []
    place = seen[:, 1:3] @ across
    order = np.argsort(place)
    cuts = np.flatnonzero(np.diff(place[order]) > 1.5 * diameter_px) + 1
    groups = np.split(order, cuts)
    frames = [len(set(seen[g, 0])) for g in groups]
    least = min(_LEAST_FRAMES, int(seen[:, 0].max()) + 1)
    enough = max(least, _LEAST_SHARE * max(frames))
    counts = [len(g) for g in groups]
    return [g for g, f, n in zip(groups, frames, counts) if f >= enough and n >= 0.2 * max(counts)]


def _window(place: Array, across: Array, diameter_px: float, shape: Sequence[int]) -> Window:
    """Return the part of the image that the band from least to greatest ``place`` crosses."""
    reach = 1.5 * diameter_px + 6
    low, high = float(place.min()) - reach, float(place.max()) + reach
    height, width = shape
    v, u = np.mgrid[0:height:4, 0:width:4]
    at = u * across[0] + v * across[1]
    inside = (at >= low - 4) & (at <= high + 4)
    rows, columns = np.flatnonzero(inside.any(1)) * 4, np.flatnonzero(inside.any(0)) * 4
    return (
        slice(int(rows[0]), min(int(rows[-1]) + 4, height)),
        slice(int(columns[0]), min(int(columns[-1]) + 4, width)),
    )


def _single(dots: Array, diameter_px: float) -> Array:
    """Return the dots without those that are found twice because windows overlap."""
    kept: list[Array] = []
    for dot in dots:
        if all(np.hypot(*(dot[:2] - other[:2])) > diameter_px / 2 for other in kept):
            kept.append(dot)
    return np.array(kept).reshape(-1, len(_COLUMNS))
