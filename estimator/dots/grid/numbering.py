"""Number the dots of one image: which dot of the target is each.

The lattice tells which dots are neighbours; the marks, the extent of a bounded grid and the pitch
ratio tell which dot is which. Every placement of the target on the lattice gets a log-likelihood.
One mark that is missed, or one dot that only looks like a mark, makes a numbering less likely but
not impossible, so the evidence of each place is bounded on both sides. Where the evidence does not
suffice, the numbering is marked as ambiguous and lists all candidates: a wrong number would spoil a
calibration, a missing image hardly matters.

A target of arbitrary points has no lattice; `match_points` numbers it by the arrangement of the
dots alone. Their ellipses give the foreshortening. With it removed, triangles of neighbouring dots
look as they do on the target, up to rotation, mirroring and perspective. Pairs of triangles with
equal sides propose maps from the target to the image; the map that explains most dots is the best.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from telerig.arrays import Array, Bools, Ints
from telerig.errors import DetectionError, InputError
from telerig.estimator.dots.grid.lattice import (
    MIN_DOTS,
    Lattice,
    apply_homography,
    circle_from_ellipses,
    fit_affine,
    fit_homography,
    grow_lattice,
    shape_matrix,
)
from telerig.rig.target import QUARTER_TURNS, Target
from telerig.statistics import robust_sd

LOG_MISSED_MARK = -4.0
"""A mark that is seen as a plain dot."""
LOG_FALSE_MARK = -7.5
"""A plain dot that is seen as a mark."""
LOG_UNSEEN_MARK = -2.0
"""A mark where the image shows no lattice place, or the dot of a mark is lost."""
LOG_FILLED_GAP = -5.0
"""A dot (dirt, say) at the place of a mark of the style "missing"."""
LOG_UNSURE_GAP = -0.7
"""A mark of the style "missing" at an empty place that has too few dots round it to be a gap."""


@dataclass(frozen=True)
class MarkEvidence:
    """Evidence for marks at the places of a lattice.

    gain : (H, W) log-likelihood ratio of mark to plain dot; place (i, j) is gain[i + 1, j + 1].
    seen : (K, 2) places that look like marks.
    """

    gain: Array
    seen: Ints

    def at(self, places: Ints) -> Array:
        """(...,) log-likelihood ratio at (..., 2) places; marks outside the lattice are unseen."""
        shifted = places + 1
        inside = np.all((shifted >= 0) & (shifted < self.gain.shape), axis=-1)
        clipped = np.clip(shifted, 0, np.array(self.gain.shape) - 1)
        return np.where(inside, self.gain[clipped[..., 0], clipped[..., 1]], LOG_UNSEEN_MARK)

    def is_seen(self, places: Ints) -> Bools:
        """(...,) whether each of the (..., 2) places looks like a mark."""
        if not len(self.seen):
            return np.zeros(places.shape[:-1], bool)
        return np.asarray(np.any(np.all(places[..., None, :] == self.seen, axis=-1), axis=-1))


def relative_diameter(lattice: Lattice) -> Array:
    """Return each dot's diameter (n,) in units of the lattice's pitch, relative to the median."""
    size = np.linalg.det(lattice.shape) ** 0.25
    return np.asarray(size / np.median(size))


def mark_likeness(lattice: Lattice, rings: Bools, target: Target) -> Array:
    """Return the probability (n,) that each dot is a mark of the target's style.

    rings : (n,) whether the image shows a ring.
    """
    if target.mark_style == "ring":
        return rings.astype(float)
    size = np.log(relative_diameter(lattice))
    step = np.log(
        (target.mark_diameter_mm or 1.5 * target.dot_diameter_mm) / target.dot_diameter_mm
    )
    spread = 1.5 * float(robust_sd(size))
    sigma = float(np.clip(spread, 0.05, max(abs(step) / 4, 0.05)))
    odds = (size - step / 2) * step / sigma**2
    return np.asarray(1 / (1 + np.exp(-np.clip(odds, -30, 30))))


def mark_evidence(lattice: Lattice, rings: Bools, target: Target) -> MarkEvidence:
    """Return the evidence at all places of the lattice and of a border one place wide.

    rings : (n,) whether the image shows a ring.
    """
    shape = lattice.places.max(0) + 3
    occupied = np.zeros(shape, bool)
    occupied[tuple((lattice.places + 1).T)] = True
    gain = np.full(shape, LOG_UNSEEN_MARK)
    if target.mark_style == "missing":
        empty = gaps(occupied, target.bounded)
        lost = max(0.5, empty.sum() - len(target.marks)) / occupied.sum()
        gain[_count_around(occupied) >= 4] = LOG_UNSURE_GAP
        gain[occupied] = LOG_FILLED_GAP
        gain[empty] = -np.clip(np.log(lost), -5.0, -1.5)
        return MarkEvidence(gain, np.argwhere(empty) - 1)
    like = mark_likeness(lattice, rings, target)
    gain[tuple((lattice.places + 1).T)] = mark_gain(like)
    return MarkEvidence(gain, lattice.places[like > 0.4])


def mark_gain(likeness: Array) -> Array:
    """Return the log-likelihood ratio (n,) of mark to plain dot, from `mark_likeness` (n,)."""
    missed, false = np.exp(LOG_MISSED_MARK), np.exp(LOG_FALSE_MARK)
    as_mark = np.log(likeness * (1 - missed) + (1 - likeness) * missed)
    as_plain = np.log(likeness * false + (1 - likeness) * (1 - false))
    return np.asarray(as_mark - as_plain)


def gaps(occupied: Bools, bounded: bool) -> Bools:
    """Empty places among dots; the border of a bounded grid needs dots on its inner side only."""
    around = _count_around(occupied)
    if not bounded:
        return np.asarray(~occupied & (around >= 6))
    inside = np.zeros(occupied.shape, bool)
    inside[1:-1, 1:-1] = True
    enough = np.maximum(3, 0.6 * _count_around(inside))
    return np.asarray(~occupied & inside & (around >= enough))


def _count_around(places: Bools) -> Ints:
    """Return how many of the eight neighbours are set (H, W)."""
    from scipy.ndimage import convolve

    ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
    return np.asarray(convolve(places.astype(np.int64), ring, mode="constant"))


LOG_DOT_OUTSIDE = -6.0
"""Log-likelihood of a dot on the lattice where the target has none."""
MARGIN = 4.0
"""Placements within this log-likelihood of the best are taken as equally good."""
MAX_TIED = 64

_MIN_ASPECT_SIGMA = 0.03


@dataclass(frozen=True)
class Placements:
    """K placements of the grid on a lattice, best first: (column, row) = turn @ place - shift.

    turn : (K, 2, 2), det -1 where the image is mirrored; shift : (K, 2); score : (K,)
    log-likelihoods.
    """

    turn: Ints
    shift: Ints
    score: Array

    def columns_rows(self, places: Ints) -> Ints:
        """(K, n, 2) column and row on the target, for each of the K placements.

        places : (n, 2) indices of dots in the lattice of the image.
        """
        turned = np.einsum("kab,nb->kna", self.turn, places)
        return np.asarray(turned - self.shift[:, None])

    def places(self, columns_rows: Ints) -> Ints:
        """(K, m, 2) places of (m, 2) columns and rows: the inverse of `columns_rows`."""
        shifted = columns_rows + self.shift[:, None]
        return np.asarray(np.einsum("kba,knb->kna", self.turn, shifted))

    def take(self, which: Ints) -> Placements:
        return Placements(self.turn[which], self.shift[which], self.score[which])


def rank_placements(lattice: Lattice, evidence: MarkEvidence, target: Target) -> Placements:
    """Return all placements within `MARGIN` of the best, best first, unmirrored before mirrored.

    Mirrored images are considered where the target's marks tell them apart.

    Raises DetectionError when the image shows none of the marks that an unbounded grid needs,
    InputError when an unbounded grid has no marks.
    """
    hands = (1, -1) if target.mirror_images_differ() else (1,)
    turns = [turn * np.array([[hand], [1]]) for hand in hands for turn in QUARTER_TURNS]
    aspect = _aspect_score(lattice, target)
    parts = []
    for turn in turns:
        shifts, score = _shifts(lattice, evidence, target, turn)
        score = score + aspect[int(turn[0, 0] == 0)]
        parts.append((np.broadcast_to(turn, (len(shifts), 2, 2)), shifts, score))
    every = Placements(*(np.concatenate(p) for p in zip(*parts)))
    if not len(every.score):
        raise DetectionError(
            f"none of the target's {len(target.marks)} marks was found",
            todo="an unbounded grid is numbered from its marks: keep them in view, and check "
            "[target] marks, mark_style and mark_diameter_mm in rig.toml",
        )
    order = np.argsort(-np.round(every.score, 6), kind="stable")
    return every.take(order[every.score[order] >= every.score[order[0]] - MARGIN])


def _aspect_score(lattice: Lattice, target: Target) -> tuple[float, float]:
    """Log-likelihoods, from the dots' shapes, that the lattice's first axis is x and is y."""
    logs = 0.5 * np.log(lattice.shape[:, 1, 1] / lattice.shape[:, 0, 0])
    middle = float(np.median(logs))
    spread = float(robust_sd(logs - middle))
    sigma = max(_MIN_ASPECT_SIGMA, 1.25 * spread / np.sqrt(len(logs)))
    nominal = float(np.log(target.pitch_mm[0] / target.pitch_mm[1]))
    along = [max(-0.5 * ((middle - s * nominal) / sigma) ** 2, -100.0) for s in (1, -1)]
    return along[0], along[1]


def _shifts(
    lattice: Lattice, evidence: MarkEvidence, target: Target, turn: Ints
) -> tuple[Ints, Array]:
    if target.bounded:
        shifts, score = _bounded_shifts(lattice.places @ turn.T, target)
    elif target.marks:
        seen = evidence.seen @ turn.T
        shifts = np.unique((seen[:, None] - target.marks_column_row()).reshape(-1, 2), axis=0)
        score = np.zeros(len(shifts))
    else:
        raise InputError(
            "an unbounded grid without marks has no origin",
            where="[target]",
            todo="state marks, or extent = 'bounded'",
        )
    if target.marks:
        score = score + evidence.at((target.marks_column_row() + shifts[:, None]) @ turn).sum(1)
    return shifts, score


def _bounded_shifts(turned: Ints, target: Target) -> tuple[Ints, Array]:
    """Return the shifts (S, 2) that keep most dots on the grid, and log-likelihoods (S,)."""
    size = np.array([target.columns, target.rows])
    low = turned.min(0) - size + 1
    span = turned.max(0) - low + size
    count = np.zeros(span + 1, np.int64)
    count[tuple((turned - low + 1).T)] = 1
    total = count.cumsum(0).cumsum(1)
    c, r = size
    inside = total[c:, r:] - total[:-c, r:] - total[c:, :-r] + total[:-c, :-r]
    outside = len(turned) - inside
    near = np.argwhere(outside <= outside.min() + 8)
    return near + low, LOG_DOT_OUTSIDE * outside[tuple(near.T)]


def related_by_symmetry(placements: Placements, target: Target) -> bool:
    """Whether the placements differ only by rotations that leave the target unchanged."""
    hands = np.linalg.det(placements.turn)
    if np.any(hands != hands[0]):
        return False
    marks = target.marks_column_row()
    corners = np.array([[0, 0], [target.columns - 1, target.rows - 1]])
    seen = placements.places(np.concatenate([marks, corners]))[0]
    moved = placements.columns_rows(seen)
    if target.bounded and np.any(np.sort(moved[:, len(marks) :], axis=1) != corners):
        return False
    wanted = {*map(tuple, marks.tolist())}
    return all({*map(tuple, one[: len(marks)].tolist())} == wanted for one in moved)


NEEDED = ["u_px", "v_px", "a_px", "b_px", "angle_rad"]
OUTSIDE = "on the grid, outside the target's rows and columns"
CLEAR_LEAD = 0.8
"""The second-best match of points must explain fewer than this share of the best match's dots."""
AT_A_GAP = "at the place of a missing mark"


@dataclass(frozen=True)
class Numbering:
    """Which dot of the target each located dot is.

    table : dot, row, column, index (position in the frame of dots); by dot.
    unplaced : index, reason.
    handedness : +1 when the image shows the target's x and y as u and v turn, -1 when mirrored,
        0 when the image cannot tell; +1 is assumed for targets equal to their mirror image.
    equivalents : (K, n) dot ids of the table's n rows under each numbering that fits the image as
        well; row 0 is the table's own, -1 is no dot of the target.
    equivalent_handedness : (K,).
    ambiguous : the numberings differ by more than the target's own symmetry, so that the table
        may be wrong.
    marks_found : dot ids of the marks that were seen.
    """

    table: pd.DataFrame
    unplaced: pd.DataFrame
    handedness: int
    equivalents: Ints
    equivalent_handedness: Ints
    ambiguous: bool
    marks_found: Ints


def number_dots(dots: pd.DataFrame, target: Target) -> Numbering:
    """Number unordered dots (u_px, v_px, a_px, b_px, angle_rad[, ring]) of one image.

    Raises DetectionError when there are too few dots, no grid, no marks, or too many candidates,
    InputError when a column is missing or a value is not finite.
    """
    if not len(dots):
        raise DetectionError(
            "no dots found",
            todo="check the exposure, [target] polarity in rig.toml, and that it is in view",
        )
    _check_columns(dots)
    points = dots[["u_px", "v_px"]].to_numpy(float)
    shapes = shape_matrix(*dots[["a_px", "b_px", "angle_rad"]].to_numpy(float).T)
    if target.layout == "points":
        return _number_points(points, shapes, target)
    ratio = target.pitch_mm[0] / target.pitch_mm[1]
    lattice = grow_lattice(points, shapes, pitch_ratio=ratio)
    ring = dots["ring"].to_numpy(bool) if "ring" in dots else np.zeros(len(dots), bool)
    evidence = mark_evidence(lattice, ring[lattice.index], target)
    ranked, ambiguous = _kept(rank_placements(lattice, evidence, target), evidence, target)
    return _numbering(lattice, evidence, ranked, ambiguous, target)


def _check_columns(dots: pd.DataFrame) -> None:
    missing = [name for name in NEEDED if name not in dots]
    if missing:
        raise InputError(
            f"the table of dots has no column {', '.join(missing)}",
            todo="number dots with the columns that locate_dots gives",
        )
    finite = np.isfinite(dots[NEEDED].to_numpy(float)).all(axis=1)
    if not finite.all():
        rows = ", ".join(str(k) for k in np.flatnonzero(~finite)[:5])
        raise InputError(
            "the table of dots holds values that are not finite",
            where=f"row {rows}",
            todo="leave these rows out",
        )


def check_handedness(handedness_by_image: Mapping[tuple[str, str], int], two_sided: bool) -> None:
    """Raise DetectionError when the images (view, camera) of an opaque plate disagree.

    handedness_by_image : `Numbering.handedness` of each; 0, unknown, agrees with both. Views from
    behind a transparent plate (``two_sided``) are legal.
    """
    signs = {image: hand for image, hand in handedness_by_image.items() if hand}
    if two_sided or len(set(signs.values())) < 2:
        return
    first = next(iter(signs.values()))
    usual = first if sum(hand == first for hand in signs.values()) * 2 >= len(signs) else -first
    odd = [image for image, hand in signs.items() if hand != usual]
    todo = (
        "a camera or an export flips the image: undo it; or the plate is transparent and seen "
        "from behind: set [target] two_sided = true with its thickness and index"
    )
    whole = _mirrored_camera(signs, odd)
    if whole:
        raise DetectionError(
            f"every image of camera '{whole[0]}' is mirrored against camera '{whole[1]}'",
            todo=todo,
        )
    names = ", ".join(f"camera '{camera}' view '{view}'" for view, camera in odd)
    plural = "s" if len(odd) > 1 else ""
    raise DetectionError(f"mirrored image{plural} ({len(odd)} of {len(signs)}): {names}", todo=todo)


def _mirrored_camera(
    signs: Mapping[tuple[str, str], int], odd: list[tuple[str, str]]
) -> tuple[str, str] | None:
    """Return (mirrored, other) if the odd images are all images of one camera, and only those."""
    odd_cameras = {camera for _, camera in odd}
    others = [camera for _, camera in signs if camera not in odd_cameras]
    every = sum(camera in odd_cameras for _, camera in signs) == len(odd)
    if len(odd_cameras) == 1 and others and every and len(odd) > 1:
        return odd_cameras.pop(), others[0]
    return None


def _kept(ranked: Placements, evidence: MarkEvidence, target: Target) -> tuple[Placements, bool]:
    """Return the placements to keep, and whether they differ by more than a symmetry."""
    best = ranked.take(np.flatnonzero(ranked.score >= ranked.score[0] - 1e-6))
    if len(ranked.score) == len(best.score) and related_by_symmetry(best, target):
        return best, False
    if len(ranked.score) <= MAX_TIED and (target.marks or not target.bounded):
        return ranked, True
    seen = f"{len(evidence.seen)} of its {len(target.marks)} marks" if target.marks else "no marks"
    raise DetectionError(
        f"{len(ranked.score)} numberings fit equally well: the grid is seen in part and has {seen}",
        todo="keep the whole grid in view, or put marks on it and keep those in view",
    )


def _numbering(
    lattice: Lattice,
    evidence: MarkEvidence,
    ranked: Placements,
    ambiguous: bool,
    target: Target,
) -> Numbering:
    ids = np.stack([_ids(cr, target) for cr in ranked.columns_rows(lattice.places)])
    on_target = ids[0] >= 0
    _check_fits(lattice, on_target, target)
    signs = np.round(np.linalg.det(ranked.turn)).astype(np.int64)
    order = np.flatnonzero(on_target)[np.argsort(ids[0][on_target])]
    marks = target.marks_column_row()
    mark_ids = target.id_from_row_column(marks[:, 1], marks[:, 0])
    off = lattice.index[~on_target]
    reason = AT_A_GAP if target.mark_style == "missing" and not target.bounded else OUTSIDE
    return Numbering(
        table=_table(ids[0][order], lattice.index[order], target),
        unplaced=_unplaced(
            np.concatenate([lattice.unplaced, off]), [*lattice.reasons, *[reason] * len(off)]
        ),
        handedness=int(signs[0]) if np.all(signs == signs[0]) else 0,
        equivalents=ids[:, order],
        equivalent_handedness=signs,
        ambiguous=ambiguous,
        marks_found=mark_ids[evidence.is_seen(ranked.places(marks)[0])],
    )


def _ids(columns_rows: Ints, target: Target) -> Ints:
    """Return the dot ids (n,), -1 where the target has no dot."""
    column, row = columns_rows.T
    ids = target.id_from_row_column(row, column)
    there = np.ones(len(ids), bool)
    if target.bounded:
        there = (column >= 0) & (column < target.columns) & (row >= 0) & (row < target.rows)
    if target.mark_style == "missing":
        there &= ~target.is_mark(ids)
    return np.where(there, ids, -1)


def _check_fits(lattice: Lattice, on_target: Bools, target: Target) -> None:
    size = lattice.places.max(0) + 1
    if on_target.sum() < max(MIN_DOTS, 0.75 * len(on_target)):
        raise DetectionError(
            f"a grid of {size.min()} x {size.max()} places with {len(on_target)} dots was found; "
            f"the target's {target.rows} x {target.columns} hold only {on_target.sum()} of them",
            todo="check [target] rows, columns and marks in rig.toml; a grid without visible ends "
            "needs extent = 'unbounded'",
        )


def _table(ids: Ints, index: Ints, target: Target) -> pd.DataFrame:
    row, column = target.row_column_from_id(ids)
    return pd.DataFrame({"dot": ids, "row": row, "column": column, "index": index})


def _unplaced(index: Ints, reasons: list[str]) -> pd.DataFrame:
    table = pd.DataFrame({"index": index, "reason": reasons})
    return table.sort_values("index", ignore_index=True)


def _number_points(points_px: Array, shapes_px2: Array, target: Target) -> Numbering:
    """Return the numbering of a target whose layout is "points"."""
    matches = match_points(
        points_px,
        shapes_px2,
        target.nominal_mm(target.ids())[:, :2],
        dot_radius_mm=target.dot_diameter_mm / 2,
    )
    best = matches[0]
    close = [m for m in matches if len(m.dot) > CLEAR_LEAD * len(best.dot)]
    if len(close) > 1:
        raise DetectionError(
            f"{len(close)} numberings are equally good: they explain "
            f"{', '.join(str(len(m.dot)) for m in close)} of {len(points_px)} dots",
            todo="keep more of the target in view, or use a layout that is not symmetric",
        )
    order = np.argsort(best.point)
    other = np.setdiff1d(np.arange(len(points_px)), best.dot)
    return Numbering(
        table=_table(best.point[order], best.dot[order], target),
        unplaced=_unplaced(other, ["not a point of the target"] * len(other)),
        handedness=best.handedness,
        equivalents=best.point[order][None],
        equivalent_handedness=np.array([best.handedness]),
        ambiguous=False,
        marks_found=np.zeros(0, np.int64),
    )


_NEAR = 5
_TRIANGLES = 240
_LOCAL = 12
_REFINED = 12


@dataclass(frozen=True)
class PointMatch:
    """One assignment of the target's points to the dots.

    dot : (n,) positions of the matched dots; point : (n,) the target's point of each.
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
    """Return distinct matches of dots (M, 2), shapes (M, 2, 2), to points (N, 2), best first.

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


def _triangles(points: Array) -> Ints:
    """Return triangles (T, 3) of each point and two near ones, without slivers or repeats."""
    count = min(_NEAR, len(points) - 1)
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


def _proposals(flat: Array, wanted: Array) -> list[tuple[Array, int]]:
    """(affine map flat_from_mm, a point in its middle) of the maps that explain most dots near."""
    ours, theirs = _triangles(flat), _triangles(wanted)
    ours = ours[:: max(1, len(ours) // _TRIANGLES)]
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
    top = np.argsort(-hits, kind="stable")[: 40 * _REFINED]
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
        if len(kept) == _REFINED:
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
        """Return the sign of the homography's determinant at a point (2,)."""
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
