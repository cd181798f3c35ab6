"""Every study of this folder on the source that is here, one page each, resumable.

Usage: python benchmarks/all.py [--only NAME ...] [--real FOLDER] [--workers 2] [--list]

Each study is a command that prints its page or writes it; the page goes to `results/NAME.md` with
the command, the state of the source and the processor time at its end, and is never edited by
hand. `results/all.json` keeps these, so that a second call goes on with the studies whose page is
of another source, and `results/work/` what an interrupted study had done. Real images and records
are not part of this repository: studies of them are left out, and said to be, where FOLDER is not
there. Then `python benchmarks/readme.py --write`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from guard_parts.running import THREADS, state_of_source

HERE = Path(__file__).parent
RESULTS = HERE / "results"
KEPT = RESULTS / "all.json"


@dataclass(frozen=True)
class Study:
    """One page: a module of this folder, its arguments ({real} and {work} are folders)."""

    module: str
    arguments: str = ""
    page: str = ""  # its name, if not the module's
    writes: bool = True  # takes --out FILE.md; else its page is what it prints

    @property
    def name(self) -> str:
        return self.page or self.module

    def command(self, real: Path, work: Path, out: Path) -> list[str]:
        words = self.arguments.format(real=real, work=work).split()
        written = ["--out", str(out)] if self.writes else []
        return [sys.executable, str(HERE / f"{self.module}.py"), *words, *written]

    @property
    def shown(self) -> str:
        return f"python benchmarks/{self.module}.py {self.arguments}".strip()


STUDIES = (
    Study("dots"),
    Study("paper", "--seeds 40"),
    Study("print_errors"),
    Study("covariance"),
    Study("ladder"),
    Study("stress", "--auto 10 --images 1"),
    Study("initialisation"),
    Study("three_cameras"),
    Study("ordinary_lenses"),
    Study("next_view"),
    Study("stage_axis"),
    Study("solvers"),
    Study("calibrate_seconds", writes=False),
    Study("plates", "{real}"),
    Study("real_images", "{real}"),
    Study("paper_2004"),
    Study("bubbles", "--real {real}/bubble_pair"),
    Study("bubble_pair", "--images {real}/bubble_pair"),
    Study("dense_bubbles", "{real}"),
    Study("bodies"),
    Study("bubble_runs", "--first 8100"),
    Study("crossings"),
    Study("many_cameras"),
    Study("whole_run", "--frames 300 1000"),
    Study("track_memory"),
    Study("drift"),
    Study("shake_table"),
    Study("identifiability", "--seed 700"),
    Study(
        "shake_scenarios",
        "--seed 1400 --seeds 12 --only S1,S2,S3,S6 --information arms,references --models default",
    ),
    Study(
        "shake_scenarios",
        "--seed 1400 --seeds 4 --only S1,S2,S3,S6 --information arms,references --calibrated "
        "--oblique",
        page="shake_oblique",
    ),
    Study("shake_faults"),
    Study("rig_faults"),
    Study("plan"),
    Study("sensor_faults", "faults --scenarios S1 --configurations one,marks --clocks unknown"),
    Study("sound_runs", "--runs 1000 --seed 20000 --out {work}/sound_runs.jsonl", writes=False),
    Study("before_a_run", "--out {work}/before_a_run", writes=False),
    Study("smoothing_speed"),
    Study("smoothing_many"),
    Study("long_runs", "--frames 10000 30000"),
    Study("acceleration"),
    Study("bubble_physics", "--first 100 --seeds 28", writes=False),
    Study("recording", "--minutes 2"),
    Study("batch"),
    Study("house"),
)


def main() -> int:
    options = arguments()
    chosen = [s for s in STUDIES if not options.only or s.name in options.only]
    if unknown := set(options.only) - {s.name for s in STUDIES}:
        raise SystemExit(f"no study is called {', '.join(sorted(unknown))}; --list shows all")
    source = state_of_source("")
    kept: dict[str, dict[str, Any]] = json.loads(KEPT.read_text("utf-8")) if KEPT.exists() else {}
    stale = [s for s in chosen if kept.get(s.name, {}).get("source") != source]
    if options.list:
        for study in chosen:
            state = "to be run" if study in stale else f"{kept[study.name]['cpu_s']} s of CPU"
            print(f"{study.name:18} {state:14} {study.shown}")
        return 0
    absent = [] if options.real.is_dir() else [s for s in stale if "{real}" in s.arguments]
    for study in absent:
        print(f"{study.name}: left out, {options.real} is not there", flush=True)
    failed = 0
    work = RESULTS / "work" / source
    for study, record in run([s for s in stale if s not in absent], options, work):
        failed += record["exit_code"] != 0
        cost = f"{record['cpu_s']} s of CPU"
        print(f"{study.name}: {cost}, exit code {record['exit_code']}", flush=True)
        kept[study.name] = record | {"source": source}
        part = KEPT.with_suffix(".part")
        part.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n", "utf-8")
        part.replace(KEPT)
    return 1 if failed or absent else 0


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME")
    parser.add_argument("--real", type=Path, default=HERE.parents[1] / "shared" / "real")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--list", action="store_true", help="what is done, and what would be run")
    return parser.parse_args()


def run(
    studies: list[Study], options: argparse.Namespace, work: Path
) -> Iterator[tuple[Study, dict[str, Any]]]:
    """Yield each study and its record as it ends; its page is written then."""
    with ThreadPoolExecutor(options.workers) as pool:
        waiting = {pool.submit(page, s, options.real, work / s.name): s for s in studies}
        try:
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def page(study: Study, real: Path, work: Path) -> dict[str, Any]:
    """Run a study; a page that it made takes the place of the one before, else that one stays."""
    work.mkdir(parents=True, exist_ok=True)
    out, log = work / f"{study.name}.md", work / f"{study.name}.log"
    clock = time.perf_counter()
    with log.open("w", encoding="utf-8") as printed:
        process = subprocess.Popen(
            study.command(real, work, out), cwd=HERE.parent, stdout=printed,
            stderr=subprocess.STDOUT, env=os.environ | dict.fromkeys(THREADS, "1"),
        )  # fmt: skip
        code, used = waited(process)
    cpu_s, made = round(used), out if study.writes else log
    text = made.read_text("utf-8") if made.exists() else ""
    if text and "Traceback (most recent call last)" not in text:
        title = "" if text.startswith("#") else f"# {study.name}\n\n"
        foot = f"Made by `{study.shown}`; {cpu_s} s of processor time."
        part = RESULTS / f"{study.name}.part"
        part.write_text(f"{title}{text.rstrip()}\n\n{foot}\n", "utf-8")
        part.replace(RESULTS / f"{study.name}.md")
    else:
        last = log.read_text("utf-8")[-2000:]
        print(f"{study.name} ended with {code}:\n{last}", file=sys.stderr, flush=True)
    shutil.rmtree(work)
    return {"exit_code": code, "cpu_s": cpu_s, "wall_s": round(time.perf_counter() - clock)}


def waited(process: subprocess.Popen[Any]) -> tuple[int, float]:
    """The exit code, and the processor time of the process and its own children."""
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, used.ru_utime + used.ru_stime


if __name__ == "__main__":
    sys.exit(main())
