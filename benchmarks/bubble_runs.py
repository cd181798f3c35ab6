"""Simulated runs tracked from their images: are all bubbles found, paired, and kept apart?

Usage: python benchmarks/bubble_runs.py [--preset swarm] [--seeds 5] [--frames 60] [--bubbles 20]
       [--out FILE.md]

The true cameras are used as calibration, so that only the tracking is judged. A bubble counts as
in view when both images show it whole. A 3-D point is right when both its pixels are within
3 px of one true bubble's. Recall: right points over bubbles in view; precision: right points
over points in space (points of bubbles that an image cuts are left out of both). Swaps: changes
of the true bubble along a track. Centre errors are of right points, from the pixels, against the
projected centre of volume (2-D RMS over 1.414) and against the true silhouette's centroid.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

import telerig
from telerig.estimator.imported_calibration import calibration_from_cameras
from telerig.estimator.tracks import Tracks
from telerig.io.run_presets import run_preset
from telerig.io.simulation_scene import true_cameras

NEAR_PX = 3.0


@dataclass(frozen=True)
class Score:
    """Counts of one run."""

    in_view: int
    right: int
    wrong: int
    tracks: int
    swaps: int
    breaks: int
    error_px: float
    corrected_px: float
    silhouette_px: float
    miss_px: float
    frames_per_s: float

    @property
    def recall(self) -> float:
        return self.right / max(self.in_view, 1)

    @property
    def precision(self) -> float:
        return self.right / max(self.right + self.wrong, 1)


def judge(tracks: Tracks, truth: pd.DataFrame, cameras: list[str], frames_per_s: float) -> Score:
    """Compare tracks with `truth/runs/<run>/bubbles.csv`."""
    whole = (truth[[f"{c}_whole" for c in cameras]] == 1).all(axis=1)
    seen = {frame: part for frame, part in truth.assign(whole=whole).groupby("frame")}
    right = wrong = swaps = 0
    errors: dict[str, list[float]] = {"raw": [], "corrected": [], "silhouette": []}
    identity: dict[int, int] = {}
    for row in tracks.table.itertuples():
        there = seen.get(row.frame)
        if there is None:
            wrong += 1
            continue
        off = [
            np.hypot(there[f"{c}_u_px"] - getattr(row, f"{c}_u_px"),
                     there[f"{c}_v_px"] - getattr(row, f"{c}_v_px"))
            for c in cameras
        ]  # fmt: skip
        largest = np.maximum(*off).to_numpy()
        best = int(largest.argmin())
        bubble = there.iloc[best]
        if largest[best] > NEAR_PX:
            wrong += 1
            continue
        if row.particle in identity and identity[row.particle] != bubble["particle"]:
            swaps += 1
        identity[row.particle] = bubble["particle"]
        if not bubble["whole"]:
            continue
        right += 1
        for c in cameras:
            for x in "uv":
                measured = getattr(row, f"{c}_{x}_px")
                errors["raw"].append(measured - bubble[f"{c}_{x}_px"])
                shift = getattr(row, f"{c}_d{x}_px")
                errors["corrected"].append(measured + shift - bubble[f"{c}_{x}_px"])
                errors["silhouette"].append(measured - bubble[f"{c}_silhouette_{x}_px"])
    rms = {name: float(np.sqrt(np.mean(np.square(v)))) for name, v in errors.items() if v}
    kinds = tracks.events["kind"].value_counts()
    return Score(
        int(whole.sum()), right, wrong, len(tracks), swaps, int(kinds.get("break", 0)),
        rms.get("raw", np.nan), rms.get("corrected", np.nan), rms.get("silhouette", np.nan),
        tracks.summary["pairs"]["rms_px"][0], frames_per_s,
    )  # fmt: skip


def run_one(preset: str, seed: int, frames: int, bubbles: int | None, folder: Path) -> Score:
    changes = {"frames": frames} | ({} if bubbles is None else {"bubbles": bubbles})
    config = run_preset(preset, **changes)
    data = telerig.simulate(config, rng=np.random.default_rng(seed), out=folder / str(seed))
    (name,) = data.runs
    run = telerig.load_run(data.runs[name].path)
    cameras = true_cameras(config.calibration)
    calibration = calibration_from_cameras(list(cameras), name="truth")
    begun = time.perf_counter()
    tracks = telerig.track(run, calibration)
    speed = run.frame_count / (time.perf_counter() - begun)
    truth = pd.read_csv(data.path / "truth" / "runs" / name / "bubbles.csv")
    return judge(tracks, truth, [c.name for c in cameras], speed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="swarm")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--bubbles", type=int)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    head = (
        "| preset, seed | in view | recall | precision | tracks | swaps | breaks | "
        "centre to volume px | corrected px | to silhouette px | frames/s |\n" + "|---" * 11 + "|"
    )
    lines = [head]
    print(head)
    scores = []
    for seed in range(asked.first, asked.first + asked.seeds):
        with tempfile.TemporaryDirectory() as folder:
            s = run_one(asked.preset, seed, asked.frames, asked.bubbles, Path(folder))
        scores.append(s)
        lines.append(
            f"| {asked.preset} {seed} | {s.in_view} | {s.recall:.4f} | {s.precision:.4f} | "
            f"{s.tracks} | {s.swaps} | {s.breaks} | {s.error_px:.3f} | {s.corrected_px:.3f} | "
            f"{s.silhouette_px:.3f} | {s.frames_per_s:.1f} |"
        )
        print(lines[-1], flush=True)
    right, wrong = sum(s.right for s in scores), sum(s.wrong for s in scores)
    total = f"\nRecall {right / sum(s.in_view for s in scores):.4f}, precision {right / (right + wrong):.4f}."
    lines.append(total)
    print(total)
    if asked.out:
        asked.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
