"""Read a run's results folder for the exports of trajectories, and find that folder."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from os import PathLike
from pathlib import Path

import numpy as np
import pandas as pd

from telerig.arrays import Ints
from telerig.errors import InputError
from telerig.io.files.names import absent
from telerig.io.results.folders.calibration import CalibrationResults
from telerig.io.results.folders.smoothing import SmoothingResults
from telerig.io.results.folders.tracking import TrackResults
from telerig.io.results.manifest import reading
from telerig.io.results.smoothing import SmoothingFile
from telerig.io.results.stale import refuse_stale
from telerig.io.tables.run import TRACKS
from telerig.io.tables.smoothing import SHAKE, TRAJECTORIES
from telerig.rig.camera import Camera

_TRAJECTORIES = ("trajectories.csv", "tracks.csv")
_RESULTS = (*_TRAJECTORIES, "calibration.json")

LAB = (
    "lab: axes of the rig frame, origin where the rig frame's origin is at stage position 0 and "
    "without shake"
)
RIG = "rig: the first camera's frame, which rides on the stage; shake and travel are still in it"


@dataclass(frozen=True)
class RunResults:
    """Hold the results of a run for export.

    frame : the frame of the positions in words: `LAB` (smoothed) or `RIG` (tracked only).
    points : one row per frame and bubble, sorted by particle, then frame; see docs/files.md.
    shake : the table of shake.csv, the cameras' shake; None where the run was not smoothed.
    verdict : verdict of the smoothing with its flags; "" where the run was not smoothed.
    source : the name of the file from which ``points`` was read.
    accepted : why the results are stale, if they were read although they are.
    smoothing : the folder of a smoothed run, which also has the bubbles' shapes; None of others.
    cameras : those that the run was smoothed or tracked with; empty where the folder does not state
        them.
    """

    name: str
    frame: str
    points: pd.DataFrame
    shake: pd.DataFrame | None = None
    verdict: str = ""
    source: str = ""
    accepted: tuple[str, ...] = ()
    smoothing: SmoothingResults | None = None
    cameras: tuple[Camera, ...] = ()


def read_results(folder: str | PathLike[str], *, accept: Collection[str] = ()) -> RunResults:
    """Read `trajectories.csv` of a smoothed run, or else `tracks.csv`, from its results folder.

    accept : ("stale",) also reads results whose inputs have changed. Raises InputError when there
    is neither, for stale results, and for a table that cannot be read.
    """
    place = Path(folder)
    names = [n for n in _TRAJECTORIES if (place / n).is_file()]
    if not names:
        raise InputError(
            "has neither trajectories.csv nor tracks.csv",
            where=str(place),
            todo="run `telerig track`, then `telerig smooth`, or name the run with --run",
        )
    smoothed = names[0] == "trajectories.csv"
    files = (names[0], "shake.csv", "smoothing.json") if smoothed else names[:1]
    with reading(place, (*files, "tracking.json")):
        accepted = refuse_stale(place, files, accept)
        return _read_results(place, names[0], accepted)


def _read_results(place: Path, source: str, accepted: tuple[str, ...]) -> RunResults:
    tracked, lab = TrackResults(place), SmoothingResults(place)
    smoothed = source == "trajectories.csv"
    points = lab.trajectories if smoothed else tracked.tracks
    cameras = lab.file.rig_cameras() if smoothed else ()
    if not cameras and tracked.has("tracking.json"):
        cameras = tracked.file.rig_cameras()
    if not len(points):
        raise InputError(
            "has no rows below its header: no bubble was followed",
            where=str(place / source),
            todo="track the run again (`telerig track`), or export another run (--run)",
        )
    return RunResults(
        name=place.name,
        frame=LAB if smoothed else RIG,
        points=points.sort_values(["particle", "frame"], kind="stable").reset_index(drop=True),
        shake=lab.shake if smoothed and (place / "shake.csv").is_file() else None,
        verdict=_verdict(lab.file) if smoothed else "",
        source=source,
        accepted=accepted,
        smoothing=lab if smoothed else None,
        cameras=cameras,
    )


def _verdict(found: SmoothingFile) -> str:
    """Return the verdict and its flags."""
    flags = ", ".join(found.flags)
    return (found.verdict or "") + (f" ({flags})" if flags else "")


def unit_of(column: str) -> str:
    """Return the unit of a column of trajectories or shake, as UDUNITS has it; "1" for none."""
    found = next(filter(None, (one.column(column) for one in (TRAJECTORIES, TRACKS, SHAKE))), None)
    return (found and found.unit) or "1"


def numbered(points: pd.DataFrame) -> tuple[Ints, list[str]]:
    """Return a whole number for the particle of each row, and the particles' names by this number.

    If the ids of the particles are whole numbers already, they stay as they are, and the list of
    names is empty.
    """
    if points["particle"].dtype.kind == "i":
        return points["particle"].to_numpy(np.int64), []
    codes, names = pd.factorize(points["particle"])
    return codes.astype(np.int64), [str(name) for name in names]


def column_of_that_name(name: str, results: RunResults) -> InputError:
    """Return the error for a column whose name the export gives to another one."""
    return InputError(
        f"has a column {name!r}, a name that this export gives to another one",
        where=results.source,
        todo="rename the column, or export to HDF5, which keeps all names",
    )


def facts(results: RunResults) -> dict[str, str]:
    """Return what an exported file states about its content: run, frame, source and verdict."""
    try:
        made_by = f"telerig {version('telerig')}"
    except PackageNotFoundError:
        made_by = "telerig, not installed"
    return {
        "run": results.name,
        "frame": results.frame,
        "source": f"{made_by}, {results.source}",
        "verdict": results.verdict or "none: tracked, not smoothed",
        **({"accepted": "stale: " + " ".join(results.accepted)} if results.accepted else {}),
    }


def identifier(name: str) -> str:
    """Return a name that MATLAB accepts as a field: letters, digits, _, with a letter first."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII)
    return (plain if plain[:1].isalpha() else f"n_{plain}")[:63]


def results_root(source: Path) -> Path:
    """Return the folder DATASET/results that belongs to a dataset or to something in its results.

    Raises InputError when ``source`` does not exist, or is a folder of another kind.
    """
    if not source.exists():
        raise absent(source, "dataset or folder of results", "check the path")
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


def cameras_of(
    source: Path, calibration: Path | None, *, required: bool, accept: Collection[str] = ()
) -> tuple[tuple[Camera, ...], tuple[str, ...]]:
    """Read calibrated cameras, with their refractive windows, for an export.

    source : a calibration.json, or a dataset or one of its results folders, whose calibration is
        read.
    calibration : a calibration.json to read instead; None for none.
    required : whether InputError is raised if there is no calibration; otherwise there is no camera
        then.
    accept : as in `read_results`.

    Returns the cameras, and why the calibration is stale, if it was read although it is. Raises
    InputError for a calibration that is stale or cannot be read.
    """
    place = calibration
    if place is None:
        own = source.suffix == ".json" or (source / "calibration.json").is_file()
        place = source if own else results_root(source) / "calibration" / "calibration.json"
    if not (required or calibration or place.exists()):
        return (), ()
    found = CalibrationResults.at(place)
    with reading(found.folder, [found.name]):
        accepted = refuse_stale(found.folder, [found.name], accept)
        return found.rig, accepted


def run_folder(source: Path, run: str | None) -> Path:
    """Return the results folder of a run.

    source : a dataset or one of its results folders. run : name of the run, or its folder; None
    takes ``source`` if it is the results folder of a run, otherwise the only run of the dataset
    with results.
    Raises InputError if there is no such run, or if there are several.
    """

    def holds(folder: Path) -> bool:
        files = (folder / name for name in _TRAJECTORIES)
        return not folder.name.startswith(".") and any(file.is_file() for file in files)

    if run is None and holds(source):
        return source
    root = results_root(source)
    if run is not None:
        named = root / Path(run).name
        if not named.is_dir():
            raise absent(named, "folder of results", "run `telerig track` first")
        return named
    found = sorted(p for p in root.iterdir() if holds(p)) if root.is_dir() else []
    if len(found) == 1:
        return found[0]
    names = ", ".join(p.name for p in found)
    raise InputError(
        f"{len(found)} runs have results",
        where=str(root),
        todo=f"name one of these runs with --run: {names}"
        if found
        else "run `telerig track` first",
    )
