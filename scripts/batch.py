"""telerig batch: many datasets, over the cores of this machine or a cluster."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from telerig.command_options import CalibrationOptions, SmoothingOptions, TrackingOptions
from telerig.errors import InputError
from telerig.scripts import options
from telerig.scripts.console import (
    EXIT_REJECTED,
    errors_in_words,
    run_file,
    say,
    say_written,
    typed_command,
)

if TYPE_CHECKING:
    from telerig.estimator.batch.jobs import Job


@options.with_options(in_batch=True)
@errors_in_words()
def batch(
    datasets: Annotated[list[Path], typer.Argument(help="Dataset folders.")],
    calibrating: CalibrationOptions,
    tracking: TrackingOptions,
    smoothing: SmoothingOptions,
    out: Annotated[
        Path, typer.Option(help="Folder for the journal, batch.csv and report.html.")
    ] = Path("telerig-batch"),
    workers: Annotated[
        int | None, typer.Option(help="Number of jobs at once on this machine [one per core].")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, tcp://host:port.")
    ] = None,
    share: Annotated[
        str,
        typer.Option(
            help="I/N does every N-th dataset only, beginning with the I-th; for job arrays."
        ),
    ] = "1/1",
    only: options.Only = None,
    calibration: options.GivenCalibration = None,
    tracks: options.TracksOfRuns = None,
    report: options.Report = True,
    quiet: options.Quiet = False,
) -> None:
    """Calibrate many datasets, track and smooth all of their runs, or do some of it (--only).

    Every job runs in a process of its own; one that fails or dies stops only the jobs that need
    its result. The output folder keeps a journal of what is done: the same command, given again,
    continues, and repeats only the jobs that failed or whose input changed.

    Exit code 0: all done. 1: a job failed or a calibration was rejected; batch.csv and report.html
    say which. 2: the input cannot be used. 130: interrupted; the same command continues.
    """
    from telerig.estimator.batch.batch import (
        Journal,
        batch_words,
        local_executor,
        run_batch,
        summary_line,
        write_batch,
    )
    from telerig.estimator.batch.cluster import dask_executor
    from telerig.estimator.batch.jobs import check_options, jobs_of, shake_of_model, share_of
    from telerig.io.results.batch import has_failed
    from telerig.io.results.manifest import check_place

    def tell(job: Job, record: dict[str, Any], done: int, of: int) -> None:
        say(f"[{done}/{of}] {summary_line(job, record, whole_path=same_names)}")

    if scheduler is not None and workers is not None:
        raise InputError(
            "both --workers and --scheduler are given",
            todo="leave out --workers: a cluster has its own number of workers",
        )
    first, _, last = share.partition("/")
    if not (first.isdecimal() and last.isdecimal() and 1 <= int(first) <= int(last)):
        raise InputError(
            f"--share {share} names no part", todo="give I/N with I from 1 to N, like 3/40"
        )
    index, of = int(first) - 1, int(last)
    calibrating, smoothing = shake_of_model(calibrating, smoothing, only or ())
    check_options(calibration, calibrating)
    jobs = jobs_of(
        datasets, calibration=calibration, calibrating=calibrating, tracking=tracking,
        smoothing=smoothing, tracks=tracks, report=report, only=only or (),
    )  # fmt: skip
    check_place(out, "batch")
    mine = share_of(jobs, index, of)
    places = {job.dataset for job in mine}
    same_names = len({Path(place).name for place in places}) < len(places)
    chosen = local_executor(workers) if scheduler is None else dask_executor(scheduler)
    with chosen as executor:
        records = run_batch(mine, executor, Journal(out), tell=None if quiet else tell)
    if of == 1:
        write_batch(records, out, report=report, again=typed_command())
    say(batch_words(records))
    say_written(out, report and of == 1)
    if any(map(has_failed, records)):
        raise typer.Exit(EXIT_REJECTED)


if __name__ == "__main__":
    run_file(batch)
