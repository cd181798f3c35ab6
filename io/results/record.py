"""Read and write the JSON files of a results folder, among them run.json, as checked records.

A record is a frozen pydantic model. Keys that this version does not know are kept, so that a newer
file of the same schema is read and written without loss. Arrays are NumPy arrays of finite numbers
with a stated shape.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationError,
)

from telerig.arrays import Array, Ints
from telerig.errors import InputError
from telerig.io.files.atomic import plain, write_json_atomic
from telerig.io.files.names import fault_of_name
from telerig.io.files.text import read_bytes
from telerig.short_text import counted_list

_LONGEST_MESSAGE = 400
_DEEPEST = 64
"""Objects and lists inside each other in a JSON file; the deepest that telerig writes has 12."""
_LARGEST_NUMBER = 1e30


def _checked_array(*shape: int | None, kind: type = float) -> Callable[[Any], NDArray[Any]]:
    """Return a function that converts a value to an array and checks its shape and its numbers.

    shape : the length of each axis; None allows any length. kind : the type of the elements.
    The function raises ValueError for a wrong shape and for numbers that are not finite.
    """

    def check(value: Any) -> NDArray[Any]:
        try:
            found: NDArray[Any] = np.array(value, kind)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError("is not an array of numbers") from error
        if found.size == 0 and None in shape:
            found = found.reshape([n or 0 for n in shape])
        wanted = tuple(n if m is None else m for n, m in zip(found.shape, shape))
        if found.ndim != len(shape) or found.shape != wanted:
            stated = " x ".join("any" if n is None else str(n) for n in shape)
            raise ValueError(f"has shape {found.shape}, not {stated}")
        if not np.isfinite(found).all():
            raise ValueError("holds a number that is not finite")
        return found

    return check


_as_list = PlainSerializer(lambda array: array.tolist())
_Floats = Array
Vector3 = Annotated[_Floats, PlainValidator(_checked_array(3)), _as_list]
Points3 = Annotated[_Floats, PlainValidator(_checked_array(None, 3)), _as_list]
Matrix2 = Annotated[_Floats, PlainValidator(_checked_array(2, 2)), _as_list]
Matrix3 = Annotated[_Floats, PlainValidator(_checked_array(3, 3)), _as_list]
Matrix3x2 = Annotated[_Floats, PlainValidator(_checked_array(3, 2)), _as_list]
Square = Annotated[_Floats, PlainValidator(_checked_array(None, None)), _as_list]
Numbers = Annotated[_Floats, PlainValidator(_checked_array(None)), _as_list]
Wholes = Annotated[Ints, PlainValidator(_checked_array(None, kind=np.int64)), _as_list]


def _checked_name(name: str) -> str:
    if fault := fault_of_name(name):
        raise ValueError(f"the name {name!r:.80} {fault}")
    return name


Name = Annotated[str, AfterValidator(_checked_name)]


class Part(BaseModel):
    """Describe a part of a JSON results file; each subclass has one field for each key."""

    model_config = ConfigDict(
        defer_build=True,
        frozen=True,
        extra="allow",
        arbitrary_types_allowed=True,
        allow_inf_nan=False,
    )

    def content(self) -> dict[str, Any]:
        """Return the keys that were given and their values, in types that JSON can hold."""
        return dict(plain(self.model_dump(exclude_unset=True, by_alias=True)))


class Record(Part):
    """Describe a whole JSON file of a results folder."""

    KIND: ClassVar[str] = ""
    """The value that the key ``kind`` must have; "" where the file has no such key."""
    SCHEMA: ClassVar[int] = 1
    MISSING: ClassVar[str] = "there is no such file"
    MAKE: ClassVar[str] = ""
    """The command line that makes the file."""
    AGAIN: ClassVar[str] = ""
    """The advice in the error for a file that cannot be used."""

    @classmethod
    def read(cls, file: Path) -> Self:
        """Read and check a JSON file; returns the record.

        Raises InputError when the file is missing, is of another kind or of a newer schema, or does
        not have the keys and values that the schema requires.
        """
        if not file.is_file():
            raise InputError(cls.MISSING, where=str(file), todo=f"run `{cls.MAKE}` first")
        content = read_object(file, cls.AGAIN)
        if cls.KIND and content.get("kind") != cls.KIND:
            what = f"is not a {cls.KIND.removeprefix('telerig ')} file that telerig wrote"
            raise InputError(what, where=str(file), todo=cls.AGAIN)
        schema = content.get("schema", cls.SCHEMA)
        if isinstance(schema, int) and schema > cls.SCHEMA:
            raise InputError(
                f"schema {str(schema)[:20]} is newer than this version reads ({cls.SCHEMA})",
                where=str(file),
                todo="update telerig",
            )
        return cls.of(content, file)

    @classmethod
    def read_if_there(cls, file: Path) -> Self:
        """Read and check a JSON file; returns an empty record when the file does not exist.

        This is for records without required keys. Raises InputError as `read` does.
        """
        return cls.read(file) if file.is_file() else cls()

    @classmethod
    def of(cls, content: Mapping[str, Any], file: Path) -> Self:
        """Check ``content``, which was read from ``file``, and return the record.

        Raises InputError that names the faulty key.
        """
        try:
            return cls.model_validate(plain(dict(content)))
        except ValidationError as error:
            raise InputError(_fault(error), where=str(file), todo=cls.AGAIN) from error

    def write(self, file: Path) -> None:
        """Write the JSON file; it is replaced completely, or not at all if writing fails.

        Raises InputError when it cannot be written.
        """
        write_json_atomic(file, self.content())


def _fault(error: ValidationError) -> str:
    """Return the first fault with its key, and the keys of others, short enough for a terminal."""
    faults = error.errors(include_url=False, include_input=False, include_context=False)
    key, *others = (".".join(str(part)[:60] for part in f["loc"][:6]) for f in faults)
    reason = faults[0]["msg"].removeprefix("Value error, ")
    words = f"has a fault at {key!r}: {reason}" if key else reason
    more = f" (and {counted_list([*map(repr, others)], 'more fault')})" if others else ""
    return words[:_LONGEST_MESSAGE] + more


def read_object(file: Path, todo: str) -> Mapping[str, Any]:
    """Read a JSON file whose content is an object, and return it as a dictionary.

    Numbers that are not finite become None, as `write_json_atomic` writes them.
    todo : the advice in an error. Raises InputError for a file that holds no JSON object, nests
    more than 64 objects and lists, or has a number beyond 1e30.
    """
    data = read_bytes(file)
    try:
        content = json.loads(data, parse_constant=lambda _: None)
        _check_size(content, 0)
        _check_characters(data, content)
    except (ValueError, RecursionError) as error:
        what = str(error)[:_LONGEST_MESSAGE]
        raise InputError(f"cannot be read as JSON: {what}", where=str(file), todo=todo) from error
    if not isinstance(content, dict):
        raise InputError("is JSON, but not an object", where=str(file), todo=todo)
    return content


def _check_characters(data: bytes, content: Any) -> None:
    """Raise ValueError for half of a surrogate pair, escaped or not, which cannot be written."""
    if b"\\ud" in data.lower() or b"\xed" in data:
        try:
            json.dumps(content, ensure_ascii=False).encode("utf-8")
        except UnicodeEncodeError as error:
            raise ValueError("a character is one half of a surrogate pair") from error


def _check_size(value: Any, depth: int) -> None:
    """Raise ValueError for a value that is nested too deep or a number that is too large."""
    if depth > _DEEPEST:
        raise ValueError(f"more than {_DEEPEST} objects and lists inside each other")
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            if not isinstance(inner, str):
                _check_size(inner, depth + 1)
    elif isinstance(value, int | float) and not abs(value) <= _LARGEST_NUMBER:
        raise ValueError(f"a number larger than {_LARGEST_NUMBER:g}")


PACKAGES = ("gtsam", "numpy", "scipy", "opencv-python-headless", "scikit-image", "pandas")


class RunFile(Record):
    """Hold the content of run.json: which command made a results folder, with which versions.

    The manifest says from which inputs.

    command : the command's name.
    telerig : the version of telerig; None where it is not known.
    seconds : duration in s of each step by name.
    options : the values of the command's options.
    tracks : the run.json of the tracking on which a smoothing is based; otherwise empty.
    """

    AGAIN: ClassVar[str] = "run the command again that made this folder"

    command: str = ""
    telerig: str | None = None
    seconds: dict[str, float] = Field(default_factory=dict)
    options: dict[str, Any] = Field(default_factory=dict)
    tracks: dict[str, Any] = Field(default_factory=dict)


def run_record(
    command: str,
    options: Mapping[str, Any],
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """Return the content of run.json for a command that has just finished; nothing is written.

    options : the values of the command's options.
    seconds : duration in s of each step by name.
    """
    return {
        "command": command,
        "telerig": _version("telerig"),
        "python": platform.python_version(),
        "platform": platform.platform(terse=True),
        "packages": {name: _version(name) for name in PACKAGES},
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": {name: round(float(s), 3) for name, s in seconds.items()},
        "options": dict(options),
    }


def _version(package: str) -> str | None:
    """Return the installed version of a package; None when it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
