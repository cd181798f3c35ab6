"""The page of a validation: how still withheld marks stand, made from validation.json."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

from telerig.io.files.atomic import write_text_atomic
from telerig.io.report import plot
from telerig.io.report.page.figures import Figure
from telerig.io.report.page.page import (
    Block,
    Page,
    Row,
    Section,
    Tile,
    Tiles,
    Verdict,
    render_page,
    table,
    texts,
)
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
_SAYS = {
    Stillness.PASSED: "marks stand still within the stated standard deviations",
    Stillness.FAILED: "marks move more than the stated standard deviations allow",
}
_NEXT = {
    Stillness.PASSED: (
        "Next: bubbles of runs with this rig, these sensors and this calibration are good to what "
        "their results state."
    ),
    Stillness.FAILED: (
        "Next: telerig doctor DATASET/runs/NAME looks for a wrong sensor, clock or calibration in "
        "this recording. Until it is found, do not rely on standard deviations of other runs."
    ),
}


def write_validation_report(folder: Path, out: Path | None = None) -> Path:
    """Write validation.html beside validation.json, or into ``out``; InputError without that."""
    content = ValidationFile.read(Path(folder) / "validation.json")
    page = (folder if out is None else out) / NAME
    write_text_atomic(page, render(content))
    return page


def render(content: ValidationFile) -> str:
    """Return the page as text."""
    passed = content.verdict is Stillness.PASSED
    verdict = Verdict(
        f"{content.verdict}: {_SAYS[content.verdict]}", "good" if passed else "rejected",
        (*validation_words(content), _NEXT[content.verdict]), tuple(content.warnings),
    )  # fmt: skip
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
    marks: list[Block] = [*texts(lead, small=True), *table(HEAD, rows, (3, 10))]
    figures = [_figure(mark) for mark in content.marks]
    return render_page(Page(
        "telerig validation of a run with marks", "Validation", content.run, verdict, figures[:3],
        [
            Section("key", "", [Tiles(tuple(_tiles(content)))]),
            Section("marks", "Mark by mark", marks),
            Section("time", "Further marks in time", figures[3:_MOST_DRAWN]),
        ],
        TERMS,
    ))  # fmt: skip


def _tiles(content: ValidationFile) -> Iterator[Tile]:
    for entry in content.overall:
        yield Tile(
            f"error, {entry.beside}", f"{entry.error_um:.3g} µm",
            f"stated {entry.sd_um:.3g} µm, NEES {entry.nees:.2f}; {entry.unsmoothed_um:.3g} µm "
            "without smoothing",
        )  # fmt: skip
        yield Tile(
            f"velocity, {entry.beside}", f"{entry.velocity_error_mm_s:.2g} mm/s",
            f"stated {entry.velocity_sd_mm_s:.2g} mm/s, NEES {entry.velocity_nees:.2f}",
        )  # fmt: skip


def _figure(mark: WithheldMark) -> Figure:
    """Distance from the mean over time, with bands of stated standard deviations."""
    space = "rig" if len(mark.off_um) == 3 else "image"
    return Figure(
        f"Mark {mark.mark}, {mark.beside}",
        partial(plot.offsets, mark.t_s, mark.off_um, mark.sd_um_of_time),
        "Distance of the smoothed path from its mean, less the motion that the mark was given, "
        f"along the axes of the {space}. It should stay within the bands. Seen by "
        f"{' and '.join(mark.cameras)}.",
        1.9,
    )
