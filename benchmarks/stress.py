"""Rigs and data that are out of the ordinary: 3-D error against its Cramer-Rao bound, and NEES.

Usage: python benchmarks/stress.py [--seeds 20] [--auto 10] [--images 3] [--only NAME] [--out FILE]

Twenty datasets of every case, each with its own target, hand-held poses and noise, from tables of
dots; the lens model is given, and is one that can describe the lens. Errors in µm: 125 points in a
cube of 30 mm, triangulated from their true pixels, RMS per axis after the rotation and shift that
fit best. The bound is that of the true rig and of the sound dots. Most of it is the known distance
on the target, one number per dataset, so that the ratio of 20 datasets scatters by up to 16 %
(standard deviation); "without size" sets the common factor aside. NEES: the error of the points
against the calibration's covariance, per direction in which its sd is more than a hundredth of the
largest (1 expected). "shown" is how many of the target's dots an image shows; "wrong / missed":
sound dots left out, and gross ones kept. Rows with model auto have fewer datasets (--auto).
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from calibration_scene import Scene, make_scene
from numpy.typing import NDArray
from rig_truth import aligned, bound_covariance, volume, without_advice
from truth import true_cameras

import telerig
from telerig.errors import TelerigError
from telerig.estimator.calibration.quality.comparison import difference_from_truth
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.io.simulation.config import SimulationConfig
from telerig.io.simulation.presets import preset
from telerig.rig.camera import Camera
from telerig.rig.triangulation import aligned_shift, triangulate

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

RANK = 1e-2
SHARE, LEAST_PX, MOST_PX = 0.05, 5.0, 50.0
MISNUMBERED = 0.2
"""Of the gross outliers."""


@dataclass(frozen=True)
class Case:
    """name, simulation, the model that can describe it; outliers : share of gross ones."""

    name: str
    config: SimulationConfig
    model: str
    outliers: float = 0.0


def cases() -> list[Case]:
    object_side = _lenses(
        {"k1": 2e-3, "tilt_x": 0.12, "tilt_y": -0.02, "image_convergence_per_mm": 1 / 650},
        {"k1": -1.5e-3, "tilt_x": -0.1, "tilt_y": 0.03, "image_convergence_per_mm": 1 / 500},
    )
    bilateral = _lenses(
        {"k1": 2e-3, "tilt_x": 0.12, "tilt_y": -0.02}, {"k1": -1.5e-3, "tilt_x": -0.1}
    )
    stretched = _lenses(
        {"k1": 2e-3, "aspect": 1.01, "skew": 0.004}, {"k1": -1.5e-3, "aspect": 0.995, "skew": -3e-3}
    )
    out = [
        Case("Scheimpflug, object side", object_side, "tilt+radial"),
        Case("Scheimpflug, bilateral", bilateral, "tilt+radial"),
        Case("preset scheimpflug, one of each", preset("scheimpflug"), "tilt+radial"),
        Case("aspect and skew", stretched, "affine+radial"),
    ]
    out += [
        Case(f"{angle} degrees", preset("paper", angle_deg=float(angle)), "tangential")
        for angle in (20, 40, 60, 90, 110)
    ]
    out += [
        Case(f"{a} degrees, two-sided", preset("two_sided", angle_deg=float(a)), "tangential")
        for a in (130, 160)
    ]
    return [
        *out,
        Case("30-100 % of 40 x 40 dots", partly_seen(), "affine+tangential"),
        Case("5 % gross outliers", preset("paper"), "tangential", SHARE),
        Case("the same at 0.05 px", preset("paper", sigma_px=0.05), "tangential", SHARE),
    ]


def _lenses(left: dict[str, float], right: dict[str, float]) -> SimulationConfig:
    base = preset("paper")
    first, second = base.cameras
    return replace(
        base, cameras=(replace(first, parameters=left), replace(second, parameters=right))
    )


def partly_seen(marks: bool = False) -> SimulationConfig:
    """A plate as large as the field, held up to 60 % of it off: each image shows another part."""
    base = preset("dense")
    target = replace(
        base.target, rows=40, columns=40, pitch_mm=(1.1, 1.1), dot_diameter_mm=0.55,
        mark_diameter_mm=0.8, marks=((19, 19), (19, 21), (21, 19)), scale_dots=(610, 989),
    )  # fmt: skip
    return replace(
        base, name="partly seen", target=target, visible_fraction=0.3, marks_visible=marks,
        shift_mm=(22.0, 22.0, 22.0),
    )  # fmt: skip


@dataclass
class Found:
    """One row a dataset; µm."""

    rms_um: list[float] = field(default_factory=list)
    shape_um: list[float] = field(default_factory=list)
    bound_um: list[float] = field(default_factory=list)
    shape_bound_um: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    shown: list[float] = field(default_factory=list)
    models: list[str] = field(default_factory=list)
    wrong: int = 0
    missed: int = 0
    failed: list[str] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


def run(case: Case, number: int, seeds: int, model: str) -> Found:
    found = Found()
    for seed in range(seeds):
        rng = np.random.default_rng([number, seed])
        scene = make_scene(case.config, rng)
        dots, sound = spoiled(scene.dots, case.outliers, rng)
        began = time.process_time()
        try:
            with without_advice():
                calibration = self_calibrate(
                    dots, scene.nominal, scene.target, model=model,
                    nominal_rotvec_deg=scene.nominal_rotvec_deg,
                )  # fmt: skip
        except TelerigError as error:
            found.failed.append(f"seed {seed}: {error}")
            continue
        found.seconds.append(time.process_time() - began)
        found.models.append(calibration.model["name"])
        _count_outliers(found, calibration, dots, sound)
        count = scene.dots.groupby(["view", "camera"])["dot"].count() / len(scene.true_target.ids)
        found.shown += count.tolist()
        _judge(found, calibration, scene, case, sound)
    return found


def spoiled(
    dots: pd.DataFrame, share: float, rng: np.random.Generator
) -> tuple[pd.DataFrame, Bools]:
    """The table with gross outliers, and which rows are sound (of the given table).

    Most are moved by 5 to 50 px in a random direction; the others have the number of another such
    dot of the same image, and that one theirs.
    """
    count = len(dots)
    gross = rng.random(count) < share
    swapped = gross & (rng.random(count) < MISNUMBERED)
    out = dots.copy()
    number = out["dot"].to_numpy().copy()
    for i in np.flatnonzero(swapped):
        image = (dots["view"] == dots["view"].iloc[i]) & (dots["camera"] == dots["camera"].iloc[i])
        others = np.flatnonzero(image.to_numpy() & ~gross)
        if len(others):
            other = int(rng.choice(others))
            number[[i, other]] = number[[other, i]]
            gross[other] = True
    moved = gross & (number == dots["dot"].to_numpy())
    angle, far = rng.uniform(0, 2 * np.pi, count), rng.uniform(LEAST_PX, MOST_PX, count)
    jump = moved[:, None] * far[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    out[["u_px", "v_px"]] = out[["u_px", "v_px"]].to_numpy() + jump
    out["dot"] = number
    return out, ~gross


def _count_outliers(
    found: Found, calibration: Calibration, dots: pd.DataFrame, sound: Bools
) -> None:
    keys = ["view", "camera", "dot"]
    final = calibration.residuals[[*keys, "weight"]]
    weight = dots[keys].merge(final, on=keys, how="left")["weight"].to_numpy()
    found.wrong += int(((weight < 0.5) & sound).sum())
    found.missed += int(((weight >= 0.5) & ~sound).sum())


def _judge(found: Found, calibration: Calibration, scene: Scene, case: Case, sound: Bools) -> None:
    truth = list(scene.cameras.values())
    points = volume()
    size = (points - points.mean(0)).ravel() / np.linalg.norm(points - points.mean(0))
    error = space_errors(calibration, truth)
    found.rms_um.append(_rms(error))
    found.shape_um.append(_rms(error - size * (size @ error)))
    bound = bound_covariance(scene, case.config, case.model, sound)
    share, of_size = float(np.trace(bound)), float(size @ bound @ size)
    found.bound_um.append(1e3 * float(np.sqrt(share / points.size)))
    found.shape_bound_um.append(1e3 * float(np.sqrt((share - of_size) / points.size)))
    found.nees.append(normalised(calibration, error))


def space_errors(calibration: Calibration, truth: list[Camera]) -> Array:
    """(375,) mm."""
    points = volume()
    pixels = [c.project(points) for c in truth]
    pair = (calibration.cameras[0], calibration.cameras[1])
    found = triangulate(pair, (pixels[0], pixels[1]), 1.0).points_mm
    return np.asarray(aligned(found, points) - points).ravel()


def normalised(calibration: Calibration, error: Array) -> float:
    """Error squared over the covariance, per direction that the covariance spans."""
    pair = (calibration.cameras[0], calibration.cameras[1])
    values, vectors = np.linalg.eigh(calibration.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0))
    root = aligned_shift(pair, calibration.free, volume()) @ root
    directions, sizes, _ = np.linalg.svd(root, full_matrices=False)
    seen = sizes > RANK * sizes.max()
    along = directions[:, seen].T @ error / sizes[seen]
    return float(along @ along / seen.sum())


def _rms(values: Any) -> float:
    return float(1e3 * np.sqrt(np.mean(np.square(values))))


HEAD = [
    "| case | model | median, µm | RMS | bound | **RMS / bound** | without size | worst / bound | "
    "NEES | shown | wrong / missed | s |",
    "|---|---|---|---|---|---|---|---|---|---|---|---|",
]


def row(case: Case, model: str, found: Found) -> str:
    if not found.rms_um:
        return f"| {case.name} | {model} | all {len(found.failed)} failed |" + " |" * 9
    rms, bound = np.array(found.rms_um), np.array(found.bound_um)
    shape, shape_bound = np.array(found.shape_um), np.array(found.shape_bound_um)
    ratio = np.sqrt((rms**2).mean() / (bound**2).mean())
    failed = f", {len(found.failed)} failed" if found.failed else ""
    names = ", ".join(f"{n} {c}" for n, c in pd.Series(found.models).value_counts().items())
    return (
        f"| {case.name}{failed} | {model}{f' ({names})' if model == 'auto' else ''} | "
        f"{np.median(rms):.3f} | {np.sqrt((rms**2).mean()):.3f} | {np.sqrt((bound**2).mean()):.3f} "
        f"| **{ratio:.2f}** | {np.sqrt((shape**2).mean() / (shape_bound**2).mean()):.2f} | "
        f"{(rms / bound).max():.2f} (seed {int((rms / bound).argmax())}) | "
        f"{np.mean(found.nees):.2f} +- {np.std(found.nees) / np.sqrt(len(rms)):.2f} | "
        f"{min(found.shown):.0%}-{max(found.shown):.0%} | {found.wrong} / {found.missed} | "
        f"{np.median(found.seconds):.2f} |"
    )


def from_images(name: str, config: SimulationConfig, model: str, seed: int) -> str:
    """A line: rendered images, found, numbered and calibrated, against the truth."""
    folder = Path(tempfile.mkdtemp())
    try:
        data = telerig.simulate(config, rng=np.random.default_rng(seed), out=folder / "set")
        began = time.perf_counter()
        try:
            calibration = telerig.calibrate(data, model=model)
        except TelerigError as error:
            return f"| {name} | {seed} | {model} | failed: {error} | | | | |"
        seconds = time.perf_counter() - began
        cameras = true_cameras(data.truth or {})
        space = difference_from_truth(calibration, cameras, volume())
        exact = pd.read_csv(data.path / "truth" / "dots.csv", dtype={"view": str})
        inside = exact[exact["inside"] == 1]
        both = inside.merge(calibration.dots, on=["view", "camera", "dot"], how="left")
        off = np.hypot(both["u_px_y"] - both["u_px_x"], both["v_px_y"] - both["v_px_x"])
        return (
            f"| {name} | {seed} | {model} | {space.rms_um:.3f} | {space.predicted_um:.3f} | "
            f"{normalised(calibration, space.shift_mm.ravel()):.2f} | "
            f"{int(off.notna().sum())} of {len(inside)}, {int((off > 2).sum())} misnumbered | "
            f"{calibration.verdict['status']} | {seconds:.1f} |"
        )
    finally:
        shutil.rmtree(folder)


def images(seeds: int) -> list[str]:
    lines = [
        "| from images | seed | model | RMS, µm | predicted | NEES | dots found | verdict | s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    settings = [
        ("preset scheimpflug", preset("scheimpflug"), "tilt+radial"),
        ("30-100 % of 40 x 40 dots", partly_seen(marks=True), "affine+tangential"),
        ("150 degrees, two-sided", preset("two_sided"), "tangential"),
    ]
    for name, config, model in settings:
        for seed in range(seeds):
            lines.append(from_images(name, config, model, seed))
            print(lines[-1], flush=True)
    return [*lines, ""]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--auto", type=int, default=0, help="seeds of a row with model auto")
    parser.add_argument("--images", type=int, default=0, help="seeds from images")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows, failures = [], []
    for number, case in enumerate(cases()):
        if options.only not in case.name:
            continue
        for model, seeds in ((case.model, options.seeds), ("auto", options.auto)):
            if seeds == 0:
                continue
            found = run(case, number, seeds, model)
            rows.append(row(case, model, found))
            failures += [f"- {case.name}, {model}, {f}" for f in found.failed]
            print(rows[-1], flush=True)
    words = (__doc__ or "").strip().splitlines()[4:]
    lines = ["# Stress", "", *words, "", *HEAD, *rows, "", *failures, ""]
    if options.images:
        lines += images(options.images)
    if options.out:
        options.out.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
