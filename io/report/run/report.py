"""The report of a tracked run: one page that needs no network, made from a results folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from telerig.io.files.atomic import write_text_atomic
from telerig.io.report import plot
from telerig.io.report.page.figures import Figure, image_height_in
from telerig.io.report.page.page import (
    Block,
    Page,
    Row,
    Section,
    Table,
    Text,
    Tiles,
    origin,
    pairs,
    render_page,
    table,
    texts,
)
from telerig.io.report.plot.axes import camera_colour
from telerig.io.report.plot.tracking import miss_steps
from telerig.io.report.run import bubbles
from telerig.io.report.run import smoothing as smoothed
from telerig.io.report.run import tracking as tracked
from telerig.io.results.folders.smoothing import (
    AXES,
    SmoothingResults,
    known_parts,
    read_smoothing_results,
    shake_rms_um,
)
from telerig.io.results.folders.tracking import (
    TrackResults,
    learnt_sd_mm,
    per_frame,
    ray_miss_sd_mm,
    read_track_results,
)
from telerig.io.results.manifest import reading
from telerig.io.results.stale import stale
from telerig.io.results.verdict_words import words_of_axes, words_of_refusals
from telerig.short_text import number, share

_SHOWN = {"schema", "kind", "run", "notes", "worst_frames", "pairs", "covariance", "events",
          "rig_change", "warnings"}  # fmt: skip
_OF_TRACKS = (
    "Ray miss", "Triangulated point", "Track", "Birth and death of a track", "Gate",
    "Log-likelihood ratio", "Equivalent diameter", "Covariance, standard deviation (sd)",
    "Posterior",
)  # fmt: skip
_OF_SMOOTHING = (
    "RTS smoother", "Common-mode and differential shake", "Mode", "Hyper-parameters",
    "Identifiable", "Encoder position",
)  # fmt: skip
TERMS = (*_OF_TRACKS, *_OF_SMOOTHING)
_NEXT = (
    "These paths hold the shake of the rig and are relative to it. Next: telerig smooth takes the "
    "shake out, adds the travel of the stage, and says whether the paths can be relied on. If it "
    "refused this run, it said why."
)


def write_track_report(
    results_folder: Path, out: Path | None = None, *, page_folder: Path | None = None
) -> Path:
    """Write report.html into a tracked run's results folder, or into ``out``; returns its path.

    It reads nothing but that folder: tracking.json and tracks.csv, and if they are there
    detections.csv, events.csv, references.csv, run.json and overlays/<camera>/<frame>.jpg. Where
    smoothing.json is there, with trajectories.csv and shake.csv, the page begins with the
    smoothing. It is written whole or not at all. page_folder : where the page will lie in the end,
    if ``out`` is temporary. Raises InputError for a folder that holds no tracks, or files that
    cannot be read or do not fit together.
    """
    folder = Path(results_folder)
    with reading(folder, ()):
        tracks = read_track_results(folder)
        smoothing = read_smoothing_results(folder, tracks.up)
        page = page_of(tracks, smoothing, stale(folder), page_folder or out or folder)
        text = render_page(page)
    file = (folder if out is None else Path(out)) / "report.html"
    write_text_atomic(file, text)
    return file


def page_of(
    results: TrackResults,
    smoothing: SmoothingResults | None,
    outdated: Sequence[str],
    page_folder: Path,
) -> Page:
    """Return what the page of a run says; smoothing : None for a page without it."""
    verdict = tracked.verdict(results)
    key = Section("key", "", [Tiles(tuple(tracked.key_numbers(results)))])
    about = [
        Section("rays", "Do the cameras agree?", _rays(results, beside=smoothing is not None)),
        Section("images", "In the images", _images(results)),
        Section("frames", "Doubtful frames", _frames(results, page_folder)),
        Section("events", "Events", _events(results)),
        Section("more", "Notes and all numbers", _more(results)),
        origin(results.run, results.absent),
    ]
    name = results.file.run or "run"
    if smoothing is None:
        if len(results.tracks):
            verdict = replace(verdict, sentences=(*verdict.sentences, _NEXT))
        return Page(
            "telerig report of a tracked run", "Tracks", name, verdict, _look(results),
            [key, Section("paths", "Paths", _paths(results)), *about], _OF_TRACKS, outdated,
        )  # fmt: skip
    words = [Text((verdict.headline + ".", *verdict.sentences))]
    tracking = [*texts(*verdict.warnings, points=True), *words, *key.contents]
    return Page(
        "telerig report of a smoothed run", "Smoothed run", name,
        smoothed.smoothing_verdict(smoothing), _look_smoothed(smoothing),
        [
            Section("smoothing-key", "", [Tiles(tuple(smoothed.smoothing_tiles(smoothing)))]),
            Section("good-for", "What this run is good for", _uses(smoothing)),
            Section("axes", "Per axis", _axes(smoothing)),
            Section("bubbles", "Bubbles: sizes, velocities, forces", _bubbles(smoothing)),
            Section("lab", "Paths and velocities", _lab(smoothing)),
            Section("shake", "Shake of the cameras", _shake(smoothing)),
            Section("residuals", "Residuals and constants", _residuals(smoothing)),
            Section("tracking", "The tracking beneath", tracking),
            *about,
        ],
        TERMS, outdated,
    )  # fmt: skip


def up_name(up: Any) -> str:
    """Return a direction of the rig as `telerig.plot` takes it, like "-y"."""
    axis = int(np.argmax(np.abs(up)))
    return ("-" if up[axis] < 0 else "") + AXES[axis]


def _path(table: Any, up: str, words: str) -> Figure:
    words += " A colour per bubble, some drawn as ellipsoids; telerig view turns it in 3-D."
    return Figure("Paths in space", partial(plot.path, table, up=up), words, 3.6, space=True)


def _look(results: TrackResults) -> list[Figure]:
    up = up_name(results.up)
    return [
        _path(results.tracks, up, "In the rig frame, which moves with the stage."),
        Figure("Height of the longest track", partial(plot.height, results.tracks, up=up),
               "Frames from its middle, in the rig frame, less a straight line: the shake of the "
               "rig is in it."),
        _ray_miss(results),
    ]  # fmt: skip


def _look_smoothed(results: SmoothingResults) -> list[Figure]:
    up = up_name(results.up)
    shaken = _by_shake(results)
    words = "In the laboratory: the travel of the stage is added and the shake is removed."
    paths = _path(results.shaped, up, words)
    return [
        *([paths, _height(results, "", up)] if len(results.trajectories) else []),
        *(_shake_spectrum(results, camera) for camera in shaken[:1]),
    ]


def _by_shake(results: SmoothingResults) -> list[str]:
    """Return the cameras, those that shake most first."""

    def largest(camera: str) -> float:
        return max((shake_rms_um(results, camera, axis) or 0.0 for axis in AXES), default=0.0)

    return sorted(results.cameras, key=lambda camera: -largest(camera))


def _height(results: SmoothingResults, axis: str, up: str) -> Figure:
    title = f"{axis or 'Height'} of the longest track, before and after"
    caption = (
        "Some frames from its middle, less a straight line. Before: the triangulated point plus "
        "the encoder position. Red ticks: no image shows the bubble."
    )
    return Figure(title, partial(plot.height, results.trajectories, axis=axis, up=up), caption)


def _modes_hz(results: SmoothingResults) -> list[float]:
    """Return the frequencies of the model's modes."""
    return [float(mode["frequency_hz"]) for mode in results.part("model").get("modes") or []]


def _shake_spectrum(results: SmoothingResults, camera: str) -> Figure:
    draw = partial(plot.spectrum, results.shake, camera, "".join(results.seen(camera)),
                   modes_hz=_modes_hz(results), up=up_name(results.up))  # fmt: skip
    caption = "A narrow peak is a resonance of the rig. Dotted lines: modes of the model."
    return Figure(f"Spectrum of the shake of camera {camera}", draw, caption)


def _uses(results: SmoothingResults) -> list[Block]:
    rows, refusals = smoothed.use_rows(results), words_of_refusals(results.file)
    lead = (
        "Median of the longest bubbles, in rig axes. Good: the value is at least ten times its "
        "standard deviation; limited: three times. A velocity in a frame and a path are given by "
        "their RMS, the path about a straight line and up to the frequency at which its power "
        "falls below nine times that of its errors, a zigzag by the spectrum of the path, which is "
        "as wide as the record is short; the strongest oscillation of each bubble stands under "
        "Bubbles. Nothing in the run confirms the sign, unit and "
        "scale of what a value rests on."
    )
    if not rows:
        return []
    return [
        *table(["grade", "quantity", "axis", "value ± sd", "rests on"], rows, (3, 4)),
        *texts("Why not, and what to add:" if refusals else ""), *texts(*refusals, points=True),
        *texts(lead, small=True),
    ]  # fmt: skip


def _axes(results: SmoothingResults) -> list[Block]:
    head, rows = smoothed.axis_table(results)
    lead = (
        "Medians of the sd, RMS of everything else, in rig axes; the standard deviations of "
        "trajectories.csv also hold what is not known of the encoder's scale and of the travel "
        "axis, which moves all bubbles alike; “naive” is the triangulated point plus the encoder "
        "position, “RTS” is a Rauch-Tung-Striebel smoother without a model of the shake."
    )
    if results.file.axes:
        lead += (
            " q is the posterior standard deviation divided by the one that would remain if the "
            "shake were known; 1 is best. η is the share of the shake's variance that the data "
            "remove, of the shake that the run shows (mean square of the estimate plus its "
            "variance); 1 is best."
        )
    words = words_of_axes(results.file)
    return [*texts(*words, points=True), *table(head, rows), *texts(lead, small=True)]


def _bubbles(results: SmoothingResults) -> list[Block]:
    head, rows = bubbles.summary_rows(results)
    if not rows:
        return []
    swarm = bubbles.swarm_tiles(results)
    return [
        *([Tiles(tuple(swarm))] if swarm else []), *bubbles.bubble_figures(results),
        *table(head, rows), *texts(bubbles.bubble_words(results), small=True),
    ]  # fmt: skip


def _lab(results: SmoothingResults) -> list[Block]:
    """Return the other two coordinates, and velocities and their spectra along all axes."""
    if not len(results.trajectories):
        return []
    up, figures = up_name(results.up), []
    figures += [_height(results, axis, up) for axis in AXES if axis != up[-1]]
    for axis in (up[-1], *(a for a in AXES if a != up[-1])):
        draw = partial(plot.velocity, results.trajectories, axis=axis, up=up)
        what = "Rise velocity" if axis == up[-1] else f"Velocity in {axis}"
        figures.append(Figure(what, draw, "Of the longest track."))
    for axis in AXES:
        draw = partial(plot.spectra, results.trajectories, axis, modes_hz=_modes_hz(results), up=up)
        caption = "What the motion itself holds should stay where it was."
        figures.append(Figure(f"Spectrum of the velocity in {axis}", draw, caption))
    return list(figures)


def _shake(results: SmoothingResults) -> list[Block]:
    lead = (
        "The offset of each camera from the place that the encoder position gives, along the rig "
        "axes."
    )
    up = up_name(results.up)
    figures = [
        Figure(f"Shake of camera {camera}",
               partial(plot.shake, results.shake, camera, "".join(results.seen(camera)), up=up))
        for camera in results.cameras if len(results.shake) and results.seen(camera)
    ]  # fmt: skip
    figures += [_shake_spectrum(results, camera) for camera in _by_shake(results)[1:]]
    for sensor, found in known_parts(results, "accelerometer_spectra", "frequency_hz").items():
        caption = (
            "Welch's estimate, over the directions that the model moves the sensor in. What the "
            "model leaves should lie at the stated noise."
        )
        title = f"Accelerometer {sensor}, before and after"
        figures.append(Figure(title, partial(plot.accelerometer, found), caption))
    rows, words = smoothed.mode_rows(results)
    return [
        *texts(" ".join([lead, *smoothed.unseen_words(results)]), small=True), *figures,
        *table(smoothed.MODE_HEADS, rows, (1, 4)), *texts(words, small=True),
    ]  # fmt: skip


def _residuals(results: SmoothingResults) -> list[Block]:
    head = ["pixels of", "how many", "outliers", "share", "RMS, sigmas", "median, sigmas"]
    white = Figure(
        "Residuals some frames apart", partial(plot.whiteness, results.file.whiteness),
        "Both coordinates of the bubbles' pixels, outliers left out. The fit follows part of the "
        "noise, so that neighbours differ more than noise does; dashed: by how much, drawn from "
        "the model.",
    )  # fmt: skip
    constants, means = smoothed.constant_rows(results), smoothed.mean_rows(results)
    own_depth = (
        "A bias along a camera's own depth cannot be measured: its standard deviation is that of "
        "the prior."
    )
    of_means = (
        "Velocity about which each bubble's wanders, mm/s: a parameter of the model. The mean over "
        "the frames is known much better: rise_mm_s in bubble_summary.csv."
    )
    model = [Row(row) for row in smoothed.model_rows(results)]
    return [
        *table(head, smoothed.residual_rows(results)),
        *texts(smoothed.residual_words(results), small=True),
        *table(smoothed.WHITENESS_HEADS, smoothed.whiteness_rows(results), (3, 5)),
        *texts(smoothed.whiteness_words(results), small=True), white,
        *table(["sensor", "constant", "value ± sd"], constants, (2, 3)),
        *texts(own_depth if constants else "", small=True),
        *table(["bubble", "x", "y", "z"], means), *texts(of_means if means else "", small=True),
        *texts("Hyper-parameters: " + smoothed.model_words(results)),
        *table((), model),
    ]  # fmt: skip


def _paths(results: TrackResults) -> list[Block]:
    """Return the other coordinates, sizes and precision of a run that was not smoothed."""
    up = up_name(results.up)
    figures: list[Block] = [
        Figure(f"{axis} of the longest track",
               partial(plot.height, results.tracks, axis=axis, up=up), "Less a straight line.")
        for axis in AXES if axis != up[-1]
    ]  # fmt: skip
    by_track = results.tracks.groupby("particle")["d_eq_mm"].median().to_frame()
    caption = "Diameter of the sphere of the bubble's volume, the median of each track."
    if len(by_track) >= bubbles.LEAST_MANY:
        figures.append(Figure("Sizes", partial(plot.sizes, by_track), caption))
    return figures


def _ray_miss(results: TrackResults) -> Figure:
    sd = ray_miss_sd_mm(results)
    draw = partial(plot.ray_miss, results.tracks, sd, learnt_sd_mm(results) or 0.0)
    if len(results.cameras) > 2:
        caption = (
            "The RMS distance of a point from the rays of the cameras that see it; more than the "
            "outlines' noise predicts is shake, shape or wrong groups."
        )
    elif sd is None:
        caption = "There are too few points to say what the outlines' noise predicts."
    else:
        caption = (
            "Black: what the outlines' noise predicts. A shift against it is a biased "
            "calibration, more width is shake, shape or wrong pairs."
        )
    return Figure("Ray miss", draw, caption, 2.9, grid=False)


def _rays(results: TrackResults, *, beside: bool) -> list[Block]:
    """Return how the rays of a bubble agree; beside : with the histogram."""
    place = results.height_mm
    miss = results.tracks["ray_miss_mm"].to_numpy(float)
    good = np.isfinite(place) & np.isfinite(miss)
    steps = miss_steps(place[good], 1e3 * miss[good])
    caption = (
        "The red line should lie on zero. A constant offset, a slope or a bow along it is the "
        "calibration error, not an effect of the bubbles."
    )
    if len(steps):
        _, strays, error = steps[int(np.argmax(np.abs(steps[:, 1])))]
        caption += f" It strays by up to {number(abs(strays), 2)} ± {number(error, 1)} µm."
    along = Figure("Ray miss against height", partial(plot.ray_miss_along, place, miss), caption,
                   2.9, grid=False)  # fmt: skip
    rows = [Row(pair) for pair in tracked.pair_rows(results)]
    covariance = results.file.covariance
    known = f"Covariances in tracks.csv are {covariance[:1].lower()}{covariance[1:]}"
    known = known if covariance else ""
    return [
        *([_ray_miss(results)] if beside else []), *([along] if len(results.cameras) == 2 else []),
        *texts(*results.pairs.words), *([Table(rows)] if rows else []), *texts(known, small=True),
    ]  # fmt: skip


def _images(results: TrackResults) -> list[Block]:
    counts = per_frame(results)
    empty, frames = int(np.sum(counts["both"] == 0)), len(counts["both"])
    caption = (
        "The black line should follow the second highest of the cameras' lines: what lies above it "
        f"has no partner or track. {number(empty)} of {number(frames)} frames have no bubble in "
        "space."
    )
    figures: list[Block] = []
    if len(results.outlines):
        figures.append(
            Figure("Bubbles per frame", partial(plot.bubbles_in_frames, counts), caption)
        )
    for i, camera in enumerate(results.cameras):
        mine = results.outlines[results.outlines["camera"] == camera]
        alone, size = int(mine["particle"].isna().sum()), results.image_sizes_px.get(camera)
        caption = (
            f"{number(len(mine))} bubbles; red dots: {number(alone)} ({share(alone, len(mine))}) "
            "in no track, which should not gather anywhere but at the border."
        )
        draw = partial(plot.coverage, results.outlines, camera, size, colour=camera_colour(i))
        height = image_height_in(size) if size else 3.6
        if len(mine):
            figures.append(Figure(f"Bubbles in the image, camera {camera}", draw, caption, height,
                                  grid=False))  # fmt: skip
        if results.marked(i):
            draw = partial(plot.marks, results.references, camera, size, colour=camera_colour(i))
            title = f"Marks fixed to the tank, {camera}"
            figures.append(Figure(title, draw, tracked.marks_words(results, camera)))
    return [*figures, *table(["", *results.cameras], tracked.flag_rows(results))]


def _frames(results: TrackResults, page_folder: Path) -> list[Block]:
    rows = tracked.doubtful_rows(results, page_folder)
    words = (
        "The pictures (overlays/) have green outlines in a track, orange ones in none; red circles "
        "were rejected, for the reason whose number stands under the picture. telerig view shows "
        "every frame."
    )
    return [*table(["picture", "why"], rows, (99, 99)), *texts(words if rows else "", small=True)]


def _events(results: TrackResults) -> list[Block]:
    rows = tracked.event_rows(results)
    words = tracked.event_words(results)
    return [*texts(words), *table(["frame", "t, s", "what", "bubbles", "why"], rows, (0, 2))]


def _more(results: TrackResults) -> list[Block]:
    extra = {k: v for k, v in results.content.items() if k not in _SHOWN}
    notes = texts(*results.file.notes, points=True)
    return [*notes, *pairs(extra, "tracking.json")]
