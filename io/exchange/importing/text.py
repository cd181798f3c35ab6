"""Text files of other programs."""

from __future__ import annotations

from pathlib import Path

from telerig.errors import InputError


def read_text(path: Path) -> str:
    """The text of a file of another program. Raises InputError when it cannot be read."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot be read ({error})", where=str(path), todo="check the path and the file"
        ) from error
