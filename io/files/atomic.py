"""Write files that are either complete or absent: write beside the place, then rename."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import platform
import re
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from telerig.errors import InputError

_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_WRITE_ERRORS = _FULL | {errno.EROFS, errno.EIO}
"""Errors of the system that only writing can cause."""
_LEFTOVER = re.compile(
    r"\..+?\.(?:(?P<machine>[0-9a-f]{6})-)?(?P<pid>[0-9]+)-[0-9a-f]{8}\.part(?:\..*)?", re.DOTALL
)
_OLD_S = 7 * 24 * 3600.0


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, and rename the file there to ``path`` at the end.

    If an exception occurs, the temporary file is removed, and an earlier file at ``path`` stays.
    Raises InputError if the file cannot be written, for example because the disk is full.
    """
    final = Path(path)
    if final.is_dir():
        raise InputError(
            "is a folder, a file must be written there",
            where=str(final),
            todo="rename the folder or choose another file name",
        )
    make_parent(final)
    _remove_leftovers_once(final.parent.absolute())
    temporary = _beside(final, final.suffix)
    try:
        with _write_errors_in_words(final, temporary):
            yield temporary
        rename(temporary, final)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield an empty temporary folder; its files are renamed into ``folder`` at the very end.

    An interrupted command leaves the old files unchanged; files that are not written again stay.
    Raises InputError as `atomic_path` does.
    """
    final = Path(folder)
    with staged_folder(final) as temporary:
        yield temporary
        for staged in sorted(p for p in temporary.rglob("*") if p.is_file()):
            target = final / staged.relative_to(temporary)
            make_parent(target)
            rename(staged, target)


@contextmanager
def staged_folder(final: Path) -> Iterator[Path]:
    """Yield an empty temporary folder, and remove it at the end.

    It lies beside ``final``, from where its files can be renamed, or in it where ``final`` is a
    disk of its own or the folder above cannot be written. Raises InputError when the place cannot
    be written.
    """
    check_writable(final)
    make_parent(final)
    alone = final.is_dir() and (
        os.path.ismount(final) or not os.access(final.absolute().parent, os.W_OK)
    )
    temporary = _beside(final / "results" if alone else final, "")
    remove_leftovers(temporary.parent)
    try:
        try:
            temporary.mkdir()
        except OSError as error:
            raise unwritable(final, error) from error
        with _write_errors_in_words(final, temporary):
            yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_text_atomic(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file in UTF-8 with the line ends of ``text``, completely or not at all.

    Raises InputError when it cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode("utf-8"))


def write_json_atomic(path: str | os.PathLike[str], content: Any) -> None:
    """Write a strict JSON file, completely or not at all; ``content`` is converted by `plain`.

    Raises TypeError for an object that JSON cannot represent, and InputError if the file cannot be
    written.
    """
    text = json.dumps(plain(content), indent=1, ensure_ascii=False, allow_nan=False)
    write_text_atomic(path, text + "\n")


def plain(content: Any) -> Any:
    """Return ``content`` with all values converted to the types of JSON.

    Dataclasses become objects, NaN becomes null.
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
    mark = f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"
    whole = Path(os.path.normpath(final.absolute()))  # "." and ".." have no name
    return whole.parent / f".{whole.name}.{mark}.part{suffix}"


@cache
def _machine() -> str:
    """Return a short mark of this computer: a folder may be shared by several."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:6]


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files that killed commands have left in a folder.

    Files of commands on other computers are removed after a week.
    """
    try:
        entries = [entry for entry in folder.iterdir() if entry.name.startswith(".")]
    except OSError:
        return
    for entry in entries:
        mark = _LEFTOVER.fullmatch(entry.name)
        if mark is None or not _is_dead(entry, mark["machine"], int(mark["pid"])):
            continue
        if entry.is_dir():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            with suppress(OSError):
                entry.unlink()


_remove_leftovers_once = cache(remove_leftovers)
"""For single files: a folder that gets thousands of them is listed once per process."""


def _is_dead(entry: Path, machine: str | None, pid: int) -> bool:
    try:
        if machine != _machine():
            return time.time() - entry.stat().st_mtime > _OLD_S
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:
        return False
    return False


def make_parent(path: Path) -> None:
    """Make the folder in which ``path`` lies. Raises InputError when that fails."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(path.parent, error) from error


def rename(source: Path, target: Path) -> None:
    """Rename a file, over an existing one. Raises InputError when that fails."""
    try:
        os.replace(source, target)  # noqa: PTH105
    except OSError as error:
        raise unwritable(target, error) from error


def check_writable(folder: Path) -> None:
    """Raise InputError where a folder can be neither made nor written, without making it."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not there.is_dir():
        raise InputError(
            "is a file, a folder of results must be written there",
            where=str(there),
            todo="choose another --out",
        )
    if there != folder and not os.access(there, os.W_OK):
        raise unwritable(folder, PermissionError(errno.EACCES, os.strerror(errno.EACCES)))


@contextmanager
def _write_errors_in_words(final: Path, temporary: Path) -> Iterator[None]:
    """Raise InputError that names ``final`` for an error of the system in writing ``temporary``."""
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
            raise unwritable(final, error) from error
        raise


def unwritable(path: Path, error: OSError) -> InputError:
    """Return the error that says that ``path`` cannot be written, why, and what to do."""
    if error.errno in _FULL:
        todo = "make room on the disk, then run the command again"
    elif error.errno in (errno.EEXIST, errno.ENOTDIR):
        todo = "a file has the name of a folder that is needed: choose another place"
    elif error.errno == errno.ENOENT or error.errno is None:
        todo = "the folder was removed meanwhile: run the command again"
    else:
        todo = "choose a folder that can be written, or change its permissions"
    return InputError(f"cannot be written: {error.strerror or error}", where=str(path), todo=todo)
