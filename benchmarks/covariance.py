"""Is the reported covariance of a self-calibration the true one? Monte-Carlo over many datasets.

Usage: python benchmarks/covariance.py [--seeds 300] [--out FILE.md]

One set of hand-held poses; target (from its print tolerances), known distance and image noise are
drawn anew for every dataset, as the estimator assumes. Errors are against the truth in the same
gauge. "sd ratio" is the reported standard deviation over the RMS error, "68 %" and "95 %" how
often the error is within 1 and 1.96 reported standard deviations. Triangulated points: 125 in a
cube of 30 mm, from their true pixels (calibration's share, after the rotation and shift that fit
best, which are a matter of gauge) and from noisy pixels in the rig's own frame (the covariance
that `Calibration.triangulate` states). The Cramer-Rao bound is that of the true rig.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from calibration_scene import Scene, make_scene
from numpy.typing import NDArray

from telerig.estimator.calibration import Calibration
from telerig.estimator.covariance import joint_covariance
from telerig.estimator.graph import solve
from telerig.estimator.problem import held_at_nominal
from telerig.estimator.self_calibration import self_calibrate
from telerig.io.simulation import exact_dots
from telerig.io.simulation_presets import SimulationConfig, preset
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.projection import PARAMETERS
from telerig.rig.triangulation import triangulate

Array = NDArray[np.float64]

HALF_VOLUME_MM = 15.0
STEPS = 5
GAUGE = ("tx_mm", "tz_mm")
"""Components of the second camera's pose that mostly hold the gauge."""


@dataclass(frozen=True)
class Case:
    """A preset and the model that it is fitted with."""

    name: str
    config: SimulationConfig
    model: str


def cases() -> list[Case]:
    """The first two are what the model can describe exactly; the third has off-centre lenses."""
    return [
        Case("paper, lenses centred", _centred(preset("paper")), "radial"),
        Case("near_telecentric, centred", _centred(preset("near_telecentric")), "kappa+radial"),
        Case("paper as it is", preset("paper"), "radial"),
        Case("paper as it is", preset("paper"), "tangential"),
    ]


def _centred(config: SimulationConfig) -> SimulationConfig:
    cameras = tuple(replace(c, centre_offset_px=(0.0, 0.0)) for c in config.cameras)
    return replace(config, cameras=cameras)


def volume() -> Array:
    axis = np.linspace(-HALF_VOLUME_MM, HALF_VOLUME_MM, STEPS)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def aligned(points: Array, onto: Array) -> Array:
    a, b = points - points.mean(0), onto - onto.mean(0)
    u, _, vt = np.linalg.svd(a.T @ b)
    return np.asarray(a @ u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt + onto.mean(0))


def without_motion(points: Array) -> Array:
    """(3 N, 3 N) projector that removes small rigid motions."""
    x = points - points.mean(0)
    turns = [np.cross(axis, x).ravel() for axis in np.eye(3)]
    shifts = [np.tile(axis, len(x)) for axis in np.eye(3)]
    basis, _ = np.linalg.qr(np.array(turns + shifts).T)
    return np.eye(3 * len(x)) - basis @ basis.T


def moved_rig(
    cameras: Sequence[Camera], names: Sequence[str], index: int, step: float
) -> tuple[Camera, Camera]:
    """The rig with one component of the rig block changed, in the tangent the files document."""
    owner, component = names[index].split(".", 1)
    out = []
    for camera in cameras:
        if camera.name == owner and component in ("rx_rad", "ry_rad", "rz_rad"):
            turn = np.eye(3)["xyz".index(component[1])] * step
            delta = Pose(rotation_from_rotvec(turn), np.zeros(3))
            pose = (camera.rig_from_camera @ delta).inverse()
            out.append(replace(camera, camera_from_rig=pose))
        elif camera.name == owner and component in ("tx_mm", "ty_mm", "tz_mm"):
            delta = Pose(np.eye(3), np.eye(3)["xyz".index(component[1])] * step)
            pose = (camera.rig_from_camera @ delta).inverse()
            out.append(replace(camera, camera_from_rig=pose))
        elif camera.name == owner:
            out.append(camera.with_parameters(**{component: camera[component] + step}))
        else:
            out.append(camera)
    return out[0], out[1]


def point_jacobian(
    cameras: Sequence[Camera], names: Sequence[str], sd: Array, points: Array
) -> Array:
    """(3 N, P) central differences of triangulated points by the rig block."""
    pixels = tuple(c.project(points) for c in cameras)
    columns = []
    for i, s in enumerate(sd):
        ends = [
            triangulate(moved_rig(cameras, names, i, sign * s), pixels, 1.0).points_mm
            for sign in (1, -1)
        ]
        columns.append((ends[0] - ends[1]).ravel() / (2 * s))
    return np.stack(columns, 1)


def in_gauge(cameras: Sequence[Camera], case: Case) -> tuple[list[Camera], Array]:
    """The true rig in the estimate's gauge, and the (3,) shift of rig points that goes with it.

    Image centres are held at the middle of the image: what they are off by moves the camera's
    origin (kappa = 0) and appears, to first order, as p1 = -k1 dy, p2 = -k1 dx. The rig's origin is
    where the axes come closest.
    """
    out, shifts = [], []
    for camera in cameras:
        middle = (np.array(camera.image_size_px) - 1) / 2
        centre = np.array([camera["centre_u_px"], camera["centre_v_px"]])
        off = (centre - middle) / camera["scale_px_per_mm"]
        values = {"centre_u_px": middle[0], "centre_v_px": middle[1]}
        if case.model == "tangential":
            values["p1"], values["p2"] = -camera["k1"] * off[::-1] / camera.rho_mm
        out.append(camera.with_parameters(**{k: float(v) for k, v in values.items()}))
        shifts.append(np.r_[off, 0.0])
    pose = cameras[1].camera_from_rig
    across = pose.translation_mm + shifts[1] - pose.rotation @ shifts[0]
    axes = np.stack([pose.rotation[:, 2], [0.0, 0.0, 1.0]], 1)
    depths = np.linalg.lstsq(axes, across, rcond=None)[0]
    out[1] = replace(out[1], camera_from_rig=Pose(pose.rotation, across - axes @ depths))
    return out, shifts[0] + np.array([0.0, 0.0, depths[0]])


def rig_errors(calibration: Calibration, truth: Sequence[Camera]) -> Array:
    """(P,) estimate minus truth in the tangent of the rig block."""
    true = {c.name: c for c in truth}
    out = []
    for camera in calibration.cameras:
        own = [
            n.split(".", 1)[1] for n in calibration.covariance_names if n.startswith(camera.name)
        ]
        out += [camera[n] - true[camera.name][n] for n in own if n in PARAMETERS]
    delta = truth[1].camera_from_rig @ calibration.cameras[1].rig_from_camera
    return np.r_[out, delta.rotvec_rad, delta.translation_mm]


@dataclass
class Samples:
    """What is kept of every dataset."""

    names: tuple[str, ...]
    errors: list[Array]
    sds: list[Array]
    nees: list[float]
    chi2: list[float]
    space_um: list[float]
    predicted_um: list[float]
    point_inside: list[Array]
    point_nees: list[float]
    seconds: list[float]


def bound_um(case: Case, scene: Scene) -> float:
    """Cramer-Rao bound on the 3-D RMS per axis: the covariance at the truth, without noise."""
    exact = exact_dots(case.config, scene.cameras, scene.true_target, scene.views)
    dots = exact[exact["inside"] == 1].reset_index(drop=True)
    dots = scene.dots.assign(u_px=dots["u_px"], v_px=dots["v_px"])
    problem = replace(scene, dots=dots).problem().with_model(case.model)
    solution = solve(problem, held_at_nominal(problem, scene.true_state(problem)))
    names, covariance = joint_covariance(problem, solution).rig_block()
    cameras, points = list(scene.cameras.values()), volume()
    jacobian = point_jacobian(cameras, names, np.sqrt(np.diag(covariance)), points)
    free = without_motion(points) @ jacobian
    return float(1e3 * np.sqrt(np.trace(free @ covariance @ free.T) / points.size))


def run(case: Case, seeds: int) -> tuple[Samples, float]:
    first = make_scene(case.config, np.random.default_rng(1000))
    bound = bound_um(case, first)
    truth, points = list(first.cameras.values()), volume()
    gauged, shift = in_gauge(truth, case)
    samples = Samples((), [], [], [], [], [], [], [], [], [])
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        scene = make_scene(case.config, rng, views=first.views)
        began = time.process_time()
        calibration = self_calibrate(
            scene.dots,
            scene.nominal,
            scene.target,
            nominal_rotvec_deg=scene.nominal_rotvec_deg,
            model=case.model,
        )
        samples.seconds.append(time.process_time() - began)
        pixels = [c.project(points) for c in truth]
        _record(samples, calibration, gauged, points + shift, pixels, case, rng)
    return samples, bound


def _record(
    samples: Samples,
    calibration: Calibration,
    truth: list[Camera],
    points: Array,
    pixels: list[Array],
    case: Case,
    rng: np.random.Generator,
) -> None:
    names, covariance = calibration.covariance_names, calibration.covariance
    error, sd = rig_errors(calibration, truth), np.sqrt(np.diag(covariance))
    samples.names = names
    samples.errors.append(error)
    samples.sds.append(sd)
    seen = [i for i, n in enumerate(names) if not n.endswith(GAUGE)]
    block = covariance[np.ix_(seen, seen)]
    samples.nees.append(float(error[seen] @ np.linalg.solve(block, error[seen]) / len(seen)))
    samples.chi2.append(float(calibration.statistics["chi2_dof"]))
    found = triangulate(calibration.cameras[:2], tuple(pixels), 1.0).points_mm  # type: ignore[arg-type]
    off = aligned(found, points) - points
    samples.space_um.append(float(1e3 * np.sqrt((off**2).mean())))
    jacobian = without_motion(points) @ point_jacobian(calibration.cameras, names, sd, found)
    variance = np.trace(jacobian @ covariance @ jacobian.T) / points.size
    samples.predicted_um.append(float(1e3 * np.sqrt(variance)))
    noise = case.config.sigma_px
    noisy = [uv + noise * rng.standard_normal(uv.shape) for uv in pixels]
    measured = calibration.triangulate(*noisy, sigma_px=noise)
    off = measured.points_mm - points
    sds = np.sqrt(np.diagonal(measured.covariance_mm2, axis1=-2, axis2=-1))
    samples.point_inside.append(np.abs(off) / sds)
    solved = np.linalg.solve(measured.covariance_mm2, off[..., None])[..., 0]
    samples.point_nees.append(float((off * solved).sum(-1).mean() / 3))


def table(case: Case, samples: Samples, bound: float) -> list[str]:
    errors, sds = np.array(samples.errors), np.array(samples.sds)
    inside = np.array(samples.point_inside)
    count = len(errors)
    space, predicted = np.array(samples.space_um), np.array(samples.predicted_um)
    lines = [
        f"## {case.name}: model {case.model}, {count} datasets",
        "",
        "| parameter | reported sd | RMS error | sd ratio | mean error / sd | 68 % | 95 % |",
        "|---|---|---|---|---|---|---|",
    ]
    for i, name in enumerate(samples.names):
        rms, sd = np.sqrt((errors[:, i] ** 2).mean()), np.sqrt((sds[:, i] ** 2).mean())
        z = errors[:, i] / sds[:, i]
        lines.append(
            f"| {name} | {sd:.3g} | {rms:.3g} | {sd / rms:.2f} | {z.mean():+.2f} | "
            f"{np.mean(np.abs(z) < 1):.0%} | {np.mean(np.abs(z) < 1.96):.0%} |"
        )
    spread = 1 / np.sqrt(2 * count)
    return [
        *lines,
        "",
        f"- sd ratio is uncertain by {spread:.2f}. Rig block without the gauge: normalised error "
        f"squared {np.mean(samples.nees):.3f} +- {np.std(samples.nees) / np.sqrt(count):.3f} "
        "(1 expected).",
        f"- chi-square per degree of freedom: {np.mean(samples.chi2):.4f} +- "
        f"{np.std(samples.chi2) / np.sqrt(count):.4f}.",
        f"- 3-D error of the calibration, aligned: median {np.median(space):.3f} um RMS per axis, "
        f"RMS {np.sqrt((space**2).mean()):.3f}, predicted {np.sqrt((predicted**2).mean()):.3f}, "
        f"Cramer-Rao bound {bound:.3f}; **median over bound {np.median(space) / bound:.2f}**, RMS "
        f"over bound {np.sqrt((space**2).mean()) / bound:.2f}.",
        f"- `Calibration.triangulate` from noisy pixels, in the rig's frame: within 1 sd "
        f"{np.mean(inside < 1):.1%} (68.3), within 1.96 sd {np.mean(inside < 1.96):.1%} (95), "
        f"normalised error squared {np.mean(samples.point_nees):.3f} (1).",
        f"- {np.median(samples.seconds):.2f} s a calibration (one core).",
        "",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=300)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    lines = [
        "# Reported against true covariance",
        "",
        *(__doc__ or "").strip().splitlines()[4:],
        "",
    ]
    for case in cases():
        samples, bound = run(case, options.seeds)
        lines += table(case, samples, bound)
        print("\n".join(table(case, samples, bound)), flush=True)
    if options.out:
        options.out.write_text("\n".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main()
