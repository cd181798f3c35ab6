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
    ELLIPSE_PARAMETERS,
    deepest_concavity,
    ellipse_basis,
    foot_points,
    moved,
    rough_distance,
)
from telerig.estimator.bubbles.outline.outline_fit import Outlines
from telerig.estimator.images.noise import clipped_sigma

_NOISE_SAMPLES = 40_000
_DARK_SHARE, _ENOUGH_DARK = 0.12, 120
_FAINT_SHARE = 0.5
_LOW_SIGMA = 6.0
_DARKEST = 0.05
_LIT = 0.85
_LEAST_OUTLINE, _STEEP_SHARE = 5, 0.6
_MAX_CUT_CENTRE_SHARE = 0.6


@dataclass(frozen=True)
class Blob:
    """One dark region: its outline ``contour_px`` (n, 2; closed, to about 0.1 px) at half depth,
    the ``inner`` level (background is 1), the edge's ``blur_px``, and the ``box`` (u, v, width,
    height) of the region it came from."""

    contour_px: Array
    inner: float
    blur_px: float
    box: tuple[int, int, int, int]
    touches_border: bool


class Rejected(NamedTuple):
    """A dark region that is no bubble, and why."""

    u_px: float
    v_px: float
    radius_px: float
    reason: str


def noise_share(ratio: Float32, response: Float32) -> float:
    """Noise of the normalised image where the screen is free, as a share of the background.

    response : the image's `high_pass`, which is blind to any plane.
    """
    free = cv2.erode((ratio > _LIT).astype(np.uint8), np.ones((3, 7), np.uint8)) > 0
    values = response[free] if np.count_nonzero(free) > 200 else response.ravel()
    return clipped_sigma(
        values[:: max(1, values.size // _NOISE_SAMPLES)].astype(np.float64), rounds=6
    )


def dark_noise_share(ratio: Float32, response: Float32, blobs: list[Blob], sigma: float) -> float:
    """Noise within the dark rims, at most ``sigma``, that of the screen: photons are fewer there.

    From the `high_pass` where five by five pixels are dark alike. Structure within the rims makes
    the estimate too large rather than too small.
    """
    found = [np.empty(0, np.float32)]
    for blob in blobs:
        x, y, width, height = blob.box
        crop = np.s_[y : y + height, x : x + width]
        even = (ratio[crop] < blob.inner + _DARK_SHARE * (1.0 - blob.inner)).astype(np.uint8)
        found.append(response[crop][cv2.erode(even, np.ones((5, 5), np.uint8), borderValue=0) > 0])
    values = np.concatenate(found)
    if values.size < _ENOUGH_DARK:
        return sigma
    return min(sigma, clipped_sigma(values[: 10 * _NOISE_SAMPLES].astype(np.float64), rounds=6))


def find_blobs(
    ratio: Float32, *, sigma: float, min_contrast: float, min_diameter_px: float
) -> tuple[list[Blob], list[Rejected]]:
    """Dark regions of the normalised image that may be bubbles, and those too small or faint.

    Hysteresis: a region is what is darker than a faint shadow, and counts when it holds pixels
    darker than ``1 - min_contrast``. Its outline is traced at half of its own depth.
    """
    low = 1.0 - max(_FAINT_SHARE * min_contrast, min(_LOW_SIGMA * sigma, 0.9 * min_contrast))
    mask = cv2.compare(ratio, low, cv2.CMP_LT)
    regions, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    blobs: list[Blob] = []
    rejected: list[Rejected] = []
    too_small = f"smaller than {min_diameter_px:g} px"
    for region in regions:
        if len(region) < _LEAST_OUTLINE:
            continue
        x, y, width, height = cv2.boundingRect(region)
        found: list[Blob] = []
        reason = too_small
        if max(width, height) >= min_diameter_px:
            box = (x, y, width, height)
            found, reason = _trace(ratio, region, box, low, min_contrast, min_diameter_px)
        blobs += found
        if not found:
            radius = 0.5 * float(np.sqrt(width * height))
            rejected.append(Rejected(x + (width - 1) / 2, y + (height - 1) / 2, radius, reason))
    return blobs, rejected


def _trace(
    ratio: Float32,
    region: NDArray[np.int32],
    box: tuple[int, int, int, int],
    low: float,
    min_contrast: float,
    min_diameter_px: float,
) -> tuple[list[Blob], str]:
    """Outlines at half depth within one region, or the reason why there is none."""
    x, y, width, height = box
    rows, columns = ratio.shape
    left, top = max(x - 1, 0), max(y - 1, 0)
    part = ratio[top : min(y + height + 1, rows), left : min(x + width + 1, columns)]
    own = np.zeros(part.shape, np.uint8)
    cv2.drawContours(own, [region], -1, 1, cv2.FILLED, offset=(-left, -top))
    values = part[(own > 0) & (part < low)]
    place = int(_DARKEST * values.size)
    inner = float(np.partition(values, place)[place])
    if inner > 1.0 - min_contrast:
        return [], f"contrast {1.0 - inner:.2f} is below {min_contrast:g}"
    half = 0.5 * (1.0 + inner)
    dark = own & (part < half)
    at_border = (top == 0, left == 0, top + part.shape[0] == rows, left + part.shape[1] == columns)
    if any(at_border):
        _close_at_border(dark, at_border)
    outlines, _ = cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    blobs = []
    for outline in outlines:
        points = outline.reshape(-1, 2)
        size = int(np.max(np.max(points, axis=0) - np.min(points, axis=0))) + 1
        if len(points) < _LEAST_OUTLINE or size < min_diameter_px:
            continue
        points = points + np.array([left, top])
        refined, blur = refined_contour(ratio, points, half, 1.0 - inner)
        edge = (points[:, 0] <= 0) | (points[:, 1] <= 0)
        edge |= (points[:, 0] >= columns - 1) | (points[:, 1] >= rows - 1)
        refined[edge] = np.nan
        blobs.append(Blob(refined, inner, blur, box, bool(np.any(edge))))
    return blobs, "" if blobs else f"smaller than {min_diameter_px:g} px"


def _close_at_border(dark: NDArray[np.uint8], sides: tuple[bool, ...]) -> None:
    """Join what is dark along the image's edges: a bright centre cut by the edge becomes a hole."""
    lines = (dark[0], dark[:, 0], dark[-1], dark[:, -1])
    for line, at_border in zip(lines, sides, strict=True):
        if not at_border:
            continue
        places = np.flatnonzero(line)
        for low, high in zip(places[:-1].tolist(), places[1:].tolist(), strict=True):
            if 1 < high - low <= _MAX_CUT_CENTRE_SHARE * line.size:
                line[low:high] = 1


def refined_contour(
    ratio: Float32, points: NDArray[np.int_], half: float, contrast: float
) -> tuple[Array, float]:
    """Outline points (n, 2) moved along the gradient to the half level, and the edge's blur."""
    rows, columns = ratio.shape
    u, v = points[:, 0].astype(np.intp), points[:, 1].astype(np.intp)
    u0, u1 = np.maximum(u - 1, 0), np.minimum(u + 1, columns - 1)
    v0, v1 = np.maximum(v - 1, 0), np.minimum(v + 1, rows - 1)
    slope_u = (
        2.0 * (ratio[v, u1] - ratio[v, u0])
        + (ratio[v0, u1] - ratio[v0, u0])
        + (ratio[v1, u1] - ratio[v1, u0])
    ) / 8.0
    slope_v = (
        2.0 * (ratio[v1, u] - ratio[v0, u])
        + (ratio[v1, u0] - ratio[v0, u0])
        + (ratio[v1, u1] - ratio[v0, u1])
    ) / 8.0
    square = np.maximum(slope_u**2 + slope_v**2, (0.02 * contrast) ** 2)
    shift = (half - ratio[v, u]) / square
    shift = shift * np.minimum(1.0, 1.2 / np.maximum(np.abs(shift) * np.sqrt(square), 1e-9))
    refined = np.stack([u + shift * slope_u, v + shift * slope_v], axis=1).astype(np.float64)
    place = int(_STEEP_SHARE * square.size)
    steepest = float(np.sqrt(np.partition(square, place)[place]))
    blur = contrast / (np.sqrt(2.0 * np.pi) * max(steepest, 1e-6))
    return refined, float(np.sqrt(max(blur**2 - 0.6, 0.15)))


_TURN_RAD = -0.1
_POINT_SIGMA_PX = 0.2
_ROUND_SHARE = 0.12
_SHORTEST_ARC = 5
_ROUNDS = 8


def contour_moments(contours: list[Array]) -> tuple[Array, Array, Array]:
    """Ellipses (B, 5) of equal area moments, and the RMS and largest distance of their points.

    Points that are NaN (beyond the image) are passed over.
    """
    found = []
    for contour in contours:
        points = contour[np.isfinite(contour[:, 0])]
        points = points if len(points) >= 3 else np.eye(3, 2)
        m = cv2.moments(points.astype(np.float32)[:, None])
        area = m["m00"] or 1e-9
        uu, vv, uv = m["mu20"] / area, m["mu02"] / area, m["mu11"] / area
        middle, half = (uu + vv) / 2.0, np.hypot((uu - vv) / 2.0, uv)
        a, b = 2.0 * np.sqrt(np.maximum([middle + half, middle - half], 0.1))
        angle = 0.5 * np.arctan2(2.0 * uv, uu - vv)
        ellipse = np.array([m["m10"] / area, m["m01"] / area, a, b, angle])
        gap = rough_distance(ellipse, points[:, 0], points[:, 1])
        found.append((ellipse, np.sqrt(np.mean(gap**2)), np.max(np.abs(gap))))
    ellipses, rms, largest = zip(*found)
    return np.array(ellipses), np.array(rms), np.array(largest)


def notch_arcs(contour: Array) -> list[Array]:
    """The outline (n, 2) cut where it turns inwards and where it leaves the image.

    Turns are measured over arms of an eighth of the size, at least 3 px and at most 8, on points
    evenly spaced by 1 px and smoothed over 1 px. Arcs of fewer than five points are dropped.
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
    """1 for outlines that run from +u to +v, -1 for the others."""
    x, y = (points - points[0]).T
    return float(np.sign(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))


def _turning(points: Array, arm: int) -> Array:
    """Turn (n,) of the outline over ``arm`` points before and after, towards +v from +u."""
    back = points - np.roll(points, arm, axis=0)
    ahead = np.roll(points, -arm, axis=0) - points
    cross = back[:, 0] * ahead[:, 1] - back[:, 1] * ahead[:, 0]
    return np.asarray(np.arctan2(cross, np.sum(back * ahead, axis=1)))


def _notches(turn: Array, arm: int) -> list[int]:
    """Deepest inward turns first, none nearer than ``arm`` to a deeper one."""
    found: list[int] = []
    for index in np.argsort(turn).tolist():
        if turn[index] > _TURN_RAD:
            break
        apart = [min((index - k) % turn.size, (k - index) % turn.size) for k in found]
        if min(apart, default=arm) >= arm:
            found.append(index)
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
    """Arcs between bounds, without the points that the notch's blur has moved."""
    arcs = [points[low + 2 : high - 1] for low, high in itertools.pairwise(bounds)]
    return [arc for arc in arcs if len(arc) >= _SHORTEST_ARC]


def _circles(arcs: list[Array]) -> Array:
    """Circles (B, 5) through arcs, by linear least squares."""
    circles = np.empty((len(arcs), ELLIPSE_PARAMETERS))
    for index, arc in enumerate(arcs):
        middle = np.mean(arc, axis=0)
        x, y = (arc - middle).T
        square = x * x + y * y
        design = np.stack([x, y, np.ones_like(x)])
        normal = design @ design.T + 1e-9 * np.eye(3)
        p, q, r = np.linalg.solve(normal, design @ square)
        radius = np.sqrt(max(r + (p * p + q * q) / 4.0, 0.5))
        circles[index] = middle[0] + p / 2.0, middle[1] + q / 2.0, radius, radius, 0.0
    return circles


def fit_ellipses(arcs: list[Array]) -> tuple[Array, Array]:
    """Ellipses (B, 5) along B arcs of points, robustly, and the RMS distance of the points (B,).

    Short arcs lean towards circles: a - b and the shear carry a prior of 12 % of the radius.
    """
    sizes = np.array([len(arc) for arc in arcs])
    first = np.cumsum(sizes) - sizes
    points = np.concatenate(arcs)
    origin = np.mean(points, axis=0)
    u, v = (points - origin).astype(np.float32).T
    ellipse = _circles(arcs)
    ellipse[:, :2] -= origin
    radius = ellipse[:, 2].copy()
    basis = np.empty((ELLIPSE_PARAMETERS, u.size), dtype=np.float32)
    for _ in range(_ROUNDS):
        foot = foot_points(ellipse, sizes, u, v)
        ellipse_basis(foot, basis)
        weight = 1.0 / (_POINT_SIGMA_PX**2 * (1.0 + (foot.distance / 0.6) ** 2))
        products = np.add.reduceat(basis[:, None] * basis[None] * weight, first, axis=2)
        pull = np.add.reduceat(basis * (weight * foot.distance), first, axis=1).T.astype(np.float64)
        information = np.moveaxis(products, 2, 0).astype(np.float64)
        _add_roundness(information, pull, ellipse, _ROUND_SHARE * radius)
        step = np.linalg.solve(information, pull[..., None])[..., 0].astype(np.float64)
        reach = np.max(np.abs(step), axis=1)
        step *= np.minimum(1.0, 0.4 * ellipse[:, 3] / (reach + 1e-12))[:, None]
        ellipse, _ = moved(ellipse, step)
        if np.max(reach) < 0.01:
            break
    gap = foot_points(ellipse, sizes, u, v).distance
    ellipse[:, :2] += origin
    return ellipse, np.sqrt(np.add.reduceat(gap**2, first) / sizes)


def _add_roundness(information: Array, pull: Array, ellipse: Array, spread: Array) -> None:
    weight = 1.0 / spread**2
    for i, j, sign in ((2, 2, 1.0), (3, 3, 1.0), (2, 3, -1.0), (3, 2, -1.0)):
        information[:, i, j] += sign * weight
    information[:, 4, 4] += 4.0 * weight
    gap = (ellipse[:, 2] - ellipse[:, 3]) * weight
    pull[:, 2] -= gap
    pull[:, 3] += gap
    diagonal = np.arange(ELLIPSE_PARAMETERS)
    information[:, diagonal, diagonal] += 1e-6


_CLEAN_PX, _CLEAN_SHARE = 0.15, 0.012
_FIT_PX, _FIT_SHARE = 0.3, 0.03
_MIN_ARC_RAD = 1.0
_MIN_EXPLAINED, _MIN_COVERED = 0.75, 0.88
_MAX_ARCS = 24
_LEAST_IN_IMAGE = 0.08
_CANVAS_MARGIN_PX = 2
"""Outline points on the image's edge are left out, which narrows the blob by this much."""

_NECKS = ((0.03, 2.5), (0.3, 1.3), (1.5, 0.0))
"""Depth of a concavity and the chi2_dof above which it counts as a neck: strong shape modes have
concavities too, but then the outline's harmonics describe them."""
_MISFIT_PX, _MISFIT_SHARE = 0.15, 0.005
_LARGEST_GROWTH, _LONG = 1.6, 2.3
_SHARPEST_ORDER, _WHOLE = 35.0, 0.9


@dataclass(frozen=True)
class Part:
    """One bubble of a blob: ``ellipse`` (5,), the blob's index, and whether the blob holds
    others (``shared``) or could not be split (``merged``)."""

    ellipse: Array
    blob: int
    shared: bool = False
    merged: bool = False


def split_blobs(blobs: list[Blob], shape: tuple[int, ...], *, min_diameter_px: float) -> list[Part]:
    """The bubbles in every blob of an image of ``shape``; at least one part for each."""
    if not blobs:
        return []
    whole, rms, largest = contour_moments([blob.contour_px for blob in blobs])
    parts: list[Part] = []
    for index, blob in enumerate(blobs):
        radius = float(np.sqrt(whole[index, 2] * whole[index, 3]))
        allowed = _CLEAN_PX + _CLEAN_SHARE * radius
        clean = rms[index] < allowed and largest[index] < 4.0 * allowed
        if clean and not blob.touches_border:
            parts.append(Part(whole[index], index))
        else:
            parts += _split(blob, index, whole[index], shape, min_diameter_px)
    return parts


def _tolerance(ellipse: Array) -> Array:
    return np.asarray(_FIT_PX + _FIT_SHARE * np.sqrt(ellipse[..., 2] * ellipse[..., 3]))


def _split(
    blob: Blob, index: int, whole: Array, shape: tuple[int, ...], min_diameter_px: float
) -> list[Part]:
    arcs = notch_arcs(blob.contour_px)
    unsplit = [Part(whole, index, merged=True)]
    if not arcs or len(arcs) > _MAX_ARCS:
        return unsplit
    contour = blob.contour_px[np.isfinite(blob.contour_px[:, 0])]
    if len(arcs) == 1:
        fitted, rms = fit_ellipses(arcs)
        sound = rms[0] < 2.5 * _tolerance(fitted[0]) and _dark(fitted[0], contour, shape)
        return [Part(fitted[0], index)] if sound else unsplit
    groups = _grouped(arcs, contour)
    fitted, rms = fit_ellipses(groups)
    good = [
        ellipse
        for ellipse, group, error in zip(fitted, groups, rms, strict=True)
        if _sound(ellipse, group, float(error), contour, min_diameter_px)
        and _dark(ellipse, contour, shape)
    ]
    if not _explains(good, contour):
        return unsplit
    return [Part(ellipse, index, shared=len(good) > 1) for ellipse in good]


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
    """Arcs joined, best pair first, as long as one ellipse fits both."""
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
    """The outline filled, in the window of pixels (u, v) from ``low`` to before ``high``."""
    canvas = np.zeros((high - low)[::-1], np.uint8)
    cv2.fillPoly(canvas, [np.round(contour - low).astype(np.int32)[:, None]], 1)
    return canvas


def _dark(ellipse: Array, contour: Array, shape: tuple[int, ...]) -> bool:
    """Whether what the image shows of the ellipse's disc lies within the blob."""
    low = np.maximum(np.floor(ellipse[:2] - ellipse[2]), 0).astype(np.int64)
    high = np.minimum(np.ceil(ellipse[:2] + ellipse[2]) + 1, shape[::-1]).astype(np.int64)
    if np.any(high <= low):
        return False
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]]
    disc = rough_distance(ellipse, u, v) < 0.0
    blob = cv2.dilate(_filled(contour, low, high), np.ones((2 * _CANVAS_MARGIN_PX + 1,) * 2))
    seen = np.count_nonzero(disc) / (np.pi * ellipse[2] * ellipse[3])
    return bool(seen > _LEAST_IN_IMAGE and np.mean(blob[disc]) > _MIN_COVERED)


def _covered(ellipses: Array, contour: Array) -> float:
    low = np.floor(np.min(contour, axis=0)).astype(np.int64)
    high = np.ceil(np.max(contour, axis=0)).astype(np.int64) + 1
    v, u = np.nonzero(_filled(contour, low, high))
    gap = rough_distance(ellipses[:, None, :], (u + low[0])[None, :], (v + low[1])[None, :])
    return float(np.mean(np.any(gap < 0.7, axis=0)))


def implausible_outlines(outlines: Outlines) -> Bools:
    """Outlines (B,) that miss the rim, or have a neck: no single bubble has such an outline.

    The slighter the neck, the worse the outline's harmonics must describe the rim. Outlines that
    are partly hidden are not tested for necks.
    """
    depth = deepest_concavity(outlines.ellipse, outlines.harmonics)
    radius = np.sqrt(outlines.ellipse[:, 2] * outlines.ellipse[:, 3])
    sure = depth > 3.0 * _SHARPEST_ORDER * outlines.sigma_outline_px / radius
    neck = np.any([(depth > least) & (outlines.chi2_dof > fit) for least, fit in _NECKS], axis=0)
    neck &= sure & (outlines.coverage > _WHOLE)
    return np.asarray(neck | (outlines.misfit_px > _MISFIT_PX + _MISFIT_SHARE * radius))


def implausible_parts(outlines: Outlines, parts: list[Part]) -> Bools:
    """Implausible outlines, and parts of a blob whose fit ended far from its start: then the
    split was wrong."""
    began = np.stack([part.ellipse for part in parts])
    ended = outlines.ellipse
    growth = np.sqrt(ended[:, 2] * ended[:, 3] / (began[:, 2] * began[:, 3]))
    jump = np.hypot(ended[:, 0] - began[:, 0], ended[:, 1] - began[:, 1])
    moved = np.maximum(growth, 1.0 / growth) > _LARGEST_GROWTH
    moved |= (jump > 0.3 * began[:, 3] + 1.0) | (ended[:, 2] > _LONG * ended[:, 3])
    moved &= np.array([part.shared for part in parts])
    return implausible_outlines(outlines) | moved
