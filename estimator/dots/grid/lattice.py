"""Grow a lattice from unordered dots: which of them lie on one grid, and at which places.

The dots are circles, so their median ellipse gives the foreshortening. Mapping that ellipse to a
circle gives the grid's cell its true shape to first order, however strong the tilt. From there the
grid grows place by place, each predicted from the dots around it, so that perspective and
distortion only have to be smooth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from telerig.arrays import Array, Bools, Ints
from telerig.errors import DetectionError
from telerig.statistics import robust_sd

NEIGHBOURS: Ints = np.array(
    [(i, j) for i in range(-2, 3) for j in range(-2, 3) if (i, j) != (0, 0)], np.int64
)
"""(24, 2) steps to the places of the 5 x 5 window."""

_HOLD = 0.05
"""Weight of the neighbours' own pitch vectors, which decide where all places lie in one line."""


def fit_neighbours(
    at: Ints, values: Array, places: Ints, basis: Array, *, itself: bool = False
) -> tuple[Array, Array, Array]:
    """Fit an affine function to the values of the dots round each of C places of a grid.

    at : (H, W) index of the dot at each place of the grid, -1 for none.
    values : (N, 2) of the N dots.
    places : (C, 2) indices into ``at``.
    basis : (N, 2, 2) pitch vectors of each dot, towards which the fit is pulled weakly.
    itself : whether the dot at the place itself is used, too.

    Returns for each place the fitted value (C, 2), its change (C, 2, 2) per step of the grid, and
    the variance (C,) of the fitted value if the values of the dots have unit variance.
    """
    steps = np.concatenate([NEIGHBOURS, [[0, 0]]]) if itself else NEIGHBOURS
    dots = at[places[:, :1] + steps[:, 0], places[:, 1:] + steps[:, 1]]
    there = (dots >= 0) / (0.5 + np.sum(steps**2, axis=1))
    design = np.column_stack([np.ones(len(steps)), steps])
    outer = np.einsum("ka,kb->kab", design, design).reshape(len(steps), 9)
    normal = (there @ outer).reshape(-1, 3, 3)
    total = np.maximum(there.sum(1), 1e-12)[:, None]
    mean_basis = np.einsum("ck,ckab->cab", there, basis[dots]) / total[..., None]
    right = np.einsum("ck,ka,ckx->cax", there, design, values[dots])
    hold = _HOLD * total[..., None]
    normal = normal + hold * np.diag([0.0, 1.0, 1.0]) + 1e-12 * np.eye(3)
    right[:, 1:] += hold * mean_basis
    solved = np.linalg.solve(normal, right)
    row = np.linalg.solve(normal, np.eye(3)[:, :1])[..., 0]
    spread = np.sum((there * (row @ design.T)) ** 2, axis=1)
    return solved[:, 0], solved[:, 1:], spread


def leave_one_out(at: Ints, residuals: Array, places: Ints) -> Array:
    """Return how far each dot's residual is from the value that its neighbours predict.

    at : (H, W) index of the dot at each place, -1 for none.
    residuals : (N, 2) of the N dots, in standard deviations.
    places : (C, 2) indices into ``at`` of the dots that are tested.

    Returns the distances (C,) in standard deviations.
    """
    flat = np.zeros((len(residuals), 2, 2))
    expected, _, spread = fit_neighbours(at, residuals, places, flat)
    own = residuals[at[tuple(places.T)]]
    return np.asarray(np.linalg.norm(own - expected, axis=1) / np.sqrt(1 + spread))


def fit_homography(source: ArrayLike, target: ArrayLike) -> Array:
    """Return the homography H (3, 3) with target ~ H source that fits N pairs of points best.

    source, target : (N, 2). With few pairs the map is affine.
    """
    homography, _ = cv2.findHomography(np.asarray(source, float), np.asarray(target, float))
    return fit_affine(source, target) if homography is None else np.asarray(homography)


def apply_homography(homography: Array, points: ArrayLike) -> Array:
    """Return the images (..., N, 2) of points (..., N, 2) under homographies (..., 3, 3)."""
    p = np.asarray(points, float)
    h = homography
    mapped = p @ h[..., :2].mT + h[..., None, :, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])


def epipolar_products(first: Array, second: Array) -> Array:
    """Return the products (..., 9) of (u, v, 1) and (u', v', 1), in which x'^T F x is linear.

    first, second : (..., 2) pixels of the same points in two cameras; NaN where a camera did not
        see one, and so are all products then.
    """
    seen = np.where(np.isfinite(first + second).all(-1, keepdims=True), 1.0, np.nan)
    one, two = (np.concatenate([p, np.ones_like(seen)], -1) for p in (first, second))
    return np.asarray(seen * (one[..., :, None] * two[..., None, :]).reshape(*one.shape[:-1], 9))


def fit_affine(source: ArrayLike, target: ArrayLike) -> Array:
    """Return the affine map, as a homography (3, 3), that fits N pairs of points (N, 2) best."""
    a, b = np.asarray(source, float), np.asarray(target, float)
    solved, *_ = np.linalg.lstsq(np.column_stack([a, np.ones(len(a))]), b, rcond=None)
    return np.vstack([solved.T, [0.0, 0.0, 1.0]])


MIN_DOTS = 6
NOT_ON_GRID = "not on the grid"
OFF_PLACE = "off its place on the grid"
SECOND_DOT = "a second dot at an occupied place"

_REACH = 0.25
"""A dot is at a predicted place when it is within this fraction of the local pitch."""
_ROUGH = 0.05
"""On a true grid the median distance from the neighbours' prediction is below this fraction of the
pitch."""
_ANGLE_REACH = 0.55
"""Steps are looked for within this angle (rad) of the cell's."""


@dataclass(frozen=True)
class Cell:
    """Shape of a grid's cell, without its size and direction.

    ratio : of the longer to the shorter pitch.
    cosine : of the acute angle between the pitch vectors; 0 for a rectangle, 1/2 for a hexagonal
        grid.
    """

    ratio: float
    cosine: float

    @classmethod
    def of(cls, basis: ArrayLike) -> Cell:
        """Return the shape of the cell that two pitch vectors (2, 2), as rows, make."""
        one, two = np.asarray(basis, float)
        length = np.hypot(*one), np.hypot(*two)
        ratio = float(max(length) / min(length))
        return cls(ratio, float(abs(one @ two) / (length[0] * length[1])))


SQUARE = Cell(1.0, 0.0)


@dataclass(frozen=True)
class Lattice:
    """Dots at the places of one grid. The axes of the places are right-handed in (u, v).

    index : (n,) positions in the given arrays of the dots that have a place.
    places : (n, 2) integer place of each.
    basis_px : (n, 2, 2) local pitch vectors; basis_px[k, axis] is the step in (u, v).
    shape : (n, 2, 2) each dot's shape matrix in units of the local pitch vectors; for a round dot
        of radius r on perpendicular pitches p it is diag(r^2 / p1^2, r^2 / p2^2).
    unplaced : (m,) positions of the other dots
    reasons : why, one each.
    """

    index: Ints
    places: Ints
    basis_px: Array
    shape: Array
    unplaced: Ints
    reasons: tuple[str, ...]


def shape_matrix(a_px: ArrayLike, b_px: ArrayLike, angle_rad: ArrayLike) -> Array:
    """Return the matrix S (..., 2, 2) of the ellipse x^T S^-1 x = 1 with semi-axes a, b."""
    a2, b2 = np.square(np.asarray(a_px, float)), np.square(np.asarray(b_px, float))
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    uu, vv, uv = a2 * c * c + b2 * s * s, a2 * s * s + b2 * c * c, (a2 - b2) * c * s
    return np.stack([np.stack([uu, uv], -1), np.stack([uv, vv], -1)], -2)


def circle_from_ellipses(shapes_px2: ArrayLike) -> Array:
    """Return the matrix (2, 2) that maps the median ellipse of N shapes to the unit circle."""
    values, vectors = np.linalg.eigh(np.asarray(shapes_px2, float))
    values = np.maximum(values, 1e-6)
    logs = np.einsum("nij,nj,nkj->nik", vectors, np.log(values), vectors)
    values, vectors = np.linalg.eigh(np.median(logs, axis=0))
    return np.asarray((vectors * np.exp(-0.5 * values)) @ vectors.T)


def grow_lattice(
    points_px: ArrayLike,
    shapes_px2: ArrayLike,
    *,
    cell: Cell = SQUARE,
    floor_px: float = 0.3,
) -> Lattice:
    """Find the largest grid among the N dots of an image.

    points_px : (N, 2) centres.
    shapes_px2 : (N, 2, 2), see `shape_matrix`.
    cell : shape of the grid's cell; it does not say which axis is x.
    floor_px : a dot within this distance of its place on the grid always belongs to the grid.

    Raises DetectionError when fewer than 6 dots lie on a common grid.
    """
    points, shapes = np.asarray(points_px, float), np.asarray(shapes_px2, float)
    if len(points) < MIN_DOTS:
        raise DetectionError(
            f"{len(points)} dots are too few to make out a grid",
            todo=f"at least {MIN_DOTS} dots of the target must be whole and sharp",
        )
    circle = circle_from_ellipses(shapes)
    back = np.asarray(np.linalg.inv(circle), float)
    flat = points @ circle.T
    best = _best_growth(flat, cell)
    if best is not None:
        _drop_false_dots(best, back, floor_px)
    if best is None or not _is_grid(best):
        found = 0 if best is None else int(best.placed().sum())
        raise DetectionError(
            f"of {len(points)} dots only {found} lie on a grid with the target's pitch ratio",
            todo="check [target] pitch_mm and polarity, and that the target is sharp and in view",
        )
    return _lattice(best, back, shapes)


def _best_growth(flat: Array, cell: Cell) -> _Growth | None:
    """Return the best of a few starts, or the first that covers nearly all dots."""
    best: _Growth | None = None
    for basis in _bases(flat, cell):
        for seed in _seeds(flat, basis):
            growth = _Growth(flat, seed, basis)
            growth.grow()
            if best is None or growth.score(cell) > best.score(cell):
                best = growth
            if best.score(cell) > 0.85 * len(flat):
                return best
    return best


def _bases(flat: Array, cell: Cell) -> list[Array]:
    """Return pairs of frequent steps that make a cell of this shape, likeliest first."""
    steps, votes = _frequent_steps(flat, min(len(flat) - 1, round(4 + 6 * cell.ratio)))
    length = np.linalg.norm(steps, axis=1)
    one, two = np.triu_indices(len(steps), 1)
    area = np.abs(steps[one, 0] * steps[two, 1] - steps[one, 1] * steps[two, 0])
    angle = np.arcsin(np.clip(area / (length[one] * length[two]), 0, 1))
    aspect = np.abs(np.abs(np.log(length[one] / length[two])) - np.log(cell.ratio))
    good = (np.abs(angle - np.arccos(cell.cosine)) < _ANGLE_REACH) & (aspect < 0.3)
    score = np.sqrt(votes[one] * votes[two]) * good
    kept = np.flatnonzero((score > 0) & (score >= 0.4 * score.max(initial=0)))
    return [steps[[one[k], two[k]]] for k in kept[np.argsort(area[kept])][:6]]


def frequent_cell(points: Array) -> Array | None:
    """Return the pitch vectors (2, 2), as rows, of a grid among N points (N, 2).

    They are the two shortest steps that are frequent between neighbouring points. Returns None if
    all frequent steps have one direction.
    """
    if len(points) < MIN_DOTS:
        return None
    steps, votes = _frequent_steps(points, min(len(points) - 1, 12))
    steps = steps[votes > 0.4 * votes.max(initial=0)]
    steps = steps[np.argsort(np.linalg.norm(steps, axis=1))]
    if not len(steps):
        return None
    length = np.linalg.norm(steps, axis=1) * np.hypot(*steps[0])
    aside = np.abs(steps[:, 0] * steps[0, 1] - steps[:, 1] * steps[0, 0]) > 0.3 * length
    return steps[[0, int(np.argmax(aside))]] if aside.any() else None


def _frequent_steps(flat: Array, neighbours: int, patch_size: int = 60) -> tuple[Array, Array]:
    """Return the steps (K, 2) between near dots, up to sign, and how often each occurs (K,)."""
    middle = np.median(flat, axis=0)
    patch = np.argsort(np.sum((flat - middle) ** 2, axis=1))[:patch_size]
    _, near = cKDTree(flat).query(flat[patch], neighbours + 1)
    steps = (flat[near[:, 1:]] - flat[patch][:, None]).reshape(-1, 2)
    steps = np.concatenate([steps, -steps])
    reach = 0.15 * np.linalg.norm(steps, axis=1)
    votes = cKDTree(steps).query_ball_point(steps, reach, return_length=True).astype(float)
    found, counts = [], []
    left = np.where(steps @ [1.0, 1e-3] > 0, votes, 0.0)
    for _ in range(16):
        top = int(np.argmax(left))
        if left[top] < 0.1 * votes.max() or left[top] == 0:
            break
        close = np.linalg.norm(steps - steps[top], axis=1) <= reach[top]
        found.append(np.median(steps[close], axis=0))
        counts.append(votes[top])
        for sign in (1, -1):
            left[np.linalg.norm(steps - sign * steps[top], axis=1) <= 2 * reach[top]] = 0
    return np.array(found).reshape(-1, 2), np.array(counts)


def _seeds(flat: Array, basis: Array, count: int = 4) -> Iterator[int]:
    """Return dots with good neighbours on all sides, best first and well apart."""
    steps = np.concatenate([basis, -basis])
    miss, _ = cKDTree(flat).query((flat[:, None] + steps).reshape(-1, 2))
    pitch = np.linalg.norm(steps, axis=1)
    part = np.minimum(miss.reshape(-1, 4) / pitch, 1.0)
    order = np.argsort(np.sum(part, axis=1), kind="stable")
    yield from order[:: max(1, len(order) // (4 * count))][:count].tolist()


class _Growth:
    """A grid while it grows: `at` holds the dot at each place, -1 where there is none."""

    def __init__(self, flat: Array, seed: int, basis: Array) -> None:
        turn = np.sign(np.linalg.det(basis))
        basis = basis * np.array([[1.0], [turn]])
        extent = np.ptp(flat, axis=0).max() / np.linalg.norm(basis, axis=1).min()
        self.half = int(min(2 * extent + 8, 1500))
        self.flat, self.tree = flat, cKDTree(flat)
        self.at = np.full((2 * self.half + 1, 2 * self.half + 1), -1, np.int64)
        self.place = np.full((len(flat), 2), -1, np.int64)
        self.basis = np.zeros((len(flat), 2, 2))
        self.banned = np.zeros(len(flat), bool)
        self.basis[seed] = basis
        self._put(np.array([seed]), np.array([[self.half, self.half]]))

    def placed(self) -> Bools:
        return np.asarray(self.place[:, 0] >= 0)

    def score(self, cell: Cell) -> float:
        """Return the number of dots on the grid, reduced for gaps and for a ragged outline."""
        dots = np.flatnonzero(self.placed())
        i, j = self.place[dots].T
        runs = (self.at[i + 1, j] >= 0).sum() + (self.at[i, j + 1] >= 0).sum()
        full = min(1.0, 0.5 + float(runs) / (2 * len(dots)))
        seen = Cell.of(np.median(self.basis[dots], axis=0))
        skew = abs(seen.cosine - cell.cosine)
        stretch = abs(np.log(seen.ratio) - np.log(cell.ratio))
        return len(dots) * full * float(np.exp(-((skew / 0.3) ** 2) - (stretch / 0.3) ** 2))

    def grow(self) -> None:
        """Add dots round by round until no dot is left at a place within two steps of the grid."""
        front = self.place[self.placed()]
        while len(front):
            front = self._round(front, NEIGHBOURS[np.abs(NEIGHBOURS).sum(1) == 1])
            if not len(front):
                front = self._round(self.place[self.placed()], NEIGHBOURS)

    def remove(self, dots: Ints) -> None:
        self.at[tuple(self.place[dots].T)] = -1
        self.place[dots] = -1
        self.banned[dots] = True

    def _round(self, front: Ints, steps: Ints) -> Ints:
        around = (front[:, None] + steps).reshape(-1, 2)
        wanted = np.stack(np.divmod(np.unique(around @ [len(self.at), 1]), len(self.at)), axis=1)
        wanted = wanted[np.all((wanted > 2) & (wanted < 2 * self.half - 2), axis=1)]
        wanted = wanted[self.at[tuple(wanted.T)] < 0]
        if not len(wanted):
            return np.asarray(wanted)
        expected, basis, _ = fit_neighbours(self.at, self.flat, wanted, self.basis)
        reach = _REACH * np.linalg.norm(basis, axis=2).min(axis=1)
        miss, dot = self.tree.query(expected, 2)
        free = ~self.placed()[dot] & ~self.banned[dot]
        pick = np.where(free[:, 0], 0, 1)
        rows = np.arange(len(dot))
        miss, dot, free = miss[rows, pick], dot[rows, pick], free[rows, pick]
        good = np.flatnonzero(free & (miss < reach))
        good = good[np.argsort(miss[good] / reach[good])]
        _, first = np.unique(dot[good], return_index=True)
        good = good[first]
        self.basis[dot[good]] = basis[good]
        self._put(dot[good], wanted[good])
        return np.asarray(wanted[good])

    def _put(self, dots: Ints, places: Ints) -> None:
        self.at[tuple(places.T)] = dots
        self.place[dots] = places


def _drop_false_dots(growth: _Growth, image_from_flat: Array, floor_px: float) -> None:
    """Remove dots that are off their place as predicted by their neighbours, then grow again."""
    for _ in range(8):
        dots = np.flatnonzero(growth.placed())
        if len(dots) < MIN_DOTS:
            return
        places = growth.place[dots]
        smooth = apply_homography(fit_homography(places, growth.flat[dots]), places)
        residual = np.zeros_like(growth.flat)
        residual[dots] = (growth.flat[dots] - smooth) @ image_from_flat.T
        miss = leave_one_out(growth.at, residual, places)
        limit = max(8 * float(robust_sd(miss)), floor_px)
        worst = np.full(growth.at.shape, 0.0)
        worst[tuple(places.T)] = miss
        around = [worst[tuple((places + step).T)] for step in NEIGHBOURS]
        false = dots[(miss > limit) & (miss >= np.max(around, axis=0))]
        if not len(false):
            return
        growth.remove(false)
        growth.grow()


def _is_grid(growth: _Growth) -> bool:
    """Whether enough dots lie closely enough on it: by chance a few scattered dots always do."""
    dots = np.flatnonzero(growth.placed())
    if len(dots) < max(MIN_DOTS, 0.3 * len(growth.flat)):
        return False
    places = growth.place[dots]
    fit = fit_homography if len(dots) > 9 else fit_affine
    residual = np.zeros_like(growth.flat)
    residual[dots] = growth.flat[dots] - apply_homography(fit(places, growth.flat[dots]), places)
    pitch = np.linalg.norm(growth.basis[dots], axis=2).min(axis=1)
    rough = np.median(leave_one_out(growth.at, residual, places) / pitch)
    return bool(rough < _ROUGH)


def _lattice(growth: _Growth, image_from_flat: Array, shapes_px2: Array) -> Lattice:
    index = np.flatnonzero(growth.placed())
    places = growth.place[index]
    _, basis, _ = fit_neighbours(growth.at, growth.flat, places, growth.basis, itself=True)
    basis_px = basis @ image_from_flat.T
    pitch_from_px = np.linalg.inv(basis_px.mT)
    shape = pitch_from_px @ shapes_px2[index] @ pitch_from_px.mT
    unplaced = np.flatnonzero(~growth.placed())
    reach = np.linalg.norm(basis, axis=2).min(axis=1)
    miss, next_to = cKDTree(growth.flat[index]).query(growth.flat[unplaced])
    second = miss < _REACH * reach[next_to]
    reasons = np.where(second, SECOND_DOT, NOT_ON_GRID)
    reasons = np.where(growth.banned[unplaced] & ~second, OFF_PLACE, reasons)
    return Lattice(
        index, places - places.min(0), basis_px, shape, unplaced, tuple(reasons.tolist())
    )


def next_places(
    lattice: Lattice, points_px: Array, image_shape: tuple[int, ...], radius_px: float
) -> tuple[Ints, Ints]:
    """Return the places (K, 2) without a dot next to dots: those in view, and the others.

    A place is in view if the image would show a whole dot there.

    points_px : (N, 2) centres of all dots of the image. radius_px : of a dot.
    """
    steps = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
    at = (lattice.places[:, None] + steps).reshape(-1, 2)
    px = (points_px[lattice.index, None] + steps @ lattice.basis_px).reshape(-1, 2)
    margin, size = radius_px + 2.0, np.array(image_shape[::-1])
    inside = np.all((px > margin) & (px < size - 1 - margin), axis=1)
    taken = {*map(tuple, lattice.places.tolist())}
    out = {*map(tuple, at[~inside].tolist())} - taken
    seen = {*map(tuple, at[inside].tolist())} - taken - out
    in_view, out_of_view = (np.array(sorted(s), np.int64).reshape(-1, 2) for s in (seen, out))
    return in_view, out_of_view
