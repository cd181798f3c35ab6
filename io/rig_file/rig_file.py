"""Read and write `rig.toml`: all that is known of a rig before calibration."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import Any

from telerig.errors import InputError, suggestion
from telerig.io.files.atomic import write_text_atomic
from telerig.io.rig_file.description import CARRIAGE, SCHEMA, CameraDescription, RigDescription
from telerig.io.rig_file.devices import devices_from_tables
from telerig.io.rig_file.parts import (
    accelerometers_from_tables,
    references_from_table,
    rotvec_from_table,
    stage_from_table,
    subtables,
    walls_from_tables,
)
from telerig.io.rig_file.schema import TOP_LEVEL, CameraTable, Problem, TargetTable, validate
from telerig.io.rig_file.target import target_from_table, target_problems
from telerig.io.rig_file.writer import rig_toml
from telerig.rig.target import Target


def read_rig_toml(path: str | PathLike[str]) -> RigDescription:
    """Read and check a rig file.

    Directions come out as unit vectors, sigmas with their defaults filled in. Raises one
    InputError that lists every fault with its table, its key and what to do.
    """
    file = Path(path)
    return description_from_toml(_text(file), where=str(file), name=file.resolve().parent.name)


def write_rig_toml(rig: RigDescription, path: str | PathLike[str]) -> None:
    """Write a rig file that `read_rig_toml` gives back unchanged.

    Raises InputError when a rig file could not be read that holds this description.
    """
    text = rig_toml(rig)
    description_from_toml(text, where=str(path))
    write_text_atomic(path, text)


def description_from_toml(text: str, *, where: str, name: str = "rig") -> RigDescription:
    """The rig described by the text of a rig file; ``name`` is used when the text gives none."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(
            f"is not valid TOML: {error}",
            where=where,
            todo="correct that line: strings need quotes, each key stands once, "
            "keys follow their [table]",
        ) from error
    _check_schema(raw, where)
    problems = list(_top_level_problems(raw))
    rig = _description(raw, name, problems)
    if problems or rig is None:
        raise _as_error(problems, where)
    return rig


def _text(file: Path) -> str:
    try:
        return file.read_bytes().decode("utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(
            "does not exist", where=str(file), todo="write one with `telerig init`"
        ) from error
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}",
            where=str(file),
            todo="check that it is a file and its permissions",
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(
            f"is not UTF-8 text (byte {error.start})",
            where=str(file),
            todo="save it as UTF-8 in your editor",
        ) from error


def _check_schema(raw: dict[str, Any], where: str) -> None:
    """A file of another schema is refused before its keys are looked at."""
    schema, place = raw.get("schema"), f"{where} schema"
    if schema is None:
        raise InputError("is missing", where=place, todo=f"begin the file with schema = {SCHEMA}")
    if not isinstance(schema, int) or isinstance(schema, bool) or schema < 1:
        raise InputError(f"is {schema!r}", where=place, todo=f"write schema = {SCHEMA}")
    if schema > SCHEMA:
        raise InputError(
            f"is {schema}, newer than the {SCHEMA} that this telerig reads",
            where=place,
            todo="install a newer telerig",
        )


def _as_error(problems: list[Problem], where: str) -> InputError:
    if len(problems) == 1:
        only = problems[0]
        return InputError(only.what, where=f"{where} {only.place}", todo=only.todo)
    lines = [f"{len(problems)} problems"]
    lines += [f"  {p.place}: {p.what}\n    -> {p.todo}" for p in problems]
    return InputError("\n".join(lines), where=where, todo="correct them all, then try again")


def _top_level_problems(raw: dict[str, Any]) -> Iterator[Problem]:
    todos = {key: suggestion(key, TOP_LEVEL) for key in raw if key not in TOP_LEVEL}
    for key, todo in todos.items():
        place = (f"{key}", "") if isinstance(raw[key], dict) else ("", key)
        yield Problem(*place, "unknown table" if place[0] else "unknown key", todo)
    for table in ("cameras", "target"):
        if raw.get(table, {}) == {} and f"did you mean {table}?" not in todos.values():
            example = "[cameras.left]" if table == "cameras" else "[target]"
            yield Problem(table, "", "is missing", f"add a table {example}; see `telerig init`")
    if not isinstance(raw.get("name", ""), str):
        yield Problem("", "name", f"is {raw['name']!r}", 'must be text, like name = "tank 2"')


def _description(raw: dict[str, Any], name: str, problems: list[Problem]) -> RigDescription | None:
    cameras = _cameras(raw.get("cameras", {}), problems)
    names = list(cameras)
    target = _target(raw, problems)
    rotvec = rotvec_from_table(raw, names, problems)
    stage = stage_from_table(raw, names, problems)
    accelerometers = accelerometers_from_tables(raw, names, problems)
    references = references_from_table(raw, problems)
    walls = walls_from_tables(raw, cameras, problems)
    devices = devices_from_tables(raw, names, problems)
    if problems or target is None:
        return None
    return RigDescription(
        name=raw.get("name", name),
        cameras={key: camera for key, camera in cameras.items() if camera is not None},
        target=target,
        second_from_first_rotvec_deg=rotvec,
        stage=stage,
        accelerometers=accelerometers,
        references=references,
        walls=walls,
        devices=devices,
    )


def _cameras(raw: Any, problems: list[Problem]) -> dict[str, CameraDescription | None]:
    """Every camera named in the file, in its order; None where its table is faulty."""
    tables = subtables(raw, "cameras", problems)
    problems += _camera_name_problems(list(tables))
    cameras: dict[str, CameraDescription | None] = {}
    for name, table in tables.items():
        checked, found = validate(CameraTable, table, f"cameras.{name}")
        problems += found
        cameras[name] = None
        if checked is not None and not found:
            width, height = checked.image_size_px
            size, scale = (width, height), checked.scale_px_per_mm
            cameras[name] = CameraDescription(name, size, scale, checked.telecentricity_per_mm)
    return cameras


def _camera_name_problems(names: list[str]) -> Iterator[Problem]:
    for name in names:
        if not re.fullmatch(r"\w[\w-]*", name):
            yield Problem(
                f'cameras."{name}"',
                "",
                "the name cannot be used for a folder",
                "use letters, digits, _ and - only",
            )
        if name.lower() == CARRIAGE:
            yield Problem(
                f"cameras.{name}",
                "",
                f'"{CARRIAGE}" means the stage in mounted_on',
                "give the camera another name",
            )
    if len({name.lower() for name in names}) < len(names):
        yield Problem(
            "cameras",
            "",
            "two names differ only in upper and lower case",
            "give the cameras names that any file system keeps apart",
        )
    if len(names) > 2:
        yield Problem(
            "cameras",
            "",
            f"has {len(names)} cameras ({', '.join(names)}); telerig works with one or two for now",
            "keep two; write another dataset for another pair",
        )


def _target(raw: dict[str, Any], problems: list[Problem]) -> Target | None:
    if "target" not in raw:
        return None
    table, found = validate(TargetTable, raw["target"], "target")
    faulty = {key for problem in found for key in (problem.key, *problem.involved)}
    if table is not None:
        found += target_problems(table, faulty)
    problems += found
    return target_from_table(table) if table is not None and not found else None
