"""Describe batch.json, the records of all jobs of a batch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import PurePath
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field

from telerig.io.results.record import Part, Record

_LONGEST_NAME = 255
"""What file systems allow for a folder's name."""


def _checked_path(path: str) -> str:
    if max(map(len, path.split("/"))) > _LONGEST_NAME:
        raise ValueError(f"the name {path[:60]!r}... is too long for a folder")
    return path


_Path = Annotated[str, AfterValidator(_checked_path)]


class JobRecord(Part):
    """Hold what became of one job.

    kind : "calibrate", "track" or "smooth".
    dataset, run : folder of the dataset, and name of the run; "" for a calibration.
    status : "done", "rejected", "failed", "crashed", "left out", or "kept": a calibration that was
        there before.
    words : the result or the reason of any other status, in words.
    figures : numbers of the result by name, and its "verdict" and "flags" where it has them: those
        of a run, or the codes of the objections to a calibration.
    seconds : duration; None if it is not known.
    host : name of the computer; None if it is not known.
    """

    kind: str
    dataset: _Path
    run: _Path
    status: str
    words: str
    figures: dict[str, Any] | None = None
    seconds: float | None = None
    host: str | None = None


class BatchFile(Record):
    """Hold the content of batch.json: the name of the batch and the records of its jobs.

    fluid : the keys of [fluid] in rig.toml if it is the same in all smoothed runs, else empty.
    """

    MISSING: ClassVar[str] = "no batch here"
    MAKE: ClassVar[str] = "telerig batch DATASETS --out FOLDER"
    AGAIN: ClassVar[str] = "run `telerig batch` again with --out of this folder"

    schema_: int = Field(1, alias="schema")
    name: str | None = None
    jobs: tuple[JobRecord, ...]
    fluid: dict[str, Any] = Field(default_factory=dict)


def verdict_of(record: Mapping[str, Any]) -> str:
    """Return the verdict of a job without its flags; "" for a job without one."""
    return str((record.get("figures") or {}).get("verdict") or "")


def verdict_and_flags(record: Mapping[str, Any]) -> str:
    """Return the verdict of a job and its flags as a text; "" for a job without one."""
    return " ".join([verdict_of(record), *(record.get("figures") or {}).get("flags", ())])


def has_failed(record: Mapping[str, Any]) -> bool:
    """Return whether a job has no result, or one that is not to be used."""
    return record.get("status") not in ("done", "kept")


def verdict_counts(records: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Return how often each verdict occurs among the jobs that did not fail."""
    found = (verdict_of(record) for record in records if not has_failed(record))
    return dict(Counter(word for word in found if word))


def listed(counts: Mapping[str, int]) -> str:
    """Return numbers with what they count, as in "3 done, 1 failed"."""
    return ", ".join(f"{n} {what}" for what, n in counts.items())


def short_names(datasets: Iterable[str]) -> dict[str, str]:
    """Return for each dataset's folder the shortest end of its path that no other one has."""
    every = list(dict.fromkeys(datasets))
    parts = {place: PurePath(place).parts for place in every}

    def end(place: str, count: int) -> str:
        return "/".join(parts[place][-count:])

    found = {}
    for place in every:
        counts = range(1, len(parts[place]) + 1)
        alone = (n for n in counts if [end(p, n) for p in every].count(end(place, n)) == 1)
        found[place] = end(place, next(alone, len(parts[place])))
    return found
