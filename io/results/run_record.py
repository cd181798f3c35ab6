"""run.json: what made a result. Versions, input hashes, options, seed, times."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, ClassVar

from pydantic import Field

from telerig.io.results.record import Record

PACKAGES = ("gtsam", "numpy", "scipy", "opencv-python-headless", "scikit-image", "pandas")


class RunFile(Record):
    """run.json. ``tracks`` is the record of the tracking that a smoothing started from."""

    AGAIN: ClassVar[str] = "run the command again that made this folder"

    command: str = ""
    telerig: str | None = None
    seconds: dict[str, float] = Field(default_factory=dict)
    options: dict[str, Any] = Field(default_factory=dict)
    inputs_sha256: dict[str, str] = Field(default_factory=dict)
    tracks: dict[str, Any] = Field(default_factory=dict)


def sha256(path: Path) -> str:
    """Hash of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def run_record(
    command: str,
    dataset: Path,
    inputs: Iterable[Path],
    options: Mapping[str, Any],
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """The content of run.json. inputs : hashed, named relative to the dataset."""
    return {
        "command": command,
        "telerig": _version("telerig"),
        "python": platform.python_version(),
        "platform": platform.platform(terse=True),
        "packages": {name: _version(name) for name in PACKAGES},
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": {name: round(float(s), 3) for name, s in seconds.items()},
        "options": dict(options),
        "inputs_sha256": {_relative(p, dataset): sha256(p) for p in inputs},
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _relative(path: Path, dataset: Path) -> str:
    return path.relative_to(dataset).as_posix() if path.is_relative_to(dataset) else path.name
