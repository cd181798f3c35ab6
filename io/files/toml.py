"""Read TOML files of a size, a depth and with numbers that a person can have written."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from telerig.errors import InputError
from telerig.io.files.text import LARGEST_NUMBER, read_text

LONGEST = 4_000_000
"""Characters of a file: a target of 100,000 points."""
DEEPEST = 32
"""Tables and lists inside each other. tomllib needs time and memory that grow with its square."""


def read_toml(file: Path, todo: str, missing: str = "check the path") -> dict[str, Any]:
    """Read a TOML file and return its content.

    todo : the advice in the error for a file that is no TOML. missing : the advice for a file that
    does not exist. Raises InputError as `toml_content` and `read_text` do.
    """
    return toml_content(read_text(file, missing=missing), str(file), todo)


def toml_content(text: str, where: str, todo: str) -> dict[str, Any]:
    """Return the content of a TOML text; ``where`` and ``todo`` are for errors.

    Raises InputError for a text that is no TOML or longer than `LONGEST`, for nesting beyond
    `DEEPEST`, and for a finite number beyond `LARGEST_NUMBER`.
    """
    if len(text) > LONGEST:
        what = f"has {len(text)} characters, more than the {LONGEST} that are read"
        raise InputError(what, where=where, todo="check that this is the right file")
    if line := _too_deep(text):
        what = f"line {line} lies more than {DEEPEST} tables or lists deep"
        raise InputError(what, where=where, todo=todo)
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not valid TOML: {error}", where=where, todo=todo) from error
    _check_numbers(content, where)
    return content


def _too_deep(text: str) -> int:
    """Return the number of the first line that is nested too deep (strings count as keys), or 0."""
    depth = 0
    for number, line in enumerate(text.split("\n"), 1):
        words = re.split(r"[,=\[\]{}]", line.replace(" ", "").replace("\t", ""))
        if any(sum(map(bool, word.split("."))) > DEEPEST for word in words):
            return number
        for bracket in re.findall(r"[\[\]{}]", line):
            depth = max(depth + (1 if bracket in "[{" else -1), 0)
            if depth > DEEPEST:
                return number
    return 0


def _check_numbers(value: Any, place: str) -> None:
    """Raise InputError for the first finite number that is too large."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _check_numbers(inner, f"{place} {key}")
    elif isinstance(value, list):
        for inner in value:
            _check_numbers(inner, place)
    elif isinstance(value, int | float) and LARGEST_NUMBER < abs(value) < float("inf"):
        what = f"is larger than {LARGEST_NUMBER:g}"
        raise InputError(what, where=place, todo="correct it")
