"""Kill a command that writes results at every step of the replacement."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from telerig.io.files import atomic
from telerig.io.results import manifest


class Killed(BaseException):
    """Stands for the end of the process: nothing catches it."""


def killed_at_every_rename(
    folder: Path, old: Callable[[], object], new: Callable[[], object]
) -> Iterator[int]:
    """Write the old results, kill the new ones before step k, and yield k, for every k.

    A step is a rename into ``folder`` or the removal of a file there; renames inside temporary
    folders do not count. Afterwards nothing more is written, as after a kill. The last k is the
    one at which ``new`` ends undisturbed. The old results are copied, not written again.
    """
    kept = folder.with_name(f"{folder.name} kept")
    shutil.rmtree(folder, ignore_errors=True)
    old()
    if folder.exists():
        shutil.copytree(folder, kept)
    step = 0
    while True:
        shutil.rmtree(folder, ignore_errors=True)
        if kept.exists():
            shutil.copytree(kept, folder)
        done = _kill_at(step, folder, new)
        yield step
        if done:
            shutil.rmtree(kept, ignore_errors=True)
            return
        step += 1


def _kill_at(step: int, folder: Path, write: Callable[[], object]) -> bool:
    """Write until before the given step; returns whether the command has ended by itself."""
    count = iter(range(step + 1))

    def counted(real: Callable[..., None], place: int) -> Callable[..., None]:
        def call(*paths: Path) -> None:
            inside = paths[0].resolve() if place == 0 else Path(paths[1]).resolve()
            if inside.is_relative_to(folder.resolve()) and next(count) == step:
                raise Killed
            real(*paths)

        return call

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", counted(os.replace, 1))
        removed = manifest._remove
        patch.setattr(
            manifest, "_remove",
            lambda place, name: counted(lambda _: removed(place, name), 0)(place / name),
        )  # fmt: skip
        try:
            write()
        except Killed:
            return False
        finally:
            assert atomic.os.replace is os.replace
        return True
