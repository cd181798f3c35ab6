"""A camera that moves by 20 µm and 50 µrad after the calibration: what a run tells of it.

Usage: python benchmarks/drift.py [--seeds 24] [--graph 20] [--seed 0] [--out FILE.md]
Runs of the simulator as tables: pixels of the projected centres with noise, cameras that shake, a
calibration that is sure of its pose to 20 µrad and 0.5 µm and wrong by a draw from that. The
movement is 20 µm along the common perpendicular, and a rotation by 50 µrad about a random axis
across it. Every seed counts. `--graph`: seeds that are smoothed with and without --refine-rig, the
modes of the shake given.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.random import Generator
from numpy.typing import NDArray

import telerig
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.rig_drift.estimate import rig_change
from telerig.estimator.rig_drift.movement import (
    DriftPrior,
    covariance_root,
    drift_covariance,
    moved_pose,
)
from telerig.estimator.rig_drift.ray_misses import offset_roll_pitch
from telerig.estimator.smoothing.problem.problem import CARRIAGE, RigMode, ShakeModel
from telerig.factors.bubble_motion import BubbleModel, Zigzag
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.config import RunConfig
from telerig.io.simulation.presets import run_preset
from telerig.io.simulation.run.scene import RunScene, run_scene
from telerig.io.simulation.run.sensors import stage_table
from telerig.rig.camera import Camera
from telerig.rig.triangulation import triangulate

Array = NDArray[np.float64]
Pair = tuple[Camera, Camera]

OFFSET_MM, TURN_RAD = 0.02, 5e-5
CALIBRATION_SD = np.repeat([2e-5, 5e-4], 3)
NAMES = tuple(f"right.{p}" for p in ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm"))


@dataclass(frozen=True)
class Case:
    """wander_mm : RMS of the bubbles' centres in each image, Ornstein-Uhlenbeck over 0.1 s."""

    words: str
    config: RunConfig
    noise_px: float = 0.1
    wander_mm: float = 0.0


@dataclass(frozen=True)
class Drawn:
    scene: RunScene
    tracks: pd.DataFrame
    calibration: Calibration
    tangent: Array


def cases() -> dict[str, Case]:
    rise = run_preset("rise", frames=500)
    still = replace(rise, stage=replace(rise.stage, shake_mm=0.0))
    wide = replace(
        still, motion=replace(still.motion, path="helix", lateral_mm=(15, 15), lateral_hz=(1, 1))
    )
    return {
        "rise": Case("one bubble, 500 frames, cameras shake by 0.1 mm against each other", rise),
        "still": Case("the same, cameras at rest", still),
        "wander": Case("the same, centres wander by 0.2 px", still, wander_mm=0.02),
        "wide": Case("one bubble on a helix 30 mm wide, at rest, 0.03 px", wide, 0.03),
        "swarm": Case("20 bubbles, 100 frames, 20 px/mm, shake 0.02 mm", run_preset("swarm")),
    }


def drawn(case: Case, moves: bool, rng: Generator) -> Drawn:
    config = case.config
    first, second = true_cameras(config.calibration).values()
    cameras = (first, second)
    scene = run_scene(config, {c.name: c for c in cameras}, rng)
    angle = rng.uniform(0, 2 * np.pi)
    values = np.array([OFFSET_MM, TURN_RAD * np.cos(angle), TURN_RAD * np.sin(angle)])
    tangent = np.linalg.pinv(offset_roll_pitch(cameras, np.zeros(3))) @ values * moves
    wrong = CALIBRATION_SD * rng.standard_normal(6)
    pose = moved_pose(second.camera_from_rig.inverse(), wrong + tangent)
    true = (first, replace(second, camera_from_rig=pose.inverse()))
    known = Calibration(
        cameras, np.zeros(0, np.int64), np.zeros((0, 3)), {}, np.diag(CALIBRATION_SD**2), NAMES,
        ((), ()),
    )  # fmt: skip
    return Drawn(scene, tracks_of(case, scene, cameras, true, rng), known, tangent)


def tracks_of(
    case: Case, scene: RunScene, cameras: Pair, true: Pair, rng: Generator
) -> pd.DataFrame:
    """Bubbles well inside both images, as tracks.csv has them."""
    frames = range(case.config.frames)
    pixels = []
    for j, camera in enumerate(true):
        shift = np.array([scene.rig_from_lab_mm(j, f) for f in frames])
        seen = camera.project((scene.lab_mm.swapaxes(0, 1) + shift[:, None]).reshape(-1, 3))
        seen = seen.reshape(len(frames), -1, 2)
        seen += case.wander_mm * camera["scale_px_per_mm"] * wander(seen.shape, scene.t_s, rng)
        pixels.append(seen + case.noise_px * rng.standard_normal(seen.shape))
    size = np.array(cameras[0].image_size_px)
    inside = np.all([((uv > 20) & (uv < size - 20)).all(-1) for uv in pixels], 0)
    inside &= inside.sum(0) >= 10
    frame, particle = np.nonzero(inside)
    first, second = (uv[inside] for uv in pixels)
    found = triangulate(cameras, (first, second), case.noise_px)
    table = pd.DataFrame({"frame": frame, "particle": particle, "t_s": scene.t_s[frame]})
    table[["x_mm", "y_mm", "z_mm"]] = found.points_mm
    table["ray_miss_mm"] = found.ray_miss_mm
    for camera, uv in zip(cameras, (first, second)):
        table[[f"{camera.name}_u_px", f"{camera.name}_v_px"]] = uv
        for name, value in (("suu", 1.0), ("suv", 0.0), ("svv", 1.0)):
            table[f"{camera.name}_{name}_px2"] = value * case.noise_px**2
    return table


def wander(shape: tuple[int, ...], t_s: Array, rng: Generator) -> Array:
    keep = float(np.exp(-(t_s[1] - t_s[0]) / 0.1))
    out = rng.standard_normal(shape)
    for i in range(1, len(out)):
        out[i] = keep * out[i - 1] + np.sqrt(1 - keep**2) * out[i]
    return out


@dataclass
class Score:
    """Of one case, a row a seed: errors and sd of offset, roll, pitch; NEES per component."""

    errors: list[Array]
    sigmas: list[Array]
    nees: list[float]
    called: int = 0

    def add(self, run: Drawn, tangent: Array, covariance: Array, place: Array, moved: bool) -> None:
        cameras = (run.calibration.cameras[0], run.calibration.cameras[1])
        rows = offset_roll_pitch(cameras, place)
        self.errors.append(1e6 * rows @ (tangent - run.tangent))
        self.sigmas.append(1e6 * np.sqrt(np.diagonal(rows @ covariance @ rows.T)))
        inverse = np.linalg.pinv(covariance_root(drift_covariance(cameras, DriftPrior())))
        error, spread = inverse @ (tangent - run.tangent), inverse @ covariance @ inverse.T
        self.nees.append(float(error @ np.linalg.solve(spread, error)) / len(error))
        self.called += moved

    def row(self, words: str) -> str:
        rms = np.sqrt(np.mean(np.square(self.errors), 0))
        sd = np.sqrt(np.mean(np.square(self.sigmas), 0))
        far = np.abs(np.array(self.errors) / self.sigmas).max()
        return (
            f"| {words} | {rms[0] / 1000:.2f} ({sd[0] / 1000:.2f}) | {rms[1]:.0f} ({sd[1]:.0f}) | "
            f"{rms[2]:.0f} ({sd[2]:.0f}) | {np.mean(self.nees):.2f} | {far:.1f} | "
            f"{self.called} of {len(self.nees)} |"
        )


def from_gaps(case: Case, moves: bool, seeds: range) -> Score:
    score = Score([], [], [])
    for seed in seeds:
        run = drawn(case, moves, np.random.default_rng(seed))
        found = rig_change(run.tracks, run.calibration)
        assert found is not None
        c = found[0]
        score.add(run, c.tangent, c.covariance, c.place_mm, c.moved)
    return score


def true_model() -> ShakeModel:
    """The shake of `rise` as it is, and bubbles that zigzag."""
    common, own = (float(v) for v in 0.2 / np.sqrt(2) * np.sqrt([0.75, 0.25]))
    modes = [RigMode(12.0, 0.03, (common / 2, common, common / 2), CARRIAGE, 60.0)]
    modes += [RigMode(19.2, 0.03, (own / 2, own, own / 2), j, 60.0) for j in (0, 1)]
    bubble = BubbleModel(zigzags=(Zigzag(6.0, 0.04, (2.0, 0.0, 2.0)),
                                  Zigzag(12.0, 0.04, (0.0, 0.15, 0.0))))  # fmt: skip
    return ShakeModel(bubble=bubble, modes=tuple(modes))


def in_graph(case: Case, model: ShakeModel, seeds: range) -> tuple[Score, Array]:
    """The score, and (seeds, 2) the constant error along y (µm) without and with refinement."""
    score, bias = Score([], [], []), []
    for seed in seeds:
        run = drawn(case, True, np.random.default_rng(seed))
        stage = pd.DataFrame(stage_table(run.scene, np.random.default_rng(seed)))
        both = []
        for wanted in (False, True):
            found = telerig.smooth(
                run.tracks, run.calibration, stage=stage, t_s=run.scene.t_s, model=model,
                refine_rig=wanted,
            )  # fmt: skip
            table = found.trajectories
            true = run.scene.lab_mm[table["particle"], table["frame"]]
            both.append(1000 * float(np.mean(table["y_mm"].to_numpy() - true[:, 1])))
        bias.append(both)
        c = found.summary["rig_change"]
        parts = (np.array(c[name]) for name in ("tangent", "covariance", "place_mm"))
        score.add(run, *parts, c["moved"])
        print("graph", seed, score.errors[-1], score.sigmas[-1], both, flush=True)
    return score, np.array(bias)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", type=int, default=24)
    parser.add_argument("--still-seeds", type=int, default=40)
    parser.add_argument("--graph", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    lines = []

    def seeds(number: int) -> range:
        return range(options.seed, options.seed + number)

    def show(line: str) -> None:
        print(line, flush=True)
        lines.append(line)

    show("| run | offset, µm | roll, µrad | pitch, µrad | NEES | largest, sd | called moved |")
    show("|---|---|---|---|---|---|---|")
    known = cases()
    chosen = options.only or list(known)
    for name in chosen if options.seeds else ():
        case = known[name]
        show(from_gaps(case, True, seeds(options.seeds)).row(f"{name}: {case.words}"))
    for name in chosen if options.still_seeds else ():
        case = known[name]
        show(from_gaps(case, False, seeds(options.still_seeds)).row(f"{name}, nothing moved"))
    biases: dict[str, Array] = {}
    graph: dict[str, Callable[[], ShakeModel]] = {
        "rise": true_model,
        "still": lambda: replace(true_model(), modes=()),
    }
    for name in [n for n in graph if n in chosen and options.graph]:
        score, biases[name] = in_graph(known[name], graph[name](), seeds(options.graph))
        show(score.row(f"{name}, in the graph (--refine-rig)"))
    show("")
    for name, bias in biases.items():
        rms = np.sqrt(np.mean(bias**2, 0))
        show(f"Constant error of y in the trajectories of {name}, µm RMS over seeds: "
             f"{rms[0]:.1f} without, {rms[1]:.1f} with --refine-rig.")  # fmt: skip
    if options.out:
        options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
