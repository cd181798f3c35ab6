"""telerig smooth: separate the motion of the bubbles from the shake of the rig, with a verdict."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from telerig.errors import TelerigError
from telerig.scripts import options
from telerig.scripts.console import (
    EXIT_REJECTED,
    errors_in_words,
    progress,
    run_file,
    say,
    say_written,
    typed_command,
)


@errors_in_words()
def smooth(
    runs: options.Runs,
    calibration: options.CalibrationFiles = None,
    tracks: Annotated[
        Path | None,
        typer.Option(
            help="tracks.csv, or the folder that holds it [the results folder]. For several runs: "
            "a folder that holds a folder for each run."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Results folder [DATASET/results/NAME]. For several runs: a folder in which each "
            "run gets a folder."
        ),
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            "--model",
            "--shake",
            help="Priors of the shake: auto learns what no sensor measures, default fixes them.",
        ),
    ] = "auto",
    refine_rig: options.RefineRig = False,
    accept: options.AcceptedFaults = None,
    report: options.Report = True,
    quiet: options.Quiet = False,
) -> None:
    """Smooth tracked runs: bubbles in the lab frame, the shake of each camera, and a verdict.

    Uses the sensors of the run: the encoder (stage.csv), accelerometers (accelerometer.csv), marks
    fixed to the tank (references.csv). Writes trajectories.csv, shake.csv, smoothing.json and
    results.h5 beside the tracks, and the report. Of several runs, one that fails does not stop the
    others; `telerig batch --only smooth` does them on several cores.

    Exit code 0: smoothed, whatever the verdict. 1: of several runs, some failed. 2: the input
    cannot be used. 130: interrupted.
    """
    from telerig.estimator.batch.jobs import check_distinct

    several = len(runs) > 1
    names = [run.resolve().name for run in runs]
    if several:
        for option, folder in (("--out", out), ("--tracks", tracks)):
            check_distinct([str(folder / name) for name in names] if folder else [], option)
    failed = []
    for run, name in zip(runs, names):
        try:
            _smooth_one(
                run, calibration,
                tracks / name if several and tracks else tracks,
                out / name if several and out else out,
                model=model, refine_rig=refine_rig, accept=accept or [], report=report, quiet=quiet,
                again="" if several else typed_command(), titled=several,
            )  # fmt: skip
        except TelerigError as error:
            if not several:
                raise
            typer.echo(f"telerig: {run}: not smoothed: {error}\n", err=True)
            failed.append(name)
    if several:
        words = f"; failed: {', '.join(failed)}" if failed else ""
        say(f"{len(runs) - len(failed)} of {len(runs)} runs are smoothed{words}")
    if failed:
        raise typer.Exit(EXIT_REJECTED)


def _smooth_one(
    run: Path,
    calibration: list[Path] | None,
    tracks: Path | None,
    out: Path | None,
    *,
    model: str,
    refine_rig: bool,
    accept: list[str],
    report: bool,
    quiet: bool,
    again: str,
    titled: bool,
) -> None:
    """Smooth a run, write its results and say what was found.

    again : the command that makes the results again; "" for one with the options given here.
    titled : whether the run is named before what was found.
    """
    from telerig.estimator.calibration.result.calibration import calibration_for
    from telerig.estimator.smoothing.results_folder import smooth_run
    from telerig.estimator.smoothing.terminal_summary import smoothing_words
    from telerig.io.dataset.run import load_run
    from telerig.scripts.track import cameras_without_rig, default_folder

    calibrated, files = calibration_for(run, calibration)
    folder = out or default_folder(run)
    own = folder if (folder / "tracks.csv").is_file() else default_folder(run)
    words = ["telerig", "smooth", str(run)]
    for option, value in (("--calibration", calibration), ("--tracks", tracks), ("--out", out)):
        for path in value if isinstance(value, list) else [value] if value else []:
            words += [option, str(path)]
    words += [f"--model={model}", *(["--refine-rig"] if refine_rig else [])]
    words += [word for code in accept for word in ("--accept", code)]
    with progress(quiet) as stage:
        stage("reading the run", 0, 1)
        # tracks are smoothed: it does not matter whether a run with both has images or detections
        data = load_run(
            run, source="detections" if (run / "detections.csv").is_file() else None,
            **cameras_without_rig(run, calibrated),
        )  # fmt: skip
        found = smooth_run(
            data, calibrated, tracks or own, folder, model=model, inputs=files,
            refine_rig=refine_rig, accept=accept, report=report, stage=stage,
            again=again or shlex.join(words),
        )  # fmt: skip
    if titled:
        say(f"{run}:")
    say(smoothing_words(found))
    say_written(folder, report and (folder / "report.html").is_file())
    if titled:
        say("")


if __name__ == "__main__":
    run_file(smooth)
