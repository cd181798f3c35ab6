"""telerig smooth: bubble motion and rig shake told apart, with a verdict on how far they can be."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.scripts.console import errors_in_words, progress, say


def smooth(
    run: Annotated[Path, typer.Argument(help="Recording: DATASET/runs/NAME.")],
    calibration: Annotated[
        list[Path] | None,
        typer.Option(help="calibration.json [DATASET/results/calibration/calibration.json]."),
    ] = None,
    tracks: Annotated[
        Path | None,
        typer.Option(help="tracks.csv, or the folder that holds it [the results folder]."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Results folder [DATASET/results/NAME].")] = None,
    model: Annotated[
        str, typer.Option(help="auto (learns what no sensor tells) or default (fixed priors).")
    ] = "auto",
    refine_rig: Annotated[
        bool,
        typer.Option(
            "--refine-rig",
            help="Estimate how the cameras have moved against each other since the calibration.",
        ),
    ] = False,
    report: Annotated[bool, typer.Option(help="Write report.html.")] = True,
    quiet: Annotated[bool, typer.Option(help="Print only the summary.")] = False,
) -> None:
    """Smooth a tracked run: bubbles in the lab, the shake of each camera, and a verdict.

    Uses what the run holds: the encoder (stage.csv), accelerometers (accelerometer.csv), marks
    fixed to the tank (references.csv). Writes trajectories.csv, shake.csv, smoothing.json and
    results.h5 beside the tracks, and the report.

    Exit code 0: smoothed, whatever the verdict. 2: the input cannot be used. 130: interrupted.
    """
    with errors_in_words():
        from telerig.estimator.smoothing.results_folder import smooth_run
        from telerig.estimator.smoothing.wording import smoothing_words
        from telerig.estimator.tracking.calibration_of_run import calibration_for
        from telerig.io.dataset.run import load_run
        from telerig.scripts.track import any_source, cameras_without_rig, default_folder

        calibrated, files = calibration_for(run, calibration)
        data = load_run(run, source=any_source(run), **cameras_without_rig(run, calibrated))
        folder = out or default_folder(run)
        with progress(quiet) as stage:
            found = smooth_run(
                data, calibrated, tracks or folder, folder, model=model, inputs=files,
                refine_rig=refine_rig, report=report, stage=stage,
            )  # fmt: skip
        say(smoothing_words(found))
        say(f"written: {folder}" + ("/report.html" if report else ""))


if __name__ == "__main__":
    typer.run(smooth)
