"""Dark blobs in front of a lit screen, and the bubbles in each of them.

Blobs are found by a threshold that follows the noise, and traced at half of their depth. The
outline of a union of convex discs turns inwards only where one disc's rim meets another's. Each arc
between such notches belongs to one disc; arcs on both sides of a neighbour may belong to the same
one. A hypothesis is sound when the ellipse runs along its arcs and no outline point of the blob
lies inside it; a blob whose outline and area such ellipses do not explain stays whole and is called
merged.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Float32, Ints
from telerig.estimator.bubbles.outline import kernels
from telerig.estimator.bubbles.outline.ellipse_geometry import rough_distance
from telerig.estimator.bubbles.outline.outline_fit import ellipses_along
from telerig.estimator.images.noise import clipped_sigma, high_pass

_NOISE_SAMPLES = 20_000
_BAND_ROWS, _LEAST_BANDS = 16, 6
_ENOUGH_LIT, _ENOUGH_DARK, _LEAST_NOISE = 200, 120, 1e-4
_FAINT_SHARE = 0.5
_LOW_SIGMA = 6.0
_DARKEST = 0.05
_LIT, _DARK = 0.85, 0.3
_LEAST_OUTLINE, _STEEP_SHARE = 5, 0.6
_MAX_CUT_CENTRE_SHARE = 0.6

Box = tuple[int, int, int, int]
"""First column u and row v, width and height of a region."""


@dataclass(frozen=True)
class Blob:
    """One dark region of an image that was divided by its background.

    contour_px : (n, 2) closed outline at half depth, to about 0.1 px.
    inner : grey level inside (the background is 1).
    blur_px : standard deviation of the edge's blur.
    touches_border : whether it touches the image's border.
    within : whether another region surrounds it: it may be a bubble in front of a bright heart.
    """

    contour_px: Array
    inner: float
    blur_px: float
    box: Box
    touches_border: bool
    within: bool = False


class Rejected(NamedTuple):
    """A dark region that is no bubble: its centre, its radius, and the reason in words."""

    u_px: float
    v_px: float
    radius_px: float
    reason: str


def noise_shares(ratio: Float32, field: Bools | None = None) -> Array:
    """Return the noise (2,) of the free screen and of what is evenly dark before it.

    Both are standard deviations of a pixel, as shares of the background. They are estimated after
    `high_pass`, which removes smooth changes; of a large image only some bands of rows are used.
    Dark pixels show fewer photons: their noise is at most that of the screen. Structure in the dark
    makes it too large, not too small.

    ratio : image divided by its background. field : (rows, columns) where the screen is; None for
    everywhere.
    """
    found, kinds = [], []
    bands = max(_NOISE_SAMPLES // (_BAND_ROWS * ratio.shape[1]), _LEAST_BANDS)
    for first in range(0, max(len(ratio) - _BAND_ROWS, 0) + 1, max(len(ratio) // bands, 14)):
        band = ratio[first : first + _BAND_ROWS]
        bright, dark = band > _LIT, band < _DARK
        if field is not None:
            bright &= field[first : first + _BAND_ROWS]
        free = cv2.erode(bright.view(np.uint8), np.ones((3, 7), np.uint8))
        even = cv2.erode(dark.view(np.uint8), np.ones((5, 5), np.uint8), borderValue=0)
        found.append(high_pass(band)[1:-1].ravel())
        kinds.append((free + 2 * even)[1:-1].ravel())
    response, kind = np.concatenate(found), np.concatenate(kinds)
    free, even = response[kind == 1], response[kind == 2]
    lit = _sigma(free if free.size > _ENOUGH_LIT else response)
    inside = min(_sigma(even), lit) if even.size > _ENOUGH_DARK else lit
    return np.maximum([lit, inside], _LEAST_NOISE)


def _sigma(values: Float32) -> float:
    thin = values[:: max(1, values.size // _NOISE_SAMPLES)]
    return clipped_sigma(thin.astype(np.float64), rounds=6)


def find_blobs(
    ratio: Float32, *, sigma: float, min_contrast: float, min_diameter_px: float
) -> tuple[list[Blob], list[Rejected]]:
    """Find the dark regions of an image that was divided by its background.

    A region consists of connected pixels that are darker than a faint shadow, and it must contain
    pixels darker than ``1 - min_contrast``. Its outline is traced at half of its own depth.

    sigma : noise of the screen. min_diameter_px : smallest diameter of a bubble.
    Returns the regions that may be bubbles, and those that are too small or too faint.
    """
    low = 1.0 - max(_FAINT_SHARE * min_contrast, min(_LOW_SIGMA * sigma, 0.9 * min_contrast))
    shadow = (ratio < np.float32(low)).view(np.uint8)
    regions, tree = cv2.findContours(shadow, cv2.RETR_TREE, cv2.CHAIN_APPROX_NONE)
    depth, blobs, rejected = _depths(tree), [], []
    for k, region in enumerate(regions):
        if depth[k] % 2 or len(region) < _LEAST_OUTLINE:
            continue
        box = x, y, width, height = tuple(cv2.boundingRect(region))
        found, reason = [], f"smaller than {min_diameter_px:g} px"
        if max(width, height) >= min_diameter_px:
            window = slice(y, y + height), slice(x, x + width)
            dark, part = np.zeros((height, width), np.uint8), ratio[window]
            filled = [region, *_holes(regions, tree, k)]
            cv2.drawContours(dark, filled, -1, (1,), cv2.FILLED, offset=(-x, -y))
            dark &= shadow[window]
            inner = _darkest(part[dark > 0])
            if inner > 1.0 - min_contrast:
                reason = f"contrast {1.0 - inner:.2f} is below {min_contrast:g}"
            else:
                dark &= (part < np.float32(0.5 * (1.0 + inner))).view(np.uint8)
                _close_at_border(dark, box, ratio.shape)
                found = _traced(ratio, dark, box, inner, depth[k] > 0, min_diameter_px)
        if not found:
            radius = 0.5 * float(np.sqrt(width * height))
            rejected.append(Rejected(x + (width - 1) / 2, y + (height - 1) / 2, radius, reason))
        blobs += found
    return blobs, rejected


def _darkest(values: Float32) -> float:
    """Return the level of the darkest 5 % of a region's pixels, between 0 and 1."""
    place = int(_DARKEST * values.size)
    return float(np.clip(np.partition(values, place)[place], 0.0, 0.999))


def _depths(tree: NDArray[np.int32] | None) -> list[int]:
    """Return how many outlines are around each one: 0 for regions, odd for their bright holes."""
    parents = [] if tree is None else tree[0, :, 3].tolist()
    depths = []
    for parent in parents:
        depth = 0
        while parent >= 0:
            depth, parent = depth + 1, parents[parent]
        depths.append(depth)
    return depths


def _holes(
    regions: Sequence[NDArray[Any]], tree: NDArray[np.int32], region: int
) -> Iterator[NDArray[Any]]:
    """Yield the outlines of a region's bright holes."""
    hole = int(tree[0, region, 2])
    while hole >= 0:
        yield regions[hole]
        hole = int(tree[0, hole, 0])


def _close_at_border(dark: NDArray[np.uint8], box: Box, shape: tuple[int, ...]) -> None:
    """Join what is dark of a region along the image's edges: a bright centre cut by the edge
    becomes a hole.

    dark : (height, width) of the region's box, which is changed; shape : of the image.
    """
    x, y, width, height = box
    edges = [(y == 0, dark[0]), (x == 0, dark[:, 0])]
    edges += [(y + height == shape[0], dark[-1]), (x + width == shape[1], dark[:, -1])]
    for line in (line for at_edge, line in edges if at_edge):
        places = np.flatnonzero(line)
        for k in np.flatnonzero(np.diff(places) > 1).tolist():
            if places[k + 1] - places[k] <= _MAX_CUT_CENTRE_SHARE * (np.ptp(places) + 1):
                line[places[k] : places[k + 1]] = 1


def _traced(
    ratio: Float32, dark: NDArray[np.uint8], box: Box, inner: float, within: bool, least_px: float
) -> list[Blob]:
    """Return the blobs of a region, with outline points moved along the gradient to half depth.

    dark : (height, width) what is darker than half depth in the region's box.
    """
    outlines, tree = cv2.findContours(dark, cv2.RETR_TREE, cv2.CHAIN_APPROX_NONE, offset=box[:2])
    blobs = []
    for outline, level in zip(outlines, _depths(tree), strict=True):
        if level % 2 or len(outline) < _LEAST_OUTLINE:
            continue
        if max(cv2.boundingRect(outline)[2:]) < least_px:
            continue
        pixels = outline.reshape(-1, 2)
        points, slope = np.empty(pixels.shape), np.empty(len(pixels))
        kernels.move_to_half_depth(ratio, pixels, inner, points, slope)
        place = int(_STEEP_SHARE * slope.size)
        steepest = float(np.partition(slope, place)[place])
        blur = (1.0 - inner) / (np.sqrt(2.0 * np.pi) * max(steepest, 1e-6))
        blur = float(np.sqrt(max(blur**2 - 0.6, 0.15)))
        at_border = not np.all(np.isfinite(points))
        blobs.append(Blob(points, inner, blur, box, at_border, within or level > 0))
    return blobs


_TURN_RAD, _FLAT = -0.1, 0.5
"""Turn at a notch, and share of a circle's turn below which an outline is flat."""
_SHORTEST_ARC = 5


def contour_moments(contours: list[Array]) -> tuple[Array, Array, Array]:
    """Return the ellipses (B, 5) with the same area moments as B contours.

    Also returns the RMS and the largest distance (B,) of each contour's points from its ellipse.
    Points that are NaN (beyond the image) do not count.
    """
    found, used = [], []
    for contour in contours:
        points = contour[np.isfinite(contour[:, 0])]
        points = points if len(points) >= 3 else np.eye(3, 2)
        m = cv2.moments(points.astype(np.float32)[:, None])
        area = m["m00"] or 1e-9
        found.append([m[name] / area for name in ("m10", "m01", "mu20", "mu02", "mu11")])
        used.append(points)
    u, v, uu, vv, uv = np.array(found).T
    middle, half = (uu + vv) / 2.0, np.hypot((uu - vv) / 2.0, uv)
    a, b = 2.0 * np.sqrt(np.maximum([middle + half, middle - half], 0.1))
    ellipses = np.stack([u, v, a, b, 0.5 * np.arctan2(2.0 * uv, uu - vv)], axis=1)
    sizes = np.array([len(points) for points in used])
    first = np.cumsum(sizes) - sizes
    gap = rough_distance(np.repeat(ellipses, sizes, axis=0), *np.concatenate(used).T)
    rms = np.sqrt(np.add.reduceat(gap**2, first) / sizes)
    return ellipses, rms, np.maximum.reduceat(np.abs(gap), first)


def notch_arcs(contour: Array) -> list[Array]:
    """Cut an outline (n, 2) where it turns inwards and where it leaves the image.

    Turns are measured between two arms whose length is an eighth of the outline's size, 3 to 8 px,
    on points that are spaced by 1 px and smoothed over 1 px. Returns the arcs in between, without
    those of fewer than five points.
    """
    inside = np.isfinite(contour[:, 0])
    if not np.any(inside):
        return []
    sense = _sense(contour[inside])
    if np.all(inside):
        return _cut(contour, sense, closed=True)
    turn = int(np.argmin(inside))
    contour, inside = np.roll(contour, -turn, axis=0), np.roll(inside, -turn)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    return [
        arc
        for low, high in zip(edges[::2], edges[1::2], strict=True)
        for arc in _cut(contour[low:high], sense, closed=False)
    ]


def _spaced(points: Array, *, closed: bool) -> Array:
    whole = np.concatenate([points, points[:1]]) if closed else points
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(whole, axis=0).T))])
    count = max(int(length[-1]), 4)
    place = np.arange(count) * (length[-1] / count)
    even = np.stack([np.interp(place, length, whole[:, k]) for k in (0, 1)], axis=1)
    if closed:
        return 0.25 * np.roll(even, 1, axis=0) + 0.5 * even + 0.25 * np.roll(even, -1, axis=0)
    even[1:-1] = 0.25 * even[:-2] + 0.5 * even[1:-1] + 0.25 * even[2:]
    return even


def _arm(points: Array) -> int:
    size = float(np.sqrt(np.prod(np.ptp(points, axis=0) + 1.0)))
    return int(np.clip(round(0.1 * size), 3, 8))


def _sense(points: Array) -> float:
    """Return 1 for outlines that run from +u to +v, -1 for the others."""
    x, y = (points - points[0]).T
    return float(np.sign(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))


def _turning(points: Array, arm: int) -> Array:
    """Return the turn (n,) of the outline over ``arm`` points on both sides, towards +v from +u."""
    back = points - np.roll(points, arm, axis=0)
    ahead = np.roll(points, -arm, axis=0) - points
    cross = back[:, 0] * ahead[:, 1] - back[:, 1] * ahead[:, 0]
    return np.asarray(np.arctan2(cross, np.sum(back * ahead, axis=1)))


def _notches(turn: Array, arm: int, most_rad: float) -> list[int]:
    """Return where an outline turns by less than ``most_rad``; of places nearer than ``arm`` the
    one that turns least."""
    found, near = [], np.zeros(turn.size, np.bool_)
    for index in np.argsort(turn).tolist():
        if turn[index] > most_rad:
            break
        if not near[index]:
            found.append(index)
            near[np.arange(index - arm + 1, index + arm) % turn.size] = True
    return sorted(found)


def _cut(contour: Array, sense: float, *, closed: bool, flat: bool = False) -> list[Array]:
    """Cut an outline at its notches, or wherever it is flat."""
    if len(contour) < _SHORTEST_ARC:
        return []
    points = _spaced(contour, closed=closed)
    arm = _arm(points)
    if len(points) < 4 * arm:
        return [points]
    turn = sense * _turning(points, arm)
    if not closed:
        turn[:arm] = turn[-arm:] = np.inf
    notches = _notches(turn, arm, _FLAT * 2.0 * np.pi * arm / len(points) if flat else _TURN_RAD)
    if closed and not notches:
        return [points]
    if closed:
        points = np.roll(points, -notches[0], axis=0)
        notches = [k - notches[0] for k in notches[1:]]
    return _trimmed(points, [0, *notches, len(points)])


def _trimmed(points: Array, bounds: list[int]) -> list[Array]:
    """Return arcs between bounds, without the points that the notch's blur has moved."""
    arcs = [points[low + 2 : high - 1] for low, high in itertools.pairwise(bounds)]
    return [arc for arc in arcs if len(arc) >= _SHORTEST_ARC]


def fit_ellipses(arcs: list[Array]) -> tuple[Array, Array]:
    """Return the ellipses (B, 5) along B arcs of points, and the RMS distances (B,) of these."""
    return ellipses_along(np.concatenate(arcs), np.array([len(arc) for arc in arcs]))


_CLEAN_PX, _CLEAN_SHARE = 0.15, 0.012
_FIT_PX, _FIT_SHARE = 0.3, 0.03
_MIN_ARC_RAD = 1.0
_MIN_EXPLAINED, _MIN_COVERED = 0.75, 0.88
_MAX_ARCS = 24
_LEAST_IN_IMAGE = 0.08
_CANVAS_MARGIN_PX = 2
"""Outline points on the image's edge are left out, which narrows the blob by this much: its rows
and columns are continued so far beyond its bounding box."""


@dataclass(frozen=True)
class Part:
    """One bubble in a dark region.

    ellipse : (5,).
    blob : index of the region.
    shared : whether the region contains other bubbles, too.
    merged : whether the region could not be divided into bubbles.
    """

    ellipse: Array
    blob: int
    shared: bool = False
    merged: bool = False


def split_blobs(blobs: list[Blob], shape: tuple[int, ...], *, min_diameter_px: float) -> list[Part]:
    """Divide every dark region of an image into bubbles; each region gives at least one part.

    shape : of the image. min_diameter_px : smallest diameter of a bubble.
    """
    if not blobs:
        return []
    whole, rms, largest = contour_moments([blob.contour_px for blob in blobs])
    allowed = _CLEAN_PX + _CLEAN_SHARE * np.sqrt(whole[:, 2] * whole[:, 3])
    clean = (rms < allowed) & (largest < 4.0 * allowed)
    clean &= ~np.array([blob.touches_border for blob in blobs])
    parts = {index: [Part(whole[index], index)] for index in np.flatnonzero(clean).tolist()}
    unclean = np.flatnonzero(~clean).tolist()
    arcs = {index: notch_arcs(blobs[index].contour_px) for index in unclean}
    single = [index for index in unclean if len(arcs[index]) == 1]
    fits = zip(*fit_ellipses([arcs[index][0] for index in single])) if single else ()
    for index, (ellipse, error) in zip(single, fits):
        sound = error < 2.5 * _tolerance(ellipse)
        sound = sound and _dark(ellipse, _in_image(blobs[index]), shape)
        parts[index] = [Part(ellipse if sound else whole[index], index, merged=not sound)]
    for index in set(unclean) - set(single):
        good = _split(_in_image(blobs[index]), arcs[index], shape, min_diameter_px)
        parts[index] = [Part(ellipse, index, shared=len(good) > 1) for ellipse in good]
        parts[index] = parts[index] or [Part(whole[index], index, merged=True)]
    return [part for index in range(len(blobs)) for part in parts[index]]


def split_where_flat(
    blob: Blob, index: int, shape: tuple[int, ...], min_diameter_px: float
) -> list[Part]:
    """Divide a dark region that is not one bubble wherever its outline is flat.

    index : of the region. Returns its bubbles, one for each arc; [] if they do not explain it.
    """
    contour = _in_image(blob)
    arcs = _cut(contour, _sense(contour), closed=True, flat=True)
    good = _explained(arcs, contour, shape, min_diameter_px) if len(arcs) <= _MAX_ARCS else []
    return [Part(ellipse, index, shared=True) for ellipse in good] if len(good) > 1 else []


def _in_image(blob: Blob) -> Array:
    """Return the outline's points that are not on the image's edge."""
    return blob.contour_px[np.isfinite(blob.contour_px[:, 0])]


def _tolerance(ellipse: Array) -> Array:
    return np.asarray(_FIT_PX + _FIT_SHARE * np.sqrt(ellipse[..., 2] * ellipse[..., 3]))


def _split(
    contour: Array, arcs: list[Array], shape: tuple[int, ...], min_diameter_px: float
) -> list[Array]:
    """Return ellipses (5,) that explain the outline ``contour`` and its arcs; [] for none."""
    if not arcs or len(arcs) > _MAX_ARCS:
        return []
    return _explained(_grouped(arcs, contour), contour, shape, min_diameter_px)


def _explained(
    groups: list[Array], contour: Array, shape: tuple[int, ...], min_diameter_px: float
) -> list[Array]:
    """Return ellipses (5,) along groups of arcs if they explain the outline; else []."""
    if not groups:
        return []
    fitted, rms = fit_ellipses(groups)
    good = [
        ellipse
        for ellipse, group, error in zip(fitted, groups, rms, strict=True)
        if _sound(ellipse, group, float(error), contour, min_diameter_px)
        and _dark(ellipse, contour, shape)
    ]
    return good if _explains(good, contour) else []


def _sound(
    ellipse: Array, group: Array, rms: float, contour: Array, min_diameter_px: float
) -> bool:
    """Whether the ellipse runs along its arcs, is seen over enough of them, and holds no rim."""
    tolerance = float(_tolerance(ellipse))
    if rms > tolerance or 2.0 * ellipse[3] < min(0.6 * min_diameter_px, 6.0):
        return False
    if _seen_rad(ellipse, group) < _MIN_ARC_RAD or ellipse[2] > 2.2 * ellipse[3]:
        return False
    return _holds_no_rim(ellipse, contour)


def _holds_no_rim(ellipse: Array, contour: Array) -> bool:
    inside = rough_distance(ellipse, contour[:, 0], contour[:, 1]) < -2.0 * _tolerance(ellipse)
    return bool(np.mean(inside) < 0.02)


def _seen_rad(ellipse: Array, points: Array) -> float:
    angle = np.arctan2(points[:, 1] - ellipse[1], points[:, 0] - ellipse[0])
    slot = ((angle + np.pi) * (48 / (2.0 * np.pi))).astype(int) % 48
    return float(np.unique(slot).size * (2.0 * np.pi / 48))


def _grouped(arcs: list[Array], contour: Array) -> list[Array]:
    """Join arcs, best pair first, as long as one ellipse fits both."""
    groups = list(arcs)
    rejected: set[tuple[int, int]] = set()
    ids = list(range(len(groups)))
    while len(groups) > 1:
        pairs = [
            (i, j)
            for i in range(len(groups))
            for j in range(i + 1, len(groups))
            if (ids[i], ids[j]) not in rejected
        ]
        if not pairs:
            break
        joint = [np.concatenate([groups[i], groups[j]]) for i, j in pairs]
        ellipses, rms = fit_ellipses(joint)
        score = rms / _tolerance(ellipses)
        fitting = [
            score[k] < 0.8
            and ellipses[k, 2] < 1.6 * ellipses[k, 3]
            and _holds_no_rim(ellipses[k], contour)
            for k in range(len(pairs))
        ]
        rejected |= {(ids[i], ids[j]) for k, (i, j) in enumerate(pairs) if not fitting[k]}
        if not any(fitting):
            break
        best = int(np.argmin(np.where(fitting, score, np.inf)))
        i, j = pairs[best]
        groups = [g for k, g in enumerate(groups) if k not in (i, j)] + [joint[best]]
        ids = [g for k, g in enumerate(ids) if k not in (i, j)] + [max(ids) + 1]
    return groups


def _explains(ellipses: list[Array], contour: Array) -> bool:
    """Whether the ellipses' rims carry the blob's outline and their discs fill its area."""
    if not ellipses:
        return False
    stack = np.stack(ellipses)
    gap = rough_distance(stack[:, None, :], contour[None, :, 0], contour[None, :, 1])
    nearest = np.min(np.abs(gap), axis=0)
    if np.mean(nearest < 1.0 + 2.0 * np.min(_tolerance(stack))) < _MIN_EXPLAINED:
        return False
    return _covered(stack, contour) > _MIN_COVERED


def _filled(contour: Array, low: Ints, high: Ints) -> NDArray[np.uint8]:
    """Fill the outline in the window of pixels (u, v) from ``low`` to before ``high``."""
    canvas = np.zeros((high - low)[::-1], np.uint8)
    cv2.fillPoly(canvas, [np.round(contour - low).astype(np.int32)[:, None]], 1)
    return canvas


def _dark(ellipse: Array, contour: Array, shape: tuple[int, ...]) -> bool:
    """Whether what the image shows of the ellipse's disc lies within the blob."""
    low = np.maximum(np.floor(ellipse[:2] - ellipse[2]), 0).astype(np.int64)
    high = np.minimum(np.ceil(ellipse[:2] + ellipse[2]) + 1, shape[::-1]).astype(np.int64)
    if np.any(high <= low):
        return False
    first = np.floor(np.min(contour, axis=0)).astype(np.int64)
    last = np.ceil(np.max(contour, axis=0)).astype(np.int64) + 1
    blob = np.pad(_filled(contour, first, last), _CANVAS_MARGIN_PX, mode="edge")
    first, last = first - _CANVAS_MARGIN_PX, last + _CANVAS_MARGIN_PX
    begin, end = np.maximum(low, first), np.minimum(high, last)
    if np.any(end <= begin):
        return False
    seen_blob = np.zeros((high - low)[::-1], np.uint8)
    (left, top), (right, bottom) = begin - low, end - low
    source = blob[begin[1] - first[1] : end[1] - first[1], begin[0] - first[0] : end[0] - first[0]]
    seen_blob[top:bottom, left:right] = source
    u, v = np.arange(low[0], high[0]), np.arange(low[1], high[1])[:, None]
    disc = rough_distance(ellipse, u, v) < 0.0
    seen = np.count_nonzero(disc) / (np.pi * ellipse[2] * ellipse[3])
    return bool(seen > _LEAST_IN_IMAGE and np.mean(seen_blob[disc]) > _MIN_COVERED)


def _covered(ellipses: Array, contour: Array) -> float:
    low = np.floor(np.min(contour, axis=0)).astype(np.int64)
    high = np.ceil(np.max(contour, axis=0)).astype(np.int64) + 1
    v, u = np.nonzero(_filled(contour, low, high))
    gap = rough_distance(ellipses[:, None, :], (u + low[0])[None, :], (v + low[1])[None, :])
    return float(np.mean(np.any(gap < 0.7, axis=0)))
