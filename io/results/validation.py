"""Describe validation.json: how still marks stand that were smoothed as if they were bubbles."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import ClassVar

import numpy as np
from pydantic import Field

from telerig.io.results.record import Name, Part, Record
from telerig.io.results.smoothing import Verdict

LARGEST_NEES = 2.0
"""Largest NEES of marks whose stated standard deviations count as true."""


class Stillness(StrEnum):
    """Name whether marks stand still within their stated standard deviations."""

    PASSED = "PASSED"
    FAILED = "FAILED"


class Rest(StrEnum):
    """Name the measurements that a smoothing could use in addition to the withheld mark.

    MARKS : the other marks and all sensors.
    SENSORS : only encoder and accelerometers, as in a run without marks.
    """

    MARKS = "other marks"
    SENSORS = "sensors only"


class Errors(Part):
    """Hold the errors of marks that were smoothed as bubbles; a true mark stands still.

    beside : which other measurements the smoothing could use.
    error_um, sd_um : RMS per axis of the position about its mean, and its stated standard
        deviation.
    velocity_error_mm_s, velocity_sd_mm_s : RMS of the velocity, which should be 0, and its stated
        standard deviation.
    nees, velocity_nees : mean squared errors divided by their stated variances; 1 is expected.
    unsmoothed_um : RMS of the positions about their mean without smoothing: positions that follow
        from the pixels, with the encoder's travel added.
    """

    beside: Rest
    error_um: float
    sd_um: float
    nees: float
    velocity_error_mm_s: float
    velocity_sd_mm_s: float
    velocity_nees: float
    unsmoothed_um: float


class WithheldMark(Errors):
    """Hold the result for one mark that was smoothed as a bubble.

    cameras : the cameras whose pixels were used. If it is one camera, only the two axes of its
        image count.
    frames : number of frames from the mark's first to its last one.
    smoothing : the verdict of the smoothing.
    t_s, off_um, sd_um_of_time : for at most some hundred frames their times, the position along
        each axis minus its mean, and the standard deviation of this difference.
    """

    mark: str
    cameras: tuple[Name, ...]
    frames: int
    smoothing: Verdict | None = None
    t_s: tuple[float, ...] = ()
    off_um: tuple[tuple[float, ...], ...] = ()
    sd_um_of_time: tuple[tuple[float, ...], ...] = ()

    @property
    def verdict(self) -> Stillness:
        """Whether this mark stands still."""
        honest = max(self.nees, self.velocity_nees) <= LARGEST_NEES
        agrees = self.smoothing is not Verdict.CONTRADICTED
        return Stillness.PASSED if honest and agrees else Stillness.FAILED


class Overall(Errors):
    """Hold the errors of all withheld marks together: RMS of errors and standard deviations, and
    means of NEES, weighted by frames."""

    marks: int
    verdict: Stillness


class ValidationFile(Record):
    """Hold the content of validation.json.

    verdict : FAILED if the marks together, or a smoothing, contradict the stated standard
        deviations.
    overall : one entry for each kind of `Rest`.
    """

    KIND: ClassVar[str] = "telerig validation"
    MISSING: ClassVar[str] = "this run is not validated"
    MAKE: ClassVar[str] = "telerig validate RUN"
    AGAIN: ClassVar[str] = "validate again (`telerig validate`)"

    kind: str = KIND
    schema_: int = Field(1, alias="schema")
    run: str
    verdict: Stillness
    overall: tuple[Overall, ...]
    marks: tuple[WithheldMark, ...]
    warnings: tuple[str, ...] = ()


def overall(marks: Sequence[WithheldMark], beside: Rest) -> Overall:
    """Return the errors of all marks together, for smoothings with the same other measurements.

    beside : the measurements that the smoothings could use.
    """
    mine = [mark for mark in marks if mark.beside is beside]
    weights = np.array([mark.frames for mark in mine], float)

    def mean(name: str) -> float:
        return float(np.average([getattr(mark, name) for mark in mine], weights=weights))

    def rms(name: str) -> float:
        return float(np.sqrt(np.average([getattr(m, name) ** 2 for m in mine], weights=weights)))

    nees, velocity_nees = mean("nees"), mean("velocity_nees")
    agree = all(mark.smoothing is not Verdict.CONTRADICTED for mark in mine)
    passed = agree and max(nees, velocity_nees) <= LARGEST_NEES
    return Overall(
        beside=beside, marks=len(mine), error_um=rms("error_um"), sd_um=rms("sd_um"), nees=nees,
        velocity_error_mm_s=rms("velocity_error_mm_s"), velocity_sd_mm_s=rms("velocity_sd_mm_s"),
        velocity_nees=velocity_nees, unsmoothed_um=rms("unsmoothed_um"),
        verdict=Stillness.PASSED if passed else Stillness.FAILED,
    )  # fmt: skip


def validation_words(file: ValidationFile) -> list[str]:
    """Return the verdict in sentences, one for each kind of `Rest`."""
    return [_words(entry) for entry in file.overall]


def _words(entry: Overall) -> str:
    one, passed = entry.marks == 1, entry.verdict is Stillness.PASSED
    count = "1 mark smoothed as a bubble" if one else f"{entry.marks} marks smoothed as bubbles"
    stand = "stands" if one else "stand"
    fall = "does not stand" if one else "do not stand"
    means = {
        Rest.MARKS: "with the other marks and all sensors",
        Rest.SENSORS: "with encoder and accelerometers only, as in a run without marks",
    }[entry.beside]
    return (
        f"{entry.verdict} {means}: {count} {stand if passed else fall} still within the stated "
        f"standard deviations: {entry.error_um:.3g} µm at stated {entry.sd_um:.3g} µm "
        f"(NEES {entry.nees:.2f}), {entry.velocity_error_mm_s:.2g} mm/s at stated "
        f"{entry.velocity_sd_mm_s:.2g} mm/s (NEES {entry.velocity_nees:.2f}); "
        f"{entry.unsmoothed_um:.3g} µm without smoothing."
    )


HEAD = (
    "mark", "beside", "seen by", "frames", "error / µm", "sd / µm", "NEES", "velocity / mm/s",
    "sd / mm/s", "NEES", "smoothing", "verdict",
)  # fmt: skip
"""The columns of the table of marks."""


def table_rows(file: ValidationFile) -> list[tuple[str, ...]]:
    """Return one row of cells for each withheld mark, with the columns `HEAD`."""
    return [
        (
            mark.mark, str(mark.beside), " ".join(mark.cameras), f"{mark.frames}",
            f"{mark.error_um:.3g}", f"{mark.sd_um:.3g}", f"{mark.nees:.2f}",
            f"{mark.velocity_error_mm_s:.2g}", f"{mark.velocity_sd_mm_s:.2g}",
            f"{mark.velocity_nees:.2f}", str(mark.smoothing or ""), str(mark.verdict),
        )
        for mark in file.marks
    ]  # fmt: skip


def table_words(file: ValidationFile) -> list[str]:
    """Return the table of a validation as lines of text, their columns aligned with spaces."""
    rows = [HEAD, *table_rows(file)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(HEAD))]
    return ["  ".join(cell.ljust(w) for cell, w in zip(row, widths)).rstrip() for row in rows]
