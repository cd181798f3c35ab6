"""telerig export: cameras and trajectories in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from telerig.errors import InputError
from telerig.scripts.console import errors_in_words, say

if TYPE_CHECKING:
    from collections.abc import Sequence

    from telerig.io.exchange.export.volume import Volume
    from telerig.rig.camera import Camera


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
            help="Cameras: halcon, opencv, soloff. Trajectories: hdf5, netcdf, mat, trackpy."
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
            help="File to write; a folder for halcon and soloff [DATASET/results/export]."
        ),
    ] = None,
    volume: Annotated[
        str | None,
        typer.Option(
            help="Working volume in mm in the rig frame, 'x,x,y,y,z,z' [what both cameras see]."
        ),
    ] = None,
    full_cubic: Annotated[
        bool, typer.Option("--full-cubic", help="soloff: add the term z^3 (20 terms).")
    ] = False,
    first_pixel: Annotated[
        float, typer.Option(help="soloff: coordinate of the first pixel's centre; MATLAB: 1.")
    ] = 0.0,
) -> None:
    """Write a calibration or a run for HALCON, OpenCV, PIV programs, MATLAB, Python, NetCDF tools.

    Prints how far the exported cameras are from the calibrated ones over the working volume.
    docs/exports.md says what each format holds.

    Exit code 0: written. 2: the input cannot be used, with what, where and what to do.
    """
    with errors_in_words():
        polynomial = {"full_cubic": full_cubic, "first_pixel": first_pixel}
        for line in _export(source, to, run, calibration, out, volume_from(volume), polynomial):
            say(line)


_TRAJECTORIES = ("trajectories.csv", "tracks.csv")
_RESULTS = (*_TRAJECTORIES, "calibration.json")


def _export(
    source: Path,
    to: str,
    run: str | None,
    calibration: Path | None,
    out: Path | None,
    volume: Volume | None,
    polynomial: dict[str, Any],
) -> list[str]:
    from telerig.io.exchange.export.run_results import read_results
    from telerig.io.exchange.export.write import (
        CAMERA_FORMATS,
        RUN_FORMATS,
        SUFFIXES,
        export_cameras,
        export_run,
    )

    if to not in CAMERA_FORMATS + RUN_FORMATS:
        known = ", ".join(CAMERA_FORMATS + RUN_FORMATS)
        raise InputError(f"--to {to}", todo=f"use one of: {known}")
    folder = results_root(source) / "export"
    cameras = cameras_of(source, calibration, required=to in CAMERA_FORMATS)
    if to in CAMERA_FORMATS:
        place = out or folder / f"{to}{SUFFIXES.get(to, '')}"
        words = export_cameras(cameras, to, place, volume=volume, **polynomial)
        behind = [c.name for c in cameras if c.wall is not None]
        if behind and to != "halcon":
            words.append(
                f"for points in the water: what the walls of {', '.join(behind)} do is fitted with "
                "the rest"
            )
    else:
        results = read_results(run_folder(source, run))
        place = out or folder / f"{results.name}{SUFFIXES[to]}"
        words = export_run(results, to, place, cameras)
    return [*words, f"written: {place}"]


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
    """Of --calibration, of a calibration.json, or of the dataset's own; () where there is none."""
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


def volume_from(words: str | None) -> Volume | None:
    """A `Volume` from six numbers; None for None. Raises InputError for anything else."""
    from telerig.io.exchange.export.volume import volume_of

    if words is None:
        return None
    try:
        numbers = [float(word) for word in words.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise InputError(f"--volume {words}", todo="give six numbers: x,x,y,y,z,z in mm")
    return volume_of([numbers[0:2], numbers[2:4], numbers[4:6]])


if __name__ == "__main__":
    typer.run(export)
