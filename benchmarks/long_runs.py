"""Do memory and time of `telerig track` and `telerig smooth` stay bounded on long runs of tables?

Usage: python benchmarks/long_runs.py [--frames 10000 30000 100000] [--steps track smooth]
       [--interrupt WORDS ...] [--out FILE.md]

20 bubbles in sight at 500 Hz, tracks of 0.5 s in the mean, a shaking rig, two affine cameras: the
table of detections is written some frames at a time, and so is one of tracks, so that both commands
can be measured by themselves. Each runs as a process of its own. Memory: the largest resident set,
also so far when `telerig smooth` begins a piece. With --interrupt it gets Ctrl-C as soon as its
progress says the words, like "along the run, piece 3 of", and is given again.
"""

from __future__ import annotations

import argparse
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.simulation.run.motion import rig_shake, stochastic_paths
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

RATE_HZ, BUBBLES, TRACK, SIGMA_PX, RADIUS_PX = 500.0, 20, 250, 0.3, 8.0
UP = np.array([0.0, -1.0, 0.0])
_AT_ONCE = 2000

COMMAND = """
import sys, runpy
sys.argv = ["telerig", *sys.argv[1:]]
try:
    runpy.run_module("telerig.scripts.main", run_name="__main__")
finally:
    status = dict(line.split(":", 1) for line in open("/proc/self/status"))
    print(f"PEAK {int(status['VmHWM'].split()[0]) / 1024:.0f}")
"""

RIG = """schema = 1
name = "long"
[cameras.left]
image_size_px = [1024, 1024]
scale_px_per_mm = 10.0
[cameras.right]
image_size_px = [1024, 1024]
scale_px_per_mm = 10.0
[stereo]
right_from_left_rotvec_deg = [0.0, 90.0, 0.0]
[target]
layout = "grid"
rows = 3
columns = 5
pitch_mm = 7.0
dot_diameter_mm = 2.4
"""


def write_run(folder: Path, frames: int, rng: np.random.Generator) -> Path:
    """Write a dataset with one run of so many frames; its folder."""
    turn = Pose.from_rotvec([0.0, np.pi / 2, 0.0])
    cameras = (
        Camera.create("left", (1024, 1024), 10.0),
        Camera.create("right", (1024, 1024), 10.0, camera_from_rig=turn),
    )
    run = folder / "runs" / "long"
    run.mkdir(parents=True)
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    (run / "run.toml").write_text(f"frame_rate_hz = {RATE_HZ}\nstart_s = 0.0\n", encoding="utf-8")
    known = calibration_from_cameras(list(cameras), name="truth")
    covariance = np.diag(np.repeat([2e-4, 2e-3], 3) ** 2)  # rad, mm
    replace(known, covariance=covariance).save(folder / "calibration")
    shake = rig_shake(
        1 / RATE_HZ, frames, rng, cameras=2, rms_mm=[0.0, 0.2, 0.0], frequency_hz=9.0
    ).offset_mm
    number, slots = 0, []
    for _ in range(BUBBLES):
        place, particle, first = np.full((frames, 3), np.nan), np.full(frames, -1), 0
        while first < frames - 3:
            end = min(frames, first + int(TRACK * rng.uniform(0.5, 1.5)))
            place[first:end], particle[first:end] = _path(end - first, rng), number
            number, first = number + 1, end + 1
        slots.append((place, particle))
    for first in range(0, frames, _AT_ONCE):
        every = np.arange(first, min(first + _AT_ONCE, frames))
        _append(run, cameras, every, slots, shake, rng)
    return run


def _path(frames: int, rng: np.random.Generator) -> Array:
    """Places (frames, 3) of a bubble in the lab, mm."""
    path = stochastic_paths(
        1 / RATE_HZ, frames, rng, rise_mm_s=np.full(1, 10.0), wander_mm_s=10.0, wander_tau_s=0.3,
        height_oscillation=(0.18, 13.0, 0.03), lateral_oscillation=(2.0, 6.0, 0.03),
    )  # fmt: skip
    lab = path.height_mm[0, :, None] * UP
    lab[:, [0, 2]] += path.lateral_mm[0]
    return np.asarray(lab + rng.uniform(-15, 15, 3))


def _append(
    run: Path, cameras: tuple[Camera, Camera], frames: Array, slots: list[tuple[Array, Array]],
    shake: Array, rng: np.random.Generator,
) -> None:  # fmt: skip
    """Append some frames to detections.csv and tracks.csv."""
    frame = np.tile(frames, len(slots))
    lab = np.concatenate([place[frames] for place, _ in slots])
    particle = np.concatenate([number[frames] for _, number in slots])
    there = particle >= 0
    frame, lab, particle = frame[there], lab[there], particle[there]
    tracks = pd.DataFrame({"frame": frame, "particle": particle, "t_s": frame / RATE_HZ})
    tracks[["x_mm", "y_mm", "z_mm"]] = lab + rng.normal(0, 0.1, lab.shape)
    seen = []
    for c, camera in enumerate(cameras):
        uv = camera.project(lab - shake[c][frame]) + SIGMA_PX * rng.normal(size=(len(lab), 2))
        tracks[[f"{camera.name}_{n}_px" for n in "uv"]] = uv
        variances = {"suu": SIGMA_PX**2, "suv": 0.0, "svv": SIGMA_PX**2}
        tracks = tracks.assign(**{f"{camera.name}_{n}_px2": v for n, v in variances.items()})
        seen.append(
            pd.DataFrame({"frame": frame, "camera": camera.name, "u_px": uv[:, 0],
                          "v_px": uv[:, 1], "sigma_px": SIGMA_PX, "a_px": RADIUS_PX,
                          "b_px": RADIUS_PX, "angle_rad": 0.0})
        )  # fmt: skip
    tracks["d_eq_mm"] = 2 * RADIUS_PX / 10
    for name, table in (("tracks", tracks), ("detections", pd.concat(seen))):
        file = run / f"{name}.csv" if name == "detections" else run.parent.parent / "tracks.csv"
        ordered = table.sort_values("frame", kind="stable")
        ordered.to_csv(file, mode="a", index=False, header=not file.exists(), float_format="%.5f")


def measured(
    step: str, run: Path, out: Path, interrupts: Sequence[str] = ()
) -> tuple[float, float, float]:
    """Processor seconds, wall seconds, and the largest resident set in MB, of all calls together.

    interrupts : words in lines of progress at which the command gets Ctrl-C.
    """
    place = run.parent.parent
    more = ["--tracks", place / "tracks.csv"] if step == "smooth" else []
    begun, before, peak = time.perf_counter(), _cpu_s(), 0.0
    left, said = list(interrupts), list[str]()
    while True:
        with subprocess.Popen(
            [sys.executable, "-c", COMMAND, step, run, "--calibration",
             place / "calibration" / "calibration.json", "--out", out, "--no-report", *more],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        ) as process:  # fmt: skip
            assert process.stdout is not None and process.stderr is not None
            for line in process.stderr:
                said.append(line)
                if " piece" in line:
                    status = Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8")
                    held = int(status.split("VmHWM:")[1].split()[0]) / 1024
                    words, peak = line.strip().partition("frames: ")[2], max(peak, held)
                    after_s = time.perf_counter() - begun
                    print(f"{words}: {held:.0f} MB, {after_s:.0f} s", flush=True)
                if left and left[0] in line:
                    process.send_signal(signal.SIGINT)
                    del left[0]
            ends = [float(line.split()[1]) for line in process.stdout if line[:4] == "PEAK"]
        peak = max([peak, *ends])
        if process.returncode == 0:
            return _cpu_s() - before, time.perf_counter() - begun, peak
        if process.returncode != 130:
            sys.exit("".join(said))


def _cpu_s() -> float:
    """Processor seconds of all commands so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, nargs="+", default=[10_000, 30_000, 100_000])
    parser.add_argument("--steps", nargs="+", default=["track", "smooth"])
    parser.add_argument("--interrupt", nargs="*", default=[])
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    lines = ["| command | frames | CPU s | wall s | memory MB | results MB |",
             "|---|---|---|---|---|---|"]  # fmt: skip
    print("\n".join(lines))
    for frames in asked.frames:
        with tempfile.TemporaryDirectory() as name:
            run = write_run(Path(name), frames, np.random.default_rng(1))
            for step in asked.steps:
                out = Path(name) / f"by-{step}"
                cpu, wall, peak = measured(step, run, out, asked.interrupt)
                size = sum(file.stat().st_size for file in out.iterdir()) / 1e6
                lines.append(
                    f"| {step} | {frames:,} | {cpu:.0f} | {wall:.0f} | {peak:.0f} | {size:.0f} |"
                )
                print(lines[-1], flush=True)
    if asked.out:
        asked.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
