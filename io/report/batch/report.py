"""The report of a batch: what was done, what failed and why, how good the results are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from telerig.errors import InputError
from telerig.io.files.atomic import write_text_atomic
from telerig.io.report import plot
from telerig.io.report.page.figures import (
    CAMERA_COLOURS,
    LEFT_OUT,
    Curve,
    Picture,
    draw_curves,
    drawing,
    svg_text,
)
from telerig.io.report.page.page import Figure, Row, drawn_over_cores, link_to, render_page
from telerig.io.report.plot.axes import colour_of
from telerig.io.results.batch import (
    BatchFile,
    short_names,
    verdict_and_flags,
    verdict_counts,
    verdict_of,
)
from telerig.io.results.manifest import reading
from telerig.io.results.smoothing import Verdict
from telerig.io.tables.smoothing import BATCH_BUBBLES
from telerig.short_text import ABSENT, counted, is_number, number

Job = Mapping[str, Any]

KINDS = {"calibrate": "calibrated", "track": "tracked", "smooth": "smoothed"}
_DONE = "done"
_COLOUR = {"calibrate": CAMERA_COLOURS[0], "track": CAMERA_COLOURS[1], "smooth": CAMERA_COLOURS[2]}
_LONGEST_WORDS = 600
_LEFT_OUT, _MOST_LOST = "left out", 4


@dataclass(frozen=True)
class Line:
    """A dataset's calibration or a run: cells for the page, with links to the reports."""

    name: str
    link: str
    cells: tuple[str, ...]
    failed: bool


def write_batch_report(folder: Path, out: Path | None = None) -> Path:
    """Write report.html beside batch.json, or into ``out``; InputError where there is no batch."""
    bubbles = pd.DataFrame()
    with reading(Path(folder), ["batch.json", "bubbles.csv"]):
        file = BatchFile.read(Path(folder) / "batch.json")
        if (Path(folder) / "bubbles.csv").is_file():
            bubbles = BATCH_BUBBLES.read(Path(folder) / "bubbles.csv")
    jobs = [job.content() for job in file.jobs]
    name = file.name or Path(folder).resolve().name
    place = Path(folder) if out is None else Path(out)
    write_text_atomic(place / "report.html", render(jobs, place, name, bubbles, file.fluid))
    return place / "report.html"


def render(
    jobs: Sequence[Job], folder: Path, name: str, bubbles: pd.DataFrame, fluid: Mapping[str, Any]
) -> str:
    """Return the page as text.

    folder : where it will lie, for the links. name : of the batch. bubbles, fluid : of all runs.
    """
    names = short_names(str(j["dataset"]) for j in jobs)
    failed = [j for j in jobs if j["status"] != _DONE]
    runs = {(j["dataset"], j["run"]) for j in jobs if j["run"]}
    lost = {(j["dataset"], j["run"]) for j in failed if j["run"]}
    datasets = len({j["dataset"] for j in jobs})
    words = f"{len(runs) - len(lost)} of {len(runs)} runs done" if runs else "No runs"
    drawn = _of_bubbles(bubbles, fluid, names)
    lines: dict[tuple[str, str], dict[str, Job]] = {}
    for job in jobs:
        if job["run"]:
            lines.setdefault((job["dataset"], job["run"]), {})[job["kind"]] = job
    context = {
        "name": name,
        "headline": f"{words}, {datasets} dataset" + ("s" if datasets != 1 else ""),
        "lost": _lost(failed, names),
        "colour": _colour(jobs),
        "words": _words(jobs),
        "figures": _key_numbers(jobs),
        "failures": [_failure(j) for j in failed],
        "calibrations": [_calibration(j, folder, names) for j in jobs if j["kind"] == "calibrate"],
        "runs": [
            _run(f"{names[dataset]} / {run}", run, kinds, folder)
            for (dataset, run), kinds in lines.items()
        ],
        "pictures": [p for p in drawn_over_cores(_drawings(jobs)) if p is not None],
        "bubbles": drawn,
    }
    return render_page("template_batch.html", context, "")


SOUND = ("GOOD", "RESOLVED")
"""The verdicts that need no second look."""


def _colour(jobs: Sequence[Job]) -> str:
    failed = [j for j in jobs if j["status"] != _DONE]
    if jobs and len(failed) == len(jobs):
        return "rejected"
    return "good" if not failed and set(verdict_counts(jobs)) <= set(SOUND) else "usable"


def _words(jobs: Sequence[Job]) -> str:
    """Return what the page says first: whether jobs failed, and what the verdicts are."""
    words = []
    if any(j["status"] != _DONE for j in jobs):
        words.append(
            "What failed, and what to do, is listed below; the same command tries it again and "
            "leaves the rest."
        )
    else:
        words.append("Every job was done.")
    for kind, subject in (("calibrate", "calibration"), ("smooth", "smoothed run")):
        counts = verdict_counts(j for j in jobs if j["kind"] == kind)
        if counts:
            listed = ", ".join(f"{n} {word}" for word, n in counts.items())
            words.append(f"Verdicts of {counted(sum(counts.values()), subject)}: {listed}.")
    unclear = verdict_counts(j for j in jobs if j["kind"] == "smooth").keys() - set(SOUND)
    if unclear:
        words.append(
            "Where a run is not RESOLVED, its paths may still contain shake of the rig: its report "
            "says how much, and what to add to the rig."
        )
    return " ".join(words)


def _lost(failed: Sequence[Job], names: Mapping[str, str]) -> str:
    """Return which jobs failed by themselves, for the headline; "" if none did."""
    own = [j for j in failed if j["status"] != _LEFT_OUT]
    words = [f"{j['kind']} {names[j['dataset']]}" + (j["run"] and f" / {j['run']}") for j in own]
    more = len(words) - _MOST_LOST
    return "; ".join(words[:_MOST_LOST]) + (f"; and {more} more" if more > 0 else "")


@dataclass(frozen=True)
class BubblePictures:
    """What all runs say of bubbles: drawings as SVG, each with a caption, and the runs' colours."""

    count: int
    pictures: tuple[tuple[str, str, str], ...]
    runs: tuple[tuple[int, str, str], ...]


def _of_bubbles(
    bubbles: pd.DataFrame, fluid: Mapping[str, Any], names: Mapping[str, str]
) -> BubblePictures | None:
    """Return pictures of the bubbles of all runs, beside published laws; None without bubbles."""
    if not len(bubbles):
        return None
    whose = bubbles["dataset"].map(lambda place: names.get(place, place)) + " / " + bubbles["run"]
    table, liquid = bubbles.assign(whose=whose), fluid or None
    drawings = (
        ("Speed against diameter", partial(plot.velocity, table, liquid, by="whose"),
         "Mean speed along the path against the diameter, and laws of the rise velocity."),
        ("Drag against Reynolds number", partial(plot.drag, table, liquid, by="whose"),
         "The laws are for bubbles of these sizes that rise steadily."),
        ("Aspect ratio against Weber number", partial(plot.aspect, table, by="whose"),
         "Equatorial over polar semi-axis, and Moore's law for pure liquids."),
    )  # fmt: skip
    pictures = []
    for title, draw, caption in drawings:
        try:
            with drawing(3.2, grid=True) as sheet:
                draw(axes=sheet.axes)
                lines = [line for line in sheet.axes.get_lines() if line.get_gid() is None]
                known = [line for line in lines if not str(line.get_label()).startswith("_")]
                sheet.axes.legend(handles=known, loc="best")
        except InputError:  # no bubble of which these numbers are known
            continue
        pictures.append((title, svg_text(sheet.source), caption))
    labels = pd.factorize(whose)[1]
    runs = tuple((k, str(label), colour_of(k)) for k, label in enumerate(labels))
    return BubblePictures(len(bubbles), tuple(pictures), runs)


def _key_numbers(jobs: Sequence[Job]) -> list[Figure]:
    figures = []
    for kind, word in KINDS.items():
        mine = [j for j in jobs if j["kind"] == kind]
        if mine:
            counts = Counter(j["status"] for j in mine)
            rest = {s: n for s, n in counts.items() if s != _DONE} | verdict_counts(mine)
            remark = ", ".join(f"{n} {s}" for s, n in rest.items())
            figures.append(Figure(word, f"{counts[_DONE]} of {len(mine)}", remark or "none failed"))
    seconds = [float(j["seconds"]) for j in jobs if is_number(j.get("seconds"))]
    if seconds:
        hosts = len({j.get("host") for j in jobs if j.get("host")})
        machines = f", {hosts} machine" + ("s" if hosts > 1 else "") if hosts else ""
        remark = f"longest job {max(seconds):.0f} s{machines}"
        figures.append(Figure("work", f"{sum(seconds) / 60:.3g} min", remark))
    return figures


def _failure(job: Job) -> Row:
    run = f", run {job['run']}" if job["run"] else ""
    words = str(job["words"]).strip()[:_LONGEST_WORDS]
    return Row((f"{job['dataset']}{run}", f"{job['kind']} {job['status']}", words))


def _calibration(job: Job, folder: Path, names: Mapping[str, str]) -> Line:
    found = job.get("figures") or {}
    share: Any = found.get("share_kept")
    cells = (
        verdict_and_flags(job) or str(job["status"]),
        str(found.get("lens_model") or ABSENT),
        str(found.get("views") or ABSENT),
        f"{100 * share:.1f}%" if is_number(share) else ABSENT,
        _text(found.get("rms_px")),
    )
    link = _link(job, folder, "calibration")
    return Line(names[job["dataset"]], link, cells, job["status"] != _DONE)


def _run(name: str, run: str, kinds: Mapping[str, Job], folder: Path) -> Line:
    tracked, smoothed = (kinds.get(k, {}).get("figures") or {} for k in ("track", "smooth"))
    failed = [j for j in kinds.values() if j["status"] != _DONE]
    verdict = verdict_and_flags(kinds.get("smooth", {})) or (
        f"{failed[0]['kind']} {failed[0]['status']}" if failed else ABSENT
    )
    sd = [smoothed.get(f"s{x}_um") for x in "xyz"]
    cells = (
        verdict,
        _text(tracked.get("frames")),
        _text(tracked.get("tracks")),
        _text(tracked.get("points")),
        ", ".join(map(_text, sd)) if any(map(is_number, sd)) else ABSENT,
    )
    link = _link(next(iter(kinds.values())), folder, run)
    off = bool(failed) or verdict_of(kinds.get("smooth", {})) == Verdict.CONTRADICTED
    return Line(name, link, cells, off)


def _text(value: Any) -> str:
    return number(value) if is_number(value) else ABSENT


def _link(job: Job, folder: Path, results: str) -> str:
    """Return the link from the batch's page to a report."""
    target = Path(job["dataset"]) / "results" / results / "report.html"
    return link_to(target, folder) if target.is_file() else ""


def _drawings(jobs: Sequence[Job]) -> list[Callable[[], Picture | None]]:
    return [
        partial(_values, jobs, "calibrate", ("rms_px",), "Calibrations", "residual RMS / px",
                "One point a dataset: a rig that was touched, or a bad target, stands out."),
        partial(_values, jobs, "smooth", ("sx_um", "sy_um", "sz_um"), "Smoothed runs",
                "sd of position / µm", "Median of each run, in the order of the batch: x, y, z."),
        partial(_times, jobs),
    ]  # fmt: skip


def _values(
    jobs: Sequence[Job], kind: str, names: Sequence[str], title: str, label: str, caption: str
) -> Picture | None:
    mine = [j for j in jobs if j["kind"] == kind]
    values = np.array([[_float((j.get("figures") or {}).get(n)) for n in names] for j in mine])
    if not np.isfinite(values).any():
        return None
    place = np.arange(1.0, len(mine) + 1)
    dots = {"marker": "o", "markersize": 3.5, "linestyle": "none"}
    curves = [
        Curve(place, values[:, i], CAMERA_COLOURS[i], name.split("_")[0], style=dots)
        for i, name in enumerate(names)
    ]
    none = place[~np.isfinite(values).any(1)]
    caption += " A red line: no result."
    return _by_job(title, "in the order of the batch", label, curves, caption, none)


def _times(jobs: Sequence[Job]) -> Picture | None:
    timed = [j for j in jobs if is_number(j.get("seconds"))]
    curves = []
    for kind, colour in _COLOUR.items():
        seconds = np.array([float(j["seconds"]) for j in timed if j["kind"] == kind])
        dots = {"marker": "o", "markersize": 3.5, "linestyle": "none"}
        curves.append(Curve(np.arange(1.0, len(seconds) + 1), seconds, colour, kind, style=dots))
    caption = "Wall time of every job, of those taken from the journal too."
    return _by_job("Time", "job", "time / s", curves, caption) if timed else None


def _by_job(
    title: str, xlabel: str, ylabel: str, curves: Sequence[Curve], caption: str, none: Any = ()
) -> Picture:
    """Return the points from zero over whole numbers of jobs. none : jobs without a result."""
    from matplotlib.ticker import MaxNLocator

    legend = "above" if len(curves) > 1 else ""
    with drawing(2.4, legend=legend, grid=True, xlabel=xlabel, ylabel=ylabel) as sheet:
        draw_curves(sheet, curves)
        for job in none:
            sheet.axes.axvline(job, color=LEFT_OUT, lw=0.8)
        sheet.axes.set_ylim(0, 1.1 * np.nanmax(np.concatenate([c.y for c in curves])))
        sheet.axes.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True, min_n_ticks=1))
    return Picture(title, sheet.source, caption)


def _float(value: Any) -> float:
    return float(value) if is_number(value) else float("nan")
