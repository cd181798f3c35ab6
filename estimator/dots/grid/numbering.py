"""Number the dots of one image: which dot of the target is each.

The lattice says which dots are neighbours; the marks, the extent of a bounded grid and the pitch
ratio say which of them is which. Where they do not, the numbering says so and lists every
candidate: a wrong number would spoil a calibration, a missing image hardly matters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.errors import DetectionError, InputError
from telerig.estimator.dots.grid.lattice import MIN_DOTS, Lattice, grow_lattice, shape_matrix
from telerig.estimator.dots.grid.marks import MarkEvidence, mark_evidence
from telerig.estimator.dots.grid.placements import (
    MAX_TIED,
    Candidates,
    mark_points,
    mirror_images_differ,
    rank_candidates,
    related_by_symmetry,
)
from telerig.estimator.dots.grid.point_layout import match_points
from telerig.rig.target import Target

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

NEEDED = ["u_px", "v_px", "a_px", "b_px", "angle_rad"]
OUTSIDE = "on the grid, outside the target's rows and columns"
CLEAR_LEAD = 0.8
"""Of two matches of points, the lesser must explain fewer than this part of the better one's."""
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
    ambiguous : the numberings differ by more than the target's own symmetry: do not use the table
        without settling which is right.
    marks_found, marks_missed : dot ids of the marks that were seen, and of those that should have
        been. false_marks : positions of dots that look like marks and are not.
    notes : what was assumed.
    """

    table: pd.DataFrame
    unplaced: pd.DataFrame
    handedness: int
    equivalents: Ints
    equivalent_handedness: Ints
    ambiguous: bool
    marks_found: Ints
    marks_missed: Ints
    false_marks: Ints
    notes: tuple[str, ...]


def number_dots(
    dots: pd.DataFrame,
    target: Target,
    *,
    allow_mirrored: bool = True,
    handedness: int | None = None,
) -> Numbering:
    """Number unordered dots (u_px, v_px, a_px, b_px, angle_rad[, ring]) of one image.

    allow_mirrored : consider that the image shows the target mirrored. handedness : +1 or -1 when
    it is known from other images.

    Raises DetectionError when there are too few dots, no grid, no marks, or too many candidates,
    InputError when a column is missing or a value is not finite.
    """
    if not len(dots):
        raise DetectionError(
            "no dots found", todo="check [target] polarity, the exposure, and that it is in view"
        )
    _check_columns(dots)
    hands = _hands(target, allow_mirrored, handedness)
    if target.layout == "points":
        return _number_points(dots, target, hands)
    points = dots[["u_px", "v_px"]].to_numpy(float)
    shapes = shape_matrix(*dots[["a_px", "b_px", "angle_rad"]].to_numpy(float).T)
    ratio = target.pitch_mm[0] / target.pitch_mm[1]
    lattice = grow_lattice(points, shapes, pitch_ratio=ratio)
    ring = dots["ring"].to_numpy(bool) if "ring" in dots else np.zeros(len(dots), bool)
    evidence = mark_evidence(lattice, ring[lattice.index], target)
    ranked = rank_candidates(lattice, evidence, target, hands)
    ranked, ambiguous = _settle(ranked, evidence, target)
    return _numbering(lattice, evidence, ranked, ambiguous, target)


def _check_columns(dots: pd.DataFrame) -> None:
    missing = [name for name in NEEDED if name not in dots]
    if missing:
        raise InputError(f"the table of dots has no column {', '.join(missing)}")
    finite = np.isfinite(dots[NEEDED].to_numpy(float)).all(axis=1)
    if not finite.all():
        rows = ", ".join(str(k) for k in np.flatnonzero(~finite)[:5])
        raise InputError("the table of dots holds values that are not finite", where=f"row {rows}")


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
    """(mirrored, other) when the odd images are all of one camera, and all of its images."""
    odd_cameras = {camera for _, camera in odd}
    others = [camera for _, camera in signs if camera not in odd_cameras]
    every = sum(camera in odd_cameras for _, camera in signs) == len(odd)
    if len(odd_cameras) == 1 and others and every and len(odd) > 1:
        return odd_cameras.pop(), others[0]
    return None


def _hands(target: Target, allow_mirrored: bool, handedness: int | None) -> tuple[int, ...]:
    if handedness is not None:
        return (handedness,)
    tells = target.layout == "points" or mirror_images_differ(target)
    return (1, -1) if allow_mirrored and tells else (1,)


def _settle(ranked: Candidates, evidence: MarkEvidence, target: Target) -> tuple[Candidates, bool]:
    """The candidates worth keeping, and whether they differ by more than symmetry."""
    best = ranked.take(np.flatnonzero(ranked.score >= ranked.score[0] - 1e-6))
    if len(ranked.score) == len(best.score) and related_by_symmetry(best, target):
        return best, False
    if len(ranked.score) <= MAX_TIED and (target.marks or not target.bounded):
        return ranked, True
    seen = f"{len(evidence.seen)} of its {len(target.marks)} marks" if target.marks else "no marks"
    raise DetectionError(
        f"{len(ranked.score)} numberings fit equally well: the grid is seen in part and has {seen}",
        todo="keep the whole grid in view, or put marks on it and keep them in view",
    )


def _numbering(
    lattice: Lattice,
    evidence: MarkEvidence,
    ranked: Candidates,
    ambiguous: bool,
    target: Target,
) -> Numbering:
    ids = np.stack([_ids(cr, target) for cr in ranked.columns_rows(lattice.places)])
    on_target = ids[0] >= 0
    _check_fits(lattice, on_target, target)
    signs = np.round(np.linalg.det(ranked.turn)).astype(np.int64)
    order = np.flatnonzero(on_target)[np.argsort(ids[0][on_target])]
    marks = mark_points(target)
    seen = evidence.is_seen(ranked.places(marks)[0])
    mark_ids = target.id_from_row_column(marks[:, 1], marks[:, 0])
    shown = evidence.is_shown(ranked.places(marks)[0])
    false = evidence.is_seen(lattice.places) & ~np.isin(ids[0], mark_ids)
    return Numbering(
        table=_table(ids[0][order], lattice.index[order], target),
        unplaced=_unplaced(lattice, on_target, target),
        handedness=int(signs[0]) if np.all(signs == signs[0]) else 0,
        equivalents=ids[:, order],
        equivalent_handedness=signs,
        ambiguous=ambiguous,
        marks_found=mark_ids[seen],
        marks_missed=mark_ids[~seen & shown],
        false_marks=lattice.index[false],
        notes=_notes(target, len(signs), ambiguous),
    )


def _ids(columns_rows: Ints, target: Target) -> Ints:
    """(n,) dot ids, -1 where the target has no dot."""
    column, row = columns_rows.T
    ids = target.id_from_row_column(row, column)
    there = np.ones(len(ids), bool)
    if target.bounded:
        there = (column >= 0) & (column < target.columns) & (row >= 0) & (row < target.rows)
    if target.mark_style == "missing":
        there &= ~target.is_mark(ids)
    return np.where(there, ids, -1)


def _check_fits(lattice: Lattice, on_target: NDArray[np.bool_], target: Target) -> None:
    size = lattice.places.max(0) + 1
    if on_target.sum() < max(MIN_DOTS, 0.75 * len(on_target)):
        raise DetectionError(
            f"a grid of {size.min()} x {size.max()} places with {len(on_target)} dots was found; "
            f"the target's {target.rows} x {target.columns} hold only {on_target.sum()} of them",
            todo="check [target] rows, columns and marks; a larger grid needs extent = 'unbounded'",
        )


def _table(ids: Ints, index: Ints, target: Target) -> pd.DataFrame:
    row, column = target.row_column_from_id(ids)
    return pd.DataFrame({"dot": ids, "row": row, "column": column, "index": index})


def _unplaced(lattice: Lattice, on_target: NDArray[np.bool_], target: Target) -> pd.DataFrame:
    off = lattice.index[~on_target]
    reason = AT_A_GAP if target.mark_style == "missing" and not target.bounded else OUTSIDE
    return pd.DataFrame(
        {
            "index": np.concatenate([lattice.unplaced, off]),
            "reason": [*lattice.reasons, *[reason] * len(off)],
        }
    ).sort_values("index", ignore_index=True)


def _notes(target: Target, candidates: int, ambiguous: bool) -> tuple[str, ...]:
    notes = []
    if target.layout == "grid" and not mirror_images_differ(target):
        notes.append("the target equals its mirror image: seen from its front is assumed")
    if candidates > 1 and not ambiguous:
        notes.append(f"the target is symmetric: {candidates} numberings are equally good")
    if ambiguous:
        notes.append(f"{candidates} numberings fit the image about equally well")
    return tuple(notes)


def _number_points(dots: pd.DataFrame, target: Target, hands: tuple[int, ...]) -> Numbering:
    points = dots[["u_px", "v_px"]].to_numpy(float)
    shapes = shape_matrix(*dots[["a_px", "b_px", "angle_rad"]].to_numpy(float).T)
    matches = match_points(
        points,
        shapes,
        target.nominal_mm(target.ids())[:, :2],
        dot_radius_mm=target.dot_diameter_mm / 2,
        handedness=hands,
    )
    best = matches[0]
    close = [m for m in matches if len(m.dot) > CLEAR_LEAD * len(best.dot)]
    if len(close) > 1:
        raise DetectionError(
            f"{len(close)} numberings are equally good: they explain "
            f"{', '.join(str(len(m.dot)) for m in close)} of {len(dots)} dots",
            todo="keep more of the target in view, or use a layout that is not symmetric",
        )
    order = np.argsort(best.point)
    other = np.setdiff1d(np.arange(len(dots)), best.dot)
    none = np.zeros(0, np.int64)
    return Numbering(
        table=_table(best.point[order], best.dot[order], target),
        unplaced=pd.DataFrame(
            {"index": other, "reason": ["not a point of the target"] * len(other)}
        ),
        handedness=best.handedness,
        equivalents=best.point[order][None],
        equivalent_handedness=np.array([best.handedness]),
        ambiguous=False,
        marks_found=none,
        marks_missed=none,
        false_marks=none,
        notes=(),
    )
