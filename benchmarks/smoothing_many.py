"""How does the cost of smoothing grow with frames and with bubbles in sight?

Usage: python benchmarks/smoothing_many.py [--frames 1000,3000,10000] [--bubbles 5,10,20,40]
       [--tracks 50,250,500] [--against-joint] [--across 0,0.03,0.12] [--seeds 3] [--out FILE.md]
`telerig.smooth` on a table of tracks, images alone, modes learned: processor seconds by phase and
peak memory, a process for each case, one thread. All frames with 20 bubbles, all numbers of bubbles
with 1,000 frames, 40 bubbles with the middle number of frames, and 2,000 frames with 20 bubbles in
sight whose tracks last so many frames in the mean.
--against-joint: instead, estimates and standard deviations against those of the joint graph, 20
bubbles in 400 frames with the true modes.
--across: instead, 1,000 frames with 5 and with 20 bubbles, modes learned, in which the rig shakes
by so many mm across the vertical (0.2 mm along it).
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
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from shake_cases import SCENARIOS
from shake_learning_data import CAMERAS, true_model, with_comings_and_goings
from shake_learning_data import run as crowded
from shake_scene import Case, simulate

from telerig.estimator.smoothing.graph import crowd
from telerig.estimator.smoothing.graph.solve import Options, solve
from telerig.estimator.smoothing.problem.problem import SmoothingProblem
from telerig.estimator.smoothing.smooth import smooth

Array = NDArray[np.float64]
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


def tracked(
    rng: np.random.Generator, frames: int, bubbles: int, track: int, across_mm: float = 0.0
) -> tuple[SmoothingProblem, Array]:
    """A problem and the true places (rows, 3); ``track`` frames a track in the mean, 0 for all."""
    problem, lab, _ = crowded(
        rng, bubbles=bubbles, seconds=frames / RATE_HZ, rate_hz=RATE_HZ, across_mm=across_mm
    )
    if not track:
        return problem, lab.reshape(-1, 3)
    cut = with_comings_and_goings(problem, rng, track)
    owner = np.cumsum([b.first == 0 for b in cut.bubbles]) - 1
    return cut, np.concatenate(
        [lab[o, b.first : b.last + 1] for o, b in zip(owner, cut.bubbles, strict=True)]
    )


def measured(
    frames: int, bubbles: int, track: int, seed: int = 1, across_um: int = 0
) -> dict[str, Any]:
    """Processor seconds by phase, peak memory of this process in GB, errors and sd (µm), NEES."""
    rng = np.random.default_rng(seed)
    problem, lab = tracked(rng, frames, bubbles, track, 1e-3 * across_um)
    short = simulate(Case(replace(SCENARIOS["S2"], frames=60)), rng)
    calibration = replace(short.inputs("one")["calibration"], cameras=CAMERAS)
    table = table_of(problem)
    seconds: dict[str, float] = {}
    before, first_line, begun = {"at": time.process_time()}, [0.0], time.perf_counter()

    def progress(what: str, share: float, _: int) -> None:
        first_line[0] = first_line[0] or time.perf_counter() - begun
        now, name = time.process_time(), what.split(":")[0]
        seconds[name] = seconds.get(name, 0.0) + now - before["at"]
        before["at"] = now

    found = smooth(table, calibration, t_s=problem.t_s, progress=progress).trajectories
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    found = found.sort_values(["particle", "frame"])
    off = found[["x_mm", "y_mm", "z_mm"]].to_numpy() - lab
    sd = found[["sx_mm", "sy_mm", "sz_mm"]].to_numpy()
    um, sd_um = ((1e3 * np.sqrt((a**2).mean(0))).tolist() for a in (off, sd))
    nees = ((off / sd) ** 2).mean(0)
    return {
        "seconds": seconds, "total": sum(seconds.values()), "gb": peak, "first": first_line[0],
        "um": um, "sd_um": sd_um, "nees_axes": nees.tolist(), "nees": float(nees.mean()),
    }  # fmt: skip


def across(millimetres: list[float], seeds: int) -> list[str]:
    """Rows of a table: errors and standard deviations where the rig shakes across, too."""
    lines = [
        "| shake across, mm | bubbles | seed | RMS error x, y, z, µm | sd, µm | NEES x, y, z |",
        "|---|---|---|---|---|---|",
    ]
    for mm in millimetres:
        for bubbles in (5, 20):
            for seed in range(1, seeds + 1):
                one = in_a_process((1000, bubbles, 0, seed, round(1e3 * mm)))
                um, sd = (", ".join(f"{v:.1f}" for v in one[n]) for n in ("um", "sd_um"))
                nees = ", ".join(f"{v:.2f}" for v in one["nees_axes"])
                lines.append(f"| {mm:g} | {bubbles} | {seed} | {um} | {sd} | {nees} |")
                print(lines[-1], flush=True)
    return lines


def against_joint(seeds: int) -> list[str]:
    """Rows of a table: the crowd's solution against that of the joint graph."""
    lines = [
        "| tracks | seed | CPU s joint, crowd | largest difference, sd | RMS error, crowd / joint "
        "| sd, crowd / joint: median along the shared axis, extremes of all | NEES joint, crowd |",
        "|---|---|---|---|---|---|---|",
    ]
    for track in (0, 130, 50):
        for seed in range(1, seeds + 1):
            problem, lab = tracked(np.random.default_rng(seed), 400, 20, track)
            found, seconds = [], []
            for joint in (True, False):
                crowd.jointly = lambda _, joint=joint: joint
                begun = time.process_time()
                found.append(solve(problem, true_model(), Options(robust=False)))
                seconds.append(time.process_time() - begun)
            sigma, off = [], []
            for one in found:
                rows, covariances = one.graph.bubble.position, one.covariances
                assert covariances is not None
                variance = ((rows @ covariances.bubbles) * rows).sum(-1)
                sigma.append(np.sqrt(variance))
                off.append(one.state.bubbles @ rows.T - lab)
            ratio = sigma[1] / sigma[0]
            apart = float(np.max(np.abs(off[1] - off[0]) / sigma[0]))
            rms = [float(np.sqrt(np.mean(o**2))) for o in off]
            nees = [float(np.mean((o / s) ** 2)) for o, s in zip(off, sigma)]
            cells = [
                str(track or "whole run"), str(seed), f"{seconds[0]:.1f}, {seconds[1]:.1f}",
                f"{apart:.0e}", f"{rms[1] / rms[0]:.5f}",
                f"{np.median(ratio[:, 1]):.3f}, {ratio.min():.2f}-{ratio.max():.2f}",
                f"{nees[0]:.3f}, {nees[1]:.3f}",
            ]  # fmt: skip
            lines.append(f"| {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    return lines


def in_a_process(case: tuple[int, ...]) -> dict[str, Any]:
    command = [sys.executable, __file__, "--case", ",".join(map(str, case))]
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
    parser.add_argument("--tracks", default="50,250,500")
    parser.add_argument("--against-joint", action="store_true")
    parser.add_argument("--across", type=lambda a: [float(v) for v in a.split(",")])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--case")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if args.case:
        print(json.dumps(measured(*map(int, args.case.split(",")))))
        return
    if args.across:
        lines = ["# A rig that shakes across the vertical", "", *across(args.across, args.seeds)]
    elif args.against_joint:
        lines = ["# The crowd's solution against the joint graph's", "", *against_joint(args.seeds)]
    else:
        frames, bubbles, tracks = (
            [int(v) for v in a.split(",") if v] for a in (args.frames, args.bubbles, args.tracks)
        )
        lines = growing(sorted(frames), bubbles, tracks)
    if args.out:
        args.out.write_text("\n".join(lines) + "\n")


def growing(frames: list[int], bubbles: list[int], tracks: list[int]) -> list[str]:
    """Rows of a table of times and memory, and the exponents."""
    cases = [(f, 20, 0) for f in frames] + [(1000, n, 0) for n in bubbles if n != 20]
    cases += [(frames[len(frames) // 2], 40, 0)] if frames and max(bubbles, default=0) > 20 else []
    cases += [(2000, 20, track) for track in tracks]
    lines = [
        "# Smoothing many bubbles: time and memory",
        "",
        "CPU seconds of one thread; `benchmarks/smoothing_many.py`.",
        "The rig does not shake across the vertical in these runs, which no smoother can know:",
        "half of the shake along it is expected, so that NEES is below 1 along x and z. With",
        "--across it does, and NEES is as it should be (docs/decisions/030-many-bubbles.md).",
        "",
        "| frames | bubbles in sight | frames a track | learning | smoothing | verdict | tables "
        "| all | peak GB | first line, s | RMS error x, y, z, µm | NEES |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    found = {}
    for case in dict.fromkeys(cases):
        one = found[case] = in_a_process(case)
        parts = [
            sum(s for n, s in one["seconds"].items() if n.startswith(word))
            for word in ("learning", "smoothing", "judging", "making")
        ]
        words = " | ".join(f"{s:.1f}" for s in (*parts, one["total"]))
        um = ", ".join(f"{e:.1f}" for e in one["um"])
        lines.append(
            f"| {case[0]:,} | {case[1]} | {case[2] or 'all'} | {words} | {one['gb']:.2f} "
            f"| {one['first']:.3f} | {um} | {one['nees']:.2f} |"
        )
        print(lines[-1], flush=True)

    def growth(of: list[tuple[int, int, int]], which: int) -> str:
        sizes = [c[which] for c in of]
        rest = [
            sum(s for n, s in found[c]["seconds"].items() if not n.startswith("learning"))
            for c in of
        ]
        whole = exponent(sizes, [found[c]["total"] for c in of])
        return f"{whole:.2f}, without learning {exponent(sizes, rest):.2f}"

    by_frames = [c for c in found if c[1] == 20 and not c[2]]
    by_bubbles = sorted(c for c in found if c[0] == 1000 and not c[2])
    lines.append("")
    if len(by_frames) > 1:
        lines.append(f"Exponent in frames: {growth(by_frames, 0)}.")
    if len(by_bubbles) > 1:
        lines.append(f"Exponent in bubbles: {growth(by_bubbles, 1)}.")
        crowds = [c for c in by_bubbles if c[1] > 1]
        lines.append(f"Exponent in bubbles from {crowds[0][1]} on: {growth(crowds, 1)}.")
    print("\n".join(lines[-3:]))
    return lines


if __name__ == "__main__":
    main()
