"""The tables of `rig.toml` as pydantic models, and their faults in the user's words."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from telerig.errors import suggestion

Positive = Annotated[float, Field(gt=0)]
Triple = Annotated[list[float], Field(min_length=3, max_length=3)]
Pair = Annotated[list[float], Field(min_length=2, max_length=2)]
PositivePair = Annotated[list[Positive], Field(min_length=2, max_length=2)]
PixelPair = Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=2, max_length=2)]
Cell = Annotated[list[int], Field(min_length=2, max_length=2)]
CellPair = Annotated[list[Cell], Field(min_length=2, max_length=2)]
Colours = Literal["white_on_black", "black_on_white"]


@dataclass(frozen=True)
class Problem:
    """One fault of the file: in which table, at which key, what it is and what to do.

    involved : further keys of the same table on which the fault depends.
    """

    table: str
    key: str
    what: str
    todo: str
    involved: tuple[str, ...] = ()

    @property
    def place(self) -> str:
        return " ".join(p for p in (f"[{self.table}]" if self.table else "", self.key) if p)


TOP_LEVEL = [
    "schema",
    "name",
    "cameras",
    "stereo",
    "target",
    "stage",
    "accelerometers",
    "devices",
    "references",
    "walls",
]


class Table(BaseModel):
    """No unknown keys, no text for numbers, no NaN. A field's description completes "must be"."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class CameraTable(Table):
    image_size_px: PixelPair = Field(description="[width, height] in whole pixels")
    scale_px_per_mm: Positive = Field(description="a positive number, nominal, like 10.0")
    telecentricity_per_mm: float | None = Field(
        None, description="a number: 0.0 telecentric, 1 / working distance for a perspective lens"
    )


class StereoTable(Table):
    rotvec: Triple | None = None


class TargetTable(Table):
    layout: Literal["grid", "points"] = Field("grid", description='"grid" or "points"')
    rows: Annotated[int, Field(ge=1)] | None = Field(None, description="a whole number from 1")
    columns: Annotated[int, Field(ge=1)] | None = Field(None, description="a whole number from 1")
    pitch_mm: Positive | PositivePair | None = Field(
        None, description="a positive number or [x, y] of them"
    )
    points_mm: Annotated[list[Pair], Field(min_length=1)] | None = Field(
        None, description="a list of [x, y]"
    )
    dot_diameter_mm: Positive = Field(description="a positive number")
    polarity: Colours = Field("white_on_black", description='"white_on_black" or "black_on_white"')
    marks: list[Cell] = Field([], description="a list of [row, column] in whole numbers")
    mark_style: Literal["large", "ring", "missing"] = Field(
        "large", description='"large", "ring" or "missing"'
    )
    mark_diameter_mm: Positive | None = Field(None, description="a positive number")
    extent: Literal["bounded", "unbounded"] = Field(
        "bounded", description='"bounded" or "unbounded"'
    )
    print_sigma_mm: Positive = Field(0.02, description="a positive number")
    flatness_sigma_mm: Positive | None = Field(None, description="a positive number")
    scale_dots: Cell | CellPair | None = Field(
        None, description="two dot numbers or two [row, column]"
    )
    scale_distance_mm: Positive | None = Field(None, description="a positive number")
    scale_sigma_mm: Positive = Field(0.001, description="a positive number")
    two_sided: bool = Field(False, description="true or false")
    plate_thickness_mm: Positive | None = Field(None, description="a positive number")
    plate_index: Annotated[float, Field(ge=1)] | None = Field(
        None, description="a refractive index, 1 or more"
    )


class StageTable(Table):
    axis: Triple
    up: Triple | None = None
    position_sigma_mm: Positive = Field(0.005, description="a positive number")
    scale_sigma: Annotated[float, Field(ge=0, lt=0.5)] | None = Field(
        None, description="a share like 0.001: how far the encoder's scale may be off"
    )


class AccelerometerTable(Table):
    mounted_on: str = Field(description='a camera\'s name or "carriage"')
    axes: Annotated[list[Triple], Field(min_length=3, max_length=3)] = Field(
        description="three rows of three numbers: the sensor's x, y, z axes in rig coordinates"
    )
    noise_density_ug_sqrt_hz: Positive = Field(
        description="a positive number in micro-g per root hertz (the sensor's data sheet)"
    )
    bias_sigma_m_s2: Positive = Field(0.2, description="a positive number")


class ReferencesTable(Table):
    kind: Literal["dots"] = Field("dots", description='"dots"')
    polarity: Colours = Field("black_on_white", description='"white_on_black" or "black_on_white"')
    dot_diameter_mm: Positive = Field(description="a positive number")


class WallTable(Table):
    normal: Triple = Field(description="three numbers in the camera's frame, like [0.0, 0.0, 1.0]")
    indices: Annotated[list[Annotated[float, Field(ge=1)]], Field(min_length=3, max_length=3)] = (
        Field(description="three refractive indices of 1 or more, like [1.0, 1.52, 1.333]")
    )
    thickness_mm: Positive = Field(description="a positive number")
    distance_mm: float | None = Field(None, description="a number, negative before the origin")
    normal_sigma_deg: Annotated[float, Field(ge=0, le=10)] = Field(
        0.0, description="degrees from 0 to 10"
    )


def stereo_table(first: str, second: str) -> type[StereoTable]:
    """The table [stereo] with its key named after the cameras."""
    key = Field(
        None,
        alias=f"{second}_from_{first}_rotvec_deg",
        description="three numbers in degrees, like [0.0, 90.0, 0.0]",
    )
    return create_model("StereoTable", __base__=StereoTable, rotvec=(Triple | None, key))


def stage_table(first: str) -> type[StageTable]:
    """The table [stage] with its keys named after the first camera."""
    vector = "three numbers, a direction in the rig frame, like [0.0, -1.0, 0.0]"
    axis = Field(alias=f"axis_{first}", description=vector)
    up = Field(None, alias=f"up_{first}", description=vector)
    return create_model(
        "StageTable", __base__=StageTable, axis=(Triple, axis), up=(Triple | None, up)
    )


AnyTable = TypeVar("AnyTable", bound=Table)


def validate(model: type[AnyTable], raw: Any, table: str) -> tuple[AnyTable | None, list[Problem]]:
    """Check one table; with faults, also what the sound keys alone give (None if not enough)."""
    if not isinstance(raw, dict):
        what = f"is {_short(raw)}, must be a table"
        return None, [Problem("", table, what, f"write a line [{table}] with its keys below it")]
    try:
        return model.model_validate(raw), []
    except ValidationError as error:
        problems = _problems(model, error, table, raw)
    faulty = {key for problem in problems for key in (problem.key, *problem.involved)}
    try:
        sound = {key: value for key, value in raw.items() if key not in faulty}
        return model.model_validate(sound), problems
    except ValidationError:
        return None, problems


def fields_of(model: type[Table]) -> dict[str, str]:
    """Every key that the table may have, with its description."""
    return {f.alias or name: f.description or "" for name, f in model.model_fields.items()}


def _problems(
    model: type[Table], error: ValidationError, table: str, raw: dict[str, Any]
) -> list[Problem]:
    known, found = fields_of(model), error.errors(include_url=False)
    problems: dict[str, Problem] = {}
    given = {str(e["loc"][0]) for e in found if e["type"] == "extra_forbidden"}
    for key in sorted(given):
        todo = _home(key) or suggestion(key, list(known))
        meant = tuple(k for k in known if todo == f"did you mean {k}?" and k not in raw)
        problems[key] = Problem(table, key, "unknown key", todo, meant)
    mistyped = {key for problem in problems.values() for key in problem.involved}
    for fault in found:
        key = str(fault["loc"][0])
        if fault["type"] == "missing" and len(fault["loc"]) == 1:
            if key not in mistyped:
                problems[key] = Problem(table, key, "is missing", f"add {key}: {known[key]}")
        elif key not in problems:
            problems[key] = _wrong_value(table, key, known[key], fault)
    return list(problems.values())


def _home(key: str) -> str:
    """Where a key belongs that stands in the wrong table."""
    if key in TOP_LEVEL[:2]:
        return f"{key} belongs at the top of the file, above the first [table]"
    tables: dict[str, type[Table]] = {
        "cameras.<name>": CameraTable,
        "target": TargetTable,
        "walls.<camera>": WallTable,
        "accelerometers.<name>": AccelerometerTable,
    }
    homes = [table for table, model in tables.items() if key in model.model_fields]
    return f"{key} belongs under [{homes[0]}]" if homes else ""


def _wrong_value(table: str, key: str, wanted: str, fault: Any) -> Problem:
    position = "".join(f"[{i}]" for i in fault["loc"][1:] if isinstance(i, int))
    what = f"{'item ' + position + ' ' if position else ''}is {_short(fault['input'])}"
    todo = f"must be {wanted}"
    if fault["type"] == "literal_error" and isinstance(fault["input"], str):
        near = suggestion(fault["input"], wanted.split('"')[1::2])
        todo += f": {near}" if near.startswith("did") else ""
    return Problem(table, key, what, todo)


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    brief = reprlib.Repr()
    brief.maxstring = 60
    return brief.repr(value)
