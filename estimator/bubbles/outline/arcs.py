"""Outlines as lists of points: moments, notches, arcs between notches, ellipses through arcs."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.bubbles.outline.ellipse_geometry import (
    ELLIPSE_PARAMETERS,
    ellipse_basis,
    foot_points,
    moved,
    rough_distance,
)

Array = NDArray[np.float64]

_TURN_RAD = -0.1
_POINT_SIGMA_PX = 0.2
_ROUND_SHARE = 0.12
_SHORTEST_ARC = 5
_ROUNDS = 8


def contour_moments(contours: list[Array]) -> tuple[Array, Array, Array]:
    """Ellipses (B, 5) of equal area moments, and the RMS and largest distance of their points.

    Points that are NaN (beyond the image) are passed over.
    """
    clean = [contour[np.isfinite(contour[:, 0])] for contour in contours]
    clean = [contour if len(contour) >= 3 else np.eye(3, 2) for contour in clean]
    sizes = np.array([len(contour) for contour in clean])
    first = np.cumsum(sizes) - sizes
    owner = np.repeat(np.arange(sizes.size), sizes)
    points = np.concatenate(clean)
    origin = np.add.reduceat(points, first) / sizes[:, None]
    x, y = (points - origin.take(owner, axis=0)).T
    following = np.arange(owner.size) + 1
    following[first + sizes - 1] = first
    x1, y1 = x[following], y[following]
    cross = x * y1 - x1 * y
    terms = [
        cross / 2.0,
        cross * (x + x1) / 6.0,
        cross * (y + y1) / 6.0,
        cross * (x * x + x * x1 + x1 * x1) / 12.0,
        cross * (y * y + y * y1 + y1 * y1) / 12.0,
        cross * (x * (2.0 * y + y1) + x1 * (2.0 * y1 + y)) / 24.0,
    ]
    area, mx, my, mxx, myy, mxy = (np.add.reduceat(term, first) for term in terms)
    area = np.where(np.abs(area) < 1e-9, 1e-9, area)
    mx, my = mx / area, my / area
    mxx, myy, mxy = mxx / area - mx * mx, myy / area - my * my, mxy / area - mx * my
    middle, half = (mxx + myy) / 2.0, np.hypot((mxx - myy) / 2.0, mxy)
    a = 2.0 * np.sqrt(np.maximum(middle + half, 0.1))
    b = 2.0 * np.sqrt(np.maximum(middle - half, 0.1))
    angle = 0.5 * np.arctan2(2.0 * mxy, mxx - myy)
    ellipse = np.stack([origin[:, 0] + mx, origin[:, 1] + my, a, b, angle], axis=1)
    gap = rough_distance(ellipse.take(owner, axis=0), points[:, 0], points[:, 1])
    rms = np.sqrt(np.add.reduceat(gap**2, first) / sizes)
    return ellipse, rms, np.maximum.reduceat(np.abs(gap), first)


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


def arcs_between(contour: Array, cuts: Array) -> list[Array]:
    """A closed outline (n, 2) cut at its points nearest to ``cuts`` (m, 2)."""
    points = _spaced(contour, closed=True)
    gap = np.hypot(*(points[:, None] - cuts[None]).transpose(2, 0, 1))
    bounds = np.sort(np.argmin(gap, axis=0)).tolist()
    points = np.roll(points, -bounds[0], axis=0)
    return _trimmed(points, [k - bounds[0] for k in bounds] + [len(points)])


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
