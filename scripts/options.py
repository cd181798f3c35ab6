"""Arguments and options that several commands share, each declared once."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from telerig.command_options import Options, SmoothingOptions, TrackingOptions
from telerig.errors import InputError

Dataset = Annotated[
    Path, typer.Argument(help="Dataset folder, with rig.toml and the views in calibration/.")
]
Run = Annotated[Path, typer.Argument(help="Folder of the recording, DATASET/runs/NAME.")]
Runs = Annotated[list[Path], typer.Argument(help="Folders of the recordings, DATASET/runs/NAME.")]
CalibrationFolder = Annotated[
    Path | None,
    typer.Option(help="Results folder [DATASET/results/calibration].", file_okay=False),
]
RunFolder = Annotated[
    Path | None, typer.Option(help="Results folder [DATASET/results/NAME].", file_okay=False)
]
CalibrationFiles = Annotated[
    list[Path] | None,
    typer.Option(
        help="calibration.json, its folder or its dataset; or the OpenLPT camera files in the "
        "order of the cameras, the option once for each "
        "[DATASET/results/calibration/calibration.json]."
    ),
]
GivenCalibration = Annotated[
    Path | None,
    typer.Option(help="A calibration.json to use. Without it each dataset is calibrated."),
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
AcceptedFaults = Annotated[
    list[str] | None,
    typer.Option("--accept", help=SmoothingOptions.settings()["accept"].help),
]
MinDiameter = Annotated[
    float, typer.Option(help=TrackingOptions.settings()["min_diameter_px"].help)
]
MinContrast = Annotated[float, typer.Option(help=TrackingOptions.settings()["min_contrast"].help)]
Report = Annotated[bool, typer.Option(help="Write report.html.")]
View = Annotated[
    bool,
    typer.Option(
        "--view", help="Show it in a viewer while it works; needs pip install 'telerig[view]'."
    ),
]
Quiet = Annotated[bool, typer.Option(help="Print the summary only.")]


def with_options(*, in_batch: bool = False) -> Callable[..., Callable[..., None]]:
    """Decorate a command: its parameters of a class of `Options` become one option for each field.

    in_batch : whether the options get the names that `run` and `batch` give them.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(command, include_extras=True)
        taken: dict[str, dict[str, str]] = {}
        parameters: list[inspect.Parameter] = []
        for parameter in inspect.signature(command).parameters.values():
            kind = hints[parameter.name]
            if isinstance(kind, type) and issubclass(kind, Options):
                options = _typer_options(kind, in_batch)
                parameters += [one for _, one in options]
                taken[parameter.name] = {field: one.name for field, one in options}
            else:
                parameters.append(parameter.replace(annotation=kind))
        for i, parameter in enumerate(parameters):
            if parameter.default is not inspect.Parameter.empty:
                parameters[i] = parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        parameters.sort(key=lambda p: p.kind)

        def spread(**given: Any) -> None:
            for name, fields in taken.items():
                values = {field: given.pop(option) for field, option in fields.items()}
                lists = {f: tuple(values[f] or ()) for f in values if hints[name].repeats(f)}
                given[name] = hints[name](**values | lists)
            command(**given)

        spread.__doc__, spread.__name__ = command.__doc__, command.__name__
        spread.__module__ = command.__module__
        spread.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        spread.__annotations__ = {p.name: p.annotation for p in parameters}
        return spread

    return decorate


def _typer_options(kind: type[Options], in_batch: bool) -> list[tuple[str, inspect.Parameter]]:
    """Return the name of each field and the parameter by which the command line gives it."""
    hints, found = get_type_hints(kind), []
    for field, setting in kind.settings().items():
        flags = (setting.in_batch,) if in_batch else setting.flags
        if not all(flags):
            continue
        default, type_ = getattr(kind, field), hints[field]
        if kind.repeats(field):
            default, type_ = None, list[str] | None
        words = f"{setting.help} {setting.also_there}" if in_batch else setting.help
        name = flags[0].strip("-").replace("-", "_") if in_batch else field
        parameter = inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=default,
            annotation=Annotated[type_, typer.Option(*flags, help=words.strip())],
        )  # fmt: skip
        found.append((field, parameter))
    return found


def split_names(text: str | None) -> list[str] | None:
    """Return the names in a text in which they are separated by commas; None for None."""
    return None if text is None else [name.strip() for name in text.split(",")]


def numbers_of(option: str, text: str, count: int, separator: str, todo: str) -> list[float]:
    """Return the numbers in the text of an option.

    Raises InputError, with the advice ``todo``, if there are not ``count`` finite ones.
    """
    try:
        numbers = [float(word) for word in text.lower().split(separator)]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(isfinite, numbers)):
        raise InputError(f"{option} {text}: {count} numbers are needed", todo=todo)
    return numbers


def size_px(option: str, text: str, separator: str) -> tuple[int, int]:
    """Return the width and height in px in the text of an option, which are whole numbers."""
    todo = f"give width and height, like 1280{separator}800"
    width, height = numbers_of(option, text, 2, separator, todo)
    if not (width.is_integer() and height.is_integer()):
        raise InputError(f"{option} {text}: whole numbers are needed", todo=todo)
    return int(width), int(height)
