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
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Float32, Ints
from telerig.estimator.bubbles.outline.ellipse_geometry import (
    rough_distance,
)
from telerig.estimator.bubbles.outline.outline_fit import ellipses_along
from telerig.estimator.images.noise import clipped_sigma, high_pass

_NOISE_SAMPLES = 40_000
_BAND_ROWS = 16
_ENOUGH_LIT, _ENOUGH_DARK, _LEAST_NOISE = 200, 120, 1e-4
_FAINT_SHARE = 0.5
_LOW_SIGMA = 6.0
_DARKEST = 0.05
_LIT, _DARK = 0.85, 0.3
_LEAST_OUTLINE, _STEEP_SHARE = 5, 0.6
_MAX_CUT_CENTRE_SHARE = 0.6


@dataclass(frozen=True)
class Blob:
    """One dark region of an image that was divided by its background.

    contour_px : (n, 2) closed outline at half depth, to about 0.1 px.
    inner : grey level inside (the background is 1).
    blur_px : standard deviation of the edge's blur.
    box : (u, v, width, height) of the region.
    touches_border : whether it touches the image's border.
    within : whether another region surrounds it: it may be a bubble in front of a bright heart.
    """

    contour_px: Array
    inner: float
    blur_px: float
    box: tuple[int, int, int, int]
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
    for first in range(0, max(len(ratio) - _BAND_ROWS, 0) + 1, _band_step(ratio)):
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


def _band_step(ratio: Float32) -> int:
    """Return the rows from one band to the next: all of a small image, a quarter of a large one."""
    return _BAND_ROWS - 2 if ratio.size < 4 * _NOISE_SAMPLES else 4 * _BAND_ROWS


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
    shadow = ratio < np.float32(low)
    regions, tree = cv2.findContours(shadow.view(np.uint8), cv2.RETR_TREE, cv2.CHAIN_APPROX_NONE)
    depth = np.array(_depths(tree), np.intp)
    length = np.array([len(region) for region in regions], np.intp)
    labels, boxes = np.zeros(ratio.shape, np.int32), [(0, 0, 0, 0)]
    for k in np.argsort(depth, kind="stable").tolist():
        if depth[k] % 2 == 0 and length[k] >= _LEAST_OUTLINE:
            cv2.drawContours(labels, regions, k, (len(boxes),), cv2.FILLED)
            boxes.append(cv2.boundingRect(regions[k]))
    place = np.flatnonzero(shadow)
    if not place.size:
        return [], []
    own, value = labels.ravel()[place], ratio.ravel()[place]
    size = np.bincount(own, minlength=len(boxes))
    order = np.sort(own + np.clip(value, 0.0, 0.999).astype(np.float64))
    first = np.cumsum(size) - size
    inner = order[np.minimum(first + (_DARKEST * size).astype(int), own.size - 1)]
    inner -= np.arange(size.size)
    small = np.array([max(box[2:]) for box in boxes]) < min_diameter_px
    faint = inner > 1.0 - min_contrast
    half = np.where(small | faint, -np.inf, 0.5 * (1.0 + inner)).astype(np.float32)
    dark = np.zeros(ratio.shape, np.uint8)
    dark.ravel()[place[value < half[own]]] = 1
    _close_at_border(dark, labels)
    outlines, tree = cv2.findContours(dark, cv2.RETR_TREE, cv2.CHAIN_APPROX_NONE)
    traced: list[_Traced] = []
    for outline, level in zip(outlines, _depths(tree), strict=True):
        width, height = cv2.boundingRect(outline)[2:]
        if level % 2 or len(outline) < _LEAST_OUTLINE or max(width, height) < min_diameter_px:
            continue
        points = outline.reshape(-1, 2)
        region = int(labels[points[0, 1], points[0, 0]])
        traced.append(_Traced(points, float(inner[region]), boxes[region], level > 0, region))
    without = np.arange(len(boxes)) > 0
    without[[one.region for one in traced]] = False
    too_small = f"smaller than {min_diameter_px:g} px"
    rejected = []
    for k in np.flatnonzero(without).tolist():
        x, y, width, height = boxes[k]
        reason = too_small
        if faint[k] and not small[k]:
            reason = f"contrast {1.0 - inner[k]:.2f} is below {min_contrast:g}"
        radius = 0.5 * float(np.sqrt(width * height))
        rejected.append(Rejected(x + (width - 1) / 2, y + (height - 1) / 2, radius, reason))
    return _refined(ratio, traced), rejected


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


class _Traced(NamedTuple):
    """An outline of pixels (n, 2), the level inside, the box of the region it came from, whether
    another region surrounds it, and the number of the region."""

    pixels: NDArray[np.int32]
    inner: float
    box: tuple[int, int, int, int]
    within: bool
    region: int


def _close_at_border(dark: NDArray[np.uint8], labels: NDArray[np.int32]) -> None:
    """Join what is dark of a region along the image's edges: a bright centre cut by the edge
    becomes a hole. Both images are changed."""
    for edge in (np.s_[0], np.s_[:, 0], np.s_[-1], np.s_[:, -1]):
        line, own = dark[edge], labels[edge]
        places = np.flatnonzero(line)
        for low, high in zip(places[:-1].tolist(), places[1:].tolist(), strict=True):
            if high - low == 1 or own[low] != own[high]:
                continue
            extent = np.ptp(places[own[places] == own[low]]) + 1
            if high - low <= _MAX_CUT_CENTRE_SHARE * extent:
                line[low:high], own[low:high] = 1, own[low]


def _refined(ratio: Float32, traced: list[_Traced]) -> list[Blob]:
    """Return blobs with outline points moved along the gradient to half depth."""
    if not traced:
        return []
    rows, columns = ratio.shape
    sizes = np.array([len(one.pixels) for one in traced])
    points = np.concatenate([one.pixels for one in traced]).astype(np.intp)
    inner = np.repeat(np.array([one.inner for one in traced], np.float32), sizes)
    u, v = points.T
    left, right = np.maximum(u - 1, 0), np.minimum(u + 1, columns - 1)
    above, here, below = (
        row * columns for row in (np.maximum(v - 1, 0), v, np.minimum(v + 1, rows - 1))
    )
    value = ratio.ravel().take
    north_west, north_east = value(above + left), value(above + right)
    south_west, south_east = value(below + left), value(below + right)
    slope_u = 2.0 * (value(here + right) - value(here + left))
    slope_u = (slope_u + (north_east - north_west) + (south_east - south_west)) / 8.0
    slope_v = 2.0 * (value(below + u) - value(above + u))
    slope_v = (slope_v + (south_west - north_west) + (south_east - north_east)) / 8.0
    square = np.maximum(slope_u**2 + slope_v**2, (0.02 * (1.0 - inner)) ** 2)
    shift = (0.5 * (1.0 + inner) - value(here + u)) / square
    shift = shift * np.minimum(1.0, 1.2 / np.maximum(np.abs(shift) * np.sqrt(square), 1e-9))
    moved = np.stack([u + shift * slope_u, v + shift * slope_v], axis=1).astype(np.float64)
    edge = (u <= 0) | (v <= 0) | (u >= columns - 1) | (v >= rows - 1)
    moved[edge] = np.nan
    blobs, first = [], 0
    for one, size in zip(traced, sizes.tolist(), strict=True):
        part = slice(first, first + size)
        place = int(_STEEP_SHARE * size)
        steepest = float(np.sqrt(np.partition(square[part], place)[place]))
        blur = (1.0 - one.inner) / (np.sqrt(2.0 * np.pi) * max(steepest, 1e-6))
        blur = float(np.sqrt(max(blur**2 - 0.6, 0.15)))
        at_border = bool(edge[part].any())
        blobs.append(Blob(moved[part], one.inner, blur, one.box, at_border, one.within))
        first += size
    return blobs


_TURN_RAD = -0.1
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
        return _cut_closed(contour, sense)
    turn = int(np.argmin(inside))
    contour, inside = np.roll(contour, -turn, axis=0), np.roll(inside, -turn)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    return [
        arc
        for low, high in zip(edges[::2], edges[1::2], strict=True)
        for arc in _cut_open(contour[low:high], sense)
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


def _notches(turn: Array, arm: int) -> list[int]:
    """Return the deepest inward turns first, none nearer than ``arm`` to a deeper one."""
    found, near = [], np.zeros(turn.size, np.bool_)
    for index in np.argsort(turn).tolist():
        if turn[index] > _TURN_RAD:
            break
        if not near[index]:
            found.append(index)
            near[np.arange(index - arm + 1, index + arm) % turn.size] = True
    return sorted(found)


def _cut_closed(contour: Array, sense: float) -> list[Array]:
    points = _spaced(contour, closed=True)
    arm = _arm(points)
    if len(points) < 4 * arm:
        return [points]
    notches = _notches(sense * _turning(points, arm), arm)
    if not notches:
        return [points]
    points = np.roll(points, -notches[0], axis=0)
    bounds = [k - notches[0] for k in notches] + [len(points)]
    return _trimmed(points, bounds)


def _cut_open(contour: Array, sense: float) -> list[Array]:
    if len(contour) < _SHORTEST_ARC:
        return []
    points = _spaced(contour, closed=False)
    arm = _arm(points)
    if len(points) < 4 * arm:
        return [points]
    turn = sense * _turning(points, arm)
    turn[:arm] = turn[-arm:] = 0.0
    return _trimmed(points, [0, *_notches(turn, arm), len(points)])


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
