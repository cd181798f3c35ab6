"""telerig batch: many datasets, over the cores of this machine or a cluster."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from telerig.errors import InputError
from telerig.scripts.console import EXIT_REJECTED, errors_in_words, say

if TYPE_CHECKING:
    from telerig.estimator.batch.jobs import Job


def batch(
    datasets: Annotated[list[Path], typer.Argument(help="Dataset folders.")],
    out: Annotated[Path, typer.Option(help="Folder for the journal, batch.csv, report.html.")] = (
        Path("telerig-batch")
    ),
    workers: Annotated[
        int | None, typer.Option(help="Jobs at once on this machine [one per core].")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, tcp://host:port.")
    ] = None,
    share: Annotated[
        str, typer.Option(help="I/N: only every N-th dataset from the I-th on; for job arrays.")
    ] = "1/1",
    calibration: Annotated[
        Path | None, typer.Option(help="One calibration.json for all, instead of calibrating.")
    ] = None,
    model: Annotated[str, typer.Option(help="Lens model of the calibrations.")] = "auto",
    medium: Annotated[
        str, typer.Option(help="air or water: where the targets were (see [walls]).")
    ] = "air",
    report: Annotated[bool, typer.Option(help="Write the reports.")] = True,
    quiet: Annotated[bool, typer.Option(help="Print only the summary.")] = False,
) -> None:
    """Calibrate many datasets, track and smooth all of their runs.

    Every job runs in a process of its own; one that fails or dies stops only what needs it. The
    journal in the output folder knows what is done: the same command goes on where it was, and
    does again only what failed or whose input changed.

    Exit code 0: all done. 1: something failed or was rejected; batch.csv and report.html say what.
    2: the input cannot be used. 130: interrupted; the same command goes on.
    """
    with errors_in_words():
        from telerig.estimator.batch.batch import dask_executor, local_executor, run_batch
        from telerig.estimator.batch.jobs import check_options, jobs_of, share_of
        from telerig.estimator.batch.journal import Journal
        from telerig.estimator.batch.summary import batch_words, write_batch
        from telerig.estimator.batch.work import DONE, summary_line

        def tell(job: Job, record: dict[str, Any], done: int, of: int) -> None:
            say(f"[{done}/{of}] {summary_line(job, record, whole_path=alike)}")

        if scheduler is not None and workers is not None:
            raise InputError(
                "both --workers and --scheduler", todo="a cluster has its own number of workers"
            )
        index, of = _share(share)
        check_options(calibration, model, medium)
        jobs = jobs_of(datasets, calibration=calibration, model=model, medium=medium, report=report)
        mine = share_of(jobs, index, of)
        places = {job.dataset for job in mine}
        alike = len({Path(place).name for place in places}) < len(places)
        given_out = local_executor(workers) if scheduler is None else dask_executor(scheduler)
        with given_out as executor:
            records = run_batch(mine, executor, Journal(out), told=None if quiet else tell)
        if of == 1:
            write_batch(records, out, report=report)
        say(batch_words(records))
        say(f"written: {out}" + ("/report.html" if report and of == 1 else ""))
        if any(r["status"] != DONE for r in records):
            raise typer.Exit(EXIT_REJECTED)


def _share(text: str) -> tuple[int, int]:
    first, _, last = text.partition("/")
    if not (first.isdecimal() and last.isdecimal() and 1 <= int(first) <= int(last)):
        raise InputError(f"--share {text}", todo="give I/N with I from 1 to N, like 3/40")
    return int(first) - 1, int(last)


if __name__ == "__main__":
    typer.run(batch)
