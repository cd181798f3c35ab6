"""The records of a batch: a journal with one file per job, batch.csv, batch.json, a summary."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from telerig.estimator.batch.jobs import Job, fingerprint
from telerig.estimator.batch.work import DONE
from telerig.io.files.atomic import write_json_atomic
from telerig.io.files.csv_table import write_table

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("dataset", "run", "kind", "status", "verdict", "seconds", "host", "finished")
FIGURES = (
    "views", "dots_kept", "share_kept", "rms_px", "lens_model", "frames", "detections", "points",
    "tracks", "bubbles", "sx_um", "sy_um", "sz_um", "svx_mm_s", "svy_mm_s", "svz_mm_s",
)  # fmt: skip


class Journal:
    """The folder ``jobs`` of a batch, so that an interrupted batch continues where it was.

    Several processes may write different jobs into it.
    """

    def __init__(self, batch: Path) -> None:
        self.folder = Path(batch) / "jobs"

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
        """Keep the result of a job; returns the record.

        inputs : `fingerprint` before it began, so that a job whose input changes meanwhile is done
        again.
        """
        record = {
            "kind": job.kind, "dataset": job.dataset, "run": job.run, **result,
            "fingerprint": inputs,
            "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        }  # fmt: skip
        write_json_atomic(self.folder / f"{job.name}.json", record)
        return record


def table_of(records: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Columns `COLUMNS`, `FIGURES` and the reason of a failure; a row per job, in their order."""
    import pandas as pd

    rows = []
    for record in records:
        figures = record.get("figures") or {}
        reason = "" if record["status"] == DONE else _first_line(record.get("words"))
        rows.append(
            {name: record.get(name) for name in COLUMNS}
            | {name: figures.get(name) for name in FIGURES}
            | {"verdict": figures.get("verdict"), "words": reason}
        )
    return pd.DataFrame(rows, columns=[*COLUMNS, *FIGURES, "words"])


def _first_line(words: object) -> str:
    return next(iter(str(words or "").strip().splitlines()), "")


def write_batch(
    records: Sequence[Mapping[str, Any]], folder: Path, *, report: bool = True
) -> pd.DataFrame:
    """batch.csv, batch.json and report.html in ``folder``; returns the table."""
    table = table_of(records)
    write_table(table, folder / "batch.csv")
    content = {"schema": 1, "kind": "telerig batch", "jobs": list(records)}
    write_json_atomic(folder / "batch.json", content)
    if report:
        from telerig.io.report.batch.report import write_batch_report

        write_batch_report(folder)
    return table


def batch_words(records: Sequence[Mapping[str, Any]]) -> str:
    """The summary for the user: how many jobs of each kind and status, and each failure."""
    lines = []
    for kind in ("calibrate", "track", "smooth"):
        of_kind = [r for r in records if r["kind"] == kind]
        if of_kind:
            counts = Counter(r["status"] for r in of_kind)
            lines.append(f"{kind}: " + ", ".join(f"{n} {status}" for status, n in counts.items()))
    for record in records:
        if record["status"] != DONE:
            where = record["dataset"] + (f", run {record['run']}" if record["run"] else "")
            reason = _first_line(record["words"])
            lines.append(f"  {where}: {record['kind']} {record['status']}: {reason}")
    return "\n".join(lines)
