"""Read hostile files one after another, in a process of its own with little memory.

`python fuzz_worker.py CORPUS WORK BEGIN END [TARGET]` reads the cases BEGIN to END - 1 and prints
one line of JSON before and one after each. TARGET: one or more, with commas. It runs in a process
of its own, so that a crash of a decoder or a loop without end ends one case and not the test.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import shutil
import sys
import time
import traceback
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from fuzz_targets import EXPORTED, Target, targets_of
from mutators import mutated

from telerig.errors import InputError, TelerigError

MEMORY_BYTES = 1 << 30
"""Address space that a case may take beyond what the process has when it begins."""

LONGEST_MESSAGE = 4096
LONGEST_NOISE = 4096
"""Bytes that libraries may print on standard error during a case."""


class Fault(AssertionError):
    """A case broke a rule other than that only telerig's errors are raised."""


def chosen(case: int, targets: dict[str, Target]) -> str:
    """Return the name of a case's target."""
    rng = np.random.default_rng([case, 8])
    names = list(targets)
    shares = np.array([targets[name].share for name in names])
    return names[rng.choice(len(names), p=shares / shares.sum())]


def outcome(target: Target, file: Path, work: Path) -> tuple[str, str]:
    """Read a changed file. Returns "read", "refused" or "fault", and what happened in words."""
    before, noise = _tree(work), _noise()
    refusal: TelerigError | None = None
    try:
        with warnings.catch_warnings(record=True) as warned, _limited_memory():
            warnings.simplefilter("always")
            warnings.filterwarnings(
                "ignore", ".*(there is no manifest.json|; it is used|images are in colour)"
            )
            try:
                _refuse_not_finite(target.read(file), "the result")
                result, words = "read", ""
            except TelerigError as error:
                result, words, refusal = "refused", str(error), error
        if warned:
            one = warned[0]
            raise Fault(f"{len(warned)} warnings: {one.message} {one.filename}:{one.lineno}")
        if len(words.encode("utf-8", "surrogatepass")) > LONGEST_MESSAGE:
            raise Fault(f"a message of {len(words)} characters: {words[:300]}")
        if (
            result == "refused"
            and isinstance(refusal, InputError)
            and not {file.name, file.parent.name} & set(_words(words))
        ):
            raise Fault(f"a message that does not name the file: {words[:300]}")
        if _noise() - noise > LONGEST_NOISE:
            raise Fault(f"{_noise() - noise} bytes on standard error")
        shutil.rmtree(work / "case" / EXPORTED, ignore_errors=True)
        if strange := _tree(work) ^ before:
            raise Fault(f"files were written: {sorted(strange)[:5]}")
    except BaseException as error:  # noqa: BLE001 - whatever is raised is what is looked for
        shutil.rmtree(work / "case" / EXPORTED, ignore_errors=True)
        return "fault", _brief(error)
    return result, words


def _words(message: str) -> list[str]:
    for mark in '/\\:,()"\n':
        message = message.replace(mark, " ")
    return message.split()


def _brief(error: BaseException) -> str:
    frames = [
        f
        for f in traceback.extract_tb(error.__traceback__)
        if Path(f.filename).parent.name != "fuzz"
    ]
    ours = [f"{Path(f.filename).name}:{f.lineno}" for f in frames][-4:]
    return f"{type(error).__name__}: {str(error)[:400]} [{' '.join(ours)}]"


def _refuse_not_finite(value: Any, place: str) -> None:
    if isinstance(value, pd.DataFrame):
        value = {name: value[name].to_numpy() for name in value}
    if is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, dict):
        for name, one in value.items():
            _refuse_not_finite(one, f"{place}, {str(name)[:40]}")
    elif isinstance(value, list | tuple):
        for one in value:
            _refuse_not_finite(one, place)
    elif isinstance(value, float | np.ndarray) and np.asarray(value).dtype.kind == "f":
        bad = ~np.isfinite(value)
        if np.any(bad):
            raise Fault(f"{place}: {int(np.sum(bad))} of {np.size(value)} numbers are not finite")


@contextmanager
def _limited_memory() -> Iterator[None]:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def _tree(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*")}


def _noise() -> int:
    return os.fstat(2).st_size


def main(corpus: Path, work: Path, begin: int, end: int, only: str = "") -> None:
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    folder = work / "case"
    shutil.copytree(corpus, folder)
    targets = targets_of(corpus)
    for target in targets.values():  # loads libraries, and shows that the corpus is sound
        result, words = outcome(target, folder / target.file, work)
        assert result == "read", (target.file, words)
    for case in range(begin, end):
        name = only.split(",")[case % (only.count(",") + 1)] or chosen(case, targets)
        target = targets[name]
        file = folder / target.file
        answers.write(json.dumps({"case": case, "target": name}) + "\n")
        sound = (corpus / target.file).read_bytes()
        content = mutated(
            sound, target.kind, np.random.default_rng([case, zlib.crc32(name.encode())])
        )
        file.write_bytes(content)
        started = time.monotonic()
        result, words = outcome(target, file, work)
        seconds = time.monotonic() - started
        file.write_bytes(sound)
        record = {"case": case, "target": name, "result": result, "words": words[:2000],
                  "seconds": round(seconds, 3)}  # fmt: skip
        answers.write(json.dumps(record) + "\n")
        if seconds > 1:
            gc.collect()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), *sys.argv[5:])
