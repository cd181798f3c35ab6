"""Write the results folder of a tracked run while it is being tracked."""

from __future__ import annotations

import heapq
import shlex
import shutil
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from telerig.errors import InputError
from telerig.estimator.bubbles.detect import outline_points
from telerig.estimator.bubbles.outline.blobs import Rejected
from telerig.estimator.tracking.detect_run import (
    CORRECTIONS,
    DetectionStore,
    Progress,
    joined,
    mask_files,
)
from telerig.estimator.tracking.linking.frames_to_rows import Linked
from telerig.estimator.tracking.track import (
    TrackingStream,
    TrackOptions,
    ids_of,
    numbers_of,
    tracking_stream,
)
from telerig.estimator.tracking.tracks import events_table
from telerig.io.files.atomic import rename, write_json_atomic
from telerig.io.files.csv_table import write_table
from telerig.io.files.frame_table import FrameTable
from telerig.io.machine.parallel import ordered_map, quick_workers
from telerig.io.results.inputs import Source, fingerprints, relative
from telerig.io.results.manifest import replaced_results
from telerig.io.results.record import run_record
from telerig.io.results.stale import stale
from telerig.io.results.tracking import TrackingFile

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.io.dataset.run import RunData

WORK = ".work"
"""Folder inside the results with the rows before corrections."""
WORST_FRAMES, _SAMPLED = 8, 3
_DOUBTFUL = 0.05
"""A frame is doubtful if one of its detections has no partner or is merged, a pair is ambiguous, or
one in twenty such frames has a wrong pair."""
_OUTLINE_POINTS = 72
_TABLES = ("frames.csv", "run.toml", "stage.csv", "references.csv", CORRECTIONS)
_RIG_TABLES = ("cameras", "stage", "walls", "references", "tracking", "bubbles")
"""The tables of rig.toml on which tracking depends."""
_GREEN, _ORANGE = (40, 200, 70), (255, 140, 40)


@dataclass
class _Worst:
    """The frames that a person should look at first: doubtful ones, or some where none is.

    heap : score, frame (negative) and reason of doubtful frames. seen : frames with detections.
    """

    heap: list[tuple[float, int, str]] = field(default_factory=list)
    seen: list[int] = field(default_factory=list)

    def add(self, part: Linked) -> None:
        flags = part.tracks["flags"]
        columns = part.tracks.assign(
            uncertain=1 - part.tracks["confidence"], ambiguous=flags.str.contains("ambiguous")
        ).groupby("frame")[["uncertain", "ambiguous"]]
        sums = columns.sum()
        found = part.detections[np.isfinite(part.detections["u_px"].to_numpy(float))]
        unpaired = found["particle"].isna().groupby(found["frame"]).sum()
        merged = found["flags"].str.contains("merged").groupby(found["frame"]).sum()
        for frame in sorted(set(part.detections["frame"])):
            uncertain, ambiguous = sums.loc[frame] if frame in sums.index else (0.0, 0)
            parts = {
                "without partner or track": float(unpaired.get(frame, 0)),
                "merged": float(merged.get(frame, 0)),
                "ambiguous pairs": float(ambiguous),
            }
            why = ", ".join(f"{int(n)} {what}" for what, n in parts.items() if n)
            score = sum(parts.values()) + float(uncertain)
            self.seen.append(int(frame))
            if score < _DOUBTFUL:
                continue
            heapq.heappush(self.heap, (score, -int(frame), why or "least sure pairs"))
            if len(self.heap) > WORST_FRAMES:
                heapq.heappop(self.heap)

    def frames(self) -> list[dict[str, Any]]:
        ranked = sorted(self.heap, reverse=True)
        if not ranked and self.seen:
            some = np.linspace(0, len(self.seen) - 1, _SAMPLED).astype(int)
            ranked = [(0.0, -self.seen[k], "") for k in np.unique(some).tolist()]
        return [{"frame": -f, "score": round(s, 3), "why": why} for s, f, why in ranked]


def write_tracking(
    run: RunData,
    calibration: Calibration,
    folder: Path,
    *,
    options: TrackOptions,
    record: Mapping[str, Any],
    report: bool = True,
    stage: Progress | None = None,
    executor: Executor | None = None,
) -> dict[str, Any]:
    """Track a run, write the results into a folder, and return the content of tracking.json.

    Detections made before an interruption are read from ``.<folder>.work`` beside the folder. All
    files of results appear together at the end. What the tracks were made from stays in the folder
    (`WORK`); while nothing but corrections.csv changes, its rows are corrected and written anew.

    record : command, inputs, options and times for run.json; ``again``, the command line that makes
        the folder again.
    report : whether the HTML report is written.
    stage : function that is called with the name of the step, the number done and the total; or
        None.

    executor : see `tracking_stream`.

    Raises InputError if a report is wanted and the bubbles were given ids that are no whole
    numbers.
    """
    if report and run.detections is not None:
        _check_ids(run.detections)
    work, kept = folder.parent / f".{folder.name}.work", folder / WORK
    if kept.is_dir() and not work.is_dir():
        work = kept
    again = str(record.get("again") or f"telerig track {shlex.quote(str(run.path))}")
    inputs = fingerprints(folder, [*_sources(run), *record.get("inputs", [])])
    with replaced_results(folder, "track", again=again, inputs=inputs) as staged:
        stream = tracking_stream(run, calibration, work, options, stage, executor)
        worst = _write_rows(stream, staged)
        summary = stream.summary()
        summary["worst_frames"] = worst.frames()
        summary["warnings"] = [*_stale_inputs(record.get("inputs", [])), *summary["warnings"]]
        TrackingFile.of(summary, folder / "tracking.json").write(staged / "tracking.json")
        write_table(events_table(stream.events), staged / "events.csv")
        table = stream.marks.table if stream.marks is not None else None
        if table is not None:
            write_table(table, staged / "references.csv")
        stated = {
            **record.get("options", {}),
            "track": repr(options),
            "calibration": [relative(file, folder) for file in record.get("inputs", [])],
        }
        command, seconds = str(record.get("command", "track")), record.get("seconds", {})
        write_json_atomic(staged / "run.json", run_record(command, stated, seconds))
        if run.detections is None:
            _write_pictures(run, stream.store, summary, staged)
        if report:
            from telerig.io.report.run.report import write_track_report

            write_track_report(staged)
    for path in work.glob("detections-*.csv"):  # the rows have them
        path.unlink()
    if work != kept:
        shutil.rmtree(kept, ignore_errors=True)
        rename(work, kept)
    return summary


def _sources(run: RunData) -> list[Path | Source]:
    """Return the inputs, besides the calibration, whose change makes tracks stale."""
    rig = run.path.parent.parent / "rig.toml"
    images = Source(run.path, cameras=run.cameras)
    return [
        *([] if run.rig is None else [Source(rig, tables=_RIG_TABLES)]),
        *sorted(set(mask_files(run).values())),
        *(run.path / name for name in _TABLES),
        run.path / "detections.csv" if run.detections is not None else images,
    ]


def _stale_inputs(files: Sequence[Path]) -> list[str]:
    return [sentence for file in files for sentence in stale(file.parent, [file.name])]


def _check_ids(detections: pd.DataFrame | FrameTable) -> None:
    names = numbers_of(ids_of(detections))[1]
    if names:
        raise InputError(
            f"particle {names[0]!r} is no whole number below 1e15, which the report needs",
            where="detections.csv",
            todo="number the bubbles, or track with --no-report",
        )


def _write_rows(stream: TrackingStream, staged: Path) -> _Worst:
    worst, begun = _Worst(), False
    for part in stream.rows:
        for name, table in (("tracks", part.tracks), ("detections", part.detections)):
            with (staged / f"{name}.csv").open("a", encoding="utf-8", newline="") as file:
                table.to_csv(file, index=False, header=not begun, lineterminator="\n")
        begun = True
        worst.add(part)
    return worst


def _write_pictures(
    run: RunData, store: DetectionStore, summary: Mapping[str, Any], staged: Path
) -> None:
    """Write overlays of the worst frames, from the tables."""
    frames = [int(w["frame"]) for w in summary["worst_frames"]]
    written = pd.read_csv(
        staged / "detections.csv", dtype={"camera": str, "flags": str},
        chunksize=20_000, keep_default_na=False, na_values=[""],
    )  # fmt: skip
    found, rejected = _drawn(written, frames), _drawn(store.tables("rejected"), frames)
    tasks = [
        (c, f, *(t[(t["frame"] == f) & (t["camera"] == c)] for t in (found, rejected)))
        for f in frames
        for c in run.cameras
    ]
    for _ in ordered_map(partial(_draw, run, staged), tasks, quick_workers(len(tasks))):
        pass


def _drawn(tables: Iterable[pd.DataFrame], frames: Sequence[int]) -> pd.DataFrame:
    """Return the rows of tables that have a place in an image of these frames."""
    return joined(
        [t[t["frame"].isin(frames) & np.isfinite(t["u_px"].to_numpy(float))] for t in tables]
    )


def _draw(run: RunData, staged: Path, task: tuple[str, int, pd.DataFrame, pd.DataFrame]) -> None:
    from telerig.io.report.overlays import draw_bubble_overlay, write_picture

    camera, frame, found, rejected = task
    image = run.image(camera, frame)
    if image is None:
        return
    rows = [row for _, row in found.fillna({"flags": ""}).iterrows()]
    outlines = [outline_points(row, _OUTLINE_POINTS) for row in rows]
    named = ["" if pd.isna(row["particle"]) else f"{int(row['particle'])}" for row in rows]
    words = [f"{n} {row['flags']}".strip() for n, row in zip(named, rows)]
    colours = [_GREEN if n else _ORANGE for n in named]
    marks = [*rejected[[*Rejected._fields]].itertuples(index=False)]
    picture = draw_bubble_overlay(image, outlines, words, colours, rejected=marks)
    write_picture(picture, staged / "overlays" / camera / f"{frame:06d}.jpg")
