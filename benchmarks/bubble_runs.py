"""Simulated runs tracked from their images: are all bubbles found, paired, and kept apart?

Usage: python benchmarks/bubble_runs.py [--preset swarm] [--seeds 5] [--frames 60] [--bubbles 20]
       [--out FILE.md]

The true cameras are used as calibration, so that only the tracking is judged. A bubble counts as
in view when both images show it whole. A 3-D point is right when both its pixels are within
3 px of one true bubble's. Recall: right points over bubbles in view; precision: right points
over points in space (points of bubbles that an image cuts are left out of both). Swaps: changes
of the true bubble along a track. Centre errors are of right points, from the pixels, against the
projected centre of volume (RMS per coordinate) and against the true silhouette's centroid.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
from track_score import FullScore, full_score

import telerig
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset


def run_one(
    preset: str, seed: int, frames: int, bubbles: int | None, folder: Path
) -> tuple[FullScore, float]:
    changes = {"frames": frames} | ({} if bubbles is None else {"bubbles": bubbles})
    config = run_preset(preset, **changes)
    data = telerig.simulate(config, rng=np.random.default_rng(seed), out=folder / str(seed))
    (name,) = data.runs
    run = telerig.load_run(data.runs[name].path)
    cameras = list(true_cameras(config.calibration).values())
    calibration = calibration_from_cameras(cameras, name="truth")
    begun = time.perf_counter()
    tracks = telerig.track(run, calibration)
    speed = run.frame_count / (time.perf_counter() - begun)
    truth = pd.read_csv(data.path / "truth" / "runs" / name / "bubbles.csv")
    return full_score(tracks, truth, [c.name for c in cameras]), speed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="swarm")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--bubbles", type=int)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    names = [
        "preset, seed", "in view", "recall", "hidden by half", "recall of the others", "precision",
        "tracks", "swaps", "breaks", "centre to volume px", "corrected px", "to silhouette px",
        "frames/s",
    ]  # fmt: skip
    head = f"| {' | '.join(names)} |\n|{'---|' * len(names)}"
    lines = [head]
    print(head)
    scores = []
    for seed in range(asked.first, asked.first + asked.seeds):
        with tempfile.TemporaryDirectory() as folder:
            s, speed = run_one(asked.preset, seed, asked.frames, asked.bubbles, Path(folder))
        scores.append(s)
        lines.append(
            f"| {asked.preset} {seed} | {s.in_view} | {s.recall:.4f} | {s.hidden} | "
            f"{s.recall_in_sight:.4f} | {s.precision:.4f} | "
            f"{s.tracks} | {s.swaps} | {s.breaks} | {s.centre_px:.3f} | {s.corrected_px:.3f} | "
            f"{s.silhouette_px:.3f} | {speed:.1f} |"
        )
        print(lines[-1], flush=True)
    right, wrong = sum(s.right for s in scores), sum(s.wrong for s in scores)
    in_view = sum(s.in_view for s in scores)
    shown = sum(s.right - s.hidden_right for s in scores) / sum(
        s.in_view - s.hidden for s in scores
    )
    total = (
        f"\nRecall {right / in_view:.4f}, of bubbles that show half of their outline {shown:.4f}; "
        f"precision {right / (right + wrong):.4f}."
    )
    lines.append(total)
    print(total)
    if asked.out:
        asked.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
