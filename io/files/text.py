"""Text files of any origin: UTF-8 with or without a byte order mark."""

from __future__ import annotations

from pathlib import Path

from telerig.errors import InputError


def read_text(file: Path, todo: str = "check the path and the file") -> str:
    """The text of a file, its lines ended by LF. Raises InputError when it cannot be read.

    todo : what to do about a file that is there, but is no UTF-8 text.
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
