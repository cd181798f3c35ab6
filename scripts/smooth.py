"""telerig smooth: separate the motion of the bubbles from the shake of the rig, with a verdict."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.scripts import options
from telerig.scripts.console import (
    errors_in_words,
    progress,
    run_file,
    say,
    say_written,
    typed_command,
)


@errors_in_words()
def smooth(
    run: options.Run,
    calibration: options.CalibrationFiles = None,
    tracks: Annotated[
        Path | None,
        typer.Option(help="tracks.csv, or the folder that holds it [the results folder]."),
    ] = None,
    out: options.RunFolder = None,
    model: Annotated[
        str,
        typer.Option(
            help="Priors of the shake: auto learns what no sensor measures, default fixes them."
        ),
    ] = "auto",
    refine_rig: Annotated[
        bool,
        typer.Option(
            "--refine-rig",
            help="Estimate how the cameras have moved against each other since the calibration.",
        ),
    ] = False,
    accept: options.AcceptedFaults = None,
    report: options.Report = True,
    quiet: options.Quiet = False,
) -> None:
    """Smooth a tracked run: bubbles in the lab frame, the shake of each camera, and a verdict.

    Uses the sensors of the run: the encoder (stage.csv), accelerometers (accelerometer.csv), marks
    fixed to the tank (references.csv). Writes trajectories.csv, shake.csv, smoothing.json and
    results.h5 beside the tracks, and the report.

    Exit code 0: smoothed, whatever the verdict. 2: the input cannot be used. 130: interrupted.
    """
    from telerig.estimator.calibration.result.calibration import calibration_for
    from telerig.estimator.smoothing.results_folder import smooth_run
    from telerig.estimator.smoothing.terminal_summary import smoothing_words
    from telerig.io.dataset.run import load_run
    from telerig.scripts.track import cameras_without_rig, default_folder

    calibrated, files = calibration_for(run, calibration)
    # tracks are smoothed, so it does not matter whether a run with both has images or detections
    data = load_run(
        run, source="detections" if (run / "detections.csv").is_file() else None,
        **cameras_without_rig(run, calibrated),
    )  # fmt: skip
    folder = out or default_folder(run)
    with progress(quiet) as stage:
        found = smooth_run(
            data, calibrated, tracks or folder, folder, model=model, inputs=files,
            refine_rig=refine_rig, accept=accept or (), report=report, stage=stage,
            again=typed_command(),
        )  # fmt: skip
    say(smoothing_words(found))
    say_written(folder, report)


if __name__ == "__main__":
    run_file(smooth)
