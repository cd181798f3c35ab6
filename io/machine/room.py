"""What this computer has room for: whether a request exceeds its memory or what a disk has free."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from telerig.errors import InputError

_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
"""Where Linux states the memory that a container may use."""


def memory_bytes() -> float:
    """Return the computer's memory, or what its container allows if that is less."""
    found = [float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")]
    for file in _LIMITS:
        text = file.read_text(encoding="utf-8").strip() if file.is_file() else ""
        found += [float(text)] if text.isdecimal() else []
    return min(found)


def free_bytes(folder: Path) -> float:
    """Return what is free on the disk of a folder, which need not exist."""
    place = folder.absolute()
    return float(shutil.disk_usage(next(p for p in (place, *place.parents) if p.exists())).free)


def check_room(
    where: str, todo: str, *, memory: float = 0.0, disk: float = 0.0, folder: Path = Path()
) -> None:
    """Raise InputError for work that this computer has no room for, before it begins.

    memory, disk : the least number of bytes that the work takes.
    folder : on whose disk.
    """
    if memory > (there := memory_bytes()):
        raise InputError(
            f"needs {_words(memory)} of memory, this computer has {_words(there)}",
            where=where, todo=todo,
        )  # fmt: skip
    if disk > 0 and disk > (free := free_bytes(folder)):
        raise InputError(
            f"needs {_words(disk)} on the disk, {_words(free)} are free",
            where=where, todo=f"{todo}, or make room on the disk",
        )  # fmt: skip


def _words(size: float) -> str:
    for unit, number in (("TB", 1e12), ("GB", 1e9)):
        if size >= number:
            return f"{size / number:.3g} {unit}"
    return f"{size / 1e6:.3g} MB"
