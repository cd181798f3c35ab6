"""One table of `rig.toml` against the type that describes it: the object, or what is wrong."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from pydantic import TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from telerig.errors import nearest, suggestion
from telerig.io.files.names import ADVICE, fault_of_name
from telerig.io.rig_file.description import Table

AnyTable = TypeVar("AnyTable", bound=Table)


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
        """Return where in rig.toml the problem is, like "[cameras.left] image_size_px"."""
        return " ".join(p for p in (f"[{self.table}]" if self.table else "", self.key) if p)


class Problems(list[Problem]):
    """Collects all faults of a file, so that one error can report them together.

    It raises nothing itself: the function that reads the whole file raises the error at its end.
    """

    def add(self, table: str, key: str, what: str, todo: str, *involved: str) -> None:
        """Append a `Problem` with these fields."""
        self.append(Problem(table, key, what, todo, involved))


def read_table(
    kind: type[AnyTable],
    raw: Any,
    table: str,
    problems: Problems,
    *,
    homes: Mapping[str, str],
    keys: Mapping[str, str] | None = None,
    **fixed: Any,
) -> AnyTable | None:
    """Return the object that a table of rig.toml describes; faults are added to ``problems``.

    kind : the dataclass of the object; its annotated fields are the keys of the table.
    raw : content of the table.
    table : its name.
    homes : for keys that users often write into a wrong table, the table to which they belong.
    keys : the keys of fields that have another name in the file. fixed : values of fields that are
        not in the file.

    If keys are faulty, the object is made from the others; None if these are not enough.
    """
    if not isinstance(raw, dict):
        todo = f"write a line [{table}] with its keys below it"
        problems.add("", table, f"is {_short(raw)}, must be a table", todo)
        return None
    types: dict[str, Any] = field_types(kind)  # type: ignore[arg-type]
    key_of = {name: (keys or {}).get(name, name) for name in types if name not in fixed}
    known = {key: types[name] for name, key in key_of.items()}
    found: dict[str, Problem] = {}
    for key in sorted(key for key in raw if key not in known):
        near = nearest(key, list(known))
        meant = (near,) if near and near not in raw and key not in homes else ()
        todo = homes.get(key) or suggestion(key, list(known))
        found[key] = Problem(table, key, "unknown key", todo, meant)
    mistyped = {key for problem in found.values() for key in problem.involved}
    content = {name: raw[key] for name, key in key_of.items() if key in raw}
    out: AnyTable | None
    out, faults = _validated(kind, fixed | content)
    for fault in faults:
        key = key_of[str(fault["loc"][0])]
        if key not in raw:
            if key not in mistyped:
                found[key] = Problem(table, key, "is missing", f"add {key}: {_words(known[key])}")
        elif key not in found:
            found[key] = _wrong_value(table, key, known[key], fault)
    problems += found.values()
    if faults:
        sound = {name: value for name, value in content.items() if key_of[name] not in found}
        out, _ = _validated(kind, fixed | sound)
    return out


def subtables(raw: dict[str, Any], table: str, problems: Problems) -> dict[str, Any]:
    """Return the tables [table.<name>] of the file ``raw`` by name."""
    content = raw.get(table, {})
    if not isinstance(content, dict):
        todo = f"write a table [{table}.<name>] for each"
        problems.add("", table, f"is {content!r}, must be tables", todo)
        return {}
    stray = [name for name, inner in content.items() if not isinstance(inner, dict)]
    if stray:
        what = f"holds {', '.join(stray)}, but must hold a table for each name"
        todo = f"write [{table}.<name>] above them, with the name filled in"
        problems.add(table, "", what, todo)
    for name in content:
        if fault := fault_of_name(name):
            problems.add(table, "", f"the name {name!r:.80} {fault}", ADVICE)
    return {name: inner for name, inner in content.items() if name not in stray}


@cache
def field_types(kind: Any) -> dict[str, Any]:
    """Return the type of each field of a table, with its annotations."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: hints[name] for name in (field.name for field in fields(kind))}


def _words(hint: Any) -> str:
    """Return what a value must be: the description of its type, or of what that is made of."""
    for extra in reversed(getattr(hint, "__metadata__", ())):
        if isinstance(extra, FieldInfo) and extra.description:
            return extra.description
    if get_origin(hint) is Literal:
        *others, last = (f'"{choice}"' for choice in get_args(hint))
        return f"{', '.join(others)} or {last}" if others else last
    return next(filter(None, map(_words, get_args(hint))), "true or false" if hint is bool else "")


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _validated(kind: Any, content: Any) -> tuple[Any, list[Any]]:
    """Validate as JSON, since in that mode lists may become tuples although types are strict."""
    try:
        return _adapter(kind).validate_json(json.dumps(content, default=str)), []
    except ValidationError as error:
        return None, list(error.errors(include_url=False))


def _wrong_value(table: str, key: str, hint: Any, fault: Any) -> Problem:
    indices = [i for i in fault["loc"][1:] if isinstance(i, int)]
    if fault["type"] == "missing":  # an item of a list that is too short
        indices = indices[:-1]
    position = "".join(f"[{i}]" for i in indices)
    what = f"{'item ' + position + ' ' if position else ''}is {_short(fault['input'])}"
    todo = f"must be {_words(hint)}"
    if get_origin(hint) is Literal and isinstance(fault["input"], str):
        near = nearest(fault["input"], list(get_args(hint)))
        todo += f": did you mean {near}?" if near else ""
    return Problem(table, key, what, todo)


def _short(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    brief = reprlib.Repr()
    brief.maxstring = 60
    return brief.repr(value)
