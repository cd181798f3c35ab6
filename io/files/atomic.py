"""Write files that are either complete or absent: write beside the place, then rename."""

from __future__ import annotations

import errno
import json
import math
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from telerig.errors import InputError

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_WRITE_ERRORS = _FULL | {errno.EROFS, errno.EIO}
"""Errors of the system that only writing can cause."""


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, with the same suffix, and rename it at the end.

    Missing parent folders are made. On an exception the temporary file is removed, and a file that
    was at ``path`` before stays.
    Raises InputError when the place cannot be written, also when the disk is full or the folder
    disappears while the file is being written.
    """
    final = Path(path)
    if final.is_dir():
        raise InputError(
            "is a folder, a file must be written there",
            where=str(final),
            todo="rename the folder or choose another file name",
        )
    _make_parent(final)
    temporary = _beside(final, final.suffix)
    try:
        with _write_errors_in_words(final, temporary):
            yield temporary
        _rename(temporary, final)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield an empty temporary folder; its files are renamed into ``folder`` at the very end.

    Until then ``folder`` is as before, so an interrupted command leaves the old results unchanged.
    Files that are already in ``folder`` and are not written again stay.
    Raises InputError when the place cannot be written, also when the disk is full or the temporary
    folder disappears meanwhile.
    """
    final = Path(folder)
    if final.exists() and not final.is_dir():
        raise InputError(
            "is a file, a folder of results must be written there",
            where=str(final),
            todo="choose another --out",
        )
    _make_parent(final)
    temporary = _beside(final, "")
    try:
        try:
            temporary.mkdir()
        except OSError as error:
            raise _unwritable(temporary, error) from error
        with _write_errors_in_words(final, temporary):
            yield temporary
        for staged in sorted(p for p in temporary.rglob("*") if p.is_file()):
            target = final / staged.relative_to(temporary)
            _make_parent(target)
            _rename(staged, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_text_atomic(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file in UTF-8 with the line ends of ``text``, completely or not at all.

    Raises InputError when it cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode("utf-8"))


def write_json_atomic(path: str | os.PathLike[str], content: Any) -> None:
    """Write a strict JSON file, completely or not at all.

    NumPy arrays become lists, dataclasses become objects, NaN and infinity become null. Floats keep
    every digit.
    Raises TypeError for an object that JSON cannot represent, InputError when the file cannot be
    written.
    """
    text = json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False)
    write_text_atomic(path, text + "\n")


def plain(content: Any) -> Any:
    """Return ``content`` in the types of JSON; numbers that are not finite become None.

    Raises TypeError for an object that JSON cannot represent.
    """
    if isinstance(content, dict):
        return {str(key): plain(value) for key, value in content.items()}
    if isinstance(content, np.ndarray | np.generic):
        return plain(content.tolist())
    if isinstance(content, list | tuple):
        return [plain(value) for value in content]
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    if isinstance(content, Path):
        return str(content)
    if is_dataclass(content) and not isinstance(content, type):
        return {field.name: plain(getattr(content, field.name)) for field in fields(content)}
    if content is None or isinstance(content, str | bool | int):
        return content
    raise TypeError(f"{type(content).__name__} has no form in JSON: {content!r}")


def _beside(final: Path, suffix: str) -> Path:
    return final.with_name(f".{final.name}.{os.getpid()}-{secrets.token_hex(4)}.part{suffix}")


def _make_parent(path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path.parent, error) from error


def _rename(source: Path, target: Path) -> None:
    try:
        os.replace(source, target)  # noqa: PTH105
    except OSError as error:
        raise _unwritable(target, error) from error


@contextmanager
def _write_errors_in_words(final: Path, temporary: Path) -> Iterator[None]:
    """Raise InputError that names ``final`` for an error of the system in writing ``temporary``.

    Errors of the system that have another cause, such as reading elsewhere, are left alone.
    """
    try:
        yield
    except InputError as error:
        if not error.where.startswith(str(temporary)):
            raise
        where = error.where.replace(str(temporary), str(final), 1)
        raise InputError(error.what, where=where, todo=error.todo) from error
    except OSError as error:
        gone = not temporary.parent.is_dir()
        named = str(error.filename or "").startswith(str(temporary))
        if gone or named or error.errno in _WRITE_ERRORS:
            raise _unwritable(final, error) from error
        raise


def _unwritable(path: Path, error: OSError) -> InputError:
    if error.errno in _FULL:
        todo = "make room on the disk, then run the command again"
    elif error.errno == errno.ENOENT or error.errno is None:
        todo = "the folder was removed meanwhile: run the command again"
    else:
        todo = "choose a folder that can be written (--out), or change its permissions"
    return InputError(f"cannot be written: {error.strerror or error}", where=str(path), todo=todo)
