"""Calibrations of six kinds from tables, and of three from images.

The 3-D error is that of 125 points in a cube of 30 mm, triangulated from their true pixels, after
the rigid motion that fits best, over the Cramer-Rao bound of an independent bundle adjustment
(`reference_calibration`) of the true lens model. NEES: of the angle of the axes, and of scale or
kappa of each camera. The stated sd is the calibration's share of a triangulated point.
"""

from __future__ import annotations

import json
import tempfile
import tomllib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import ordinary_lenses
import pandas as pd
from numpy.typing import NDArray

import telerig
from guard_parts import reference_calibration as reference
from guard_parts.inputs import digest
from guard_parts.metrics import Metric, count, error, nees, stated_sd, word
from guard_parts.product import SimulationConfig, preset

Array = NDArray[np.float64]

SEEDS = 5


def simulated(config: SimulationConfig, seed: int, folder: Path, images: bool) -> Any:
    return telerig.simulate(
        config, rng=np.random.default_rng([seed, 35]), out=folder / "set", images=images
    )


def known(data: Any) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Content of truth.json and of rig.toml."""
    truth = json.loads((data.path / "truth" / "truth.json").read_text(encoding="utf-8"))
    return truth, tomllib.loads((data.path / "rig.toml").read_text(encoding="utf-8"))


def dots_of(path: Path) -> pd.DataFrame:
    return pd.read_csv(path, dtype={"view": str, "camera": str})


def in_space(calibration: Any, truth: Mapping[str, Any]) -> tuple[float, Array]:
    """RMS error in µm per axis, and the calibration's share of the points' sds (N, 3) in mm."""
    state = reference.truth_of(truth, pd.DataFrame({"view": [], "dot": []}))
    rho = np.array([c["rho_mm"] for c in truth["cameras"].values()])
    points = reference.cube()
    pixels = dict(zip(truth["cameras"], reference.seen_points(state, rho, points)))
    found = calibration.triangulate(pixels, sigma_px=0.01)
    off = reference.aligned(found.points_mm, points) - points
    share = found.covariance_mm2 - found.measurement_covariance_mm2
    sd = np.sqrt(np.diagonal(share, axis1=1, axis2=2))
    return 1e3 * float(np.sqrt((off**2).mean())), sd


def squares(calibration: Any, truth: Mapping[str, Any]) -> list[float]:
    """Squared errors over stated variances of what no gauge touches."""
    out = []
    for name, camera in truth["cameras"].items():
        kappa = camera["parameters"]["kappa_per_mm"]
        which = "kappa_per_mm" if kappa else "scale_px_per_mm"
        sd = calibration.sd(f"{name}.{which}")
        off = calibration.camera(name)[which] - camera["parameters"][which]
        out += [(off / sd) ** 2] if sd > 0 else []
    first, *others = (np.array(c["camera_from_rig"]["rotation"]) for c in truth["cameras"].values())
    angle = np.degrees(np.arccos(first[2] @ others[0][2]))
    stated = calibration.statistics
    out.append(((stated["axes_angle_deg"] - angle) / stated["axes_angle_sd_deg"]) ** 2)
    return out


def words_of(calibrations: Sequence[Any]) -> list[Metric]:
    verdicts = Counter(str(c.verdict["status"]) for c in calibrations)
    models = Counter(str(c.model["name"]) for c in calibrations)
    return [
        word("verdicts", ", ".join(f"{n} {v}" for v, n in sorted(verdicts.items()))),
        word("models", ", ".join(f"{n} {m}" for m, n in sorted(models.items()))),
    ]


def from_tables(config: SimulationConfig, free: Sequence[str]) -> list[Metric]:
    """free : lens parameters of the bound, those of the true lens."""
    found, rms, bounds, sds, z2, given = [], [], [], [], [], []
    for seed in range(SEEDS):
        with tempfile.TemporaryDirectory() as name:
            data = simulated(config, seed, Path(name), images=False)
            truth, rig = known(data)
            dots = dots_of(data.path / "calibration" / "dots.csv")
            try:
                calibration = telerig.calibrate(data)
            except telerig.TelerigError as failed:
                print(f"{config.name}, seed {seed}: {failed}")
                continue
        given.append(dots[["u_px", "v_px"]])
        found.append(calibration)
        problem = reference.problem_of(truth, rig, dots, free)
        bounds.append(reference.bound_um(problem, reference.truth_of(truth, dots)))
        um, sd = in_space(calibration, truth)
        rms.append(um)
        sds.append(sd)
        z2 += squares(calibration, truth)
    return [
        count("solved", len(found), "higher"),
        error("3-D error over bound", _rms(rms) / _rms(bounds), "1"),
        error("3-D error", _rms(rms), "µm"),
        stated_sd(np.concatenate(sds), "µm", scale=1e3),
        nees(z2),
        *words_of(found),
        word("inputs", digest(*given)),
    ]


def from_images(config: SimulationConfig, seeds: int) -> list[Metric]:
    found, rms, sds, z2, given = [], [], [], [], []
    missing = misnumbered = 0
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as name:
            data = simulated(config, seed, Path(name), images=True)
            truth, _ = known(data)
            exact = dots_of(data.path / "truth" / "dots.csv")
            calibration = telerig.calibrate(data)
        given.append(exact[["u_px", "v_px"]])
        found.append(calibration)
        both = exact[exact["inside"] == 1].merge(
            calibration.dots, on=["view", "camera", "dot"], how="left", suffixes=("_true", "")
        )
        off = np.hypot(both["u_px"] - both["u_px_true"], both["v_px"] - both["v_px_true"])
        missing += int(off.isna().sum())
        misnumbered += int((off > 2).sum())
        um, sd = in_space(calibration, truth)
        rms.append(um)
        sds.append(sd)
        z2 += squares(calibration, truth)
    return [
        count("solved", len(found), "higher"),
        error("3-D error", _rms(rms), "µm"),
        stated_sd(np.concatenate(sds), "µm", scale=1e3),
        nees(z2),
        count("dots missing", missing),
        count("dots misnumbered", misnumbered),
        *words_of(found),
        word("inputs", digest(*given)),
    ]


def ordinary(rigs: int) -> list[Metric]:
    """Ordinary lenses by OpenCV: image centres and the angle of the axes against what is stated."""
    found, z2, angles, given = [], [], [], []
    for seed in range(rigs):
        rng = np.random.default_rng([seed, 35])
        rig = ordinary_lenses.rig_of(rng, distorted=seed % 2 == 0)
        dots = ordinary_lenses.dots_of(rig, rng)
        given.append(dots[["u_px", "v_px"]])
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "calibration").mkdir()
            (folder / "rig.toml").write_text(_ordinary_toml(rig.angle_deg), encoding="utf-8")
            table = dots[["view", "camera", "dot", "u_px", "v_px"]]
            table = table.assign(sigma_px=ordinary_lenses.NOISE_PX)
            table.to_csv(folder / "calibration" / "dots.csv", index=False)
            calibration = telerig.calibrate(telerig.load_dataset(folder))
        found.append(calibration)
        off, sd = ordinary_lenses.errors(rig, calibration)
        z2 += [(e / s) ** 2 for e, s in zip(off, sd) if s > 0]
        angles.append(float(off[-1]))
    return [
        count("solved", len(found), "higher"),
        error("angle error", _rms(angles), "deg"),
        nees(z2),
        *words_of(found),
        word("inputs", digest(*given)),
    ]


def _ordinary_toml(angle_deg: float) -> str:
    target, width, height = ordinary_lenses.TARGET, *map(int, ordinary_lenses.SIZE)
    camera = f"""image_size_px = [{width}, {height}]
scale_px_per_mm = {width / ordinary_lenses.FIELD_MM}
"""
    return f"""schema = 1
name = "ordinary lenses"
[cameras.left]
{camera}[cameras.right]
{camera}[stereo]
right_from_left_rotvec_deg = [0.0, {angle_deg + 3.0}, 0.0]
[target]
rows = {target.rows}
columns = {target.columns}
pitch_mm = {target.pitch_mm[0]}
dot_diameter_mm = {target.dot_diameter_mm}
marks = {[list(mark) for mark in target.marks]}
mark_diameter_mm = {1.5 * target.dot_diameter_mm}
print_sigma_mm = {ordinary_lenses.PRINT_MM}
flatness_sigma_mm = {ordinary_lenses.PRINT_MM}
"""


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _lenses(left: dict[str, float], right: dict[str, float]) -> SimulationConfig:
    base = preset("paper")
    first, second = base.cameras
    both = (replace(first, parameters=left), replace(second, parameters=right))
    return replace(base, cameras=both)


def _printed(sigma_mm: float) -> SimulationConfig:
    base = preset("paper")
    target = replace(base.target, print_sigma_mm=sigma_mm, flatness_sigma_mm=sigma_mm)
    return replace(base, target=target)


DISTORTED = _lenses({"k1": 8e-3, "p1": 1e-3, "p2": -6e-4}, {"k1": -6e-3, "p1": -8e-4, "p2": 5e-4})
SCALE, RADIAL = ("scale_px_per_mm",), ("scale_px_per_mm", "k1")

TASKS: dict[str, Callable[[], list[Metric]]] = {
    "paper, tables": partial(from_tables, preset("paper"), RADIAL),
    "symmetric, tables": partial(from_tables, preset("symmetric"), RADIAL),
    "kappa, tables": partial(from_tables, preset("near_telecentric"), (*RADIAL, "kappa_per_mm")),
    "distorted, tables": partial(from_tables, DISTORTED, (*RADIAL, "p1", "p2")),
    "three cameras, tables": partial(from_tables, preset("three"), SCALE),
    "printed to 0.1 mm, tables": partial(from_tables, _printed(0.1), RADIAL),
    "ordinary lenses, tables": partial(ordinary, 4),
    "paper, images": partial(from_images, preset("paper"), 3),
    "symmetric, images": partial(from_images, preset("symmetric"), 1),
    "unbounded, images": partial(from_images, preset("unbounded"), 1),
}
