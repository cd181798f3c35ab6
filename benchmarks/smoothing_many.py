"""How does the cost of smoothing grow with frames and with bubbles in sight?

Usage: python benchmarks/smoothing_many.py [--frames 1000,3000,10000] [--bubbles 5,10,20,40]
       [--out FILE.md]
`telerig.smooth` on a table of tracks, images alone, modes learned: processor seconds by phase and
peak memory, a process for each case, one thread. All frames with 20 bubbles, all numbers of bubbles
with 1,000 frames, and 40 bubbles with the middle number of frames.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from shake_cases import SCENARIOS
from shake_learning_data import CAMERAS
from shake_learning_data import run as crowded
from shake_scene import Case, simulate

from telerig.estimator.smoothing.problem.problem import SmoothingProblem
from telerig.estimator.smoothing.smooth import smooth

RATE_HZ = 500.0


def table_of(problem: SmoothingProblem) -> pd.DataFrame:
    """A table of tracks with the pixels of a problem whose bubbles are all seen by all cameras."""
    frame = np.concatenate([np.arange(b.first, b.last + 1) for b in problem.bubbles])
    owner = np.repeat(np.arange(len(problem.bubbles)), [len(b) for b in problem.bubbles])
    place = np.concatenate([b.guess_mm for b in problem.bubbles])
    out = pd.DataFrame({"frame": frame, "particle": owner, "t_s": problem.t_s[frame]})
    out[["x_mm", "y_mm", "z_mm"]] = place
    seen = problem.observations
    for index, camera in enumerate(problem.cameras):
        mine = seen.of(seen.camera == index)
        columns = {"frame": mine.frame, "particle": mine.item}
        columns |= {f"{camera.name}_{n}_px": mine.uv_px[:, i] for i, n in enumerate("uv")}
        for name, i, j in (("suu", 0, 0), ("suv", 0, 1), ("svv", 1, 1)):
            columns[f"{camera.name}_{name}_px2"] = mine.covariance_px2[:, i, j]
        out = out.merge(pd.DataFrame(columns), on=["frame", "particle"])
    return out.sort_values(["frame", "particle"]).reset_index(drop=True)


def measured(frames: int, bubbles: int) -> dict[str, Any]:
    """Processor seconds by phase, and peak memory of this process, in GB."""
    rng = np.random.default_rng(1)
    problem, _, _ = crowded(rng, bubbles=bubbles, seconds=frames / RATE_HZ, rate_hz=RATE_HZ)
    short = simulate(Case(replace(SCENARIOS["S2"], frames=60)), rng)
    calibration = replace(short.inputs("one")["calibration"], cameras=CAMERAS)
    table = table_of(problem)
    seconds: dict[str, float] = {}
    before, first_line, begun = {"at": time.process_time()}, [0.0], time.perf_counter()

    def progress(what: str, share: float) -> None:
        first_line[0] = first_line[0] or time.perf_counter() - begun
        now, name = time.process_time(), what.split(":")[0]
        seconds[name] = seconds.get(name, 0.0) + now - before["at"]
        before["at"] = now

    smooth(table, calibration, t_s=problem.t_s, progress=progress)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return {"seconds": seconds, "total": sum(seconds.values()), "gb": peak, "first": first_line[0]}


def in_a_process(frames: int, bubbles: int) -> dict[str, Any]:
    command = [sys.executable, __file__, "--case", f"{frames},{bubbles}"]
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, env={**os.environ, **one}
    )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def exponent(sizes: list[int], seconds: list[float]) -> float:
    """Slope of log seconds over log sizes."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", default="1000,3000,10000")
    parser.add_argument("--bubbles", default="5,10,20,40")
    parser.add_argument("--case")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if args.case:
        print(json.dumps(measured(*map(int, args.case.split(",")))))
        return
    frames, bubbles = ([int(v) for v in a.split(",")] for a in (args.frames, args.bubbles))
    cases = [(f, 20) for f in frames] + [(1000, n) for n in bubbles if n != 20]
    cases.append((sorted(frames)[len(frames) // 2], 40))
    lines = [
        "# Smoothing many bubbles: time and memory",
        "",
        "CPU seconds of one thread.",
        "",
        "| frames | bubbles in sight | learning | smoothing | verdict | tables | all | peak GB "
        "| first line, s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    found = {}
    for case in dict.fromkeys(cases):
        one = found[case] = in_a_process(*case)
        parts = [
            sum(s for n, s in one["seconds"].items() if n.startswith(word))
            for word in ("learning", "smoothing", "judging", "making")
        ]
        words = " | ".join(f"{s:.1f}" for s in (*parts, one["total"]))
        lines.append(
            f"| {case[0]:,} | {case[1]} | {words} | {one['gb']:.2f} | {one['first']:.3f} |"
        )
        print(lines[-1], flush=True)

    def growth(of: list[tuple[int, int]], which: int) -> str:
        phases = [
            sum(s for n, s in found[c]["seconds"].items() if not n.startswith("learning"))
            for c in of
        ]
        sizes = [c[which] for c in of]
        return f"{exponent(sizes, phases):.2f} without learning, which does not grow"

    by_frames = [c for c in found if c[1] == 20]
    by_bubbles = sorted(c for c in found if c[0] == 1000)
    lines.append("")
    if len(by_frames) > 1:
        lines.append(f"Exponent in frames: {growth(by_frames, 0)}.")
    if len(by_bubbles) > 1:
        lines.append(f"Exponent in bubbles: {growth(by_bubbles, 1)}.")
    print("\n".join(lines[-2:]))
    if args.out:
        args.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
