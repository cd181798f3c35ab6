"""telerig track: from pairs of bubble images to 3-D tracks."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from telerig.errors import InputError
from telerig.scripts.console import errors_in_words, progress, say

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration


def track(
    run: Annotated[Path, typer.Argument(help="Recording: DATASET/runs/NAME.")],
    calibration: Annotated[
        list[Path] | None,
        typer.Option(
            help="calibration.json, or two OpenLPT camera files, first camera first "
            "[DATASET/results/calibration/calibration.json]."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Results folder [DATASET/results/NAME].")] = None,
    min_diameter: Annotated[float, typer.Option(help="Smaller dark spots are dirt (px).")] = 8.0,
    source: Annotated[
        str | None, typer.Option("--from", help="images or detections, when the run has both.")
    ] = None,
    report: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    quiet: Annotated[bool, typer.Option(help="Print only the summary.")] = False,
) -> None:
    """Find the bubbles of a run, match them across the views, and follow them in space.

    Writes detections.csv, tracks.csv, events.csv, tracking.json, run.json and report.html. An
    interrupted run goes on where it was when the same command is given again.

    Exit code 0: tracked. 2: the input cannot be used, with what, where and what to do.
    130: interrupted.
    """
    with errors_in_words():
        from telerig.estimator.batch.jobs import check_run_name
        from telerig.estimator.tracking.calibration_of_run import calibration_for
        from telerig.estimator.tracking.results_folder import write_tracking
        from telerig.estimator.tracking.track import TrackOptions
        from telerig.estimator.tracking.wording import tracking_words
        from telerig.io.dataset.run import load_run

        if out is None:
            check_run_name(run)
        begun = time.perf_counter()
        calibrated, files = calibration_for(run, calibration)
        data = load_run(run, source=chosen_source(source), **cameras_without_rig(run, calibrated))
        folder = out or default_folder(run)
        options = TrackOptions(min_diameter_px=min_diameter)
        asked = {"from": source, "min_diameter_px": min_diameter}
        record = {"command": "track", "options": asked, "inputs": files}
        with progress(quiet) as stage:
            summary = write_tracking(
                data, calibrated, folder, options=options, record=record, report=report, stage=stage
            )
        say(tracking_words(summary, time.perf_counter() - begun))
        say(f"written: {folder}" + ("/report.html" if report else ""))


def chosen_source(source: str | None) -> Literal["images", "detections"] | None:
    """The value of ``--from``; raises InputError for another word."""
    if source is None:
        return None
    if source == "images":
        return "images"
    if source == "detections":
        return "detections"
    raise InputError(f"--from {source}", todo="use --from images or --from detections")


def cameras_without_rig(run: Path, calibration: Calibration) -> dict[str, Any]:
    """What `load_run` needs of a calibration for a folder that belongs to no dataset."""
    if (run.resolve().parent.parent / "rig.toml").is_file():
        return {}
    return {
        "cameras": [c.name for c in calibration.cameras],
        "image_sizes_px": {c.name: c.image_size_px for c in calibration.cameras},
    }


def any_source(run: Path) -> Literal["images", "detections"] | None:
    """For work on tracks it does not matter which of both a run holds."""
    return "detections" if (run / "detections.csv").is_file() else None


def default_folder(run: Path) -> Path:
    """results/<run> of the dataset that holds the run, else results/ inside the run."""
    place = run.resolve()
    if place.parent.name == "runs":
        return place.parent.parent / "results" / place.name
    return place / "results"


if __name__ == "__main__":
    typer.run(track)
