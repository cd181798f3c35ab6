"""From an image to the numbered dots of the target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pandas as pd
from numpy.typing import NDArray

from telerig.errors import DetectionError
from telerig.estimator.dots.grid.numbering import Numbering, number_dots
from telerig.estimator.dots.locate import measure_dots
from telerig.rig.target import Target

MEASURED = [
    *("u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"),
    *("a_px", "b_px", "angle_rad", "chi2_dof"),
]
REJECTED = ["u_px", "v_px", "a_px", "b_px", "angle_rad", "reason"]


@dataclass(frozen=True)
class TargetDetection:
    """The target in one image.

    table : dot, row, column and the measured columns of each numbered dot; by dot.
    rejected : u_px, v_px, a_px, b_px, angle_rad, reason of everything dot-like that was left out.
    numbering : how the numbers came about; its positions refer to ``dots``.
    dots : every dot that was measured, in the order it was found.
    """

    table: pd.DataFrame
    rejected: pd.DataFrame
    numbering: Numbering
    dots: pd.DataFrame


def detect_target(image: NDArray[Any], target: Target) -> pd.DataFrame:
    """Numbered dots of the target in a grey (H, W) image.

    Columns: dot row column u_px v_px suu_px2 suv_px2 svv_px2 a_px b_px angle_rad chi2_dof. The
    numbers of a symmetric target without marks are one choice of several: see `find_target`.

    Raises DetectionError when the target is not found or its numbers are ambiguous, InputError
    for what is no image.
    """
    found = find_target(image, target)
    if found.numbering.ambiguous:
        raise ambiguous_numbering(found.numbering, target)
    return found.table


def find_target(
    image: NDArray[Any],
    target: Target,
    *,
    min_diameter_px: float = 5.0,
    handedness: int | None = None,
) -> TargetDetection:
    """Like `detect_target`, with what was rejected, and with ambiguous numberings returned.

    handedness : +1 or -1 when other images tell how the target is seen.
    """
    measured = measure_dots(image, polarity=target.polarity, min_diameter_px=min_diameter_px)
    numbering = number_dots(measured.dots, target, handedness=handedness)
    return TargetDetection(
        table=numbered_table(measured.dots, numbering),
        rejected=rejected_table(measured.dots, measured.rejected, numbering),
        numbering=numbering,
        dots=measured.dots,
    )


def numbered_table(dots: pd.DataFrame, numbering: Numbering) -> pd.DataFrame:
    """The measured columns of the numbered dots beside their numbers."""
    rows = dots.iloc[numbering.table["index"].to_numpy()][MEASURED].reset_index(drop=True)
    return pd.concat([numbering.table[["dot", "row", "column"]], rows], axis=1)


def ambiguous_numbering(numbering: Numbering, target: Target) -> DetectionError:
    """The error that says which numberings are tied and what would settle them."""
    found, wanted = len(numbering.marks_found), len(target.marks)
    hands = set(numbering.equivalent_handedness.tolist())
    mirrored = "; some of them take the image for a mirrored one" if len(hands) > 1 else ""
    count = len(numbering.equivalents)
    return DetectionError(
        f"{count} numberings of the {len(numbering.table)} dots fit about equally well"
        f"{mirrored}: {found} of {wanted} marks were found",
        todo="keep all marks in view, clean and lit, or leave this image out",
    )


def rejected_table(dots: pd.DataFrame, blobs: pd.DataFrame, numbering: Numbering) -> pd.DataFrame:
    """What was not numbered, with reasons: rejected blobs and dots off the target."""
    index = numbering.unplaced["index"].to_numpy()
    unplaced = dots.iloc[index].reset_index(drop=True)
    unplaced = unplaced.assign(reason=numbering.unplaced["reason"])
    parts = [part[REJECTED] for part in (blobs, unplaced) if len(part)]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=REJECTED)
