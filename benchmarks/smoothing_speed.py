"""How long does smoothing take, and how does that grow?

Usage: python benchmarks/smoothing_speed.py [--long] [--out FILE.md]
Processor time of this process, one thread; the least of several calls for short runs. A peer in
the same run: filterpy's Kalman filter and RTS smoother of a state of as many numbers, every frame
measured with as many pixels (matrices made beforehand). --long adds 100,000 frames and learning.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from shake_cases import SCENARIOS
from shake_learning_data import run as crowded
from shake_scene import Case, Run, simulate

from telerig.estimator.smoothing.graph.solve import solve
from telerig.estimator.smoothing.learning.default_priors import default_model
from telerig.estimator.smoothing.smooth import problem_of, smooth


def run_of(frames: int, rate_hz: float = 500.0) -> Run:
    scenario = replace(SCENARIOS["S2"], frames=frames, rate_hz=rate_hz)
    return simulate(Case(scenario), np.random.default_rng(0))


def timed(call: Callable[[], Any], repeats: int) -> tuple[float, float, Any]:
    """Least processor and wall seconds, and the last result."""
    cpu, wall, result = [], [], None
    for _ in range(repeats):
        begun, clock = time.process_time(), time.perf_counter()
        result = call()
        cpu.append(time.process_time() - begun)
        wall.append(time.perf_counter() - clock)
    return min(cpu), min(wall), result


def whole(run: Run, information: str, model: Any = "default") -> Any:
    inputs = run.inputs(information)
    return smooth(inputs.pop("tracks"), inputs.pop("calibration"), model=model, **inputs)


def rts_seconds(states: int, frames: int) -> float:
    """filterpy on a random stable model of so many states, four pixels a frame."""
    from filterpy.kalman import KalmanFilter

    rng = np.random.default_rng(0)
    peer: Any = KalmanFilter(dim_x=states, dim_z=4)
    peer.F = np.eye(states) * 0.95 + 0.01 * rng.normal(size=(states, states))
    peer.Q, peer.R = np.eye(states) * 1e-3, np.eye(4)
    peer.H = rng.normal(size=(4, states))
    pixels = rng.normal(size=(frames, 4, 1))
    begun = time.process_time()
    means, covariances, _, _ = peer.batch_filter(pixels)
    peer.rts_smoother(means, covariances)
    return time.process_time() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    lines = [
        "# Smoothing: time",
        "",
        "| run | frames | what is timed | CPU s | wall s | states a frame | filterpy RTS, CPU s "
        "| ratio |",
        "|---|---|---|---|---|---|---|---|",
    ]

    def row(name: str, frames: int, what: str, repeats: int, call: Callable[[], Any]) -> Any:
        cpu, wall, result = timed(call, repeats)
        solution = getattr(result, "solution", result)
        graph = solution.graph
        states = graph.shake.size + len(graph.problem.bubbles) * graph.bubble.size
        peer = rts_seconds(states, min(frames, 2000)) * frames / min(frames, 2000)
        lines.append(
            f"| {name} | {frames:,} | {what} | {cpu:.2f} | {wall:.2f} | {states} | {peer:.2f} "
            f"| {cpu / peer:.2f} |"
        )
        print(lines[-1], flush=True)
        return result

    short, sensors, many = run_of(59, 100.0), run_of(1500, 1000.0), run_of(10_000)
    for run, information, name, frames, repeats in (
        (short, "one", "2004's", 59, 5),
        (sensors, "arms", "two sensors at 2 kHz", 1500, 2),
        (sensors, "references", "four marks a camera", 1500, 2),
        (many, "one", "images alone", 10_000, 3),
    ):
        found = row(name, frames, "`telerig.smooth`, all of it", repeats,
                    lambda r=run, i=information: whole(r, i))  # fmt: skip
        inputs = run.inputs(information)
        problem, *_ = problem_of(inputs.pop("tracks"), inputs.pop("calibration"), **inputs)
        row(name, frames, "one solution with all covariances", repeats,
            lambda p=problem, m=found.model: solve(p, m))  # fmt: skip
    for frames, bubbles, rate_hz in ((59, 5, 100.0), (400, 5, 500.0), (1000, 5, 500.0),
                                     (400, 20, 500.0)):  # fmt: skip
        crowd, _, _ = crowded(
            np.random.default_rng(1), bubbles=bubbles, seconds=frames / rate_hz, rate_hz=rate_hz
        )
        prior = default_model(crowd)
        row(f"{bubbles} bubbles, images alone", frames, "one solution with all covariances",
            1 if bubbles > 5 else 3, lambda p=crowd, m=prior: solve(p, m))  # fmt: skip
    if args.long:
        longest, s1 = run_of(100_000), simulate(Case(SCENARIOS["S1"]), np.random.default_rng(0))
        row("images alone", 100_000, "`telerig.smooth`, all of it", 1,
            lambda: whole(longest, "one"))  # fmt: skip
        row("S1", 750, "`telerig.smooth`, modes learned", 1,
            lambda: whole(s1, "one", "auto"))  # fmt: skip
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    lines += ["", f"Peak memory of the process: {peak:.1f} GB."]
    if args.out:
        args.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
