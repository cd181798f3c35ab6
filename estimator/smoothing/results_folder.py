"""A tracked run smoothed into its results folder."""

from __future__ import annotations

import shlex
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from telerig.command_options import SmoothingOptions
from telerig.errors import InputError
from telerig.estimator.calibration.refractive_windows import window_warnings
from telerig.estimator.calibration.result.calibration import of_run
from telerig.estimator.smoothing.results_file import StoredTables
from telerig.estimator.smoothing.smooth import smooth
from telerig.estimator.smoothing.unfinished import UnfinishedPieces
from telerig.estimator.tracking.tracks import StoredTracks, Tracks, open_track_table, open_tracks
from telerig.io.files.atomic import write_json_atomic
from telerig.io.results.inputs import Source, fingerprints
from telerig.io.results.manifest import reading, replaced_results
from telerig.io.results.record import RunFile, run_record
from telerig.io.results.stale import stale
from telerig.io.results.work_folder import work_key

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.estimator.smoothing.result import Smoothing
    from telerig.io.dataset.run import RunData

Stage = Callable[[str, float, int], None]
"""Called with the name of a step, the share that is done, and 1."""

DEFAULT = SmoothingOptions()
_RIG_TABLES = ("cameras", "stage", "walls", "references", "tracking", "accelerometers", "fluid")
"""The tables of rig.toml on which smoothing depends."""
_USED = ("tracks.csv", "detections.csv", "tracking.json")
"""The files of a tracked run on which smoothing depends."""
_TRACKED = ("tracks.csv", "detections.csv", "events.csv", "references.csv", "tracking.json")


def smooth_run(
    run: RunData,
    calibration: Calibration,
    tracks: Path,
    folder: Path,
    options: SmoothingOptions = DEFAULT,
    *,
    inputs: Sequence[Path] = (),
    report: bool = True,
    stage: Stage | None = None,
    again: str = "",
) -> Smoothing:
    """Smooth and write the files of `Smoothing.save`, run.json and the report.

    tracks : `tracks.csv`, or the folder that `telerig track` wrote.
    options : of `telerig smooth`.
    inputs : the files of the calibration.
    again : the command line that makes the files again; "" for `telerig smooth` of the run.

    Files appear together at the end. Raises InputError when there are no tracks, or not all of
    their cameras are in the calibration.
    """
    begun = time.perf_counter()
    followed, source = read_tracks(tracks, run.path)
    _check_tracks(followed, source, run, calibration)
    calibration = of_run(calibration, run.cameras)
    run, marks = with_followed_references(run, source.parent)
    of_tracks = [source.parent / name for name in _USED] if tracks.is_dir() else [source]
    used = [*of_tracks, *marks, *inputs]
    fingerprint = fingerprints(folder, [*run_sources(run), *used])
    tracked = RunFile.read_if_there(source.parent / "run.json")
    warnings = [
        *dict.fromkeys(s for file in used for s in stale(file.parent, [file.name])),
        *filter(None, [calibration.rejection]),
        *window_warnings(run.rig, calibration),
        *([] if options.refine_rig else _moved(followed)),
    ]
    again = again or f"telerig smooth {shlex.quote(str(run.path))}"
    kept = UnfinishedPieces(
        folder.parent / f".{folder.name}.smoothing", work_key(options.record(), fingerprint)
    )
    with replaced_results(folder, "smooth", again=again, inputs=fingerprint) as staged:
        found = smooth(
            followed, calibration, stage=run, progress=stage or False, folder=staged,
            unfinished=kept, **options.keywords,
        )  # fmt: skip
        found = replace(
            found, summary={**found.summary, "warnings": [*warnings, *found.summary["warnings"]]}
        )
        found.write_files(staged)
        seconds = {"smooth": time.perf_counter() - begun}
        record = run_record("smooth", options.record(), seconds)
        if tracked.content():
            record["tracks"] = tracked.tracks or tracked.content()
        write_json_atomic(staged / "run.json", record)
        if report:
            _report(staged, folder, source.parent)
    kept.end()
    if isinstance(found.tables, StoredTables):
        found = replace(found, tables=StoredTables(folder))
    return found


def run_sources(run: RunData) -> list[Path | Source]:
    """Return the inputs in the run's folder whose change makes its smoothing stale."""
    rig = run.path.parent.parent / "rig.toml"
    names = ("frames.csv", "run.toml", "stage.csv", "accelerometer.csv", "references.csv")
    return [
        *([] if run.rig is None else [Source(rig, tables=_RIG_TABLES)]),
        *(run.path / name for name in names),
    ]


def _check_tracks(
    tracks: Tracks | StoredTracks | Any, file: Path, run: RunData, calibration: Calibration
) -> None:
    """Raise InputError for tracks of another run, or of a camera that is not in the calibration."""
    summary = getattr(tracks, "summary", {})
    name = summary.get("run") or run.name
    if name != run.name and (run.path.parent / name).is_dir():  # the run was not renamed
        raise InputError(
            f"has the tracks of the run {name!r}, not of {run.name!r}",
            where=str(file),
            todo="name the tracks of this run with --tracks, or choose another --out",
        )
    used = list(summary.get("image_size_px") or [])
    have = [camera.name for camera in calibration.cameras]
    if set(used) - set(have):
        raise InputError(
            f"the run was tracked with cameras {', '.join(used)}, the calibration has "
            f"{', '.join(have)}",
            todo="give the calibration that the run was tracked with, or track again",
        )


def _moved(tracks: Tracks | StoredTracks | Any) -> list[str]:
    """Return a warning if tracking found a movement of the cameras."""
    summary = getattr(tracks, "summary", {})
    change, cameras = summary.get("rig_change") or {}, summary.get("image_size_px") or {}
    if not change.get("moved"):
        return []
    return [
        f"camera {change['camera']!r} had moved since the calibration with which the run was "
        f"tracked (by {1e3 * change['offset_mm']:+.0f} µm perpendicular to both optical axes), so "
        "all positions are wrong by this movement. Calibrate again and track again"
        + (", or smooth with --refine-rig" if len(cameras) == 2 or change.get("culprit") else "")
    ]


def read_tracks(path: Path, run: Path) -> tuple[Tracks | StoredTracks | Any, Path]:
    """Return the tracks of a results folder or of a single table, and their file."""
    if path.is_dir():
        if not (path / "tracks.csv").is_file():
            raise InputError(
                "there are no tracks", where=str(path), todo=f"run `telerig track {run}` first"
            )
        return open_tracks(path), path / "tracks.csv"
    if not path.is_file():
        raise InputError("there is no such file", where=str(path), todo="give tracks.csv")
    with reading(path.parent, [path.name]):
        return open_track_table(path), path


def with_followed_references(run: RunData, tracked: Path) -> tuple[RunData, list[Path]]:
    """The run with the marks that `telerig track` followed in its images, and their file; a run's
    own references.csv goes before them."""
    file = tracked / "references.csv"
    if run.references is not None or not file.is_file() or tracked.resolve() == run.path:
        return run, []
    from telerig.io.dataset.tables import read_references_csv

    sizes = dict(run.image_sizes_px)
    with reading(tracked, [file.name]):
        table = read_references_csv(file, list(run.cameras), sizes, run.frame_count)
    return replace(run, references=table), [file]


def _report(staged: Path, folder: Path, tracked: Path) -> None:
    """Write the run's page, which also needs the tracks."""
    from telerig.io.report.run.report import write_track_report

    borrowed = []
    for place in (folder, tracked):
        for name in (*_TRACKED, "overlays", "binary"):
            source, target = place / name, staged / name
            if source.exists() and not target.exists():
                copy = shutil.copytree if source.is_dir() else shutil.copy2
                copy(source, target)
                borrowed.append(target)
    if (staged / "tracking.json").is_file():
        write_track_report(staged)
    if folder.resolve() == tracked.resolve():
        for target in borrowed:
            shutil.rmtree(target) if target.is_dir() else target.unlink()
