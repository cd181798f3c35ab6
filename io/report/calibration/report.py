"""The report of a calibration: one page that needs no network, made from a results folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from telerig.arrays import Array
from telerig.io.files.atomic import write_text_atomic
from telerig.io.report import plot
from telerig.io.report.calibration import tables as tables
from telerig.io.report.page.figures import Figure, image_height_in
from telerig.io.report.page.page import (
    Block,
    Page,
    Row,
    Section,
    Table,
    Tiles,
    Verdict,
    origin,
    pairs,
    render_page,
    table,
    texts,
)
from telerig.io.report.plot.axes import camera_colour
from telerig.io.report.plot.outline import common_plane
from telerig.io.report.plot.rig import sd_in_plane
from telerig.io.report.plot.target import target_shape
from telerig.io.results.calibration_words import has_ordinary_lens, telecentricity_words
from telerig.io.results.findings import ASK_FOR_VIEWS, TRUST, Status
from telerig.io.results.folders.calibration import CalibrationResults, read_calibration_results
from telerig.io.results.manifest import reading
from telerig.io.results.stale import stale
from telerig.rig.pose import Pose
from telerig.short_text import ABSENT, counted, number, sentence
from telerig.statistics import rms

TERMS = (
    "Covariance, standard deviation (sd)", "Posterior", "Gauge",
    "Chi-square per degree of freedom", "Split-half check", "Mirror ambiguity",
    "Refractive window", "Telecentric",
)  # fmt: skip
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
Share = Literal["calibration", "measurement"]
_SIDES: tuple[Literal["x", "y"], ...] = ("x", "y")


def write_calibration_report(
    results_folder: Path, out: Path | None = None, *, page_folder: Path | None = None
) -> Path:
    """Write report.html into a calibration's results folder, or into ``out``; return its path.

    The page is made from nothing but that folder. page_folder : where the page will lie in the end,
    if ``out`` is temporary. Raises InputError for a folder that holds no calibration, or files that
    cannot be read or do not fit together.
    """
    folder = Path(results_folder)
    with reading(folder, ()):
        page = page_of(
            read_calibration_results(folder), stale(folder), page_folder or out or folder
        )
        text = render_page(page)
    file = (folder if out is None else Path(out)) / "report.html"
    write_text_atomic(file, text)
    return file


def page_of(results: CalibrationResults, outdated: Sequence[str], page_folder: Path) -> Page:
    """Return what the page says; ``page_folder`` is where it will lie."""
    residuals = Section("residuals", "Residuals", _residuals(results))
    next_view = Section("next", "Would another view help?", _next(results))
    rejected = results.file.verdict.status == Status.REJECTED
    first, later = ((residuals,), ()) if rejected else ((next_view,), (residuals,))
    return Page(
        "telerig calibration report", str(results.file.verdict.status),
        results.file.name or "calibration", _verdict(results), _look(results),
        [
            Section("key", "", [Tiles(tuple(tables.key_numbers(results)))]),
            *first,
            Section("parameters", "Cameras", _cameras(results)),
            Section("trust", "How far it can be trusted", _trust(results)),
            *later,
            Section("coverage", "Coverage and tilts", _coverage(results)),
            Section("target", "Shape of the target", _target(results)),
            Section("views", "View by view", _views(results, page_folder)),
            Section("model", "Choice of the model", _model(results)),
            Section("comparison", "Since the earlier calibration", _comparison(results)),
            Section("more", "Notes and all statistics", _more(results)),
            origin(results.run, results.absent),
        ],
        TERMS, outdated,
    )  # fmt: skip


def _verdict(results: CalibrationResults) -> Verdict:
    file = results.file
    status, advice = file.verdict.status, file.diagnostics.next_view
    words = [sentence(said) for said in telecentricity_words(results.statistics)]
    if not file.verdict.reasons:
        words.append(
            "No check objected: enough dots agree with the model, and their residuals are what "
            "their noise predicts."
        )
    if advice and status != Status.REJECTED:
        poses = advice.get("poses") or [{}]
        more = f" Next: {poses[0].get('words')}." if poses[0] and not advice.get("enough") else ""
        asked = any(finding.code in ASK_FOR_VIEWS for finding in file.findings or ())
        said = "" if asked and more else sentence(str(advice["verdict"]))
        words.append(f"{said}{more}".strip())
    headline = f"{status}{tables.precision_words(results)}"
    return Verdict(headline, _COLOURS[status], tuple(words),
                   tuple(map(sentence, file.verdict.reasons)))  # fmt: skip


def _look(results: CalibrationResults) -> list[Figure]:
    """Return the rig with all poses, the residuals, and the uncertainty in space if it varies."""
    rig = Figure(
        "The rig and all poses of the target", _rig(results),
        "Seen along the common perpendicular of the optical axes: the targets (grey) should fill "
        "where the fields of the cameras overlap. Where the boxes stand along their axes is drawn, "
        "not measured.",
        3.6,
    )  # fmt: skip
    beside = next(_maps(results), None) or _histogram(results)
    return [rig, _field(results, 0), beside]


def _rig(results: CalibrationResults, **settings: Any) -> partial[Any]:
    return partial(plot.rig, results.cameras, results.views, results.points_mm, **settings)


def _field(results: CalibrationResults, index: int) -> Figure:
    camera = results.cameras[index]
    left_out = int(
        (~results.residuals["kept"] & (results.residuals["camera"] == camera.name)).sum()
    )
    caption = (
        "Arrows in all directions are noise; arrows that swirl or point outwards together "
        "are distortion that the model misses."
    )
    if left_out:
        caption += f" Red: {counted(left_out, 'dot')} that were left out."
    draw = partial(
        plot.residuals, results.residuals, camera.name, camera.image_size_px,
        colour=camera_colour(index),
    )  # fmt: skip
    height = image_height_in(camera.image_size_px)
    return Figure(f"Residuals, camera {camera.name}", draw, caption, height, grid=False)


def _histogram(results: CalibrationResults) -> Figure:
    table, whitened = results.residuals, "whitened_u" in results.residuals
    if whitened:
        kept = table.loc[table["kept"], ["whitened_u", "whitened_v"]].to_numpy(float)
        caption = (
            "Residuals over their own predicted noise should follow the black curve, a little "
            f"narrower because they were fitted (here {number(rms(kept.ravel()))}); fat tails are "
            "outliers."
        )
    else:
        caption = (
            "Steps should follow the curve, a normal distribution of the same RMS; fat tails are "
            "outliers."
        )
    draw = partial(plot.residual_histogram, table)
    return Figure("Distribution of the residuals", draw, caption, 2.9, grid=False)


_SHARES: dict[Share, tuple[str, str]] = {
    "calibration": (
        "Uncertainty: the calibration's share",
        "Standard deviation of a point's position due to the calibration alone, √(sx² + sy² + sz²),"
        " in the plane of the rig frame nearest to both optical axes. Points of a run that lie "
        "near each other share this error: it cancels in their differences. It holds the error "
        "of the rig frame itself, which moves all points alike and which the verdict leaves out.",
    ),
    "measurement": (
        "Uncertainty: the pixels' share",
        "Standard deviation of a point triangulated from both cameras, √(sx² + sy² + sz²), if its "
        "pixel noise is that of this calibration's dots ({sigma} px). These errors are independent "
        "from point to point, and proportional to the pixel noise.",
    ),
}


def _across(results: CalibrationResults) -> int:
    """Return which rig axis, x (0) or y (1), is nearer to the plane of the optical axes."""
    return int(np.argmax(np.abs(common_plane(results.cameras)[0, :2])))


def _maps(results: CalibrationResults) -> Iterator[Figure]:
    """Yield the maps of uncertainty that are not uniform; a single camera has none."""
    for of, (title, caption) in _SHARES.items() if results.uncertainty else ():
        across = _across(results)
        grid = sd_in_plane(results.uncertainty, f"{of}_mm2", across)[2]
        if not _is_flat(grid):
            words = caption.format(sigma=number(float(results.uncertainty["sigma_px"]), 3))
            words += f" {number(grid.min(), 3)} to {number(grid.max(), 3)} µm."
            draw = partial(plot.uncertainty, results.uncertainty, of, across=_SIDES[across])
            yield Figure(title, draw, words, 3.6, grid=False)


def _is_flat(grid: Array) -> bool:
    return bool(np.ptp(grid) <= 1e-3 * grid.max())


def same_everywhere(results: CalibrationResults) -> str:
    """Return a sentence on a pixels' share that is uniform; "" if it has a picture."""
    arrays = results.uncertainty
    grid = sd_in_plane(arrays, "measurement_mm2", _across(results))[2] if arrays else np.zeros(0)
    if not grid.size or not _is_flat(grid):
        return ""
    sigma = number(float(arrays["sigma_px"]), 3)
    return (
        f"the pixels' share of a point's uncertainty is {number(float(grid.mean()), 3)} µm "
        f"everywhere (1 sd, all axes together), for the noise of this calibration's dots ({sigma} "
        "px)"
    )


def _trust(results: CalibrationResults) -> list[Block]:
    findings = results.file.findings
    words = [f.words for f in findings if f.status == Status.GOOD and f.code in TRUST]
    words.append(same_everywhere(results))
    maps = list(_maps(results))[1:]
    halves = results.file.diagnostics.halves
    if "points_mm" in halves:
        shift = np.array(halves["shift_um"], float).reshape(-1, 3)
        longest = float(np.linalg.norm(shift, axis=1).max())
        caption = (
            f"Arrows show by how much a calibration from {halves['views'][0]} views and one from "
            f"the other {halves['views'][1]} place the same pixels differently (longest in space "
            f"{number(longest, 2)} µm). Grey circles have the radius of one predicted standard "
            "deviation of that difference. Neighbouring arrows are alike, because the difference "
            "is mostly a rotation and a scale. If most arrows are much longer than the radius, the "
            "covariance is too small."
        )
        draw = partial(plot.split_half, halves, across=_SIDES[_across(results)])
        maps.append(Figure("Split-half check", draw, caption, 3.6))
    return [*texts(*(sentence(said) for said in words if said), points=True), *maps]


def _next(results: CalibrationResults) -> list[Block]:
    """Return reasons and pictures of the best pose; nothing where the verdict said it all."""
    advice = results.file.diagnostics.next_view
    poses = advice.get("poses") or ()
    if not poses:
        return []
    best = poses[0]
    said = "If you take one more" if advice.get("enough") else "Hold the target like this"
    reasons = map(sentence, best.get("reasons") or ())
    blocks: list[Block] = [*texts(f"{said}: {best['words']}."), *texts(*reasons, points=True)]
    if len(results.cameras) < 2:
        return blocks
    matrix = np.array(best["rig_from_target"], float).reshape(4, 4)
    pose = Pose(matrix[:3, :3], matrix[:3, 3])
    marks = np.flatnonzero(np.isin(results.dot_ids, advice.get("marks") or [])).tolist()
    for i, camera in enumerate(results.cameras):
        draw = partial(plot.target_in_image, camera, pose, results.points_mm, marks=marks, index=i,
                       table=results.residuals)  # fmt: skip
        caption = (
            "Large: marks; red: the edge beside row 0, or of smallest y; grey: where dots were so "
            "far. Some degrees and millimetres more or less do not matter."
        )
        height = image_height_in(camera.image_size_px)
        blocks.append(Figure(f"Next view, camera {camera.name}", draw, caption, height, grid=False))
    caption = (
        "The same in plan, left and right as camera "
        f"{results.cameras[0].name} sees them; grey: the views so far."
    )
    plan = _rig(results, next_pose=pose)
    return [*blocks, Figure("Where to hold it next", plan, caption, 3.9)]


def _cameras(results: CalibrationResults) -> list[Block]:
    held = tables.held_everywhere(results)
    lead = (
        "Value ± one posterior standard deviation; 0 with a standard deviation: left at nominal, "
        "which the data do not exclude to that extent; “held”: not estimated. Distortion "
        "coefficients refer to coordinates divided by half the image diagonal."
    )
    if held:
        lead += f" Held at nominal in all cameras: {', '.join(held)}."
    pose, stage = tables.pose_rows(results), tables.stage_rows(results)
    names = results.camera_names
    observable = (
        "Where on its optical axis a camera's origin lies is a choice, for which scale and κ are "
        "stated; the centre of perspective is at the distance 1 / κ from it. The standard "
        "deviations of shifts along the axes are those of this gauge."
        if has_ordinary_lens(results.statistics) else
        "Only the three rotations and the distance between the axes are observable; the other two "
        "shifts are held by the gauge, so that their standard deviations are those of the gauge."
        if len(names) < 3 else
        "No telecentric camera sees its own shift along its optical axis (z), and the shift of all "
        "along the axis of the first is not observable either: the gauge holds the shift of each "
        f"camera along its z axis and that of {names[1]} along the axis of {names[0]}, so that the "
        "standard deviations of these are those of the gauge."
    )  # fmt: skip
    travel = (
        "Travel axis and encoder scale are from the views in stage_axis/. Smoothed runs take them "
        "from this calibration, with their covariance."
    )
    return [
        *table(["parameter", *names], tables.parameter_rows(results)), *texts(lead, small=True),
        *table(["pose", "value"], pose), *texts(observable if pose else "", small=True),
        *table(["stage", "value"], stage), *texts(travel if stage else "", small=True),
    ]  # fmt: skip


def _model(results: CalibrationResults) -> list[Block]:
    ladder = tables.ladder_rows(results)
    lead = (
        "Each step frees some parameters of one camera; the chosen model is set in bold, steps "
        "that were not taken are pale. “chi² gained” is by how much the step lowers chi², predicted"
        " from the fit of the richest model. “BIC gain” subtracts from it the BIC penalty of the "
        "step's parameters; a positive value favours the step. “chance” is the p-value: the "
        "probability that noise alone gains as much."
    )
    head = ["step (camera)", "chi² gained", "BIC gain", "chance", ""]
    return [
        *texts(results.file.model.words or ""), *table(head, ladder, (1, 4)),
        *texts(lead if ladder else "", small=True),
    ]  # fmt: skip


def _comparison(results: CalibrationResults) -> list[Block]:
    found = results.comparison
    if not found.content():
        return []
    words = sentence(str(found.words or ""))
    earlier = f"This calibration minus {found.earlier}." if found.earlier else ""
    head = ["", "change", "standard deviations"]
    return [*texts(earlier, small=True), *texts(words), *table(head, tables.change_rows(results))]


def _residuals(results: CalibrationResults) -> list[Block]:
    every = results.residuals
    fields = [_field(results, i) for i in range(1, len(results.cameras))]
    spread = [_histogram(results)] if next(_maps(results), None) else []
    left_out, lowered = int((~every["kept"]).sum()), int((every["weight"] < 1).sum())
    words = (
        f"{left_out} of {len(every)} dots were left out (weight 0.5 or below), {lowered} have a "
        "lowered weight. Residuals are measured minus predicted, in px. All of them are in "
        "residuals.csv."
    )
    head = ["view", "camera", "dot", "row, column", "du", "dv", "length", "weight", "reason"]
    return [*fields, *spread, *texts(words), *table(head, tables.worst_rows(results), (2, 8))]


def _coverage(results: CalibrationResults) -> list[Block]:
    figures: list[Block] = []
    for i, camera in enumerate(results.cameras):
        draw = partial(plot.coverage, results.residuals, camera.name, camera.image_size_px,
                       colour=camera_colour(i))  # fmt: skip
        caption = "Dots of all views. Red: no dot was there; the distortion is extrapolated."
        height = image_height_in(camera.image_size_px)
        figures.append(Figure(f"Coverage, camera {camera.name}", draw, caption, height, grid=False))
    caption = (
        "One mark per view: distance from the middle is the tilt, direction is where the target "
        "leans in the image; marks should go round the disc at 20 to 60 degrees."
    )
    draw = partial(plot.tilts, results.cameras, results.views, results.residuals)
    return [*figures, Figure("Tilts of the target", draw, caption, 4.0, grid=False)]


def _target(results: CalibrationResults) -> list[Block]:
    given = (results.points_mm, results.row_column, results.target_covariance)
    shape = target_shape(*given)
    if shape is None:
        return []
    known = [f"{number(float(np.median(sd)), 2)} µm (1 sd)" if sd.any() else "an unknown degree"
             for sd in (shape.sd_um[:, :2], shape.sd_um[:, 2])]  # fmt: skip
    plane = (
        "Arrows from a perfect, evenly stretched grid to the estimated dots: RMS "
        f"{number(rms(shape.off_um[:, :2].ravel()))} µm per axis, known to {known[0]}; rings are "
        "one sd."
    )
    heights = (
        f"Height of each dot over the best plane along the target's z: RMS "
        f"{number(rms(shape.off_um[:, 2]))} µm, known to {known[1]}; a smooth bow is bending, a "
        "patchwork is the print."
    )
    draw = partial(plot.target, *given)
    return [
        Figure("Print errors in the plane", draw, plane, 4.2, grid=False),
        Figure("Out of the plane", partial(draw, heights=True), heights, 4.6, grid=False),
    ]


def _views(results: CalibrationResults, page_folder: Path) -> list[Block]:
    rows = tables.view_rows(results, page_folder)
    head = ["view", *(f"dots of {name}" for name in results.camera_names), "RMS / px"]
    words = (
        "A view leads to its picture with the dots that were found (overlays/); telerig view shows "
        "every view's image with its dots and residuals, and the rig in 3-D."
    )
    return [*table(head, rows), *texts(words if rows else "", small=True)]


def _more(results: CalibrationResults) -> list[Block]:
    file = results.file
    notes = [f.words for f in file.findings if f.status == Status.GOOD and f.code not in TRUST]
    costs = (file.twin.cost, file.twin.other_cost)
    costs_words = [ABSENT if c is None else f"{c:.10g}" for c in costs]
    twin = [
        Row(("mirror ambiguity: cost of the solution that was kept", costs_words[0])),
        Row(("mirror ambiguity: cost of its mirror image", costs_words[1])),
        Row(("mirror ambiguity: decided by", file.twin.decided_by or ABSENT)),
        Row(("mirror ambiguity: because", file.twin.words or ABSENT)),
        Row(("gauge", file.gauge or ABSENT)),
    ]
    shown = _SHOWN if tables.stage_rows(results) else _SHOWN - {"stage"}
    extra = {k: v for k, v in results.content.items() if k not in shown and v != {}}
    return [
        *texts(*notes, points=True), Table(twin),
        *pairs({**results.statistics, **extra}, "calibration.json"),
    ]  # fmt: skip
