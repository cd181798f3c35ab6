"""telerig run: everything for one dataset."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from telerig.errors import TelerigError
from telerig.scripts.console import EXIT_REJECTED, errors_in_words, progress, say

if TYPE_CHECKING:
    from telerig.estimator.batch.jobs import Job


def run(
    dataset: Annotated[Path, typer.Argument(help="Dataset folder with rig.toml.")],
    calibration: Annotated[
        Path | None,
        typer.Option(help="calibration.json to use instead of calibrating the dataset."),
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Name of a run; may be given again [all runs].")
    ] = None,
    model: Annotated[
        str,
        typer.Option(
            help="Lens model: auto, none, radial, brown, kappa, ..., or left=brown,right=auto."
        ),
    ] = "auto",
    medium: Annotated[
        str,
        typer.Option(help="air or water: where the target was. With [walls], runs are in water."),
    ] = "air",
    report: Annotated[bool, typer.Option(help="Write the reports.")] = True,
    quiet: Annotated[bool, typer.Option(help="Print only the summary.")] = False,
) -> None:
    """Calibrate a dataset, then track and smooth all of its runs.

    What fails does not stop the rest, except what needs it. A calibration that is REJECTED is not
    used: mend it, or give another one.

    Exit code 0: all done. 1: a calibration was rejected or a run failed. 2: the dataset cannot be
    used. 130: interrupted; the same command goes on.
    """
    with errors_in_words():
        from telerig.estimator.batch.jobs import check_options, jobs_of
        from telerig.estimator.batch.summary import batch_words
        from telerig.estimator.batch.work import DONE, FAILED, LEFT_OUT, failure

        check_options(calibration, model, medium)
        jobs = jobs_of([dataset], calibration=calibration, only=only or (), model=model,
                       medium=medium, report=report, strict=True)  # fmt: skip
        records: dict[str, dict[str, Any]] = {}
        for job in jobs:
            lost = [n for n in job.needs if records[n]["status"] != DONE]
            result = failure(LEFT_OUT, f"needs {lost[0]}") if lost else _done(job, quiet)
            records[job.name] = {"kind": job.kind, "dataset": job.dataset, "run": job.run, **result}
            if not lost and (not quiet or result["status"] != DONE):
                say(result["words"])
                if result["status"] != FAILED:
                    say(f"written: {job.results}" + ("/report.html" if report else ""))
                say("")
        say(batch_words(list(records.values())))
        if any(r["status"] != DONE for r in records.values()):
            raise typer.Exit(EXIT_REJECTED)


def _done(job: Job, quiet: bool) -> dict[str, Any]:
    from telerig.estimator.batch.work import FAILED, do_job, failure

    try:
        with progress(quiet) as stage:
            return do_job(job, stage)
    except TelerigError as error:
        return failure(FAILED, str(error))


if __name__ == "__main__":
    typer.run(run)
