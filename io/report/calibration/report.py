"""The report of a calibration: one page that needs no network, made from a results folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from telerig.io.files.atomic import write_text_atomic
from telerig.io.report.calibration import tables as tables
from telerig.io.report.calibration.dot_fit import dot_pictures
from telerig.io.report.calibration.figures import (
    coverage,
    residual_field,
    residual_histogram,
    same_everywhere,
    tilts,
    trust_pictures,
)
from telerig.io.report.calibration.rig import dots_are_drawn, next_pictures, rig_plan, scene_json
from telerig.io.report.calibration.target import target_pictures
from telerig.io.report.page.contact_sheet import ContactSheet, picture_sheet
from telerig.io.report.page.figures import Picture
from telerig.io.report.page.page import drawn_over_cores, render_page
from telerig.io.results.calibration_words import telecentricity_words
from telerig.io.results.findings import ASK_FOR_VIEWS, TRUST, Status
from telerig.io.results.folders.calibration import CalibrationResults, read_results
from telerig.io.results.manifest import reading
from telerig.io.results.stale import stale
from telerig.short_text import ABSENT, flat_rows, sentence

_COLOURS = {
    Status.GOOD: "good",
    Status.USABLE: "usable",
    Status.REJECTED: "rejected",
    Status.IMPORTED: "usable",
}
_SHOWN = {
    "schema", "kind", "name", "pixel_origin", "units", "gauge", "findings", "verdict", "cameras",
    "target", "views", "covariance", "model", "twin", "statistics", "diagnostics", "notes", "stage",
}  # fmt: skip


def write_calibration_report(
    results_folder: Path,
    out: Path | None = None,
    *,
    dot: list[Picture] | None = None,
    page_folder: Path | None = None,
) -> Path:
    """Write report.html into a calibration's results folder, or into ``out``; return its path.

    The page is made from nothing but that folder. dot : what `dot_pictures` made of dot_example.npz
    before; None draws it now. page_folder : where the page will lie in the end, if ``out`` is
    temporary. Raises InputError for a folder that holds no calibration, or files
    that cannot be read or do not fit together.
    """
    folder = Path(results_folder)
    with reading(folder, ()):
        page = render(read_results(folder), dot, stale(folder), page_folder or out)
    file = (folder if out is None else Path(out)) / "report.html"
    write_text_atomic(file, page)
    return file


def render(
    results: CalibrationResults,
    dot: list[Picture] | None = None,
    outdated: Sequence[str] = (),
    page_folder: Path | None = None,
) -> str:
    """Return the page as text; ``outdated`` is what `stale` found, ``page_folder`` its place."""
    context = {"stale": outdated} | _words(results) | _tables(results)
    context |= _pictures(results, dot, page_folder)
    return render_page("template_calibration.html", context, scene_json(results))


def _words(results: CalibrationResults) -> dict[str, Any]:
    file = results.file
    costs = (file.twin.cost, file.twin.other_cost)
    notes = [finding for finding in file.findings or () if finding.status == Status.GOOD]
    trust = [finding.words for finding in notes if finding.code in TRUST]
    trust.append(same_everywhere(results))
    return {
        "name": file.name or "calibration",
        "status": file.verdict.status,
        "colour": _COLOURS[file.verdict.status],
        "precise": tables.precision_words(results),
        "reasons": file.verdict.reasons,
        "lenses": [sentence(words) for words in telecentricity_words(results.statistics)],
        "cameras": results.camera_names,
        "model": file.model.content(),
        "twin": file.twin.content(),
        "twin_costs": [ABSENT if c is None else f"{c:.10g}" for c in costs],
        "gauge": file.gauge or ABSENT,
        "notes": [finding.words for finding in notes if finding.code not in TRUST],
        "absent": results.absent,
        "trust_words": [sentence(words) for words in trust if words],
        "comparison": results.comparison.content(),
        "advice": file.diagnostics.next_view,
        "views_asked": any(f.code in ASK_FOR_VIEWS for f in file.findings or ()),
        "dots_drawn": dots_are_drawn(results),
    }


def _tables(results: CalibrationResults) -> dict[str, Any]:
    stage = tables.stage_rows(results)
    shown = _SHOWN if stage else _SHOWN - {"stage"}
    extra = {k: v for k, v in results.content.items() if k not in shown and v != {}}
    return {
        "figures": tables.key_numbers(results),
        "parameters": tables.parameter_rows(results),
        "held": tables.held_everywhere(results),
        "pose": tables.pose_rows(results),
        "stage": stage,
        "ladder": tables.ladder_rows(results),
        "worst": tables.worst_rows(results),
        "changes": tables.change_rows(results),
        "left_out": int((~results.residuals["kept"]).sum()),
        "lowered": int((results.residuals["weight"] < 1).sum()),
        "measured": len(results.residuals),
        "statistics": list(flat_rows(results.statistics)),
        "extra": list(flat_rows(extra)),
        "run": list(flat_rows(results.run)),
    }


def _pictures(
    results: CalibrationResults, dot: list[Picture] | None, page_folder: Path | None
) -> dict[str, Any]:
    every = range(len(results.cameras))
    drawings: list[tuple[str, Callable[[], Any]]] = [  # what takes long comes first
        ("trust", partial(trust_pictures, results)),
        ("target", partial(target_pictures, results)),
        ("next", partial(next_pictures, results)),
        *(("fields", partial(residual_field, results, i)) for i in every),
        ("spread", partial(residual_histogram, results)),
        ("plan", partial(rig_plan, results)),
        *(("covered", partial(coverage, results, i)) for i in every),
        ("covered", partial(tilts, results)),
        ("sheet", partial(contact_sheet, results, page_folder)),
    ]
    if dot is None:
        drawings.insert(0, ("dot", partial(dot_pictures, results.dot_example)))
    drawn = drawn_over_cores([d for _, d in drawings])
    pictures: dict[str, Any] = {"fields": [], "covered": [], "spread": [], "dot": dot}
    for (place, _), picture in zip(drawings, drawn):
        if place in ("fields", "covered", "spread"):
            pictures[place].append(picture)
        else:
            pictures[place] = picture
    beside = pictures["trust"] or pictures["spread"]
    pictures["first"] = [pictures["fields"].pop(0), beside.pop(0)]
    return pictures


def contact_sheet(results: CalibrationResults, page_folder: Path | None = None) -> ContactSheet:
    """Return the overlays of a calibration. Raises InputError for a picture that cannot be read."""
    views = list(results.views) if results.overlays else []
    return picture_sheet(views, results.camera_names, results.overlays, page_folder=page_folder)
