"""What does a whole run cost, phase by phase, beside a minimal pipeline?

Usage: python benchmarks/whole_run.py [--data FOLDER] [--images 60] [--frames 1000] [--out FILE.md]

The run: 1280 x 800 px, two cameras, 20 bubbles in sight (the simulator's `swarm`). Simulating the
images takes longer than tracking them, so they are kept in ``--data`` for the next time, and each
of the ``--frames`` of a long run is a link to one of them (forwards, then backwards: the bubbles'
motion is continuous). Seconds are processor time of one thread; the ratios decide, because the
seconds depend on the machine.

Peers, in the same process: a minimal pipeline of OpenCV and NumPy (median background, threshold,
contours with moments, the nearest neighbour in time; no covariance, no splitting, no flags), and
filterpy with SciPy for linking (rays paired by their shared coordinate, a Kalman filter of 12
states per bubble, `linear_sum_assignment`). trackpy is left out: it needs 91 to 487 ms an image.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
import pandas as pd

import telerig
from telerig.arrays import Array
from telerig.estimator.bubbles.background.from_run import Background, estimate_background
from telerig.estimator.bubbles.detect import detect_bubbles, load_compiled_loops
from telerig.estimator.bubbles.pairing.learning import learn_rig
from telerig.estimator.bubbles.shape.shapes import Shapes
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.estimator.rig_drift.estimate import PairCollector
from telerig.estimator.tracking.detect_run import lab_shift_px
from telerig.estimator.tracking.linking.filter import TrackerSettings, transition
from telerig.estimator.tracking.linking.frames_to_rows import RowMaker
from telerig.estimator.tracking.linking.tracker import Tracker
from telerig.io.machine.parallel import keep_freed_memory
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.rig.camera import Camera
from telerig.rig.triangulation import triangulate

Image = np.ndarray[Any, Any]
Tables = dict[str, list[pd.DataFrame]]

PRESET, SEED = "swarm", 1000
AXIS = np.array([0.0, -1.0, 0.0])
DEPTH = 0.3
LEAST_AREA_PX2 = 30.0
FURTHEST_MM = 1.0

COMMAND = """
import resource, sys, runpy
sys.argv = ["telerig", *sys.argv[1:]]
try:
    runpy.run_module("telerig.scripts.main", run_name="__main__")
finally:
    own, workers = (resource.getrusage(who)
                    for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    cpu = own.ru_utime + own.ru_stime + workers.ru_utime + workers.ru_stime
    status = dict(line.split(":", 1) for line in open("/proc/self/status"))
    peak_kb = int(status["VmHWM"].split()[0])  # ru_maxrss counts the process that started this one
    print(f"COST {cpu:.1f} {peak_kb / 1024:.0f} {workers.ru_maxrss / 1024:.0f}")
"""


@dataclass
class Study:
    """The images, the cameras, what the phases have found so far, and the lines of the report."""

    folder: Path
    cameras: tuple[Camera, Camera]
    images: dict[str, list[Image]]
    backgrounds: dict[str, Background] = field(default_factory=dict)
    medians: dict[str, Image] = field(default_factory=dict)
    tables: Tables = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def frames(self) -> int:
        return len(self.images[self.cameras[0].name])

    def say(self, line: str) -> None:
        self.lines.append(line)
        print(line, flush=True)

    def row(self, phase: str, unit: str, ours_s: float, peer: str, peer_s: float) -> None:
        per, scale = ("s", 1.0) if ours_s > 1 else ("ms", 1e3)
        self.say(
            f"| {phase} | {unit} | {scale * ours_s:.2f} {per} | {peer} "
            f"| {scale * peer_s:.2f} {per} | {ours_s / peer_s:.1f} |"
        )


def cpu_s(call: Callable[[], Any], repeats: int = 1) -> tuple[float, Any]:
    """Least processor time of a call, and its result."""
    taken, result = [], None
    for _ in range(repeats):
        begun = time.process_time()
        result = call()
        taken.append(time.process_time() - begun)
    return min(taken), result


def study(folder: Path, images: int) -> Study:
    config = run_preset(PRESET, frames=images)
    cameras = tuple(true_cameras(config.calibration).values())
    if not (folder / "calibration").is_dir():
        telerig.simulate(config, rng=np.random.default_rng(SEED), out=folder)
        calibration_from_cameras(list(cameras), name="truth").save(folder / "calibration")
    run = telerig.load_run(folder / "runs" / PRESET)
    every = {c.name: [run.image(c.name, f) for f in range(run.frame_count)] for c in cameras}
    return Study(folder, (cameras[0], cameras[1]), every)


def background(found: Study) -> None:
    """Level of the screen of one camera, the lab's layer included."""
    run = telerig.load_run(found.folder / "runs" / PRESET)
    ours = peer = 0.0
    for camera in found.cameras:
        images, name = found.images[camera.name], camera.name
        shift = lab_shift_px(camera, AXIS, run.position_mm, len(images))
        spent, level = cpu_s(
            lambda i=images, s=shift: estimate_background(i.__getitem__, len(i), shift_px=s)
        )
        ours, found.backgrounds[name] = ours + spent, level
        some = np.stack(images[:: max(1, len(images) // 21)])
        spent, median = cpu_s(lambda s=some: np.quantile(s, 0.8, axis=0).astype(np.uint8))
        peer, found.medians[name] = peer + spent, median
    found.row("background", "a camera", ours / 2, "quantile of 21 frames", peer / 2)


def plain_centres(image: Image, level: Image) -> Array:
    """(N, 2) centres from a threshold, contours and moments."""
    depth = cv2.subtract(level, image)
    _, mask = cv2.threshold(depth, DEPTH * float(np.median(level)), 255, cv2.THRESH_BINARY)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    centres = []
    for outline in outlines:
        m = cv2.moments(outline)
        if m["m00"] >= LEAST_AREA_PX2:
            centres.append((m["m10"] / m["m00"], m["m01"] / m["m00"]))
    return np.array(centres).reshape(-1, 2)


def detection(found: Study) -> None:
    """Bubbles in one image."""
    levels = {n: [b.of_frame(f) for f in range(found.frames)] for n, b in found.backgrounds.items()}

    def ours() -> Tables:
        return {
            name: [detect_bubbles(i, background=b) for i, b in zip(images, levels[name])]
            for name, images in found.images.items()
        }

    def peer() -> list[Array]:
        return [
            plain_centres(image, found.medians[name])
            for name, images in found.images.items()
            for image in images
        ]

    many = 2 * found.frames
    load_compiled_loops()
    keep_freed_memory()  # as the processes of `telerig track` do
    spent, found.tables = cpu_s(ours, 2)
    plain, centres = cpu_s(peer, 2)
    found.row("detection", "an image", spent / many, "threshold and contours", plain / many)
    bubbles = sum(len(t) for tables in found.tables.values() for t in tables) / many
    plain_many = sum(map(len, centres)) / many
    found.notes.append(f"Bubbles an image: {bubbles:.1f}; {plain_many:.1f} by the threshold.")


def linking(found: Study) -> None:
    """Pairs, tracks and points in space of one frame."""
    run = telerig.load_run(found.folder / "runs" / PRESET)
    pairs = list(
        zip(
            *(
                [t.assign(frame=f, camera=c.name) for f, t in enumerate(found.tables[c.name])]
                for c in found.cameras
            )
        )
    )
    calibration = calibration_from_cameras(list(found.cameras), name="truth")
    model_s, model = cpu_s(lambda: learn_rig(pairs, found.cameras), 2)
    parts = []

    def ours() -> None:
        tracker = Tracker(AXIS, TrackerSettings())
        maker = RowMaker(model, tracker, Shapes(), AXIS)
        parts.clear()
        for f, (tables, sight) in enumerate(zip(pairs, maker.sights(pairs))):
            parts.append(maker.add(f, float(run.t_s[f]), float(run.position_mm[f]), tables, sight))
        parts.append(maker.finish())

    def drift() -> None:
        collector = PairCollector(calibration)
        for part in parts:
            if part is not None:
                collector.add(part.tracks)
        collector.found()

    spent, _ = cpu_s(ours, 2)
    kalman, _ = cpu_s(lambda: kalman_links(found, run, pairs), 2)
    plain, _ = cpu_s(lambda: nearest_links(found), 2)
    frames = found.frames
    found.row("linking", "a frame", spent / frames, "filterpy and SciPy", kalman / frames)
    found.row("linking", "a frame", spent / frames, "nearest neighbour", plain / frames)
    drift_s, _ = cpu_s(drift)
    found.say(
        f"\nOnce a run: pair model {model_s:.2f} s, movement of the cameras {drift_s:.2f} s.\n"
    )


def kalman_links(found: Study, run: Any, pairs: list[Any]) -> None:
    from filterpy.kalman import KalmanFilter
    from scipy.optimize import linear_sum_assignment

    step = transition(TrackerSettings(), (0.0, -1.0, 0.0), float(run.t_s[1] - run.t_s[0]), False)
    noise, filters = step.noise + step.common_noise, []
    for first, second in pairs:
        uv = [t[["u_px", "v_px"]].to_numpy() for t in (first, second)]
        spread = [
            t[["suu_px2", "suv_px2", "suv_px2", "svv_px2"]].to_numpy().reshape(-1, 2, 2)
            for t in (first, second)
        ]
        height = [c.unproject(p)[0][:, 1] for c, p in zip(found.cameras, uv)]
        apart = np.abs(height[0][:, None] - height[1])
        rows, columns = linear_sum_assignment(np.minimum(apart, 0.2))
        near = apart[rows, columns] < 0.2
        rows, columns = rows[near], columns[near]
        points = triangulate(
            found.cameras, (uv[0][rows], uv[1][columns]), (spread[0][rows], spread[1][columns])
        )
        for kalman in filters:
            kalman.predict(F=step.matrix, Q=noise)
        taken = set()
        if filters:
            expected = np.array([k.x[:3] for k in filters])
            away = np.linalg.norm(points.points_mm[None] - expected[:, None], axis=2)
            for i, j in zip(*linear_sum_assignment(np.minimum(away, FURTHEST_MM))):
                if away[i, j] < FURTHEST_MM:
                    filters[i].update(points.points_mm[j], R=points.covariance_mm2[j])
                    taken.add(int(j))
        for j in set(range(len(rows))) - taken:
            kalman = KalmanFilter(dim_x=12, dim_z=3)
            kalman.x, kalman.P = np.zeros(12), 1e4 * np.eye(12)
            kalman.x[:3], kalman.H = points.points_mm[j], np.eye(3, 12)
            filters.append(kalman)
        filters = filters[-30:]


def nearest_links(found: Study) -> None:
    for tables in found.tables.values():
        before = None
        for table in tables:
            here = table[["u_px", "v_px"]].to_numpy()
            if before is not None and len(here) and len(before):
                np.linalg.norm(here[:, None] - before, axis=2).argmin(1)
            before = here


PHASES: tuple[Callable[[Study], None], ...] = (background, detection, linking)


def whole(found: Study, frames: int) -> None:
    """`telerig track` on so many frames, as a process of its own."""
    with tempfile.TemporaryDirectory() as name:
        run = long_run(found, Path(name), frames)
        begun = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", COMMAND, "track", run, "--no-report", "--calibration",
             found.folder / "calibration" / "calibration.json"],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        wall = time.perf_counter() - begun
        cost = [line for line in done.stdout.splitlines() if line.startswith("COST")]
        if done.returncode or not cost:
            sys.exit(done.stdout + done.stderr)
        cpu, own, worker = cost[0].split()[1:]
        found.say(f"| {frames:,} | {cpu} | {wall:.0f} | {own} | {worker} |")


def long_run(found: Study, folder: Path, frames: int) -> Path:
    """A run of links to the images, forwards and backwards in turn."""
    run = folder / "runs" / "long"
    run.mkdir(parents=True)
    (folder / "rig.toml").symlink_to(found.folder / "rig.toml")
    for camera in found.cameras:
        images = sorted((found.folder / "runs" / PRESET / camera.name).iterdir())
        (run / camera.name).mkdir()
        for k, image in enumerate(_to_and_fro(images, frames)):
            (run / camera.name / f"{k:06d}{image.suffix}").symlink_to(image)
    (run / "run.toml").write_text("frame_rate_hz = 500.0\nstart_s = 0.0\n", encoding="utf-8")
    return run


def _to_and_fro(images: list[Path], frames: int) -> Iterator[Path]:
    turn = [*images, *images[-2:0:-1]]
    return (turn[k % len(turn)] for k in range(frames))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of the images [a temporary one]")
    parser.add_argument("--images", type=int, default=60)
    parser.add_argument("--frames", type=int, nargs="*", default=[], help="of whole runs to track")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as name:
        found = study(asked.data or Path(name) / "data", asked.images)
        found.say("| phase | of | telerig | peer | peer's | ratio |\n|---|---|---|---|---|---|")
        for phase in PHASES:
            phase(found)
        found.say("\n" + "\n".join(found.notes) + "\n")
        if asked.frames:
            found.say("| frames | CPU s | wall s | memory MB | largest worker MB |")
            found.say("|---|---|---|---|---|")
        for frames in asked.frames:
            whole(found, frames)
    if asked.out:
        asked.out.write_text("# A whole run\n\n" + "\n".join(found.lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
