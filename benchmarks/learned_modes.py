"""What learning of modes finds, and what its priors cost. Nothing is told but what is studied.

Usage: python benchmarks/learned_modes.py [--runs 40] [--corners 25,60,120] [--seeds 2] [--seed 960]
                                          [--out FILE.md]
First: bubbles swing at 13 Hz while the rig shakes at 30 Hz and, hidden below the bubbles' line, at
13 Hz too. How far off are the heights, and how far stated, with the prior of such a line
(docs/decisions/017, point 3) and with all sizes alike? All else has the true hyper-parameters.
Second: which corner of the rig's force is found in S4 with five bubbles?
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from shake_learning_data import ARM_HZ, COMMON_HZ, run, true_model
from shake_scene import cases, simulate

from telerig.estimator.smoothing.graph.solve import Options, solve
from telerig.estimator.smoothing.learning import spectral_lines
from telerig.estimator.smoothing.learning.likelihood import maximise
from telerig.estimator.smoothing.learning.lines_of_sight import pooled, signals_of
from telerig.estimator.smoothing.learning.parameters import FORCE
from telerig.estimator.smoothing.problem.problem import ShakeModel, SmoothingProblem
from telerig.estimator.smoothing.smooth import smooth

Array = NDArray[np.float64]

RIG_HZ, RIG_MM = 30.0, 0.5
HIDDEN_MM = (0.0, 0.08, 0.15)
LINE = "bubble.zigzags.1."
PRIORS = {
    "as it is": spectral_lines.hidden_mode_weights,
    "all sizes alike": lambda line, own: np.ones(6),
}


def hidden(hidden_mm: float, seed: int) -> Iterable[tuple[str, float, float, float]]:
    """Prior, mean square error and variance of the heights (mm^2), mean of (error / sd)^2."""
    problem, lab, _ = run(
        np.random.default_rng(seed), bubbles=4, seconds=1.2, rate_hz=200.0, shake_mm=RIG_MM,
        sigma_px=0.2, common_hz=RIG_HZ, hidden_mm=hidden_mm,
    )  # fmt: skip
    told = true_model(RIG_MM)
    common, *arms = (replace(m, force_hz=60.0) for m in told.modes)
    arms = [replace(m, frequency_hz=ARM_HZ / COMMON_HZ * RIG_HZ) for m in arms]
    told = replace(told, modes=(replace(common, frequency_hz=RIG_HZ), *arms))
    heights = pooled(signals_of(problem)[0])
    names = [LINE + last for last in ("frequency_hz", "damping", "rms_mm")]
    found = maximise(heights, told, names, steps=8).model
    for prior, weights in PRIORS.items():
        with patch.object(spectral_lines, "hidden_mode_weights", weights):
            model = spectral_lines.with_hidden_modes(heights, found, (0.0, 1.0, 0.0), problem.up)
        yield prior, *_heights(problem, model, lab)


def _heights(
    problem: SmoothingProblem, model: ShakeModel, lab: Array
) -> tuple[float, float, float]:
    solution = solve(problem, model, Options(robust=False))
    frame, found = solution.graph, solution.covariances
    row = frame.bubble.position[1]
    bubble, at = frame.bubble_of_row, frame.frame_of_row
    edge = lab.shape[1] // 10
    inner = (at >= edge) & (at < lab.shape[1] - edge)
    off = (solution.state.bubbles @ row - lab[bubble, at, 1])[inner]
    variance = np.einsum("d,nde,e->n", row, found.bubbles, row)[inner]
    return np.mean(off**2), np.mean(variance), np.mean(off**2 / variance)


def hidden_report(runs: int) -> Iterable[str]:
    columns = ["hidden line mm", "prior", "runs", "RMS µm", "sd µm", "(e/sd)^2", "worst"]
    yield "| " + " | ".join(columns) + " |\n|" + "---|" * len(columns) + "\n"
    for hidden_mm in HIDDEN_MM:
        rows = [row for k in range(runs) for row in hidden(hidden_mm, 100 + k)]
        for prior in PRIORS:
            square, variance, ratio = np.transpose([r[1:] for r in rows if r[0] == prior])
            yield (
                f"| {hidden_mm} | {prior} | {runs} | {1e3 * np.sqrt(square.mean()):.0f} | "
                f"{1e3 * np.sqrt(variance.mean()):.0f} | {ratio.mean():.2f} | {ratio.max():.1f} |\n"
            )


def corner_report(corners: Sequence[float], seeds: Sequence[int]) -> Iterable[str]:
    columns = ["made with Hz", "seed", "found Hz", "stated, relative", "RMS µm", "sd µm"]
    yield "| " + " | ".join(columns) + " |\n|" + "---|" * len(columns) + "\n"
    for corner in corners:
        case = replace(cases()["S4"], force_hz=corner)
        for seed in seeds:
            made = simulate(case, np.random.default_rng([seed, 4]))
            inputs = made.inputs("five")
            result = smooth(inputs.pop("tracks"), inputs.pop("calibration"), **inputs)
            table = result.trajectories
            frame, bubble = table["frame"].to_numpy(), table["particle"].to_numpy()
            edge = len(made.t_s) // 10
            inner = (frame >= edge) & (frame < len(made.t_s) - edge)
            off = (table["y_mm"].to_numpy() - made.position_mm[bubble, frame, 1])[inner]
            sd = table["sy_mm"].to_numpy()[inner]
            model = result.model
            found, stated = model.force_hz, model.learned.get(FORCE)
            yield (
                f"| {corner:g} | {seed} | {'none' if found is None else f'{found:.1f}'} | "
                f"{'' if stated is None else f'{stated:.3f}'} | "
                f"{1e3 * np.sqrt(np.mean(off**2)):.1f} | {1e3 * np.sqrt(np.mean(sd**2)):.1f} |\n"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=40, help="with a hidden line")
    parser.add_argument("--corners", default="25,60,120")
    parser.add_argument("--seeds", type=int, default=2, help="of each corner")
    parser.add_argument("--seed", type=int, default=960, help="the first")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    corners = [float(c) for c in options.corners.split(",") if c]
    seeds = range(options.seed, options.seed + options.seeds)
    parts = []
    for title, rows in (
        ("A rig's line hidden below the bubbles'", hidden_report(options.runs)),
        ("Corners of the rig's force", corner_report(corners, seeds)),
    ):
        parts.append(f"\n## {title}\n\n")
        print(parts[-1], end="")
        for row in rows:
            parts.append(row)
            print(row, end="", flush=True)
    if options.out:
        options.out.write_text("# Learned modes\n" + "".join(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
