"""The report of a tracked run: one page that needs no network, made from a results folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from telerig.io.files.atomic import write_text_atomic
from telerig.io.report.page.contact_sheet import BUDGET_BYTES, picture_sheet
from telerig.io.report.page.page import drawn_over_cores, plotly_javascript, render_page
from telerig.io.report.run.smoothing.figures import PLACES, smoothing_drawings
from telerig.io.report.run.smoothing.tables import smoothing_words
from telerig.io.report.run.tracking import tables as tables
from telerig.io.report.run.tracking.figures import (
    bubbles_in_time,
    confidence,
    marks_followed,
    predicted_sd,
    ray_miss_histogram,
    ray_miss_in_space,
    seen_where,
    shared_pictures,
    sizes,
    time_series,
)
from telerig.io.report.run.tracking.scene import scene_widening, track_plans, track_scene_json
from telerig.io.report.run.tracking.two_rays import two_rays
from telerig.io.results.folders.smoothing import SmoothingResults, read_smoothing_results
from telerig.io.results.folders.tracking import (
    TrackResults,
    binary_column,
    read_track_results,
    run_cameras,
)
from telerig.io.results.manifest import reading
from telerig.io.results.stale import stale
from telerig.rig.camera import Camera
from telerig.short_text import flat_rows

PAGE_BYTES = 4_600_000
"""Of all that is large; words and tables come on top."""

_SMALL_WIDTH_PX = 560
_BASE64 = 1.34
_MOST_ROWS = 150
_SHOWN = {"schema", "kind", "run", "notes", "worst_frames", "pairs", "covariance", "events",
          "rig_change", "warnings"}  # fmt: skip


def write_track_report(
    results_folder: Path, out: Path | None = None, *, page_folder: Path | None = None
) -> Path:
    """Write report.html into a tracked run's results folder, or into ``out``; returns its path.

    It reads nothing but that folder, and the calibration beside it (`results_cameras`) for the
    drawing of two rays: tracking.json and tracks.csv, and if they are there
    detections.csv, events.csv, references.csv, run.json, overlays/<camera>/<frame>.jpg and
    binary/<camera>/<frame>.png. Where smoothing.json is there, with trajectories.csv and shake.csv,
    the page begins with the smoothing. It is written whole or not at all. page_folder : where the
    page will lie in the end, if ``out`` is temporary. Raises InputError for a
    folder that holds no tracks, or files that cannot be read or do not fit together.
    """
    folder = Path(results_folder)
    with reading(folder, ()):
        tracks = read_track_results(folder)
        rig = run_cameras(folder, tracks)
        smoothing = read_smoothing_results(folder, tracks.up)
        page = render(tracks, smoothing, rig, stale(folder), page_folder or out)
    file = (folder if out is None else Path(out)) / "report.html"
    write_text_atomic(file, page)
    return file


def render(
    results: TrackResults,
    smoothing: SmoothingResults | None = None,
    rig: tuple[tuple[Camera, ...] | None, str] = (None, ""),
    outdated: Sequence[str] = (),
    page_folder: Path | None = None,
) -> str:
    """Return the report of a run as the text of an HTML page.

    results : of the tracking.
    smoothing : None for a page without it.
    rig : the cameras and "", or None and the reason why they are not known.
    outdated : the results that are older than their inputs, in words, from `stale`.
    page_folder : where the page will lie; None for the results folder.
    """
    in_space = _in_space(results, smoothing)
    scene = track_scene_json(in_space)
    context = _words(results) | _pictures(results, smoothing, rig[0])
    context["plans"] = track_plans(in_space)
    context |= {"stale": outdated, "no_rays": rig[1], "in_lab": in_space is not results}
    context["widened"] = scene_widening(in_space)
    if smoothing is not None:
        context["smoothing"] = smoothing_words(smoothing, results)
    drawn = [p.source for group in context.values() for p in _list(group) if hasattr(p, "source")]
    left = PAGE_BYTES - len(plotly_javascript()) - len(scene) - sum(map(len, drawn))
    columns = [column for c in results.cameras for column in (c, binary_column(c))]
    rows = list(tables.worst_words(results)) if results.pictures else []
    context["sheet"] = picture_sheet(
        rows, columns, results.pictures, small_width_px=_SMALL_WIDTH_PX,
        budget_bytes=min(BUDGET_BYTES, max(0, int(left / _BASE64))), page_folder=page_folder,
    )  # fmt: skip
    return render_page("template_track.html", context, scene)


def _in_space(results: TrackResults, smoothing: SmoothingResults | None) -> TrackResults:
    """Return what the scene shows: smoothed paths in the laboratory, or else the tracks."""
    if smoothing is None or not len(smoothing.trajectories):
        return results
    return replace(results, tracks=smoothing.trajectories)


def _list(group: Any) -> list[Any]:
    return group if isinstance(group, list) else []


def _words(results: TrackResults) -> dict[str, Any]:
    content = results.content
    return {
        "name": results.file.run or "run",
        "verdict": tables.verdict(results),
        "figures": tables.key_numbers(results),
        "cameras": list(results.cameras),
        "pairs_rows": tables.pair_rows(results),
        "pair_words": list(results.pairs.words),
        "flags": tables.flag_rows(results),
        "events": tables.event_rows(results),
        "event_words": tables.event_words(results),
        "notes": list(results.file.notes),
        "covariance": results.file.covariance,
        "extra": _rows({k: v for k, v in content.items() if k not in _SHOWN}, "tracking.json"),
        "run": _rows(results.run, "run.json"),
        "absent": results.absent,
        "worst": tables.worst_words(results),
        "doubtful": any(frame.why for frame in results.file.worst_frames),
    }


def _rows(content: Mapping[str, Any], file: str) -> list[tuple[str, str]]:
    """Return the leaves of a mapping as rows, cut after `_MOST_ROWS`."""
    rows = list(flat_rows(content))
    more = len(rows) - _MOST_ROWS
    return rows if more <= 0 else [*rows[:_MOST_ROWS], ("and", f"{more} more in {file}")]


def _pictures(
    results: TrackResults,
    smoothing: SmoothingResults | None,
    cameras: tuple[Camera, ...] | None,
) -> dict[str, Any]:
    every = range(len(results.cameras))
    drawings: list[tuple[str, Callable[[], Any]]] = [
        *(("seen", partial(seen_where, results, i)) for i in every),
        *(("marks", partial(marks_followed, results, i)) for i in every if results.marked(i)),
        ("rays" if smoothing is not None else "first", partial(ray_miss_histogram, results)),
        *(("rays", partial(ray_miss_in_space, results, *how)) for how in shared_pictures(results)),
        ("counts", partial(bubbles_in_time, results)),
        ("quality", partial(predicted_sd, results)),
        ("quality", partial(sizes, results)),
        ("quality", partial(confidence, results)),
    ]
    if smoothing is None:  # else the same is drawn in the laboratory
        up = int(np.argmax(np.abs(results.up)))
        drawings += [("first" if axis == up else "series", partial(time_series, results, axis))
                     for axis in range(3)]  # fmt: skip
    pictures: dict[str, Any] = {
        place: [] for place in (*dict(drawings), "marks", "rays", "series", *PLACES)
    }
    if cameras is not None:
        drawings.append(("rays", partial(two_rays, results, cameras)))
    if smoothing is not None:
        drawings += smoothing_drawings(smoothing)
    for (place, _), picture in zip(drawings, drawn_over_cores([d for _, d in drawings])):
        found = picture if isinstance(picture, list) else [picture]
        pictures[place] += [p for p in found if p is not None]
    return pictures
