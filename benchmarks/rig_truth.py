"""The truth beside a calibration: what is a matter of gauge set aside, and the best that can be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from unittest import mock

import numpy as np
from calibration_scene import Scene
from numpy.typing import NDArray

from telerig.estimator.calibration import self_calibration
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.self_calibration import best_start
from telerig.estimator.calibration.solver.covariance import joint_covariance
from telerig.estimator.calibration.solver.problem import eccentricity_px, held_at_nominal
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.estimator.calibration.solver.system import System
from telerig.io.simulation.calibration_files import exact_dots
from telerig.io.simulation.config import SimulationConfig
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import PARAMETERS
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.triangulation import aligned_covariance, triangulate

Array = NDArray[np.float64]

HALF_VOLUME_MM = 15.0
STEPS = 5


def volume() -> Array:
    """(125, 3) points in a cube round the rig's origin."""
    axis = np.linspace(-HALF_VOLUME_MM, HALF_VOLUME_MM, STEPS)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def aligned(points: Array, onto: Array) -> Array:
    """Points after the rotation and shift that bring them nearest."""
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


def in_gauge(cameras: Sequence[Camera], model: str) -> tuple[list[Camera], Array]:
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
        if model == "tangential":
            values["p1"], values["p2"] = -camera["k1"] * off[::-1] / camera.rho_mm
        out.append(camera.with_parameters(**{k: float(v) for k, v in values.items()}))
        shifts.append(np.r_[off, 0.0])
    pose = cameras[1].camera_from_rig
    across = pose.translation_mm + shifts[1] - pose.rotation @ shifts[0]
    axes = np.stack([pose.rotation[:, 2], [0.0, 0.0, 1.0]], 1)
    depths = np.linalg.lstsq(axes, across, rcond=None)[0]
    out[1] = replace(out[1], camera_from_rig=Pose(pose.rotation, across - axes @ depths))
    return out, shifts[0] + np.array([0.0, 0.0, depths[0]])


def same_tilt_sign(camera: Camera, estimate: Camera) -> Camera:
    """Tilt and convergence with the estimate's sign: (q, w) and (-q, -w) are the same lens."""
    tilt = ("tilt_x", "tilt_y")
    if sum(camera[n] * estimate[n] for n in tilt) >= 0:
        return camera
    names = (*tilt, "image_convergence_per_mm")
    return camera.with_parameters(**{n: -float(camera[n]) for n in names})


def rig_errors(calibration: Calibration, truth: Sequence[Camera]) -> Array:
    """(P,) estimate minus truth in the tangent of the rig block."""
    pairs = zip(truth, calibration.cameras)
    true = {camera.name: same_tilt_sign(camera, estimate) for camera, estimate in pairs}
    out = []
    for camera in calibration.cameras:
        own = [
            n.split(".", 1)[1] for n in calibration.covariance_names if n.startswith(camera.name)
        ]
        out += [camera[n] - true[camera.name][n] for n in own if n in PARAMETERS]
    delta = truth[1].camera_from_rig @ calibration.cameras[1].rig_from_camera
    return np.r_[out, delta.rotvec_rad, delta.translation_mm]


def bound_covariance(
    scene: Scene, config: SimulationConfig, model: str, kept: NDArray[np.bool_] | None = None
) -> Array:
    """(375, 375) mm^2: Cramer-Rao bound of the points of `volume`, their common motion set aside.

    The covariance at the truth, without noise.  kept : which rows of ``scene.dots`` are sound,
    None: all.
    """
    exact = exact_dots(config, scene.cameras, scene.true_target, scene.views)
    dots = exact[exact["inside"] == 1].reset_index(drop=True)
    dots = scene.dots.assign(**{n: dots[n] for n in ("view", "camera", "dot", "u_px", "v_px")})
    problem = replace(scene, dots=dots).problem()
    if kept is not None:
        problem = replace(problem, weight=kept.astype(float))
    problem, _ = best_start(replace(problem, solver="numpy"), problem.nominal_mm)
    problem = problem.with_model(model)
    solution = solve(problem, held_at_nominal(problem, scene.true_state(problem)))
    _, covariance = joint_covariance(problem, solution).rig_block()
    first, second = scene.cameras.values()
    return aligned_covariance((first, second), problem.free, covariance, volume())


def bound_um(scene: Scene, config: SimulationConfig, model: str) -> float:
    """Cramer-Rao bound on the 3-D RMS per axis, the common rigid motion set aside."""
    covariance = bound_covariance(scene, config, model)
    return float(1e3 * np.sqrt(np.trace(covariance) / len(covariance)))


@contextmanager
def without_advice() -> Iterator[None]:
    """The next view takes a quarter of a calibration's time, or more, and changes nothing."""
    with mock.patch.object(self_calibration, "next_view", lambda *_: None):
        yield


def linear_deviations(scene: Scene, config: SimulationConfig, model: str) -> Array:
    """(P,) errors of one linear step from the truth, over the standard deviations at the truth.

    They are linear in the noise, so that their covariance is known: the control variate of the
    estimator's own errors. The truth is brought into the model's gauge by a fit to exact pixels
    of a target whose nominal places are the true ones.
    """
    problem = replace(scene.problem().with_model(model), solver="numpy")
    discs = eccentricity_px(problem, scene.true_state(problem, held_centres=False))
    problem = replace(problem, eccentricity_px=discs)
    exact = exact_dots(config, scene.cameras, scene.true_target, scene.views)
    true_px = exact.loc[exact["inside"] == 1, ["u_px", "v_px"]].to_numpy()
    start = held_at_nominal(problem, scene.true_state(problem))
    known = replace(problem, uv_px=true_px, nominal_mm=start.dots_mm, scale=None)
    if problem.scale is not None:
        ends, _, sigma = problem.scale
        true_mm = float(np.linalg.norm(np.subtract(*start.dots_mm[list(ends)])))
        known = replace(known, scale=(ends, true_mm, sigma))
    truth = solve(known, start).state
    gaussian = System(problem).gaussian(truth)
    step, _ = gaussian.step()
    count = sum(map(len, problem.free)) + 6
    sd = np.sqrt(np.diag(gaussian.marginal(np.arange(count))))
    return np.asarray(step[:count] / sd[:count])
