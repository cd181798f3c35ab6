"""A batch of 40 runs: two workers against one, what travels, and an interruption.

Usage: python benchmarks/batch.py [--datasets 8] [--runs 5] [--frames 15] [--out FILE.md]
Simulated rigs whose dots and bubbles are tables; the work is calibration, tracking, smoothing with
accelerometers. The local workers run one job at a time each, in a process of its own; the cluster
is a Dask scheduler with two worker processes on this machine. For the interruption the whole batch
is killed (SIGKILL) half way and started again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from telerig.estimator.batch.jobs import jobs_of
from telerig.io.simulation.presets import run_preset
from telerig.io.simulation.simulate import simulate

TABLES = ("calibration.json", "residuals.csv", "tracks.csv", "trajectories.csv", "shake.csv")


def make(folder: Path, datasets: int, runs: int, frames: int) -> list[Path]:
    """So many rigs with so many copies each of one run."""
    config = run_preset("rise", frames=frames)
    config = replace(config, stage=replace(config.stage, accelerometers=("left", "right")))
    places = []
    for seed in range(datasets):
        place = folder / f"rig{seed:02d}"
        simulate(config, rng=np.random.default_rng(seed), out=place, images=False)
        first = place / "runs" / "rise"
        for k in range(1, runs):
            shutil.copytree(first, place / "runs" / f"rise{k}")
        places.append(place)
    return places


def command(places: Sequence[Path], out: Path, *more: str) -> list[str]:
    given = [str(p) for p in places]
    return [sys.executable, "-m", "telerig.scripts.main", "batch", *given, "--out", str(out),
            "--no-report", *more]  # fmt: skip


def seconds(places: Sequence[Path], out: Path, *more: str) -> float:
    begun = time.perf_counter()
    done = subprocess.run(command(places, out, *more), capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stdout + done.stderr)
    return time.perf_counter() - begun


def digest(places: Sequence[Path]) -> str:
    """Of the tables of all results."""
    whole = hashlib.sha256()
    for place in places:
        for file in sorted((place / "results").rglob("*")):
            if file.name in TABLES:
                whole.update(str(file.relative_to(place)).encode() + file.read_bytes())
    return whole.hexdigest()[:12]


def clear(places: Sequence[Path]) -> None:
    for place in places:
        shutil.rmtree(place / "results", ignore_errors=True)


def killed_and_resumed(places: Sequence[Path], out: Path, half_s: float) -> tuple[int, int, float]:
    """Jobs done when it was killed, jobs done before on the second start, and its seconds."""
    process = subprocess.Popen(
        command(places, out, "--workers", "2"), stdout=subprocess.DEVNULL, start_new_session=True
    )
    time.sleep(half_s)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    kept = len(list((out / "jobs").glob("*.json")))
    spent = seconds(places, out, "--workers", "2")
    jobs = json.loads((out / "batch.json").read_bytes())["jobs"]
    return kept, sum(bool(j.get("resumed")) for j in jobs), spent


def over_a_cluster(places: Sequence[Path], out: Path) -> tuple[float, int]:
    """Seconds, and the bytes of all jobs and results as they are sent."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        spent = seconds(places, out, "--scheduler", cluster.scheduler_address)
    sent = sum(len(job.as_json()) for job in jobs_of(places))
    came = sum(p.stat().st_size for p in (out / "jobs").glob("*.json"))
    return spent, sent + came


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--datasets", type=int, default=8)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--frames", type=int, default=15)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        places = make(folder, args.datasets, args.runs, args.frames)
        jobs = len(jobs_of(places))
        inputs = sum(f.stat().st_size for p in places for f in p.rglob("*") if f.is_file())
        lines = [
            f"# A batch of {args.datasets * args.runs} runs of {args.datasets} rigs, {jobs} jobs",
            "", "| how | wall s | against one worker | results |", "|---|---|---|---|",
        ]  # fmt: skip

        def row(how: str, spent: float, base: float) -> None:
            lines.append(f"| {how} | {spent:.0f} | {base / spent:.2f} | {digest(places)} |")
            print(lines[-1], flush=True)
            clear(places)

        one = seconds(places, folder / "one", "--workers", "1")
        row("one worker", one, one)
        two = seconds(places, folder / "two", "--workers", "2")
        row("two workers", two, one)
        spent, sent = over_a_cluster(places, folder / "cluster")
        row("Dask, two workers", spent, one)
        kept, again, rest = killed_and_resumed(places, folder / "killed", two / 2)
        row("two workers, killed half way, the second start", rest, one)
    lines += [
        "",
        f"Killed: {kept} jobs were in the journal, {again} were not done again. To the cluster and "
        f"back: {sent / 1000:.0f} kB, {sent / jobs / 1000:.2f} kB a job; the input has "
        f"{inputs / 1e6:.1f} MB and does not travel. Results: a hash over all of "
        f"{', '.join(TABLES)}.",
    ]
    print("\n".join(lines[-1:]))
    if args.out:
        args.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
