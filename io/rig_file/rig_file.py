"""Read and write `rig.toml`: all that is known of a rig before calibration."""

from __future__ import annotations

from dataclasses import dataclass, make_dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from telerig.errors import InputError, nearest, suggestion
from telerig.io.files.atomic import write_text_atomic
from telerig.io.files.text import read_text
from telerig.io.files.toml import toml_content
from telerig.io.rig_file.camera_names import camera_name_faults
from telerig.io.rig_file.description import (
    CARRIAGE,
    MOST_CAMERAS,
    SCHEMA,
    AccelerometerDescription,
    CameraDescription,
    FieldDescription,
    FluidDescription,
    ReferencesDescription,
    RigDescription,
    StageDescription,
    Table,
    Vector,
    WallDescription,
    rotvec_key,
)
from telerig.io.rig_file.devices import devices_from_tables
from telerig.io.rig_file.tables import Problem, Problems, field_types, read_table, subtables
from telerig.io.rig_file.target import TargetTable, target_problems
from telerig.io.rig_file.writer import rig_toml, toml_key
from telerig.rig.target import Target

TOP_LEVEL = [
    *("schema", "name", "cameras", "stereo", "target"),
    *("stage", "accelerometers", "devices", "references", "walls", "tracking", "bubbles", "fluid"),
]

_CORRECT = "correct that line: strings need quotes, each key stands once, keys follow their [table]"
_LISTED_PROBLEMS = 15
_GRAZING = np.cos(np.deg2rad(85.0))

_HOMES = {
    key: f"{key} belongs under [{table}]"
    for table, kind in (
        ("stage", StageDescription),
        ("accelerometers.<name>", AccelerometerDescription),
        ("walls.<camera>", WallDescription),
        ("fluid", FluidDescription),
        ("target", TargetTable),
        ("cameras.<name>", CameraDescription),
    )
    for key in field_types(kind)
    if (table, key) not in (("stage", "axis"), ("stage", "up"))  # axis_<camera> in the file
} | {
    key: f"{key} belongs at the top of the file, above the first [table]"
    for key in ("schema", "name")
}
"""Where a key belongs that stands in a wrong table."""


_ROTVEC_DEG = Annotated[
    Vector | None, Field(description="three numbers in degrees, like [0.0, 90.0, 0.0]")
]


@dataclass(frozen=True)
class _TrackingTable(Table):
    cameras: Annotated[
        tuple[str, ...],
        Field(min_length=2, description='the names of cameras, like ["left", "right"]'),
    ]


def read_rig_toml(path: str | PathLike[str]) -> RigDescription:
    """Read and check a rig.toml; directions are returned as unit vectors.

    Raises one InputError that lists every fault with its table, its key and what to do.
    """
    file = Path(path)
    text = read_text(file, missing="write one with `telerig init`")
    return description_from_toml(text, where=str(file), name=file.resolve().parent.name)


def write_rig_toml(rig: RigDescription, path: str | PathLike[str]) -> None:
    """Write a rig.toml that gives the same description when it is read again.

    Raises InputError for a description that cannot be written so.
    """
    text = rig_toml(rig)
    description_from_toml(text, where=str(path))
    write_text_atomic(path, text)


def description_from_toml(text: str, *, where: str, name: str = "rig") -> RigDescription:
    """Return the rig that the text of a rig.toml describes; raises one InputError with every fault.

    where : the file that errors name. name : the rig's name, used when the text states none.
    """
    raw = toml_content(text, where, _CORRECT)
    _check_schema(raw, where)
    problems = Problems()
    _check_top_level(raw, problems)
    rig = _description(raw, name, problems)
    if problems or rig is None:
        raise _as_error(problems, where)
    return rig


def _check_schema(raw: dict[str, Any], where: str) -> None:
    """Refuse a file of another schema before its keys are looked at."""
    schema, place = raw.get("schema"), f"{where} schema"
    if schema is None:
        raise InputError("is missing", where=place, todo=f"begin the file with schema = {SCHEMA}")
    if not isinstance(schema, int) or isinstance(schema, bool) or schema < 1:
        raise InputError(
            f"is {schema!r}; the version of the file format must be a whole number, at least 1",
            where=place,
            todo=f"write schema = {SCHEMA}; the other lines may stay as they are",
        )
    if schema > SCHEMA:
        raise InputError(
            f"is {schema}; this telerig reads the file format up to version {SCHEMA}",
            where=place,
            todo="install a newer telerig",
        )


def _as_error(problems: list[Problem], where: str) -> InputError:
    if len(problems) == 1:
        only = problems[0]
        return InputError(only.what, where=f"{where} {only.place}", todo=only.todo)
    lines = [f"{len(problems)} problems"]
    listed = problems[:_LISTED_PROBLEMS]
    lines += [f"  {p.place}: {p.what}\n    -> {p.todo}" for p in listed]
    if len(problems) > len(listed):
        lines.append(f"  and {len(problems) - len(listed)} more")
    return InputError("\n".join(lines), where=where, todo="correct them all, then try again")


def _check_top_level(raw: dict[str, Any], problems: Problems) -> None:
    unknown = [key for key in raw if key not in TOP_LEVEL]
    for key in unknown:
        table, name, kind = (key, "", "table") if isinstance(raw[key], dict) else ("", key, "key")
        problems.add(table, name, f"unknown {kind}", suggestion(key, TOP_LEVEL))
    meant = {nearest(key, TOP_LEVEL) for key in unknown}
    for table, example in (("cameras", "[cameras.left]"), ("target", "[target]")):
        if raw.get(table, {}) == {} and table not in meant:
            todo = f"add a table {example}; see `telerig init`"
            problems.add(table, "", "is missing", todo)
    if not isinstance(raw.get("name", ""), str):
        problems.add("", "name", f"is {raw['name']!r}", 'must be text, like name = "tank 2"')


def _description(raw: dict[str, Any], name: str, problems: Problems) -> RigDescription | None:
    cameras = _cameras(raw, problems)
    names = list(cameras)
    target = _target(raw, problems)
    rotvecs = _rotvecs_deg(raw, names, problems)
    tracking = _tracking(raw, names, problems)
    stage = _stage(raw, names, problems)
    accelerometers = _accelerometers(raw, names, problems)
    references = _references(raw, problems)
    walls = _walls(raw, cameras, problems)
    bubbles = _bubbles(raw, names, problems)
    fluid = _fluid(raw, problems)
    devices = devices_from_tables(raw, names, problems)
    if problems or target is None:
        return None
    return RigDescription(
        name=raw.get("name", name),
        cameras={key: camera for key, camera in cameras.items() if camera is not None},
        target=target,
        rotvec_from_first_deg=rotvecs,
        tracking=tracking,
        stage=stage,
        accelerometers=accelerometers,
        references=references,
        walls=walls,
        devices=devices,
        bubbles=bubbles,
        fluid=fluid,
    )


def _cameras(raw: dict[str, Any], problems: Problems) -> dict[str, CameraDescription | None]:
    """Return every camera named in the file, in its order; None where its table is faulty."""
    tables = subtables(raw, "cameras", problems)
    _check_camera_names(list(tables), problems)
    cameras: dict[str, CameraDescription | None] = {}
    for name, table in tables.items():
        place, before = f"cameras.{name}", len(problems)
        camera = read_table(CameraDescription, table, place, problems, homes=_HOMES, name=name)
        cameras[name] = camera if len(problems) == before else None
    return cameras


def _check_camera_names(names: list[str], problems: Problems) -> None:
    for fault in camera_name_faults(names):
        problems.add(f"cameras.{toml_key(fault.name)}", "", fault.what, fault.todo)
    if len(names) > MOST_CAMERAS:
        what = f"has {len(names)} cameras ({', '.join(names)}); a rig has {MOST_CAMERAS} at most"
        todo = f"keep {MOST_CAMERAS}; write another dataset for the others"
        problems.add("cameras", "", what, todo)


def _target(raw: dict[str, Any], problems: Problems) -> Target | None:
    if "target" not in raw:
        return None
    found = Problems()
    table = read_table(TargetTable, raw["target"], "target", found, homes=_HOMES)
    faulty = {key for problem in found for key in (problem.key, *problem.involved)}
    if table is not None:
        found += target_problems(table, faulty)
    problems += found
    return table.target() if table is not None and not found else None


def _rotvecs_deg(raw: dict[str, Any], names: list[str], problems: Problems) -> dict[str, Vector]:
    """Return the nominal rotation of every camera but the first, of those that the file gives."""
    if "stereo" not in raw or not names:
        return {}
    if len(names) == 1:
        what = f"is given, but {names[0]} is the only camera"
        problems.add("stereo", "", what, "remove it, or add the second [cameras.<name>]")
        return {}
    camera_of = {f"rotvec_{i}_deg": name for i, name in enumerate(names[1:], 1)}
    kind = make_dataclass(
        "_StereoTable",
        [(field, _ROTVEC_DEG, None) for field in camera_of],
        bases=(Table,),
        frozen=True,
    )
    keys = {field: rotvec_key(name, names[0]) for field, name in camera_of.items()}
    table = read_table(kind, raw["stereo"], "stereo", problems, homes=_HOMES, keys=keys)
    found = {name: getattr(table, field, None) for field, name in camera_of.items()}
    return {name: rotvec for name, rotvec in found.items() if rotvec is not None}


def _tracking(raw: dict[str, Any], names: list[str], problems: Problems) -> tuple[str, ...] | None:
    """Return the cameras of `[tracking]`, in the order of the rig."""
    if "tracking" not in raw or not names:
        return None
    if len(names) == 1:
        what = f"is given, but {names[0]} is the only camera"
        problems.add("tracking", "", what, "remove it, or add the second [cameras.<name>]")
        return None
    table = read_table(_TrackingTable, raw["tracking"], "tracking", problems, homes=_HOMES)
    if table is None:
        return None
    for name in table.cameras:
        if name not in names:
            what = f"there is no camera {name!r}"
            problems.add("tracking", "cameras", what, suggestion(name, names))
    twice = [name for name in names if table.cameras.count(name) > 1]
    if twice:
        what = f"names {twice[0]!r} twice"
        problems.add("tracking", "cameras", what, "name two cameras or more, each once")
    if set(table.cameras) - set(names):
        return None
    return tuple(sorted(table.cameras, key=names.index))


def _stage(raw: dict[str, Any], names: list[str], problems: Problems) -> StageDescription | None:
    if "stage" not in raw or not names:
        return None
    keys = {"axis": f"axis_{names[0]}", "up": f"up_{names[0]}"}
    content, upright = raw["stage"], False
    if isinstance(content, dict) and keys["up"] not in content:
        content, upright = {keys["up"]: [0.0, 0.0, 1.0]} | content, True
    stage = read_table(StageDescription, content, "stage", problems, homes=_HOMES, keys=keys)
    if stage is None:
        return None
    axis = _unit(stage.axis, "stage", keys["axis"], problems)
    up = axis if upright else _unit(stage.up, "stage", keys["up"], problems)
    return replace(stage, axis=axis, up=up)


def _accelerometers(
    raw: dict[str, Any], names: list[str], problems: Problems
) -> dict[str, AccelerometerDescription]:
    out: dict[str, AccelerometerDescription] = {}
    mounts = [*names, CARRIAGE]
    for name, content in subtables(raw, "accelerometers", problems).items():
        place = f"accelerometers.{name}"
        sensor = read_table(
            AccelerometerDescription, content, place, problems, homes=_HOMES, name=name
        )
        if sensor is None:
            continue
        if sensor.mounted_on not in mounts:
            what = f'is {sensor.mounted_on!r}, which is neither a camera nor "{CARRIAGE}"'
            problems.add(place, "mounted_on", what, suggestion(sensor.mounted_on, mounts))
        x, y, z = (_unit(row, place, f"axes[{i}]", problems) for i, row in enumerate(sensor.axes))
        if abs(np.linalg.det([x, y, z])) < 0.1 and all(map(any, sensor.axes)):
            what = "has rows that lie (nearly) in one plane"
            problems.add(place, "axes", what, "give the three directions of the sensor's axes")
        out[name] = replace(sensor, axes=(x, y, z))
    return out


def _references(raw: dict[str, Any], problems: Problems) -> ReferencesDescription | None:
    if "references" not in raw:
        return None
    return read_table(
        ReferencesDescription, raw["references"], "references", problems, homes=_HOMES
    )


def _fluid(raw: dict[str, Any], problems: Problems) -> FluidDescription | None:
    if "fluid" not in raw:
        return None
    fluid = read_table(FluidDescription, raw["fluid"], "fluid", problems, homes=_HOMES)
    if fluid is not None and fluid.gas_density_kg_m3 >= fluid.density_kg_m3:
        what = f"is {fluid.gas_density_kg_m3:g}, not below density_kg_m3"
        problems.add("fluid", "gas_density_kg_m3", what, "bubbles are lighter than the liquid")
    return fluid


def _bubbles(
    raw: dict[str, Any], names: list[str], problems: Problems
) -> dict[str, FieldDescription]:
    """Return each camera's field; `[bubbles]` is for all, `[bubbles.<camera>]` for one of them."""
    content = raw.get("bubbles", {})
    if not isinstance(content, dict):
        problems.add("", "bubbles", f"is {content!r:.80}, must be a table", "write [bubbles]")
        return {}
    own = {key: value for key, value in content.items() if isinstance(value, dict)}
    common = {key: value for key, value in content.items() if key not in own}
    for key in sorted(set(own) - set(names)):
        problems.add(f"bubbles.{key}", "", f"there is no camera {key!r}", suggestion(key, names))
    whole = read_table(FieldDescription, common, "bubbles", problems, homes=_HOMES, camera="")
    out = {}
    for name in names:
        found = None if whole is None else replace(whole, camera=name)
        if name in own:
            place = f"bubbles.{name}"
            found = read_table(
                FieldDescription, own[name], place, problems, homes=_HOMES, camera=name
            )
        if found is not None and (found.region, found.mask) != (None, None):
            out[name] = found
    return out


def _walls(
    raw: dict[str, Any], cameras: dict[str, CameraDescription | None], problems: Problems
) -> dict[str, WallDescription]:
    out: dict[str, WallDescription] = {}
    for name, content in subtables(raw, "walls", problems).items():
        place = f"walls.{name}"
        if name not in cameras:
            what = f"there is no camera {name!r}"
            problems.add(place, "", what, suggestion(name, list(cameras)))
        wall = read_table(WallDescription, content, place, problems, homes=_HOMES, camera=name)
        if wall is not None:
            normal = _unit(wall.normal, place, "normal", problems)
            _check_wall(place, normal, wall, cameras.get(name), problems)
            x, y, z = (float(np.copysign(1.0, normal[2])) * component for component in normal)
            out[name] = replace(wall, normal=(x, y, z))
    return out


def _check_wall(
    place: str,
    normal: Vector,
    wall: WallDescription,
    camera: CameraDescription | None,
    problems: Problems,
) -> None:
    if any(wall.normal) and abs(normal[2]) < _GRAZING:
        what = f"is {list(wall.normal)}: the camera would look along the wall"
        todo = (
            "give it in the camera's frame, where z points into the scene; a wall that faces the "
            "camera is [0.0, 0.0, 1.0]"
        )
        problems.add(place, "normal", what, todo)
    if camera is not None and camera.telecentricity_per_mm and wall.distance_mm is None:
        key = f"cameras.{camera.name}.telecentricity_per_mm"
        what = f"is missing, and needed because {key} is not 0"
        todo = "add distance_mm from the camera's origin to the wall"
        problems.add(place, "distance_mm", what, todo)


def _unit(vector: Vector, table: str, key: str, problems: Problems) -> Vector:
    """Return the direction of ``vector``; vectors that are unit to 1e-12 keep their digits."""
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        problems.add(table, key, "has length zero", "give a direction")
        return 0.0, 0.0, 0.0
    x, y, z = vector
    return vector if abs(length - 1) < 1e-12 else (x / length, y / length, z / length)
