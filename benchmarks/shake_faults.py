"""What goes wrong in real runs: outliers, drop-outs, a late sensor, a wrong encoder scale.

Usage: python benchmarks/shake_faults.py [--seeds 4] [--seed 0] [--only outliers,...]
    [--out FILE.md]
Scenario S2 (and, for the encoder, with a start ramp), with references and with arm accelerometers;
"true" tells the smoother how shake and bubble move, "default" nothing. Every seed counts.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
sys.path.insert(0, str(Path(__file__).parent))
from shake_cases import SCENARIOS, middle
from shake_problem import true_model
from shake_scene import LATERAL, LATERAL_SHAKE, Case, Run, simulate

from telerig.estimator.smoothing.problem.problem import ShakeModel
from telerig.estimator.smoothing.result import Smoothing
from telerig.estimator.smoothing.smooth import smooth

Array = NDArray[np.float64]

BASE = Case(SCENARIOS["S2"])
FAULTS = {
    "clean": BASE,
    "outliers": replace(BASE, outliers=0.05),
    "drop-outs": replace(BASE, dropped=0.1),
    "late sensor": replace(BASE, delay_s=1e-3),
    "encoder scale": replace(BASE, encoder_scale=0.01, scale_sigma=None),
    "encoder scale stated": replace(BASE, encoder_scale=0.01, scale_sigma=0.01),
}
WORDS = {
    "clean": "nothing wrong",
    "outliers": "5 % of all pixels off by up to 20 px on each axis",
    "drop-outs": "10 % of the frames without a bubble",
    "late sensor": "accelerometers 1 ms late",
    "encoder scale": "the encoder reads 1 % too much",
    "encoder scale stated": "the same, and rig.toml states scale_sigma = 0.01",
}
HEAD = (
    "| fault | information | model | runs | RMS | over clean | predicted | (e/sd)^2 | delay ms "
    "| scale ppm |\n" + 10 * "|---" + "|"
)
INFORMATION = ("references", "arms")


@dataclass(frozen=True)
class Outcome:
    """Vertical RMS errors and predicted sd of the middle 80 %, (e/sd)^2, constants found."""

    position_um: float
    velocity: float
    square: float
    sigma_um: float
    delay_ms: float
    scale_ppm: float


def told(fault: str, information: str) -> ShakeModel:
    """The true hyper-parameters, with the constants that the fault is about left free."""
    model = true_model(BASE.scenario, information, lateral=LATERAL, lateral_shake=LATERAL_SHAKE)
    if fault == "late sensor":
        return replace(model, accelerometer_delay_sigma_s=2e-3)
    if fault == "encoder scale":
        return replace(model, encoder_scale_sigma=0.02)
    return model


def outcome(run: Run, information: str, model: Any) -> Outcome:
    inputs = run.inputs(information)
    tracks, calibration = inputs.pop("tracks"), inputs.pop("calibration")
    result = smooth(tracks, calibration, model=model, **inputs)
    table = result.trajectories[result.trajectories["particle"] == 0]
    rows = table["frame"].to_numpy()
    inner = middle(len(run.t_s))
    keep = (rows >= inner.start) & (rows < inner.stop)
    rows = rows[keep]
    height, speed = ((table[c].to_numpy()[keep]) for c in ("y_mm", "vy_mm_s"))
    off = height - run.position_mm[0, rows, 1]
    fast = speed - run.velocity_mm_s[0, rows, 1]
    sigma = table["sy_mm"].to_numpy()[keep]
    return Outcome(
        1e3 * float(np.sqrt(np.mean(off**2))),
        float(np.sqrt(np.mean(fast**2))),
        float(np.mean((off / sigma) ** 2)),
        1e3 * float(np.sqrt(np.mean(sigma**2))),
        *_constants(result, run),
    )


def _constants(result: Smoothing, run: Run) -> tuple[float, float]:
    """Delay found (ms) and the encoder's scale error (ppm) less the true ones; NaN if held."""
    solution = result.solution
    delay = scale = np.nan
    if solution.graph.sensor_flags[1] and len(solution.delays_s):
        delay = 1e3 * float(np.mean(solution.delays_s) - run.case.delay_s)
    if solution.graph.encoder_size and solution.state.encoder.size:
        scale = 1e6 * float(solution.state.encoder[0] - run.case.encoder_scale)
    return delay, scale


def line(
    fault: str, information: str, model: str, found: list[Outcome], clean: list[Outcome]
) -> str:
    """A row; ``clean`` are the same seeds without the fault."""
    ratios = [_rms(found, of) / _rms(clean, of) for of in ("position_um", "sigma_um")]
    position, velocity = _rms(found, "position_um"), _rms(found, "velocity")
    square = float(np.mean([o.square for o in found]))
    cells = [WORDS[fault], information, model, f"{len(found)}", f"{position:.1f}/{velocity:.2f}"]
    cells += [*(f"{ratio:.3f}" for ratio in ratios), f"{square:.2f}"]
    for name in ("delay_ms", "scale_ppm"):
        off = np.abs([getattr(o, name) for o in found])
        cells.append("" if np.isnan(off).any() else f"{off.max():.3g}")
    return "| " + " | ".join(cells) + " |"


def _rms(found: list[Outcome], of: str) -> float:
    return float(np.sqrt(np.mean([getattr(o, of) ** 2 for o in found])))


def lines(options: argparse.Namespace) -> Iterable[str]:
    wanted = options.only.split(",")
    for model in options.models.split(","):
        for information in options.information.split(","):
            clean: list[Outcome] = []
            for fault, case in FAULTS.items():
                if fault != "clean" and fault not in wanted:
                    continue
                if (fault, information) in {("late sensor", "references")}:
                    continue
                if fault == "encoder scale stated" and (model, information) != ("default", "arms"):
                    continue
                found = []
                for seed in range(options.seed, options.seed + options.seeds):
                    run = simulate(case, np.random.default_rng(seed))
                    chosen = told(fault, information) if model == "true" else model
                    found.append(outcome(run, information, chosen))
                    print(fault, information, model, seed, found[-1], flush=True)
                if fault == "clean":
                    clean = found
                yield line(fault, information, model, found, clean)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(FAULTS))
    parser.add_argument("--models", default="true,default")
    parser.add_argument("--information", default=",".join(INFORMATION))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = list(lines(options))
    text = f"""# Faults in the data

S2, {options.seeds} seeds from {options.seed};
vertical RMS error of the middle 80 %, position µm / velocity mm/s; its
ratio to the same without the fault, and the ratio that the posterior predicts (RMS of the stated
standard deviations, exact for the true model); mean of (error / sd)^2; the largest error, over the
seeds, of the accelerometers' delay and of the encoder's scale where the smoother estimates them.
The encoder's scale is stated as exact except where it is at fault. There the true model gives it a
prior of 2 %; the defaults free it with marks, and without add what is assumed of it (0.1 %)
or stated to the standard deviations: no residual shows it.

{HEAD}
{chr(10).join(rows)}
"""
    print(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
