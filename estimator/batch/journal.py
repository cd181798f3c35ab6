"""What came of every job, a file each, so that an interrupted batch goes on where it was."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from telerig.estimator.batch.jobs import Job, fingerprint
from telerig.estimator.batch.work import DONE
from telerig.io.files.atomic import write_json_atomic

FOLDER = "jobs"


class Journal:
    """The folder ``jobs`` of a batch. Several processes may write different jobs into it."""

    def __init__(self, batch: Path) -> None:
        self.folder = Path(batch) / FOLDER

    def done(self, job: Job) -> dict[str, Any] | None:
        """The record of the job if it was done with the same inputs, options and version."""
        record = self.read(job)
        if record is None or record.get("status") != DONE or not job.result.is_file():
            return None
        return record if record.get("fingerprint") == fingerprint(job) else None

    def read(self, job: Job) -> dict[str, Any] | None:
        """The last record of the job; None when there is none that can be read."""
        try:
            content = json.loads((self.folder / f"{job.name}.json").read_bytes())
        except (OSError, ValueError):
            return None
        return dict(content) if isinstance(content, dict) else None

    def write(self, job: Job, result: Mapping[str, Any], inputs: str) -> dict[str, Any]:
        """Keep what came of the job; returns the record.

        inputs : `fingerprint` before it began, so that what changes meanwhile is done again.
        """
        record = {
            "kind": job.kind, "dataset": job.dataset, "run": job.run, **result,
            "fingerprint": inputs,
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        }  # fmt: skip
        write_json_atomic(self.folder / f"{job.name}.json", record)
        return record
