"""Three cameras from images: at the bound, better than any two of them, covariance true?

Usage: python benchmarks/three_cameras.py [--first 0] [--seeds 20] [--out FILE.md]

The simulator's preset `three` (cameras at 0, 60 and 120 degrees, 15 hand-held views of 15 dots, of
which the cameras see 10, 15 and 10), images of 512 x 512 px. Each seed is detected and calibrated
as `telerig calibrate` does (lens model chosen, cameras free), with all cameras and with each pair.

Error: 125 points in a cube of 30 mm, triangulated from their true pixels in all cameras used; RMS
per axis after the similarity that fits best (the size comes from the target's known distance alone,
whose 1 µm in 31 mm would hide what the cameras do). It is the calibration's share alone.

Bound: Cramer-Rao, from a dense Jacobian by central differences of the simulator's own projection at
the truth: scales, poses of cameras, views, dots (with what print and the known distance say) and
the covariance that each dot's image fit states. What no image tells (the gauge) is left out by the
pseudo-inverse; the similarity of the points is projected out as it is of the error.

NEES: squared errors over their stated covariance, in the directions that it spans (standard
deviations above 1e-3 of the largest), per direction; 1 when the covariance is right. Of the points
(affine cameras bend shapes in 5 directions), and of the points' pixels in the three cameras, the
similarity of the points projected out (all that images tell of the rig). Where the stated error
is far above the bound, lens parameters that the choice left out but could not exclude are counted.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rig_truth import aligned, volume, without_motion

import telerig
from telerig.estimator.calibration.calibrate import detect, nominal_cameras
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.self_calibration import self_calibrate
from telerig.io.simulation.calibration.scene import (
    TrueTarget,
    View,
    hand_held_views,
    true_cameras,
    true_target,
)
from telerig.io.simulation.images.plates import pixel_from_plate
from telerig.io.simulation.presets import preset
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec, rotvec_from_rotation
from telerig.rig.triangulation import (
    aligned_covariance,
    rig_jacobian,
    stacked_jacobian,
    triangulate_any,
)

Array = NDArray[np.float64]

_STEP = 1e-4
_RANK = 1e-3


@dataclass(frozen=True)
class Truth:
    cameras: Mapping[str, Camera]
    target: TrueTarget
    views: Mapping[str, View]


@dataclass(frozen=True)
class Outcome:
    """rms_um : of all cameras, and by pair.  bound_um, stated_um : of all.

    nees : of points and of pixels, each with the number of its directions.
    """

    model: str
    rms_um: float
    pairs_um: dict[str, float]
    bound_um: float
    stated_um: float
    nees: tuple[tuple[float, int], tuple[float, int]]
    seconds: float


def calibrated(dots: pd.DataFrame, rig: Any, names: tuple[str, ...]) -> Calibration:
    """Of some of the cameras; views that one of them sees alone are left out."""
    mine = dots[dots["camera"].isin(names)]
    seen = mine.groupby("view")["camera"].nunique()
    mine = mine[mine["view"].isin(seen.index[seen > 1])]
    cameras = [c for c in nominal_cameras(rig) if c.name in names]
    turns = {n: rotation_from_rotvec(np.radians(r)) for n, r in rig.rotvec_from_first_deg.items()}
    turns[rig.first] = np.eye(3)
    nominal = {n: np.degrees(rotvec_from_rotation(turns[n] @ turns[names[0]].T)) for n in names[1:]}
    return self_calibrate(mine, cameras, rig.target, nominal_rotvec_deg=nominal, model="auto")


def space_error(calibration: Calibration, truth: Truth) -> Array:
    """(N, 3) errors of the volume's points, in the frame of the calibration's first camera."""
    cameras = [truth.cameras[c.name] for c in calibration.cameras]
    points = volume()
    found = triangulate_any(calibration.cameras, [c.project(points) for c in cameras], 1.0)
    error = aligned(found.points_mm, points) - points
    return np.asarray(without_similarity(points) @ error.ravel()).reshape(-1, 3)


def without_similarity(points: Array) -> Array:
    """(3 N, 3 N) projector that removes small rigid motions and changes of size."""
    size = (points - points.mean(0)).ravel()
    size /= np.linalg.norm(size)
    return without_motion(points) @ (np.eye(len(size)) - np.outer(size, size))


def bound_covariance(truth: Truth, dots: pd.DataFrame, settings: Any) -> Array:
    """(3 N, 3 N) Cramer-Rao bound of the volume's points, their rigid motion projected out."""
    names = list(truth.cameras)
    keys = [(v, c) for v in truth.views for c in names if c in truth.views[v].cameras]
    tables: dict[Any, pd.DataFrame] = dict(iter(dots.groupby(["view", "camera"])))
    used = [k for k in keys if k in tables]
    seen = sorted({int(d) for k in used for d in tables[k]["dot"]})
    place = {int(d): i for i, d in enumerate(truth.target.ids)}
    rows_of = {k: [place[int(d)] for d in tables[k]["dot"]] for k in used}
    views, count = list(truth.views), len(truth.target.ids)
    sizes = [len(names), 6 * (len(names) - 1), 6 * len(views), 3 * count]
    edges = np.cumsum([0, *sizes])

    def world(step: Array) -> tuple[list[Camera], list[Pose], Array]:
        scale, camera, view, dot = (step[a:b] for a, b in pairwise(edges))
        cameras = []
        for i, name in enumerate(names):
            one = truth.cameras[name]
            one = one.with_parameters(scale_px_per_mm=one["scale_px_per_mm"] + scale[i])
            if i:
                own = camera[6 * i - 6 : 6 * i]
                pose = Pose.from_rotvec(own[:3], own[3:]) @ one.camera_from_rig
                one = replace(one, camera_from_rig=pose)
            cameras.append(one)
        poses = [
            truth.views[v].rig_from_target
            @ Pose.from_rotvec(view[6 * i : 6 * i + 3], view[6 * i + 3 : 6 * i + 6])
            for i, v in enumerate(views)
        ]
        return cameras, poses, truth.target.points_mm + dot.reshape(-1, 3)

    def pixels(step: Array) -> Array:
        cameras, poses, points = world(step)
        by_name = dict(zip(names, cameras))
        by_view = dict(zip(views, poses))
        parts = [
            pixel_from_plate(by_name[c], by_view[v], points[rows_of[v, c]], truth.target.plate)
            for v, c in used
        ]
        return np.concatenate(parts).ravel()

    def points_of(step: Array) -> Array:
        cameras, _, _ = world(step)
        exact = [truth.cameras[n].project(volume()) for n in names]
        return triangulate_any(cameras, exact, 1.0).points_mm.ravel()

    jacobian, by_points = [], []
    for i in range(edges[-1]):
        step = np.zeros(edges[-1])
        step[i] = _STEP
        jacobian.append((pixels(step) - pixels(-step)) / (2 * _STEP))
        if i < edges[2]:
            by_points.append((points_of(step) - points_of(-step)) / (2 * _STEP))
    design = np.array(jacobian).T
    covariance = np.concatenate(
        [tables[k][["suu_px2", "suv_px2", "suv_px2", "svv_px2"]].to_numpy() for k in used]
    ).reshape(-1, 2, 2)
    weighted = np.einsum(
        "mij,mjk->mik", np.linalg.inv(covariance), design.reshape(-1, 2, edges[-1])
    )
    information = design.T @ weighted.reshape(len(design), -1)
    target = settings.target
    sigma = np.tile([target.print_sigma_mm] * 2 + [target.flatness_sigma_mm], count)
    at = np.arange(edges[3], edges[4])
    information[at, at] += 1 / sigma**2
    a, b = (place[d] for d in target.scale_dots)
    between = truth.target.points_mm[a] - truth.target.points_mm[b]
    row = np.zeros(edges[-1])
    row[edges[3] + 3 * a : edges[3] + 3 * a + 3] = between / np.linalg.norm(between)
    row[edges[3] + 3 * b : edges[3] + 3 * b + 3] = -between / np.linalg.norm(between)
    information += np.outer(row, row) / target.scale_sigma_mm**2
    size = np.sqrt(np.diag(information))
    size[size == 0] = 1.0  # a telecentric camera's own depth
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    kept = values > 1e-11 * values[-1]
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T / np.outer(size, size)
    shift = np.zeros((3 * len(volume()), edges[-1]))
    shift[:, : edges[2]] = np.array(by_points).T
    shift = without_similarity(volume()) @ shift
    assert len(seen) == count, "every dot is seen"
    return np.asarray(shift @ inverse @ shift.T)


def outcome(seed: int) -> Outcome:
    begun = time.perf_counter()
    settings = preset("three")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "data"
        data = telerig.simulate(settings, rng=np.random.default_rng(seed), out=folder)
        # the same draws again: what the files hold as numbers, as objects
        scene_rng, *_ = np.random.default_rng(seed).spawn(3)
        cameras = true_cameras(settings)
        target = true_target(settings, scene_rng)
        views = hand_held_views(settings, cameras, target, scene_rng)
        truth = Truth(cameras, target, {v.name: v for v in views})
        detected = detect(telerig.load_dataset(data.path))
        assert detected is not None
        dots, rig = detected.dots, telerig.load_dataset(data.path).rig
    whole = calibrated(dots, rig, tuple(cameras))
    error = space_error(whole, truth)
    pairs = {
        " + ".join(pair): _rms_um(space_error(calibrated(dots, rig, pair), truth))
        for pair in combinations(cameras, 2)
    }
    shapes = without_similarity(volume())
    stated = aligned_covariance(whole.cameras, whole.free, whole.covariance, volume())
    stated = shapes @ stated @ shapes
    bound = bound_covariance(truth, dots, settings)
    return Outcome(
        whole.model["name"],
        _rms_um(error),
        pairs,
        1e3 * float(np.sqrt(np.trace(bound) / len(bound))),
        1e3 * float(np.sqrt(np.trace(stated) / len(stated))),
        (nees(error.ravel(), root_of(stated)), nees(*pixel_errors(whole, truth))),
        time.perf_counter() - begun,
    )


def root_of(covariance: Array) -> Array:
    """R with R R^T = covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))


def nees(error: Array, root: Array) -> tuple[float, int]:
    """Mean squared error over variance in the directions of root root^T, and their number."""
    directions, sizes, _ = np.linalg.svd(root, full_matrices=False)
    kept = sizes > _RANK * sizes[0]
    along = directions[:, kept].T @ error / sizes[kept]
    return float((along**2).mean()), int(kept.sum())


def pixel_errors(calibration: Calibration, truth: Truth) -> tuple[Array, Array]:
    """(2 C N,) errors of the volume's pixels, the similarity of the points projected out, and a
    root of their stated covariance.
    """
    points = volume()
    exact = [truth.cameras[c.name].project(points) for c in calibration.cameras]
    found, by_point = stacked_jacobian(calibration.cameras, points)
    error = (found - np.concatenate(exact, -1)).ravel()
    centred = points - points.mean(0)
    turns = np.cross(np.eye(3)[:, None], centred)
    shifts = np.broadcast_to(np.eye(3)[:, None], turns.shape)
    motions = np.concatenate([turns, shifts, centred[None]])
    basis, _ = np.linalg.qr(np.einsum("nij,mnj->nim", by_point, motions).reshape(len(error), -1))
    by_rig = rig_jacobian(calibration.cameras, calibration.free, points)
    root = by_rig.reshape(len(error), -1) @ root_of(calibration.covariance)
    return error - basis @ (basis.T @ error), root - basis @ (basis.T @ root)


def _rms_um(error_mm: Array) -> float:
    return float(1e3 * np.sqrt((error_mm**2).mean()))


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    pairs = [" + ".join(p) for p in combinations(preset_names(), 2)]
    head = ["seed", "model", "three, µm", *(f"{p}, µm" for p in pairs), "bound, µm",
            "stated, µm", "NEES of points", "of pixels"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    print("\n".join(lines))
    found = []
    for seed in range(options.first, options.first + options.seeds):
        one = outcome(seed)
        found.append(one)
        cells = [
            str(seed), one.model, f"{one.rms_um:.3f}", *(f"{one.pairs_um[p]:.3f}" for p in pairs),
            f"{one.bound_um:.3f}", f"{one.stated_um:.3f}",
            *(f"{value:.2f}" for value, _ in one.nees),
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
        print(lines[-1], f"({one.seconds:.0f} s)", flush=True)
    whole, bound = _rms([o.rms_um for o in found]), _rms([o.bound_um for o in found])
    best = min(_rms([o.pairs_um[p] for o in found]) for p in pairs)
    words = []
    for kind, what in enumerate(("points", "pixels")):
        values, ranks = np.array([o.nees[kind] for o in found]).T
        chance = float(np.sqrt(2 / ranks.sum()))
        mean = float(np.average(values, weights=ranks))
        words.append(f"{mean:.2f} ± {chance:.2f} of {what} ({np.median(ranks):.0f} directions)")
    spread = 1 / np.sqrt(2 * sum(o.nees[0][1] for o in found))
    summary = [
        f"RMS over {len(found)} seeds: three cameras {whole:.3f} µm per axis, {whole / bound:.2f} "
        f"± {spread:.2f} times the Cramer-Rao bound of {bound:.3f} µm; the best pair {best:.3f} µm "
        f"({best / whole:.2f} times as much). The stated covariance predicts "
        f"{_rms([o.stated_um for o in found]):.3f} µm; "
        f"NEES {', '.join(words)}.",
    ]
    print("\n".join(summary))
    if options.out:
        title = ["# Three cameras, from images", "", *(__doc__ or "").strip().splitlines()[4:], ""]
        text = "\n".join([*title, *lines, "", *summary, ""])
        options.out.write_text(text, encoding="utf-8")


def preset_names() -> list[str]:
    return [camera.name for camera in preset("three").cameras]


if __name__ == "__main__":
    main()
