"""Arguments and options that several commands share, each declared once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from telerig.errors import InputError
from telerig.rig.lens_parameters import NAMES

Dataset = Annotated[
    Path, typer.Argument(help="Dataset folder, with rig.toml and the views in calibration/.")
]
Run = Annotated[Path, typer.Argument(help="Folder of the recording, DATASET/runs/NAME.")]
Runs = Annotated[list[Path], typer.Argument(help="Folders of the recordings, DATASET/runs/NAME.")]
CalibrationFolder = Annotated[
    Path | None, typer.Option(help="Results folder [DATASET/results/calibration].")
]
RunFolder = Annotated[Path | None, typer.Option(help="Results folder [DATASET/results/NAME].")]
CalibrationFiles = Annotated[
    list[Path] | None,
    typer.Option(
        help="calibration.json, or the two OpenLPT camera files in the order of the cameras "
        "[DATASET/results/calibration/calibration.json]."
    ),
]
GivenCalibration = Annotated[
    Path | None,
    typer.Option(help="A calibration.json to use. Without it each dataset is calibrated."),
]
Model = Annotated[
    str,
    typer.Option(
        help=f"Lens model: auto chooses one per camera. Others: {', '.join(NAMES)}, or several "
        "joined by + (k1+k2). "
        "left=brown,right=auto gives each camera its own."
    ),
]
Medium = Annotated[
    str,
    typer.Option(
        help="Where the target was: air or water. With [walls] in rig.toml, runs are in water."
    ),
]
ModelHere = Annotated[
    str,
    typer.Option(
        help=f"Lens model: auto chooses one per camera. Others: {', '.join(NAMES)}, or several "
        "joined by + (k1+k2). left=brown,right=auto gives each camera its own. With --only smooth "
        "as in `telerig smooth`: auto or default."
    ),
]
ShakeModel = Annotated[
    str | None,
    typer.Option(
        help="Priors of the shake: auto learns what no sensor measures, default fixes them [auto]."
    ),
]
Only = Annotated[
    list[str] | None,
    typer.Option(
        help="calibrate, track or smooth, or the name of a run; can be given several times [all]."
    ),
]
TracksOfRuns = Annotated[
    Path | None,
    typer.Option(
        help="With --only smooth: folder that holds the tracks of each run in a folder of the "
        "run's name [the results folders]."
    ),
]
RefineRig = Annotated[
    bool,
    typer.Option(
        "--refine-rig",
        help="Estimate how a camera has moved against the others since the calibration.",
    ),
]
AcceptedFaults = Annotated[
    list[str] | None,
    typer.Option(
        "--accept",
        help="Use a sensor although it was refused: code of the fault, which the error names. Can "
        "be given several times.",
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        help="Detect bubbles on a Dask cluster: its scheduler's address, tcp://host:port."
    ),
]
Report = Annotated[bool, typer.Option(help="Write report.html.")]
Quiet = Annotated[bool, typer.Option(help="Print the summary only.")]


def split_names(text: str | None) -> list[str] | None:
    """Return the names in a text in which they are separated by commas; None for None."""
    return None if text is None else [name.strip() for name in text.split(",")]


def numbers_of(option: str, text: str, count: int, separator: str, todo: str) -> list[float]:
    """Return the numbers in the text of an option.

    Raises InputError, with the advice ``todo``, if there are not ``count`` of them.
    """
    try:
        numbers = [float(word) for word in text.lower().split(separator)]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise InputError(f"{option} {text}: {count} numbers are needed", todo=todo)
    return numbers


def chosen(option: str, text: str | None, choices: tuple[str, ...]) -> Any:
    """Return the text of an option, or None. Raises InputError if it is none of ``choices``."""
    if text is not None and text not in choices:
        todo = "use " + " or ".join(f"{option} {word}" for word in choices)
        raise InputError(f"{option} {text}: there is no such choice", todo=todo)
    return text
