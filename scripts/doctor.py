"""telerig doctor: what is wrong with the installation, the ports or a dataset, and what to do."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from telerig.command_options import TrackingOptions
from telerig.scripts import options
from telerig.scripts.console import EXIT_REJECTED, errors_in_words, progress, run_file, say
from telerig.short_text import counted

if TYPE_CHECKING:
    from telerig.estimator.doctor.checks import Check

_SIGNS = {"ok": "ok", "note": "note", "warning": "WARNING", "failure": "FAILURE"}
_WIDTH = 8


@errors_in_words()
def doctor(
    dataset: Annotated[Path | None, typer.Argument(help="Dataset or run to check as well.")] = None,
    frames: Annotated[
        str, typer.Option(help="Frames of a run that are tracked and smoothed.")
    ] = "0:500",
    seconds: Annotated[
        float | None,
        typer.Option(help="How long the planned run is [as long as this one].", min=0.1),
    ] = None,
    calibration: options.CalibrationFiles = None,
    out: options.RunFolder = None,
    report: options.Report = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for other programs.")] = False,
    quiet: Annotated[bool, typer.Option(help="Print only what is not ok.")] = False,
) -> None:
    """Check the installation, the serial ports, and a dataset or a run if one is given.

    Of each run of a dataset it estimates how long tracking and smoothing will take. A run that is
    given itself is taken for a trial recording: light, focus, frames, synchrony, sensors and shake
    are measured, and the verdict that a run of --seconds may expect; trial.html shows it.

    With --quiet it prints only what is not ok, and how many checks there were.

    Exit code 0: nothing prevents the work, though there may be warnings. 1: there is a failure.
    """
    from telerig.estimator.batch.work import default_folder
    from telerig.estimator.doctor.checks import check_dataset, check_installation, check_ports

    checks = [*check_installation(), *check_ports()]
    if dataset is not None:
        checks += check_dataset(dataset)
        if dataset.resolve().parent.name == "runs":
            sensors = f"run {dataset.resolve().name} sensors"  # the trial says more of them
            checks = [c for c in checks if c.what != sensors or c.status == "ok"]
            folder = (out or default_folder(dataset)) if report else None
            checks += _recording(dataset, frames, seconds, calibration, folder, quiet or as_json)
    if as_json:
        say(json.dumps([asdict(check) for check in checks], indent=1, ensure_ascii=False))
    else:
        shown = [c for c in checks if c.status != "ok"] if quiet else checks
        width = max((len(check.what) for check in shown), default=0)
        for check in shown:
            say(f"{_SIGNS[check.status]:<{_WIDTH}}{check.what:<{width}}  {check.words}")
            if check.todo:
                say(f"{'':{_WIDTH + width + 2}}-> {check.todo}")
        if quiet:
            say(f"{len(checks) - len(shown)} of {counted(len(checks), 'check')} ok")
    if any(check.status == "failure" for check in checks):
        raise typer.Exit(EXIT_REJECTED)


def _recording(
    run: Path, frames: str, seconds: float | None, files: list[Path] | None, folder: Path | None,
    quiet: bool,
) -> tuple[Check, ...]:  # fmt: skip
    """Check a run as a trial recording, and write its page into a folder."""
    from telerig.errors import TelerigError
    from telerig.estimator.batch.work import load_with
    from telerig.estimator.calibration.result.calibration import calibration_for
    from telerig.estimator.doctor.checks import Check, Status, failure
    from telerig.estimator.doctor.recording import check_recording
    from telerig.estimator.tracking.track import stage_axis, upwards
    from telerig.io.report.run.report import up_name
    from telerig.io.report.trial import write_trial_report

    count = TrackingOptions(frames=frames).first_frames
    try:
        calibration, _ = calibration_for(run, files)
    except TelerigError as error:
        status: Status = "note" if run.is_dir() else "failure"
        return (Check("trial recording", status, f"not looked at: {error.what}", error.todo),)
    try:
        found = (run / "detections.csv").is_file()
        recorded = load_with(run, calibration, "detections" if found else None)
        part = recorded.first(count or recorded.frame_count)
        with progress(quiet) as stage:
            trial = check_recording(part, calibration, seconds=seconds, progress=stage)
        if folder is not None:
            rows = [(c.what, c.status, c.words, c.todo) for c in trial.checks]
            detections = None if trial.tracks is None else trial.tracks.detections
            shake = None if trial.smoothing is None else trial.smoothing.shake
            page = folder / "trial.html"
            up = up_name(upwards(part, stage_axis(part, calibration)))
            write_trial_report(page, part, rows, detections, shake, up=up)
            if not quiet:
                say(f"written: {page}")
        return trial.checks
    except TelerigError as error:
        return (failure("trial recording", error),)


if __name__ == "__main__":
    run_file(doctor)
