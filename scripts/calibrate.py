"""telerig calibrate: from target images or dots to a stereo calibration with its covariance."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from telerig.command_options import CalibrationOptions
from telerig.errors import InputError
from telerig.live import publish
from telerig.scripts import options
from telerig.scripts.console import (
    EXIT_REJECTED,
    errors_in_words,
    progress,
    run_file,
    say,
    say_written,
    stopped_by_signals,
    typed_command,
    viewed,
)

if TYPE_CHECKING:
    from telerig.estimator.calibration.calibrate import CalibrationRun
    from telerig.estimator.calibration.result.calibration import Calibration
    from telerig.io.dataset.dataset import Dataset


_POLL_S = 1.0
"""Time between two looks into the folder that is watched."""


@options.with_options()
@errors_in_words()
def calibrate(
    dataset: options.Dataset,
    chosen: CalibrationOptions,
    out: options.CalibrationFolder = None,
    compare: Annotated[
        Path | None,
        typer.Option(
            help="An earlier calibration of this rig, or its dataset: report what has moved since."
        ),
    ] = None,
    watch: Annotated[
        bool,
        typer.Option(
            "--watch",
            help="Solve again as images arrive and say how to hold the target next; end when "
            "another view would bring too little, or at Ctrl-C.",
        ),
    ] = False,
    until_um: Annotated[
        float | None,
        typer.Option(
            help="With --watch: end when the standard deviation of points in space, in µm, is as "
            "small as this.",
            min=0,
        ),
    ] = None,
    poll: Annotated[
        float | None,
        typer.Option(
            help="With --watch: seconds between two looks into the folder (1 s).", min=0.02
        ),
    ] = None,
    report: options.Report = True,
    view: options.View = False,
    quiet: options.Quiet = False,
) -> None:
    """Calibrate the rig from views of the target.

    Finds and numbers the dots, estimates one to four cameras, their relative poses, every pose of
    the target and the positions of the dots together, and writes calibration.json, covariance.npz,
    dots.csv, residuals.csv, run.json and report.html.

    With --watch it waits for new images in calibration/CAMERA/ until another view would improve the
    result by less than 5 %, or until Ctrl-C, and then writes the results.

    Exit code 0: calibrated. 1: calibrated, but the verdict is REJECTED. 2: the input cannot be
    used; the message says what, where and what to do. 130: interrupted.
    """
    from telerig.estimator.calibration.calibrate import check_options, run_calibration
    from telerig.estimator.calibration.quality.comparison import compare_calibrations
    from telerig.estimator.calibration.results_folder import sources, write_report, write_results
    from telerig.io.dataset.dataset import load_dataset
    from telerig.io.results.inputs import fingerprints
    from telerig.io.results.manifest import check_place

    begun = time.perf_counter()
    settings = chosen.keywords
    check_options(**settings)
    record = {**chosen.record(), "compare": None if compare is None else str(compare)}
    with viewed(view, dataset.name):
        earlier = None if compare is None else _earlier(compare, dataset)
        if watch:
            data, run = _watched(dataset, out, chosen.source, until_um, poll or _POLL_S, settings)
            used = None
            record |= {"watch": True, "until_um": until_um}
        else:
            for option, value in (("--until-um", until_um), ("--poll", poll)):
                if value is not None:
                    raise InputError(
                        f"{option} goes with --watch", todo="add --watch, or leave it out"
                    )
            data = load_dataset(dataset, source=chosen.source)
            folder = out or data.results / "calibration"
            used = fingerprints(folder, sources(data))
            check_place(folder, "calibrate", used)
            with progress(quiet) as stage:
                run = run_calibration(data, **settings, stage=stage, pictures=True)
        folder = out or data.results / "calibration"
        change = None if earlier is None else compare_calibrations(earlier, run.calibration)
        write_results(
            data, run, folder, command="calibrate", options=record,
            seconds={"calibrate": time.perf_counter() - begun}, change=change,
            report=write_report if report else None, used=used, again=typed_command(),
        )  # fmt: skip
        publish("results", folder=folder.resolve(), dataset=data.path)
    say(run.calibration.report())
    if change is not None:
        say(f"since {compare}: {change.words()}")
    say_written(folder, report)
    if run.calibration.verdict["status"] == "REJECTED":
        raise typer.Exit(EXIT_REJECTED)


def _earlier(path: Path, dataset: Path) -> Calibration:
    """Return the calibration to compare with. Raises InputError if it is of another rig."""
    from telerig.estimator.calibration.quality.comparison import check_same_rig
    from telerig.estimator.calibration.result.calibration import load_calibration
    from telerig.io.dataset.dataset import load_dataset

    earlier = load_calibration(path)
    rig = load_dataset(dataset, need_views=False).rig
    check_same_rig(earlier.cameras, tuple(rig.cameras.values()))
    return earlier


def _watched(
    dataset: Path,
    out: Path | None,
    source: str | None,
    until_um: float | None,
    poll: float,
    settings: dict[str, Any],
) -> tuple[Dataset, CalibrationRun]:
    """Return the dataset with the images that arrived, and their calibration."""
    from telerig.estimator.calibration.watch import watch
    from telerig.io.dataset.dataset import load_dataset
    from telerig.io.results.manifest import check_place

    if source == "dots":
        raise InputError("--watch waits for images", todo="leave out --from dots")
    data = load_dataset(dataset, need_views=False)
    check_place(out or data.results / "calibration", "calibrate")
    say(f"watching {data.path / 'calibration'}; Ctrl-C writes the results and ends")
    with stopped_by_signals() as stop:
        return watch(data, stop=stop, tell=say, interval_s=poll, until_um=until_um, **settings)


if __name__ == "__main__":
    run_file(calibrate)
