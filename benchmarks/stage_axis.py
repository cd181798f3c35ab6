"""Travel axis and encoder scale from `stage_axis/`: an encoder that reads 1 % too much.

Usage: python benchmarks/stage_axis.py [--seeds 8] [--seed 0] [--out FILE.md]
Whole way: simulated dataset without images (dots to 0.01 px, positions to 1 µm, seven stops over
about 30 mm), self-calibration, stage. Every seed counts.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import telerig
from telerig.io.simulation.presets import run_preset

SCALE = 0.01


def one(seed: int, stops: int) -> tuple[float, float, float, float, float]:
    """Scale error and sd (ppm), axis error (µrad) and its squared distance in sd, travel (mm)."""
    config = run_preset("rise", frames=2)
    stage = replace(config.stage, axis_views=stops, encoder_scale=SCALE)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "data"
        data = telerig.simulate(
            replace(config, stage=stage), rng=np.random.default_rng(seed), out=folder, images=False
        )
        truth = json.loads((folder / "truth" / "stage_axis.json").read_text(encoding="utf-8"))
        found = telerig.calibrate(data).stage
    off = np.array(found["axis"]) - truth["axis"]
    tilts = np.array(found["basis"]).T @ off
    covariance = np.array(found["axis_covariance_rad2"])
    return (
        1e6 * (found["encoder_scale"] - SCALE),
        1e6 * found["encoder_scale_sd"],
        1e6 * float(np.linalg.norm(off)),
        float(tilts @ np.linalg.solve(covariance, tilts)),
        float(np.ptp(truth["position_mm"])),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stops", type=int, default=7)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for seed in range(options.seed, options.seed + options.seeds):
        rows.append(one(seed, options.stops))
        print(seed, rows[-1], flush=True)
    scale, sd, axis, distance, travel = np.array(rows).T
    text = f"""# Travel axis and encoder scale from stage_axis/

The encoder reads 1 % too much; {options.stops} stops over
{travel.min():.0f} to {travel.max():.0f} mm, positions to 1 µm, dots to 0.01 px,
the rig self-calibrated from the same dataset's views.
{len(rows)} seeds from {options.seed}.

| | RMS | largest | RMS of the stated sd | mean (error / sd)^2 |
|---|---|---|---|---|
| encoder scale, ppm | {_rms(scale):.0f} | {np.abs(scale).max():.0f} | {_rms(sd):.0f} | \
{np.mean((scale / sd) ** 2):.2f} |
| travel axis, µrad | {_rms(axis):.0f} | {axis.max():.0f} | | {np.mean(distance) / 2:.2f} |
"""
    print(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
