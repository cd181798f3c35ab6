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
    """The target in one image.

    table : dot, row, column and the measured columns of each numbered dot; by dot.
    rejected : u_px, v_px, a_px, b_px, angle_rad, reason of everything dot-like that was left out.
    numbering : how the dots were numbered.
    """

    table: pd.DataFrame
    rejected: pd.DataFrame
    numbering: Numbering


def detect_target(image: NDArray[Any], target: Target) -> pd.DataFrame:
    """Numbered dots of the target in a grey (H, W) image.

    Columns: dot row column u_px v_px suu_px2 suv_px2 svv_px2 a_px b_px angle_rad chi2_dof. The
    numbers of a symmetric target without marks are one choice of several that fit equally well.

    Raises DetectionError when the target is not found or its numbers are ambiguous, InputError
    for what is no image.
    """
    found = numbered(measure_dots(image, polarity=target.polarity), target)
    if found.numbering.ambiguous:
        raise ambiguous_numbering(found.numbering, target)
    return found.table


def numbered(measured: DotMeasurement, target: Target) -> TargetDetection:
    """The target among measured dots; ambiguous numberings are returned too.

    Raises DetectionError where the dots cannot be numbered at all.
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
    """The error that says how many numberings are equally good and how to make one the best."""
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
    """Rejected blobs, and the dots at positions ``index`` (n,) with their ``reason`` (n,)."""
    dots = measured.dots.iloc[index].assign(reason=reason)[REJECTED]
    parts = [part for part in (measured.rejected, dots) if len(part)]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=REJECTED)
