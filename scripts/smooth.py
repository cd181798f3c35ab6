"""telerig smooth: separate the motion of the bubbles from the shake of the rig, with a verdict."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from telerig.command_options import SmoothingOptions
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
    viewed,
)


@options.with_options()
@errors_in_words()
def smooth(
    runs: options.Runs,
    chosen: SmoothingOptions,
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
            "run gets a folder.",
            file_okay=False,
        ),
    ] = None,
    report: options.Report = True,
    view: options.View = False,
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
                run, chosen, calibration,
                tracks / name if several and tracks else tracks,
                out / name if several and out else out,
                report=report, view=view, quiet=quiet, several=several,
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
    chosen: SmoothingOptions,
    calibration: list[Path] | None,
    tracks: Path | None,
    out: Path | None,
    *,
    report: bool,
    view: bool,
    quiet: bool,
    several: bool,
) -> None:
    """Smooth a run, write its results and say what was found.

    several : whether the command smooths other runs, too, so that the run is named.
    """
    from telerig.estimator.batch.jobs import command_line
    from telerig.estimator.batch.work import default_folder, smooth_run
    from telerig.estimator.smoothing.terminal_summary import smoothing_words

    folder = out or default_folder(run)
    own = folder if (folder / "tracks.csv").is_file() else default_folder(run)
    given: dict[str, Sequence[Path | None]] = {
        "--calibration": calibration or [], "--tracks": [tracks], "--out": [out]
    }  # fmt: skip
    again = command_line("smooth", str(run), chosen, given, report=report)
    with viewed(view, run.name), progress(quiet) as stage:
        found = smooth_run(
            run, folder, chosen, calibration, tracks=tracks or own, report=report, stage=stage,
            again=again if several else typed_command(),
        )  # fmt: skip
    if several:
        say(f"{run}:")
    say(smoothing_words(found))
    say_written(folder, report and (folder / "report.html").is_file())
    if several:
        say("")


if __name__ == "__main__":
    run_file(smooth)
