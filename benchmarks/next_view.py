"""Does the advice on the next view help? Advised views against as many random ones.

Usage: python benchmarks/next_view.py [--rigs 24] [--draws 6] [--model tangential] [--out FILE.md]

Rigs like the preset `paper`, each with another angle, mounting, lenses, target and noise, start
from the same six hand-held views. Six more are held as advised, one by one, within 3 degrees and
2 mm (standard deviations) of the advice; or six more are drawn at random. "true" is the 3-D RMS
error per axis over the working volume, its common rigid motion removed, over six datasets with
these views (target, known distance and image noise drawn anew); "sd" is what their calibrations
state. The known distance on the target (0.3 µm in 10 mm) limits both, whatever the views: "without
size" sets the common factor aside.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from calibration_scene import Scene, make_scene
from numpy.typing import NDArray
from rig_truth import without_advice

from telerig.estimator.calibration.quality.comparison import difference_from_truth
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.io.simulation.calibration.scene import View, hand_held_views, true_cameras, true_target
from telerig.io.simulation.config import SimulationConfig
from telerig.io.simulation.presets import preset
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.triangulation import aligned_covariance, working_volume

Array = NDArray[np.float64]

START, MORE = 6, 6
HELD_DEG, HELD_MM = 3.0, 2.0
JUDGED = (0, 4, 6)
NUMBERS = ("true_um", "sd_um", "shape_um", "shape_sd_um")
ROWS = (
    ("6 views, to start", "random", 0),
    ("+ 4 random", "random", 4), ("+ 4 advised", "advised", 4),
    ("+ 6 random", "random", 6), ("+ 6 advised", "advised", 6),
)  # fmt: skip


@dataclass
class Path3D:
    """By number of added views: true RMS, the same without size, stated sd, the same (µm).

    reached, promised : sd after a view, and as promised before it.
    """

    true_um: dict[int, float] = field(default_factory=dict)
    shape_um: dict[int, float] = field(default_factory=dict)
    sd_um: dict[int, float] = field(default_factory=dict)
    shape_sd_um: dict[int, float] = field(default_factory=dict)
    advised_sd_um: list[float] = field(default_factory=list)
    promised_um: list[float] = field(default_factory=list)
    enough_after: int | None = None

    def judge(self, config: SimulationConfig, views: list[View], draws: range, model: str) -> None:
        """Calibrate with these views, the target and the noise drawn anew each time."""
        found = []
        for draw in draws:
            scene = make_scene(config, np.random.default_rng([draw, 3]), views=views)
            with without_advice():
                found.append(errors_um(scene, calibrated(scene, model)))
        added = len(views) - START
        numbers = (self.true_um, self.shape_um, self.sd_um, self.shape_sd_um)
        for into, values in zip(numbers, np.transpose(found)):
            into[added] = rms(values.tolist())

    def follow(self, calibration: Calibration) -> None:
        """What is advised next."""
        advice = calibration.diagnostics["next_view"]
        self.advised_sd_um.append(advice["before_um"])
        self.promised_um.append(advice["after_um"])
        if advice["enough"] and self.enough_after is None:
            self.enough_after = advice["views"]


def errors_um(scene: Scene, calibration: Calibration) -> tuple[float, float, float, float]:
    """True RMS, without size, stated sd, without size."""
    cameras = tuple(scene.cameras.values())
    points = working_volume(cameras)
    error = difference_from_truth(calibration, cameras, points).shift_mm.ravel()
    size = (points - points.mean(0)).ravel()
    size /= np.linalg.norm(size)
    shape = error - size * (size @ error)
    pair = (calibration.cameras[0], calibration.cameras[1])
    covariance = aligned_covariance(pair, calibration.free, calibration.covariance, points)
    total = np.trace(covariance)
    parts = np.array([error @ error, shape @ shape, total, total - size @ covariance @ size])
    true, without, sd, shape_sd = 1e3 * np.sqrt(parts / error.size)
    return float(true), float(without), float(sd), float(shape_sd)


def rig(seed: int) -> SimulationConfig:
    """A rig like `paper`."""
    rng = np.random.default_rng([seed, 1])
    base = preset("paper")
    cameras = tuple(
        replace(
            c,
            scale_px_per_mm=10 + 0.1 * rng.standard_normal(),
            centre_offset_px=tuple(4 * rng.standard_normal(2)),
            parameters={"k1": 3e-3 * rng.standard_normal()},
        )
        for c in base.cameras
    )
    mount = tuple(0.6 * rng.standard_normal(3))
    return replace(
        base, cameras=cameras, mount_rotvec_deg=mount, angle_deg=float(rng.uniform(60, 100)),
        sigma_px=float(rng.choice([0.01, 0.03])),
    )  # fmt: skip


def calibrated(scene: Scene, model: str) -> Calibration:
    return self_calibrate(
        scene.dots, scene.nominal, scene.target, nominal_rotvec_deg=scene.nominal_rotvec_deg,
        model=model,
    )  # fmt: skip


def held(calibration: Calibration, name: str, rng: np.random.Generator) -> View:
    """The advised pose, as well as a hand holds it."""
    pose = np.array(calibration.diagnostics["next_view"]["poses"][0]["rig_from_target"])
    turn = rotation_from_rotvec(np.radians(HELD_DEG) * rng.standard_normal(3))
    middle = calibration.target_points_mm.mean(0)
    rotation = turn @ pose[:3, :3]
    place = pose[:3, :3] @ middle + pose[:3, 3] + HELD_MM * rng.standard_normal(3)
    return View(name, Pose(rotation, place - rotation @ middle), ("left", "right"))


def run(seed: int, draws: int, model: str) -> tuple[SimulationConfig, Path3D, Path3D]:
    """(rig, advised, random)."""
    config = rig(seed)
    rng = np.random.default_rng([seed, 2])
    cameras, target = true_cameras(config), true_target(config, np.random.default_rng(seed))
    drawn = hand_held_views(config, cameras, target, rng)
    advised, random = Path3D(), Path3D()
    views, again = drawn[:START], range(1000 * seed, 1000 * seed + draws)
    for count in range(START, START + MORE + 1):
        if count - START in JUDGED[1:]:
            advised.judge(config, views, again, model)
        if count - START in JUDGED:
            random.judge(config, drawn[:count], again, model)
        scene = make_scene(config, np.random.default_rng(seed), views=views)
        found = calibrated(scene, model)
        advised.follow(found)
        views = [*views, held(found, f"view{count:02d}", rng)]
    return config, advised, random


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def summary(paths: list[tuple[SimulationConfig, Path3D, Path3D]]) -> list[str]:
    advised, random = [a for _, a, _ in paths], [r for _, _, r in paths]
    lines = ["| views | true, µm | sd, µm | true without size | sd without size |",
             "|---|---|---|---|---|"]  # fmt: skip
    for label, kind, added in ROWS:
        some = advised if kind == "advised" else random
        columns = [[getattr(p, n)[added] for p in some] for n in NUMBERS]
        lines.append(f"| {label} | " + " | ".join(f"{rms(c):.3f}" for c in columns) + " |")
    lines.append("")
    for added in JUDGED[1:]:
        lines.append(f"- {added} advised views against {added} random ones: " + versus(
            advised, random, added))  # fmt: skip
    ratio = np.concatenate([np.array(a.advised_sd_um[1:]) / a.promised_um[:-1] for a in advised])
    fall = np.concatenate(
        [(np.array(a.advised_sd_um[:-1]) - a.advised_sd_um[1:])
         / (np.array(a.advised_sd_um[:-1]) - a.promised_um[:-1]) for a in advised]
    )  # fmt: skip
    stops = [a.enough_after for a in advised if a.enough_after is not None]
    return [
        *lines,
        f"- sd reached over sd promised, one view ahead: median {np.median(ratio):.3f}, "
        f"5-95 % {np.quantile(ratio, 0.05):.3f} to {np.quantile(ratio, 0.95):.3f}; share of the "
        f"promised fall that came: median {np.median(fall):.2f}.",
        f"- Enough (less than 5 % to gain) was said in {len(stops)} rigs by 12 views, after a "
        f"median of {np.median(stops) if stops else float('nan'):.0f} views.",
        "",
    ]


def versus(advised: list[Path3D], random: list[Path3D], added: int) -> str:
    """Ratios with their standard errors over rigs (of the mean of the logarithm), and who wins."""
    words = []
    for name, label in (("shape_um", "true error"), ("shape_sd_um", "stated sd")):
        ratio = np.array([getattr(a, name)[added] / getattr(r, name)[added]
                          for a, r in zip(advised, random)])  # fmt: skip
        mean = np.exp(np.log(ratio).mean())
        error = mean * np.log(ratio).std() / np.sqrt(len(ratio))
        words.append(
            f"{label} without size {mean:.3f} +- {error:.3f} times as large, smaller in "
            f"{np.count_nonzero(ratio < 1)} of {len(ratio)} rigs"
        )
    return "; ".join(words) + "."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=24)
    parser.add_argument("--draws", type=int, default=6)
    parser.add_argument("--model", default="tangential")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    paths = []
    each = [
        "| rig | angle, deg | noise, px | sd of 6 | 4 random, true | sd | 4 advised, true | sd |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for seed in range(options.rigs):
        config, advised, random = run(seed, options.draws, options.model)
        paths.append((config, advised, random))
        numbers = [random.shape_sd_um[0], random.shape_um[4], random.shape_sd_um[4],
                   advised.shape_um[4], advised.shape_sd_um[4]]  # fmt: skip
        each.append(
            f"| {seed} | {config.angle_deg:.0f} | {config.sigma_px:g} | "
            + " | ".join(f"{n:.3f}" for n in numbers) + " |"
        )  # fmt: skip
        print(each[-1], flush=True)
    words = (__doc__ or "").strip().splitlines()
    text = "\n".join(
        ["# Next best view", "", *words[4:], "", f"Model `{options.model}`, {len(paths)} rigs.", "",
         *summary(paths), "Without size:", "", *each, ""]
    )  # fmt: skip
    print(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
