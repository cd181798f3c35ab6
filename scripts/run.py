"""telerig run: everything for one dataset."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from telerig.command_options import CalibrationOptions, SmoothingOptions, TrackingOptions
from telerig.errors import TelerigError
from telerig.scripts import options
from telerig.scripts.console import (
    EXIT_REJECTED,
    errors_in_words,
    progress,
    run_file,
    say,
    say_written,
)

if TYPE_CHECKING:
    from telerig.estimator.batch.jobs import Job


@options.with_options(in_batch=True)
@errors_in_words()
def run(
    dataset: options.Dataset,
    calibrating: CalibrationOptions,
    tracking: TrackingOptions,
    smoothing: SmoothingOptions,
    calibration: options.GivenCalibration = None,
    only: options.Only = None,
    tracks: options.TracksOfRuns = None,
    report: options.Report = True,
    quiet: options.Quiet = False,
) -> None:
    """Calibrate a dataset, then track and smooth all of its runs.

    A failure stops only what needs the failed result. A calibration that is REJECTED is not used:
    correct its cause, or give another calibration.

    Exit code 0: all done. 1: a calibration was rejected or a run failed. 2: the dataset cannot be
    used. 130: interrupted; the same command continues.
    """
    from telerig.estimator.batch.batch import FAILED, KEPT, LEFT_OUT, batch_words, failure
    from telerig.estimator.batch.jobs import check_options, jobs_of, shake_of_model
    from telerig.io.results.batch import has_failed

    calibrating, smoothing = shake_of_model(calibrating, smoothing, only or ())
    check_options(calibration, calibrating)
    jobs = jobs_of(
        [dataset], calibration=calibration, only=only or (), calibrating=calibrating,
        tracking=tracking, smoothing=smoothing, tracks=tracks, report=report, strict=True,
    )  # fmt: skip
    records: dict[str, dict[str, Any]] = {}
    for job in jobs:
        missing = [name for name in job.needs if has_failed(records[name])]
        result = failure(LEFT_OUT, f"needs {missing[0]}") if missing else _done(job, quiet)
        records[job.name] = {"kind": job.kind, "dataset": job.dataset, "run": job.run, **result}
        if not missing and (not quiet or has_failed(result)):
            say(result["words"])
            if result["status"] not in (FAILED, KEPT):
                say_written(job.results, report)
            say("")
    say(batch_words(list(records.values())))
    if any(map(has_failed, records.values())):
        raise typer.Exit(EXIT_REJECTED)


def _done(job: Job, quiet: bool) -> dict[str, Any]:
    from telerig.estimator.batch.batch import FAILED, do_job, failure

    try:
        with progress(quiet) as stage:
            return do_job(job, stage)
    except TelerigError as error:
        return failure(FAILED, str(error))


if __name__ == "__main__":
    run_file(run)
