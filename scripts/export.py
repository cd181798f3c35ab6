"""telerig export: cameras and trajectories in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from telerig.io.exchange.formats import CAMERA_EXPORTS, RUN_EXPORTS, described
from telerig.scripts import options
from telerig.scripts.console import errors_in_words, run_file, say

_FOLDERS = " and ".join(n for n, f in (CAMERA_EXPORTS | RUN_EXPORTS).items() if not f.suffix)


@errors_in_words()
def export(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET-OR-RESULTS",
            help="A dataset, a results folder (DATASET/results/NAME), or a calibration.json.",
        ),
    ],
    to: Annotated[
        str,
        typer.Option(
            help=f"Format of the cameras: {described(CAMERA_EXPORTS)}; or of the trajectories of a "
            f"run: {described(RUN_EXPORTS)}."
        ),
    ],
    run: Annotated[
        str | None,
        typer.Option(help="For trajectories: the run, by name [the only one with results]."),
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="calibration.json [the run's or dataset's].")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help=f"File to write, or the folder for {_FOLDERS} [DATASET/results/export]."),
    ] = None,
    volume: Annotated[
        str | None,
        typer.Option(
            help="For cameras: working volume in mm in the rig frame, 'x,x,y,y,z,z' [what all "
            "cameras see]."
        ),
    ] = None,
    accept: Annotated[
        list[str] | None,
        typer.Option(
            help="Export results in spite of a fault: --accept stale, for results whose inputs "
            "have changed since. Can be given several times."
        ),
    ] = None,
) -> None:
    """Write a calibration or a run in a format of other programs.

    Prints how far the exported cameras are from the calibrated ones over the working volume.
    docs/exports.md says what each format holds.

    Exit code 0: written. 2: the input cannot be used; the message says what, where and what to do.
    """
    from telerig.io.exchange.export.volume import volume_of
    from telerig.io.exchange.formats import export_results

    box = None
    if volume is not None:
        todo = "give six numbers: x,x,y,y,z,z in mm"
        bounds = options.numbers_of("--volume", volume, 6, ",", todo)
        box = volume_of([bounds[0:2], bounds[2:4], bounds[4:6]])
    for line in export_results(
        source, to, run=run, calibration=calibration, out=out, volume=box,
        accept=accept or (),
    ):  # fmt: skip
        say(line)


if __name__ == "__main__":
    run_file(export)
