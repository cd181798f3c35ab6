"""Does the memory of `telerig track` grow with the run?

Usage: python benchmarks/track_memory.py [--frames 100 1000 10000] [--out FILE.md]

A simulated run of 59 frames (two cameras, 512 x 512) is repeated by links; every repetition ends
the tracks and starts new ones. Each length is tracked by a process of its own. Memory: the largest
resident set of the main process, and of its largest worker.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import telerig
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset

TRACK = """
import resource, sys, runpy
sys.argv = ["telerig", *sys.argv[1:]]
try:
    runpy.run_module("telerig.scripts.main", run_name="__main__")
finally:
    own, worker = (resource.getrusage(who).ru_maxrss / 1024
                   for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(f"MEMORY {own:.0f} {worker:.0f}")
"""


def repeated(source: Path, folder: Path, frames: int) -> Path:
    """A dataset whose run has so many frames, links to the source's images."""
    run = folder / "runs" / "rise"
    run.mkdir(parents=True)
    (folder / "rig.toml").symlink_to(source / "rig.toml")
    for camera in ("left", "right"):
        images = sorted((source / "runs" / "rise" / camera).iterdir())
        (run / camera).mkdir(parents=True)
        for k in range(frames):
            (run / camera / f"{k:06d}.tif").symlink_to(images[k % len(images)])
    (run / "run.toml").write_text("frame_rate_hz = 100.0\nstart_s = 0.0\n", encoding="utf-8")
    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, nargs="+", default=[100, 1000, 10000])
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    lines = ["| frames | memory MB | largest worker MB | frames/s |\n|---|---|---|---|"]
    print(lines[0])
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        config = run_preset("rise")
        telerig.simulate(config, rng=np.random.default_rng(1), out=place / "source")
        cameras = list(true_cameras(config.calibration).values())
        calibration_from_cameras(cameras, name="truth").save(place / "calibration")
        for frames in asked.frames:
            run = repeated(place / "source", place / f"{frames}", frames)
            begun = time.perf_counter()
            done = subprocess.run(
                [sys.executable, "-c", TRACK, "track", run, "--no-report", "--quiet",
                 "--calibration", place / "calibration" / "calibration.json"],
                capture_output=True, text=True, check=False, env=dict(os.environ),
            )  # fmt: skip
            found = [line for line in done.stdout.splitlines() if line.startswith("MEMORY")]
            if done.returncode or not found:
                sys.exit(done.stdout + done.stderr)
            own, worker = found[0].split()[1:]
            speed = frames / (time.perf_counter() - begun)
            lines.append(f"| {frames} | {own} | {worker} | {speed:.1f} |")
            print(lines[-1], flush=True)
    print(f"this process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
    if asked.out:
        asked.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
