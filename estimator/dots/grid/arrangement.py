"""Number the dots of a target of arbitrary points by their arrangement.

The dots' ellipses give the foreshortening. With it removed, triangles of neighbouring dots look as
they do on the target, up to rotation, mirroring and perspective. Pairs of triangles with equal
sides propose maps from the target to the image; the map that explains most dots is the best.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from telerig.arrays import Array, Ints
from telerig.errors import DetectionError
from telerig.estimator.dots.grid.lattice import (
    MIN_DOTS,
    apply_homography,
    circle_from_ellipses,
    fit_affine,
    fit_homography,
)

_LOCAL = 12


@dataclass(frozen=True)
class PointMatch:
    """One assignment of the target's points to the dots of an image.

    dot : (n,) indices of the matched dots.
    point : (n,) index of the target's point for each.
    handedness : +1, or -1 when the image is mirrored.
    """

    dot: Ints
    point: Ints
    handedness: int

    def agrees(self, other: PointMatch) -> bool:
        """Whether both assign the same point to more than half of the dots."""
        ours = set(zip(self.dot.tolist(), self.point.tolist()))
        shared = len(ours & set(zip(other.dot.tolist(), other.point.tolist())))
        return shared > 0.5 * min(len(self.dot), len(other.dot))


def match_points(
    points_px: ArrayLike,
    shapes_px2: ArrayLike,
    points_mm: ArrayLike,
    *,
    dot_radius_mm: float,
) -> list[PointMatch]:
    """Return the ways to match the dots of an image with the listed points of a target, best first.

    points_px : (M, 2) centres of the dots.
    shapes_px2 : (M, 2, 2), see `shape_matrix`.
    points_mm : (N, 2) points of the target.
    dot_radius_mm : radius of its dots.

    Raises DetectionError when there are fewer than 6 dots or no map explains half of them.
    """
    points, wanted = np.asarray(points_px, float), np.asarray(points_mm, float)
    if len(points) < MIN_DOTS or len(wanted) < MIN_DOTS:
        raise DetectionError(
            f"{len(points)} dots for a target of {len(wanted)} points are too few to match",
            todo=f"at least {MIN_DOTS} dots must be whole and sharp",
        )
    circle = dot_radius_mm * circle_from_ellipses(shapes_px2)
    flat = points @ circle.T
    matches: list[PointMatch] = []
    for start, middle in _proposals(flat, wanted):
        found = _extended(flat, wanted, start, middle)
        if len(found.dot) >= MIN_DOTS and not any(found.agrees(other) for other in matches):
            matches.append(found)
    matches.sort(key=lambda match: -len(match.dot))
    if not matches or len(matches[0].dot) < 0.5 * min(len(points), len(wanted)):
        best = len(matches[0].dot) if matches else 0
        raise DetectionError(
            f"at most {best} of {len(points)} dots fit the target's {len(wanted)} points",
            todo="check [target] points_mm, dot_diameter_mm and polarity in rig.toml, "
            "and that enough of the target is in view",
        )
    return matches


def _triangles(points: Array, nearest: int = 5) -> Ints:
    """Return triangles (T, 3) of each point and two of its nearest, without slivers or repeats."""
    count = min(nearest, len(points) - 1)
    _, near = cKDTree(points).query(points, count + 1)
    pairs = np.array(list(combinations(range(1, count + 1), 2)))
    corners = np.concatenate(
        [np.repeat(near[:, :1, None], len(pairs), 1), near[:, pairs]], axis=2
    ).reshape(-1, 3)
    corners = np.unique(np.sort(corners, axis=1), axis=0)
    one = points[corners[:, 1]] - points[corners[:, 0]]
    two = points[corners[:, 2]] - points[corners[:, 0]]
    area = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    longest = _sides(points, corners).max(axis=1)
    return np.asarray(corners[area > 0.2 * longest**2])


def _sides(points: Array, corners: Ints) -> Array:
    """Return the sides (T, 3) opposite to the corners."""
    p = points[corners]
    return np.asarray(np.linalg.norm(p[:, [1, 2, 0]] - p[:, [2, 0, 1]], axis=2))


def _signature(sides: Array) -> Array:
    """Return the shape of each triangle (T, 3), and its size with a third of the weight."""
    logs = np.log(sides)
    size = logs.mean(axis=1)
    return np.column_stack([logs[:, 0] - size, logs[:, 1] - size, size / 3])


def _proposals(flat: Array, wanted: Array, most: int = 240) -> list[tuple[Array, int]]:
    """Return maps flat_from_mm, each with a point in its middle, that explain most dots near."""
    ours, theirs = _triangles(flat), _triangles(wanted)
    ours = ours[:: max(1, len(ours) // most)]
    if not len(ours) or not len(theirs):
        return []
    theirs = np.concatenate([theirs[:, list(order)] for order in permutations(range(3))])
    tree = cKDTree(_signature(_sides(wanted, theirs)))
    near: Any = tree.query_ball_point(_signature(_sides(flat, ours)), 0.12)
    mine = np.repeat(np.arange(len(ours)), [len(n) for n in near])
    other = np.concatenate([np.asarray(n, np.int64) for n in near])
    if not len(mine):
        return []
    affine = _affine_from_triangles(wanted[theirs[other]], flat[ours[mine]])
    corner = theirs[other][:, 0]
    count = min(_LOCAL, len(wanted))
    _, around = cKDTree(wanted).query(wanted, count)
    expected = apply_homography(affine, wanted[around[corner]])
    miss, _ = cKDTree(flat).query(expected)
    hits = np.sum(miss < 0.25 * _spacing(flat), axis=1)
    top = np.argsort(-hits, kind="stable")[: 40 * _LOCAL]
    return _distinct(affine[top], corner[top], wanted)


def _distinct(affine: Array, corner: Ints, wanted: Array) -> list[tuple[Array, int]]:
    """Return the first few different proposals; many triangles propose the same map."""
    centre = apply_homography(affine, wanted.mean(0)[None])[:, 0]
    reach = 0.3 * np.ptp(wanted, axis=0).max()
    kept: list[int] = []
    for k in range(len(affine)):
        linear = affine[k, :2, :2]
        if not any(
            np.linalg.norm(centre[k] - centre[j]) < reach
            and np.linalg.norm(linear - affine[j, :2, :2]) < 0.3 * np.linalg.norm(linear)
            for j in kept
        ):
            kept.append(k)
        if len(kept) == _LOCAL:
            break
    return [(affine[k], int(corner[k])) for k in kept]


def _affine_from_triangles(source: Array, target: Array) -> Array:
    """Return the affine maps (T, 3, 3) that take corners (T, 3, 2) to corners (T, 3, 2)."""
    ones = np.ones((*source.shape[:2], 1))
    rows = np.linalg.solve(np.concatenate([source, ones], 2), target)
    affine = np.zeros((len(source), 3, 3))
    affine[:, :2], affine[:, 2, 2] = rows.mT, 1.0
    return affine


def _extended(flat: Array, wanted: Array, start: Array, middle: int) -> PointMatch:
    """Return the match of a map that is refined outwards from its middle."""
    away = np.argsort(np.sum((wanted - wanted[middle]) ** 2, axis=1))
    count, model = min(_LOCAL, len(wanted)), _Model(start, None)
    reach = 0.3 * _spacing(flat)
    tree = cKDTree(flat)
    rounds = 0
    dot = point = np.zeros(0, np.int64)
    while rounds < 3:
        dot, point = _mutually_nearest(tree, flat, model.apply(wanted[away[:count]]), reach)
        point = away[point]
        if len(dot) < min(4, MIN_DOTS):
            break
        model = _fit(wanted[point], flat[dot])
        rounds += int(count == len(wanted))
        count = min(2 * count, len(wanted))
    if len(dot) >= MIN_DOTS:
        off = np.linalg.norm(flat[dot] - model.apply(wanted[point]), axis=1)
        good = off <= max(8 * float(np.median(off)), 0.02 * _spacing(flat))
        dot, point = dot[good], point[good]
    return PointMatch(dot, point, model.handedness(wanted[middle]))


def _mutually_nearest(
    tree: cKDTree, flat: Array, expected: Array, reach: float
) -> tuple[Ints, Ints]:
    miss, dot = tree.query(expected)
    _, back = cKDTree(expected).query(flat)
    good = np.flatnonzero((miss < reach) & (back[dot] == np.arange(len(expected))))
    return dot[good], good


@dataclass(frozen=True)
class _Model:
    """A homography, and a cubic polynomial of its residuals for the lens distortion."""

    homography: Array
    cubic: Array | None
    centre: Array | float = 0.0
    scale: float = 1.0

    def apply(self, points: Array) -> Array:
        out = apply_homography(self.homography, points)
        if self.cubic is not None:
            out = out + _monomials((points - self.centre) / self.scale) @ self.cubic
        return out

    def handedness(self, point: Array) -> int:
        """Return +1, or -1 if the map mirrors the neighbourhood of a point (2,) of the target."""
        depth = self.homography[2] @ [*point, 1.0]
        return 1 if np.linalg.det(self.homography) * depth >= 0 else -1


def _fit(source: Array, target: Array) -> _Model:
    if len(source) < 8:
        return _Model(fit_affine(source, target), None)
    homography = fit_homography(source, target)
    if len(source) < 30:
        return _Model(homography, None)
    centre, scale = source.mean(0), float(np.ptp(source, axis=0).max()) / 2
    residual = target - apply_homography(homography, source)
    design = _monomials((source - centre) / scale)
    normal = design.T @ design + 1e-3 * np.eye(design.shape[1])
    cubic = np.asarray(np.linalg.solve(normal, design.T @ residual), float)
    return _Model(homography, cubic, centre, scale)


def _monomials(p: Array) -> Array:
    x, y = p[..., 0], p[..., 1]
    return np.stack([x**0, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], -1)


def _spacing(flat: Array) -> float:
    """Return the median distance of nearest neighbours."""
    near, _ = cKDTree(flat).query(flat, 2)
    return float(np.median(near[:, 1]))
