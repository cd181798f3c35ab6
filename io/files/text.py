"""Read text files in UTF-8, with or without a byte order mark."""

from __future__ import annotations

from pathlib import Path

from telerig.errors import InputError


def read_text(file: Path, todo: str = "check the path and the file") -> str:
    """Read a UTF-8 text file and return its text, in which lines end with a line feed.

    todo : the advice for a file that exists but is not UTF-8 text.
    Raises InputError when the file cannot be read.
    """
    try:
        return file.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}",
            where=str(file),
            todo="check the path and its permissions",
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(
            f"is not UTF-8 text: {error.reason} at byte {error.start}",
            where=str(file),
            todo=todo,
        ) from error
