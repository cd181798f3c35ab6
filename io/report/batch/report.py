"""The report of a batch: what was done, what failed and why, how good the results are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from telerig.io.files.atomic import write_text_atomic
from telerig.io.report import plot
from telerig.io.report.page.figures import Figure
from telerig.io.report.page.page import (
    Block,
    Choice,
    Page,
    Row,
    Section,
    Tile,
    Tiles,
    Verdict,
    link_to,
    render_page,
    table,
    texts,
)
from telerig.io.report.plot.axes import colour_of
from telerig.io.results.batch import (
    has_failed,
    listed,
    short_names,
    verdict_and_flags,
    verdict_counts,
    verdict_of,
)
from telerig.io.results.folders.batch import BatchResults, read_batch_results
from telerig.io.results.smoothing import Verdict as Resolved
from telerig.short_text import ABSENT, counted, is_number, number

Job = Mapping[str, Any]

KINDS = {"calibrate": "calibrated", "track": "tracked", "smooth": "smoothed"}
_DONE = "done"
TERMS = ("Lens model", "Verdict", "Covariance, standard deviation (sd)", "RMS")
_LONGEST_WORDS = 600
_LEFT_OUT, _MOST_LOST = "left out", 4


def write_batch_report(
    folder: Path, out: Path | None = None, *, page_folder: Path | None = None
) -> Path:
    """Write report.html beside batch.json, or into ``out``; InputError where there is no batch.

    page_folder : where the page will lie in the end, if its place is temporary.
    """
    place = Path(folder) if out is None else Path(out)
    page = page_of(read_batch_results(Path(folder)), page_folder or place)
    write_text_atomic(place / "report.html", render_page(page))
    return place / "report.html"


def page_of(results: BatchResults, folder: Path) -> Page:
    """Return what the page says.

    folder : where it will lie, for the links.
    """
    jobs = results.jobs
    names = short_names(str(j["dataset"]) for j in jobs)
    failed = [j for j in jobs if has_failed(j)]
    runs = {(j["dataset"], j["run"]) for j in jobs if j["run"]}
    lost = {(j["dataset"], j["run"]) for j in failed if j["run"]}
    datasets = len({j["dataset"] for j in jobs})
    words = f"{len(runs) - len(lost)} of {len(runs)} runs done" if runs else "No runs"
    lines: dict[tuple[str, str], dict[str, Job]] = {}
    for job in jobs:
        if job["run"]:
            lines.setdefault((job["dataset"], job["run"]), {})[job["kind"]] = job
    rows = [_run(f"{names[dataset]} / {run}", run, kinds, folder)
            for (dataset, run), kinds in lines.items()]  # fmt: skip
    calibrations = [_calibration(j, folder, names) for j in jobs if j["kind"] == "calibrate"]
    heads = ["dataset", "verdict", "lens model", "views", "dots kept", "RMS / px"]
    of_runs = ["run", "verdict", "frames", "tracks", "positions", "sd / µm"]
    sd = "The sd is of the smoothed positions, median over each run, along x, y and z."
    failures = [_failure(j) for j in failed]
    headline = f"{words}, {counted(datasets, 'dataset')}"
    own = _lost(failed, names)
    verdict = Verdict(headline, _colour(jobs), (_words(jobs),), (f"Failed: {own}.",) if own else ())
    return Page(
        "telerig report of a batch", "Batch", results.name, verdict,
        sections=[
            Section("key", "", [Tiles(tuple(_key_numbers(jobs)))]),
            Section("failures", "What failed",
                    table(["where", "job", "why, and what to do"], failures, (98, 99))),
            Section("bubbles", "Bubbles", _of_bubbles(results, names), open=True),
            Section("calibrations", "Calibrations", table(heads, calibrations, (2, 99))),
            Section("runs", "Runs", [*table(of_runs, rows, (2, 99)), *texts(sd if rows else "")]),
        ],
        terms=TERMS,
    )  # fmt: skip


SOUND = ("GOOD", "RESOLVED")
"""The verdicts that need no second look."""


def _colour(jobs: Sequence[Job]) -> str:
    failed = [j for j in jobs if has_failed(j)]
    if jobs and len(failed) == len(jobs):
        return "rejected"
    return "good" if not failed and set(verdict_counts(jobs)) <= set(SOUND) else "usable"


def _words(jobs: Sequence[Job]) -> str:
    """Return what the page says first: whether jobs failed, and what the verdicts are."""
    words = []
    if any(map(has_failed, jobs)):
        words.append(
            "What failed, and what to do, is listed below; the same command tries it again and "
            "leaves the rest."
        )
    else:
        words.append("No job failed.")
    for kind, subject in (("calibrate", "calibration"), ("smooth", "smoothed run")):
        counts = verdict_counts(j for j in jobs if j["kind"] == kind)
        if counts:
            of = counted(sum(counts.values()), subject)
            words.append(f"Verdicts of {of}: {listed(counts)}.")
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


def _of_bubbles(results: BatchResults, names: Mapping[str, str]) -> list[Block]:
    """Return the bubbles of all runs beside published laws, with boxes to choose runs."""
    bubbles = results.bubbles
    if not len(bubbles):
        return []
    whose = bubbles["dataset"].map(lambda place: names.get(place, place)) + " / " + bubbles["run"]
    every, liquid = bubbles.assign(whose=whose), results.file.fluid or None
    drawings = (
        ("Speed against diameter", partial(plot.speed, every, liquid, by="whose"),
         "Mean speed along the path against the diameter"
         + (", and laws of the rise velocity." if liquid else ". For laws of the rise velocity and "
            "for drag, describe the liquid under [fluid] in rig.toml, and run the batch again.")),
        ("Drag against Reynolds number", partial(plot.drag, every, liquid, by="whose"),
         "The laws are for bubbles of these sizes that rise steadily."),
        ("Aspect ratio against Weber number", partial(plot.aspect, every, by="whose"),
         "Equatorial over polar semi-axis, and Moore's law for pure liquids."),
    )  # fmt: skip
    labels = pd.factorize(whose)[1]
    groups = tuple((k, str(label), colour_of(k)) for k, label in enumerate(labels))
    lead = (
        f"{counted(len(bubbles), 'bubble')} of {counted(len(labels), 'run')}, each in the mean "
        "with one standard deviation; all numbers are in bubbles.csv."
    )
    figures = [Figure(title, draw, words, 3.8, inline=True) for title, draw, words in drawings]
    return [*texts(lead, small=True), *([Choice(groups)] if len(groups) > 1 else []), *figures]


def _key_numbers(jobs: Sequence[Job]) -> list[Tile]:
    figures = []
    for kind, word in KINDS.items():
        mine = [j for j in jobs if j["kind"] == kind]
        if mine:
            counts = Counter(j["status"] for j in mine)
            rest = {s: n for s, n in counts.items() if s != _DONE} | verdict_counts(mine)
            remark = listed(rest) or "none failed"
            figures.append(Tile(word, f"{counts[_DONE]} of {len(mine)}", remark))
    seconds = [float(j["seconds"]) for j in jobs if is_number(j.get("seconds"))]
    if seconds:
        hosts = len({j.get("host") for j in jobs if j.get("host")})
        machines = f", {hosts} machine" + ("s" if hosts > 1 else "") if hosts else ""
        remark = f"longest job {max(seconds):.0f} s{machines}"
        figures.append(Tile("work", f"{sum(seconds) / 60:.3g} min", remark))
    return figures


def _failure(job: Job) -> Row:
    run = f", run {job['run']}" if job["run"] else ""
    words = str(job["words"]).strip()[:_LONGEST_WORDS]
    return Row((f"{job['dataset']}{run}", f"{job['kind']} {job['status']}", words))


def _calibration(job: Job, folder: Path, names: Mapping[str, str]) -> Row:
    found = job.get("figures") or {}
    share: Any = found.get("share_kept")
    status = str(job["status"])
    cells = (
        names[job["dataset"]],
        ", ".join(filter(None, (verdict_and_flags(job), "" if status == _DONE else status))),
        str(found.get("lens_model") or ABSENT),
        str(found.get("views") or ABSENT),
        f"{100 * share:.1f}%" if is_number(share) else ABSENT,
        _text(found.get("rms_px")),
    )
    return Row(cells, faint=has_failed(job), link=_link(job, folder, "calibration"))


def _run(name: str, run: str, kinds: Mapping[str, Job], folder: Path) -> Row:
    tracked, smoothed = (kinds.get(k, {}).get("figures") or {} for k in ("track", "smooth"))
    failed = [j for j in kinds.values() if has_failed(j)]
    verdict = verdict_and_flags(kinds.get("smooth", {})) or (
        f"{failed[0]['kind']} {failed[0]['status']}" if failed else ABSENT
    )
    sd = [smoothed.get(f"s{x}_um") for x in "xyz"]
    cells = (
        name,
        verdict,
        _text(tracked.get("frames")),
        _text(tracked.get("tracks")),
        _text(tracked.get("points")),
        ", ".join(map(_text, sd)) if any(map(is_number, sd)) else ABSENT,
    )
    link = _link(next(iter(kinds.values())), folder, run)
    off = bool(failed) or verdict_of(kinds.get("smooth", {})) == Resolved.CONTRADICTED
    return Row(cells, faint=off, link=link)


def _text(value: Any) -> str:
    return number(value) if is_number(value) else ABSENT


def _link(job: Job, folder: Path, results: str) -> str:
    """Return the link from the batch's page to a report."""
    target = Path(job["dataset"]) / "results" / results / "report.html"
    return link_to(target, folder) if target.is_file() else ""
