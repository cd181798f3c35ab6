"""telerig export: cameras and trajectories in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from telerig.errors import InputError
from telerig.io.exchange.formats import CAMERA_EXPORTS, RUN_EXPORTS, described
from telerig.scripts import options
from telerig.scripts.console import errors_in_words, run_file, say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from telerig.rig.camera import Camera

_TRAJECTORIES = ("trajectories.csv", "tracks.csv")
_RESULTS = (*_TRAJECTORIES, "calibration.json")


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
        str | None, typer.Option(help="Name of the run [the only one with results].")
    ] = None,
    calibration: Annotated[
        Path | None, typer.Option(help="calibration.json [the dataset's own].")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="File to write, or the folder for halcon and soloff [DATASET/results/export]."
        ),
    ] = None,
    volume: Annotated[
        str | None,
        typer.Option(
            help="Working volume in mm in the rig frame, 'x,x,y,y,z,z' [what both cameras see]."
        ),
    ] = None,
    full_cubic: Annotated[
        bool, typer.Option("--full-cubic", help="For soloff: add the term z^3, 20 terms in all.")
    ] = False,
    first_pixel: Annotated[
        float,
        typer.Option(
            help="For soloff: coordinate of the centre of the first pixel; MATLAB counts from 1."
        ),
    ] = 0.0,
) -> None:
    """Write a calibration or a run for HALCON, OpenCV, PIV programs, MATLAB, Python, NetCDF tools.

    Prints how far the exported cameras are from the calibrated ones over the working volume.
    docs/exports.md says what each format holds.

    Exit code 0: written. 2: the input cannot be used; the message says what, where and what to do.
    """
    from telerig.io.exchange.export.run_results import read_results
    from telerig.io.exchange.export.volume import volume_of
    from telerig.io.exchange.formats import export_cameras, export_run

    box = None
    if volume is not None:
        todo = "give six numbers: x,x,y,y,z,z in mm"
        bounds = options.numbers_of("--volume", volume, 6, ",", todo)
        box = volume_of([bounds[0:2], bounds[2:4], bounds[4:6]])
    known = CAMERA_EXPORTS | RUN_EXPORTS
    if to not in known:
        raise InputError(f"--to {to}", todo=f"use one of: {', '.join(known)}")
    folder = results_root(source) / "export"
    cameras = cameras_of(source, calibration, required=to in CAMERA_EXPORTS)
    if to in CAMERA_EXPORTS:
        place = out or folder / f"{to}{known[to].suffix}"
        lines = export_cameras(
            cameras, to, place, volume=box, full_cubic=full_cubic, first_pixel=first_pixel
        )
    else:
        results = read_results(run_folder(source, run))
        place = out or folder / f"{results.name}{known[to].suffix}"
        lines = export_run(results, to, place, cameras)
    for line in [*lines, f"written: {place}"]:
        say(line)


def results_root(source: Path) -> Path:
    """DATASET/results for a dataset, one of its results folders, or a file in one of them.

    Raises InputError when there is nothing at ``source``, or a folder of something else.
    """
    if not source.exists():
        raise InputError("there is no such dataset", where=str(source), todo="check the path")
    place = source.resolve()
    if place.is_file():
        place = place.parent
    if (place / "rig.toml").is_file() or (place / "results").is_dir():
        return place / "results"
    if place.name == "results":
        return place
    if source.is_dir() and not any((place / name).is_file() for name in _RESULTS):
        raise InputError(
            "is neither a dataset nor a folder of results",
            where=str(source),
            todo="give DATASET, or DATASET/results/NAME after `telerig track`",
        )
    return place.parent


def cameras_of(source: Path, calibration: Path | None, *, required: bool) -> Sequence[Camera]:
    """The cameras of --calibration, of ``source`` or of its dataset; () where there are none.

    Raises InputError when there are none and they are required.
    """
    from telerig.estimator.calibration.result.calibration import load_calibration

    trials = [results_root(source) / "calibration" / "calibration.json"]
    if source.suffix == ".json":
        trials.insert(0, source)
    elif (source / "calibration.json").is_file():
        trials.insert(0, source / "calibration.json")
    place = calibration or next((p for p in trials if p.is_file()), None)
    if place is not None:
        return load_calibration(place).cameras
    if required:
        raise InputError(
            "there is no calibration",
            where=str(trials[0]),
            todo="run `telerig calibrate` first, or give one with --calibration",
        )
    return ()


def run_folder(source: Path, run: str | None) -> Path:
    """The results folder of a run.

    Raises InputError when it is not there, or when none of several was named.
    """

    def holds(folder: Path) -> bool:
        files = (folder / name for name in _TRAJECTORIES)
        return not folder.name.startswith(".") and any(file.is_file() for file in files)

    if run is None and holds(source):
        return source
    root = results_root(source)
    if run is not None:
        return root / run
    found = sorted(p for p in root.iterdir() if holds(p)) if root.is_dir() else []
    if len(found) == 1:
        return found[0]
    names = ", ".join(p.name for p in found)
    raise InputError(
        f"{len(found)} runs have results",
        where=str(root),
        todo=f"name one with --run: {names}" if found else "run `telerig track` first",
    )


if __name__ == "__main__":
    run_file(export)
