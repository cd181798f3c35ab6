"""telerig track: from pairs of bubble images to 3-D tracks."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from telerig.errors import InputError
from telerig.scripts import options
from telerig.scripts.console import (
    errors_in_words,
    progress,
    run_file,
    say,
    say_written,
    typed_command,
)

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration


@errors_in_words()
def track(
    run: options.Run,
    calibration: options.CalibrationFiles = None,
    out: options.RunFolder = None,
    min_diameter: Annotated[
        float,
        typer.Option(help="Dark spots with a smaller diameter, in px, are not taken for bubbles."),
    ] = 8.0,
    source: Annotated[
        str | None,
        typer.Option("--from", help="Use images or detections; needed if the run has both."),
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(help="Track only the first frames, for a first look: 0:500 [all]."),
    ] = None,
    cluster: options.Cluster = None,
    report: options.Report = True,
    quiet: options.Quiet = False,
) -> None:
    """Find the bubbles of a run, match them across the views, and follow them in space.

    Writes detections.csv, tracks.csv, events.csv, tracking.json, run.json and report.html. The
    same command, given again, continues an interrupted run. With --cluster the workers detect the
    bubbles, in batches of frames; they must see the run and the results at the same paths. When
    only corrections.csv has changed, the detection is not repeated.

    Exit code 0: tracked. 2: the input cannot be used; the message says what, where and what to do.
    130: interrupted.
    """
    from telerig.estimator.batch.jobs import check_run_name
    from telerig.estimator.tracking.tracks import tracking_words

    begun = time.perf_counter()
    if out is None:
        check_run_name(run)
    recorded = {"from": source, "min_diameter_px": min_diameter, "frames": frames}
    folder = out or default_folder(run)
    summary, steps = track_run(
        run, folder, calibration, recorded,
        again=typed_command(), cluster=cluster, report=report, quiet=quiet,
    )  # fmt: skip
    say(tracking_words(summary, time.perf_counter() - begun, steps))
    say_written(folder, report)


def track_run(
    run: Path,
    folder: Path,
    calibration: Sequence[Path] | None,
    recorded: Mapping[str, Any],
    *,
    again: str,
    cluster: str | None = None,
    report: bool = True,
    quiet: bool = False,
) -> tuple[dict[str, Any], str]:
    """Track a run and write the results into ``folder``.

    Returns the content of tracking.json, and how long the steps took in words.
    recorded : the options "from", "min_diameter_px" and "frames" as run.json holds them; those
        that it lacks have their defaults.
    again : the command line that makes the folder again.
    """
    from telerig.estimator.batch.batch import dask_executor
    from telerig.estimator.calibration.result.calibration import calibration_for
    from telerig.estimator.tracking.results_folder import write_tracking
    from telerig.estimator.tracking.track import TrackOptions
    from telerig.io.dataset.run import load_run

    if cluster is not None:
        run, folder = run.resolve(), folder.resolve()
    calibrated, files = calibration_for(run, calibration)
    chosen = options.chosen("--from", recorded.get("from"), ("images", "detections"))
    frames = recorded.get("frames")
    count = None if frames is None else first_frames(frames)
    record = {"command": "track", "options": dict(recorded), "inputs": files, "again": again}
    settings = TrackOptions(recorded.get("min_diameter_px", TrackOptions.min_diameter_px))
    chosen_cluster = nullcontext() if cluster is None else dask_executor(cluster, "--cluster")
    with chosen_cluster as executor, progress(quiet) as stage:
        stage("reading the run", 0, 1)
        data = load_run(run, source=chosen, **cameras_without_rig(run, calibrated))
        if count is not None:
            data = data.first(count)
        summary = write_tracking(
            data, calibrated, folder, options=settings, record=record, report=report, stage=stage,
            executor=executor,
        )  # fmt: skip
    return summary, stage.words()


def first_frames(text: str) -> int:
    """Return the number N of frames for the text 0:N. Raises InputError for any other text."""
    first, colon, stop = text.partition(":")
    if not colon or first not in ("", "0") or not (stop.isascii() and stop.isdecimal()):
        raise InputError(
            f"{text!r} does not name the first frames of a run",
            where="--frames",
            todo="give 0:N, for example 0:500 for the first 500 frames",
        )
    return int(stop)


def cameras_without_rig(run: Path, calibration: Calibration) -> dict[str, Any]:
    """Return the arguments of `load_run` that name the cameras, taken from the calibration.

    They are needed for a run whose folder belongs to no dataset; a run with a rig.toml two folders
    above needs none, and an empty mapping is returned.
    """
    if (run.resolve().parent.parent / "rig.toml").is_file():
        return {}
    return {
        "cameras": [c.name for c in calibration.cameras[:2]],
        "image_sizes_px": {c.name: c.image_size_px for c in calibration.cameras},
    }


def default_folder(run: Path) -> Path:
    """Return the results folder of a run: results/NAME in its dataset, or results/ inside the run.

    The latter is for a run that belongs to no dataset.
    """
    place = run.resolve()
    if place.parent.name == "runs":
        return place.parent.parent / "results" / place.name
    return place / "results"


if __name__ == "__main__":
    run_file(track)
