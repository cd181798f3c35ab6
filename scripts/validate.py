"""telerig validate: marks that stand still, smoothed as if they were bubbles."""

from __future__ import annotations

from typing import Annotated

import typer

from telerig.command_options import ShakePriors
from telerig.scripts import options
from telerig.scripts.console import (
    EXIT_REJECTED,
    errors_in_words,
    progress,
    run_file,
    say,
    typed_command,
)


@errors_in_words()
def validate(
    run: options.Run,
    calibration: options.CalibrationFiles = None,
    out: options.RunFolder = None,
    marks: Annotated[
        int, typer.Option(min=1, help="Number of marks that are withheld, one after the other.")
    ] = 6,
    model: Annotated[
        ShakePriors,
        typer.Option(
            "--model",
            "--shake",
            help="Priors of the shake, as of `telerig smooth`: auto or default.",
        ),
    ] = "auto",
    accept: options.AcceptedFaults = None,
    seed: Annotated[
        int, typer.Option(help="Seed of the motions that the marks are given.", min=0)
    ] = 0,
    report: Annotated[bool, typer.Option(help="Write validation.html.")] = True,
    quiet: options.Quiet = False,
) -> None:
    """Check a rig with marks or a target fixed to the tank, while the stage moves and shakes.

    The marks are withheld from the smoother in turn. A known motion, as of a bubble, is added to
    each withheld mark, which is then smoothed as a bubble. Once the known motion is subtracted,
    the path of the mark must stand still in the laboratory. Writes validation.json and
    validation.html.

    Exit code 0: the marks stand still within the stated standard deviations. 1: they do not. 2:
    the input cannot be used. 130: interrupted.
    """
    from telerig.estimator.batch.work import default_folder, load_tracked_run
    from telerig.estimator.calibration.result.calibration import calibration_for
    from telerig.estimator.smoothing.validate import validate_run
    from telerig.io.results.validation import Stillness, table_words, validation_words

    calibrated, files = calibration_for(run, calibration)
    data = load_tracked_run(run, calibrated)
    folder = out or default_folder(run)
    with progress(quiet) as stage:
        found = validate_run(
            data, calibrated, folder, marks=marks, model=model, accept=accept or (), seed=seed,
            inputs=files, report=report, stage=stage, again=typed_command(),
        )  # fmt: skip
    say("\n".join(validation_words(found)))
    if not quiet:
        say("\n".join(table_words(found)))
    for warning in found.warnings:
        say(f"warning: {warning}")
    say(f"written: {folder}/validation." + ("html" if report else "json"))
    if found.verdict is Stillness.FAILED:
        raise typer.Exit(EXIT_REJECTED)


if __name__ == "__main__":
    run_file(validate)
