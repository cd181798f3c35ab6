"""Which image of each camera belongs to which frame of the run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from telerig.arrays import Bools, Ints
from telerig.errors import InputError
from telerig.io.images.frames import FrameSource

Pairing = Literal["auto", "numbers", "order"]

_TODO = (
    "complete the images; number their names alike; name what is missing in the column "
    "`missing` of frames.csv; or pair them in order (--pair-by order)"
)


def pair_frames(
    sources: Mapping[str, FrameSource],
    pair_by: Pairing,
    missing: Mapping[str, Bools] | None,
    where: str,
) -> tuple[dict[str, Ints], list[str]]:
    """(F,) position in each camera's source, -1 where the frame is missing; and notes.

    pair_by : "numbers" in the names, "order", or what fits ("auto").
    missing : (F,) by camera, frames that frames.csv says were dropped; None if it says nothing.
    Raises InputError when the cameras' images cannot be paired safely.
    """
    if missing is not None:
        return _by_missing(sources, missing, where)
    numbers = {name: source.numbers() for name, source in sources.items()}
    counts = {name: len(source) for name, source in sources.items()}
    if pair_by == "order":
        return _in_order(counts)
    known = {name: n for name, n in numbers.items() if n is not None}
    if len(known) == len(numbers) and (pair_by == "numbers" or _trustworthy(known, where)):
        return _by_numbers(known)
    if pair_by == "numbers":
        silent = ", ".join(name for name, n in numbers.items() if n is None)
        raise InputError(
            f"the names of camera {silent} do not count the frames",
            where=where,
            todo="name images like 000000.tif, 000001.tif, or pair them in order",
        )
    if len(set(counts.values())) > 1:
        counted = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise InputError(f"the cameras differ in their frames: {counted}", where=where, todo=_TODO)
    return _in_order(counts)


def _trustworthy(numbers: Mapping[str, Ints], where: str) -> bool:
    """Whether the numbers in the names count frames: dense, and the same in every camera."""
    step = _step(numbers)
    spans = [int(n[-1] - n[0]) // step + 1 for n in numbers.values()]
    if any(span > 2 * len(n) + 8 for span, n in zip(spans, numbers.values())):
        return False
    sets = [set(n.tolist()) for n in numbers.values()]
    shared = set.intersection(*sets)
    if all(len(shared) == len(one) for one in sets):
        return True
    whole = all(span == len(n) for span, n in zip(spans, numbers.values()))
    if len(set(map(len, sets))) == 1 and whole:
        if not shared:
            return False
        starts = " and ".join(f"{name} at {n[0]}" for name, n in numbers.items())
        raise InputError(
            f"as many images in each camera, but their names start differently: {starts}",
            where=where,
            todo="pair them by the numbers (--pair-by numbers) if frames are missing at the ends, "
            "else in order (--pair-by order)",
        )
    return 2 * len(shared) >= min(map(len, sets))


def _step(numbers: Mapping[str, Ints]) -> int:
    first = min(int(n[0]) for n in numbers.values())
    offsets = np.concatenate([n - first for n in numbers.values()])
    return int(np.gcd.reduce(offsets)) or 1


def _by_numbers(numbers: Mapping[str, Ints]) -> tuple[dict[str, Ints], list[str]]:
    step, first = _step(numbers), min(int(n[0]) for n in numbers.values())
    count = max(int(n[-1] - first) // step + 1 for n in numbers.values())
    notes = [f"the names of the images count in steps of {step}"] if step > 1 else []
    positions = {}
    for name, counted in numbers.items():
        place = np.full(count, -1, np.int64)
        place[(counted - first) // step] = np.arange(len(counted))
        positions[name] = place
        notes += _missing_note(name, place)
    return positions, notes


def _in_order(counts: Mapping[str, int]) -> tuple[dict[str, Ints], list[str]]:
    frames = np.arange(max(counts.values()), dtype=np.int64)
    positions = {name: np.where(frames < count, frames, -1) for name, count in counts.items()}
    return positions, [note for name, p in positions.items() for note in _missing_note(name, p)]


def _by_missing(
    sources: Mapping[str, FrameSource], missing: Mapping[str, Bools], where: str
) -> tuple[dict[str, Ints], list[str]]:
    positions, notes = {}, []
    for name, source in sources.items():
        gone = missing[name]
        frames, present = len(gone), int(np.sum(~gone))
        if len(source) == frames:
            place = np.where(gone, -1, np.arange(frames))
        elif len(source) == present:
            place = np.where(gone, -1, np.cumsum(~gone) - 1)
        else:
            raise InputError(
                f"camera {name} has {len(source)} images; frames.csv has {frames} rows, "
                f"{frames - present} of them with its frame missing",
                where=where,
                todo="correct the column `missing`, or complete the images",
            )
        positions[name] = place
        notes += _missing_note(name, place)
    return positions, notes


def _missing_note(camera: str, positions: Ints) -> list[str]:
    gone = np.flatnonzero(positions < 0)
    if not gone.size:
        return []
    some = ", ".join(map(str, gone[:8])) + (", ..." if gone.size > 8 else "")
    return [f"camera {camera} misses {gone.size} frame{'s' if gone.size > 1 else ''}: {some}"]
