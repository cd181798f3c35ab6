"""Number the dots of one image: which dot of the target is each.

The lattice tells which dots are neighbours; the marks, the extent of a bounded grid and the pitch
ratio tell which dot is which. Where they do not suffice, the numbering is marked as ambiguous and
lists all candidates: a wrong number would spoil a calibration, a missing image hardly matters.
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
    Placements,
    rank_placements,
    related_by_symmetry,
)
from telerig.estimator.dots.grid.point_layout import match_points
from telerig.rig.target import Target

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

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
    """(mirrored, other) when the odd images are all of one camera, and all of its images."""
    odd_cameras = {camera for _, camera in odd}
    others = [camera for _, camera in signs if camera not in odd_cameras]
    every = sum(camera in odd_cameras for _, camera in signs) == len(odd)
    if len(odd_cameras) == 1 and others and every and len(odd) > 1:
        return odd_cameras.pop(), others[0]
    return None


def _kept(ranked: Placements, evidence: MarkEvidence, target: Target) -> tuple[Placements, bool]:
    """The placements to keep, and whether they differ by more than the target's symmetry."""
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
    """The numbering of a target whose layout is "points"."""
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
