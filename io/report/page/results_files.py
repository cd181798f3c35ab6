"""JSON files of a results folder, and its pictures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from telerig.errors import InputError


def read_object(file: Path, todo: str) -> Mapping[str, Any]:
    """A JSON object. Raises InputError for what is none."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"cannot be read as JSON: {error}", where=str(file), todo=todo) from error
    if not isinstance(content, dict):
        raise InputError("is JSON, but not an object", where=str(file), todo=todo)
    return content


def check_kind(content: Mapping[str, Any], file: Path, kind: str, schema: int, todo: str) -> None:
    """Raise InputError unless telerig wrote ``content`` as ``kind``, in a schema known here."""
    if content.get("kind") != f"telerig {kind}":
        raise InputError(f"is not a {kind} file that telerig wrote", where=str(file), todo=todo)
    found = content.get("schema")
    if not isinstance(found, int) or found > schema:
        raise InputError(
            f"schema {found} is newer than this version reads ({schema})",
            where=str(file),
            todo="update telerig",
        )


def read_picture(file: Path) -> bytes:
    """Raises InputError for a file that cannot be read."""
    try:
        return file.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=str(file)) from error
