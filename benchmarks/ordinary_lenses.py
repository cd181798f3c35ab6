"""Simulated rigs of ordinary lenses: does the automatic model state what it does not know?

python benchmarks/ordinary_lenses.py [--rigs 20] [--study NAME ...] [--first-seed 0]
    [--out benchmarks/results/ordinary_lenses.md]

Two pinhole cameras with focal lengths of 1,000 to 12,000 px, centres off by up to 40 px, every
second rig with radial distortion. OpenCV projects the outlines of the dots, of which the centroid
is measured. The bound of a rig is the standard deviation that its true model states on the same
dots. Studies: "plain"; "parallel": the axes are at 0 to 7 degrees, and the cameras 0.15 of their
distance apart; "wave": the lenses have a smooth error of 0.1 px RMS that no lens model contains (a
sine of 0.5 to 2 periods across the image, another one in u and in v), three times the noise of the
dots, which the bound takes for noise of independent dots; "aspect": f is about 2,200 px, the axes
are at 19 degrees, one lens has pixels that are 0.06 % higher than wide, the other one wider than
high, and there are 21 views.

Beside it stand the image centres of OpenCV's stereo calibration (Zhang's method with the nominal
dots, fx, fy, k1, k2, p1, p2) from the same dots.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import telerig
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import INDEX
from telerig.rig.target import Target

Array = NDArray[np.float64]
LEAST_DOTS, LEAST_VIEWS = 6, 4
"""OpenCV gets only views with so many dots that both cameras see, and rigs with so many views."""
STUDIES = {
    "plain": "Axes at 20 to 70 degrees",
    "parallel": "Nearly parallel axes",
    "wave": "An error of the lens model",
    "aspect": "Pixels that are not square",
}
SIZE = np.array([1280, 1024])
FIELD_MM = 100.0
NOISE_PX = 0.03
PRINT_MM = 0.005
TARGET = Target(
    rows=9, columns=12, pitch_mm=(7.0, 7.0), dot_diameter_mm=3.0, marks=((4, 5), (4, 7), (3, 5)),
    print_sigma_mm=PRINT_MM, flatness_sigma_mm=PRINT_MM,
)  # fmt: skip
_TURN = 2.0 * np.pi / 48 * np.arange(48)
CIRCLE = 0.5 * TARGET.dot_diameter_mm * np.column_stack([np.cos(_TURN), np.sin(_TURN), 0 * _TURN])


def centroids(outlines_px: Array) -> Array:
    """Centroids (N, 2) of polygons (N, K, 2)."""
    after = np.roll(outlines_px, -1, axis=1)
    cross = outlines_px[..., 0] * after[..., 1] - outlines_px[..., 1] * after[..., 0]
    weighted = np.sum((outlines_px + after) * cross[..., None], axis=1)
    return weighted / (3.0 * np.sum(cross, axis=1))[:, None]


@dataclass(frozen=True)
class Rig:
    """Two cameras.

    focal_px, distance_mm : (2,) focal lengths, and distances from the middle of the volume.
    centre_px, radial : (2, 2) image centres, and OpenCV's k1, k2.
    angle_deg : between the axes. base : distance of the cameras as a share of distance_mm.
    aspect : (2,) focal length along v over that along u.
    """

    focal_px: Array
    centre_px: Array
    radial: Array
    angle_deg: float
    distance_mm: Array
    base: float = 0.0
    aspect: tuple[float, float] = (1.0, 1.0)

    @property
    def distorted(self) -> bool:
        return bool(np.any(self.radial))

    @property
    def model(self) -> str:
        affine = "affine+" if self.aspect != (1.0, 1.0) else ""
        return f"kappa+{affine}{'k1+k2+' if self.distorted else ''}centre"

    def matrix(self, camera: int) -> Array:
        focal, (u, v) = self.focal_px[camera], self.centre_px[camera]
        return np.array([[focal, 0, u], [0, focal * self.aspect[camera], v], [0, 0, 1]])


def rig_of(rng: np.random.Generator, distorted: bool, focal_px: float | None = None) -> Rig:
    """A random rig, whose focal lengths are about ``focal_px``."""
    focal = np.full(2, np.exp(rng.uniform(np.log(1000.0), np.log(12000.0))))
    focal = (focal if focal_px is None else np.full(2, focal_px)) * rng.uniform(0.95, 1.05, 2)
    distance = focal * FIELD_MM / SIZE[0]
    centre = (SIZE - 1) / 2 + rng.uniform(-40.0, 40.0, (2, 2))
    # a distortion of up to 10 px at the corner of the image
    corner = np.linalg.norm(SIZE) / 2 / focal
    radial = np.zeros((2, 2))
    if distorted:
        radial[:, 0] = rng.uniform(2.0, 10.0, 2) / focal / corner**3 * rng.choice([-1.0, 1.0], 2)
        radial[:, 1] = rng.uniform(-3.0, 3.0, 2) / focal / corner**5
    return Rig(focal, centre, radial, float(rng.uniform(20.0, 70.0)), distance)


def dots_of(rig: Rig, rng: np.random.Generator, views: int = 12) -> pd.DataFrame:
    ids = TARGET.ids()
    points = TARGET.nominal_mm(ids) + PRINT_MM * rng.standard_normal((len(ids), 3))
    points -= points.mean(axis=0)
    cameras = []
    for c, turn in enumerate((-0.5, 0.5)):
        world = Rotation.from_euler("y", turn * rig.angle_deg, degrees=True).as_matrix()
        away = np.array([-turn * rig.base, 0.0, 1.0]) * rig.distance_mm[c]
        cameras.append((world, away))
    tables = []
    for v in range(views):
        tilt = rng.uniform(10.0, 32.0)
        along = rng.uniform(0.0, 2 * np.pi)
        pose = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(along), np.sin(along), 0]))
        pose = pose * Rotation.from_euler("z", rng.uniform(-180, 180), degrees=True)
        shift = rng.uniform(-1, 1, 3) * np.array([12.0, 10.0, 15.0])
        world = pose.apply(points) + shift
        for c, (turn, away) in enumerate(cameras):
            outlines = world[:, None] + pose.apply(CIRCLE)
            uv, _ = cv2.projectPoints(
                outlines.reshape(-1, 3), cv2.Rodrigues(turn)[0], away, rig.matrix(c),
                np.append(rig.radial[c], [0.0, 0.0]),
            )  # fmt: skip
            uv = centroids(uv.reshape(*outlines.shape[:2], 2))
            uv += NOISE_PX * rng.standard_normal((len(ids), 2))
            inside = np.all((uv > 10) & (uv < SIZE - 11), axis=1)
            tables.append(pd.DataFrame({
                "view": f"{v:02}", "camera": ("left", "right")[c], "dot": ids[inside],
                "u_px": uv[inside, 0], "v_px": uv[inside, 1],
                "suu_px2": NOISE_PX**2, "suv_px2": 0.0, "svv_px2": NOISE_PX**2,
            }))  # fmt: skip
    return pd.concat(tables, ignore_index=True)


def with_wave(dots: pd.DataFrame, wave_px: float, rng: np.random.Generator) -> pd.DataFrame:
    """The dots with a smooth error of the lens model of each camera."""
    place = dots[["u_px", "v_px"]].to_numpy() / SIZE
    for _, rows in dots.groupby("camera").indices.items():
        for column in ("u_px", "v_px"):
            periods = rng.uniform(0.5, 2.0, 2) * rng.choice([-1.0, 1.0], 2)
            phase = 2 * np.pi * place[rows] @ periods + rng.uniform(0, 2 * np.pi)
            at = dots.columns.get_loc(column)
            dots.iloc[rows, at] += wave_px * np.sqrt(2) * np.sin(phase)
    return dots


def calibrated(rig: Rig, dots: pd.DataFrame, model: str) -> telerig.Calibration:
    cameras = [
        Camera.create(name, (int(SIZE[0]), int(SIZE[1])), float(SIZE[0] / FIELD_MM))
        for name in ("left", "right")
    ]
    return self_calibrate(
        dots, cameras, TARGET, model=model,
        nominal_rotvec_deg=[0.0, rig.angle_deg + 3.0, 0.0],
    )  # fmt: skip


def errors(rig: Rig, found: telerig.Calibration) -> tuple[Array, Array]:
    """Errors (5,) of both centres in px and of the angle in degrees, and their stated sds (5,)."""
    error, sd = [], []
    for c, camera in enumerate(found.cameras):
        for k, name in enumerate(("centre_u_px", "centre_v_px")):
            error.append(camera.intrinsics[INDEX[name]] - rig.centre_px[c, k])
            free = name in found.free[c]
            sd.append(found.sd(f"{camera.name}.{name}") if free else 0.0)
    error.append(found.statistics["axes_angle_deg"] - rig.angle_deg)
    sd.append(found.statistics["axes_angle_sd_deg"])
    return np.array(error), np.array(sd)


def opencv_centres(rig: Rig, dots: pd.DataFrame) -> Array:
    """Errors (4,) in px of the image centres of OpenCV's stereo calibration, NaN without one."""
    place = dict(zip(TARGET.ids().tolist(), TARGET.nominal_mm(TARGET.ids())))
    tables = [dots[dots["camera"] == name].set_index(["view", "dot"]) for name in ("left", "right")]
    seen: list[list[Array]] = [[], []]
    points = []
    for view in dots["view"].unique():
        left, right = (table.loc[view] for table in tables)
        both = left.index.intersection(right.index)
        if len(both) < LEAST_DOTS:
            continue
        points.append(np.array([place[dot] for dot in both], np.float32))
        for out, table in zip(seen, (left, right)):
            out.append(table.loc[both, ["u_px", "v_px"]].to_numpy(np.float32))
    if len(points) < LEAST_VIEWS:
        return np.full(4, np.nan)
    size, flags = (int(SIZE[0]), int(SIZE[1])), cv2.CALIB_FIX_K3
    single = [
        cv2.calibrateCamera(points, uv, size, np.eye(3), np.zeros(5), flags=flags) for uv in seen
    ]
    (_, first, k_first, *_), (_, second, k_second, *_) = single
    found = cv2.stereoCalibrate(
        points, *seen, first, k_first, second, k_second, size,
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
    )  # fmt: skip
    centres = np.array([found[1][:2, 2], found[3][:2, 2]])
    return np.asarray(centres - rig.centre_px).ravel()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--study", choices=STUDIES, nargs="*", default=[*STUDIES])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    lines = ["# Ordinary lenses"]
    seeds = range(options.first_seed, options.first_seed + options.rigs)
    for name in options.study:
        lines += ["", f"## {STUDIES[name]}", "", *study(name, seeds)]
    if options.out is not None:
        options.out.write_text("\n".join([*lines, ""]), encoding="utf-8")


def study(name: str, seeds: range) -> list[str]:
    """The table of one study, and a sentence on it."""
    print(f"{STUDIES[name]}")
    lines = [
        "| seed | f px | angle deg | distortion | model | worst error / sd | centre px: error, sd, "
        "bound | OpenCV px | angle deg: error, sd, bound | says so | verdict | s |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    good, said, ratios, furthest = 0, 0, [], []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        rig = rig_of(rng, seed % 2 == 0, 2200.0 if name == "aspect" else None)
        if name == "parallel":
            rig = replace(rig, angle_deg=float(seed % 8), base=0.15)
        if name == "aspect":
            rig = replace(rig, angle_deg=19.0, aspect=(1.0006, 0.9994))
        dots = dots_of(rig, rng, 21 if name == "aspect" else 12)
        dots = with_wave(dots, 0.1 if name == "wave" else 0.0, np.random.default_rng(100 + seed))
        begun = time.process_time()
        found = calibrated(rig, dots, "auto")
        seconds = time.process_time() - begun
        error, sd = errors(rig, found)
        _, bound = errors(rig, calibrated(rig, dots, rig.model))
        z = np.abs(error) / np.maximum(sd, 1e-12)
        good += bool(z.max() < 3.0)
        ratios.append(sd / bound)
        theirs = float(np.abs(opencv_centres(rig, dots)).max())
        furthest.append((float(np.abs(error[:4]).max()), theirs))
        words = "ordinary lens" in "\n".join(found.report().splitlines()[:4])
        said += words
        worst = int(np.argmax(z[:4]))
        distortion, told = ("yes" if yes else "no" for yes in (rig.distorted, words))
        lines.append(
            f"| {seed} | {rig.focal_px[0]:.0f} | {rig.angle_deg:.0f} | {distortion} "
            f"| {found.model['name']} | {min(z.max(), 999):.1f} "
            f"| {error[worst]:.2f}, {sd[worst]:.2f}, {bound[worst]:.2f} "
            f"| {theirs:.2f} | {error[4]:.3f}, {sd[4]:.3f}, {bound[4]:.3f} | {told} "
            f"| {found.verdict['status']} | {seconds:.0f} |"
        )
        print(lines[-1], flush=True)
    lines += [
        "",
        f"{good} of {len(seeds)} rigs: centres and angle within 3 of their standard deviations. "
        f"{said} of {len(seeds)}: said in the first lines. Median standard deviation "
        f"{np.median(ratios):.2f} of the bound of the true model. Largest error of an image "
        f"centre, median and worst rig: {_of_rigs(furthest, 0)} px, OpenCV "
        f"{_of_rigs(furthest, 1)} px.",
    ]  # fmt: skip
    print(lines[-1], flush=True)
    return lines


def _of_rigs(errors: list[tuple[float, float]], which: int) -> str:
    values = np.array(errors)[:, which]
    return f"{np.nanmedian(values):.2f} and {np.nanmax(values):.2f}"


if __name__ == "__main__":
    main()
