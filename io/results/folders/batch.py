"""What a batch's folder holds, read and checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import pandas as pd

from telerig.io.results.batch import BatchFile
from telerig.io.results.manifest import reading
from telerig.io.tables.smoothing import BATCH_BUBBLES


@dataclass(frozen=True)
class BatchResults:
    """The folder of a batch; each file is read and checked when it is asked for.

    Reading raises InputError for what is missing or cannot be read.
    """

    folder: Path

    FILES: ClassVar[tuple[str, ...]] = ("batch.json", "bubbles.csv")

    @cached_property
    def file(self) -> BatchFile:
        """batch.json."""
        return BatchFile.read(self.folder / "batch.json")

    @property
    def name(self) -> str:
        """Return the name of the batch."""
        return self.file.name or self.folder.resolve().name

    @cached_property
    def jobs(self) -> Sequence[Mapping[str, Any]]:
        """The record of each job."""
        return [job.content() for job in self.file.jobs]

    @cached_property
    def bubbles(self) -> pd.DataFrame:
        """bubbles.csv, the bubbles of all runs; without rows where it is not there."""
        return BATCH_BUBBLES.read(self.folder / "bubbles.csv", optional=True)


def read_batch_results(folder: Path) -> BatchResults:
    """Read a batch's folder for its page. Raises InputError as `BatchResults` does."""
    results = BatchResults(folder)
    with reading(folder, BatchResults.FILES):
        _ = results.jobs, results.bubbles
    return results
