"""telerig plan: what accuracy an experiment can reach, and what would improve it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.command_options import Experiment
from telerig.scripts import options
from telerig.scripts.console import errors_in_words, progress, run_file, say


@options.with_options()
@errors_in_words()
def plan(
    dataset: Annotated[
        Path, typer.Argument(help="Dataset folder. Its rig.toml is enough: see telerig init.")
    ],
    planned: Experiment,
    views: Annotated[
        int, typer.Option(help="Number of views of the target, if it is not calibrated yet.")
    ] = 12,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="A calibration.json to use [the dataset's own; before it is calibrated, the one "
            "that --views views of its target are expected to give]."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="CSV file for the table [none].")] = None,
    quiet: options.Quiet = False,
) -> None:
    """Say what accuracy a run will have, before it is recorded, and what would improve it.

    Cameras, stage and accelerometers are those of rig.toml, the calibration is that of the dataset,
    or the one that views of its target are expected to give. The standard deviations are those of
    the exact posterior; docs/plan.md says what they assume.

    Exit code 0: planned. 2: the input cannot be used.
    """
    from telerig.estimator.plan import (
        calibration_of,
        check,
        expect,
        plan_table,
        plan_words,
        variants,
    )
    from telerig.io.files.csv_table import write_table
    from telerig.io.results.manifest import check_file
    from telerig.io.rig_file.rig_file import read_rig_toml

    if out is not None:
        check_file(out)
    rig = read_rig_toml(dataset / "rig.toml")
    check(planned)
    chosen = variants(rig, planned)
    expected = {}
    with progress(quiet) as stage:
        stage("calibration", 0.0, 1)
        known = calibration_of(dataset, rig, calibration, views)
        for number, (name, one) in enumerate(chosen.items()):
            stage("variants", number, len(chosen))
            expected[name] = expect(rig, known, one)
    for line in plan_words(rig, known, chosen, expected):
        say(line)
    if out is not None:
        write_table(plan_table(expected), out)
        say(f"written: {out}")


if __name__ == "__main__":
    run_file(plan)
