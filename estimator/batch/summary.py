"""A batch as a table, a job per row, and in a few words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from telerig.estimator.batch.work import DONE
from telerig.io.dataset.tables import write_table
from telerig.io.files.atomic import write_json_atomic

if TYPE_CHECKING:
    import pandas as pd

FIRST = ("dataset", "run", "kind", "status", "verdict", "seconds", "host", "finished")
FIGURES = (
    "views", "dots_kept", "share_kept", "rms_px", "lens_model", "frames", "detections", "points",
    "tracks", "bubbles", "sx_um", "sy_um", "sz_um", "svx_mm_s", "svy_mm_s", "svz_mm_s",
)  # fmt: skip


def table_of(records: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Columns `FIRST`, `FIGURES` and the first line of the words; a row per job, in their order."""
    import pandas as pd

    rows = []
    for record in records:
        figures = record.get("figures") or {}
        row = {name: record.get(name) for name in FIRST} | {n: figures.get(n) for n in FIGURES}
        words = str(record.get("words") or "").strip().splitlines()
        failed = record["status"] != DONE
        rows.append({**row, "verdict": figures.get("verdict"), "words": _first(words, failed)})
    return pd.DataFrame(rows, columns=[*FIRST, *FIGURES, "words"])


def _first(words: Sequence[str], failed: bool) -> str:
    return words[0] if words and failed else ""


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
    """What a command prints at the end: how many of what, and what went wrong where."""
    lines = []
    for kind in ("calibrate", "track", "smooth"):
        of_kind = [r for r in records if r["kind"] == kind]
        if of_kind:
            counts = Counter(r["status"] for r in of_kind)
            lines.append(f"{kind}: " + ", ".join(f"{n} {status}" for status, n in counts.items()))
    for record in records:
        if record["status"] != DONE:
            where = record["dataset"] + (f", run {record['run']}" if record["run"] else "")
            first = str(record["words"]).strip().splitlines()[:1]
            lines.append(f"  {where}: {record['kind']} {record['status']}: {' '.join(first)}")
    return "\n".join(lines)
