"""telerig plan: what accuracy an experiment can reach, and what would improve it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.scripts import options
from telerig.scripts.console import errors_in_words, progress, run_file, say


@errors_in_words()
def plan(
    dataset: Annotated[
        Path, typer.Argument(help="Dataset folder. Its rig.toml is enough: see telerig init.")
    ],
    rate_hz: Annotated[float, typer.Option(help="Frame rate in Hz.")] = 500.0,
    seconds: Annotated[float, typer.Option(help="Duration of the run in s.")] = 0.5,
    bubbles: Annotated[int, typer.Option(help="Number of bubbles in sight.")] = 1,
    diameter_mm: Annotated[float, typer.Option(help="Diameter of a bubble in mm.")] = 3.0,
    sigma_px: Annotated[
        float | None,
        typer.Option(help="Noise of a bubble's centre in px [from its diameter]."),
    ] = None,
    rise_mm_s: Annotated[float, typer.Option(help="Rise velocity in mm/s.")] = 250.0,
    zigzag_hz: Annotated[float, typer.Option(help="Frequency of the path's zigzag in Hz.")] = 6.0,
    zigzag_mm: Annotated[float, typer.Option(help="RMS of the zigzag in mm.")] = 1.4,
    shake_hz: Annotated[float, typer.Option(help="Frequency of the rig's shake in Hz.")] = 20.0,
    shake_mm: Annotated[
        float, typer.Option(help="RMS of the shake in mm, vertical; each horizontal axis has half.")
    ] = 0.15,
    marks: Annotated[
        int, typer.Option(help="Number of marks in each view that are fixed to the tank.")
    ] = 0,
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
        Experiment,
        calibration_of,
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
    planned = Experiment(
        rate_hz, seconds, bubbles, diameter_mm, sigma_px, rise_mm_s, zigzag_hz, zigzag_mm, shake_hz,
        shake_mm, marks,
    )  # fmt: skip
    planned.check()
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
