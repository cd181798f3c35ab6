"""What is on the disk if a command is killed at any step of the replacement of its results."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from telerig.io.results import manifest


def killed_at_every_rename(
    folder: Path, old: Callable[[], object], new: Callable[[], object]
) -> Iterator[int]:
    """Write old and new results, and put the folder into the state before step k, for every k.

    A step is a rename into ``folder`` or the removal of a file there; renames inside temporary
    folders do not count. A kill before a step leaves what is on the disk at that moment, so the
    folder is copied before each step of a single run. The last k is the finished command.
    """
    kept = folder.parent / f"{folder.name} kept"
    shutil.rmtree(folder, ignore_errors=True)
    old()
    steps = _states(folder, kept, new)
    for step in range(steps):
        shutil.rmtree(folder, ignore_errors=True)
        if (kept / str(step)).exists():
            shutil.copytree(kept / str(step), folder)
        yield step
    shutil.rmtree(kept)


def _states(folder: Path, kept: Path, write: Callable[[], object]) -> int:
    """Copy the folder to ``kept``/k before each step of ``write`` and at its end; returns k + 1."""
    steps = 0
    kept.mkdir()

    def keep() -> None:
        nonlocal steps
        if folder.exists():
            shutil.copytree(folder, kept / str(steps))
        steps += 1

    def replace(source: Path, target: Path) -> None:
        if Path(target).resolve().is_relative_to(folder.resolve()):
            keep()
        real_replace(source, target)

    def remove(place: Path, name: str) -> None:
        keep()
        real_remove(place, name)

    real_replace, real_remove = os.replace, manifest._remove
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", replace)
        patch.setattr(manifest, "_remove", remove)
        write()
    keep()
    return steps
