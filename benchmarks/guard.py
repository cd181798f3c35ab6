"""A guard for what is true: a fixed small set of everything, compared with a committed baseline.

Usage: python benchmarks/guard.py [--only PART[/TASK] ...] [--compare] [--write-baseline]
    [--workers 2] [--whole] [--fresh]

Some 25 minutes of processor time; parts and tasks are named by --only ("smoothing",
"smoothing/S1"). --compare shows what moved against `benchmarks/results/guard.json`, and ends with
exit code 1 if something is worse than its tolerance, changed in what may not change, or gone;
--whole also shows what did not move. Tasks that are done are kept for the same source, so that an
interrupted run goes on; --fresh forgets them. --write-baseline makes the run the baseline and
writes `guard.json` and `guard.md`. The noise is the same in every run: metrics move by as much as
the product does, and tolerances are not the scatter of the draws (`guard_parts/metrics.py`).
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from guard_parts.metrics import (
    FAILED,
    Metric,
    as_json,
    compared,
    comparison,
    from_json,
    table,
)
from guard_parts.running import PARTS, chosen, metrics_of, run, state_of_source

RESULTS = Path(__file__).parent / "results"
BASELINE = RESULTS / "guard.json"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="PART[/TASK]")
    parser.add_argument("--compare", action="store_true")
    parser.add_argument("--write-baseline", action="store_true")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--whole", action="store_true", help="also what did not move")
    parser.add_argument("--fresh", action="store_true", help="forget the tasks that are done")
    parser.add_argument(
        "--baseline", type=Path, default=BASELINE, help="another file to compare with, or to write"
    )
    parser.add_argument("--plant", default="", help=argparse.SUPPRESS)
    return parser.parse_args()


def measured(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """The records of all tasks that were asked for, in the order of the parts."""
    tasks = chosen(options.only)
    if not tasks:
        raise SystemExit(f"nothing is called {' '.join(options.only)}; parts: {', '.join(PARTS)}")
    name = f"telerig-guard-{state_of_source(options.plant)}"
    folder = Path(tempfile.gettempdir()) / name
    if options.fresh:
        shutil.rmtree(folder, ignore_errors=True)
    records: dict[str, dict[str, Any]] = {}
    begun = time.perf_counter()
    for key, record in run(tasks, folder, workers=options.workers, planted=options.plant):
        records[key] = record
        spent = time.perf_counter() - begun
        words = record["failure"] or f"{record['cpu_s']:.1f} s of CPU"
        print(f"{len(records)}/{len(tasks)} {spent:5.0f} s  {key}: {words}", file=sys.stderr)
    return {f"{p}/{n}": records[f"{p}/{n}"] for p, n in tasks}


def page(metrics: dict[str, Metric], cpu_s: float) -> str:
    """`guard.md`: one table a part."""
    lines = [
        "# Guard", "", "Made by `python benchmarks/guard.py --write-baseline`; compared by",
        "`--compare` with `guard.json`, which has the tolerances.", "",
        f"Processor time of the tasks: {cpu_s / 60:.0f} minutes.", "",
    ]  # fmt: skip
    for part in PARTS:
        mine = {k: m for k, m in metrics.items() if k.split("/")[0] == part}
        if mine:
            shown = {k: m for k, m in mine.items() if m.name != "inputs"}
            lines += [f"## {part}", "", *table(shown), ""]
    return "\n".join(lines)


def main() -> int:
    options = arguments()
    records = measured(options)
    metrics = metrics_of(records)
    cpu_s = sum(r["cpu_s"] for r in records.values())
    print("\n".join(table(metrics)))
    print(f"\n{len(records)} tasks, {len(metrics)} metrics, {cpu_s:.0f} s of CPU.")
    failed = [key for key, record in records.items() if record["failure"]]
    code = 1 if failed else 0
    if options.compare:
        before = from_json(json.loads(options.baseline.read_text(encoding="utf-8"))["metrics"])
        moved = compared(before, metrics, records if options.only else None)
        print("\n" + "\n".join(comparison(moved, whole=options.whole)))
        code = max(code, int(any(m.state in FAILED for m in moved)))
    if options.write_baseline:
        part = bool(options.only) and options.baseline == BASELINE
        if failed or part or options.plant:
            raise SystemExit("the baseline needs all tasks, without a failure or a planted fault")
        text = {"metrics": as_json(metrics), "cpu_s": round(cpu_s)}
        options.baseline.write_text(json.dumps(text, indent=0, ensure_ascii=False) + "\n", "utf-8")
        options.baseline.with_suffix(".md").write_text(page(metrics, cpu_s), encoding="utf-8")
    return code


if __name__ == "__main__":
    sys.exit(main())
