"""Number the dots of one image: which dot of the target is each.

The lattice shows which dots are neighbours; the marks, the extent of a bounded grid and the pitch
ratio tell which dot is which. Every placement of the target on the lattice gets a log-likelihood.
One mark that is missed, or one dot that only looks like a mark, makes a numbering less likely but
not impossible, so the evidence of each place is bounded on both sides. Where the evidence does not
suffice, the numbering is marked as ambiguous and lists all candidates: a wrong number would spoil a
calibration, a missing image hardly matters.

Listed points that lie on a lattice, such as a hexagonal grid, are numbered in the same way; other
points by `match_points`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools, Ints
from telerig.errors import DetectionError, InputError
from telerig.estimator.dots.grid.arrangement import match_points
from telerig.estimator.dots.grid.lattice import (
    MIN_DOTS,
    Cell,
    Lattice,
    frequent_cell,
    grow_lattice,
    next_places,
    shape_matrix,
)
from telerig.estimator.dots.thresholds import (
    DOT_LOST,
    FALSE,
    MARK_MISSED,
    MOST_DOTS,
    PART_HIDDEN,
    POSSIBLE_ODDS,
    WRONG_ODDS,
)
from telerig.rig.target import Target
from telerig.statistics import robust_sd


@dataclass(frozen=True)
class MarkEvidence:
    """What an image shows about where the marks are on the lattice of its dots.

    gain : (H, W) log-likelihood ratio of a mark to a plain dot at each place; that of the place (i,
        j) is gain[i + 1, j + 1]. It is 0 where the image shows nothing.
    seen : (k, 2) places that look like marks.
    empty : (E, 2) places next to dots that are in view and have no dot.
    """

    gain: Array
    seen: Ints
    empty: Ints

    def at(self, places: Ints) -> Array:
        """Return the log-likelihood ratios (...) of a mark to a plain dot at places (..., 2).

        Outside the lattice it is 0: a mark that is not in view is neither for nor against a place.
        """
        shifted = places + 1
        inside = np.all((shifted >= 0) & (shifted < self.gain.shape), axis=-1)
        clipped = np.clip(shifted, 0, np.array(self.gain.shape) - 1)
        return np.where(inside, self.gain[clipped[..., 0], clipped[..., 1]], 0.0)

    def is_seen(self, places: Ints) -> Bools:
        """Return whether each of the places (..., 2) looks like a mark, as booleans (...)."""
        if not len(self.seen):
            return np.zeros(places.shape[:-1], bool)
        return np.asarray(np.any(np.all(places[..., None, :] == self.seen, axis=-1), axis=-1))


def relative_diameter(lattice: Lattice) -> Array:
    """Return each dot's diameter (n,) in units of the lattice's pitch, relative to the median."""
    size = np.linalg.det(lattice.shape) ** 0.25
    return np.asarray(size / np.median(size))


def mark_likeness(lattice: Lattice, rings: Bools, target: Target) -> Array:
    """Return the probability (n,) that each of the lattice's n dots is a mark.

    rings : (n,) whether the dot has a hole.
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


def mark_evidence(lattice: Lattice, rings: Bools, empty: Ints, target: Target) -> MarkEvidence:
    """Return the evidence for marks at all places of the lattice and of a border one place wide.

    rings : (n,) whether each of the lattice's n dots has a hole. empty : see `MarkEvidence`.
    """
    shape = lattice.places.max(0) + 3
    occupied = np.zeros(shape, bool)
    occupied[tuple((lattice.places + 1).T)] = True
    gain = np.zeros(shape)
    if target.mark_style == "missing":
        gap = gaps(occupied, target.bounded)
        lost = max(0.5, gap.sum() - len(target.marks)) / occupied.sum()
        gain[occupied] = np.log(FALSE)
        gain[gap] = -np.log(np.clip(lost, FALSE, 2 * DOT_LOST))
        return MarkEvidence(gain, np.argwhere(gap) - 1, empty)
    like = mark_likeness(lattice, rings, target)
    gain[tuple((lattice.places + 1).T)] = mark_gain(like)
    return MarkEvidence(gain, lattice.places[like > 0.4], empty)


def mark_gain(likeness: Array) -> Array:
    """Return the log-likelihood ratios (n,) of a mark to a plain dot.

    likeness : (n,) probabilities that the dots look like marks, see `mark_likeness`.
    """
    as_mark = likeness * (1 - MARK_MISSED) + (1 - likeness) * MARK_MISSED
    as_plain = likeness * FALSE + (1 - likeness) * (1 - FALSE)
    return np.asarray(np.log(as_mark / as_plain))


def gaps(occupied: Bools, bounded: bool) -> Bools:
    """Return (H, W) which places of a grid are empty although dots surround them.

    occupied : (H, W) whether there is a dot at each place. bounded : whether the grid ends inside
    the image; places on its border then need fewer dots round them.
    """
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


MAX_TIED = 64

_MIN_ASPECT_SIGMA = 0.03
_LEAST_LIKELY = 100.0
_NEAR_CELL = 0.3
"""Maps from the lattice to the target are tried if they distort the cell by at most this much more
than the best map does."""


@dataclass(frozen=True)
class TargetLattice:
    """The places of the target's dots on its own lattice. For a grid they are (column, row).

    cell_mm : (2, 2) pitch vectors as rows.
    places : (N, 2) place of each dot of a bounded target, by id, missing dots included; None for an
        unbounded grid.
    marks : (K, 2) places of the marks.
    mirrored : whether the target differs from its mirror image.
    """

    cell_mm: Array
    places: Ints | None
    marks: Ints
    mirrored: bool

    @classmethod
    def of(cls, target: Target) -> TargetLattice | None:
        """Return the target's lattice; None for listed points that do not lie on a lattice."""
        if target.layout == "points":
            listed = np.asarray(target.points_mm, float)
            found = listed_lattice(listed.tobytes())
            if found is None:
                return None
            cell, places = found
            marks = places[target.marks_column_row()[:, 0]]
            return cls(cell, places, marks, target.mirror_images_differ())
        places = np.argwhere(np.ones((target.rows, target.columns)))[:, ::-1]
        return cls(
            np.diag(target.pitch_mm),
            places if target.bounded else None,
            target.marks_column_row(),
            target.mirror_images_differ(),
        )

    def ids(self, places: Ints, target: Target) -> Ints:
        """Return the dot ids (...) at places (..., 2), -1 where the target has no dot."""
        if self.places is None:
            ids = target.id_from_row_column(places[..., 1], places[..., 0])
        else:
            low, high = self.places.min(0), self.places.max(0)
            table = np.full(high - low + 1, -1)
            table[tuple((self.places - low).T)] = np.arange(len(self.places))
            inside = np.all((places >= low) & (places <= high), axis=-1)
            at = np.clip(places, low, high) - low
            ids = np.where(inside, table[at[..., 0], at[..., 1]], -1)
        if target.mark_style == "missing":
            ids = np.where(target.is_mark(ids), -1, ids)
        return np.asarray(ids)


@lru_cache(maxsize=8)
def listed_lattice(points_mm: bytes) -> tuple[Array, Ints] | None:
    """Return the cell (2, 2) and the places (N, 2) of N listed points if all lie on one lattice.

    points_mm : the bytes of (N, 2) positions.
    """
    points = np.frombuffer(points_mm).reshape(-1, 2)
    cell = frequent_cell(points)
    if cell is None:
        return None
    try:
        round_dots = np.broadcast_to(np.eye(2), (len(points), 2, 2))
        found = grow_lattice(points, round_dots, cell=Cell.of(cell))
    except DetectionError:
        return None
    if len(found.index) < len(points):
        return None
    return np.median(found.basis_px, axis=0), found.places[np.argsort(found.index)]


@dataclass(frozen=True)
class Placements:
    """K ways to place the target on the lattice of an image's dots, best first.

    In each, the dot at a place of the lattice has (column, row) = turn @ place - shift on the
    target.

    turn : (K, 2, 2), with determinant -1 where the image is mirrored.
    shift : (K, 2).
    score : (K,) log-likelihoods.
    """

    turn: Ints
    shift: Ints
    score: Array

    def columns_rows(self, places: Ints) -> Ints:
        """Return (column, row) on the target of n places of the lattice (n, 2), as (K, n, 2)."""
        turned = np.einsum("kab,nb->kna", self.turn, places)
        return np.asarray(turned - self.shift[:, None])

    def places(self, columns_rows: Ints) -> Ints:
        """Return the places (K, m, 2) on the lattice of m pairs (column, row) (m, 2)."""
        shifted = columns_rows + self.shift[:, None]
        return np.asarray(np.einsum("kab,knb->kna", inverse_of(self.turn), shifted))

    def likely(self) -> Placements:
        """Return the placements that are not clearly less likely than the best one."""
        return self.take(np.flatnonzero(is_likely(self.score)))

    def take(self, which: Ints) -> Placements:
        """Return some of the placements; which : their indices (K,)."""
        return Placements(self.turn[which], self.shift[which], self.score[which])


def is_likely(score: Array) -> Bools:
    """Return which of K log-likelihoods, best first, are not clearly below the best one."""
    return np.asarray(score >= score[0] + np.log(WRONG_ODDS))


def inverse_of(turn: Ints) -> Ints:
    """Return the inverse of integer matrices (..., 2, 2) of determinant 1 or -1."""
    return np.asarray(np.rint(np.linalg.inv(turn)), np.int64)


def rank_placements(lattice: Lattice, evidence: MarkEvidence, target: TargetLattice) -> Placements:
    """Return all possible placements (`POSSIBLE_ODDS`), best first.

    Among equals, those without mirroring come first. Mirrored placements are tried only for a
    target that differs from its mirror image.

    Raises DetectionError if the image shows none of the marks that an unbounded grid needs, and
    InputError if an unbounded grid has no marks.
    """
    turns, fit = _turns(lattice, target)
    parts = []
    for turn, score_of_turn in zip(turns, fit):
        shifts, score = _shifts(lattice, evidence, target, turn)
        parts.append((np.broadcast_to(turn, (len(shifts), 2, 2)), shifts, score + score_of_turn))
    every = Placements(*(np.concatenate(p) for p in zip(*parts)))
    if not len(every.score):
        raise DetectionError(
            f"none of the target's {len(target.marks)} marks was found",
            todo="an unbounded grid is numbered from its marks: keep them in view, and check "
            "[target] marks, mark_style and mark_diameter_mm in rig.toml",
        )
    order = np.argsort(-np.round(every.score, 6), kind="stable")
    return every.take(order[every.score[order] >= every.score[order[0]] + np.log(POSSIBLE_ODDS)])


_UNIMODULAR: Ints = np.array(
    [t for t in product((1, 0, -1), repeat=4) if abs(t[0] * t[3] - t[1] * t[2]) == 1], np.int64
).reshape(-1, 2, 2)
"""All integer matrices of entries -1, 0 and 1 and determinant +-1: candidates for the map between
two lattices whose cells are nearly the same."""


def _turns(lattice: Lattice, target: TargetLattice) -> tuple[Ints, Array]:
    """Return the maps (T, 2, 2) from the lattice's places to the target's, unmirrored first, and
    the log-likelihood (T,) of each by the dots' shapes.

    On the target the dots are round, so that their shapes there have no strain.
    """
    seen = _strain(lattice.shape)
    middle = np.median(seen, axis=0)
    spread = max(float(robust_sd(column)) for column in (seen - middle).T)
    sigma = max(_MIN_ASPECT_SIGMA, 1.25 * spread / np.sqrt(len(seen)))
    size = np.linalg.norm(middle)
    shape = np.cosh(size) * np.eye(2) + np.sinh(size) / max(size, 1e-12) * np.array(
        [[middle[0], middle[1]], [middle[1], -middle[0]]]
    )
    to_mm = target.cell_mm.T @ _UNIMODULAR
    off = np.linalg.norm(_strain(to_mm @ shape @ to_mm.mT), axis=1)
    score = np.maximum(-0.5 * (off / sigma) ** 2, -_LEAST_LIKELY)
    hand = np.rint(np.linalg.det(_UNIMODULAR))
    near = off < off.min() + _NEAR_CELL
    kept = np.concatenate(
        [np.flatnonzero(near & (hand == side)) for side in ((1, -1) if target.mirrored else (1,))]
    )
    return _UNIMODULAR[kept], score[kept]


def _strain(shape: Array) -> Array:
    """Return the logarithm of symmetric matrices (..., 2, 2), scaled to unit determinant, as
    (..., 2): its first and its mixed element.
    """
    scaled = shape / np.sqrt(np.linalg.det(shape))[..., None, None]
    values, vectors = np.linalg.eigh(scaled)
    logs = np.einsum("...ij,...j,...kj->...ik", vectors, np.log(values), vectors)
    return np.stack([logs[..., 0, 0], logs[..., 0, 1]], -1)


def _shifts(
    lattice: Lattice, evidence: MarkEvidence, target: TargetLattice, turn: Ints
) -> tuple[Ints, Array]:
    if target.places is not None:
        shifts, score = _bounded_shifts(
            lattice.places @ turn.T, evidence.empty @ turn.T, target.places
        )
    elif len(target.marks):
        seen = evidence.seen @ turn.T
        shifts = np.unique((seen[:, None] - target.marks).reshape(-1, 2), axis=0)
        score = np.zeros(len(shifts))
    else:
        raise InputError(
            "an unbounded grid without marks has no origin",
            where="[target]",
            todo="state marks, or extent = 'bounded'",
        )
    if len(target.marks):
        at = (target.marks + shifts[:, None]) @ inverse_of(turn).T
        score = score + evidence.at(at).sum(1)
    return shifts, score


def _bounded_shifts(turned: Ints, empty: Ints, places: Ints) -> tuple[Ints, Array]:
    """Return the shifts (S, 2) that keep most dots on the target, and log-likelihoods (S,).

    turned, empty : (n, 2), (E, 2) places with a dot and of `MarkEvidence`. places : (N, 2) of the
    target.
    """
    every = np.concatenate([turned, empty])
    low, size = every.min(0), np.ptp(every, axis=0) + 1
    target = np.zeros(np.ptp(places, axis=0) + 1)
    target[tuple((places - places.min(0)).T)] = 1
    whole, on_target = size + target.shape - 1, []
    mirrored = np.fft.rfft2(target[::-1, ::-1], whole)
    for seen in (turned, empty):
        there = np.zeros(size)
        there[tuple((seen - low).T)] = 1
        counts = np.fft.irfft2(np.fft.rfft2(there, whole) * mirrored, whole)
        on_target.append(np.rint(counts).astype(np.int64))
    outside, lost = len(turned) - on_target[0], on_target[1]
    near = np.argwhere(outside <= outside.min() + 8)
    few = np.maximum(lost[tuple(near.T)] * np.log(DOT_LOST), np.log(PART_HIDDEN))
    score = np.log(FALSE) * outside[tuple(near.T)] + few
    return near - target.shape + 1 + low - places.min(0), score


def related_by_symmetry(placements: Placements, target: TargetLattice) -> bool:
    """Return whether the placements differ only by rotations that leave the target unchanged."""
    hands = np.linalg.det(placements.turn)
    if np.any(hands != hands[0]):
        return False
    return all(
        {*map(tuple, one.tolist())} == {*map(tuple, kept.tolist())}
        for kept in (target.marks, target.places)
        if kept is not None
        for one in placements.columns_rows(placements.places(kept)[0])
    )


NEEDED = ["u_px", "v_px", "a_px", "b_px", "angle_rad"]
OUTSIDE = "on the grid, outside the target's rows and columns"
AT_A_GAP = "at the place of a missing mark"


@dataclass(frozen=True)
class Numbering:
    """Which dot of the target each located dot is.

    table : one row for each of n numbered dots: dot (id), row, column, and index, the row of the
        given table of dots.
    unplaced : the other dots: index, and reason why they have no number.
    handedness : +1, -1 if the image shows the target mirrored, 0 if the image does not reveal it;
        for a target that equals its mirror image, +1 is assumed.
    equivalents : (K, n) ids of the n dots under each of the K numberings that are possible, best
        first; row 0 is that of the table, -1 means that the target has no dot there.
    equivalent_handedness, score : (K,) handedness and log-likelihood of each of these numberings.
    ambiguous : whether those that are likely (`is_likely`) differ by more than rotations that leave
        the target unchanged.
    marks_found : ids of the marks that the image shows.
    """

    table: pd.DataFrame
    unplaced: pd.DataFrame
    handedness: int
    equivalents: Ints
    equivalent_handedness: Ints
    score: Array
    ambiguous: bool
    marks_found: Ints


def number_dots(
    dots: pd.DataFrame, target: Target, image_shape: tuple[int, ...] | None = None
) -> Numbering:
    """Find out which dot of the target each located dot of an image is.

    dots : table with the columns u_px, v_px, a_px, b_px, angle_rad and, for ring marks, ring, as
    `locate_dots` returns it; the order of its rows does not matter.
    image_shape : (rows, columns) of the image: it tells on which sides the target ends in view.
    None takes the box round the dots.

    Raises DetectionError if there are too few dots, no grid, no marks, or too many numberings that
    fit equally well, and InputError if a column is missing or a value is not finite.
    """
    if not len(dots):
        raise DetectionError(
            "no dots found",
            todo="check the exposure, [target] polarity in rig.toml, and that the target is in "
            "view",
        )
    _check_columns(dots)
    points = dots[["u_px", "v_px"]].to_numpy(float)
    shapes = shape_matrix(*dots[["a_px", "b_px", "angle_rad"]].to_numpy(float).T)
    on = TargetLattice.of(target)
    if on is None:
        return _number_points(points, shapes, target)
    lattice = grow_lattice(points, shapes, cell=Cell.of(on.cell_mm))
    ring = dots["ring"].to_numpy(bool) if "ring" in dots else np.zeros(len(dots), bool)
    if image_shape is None:
        points = points - points.min(0)
        image_shape = tuple(np.ceil(points.max(0)[::-1]).astype(int) + 1)
    radius_px = float(dots["a_px"].median())
    empty = next_places(lattice, points, image_shape, radius_px)[0]
    evidence = mark_evidence(lattice, ring[lattice.index], empty, target)
    ranked = rank_placements(lattice, evidence, on)
    ambiguous = _is_ambiguous(ranked, evidence, target, on)
    few = ranked.take(np.arange(min(len(ranked.score), MAX_TIED)))
    return _numbering(lattice, evidence, few, ambiguous, target, on)


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


def _is_ambiguous(
    ranked: Placements, evidence: MarkEvidence, target: Target, on: TargetLattice
) -> bool:
    """Whether the likely placements differ by more than a symmetry.

    Raises DetectionError if they are many, or if no other image can decide between them.
    """
    likely = ranked.likely()
    best = ranked.take(np.flatnonzero(ranked.score >= ranked.score[0] - 1e-6))
    if len(likely.score) == len(best.score) and related_by_symmetry(best, on):
        return False
    if len(likely.score) <= MAX_TIED and (target.marks or not target.bounded):
        return True
    seen = f"{len(evidence.seen)} of its {len(target.marks)} marks" if target.marks else "no marks"
    raise DetectionError(
        f"{len(likely.score)} numberings fit equally well: the grid is seen in part and has {seen}",
        todo="keep the whole grid in view, or put marks on it and keep those in view",
    )


def _numbering(
    lattice: Lattice,
    evidence: MarkEvidence,
    ranked: Placements,
    ambiguous: bool,
    target: Target,
    on: TargetLattice,
) -> Numbering:
    ids = on.ids(ranked.columns_rows(lattice.places), target)
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
        handedness=int(signs[0]) if np.all((signs == signs[0])[is_likely(ranked.score)]) else 0,
        equivalents=ids[:, order],
        equivalent_handedness=signs,
        score=ranked.score,
        ambiguous=ambiguous,
        marks_found=mark_ids[evidence.is_seen(ranked.places(on.marks)[0])],
    )


def _check_fits(lattice: Lattice, on_target: Bools, target: Target) -> None:
    size = lattice.places.max(0) + 1
    if on_target.sum() < max(MIN_DOTS, 0.75 * len(on_target)):
        raise DetectionError(
            f"a grid of {size.min()} x {size.max()} places with {len(on_target)} dots was found; "
            f"the target holds only {on_target.sum()} of them",
            todo="check [target] rows, columns or points_mm, and marks in rig.toml; a grid without "
            "visible ends needs extent = 'unbounded'",
        )


def _table(ids: Ints, index: Ints, target: Target) -> pd.DataFrame:
    row, column = target.row_column_from_id(ids)
    return pd.DataFrame({"dot": ids, "row": row, "column": column, "index": index})


def _unplaced(index: Ints, reasons: list[str]) -> pd.DataFrame:
    table = pd.DataFrame({"index": index, "reason": reasons})
    return table.sort_values("index", ignore_index=True)


def _number_points(points_px: Array, shapes_px2: Array, target: Target) -> Numbering:
    """Return the numbering of listed points that lie on no lattice."""
    matches = match_points(
        points_px,
        shapes_px2,
        target.nominal_mm(target.ids())[:, :2],
        dot_radius_mm=target.dot_diameter_mm / 2,
    )
    best = matches[0]
    close = [m for m in matches if len(m.dot) > MOST_DOTS * len(best.dot)]
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
        score=np.zeros(1),
        ambiguous=False,
        marks_found=np.zeros(0, np.int64),
    )
