"""Does a planned run reach what `telerig plan` expects of it?

Usage: python benchmarks/plan.py [--seeds 6] [--out FILE.md]
Runs of the simulator are tracked and smoothed with the true cameras, an encoder whose scale is said
to be exact, as it is, and all other options at their defaults. (A calibration's own frame may lie
elsewhere than the true one; its covariance is measured by covariance.py.)
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

import telerig
from telerig.command_options import Experiment
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.estimator.plan import expect
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.config import RunConfig
from telerig.io.simulation.presets import run_preset

SENSORS = {"marks": (4, ()), "arms": (0, ("left", "right")), "both": (4, ("left", "right"))}
SCENARIOS = {"S2": (250,), "S1": (375,), "S0": (59,), "S6": (250, 750)}
"""Numbers of frames. S6 has accelerometers alone, over four and over twelve periods of shake."""


def config_of(name: str, sensors: str, frames: int) -> RunConfig:
    preset, (marks, arms) = run_preset(name, frames=frames), SENSORS[sensors]
    stage = replace(preset.stage, accelerometers=arms, ramp_s=0.0)
    return replace(preset, stage=stage, table=replace(preset.table, references=marks))


def planned(config: RunConfig) -> Experiment:
    """The experiment as a user would describe this run. The simulator's sigma_px is known."""
    stage = config.stage
    amplitude, hz, _ = config.motion.lateral_oscillation
    return Experiment(
        config.frame_rate_hz, config.frames / config.frame_rate_hz, sigma_px=config.table.sigma_px,
        rise_mm_s=280.0, zigzag_hz=hz, zigzag_mm=amplitude, shake_hz=stage.shake_hz,
        shake_mm=stage.shake_mm / np.sqrt(2), marks=config.table.references,
    )  # fmt: skip


def one_run(config: RunConfig, seed: int) -> tuple[np.ndarray, np.ndarray, str, str]:
    """Mean square errors (3, 2) of position (µm^2) and velocity, expected sds, both verdicts."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "tank"
        data = telerig.simulate(config, rng=np.random.default_rng(seed), out=place, images=False)
        cameras = list(true_cameras(config.calibration).values())
        calibration = calibration_from_cameras(cameras)
        rig = replace(data.rig, stage=replace(data.rig.stage, scale_sigma=0.0))
        expected = expect(rig, calibration, planned(config))
        run = data.runs[config.name].load()
        tracks = telerig.track(run, calibration)
        found = telerig.smooth(tracks, calibration, stage=run, rig=rig)
        truth = pd.read_csv(place / "truth" / "runs" / config.name / "bubbles.csv")
    both = found.trajectories.merge(truth, on="frame", suffixes=("", "_true"))
    edge = len(both) // 10
    both = both.iloc[edge : len(both) - edge]
    square = []
    for axis in "xyz":
        off = 1e3 * (both[f"{axis}_mm"] - both[f"{axis}_lab_mm"])
        fast = both[f"v{axis}_mm_s"] - both[f"v{axis}_lab_mm_s"]
        square.append((float((off**2).mean()), float((fast**2).mean())))
    sds = np.stack([expected.position_um, expected.velocity_mm_s], -1)
    return np.array(square), sds, str(expected.verdict), found.verdict["verdict"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--only", choices=SCENARIOS, help="one scenario")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    lines = []
    for name in [options.only] if options.only else SCENARIOS:
        for frames, sensors in product(SCENARIOS[name], ["arms"] if name == "S6" else SENSORS):
            config = config_of(name, sensors, frames)
            runs, refused = [], 0
            for seed in range(options.seeds):
                try:
                    runs.append(one_run(config, seed))
                except telerig.SensorError as error:
                    print(f"{name} {sensors} seed {seed}: refused: {error}", flush=True)
                    refused += 1
            error = np.sqrt(np.mean([run[0] for run in runs], 0))
            expected = np.median([run[1] for run in runs], 0)
            ratio = expected / error
            cells = [
                f"{e:.3g} / {o:.3g} = {r:.2f}"
                for e, o, r in zip(expected.T.ravel(), error.T.ravel(), ratio.T.ravel())
            ]
            verdicts = [run[2] for run in runs], [run[3] for run in runs]
            same = f"{verdicts[0][0]}; {verdicts[1].count(verdicts[0][0])} of {len(runs)}"
            same += f", {refused} refused" if refused else ""
            lines.append(f"| {name} | {frames} | {sensors} | " + " | ".join(cells) + f" | {same} |")
            print(lines[-1], flush=True)
    text = f"""# What `telerig plan` expects, and what runs reach

Printed by `benchmarks/plan.py`: expected standard deviation / RMS error of {options.seeds}
simulated runs (root mean square over frames and runs, without the first and last tenth) = their
ratio. Position µm, velocity mm/s. Last: the expected verdict, and how many runs got it.

| scenario | frames | sensors | x | y | z | vx | vy | vz | verdict |
|---|---|---|---|---|---|---|---|---|---|
{chr(10).join(lines)}
"""
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
