"""Read whole files: bytes, and text in UTF-8 with or without a byte order mark."""

from __future__ import annotations

from pathlib import Path

from telerig.errors import InputError

LARGEST_NUMBER = 1e15
"""The largest number that is read; whole numbers up to it are exact as floats."""


def read_bytes(file: Path, missing: str = "check the path") -> bytes:
    """Read a whole file.

    missing : the advice for a file that does not exist.
    Raises InputError when the file cannot be read.
    """
    try:
        return file.read_bytes()
    except FileNotFoundError as error:
        raise InputError("does not exist", where=str(file), todo=missing) from error
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}",
            where=str(file),
            todo="check that it is a file and its permissions",
        ) from error


def need_file(file: Path) -> None:
    """Raise InputError unless there is a file of this name."""
    if not file.is_file():
        what = "is a folder, not a file" if file.is_dir() else "does not exist"
        raise InputError(what, where=str(file), todo="check the path")


def read_text(
    file: Path, todo: str = "save it as UTF-8 in your editor", missing: str = "check the path"
) -> str:
    """Read a UTF-8 text file and return its text, in which lines end with a line feed.

    todo : the advice for a file that is not UTF-8 text.  missing : as in `read_bytes`.
    Raises InputError when the file cannot be read.
    """
    try:
        text = read_bytes(file, missing).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"is not UTF-8 text: {error.reason} at byte {error.start}",
            where=str(file),
            todo=todo,
        ) from error
    return text.replace("\r\n", "\n").replace("\r", "\n")
