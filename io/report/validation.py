"""The page of a validation: how still withheld marks stand, made from validation.json."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from telerig.io.files.atomic import write_text_atomic
from telerig.io.report.page.figures import CAMERA_COLOURS, Curve, Picture, draw_curves, drawing
from telerig.io.report.page.page import Figure, Row, Section, render_sections
from telerig.io.results.validation import (
    HEAD,
    LARGEST_NEES,
    Stillness,
    ValidationFile,
    WithheldMark,
    table_rows,
    validation_words,
)

NAME = "validation.html"
TERMS = ("Marks", "NEES", "Covariance, standard deviation (sd)", "Verdict")
_MOST_DRAWN = 12


def write_validation_report(folder: Path, out: Path | None = None) -> Path:
    """Write validation.html beside validation.json, or into ``out``; InputError without that."""
    content = ValidationFile.read(Path(folder) / "validation.json")
    page = (folder if out is None else out) / NAME
    write_text_atomic(page, render(content))
    return page


def render(content: ValidationFile) -> str:
    """Return the page as text."""
    passed = content.verdict is Stillness.PASSED
    verdict = {
        "colour": "good" if passed else "rejected",
        "headline": str(content.verdict),
        "sentences": validation_words(content),
        "warnings": content.warnings,
    }
    rows = tuple(
        Row(cells, strong=mark.verdict is Stillness.FAILED)
        for cells, mark in zip(table_rows(content), content.marks)
    )
    lead = (
        "Each mark is withheld in turn and smoothed as a bubble, after a known motion, as of a "
        "bubble, has been added to its pixels. Once this motion is subtracted, its path must stand "
        "still in the laboratory. A mark fails if the NEES of its position or of its velocity is "
        f"above {LARGEST_NEES:g}, or if the smoothing finds its measurements CONTRADICTED."
    )
    pictures = tuple(_picture(mark) for mark in content.marks[:_MOST_DRAWN])
    return render_sections(
        "telerig validation of a run with marks", "Validation", content.run, verdict,
        [
            Section(tiles=tuple(_figures(content))),
            Section("Mark by mark", lead, head=HEAD, rows=rows, numbers=(3, 10)),
            Section("In time", pictures=pictures),
        ],
        TERMS,
    )  # fmt: skip


def _figures(content: ValidationFile) -> Iterator[Figure]:
    for entry in content.overall:
        yield Figure(
            f"error, {entry.beside}", f"{entry.error_um:.3g} µm",
            f"stated {entry.sd_um:.3g} µm, NEES {entry.nees:.2f}; {entry.unsmoothed_um:.3g} µm "
            "without smoothing",
        )  # fmt: skip
        yield Figure(
            f"velocity, {entry.beside}", f"{entry.velocity_error_mm_s:.2g} mm/s",
            f"stated {entry.velocity_sd_mm_s:.2g} mm/s, NEES {entry.velocity_nees:.2f}",
        )  # fmt: skip


def _picture(mark: WithheldMark) -> Picture:
    """Distance from the mean over time, with bands of stated standard deviations."""
    t = np.array(mark.t_s)
    axes = "xyz" if len(mark.off_um) == 3 else "uv"
    with drawing(1.9, legend="above", xlabel="time / s", ylabel="off / µm") as sheet:
        draw_curves(
            sheet,
            (
                Curve(t, np.array(off), CAMERA_COLOURS[i % len(CAMERA_COLOURS)], axes[i],
                      np.array(sd))
                for i, (off, sd) in enumerate(zip(mark.off_um, mark.sd_um_of_time))
            ),
        )  # fmt: skip
    return Picture(
        f"Mark {mark.mark}, {mark.beside}", sheet.source,
        f"Distance of the smoothed path from its mean, less the motion that the mark was given, "
        f"along the axes of the {'rig' if len(mark.off_um) == 3 else 'image'}. It should stay "
        f"within the bands. Seen by {' and '.join(mark.cameras)}.",
    )  # fmt: skip
