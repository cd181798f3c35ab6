"""From an image to the numbered dots of the target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pandas as pd
from numpy.typing import NDArray

from telerig.errors import DetectionError
from telerig.estimator.dots.grid.numbering import Numbering, number_dots
from telerig.estimator.dots.locate import REJECTED, DotMeasurement, measure_dots
from telerig.rig.target import Target

MEASURED = [
    *("u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"),
    *("a_px", "b_px", "angle_rad", "chi2_dof"),
]


@dataclass(frozen=True)
class TargetDetection:
    """Hold the target as it was found in one image.

    table : a row for each numbered dot, sorted by number: dot (number), row, column (on the target)
        and the measured columns of `locate_dots` up to chi2_dof.
    rejected : a row for each candidate that was left out: u_px, v_px, a_px, b_px, angle_rad and the
        reason in words.
    numbering : how the dots were numbered.
    """

    table: pd.DataFrame
    rejected: pd.DataFrame
    numbering: Numbering


def detect_target(image: NDArray[Any], target: Target) -> pd.DataFrame:
    """Find the target's dots in an image and number them.

    image : (rows, columns) grey levels.
    target : the target, as `rig.toml` describes it.

    Returns a table with a row for each dot and the columns dot (number), row, column, u_px, v_px,
    suu_px2, suv_px2, svv_px2, a_px, b_px, angle_rad, chi2_dof; see `locate_dots`. A symmetric
    target without marks can be numbered in several ways that fit equally well; the table then
    holds one of them.
    Raises DetectionError if the target is not found or its numbers are ambiguous, and InputError
    if ``image`` is no grey image.
    """
    found = numbered(measure_dots(image, polarity=target.polarity), target)
    if found.numbering.ambiguous:
        raise ambiguous_numbering(found.numbering, target)
    return found.table


def numbered(measured: DotMeasurement, target: Target) -> TargetDetection:
    """Number the target's dots among the measured dots of an image.

    An ambiguous numbering is returned, too; ``numbering.ambiguous`` of the result says so.
    Raises DetectionError if the dots cannot be numbered at all.
    """
    numbering = number_dots(measured.dots, target)
    rows = measured.dots.iloc[numbering.table["index"].to_numpy()][MEASURED]
    unplaced = numbering.unplaced
    return TargetDetection(
        pd.concat([numbering.table[["dot", "row", "column"]], rows.reset_index(drop=True)], axis=1),
        rejected_table(measured, unplaced["index"].to_numpy(), unplaced["reason"].to_numpy()),
        numbering,
    )


def ambiguous_numbering(numbering: Numbering, target: Target) -> DetectionError:
    """Return (not raise) the error for a numbering that is not unique."""
    found, wanted = len(numbering.marks_found), len(target.marks)
    hands = set(numbering.equivalent_handedness.tolist())
    mirrored = "; some of them take the image for a mirrored one" if len(hands) > 1 else ""
    count = len(numbering.equivalents)
    return DetectionError(
        f"the {len(numbering.table)} dots can be numbered in {count} ways that fit the image about "
        f"equally well{mirrored}; {found} of the target's {wanted} marks were found",
        todo="keep all marks in view, clean and lit, or leave this image out",
    )


def rejected_table(measured: DotMeasurement, index: Any, reason: Any) -> pd.DataFrame:
    """Return the table of all rejected candidates of an image.

    measured : the dots and the blobs that are no dots.
    index : (n,) positions of dots that are rejected as well, or a slice.
    reason : (n,) reasons in words, or one for all.
    """
    dots = measured.dots.iloc[index].assign(reason=reason)[REJECTED]
    parts = [part for part in (measured.rejected, dots) if len(part)]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=REJECTED)
