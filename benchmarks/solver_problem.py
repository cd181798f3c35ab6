"""Calibrations of any size for `solvers.py`: two cameras, all dots in all images, known noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.start import known_target
from telerig.factors.calibration import Observations, State, pixels
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.target import Target

Array = NDArray[np.float64]

SIGMA_PX, PRINT_MM, HALF_MM = 0.03, 0.02, 14.0
MODEL = "kappa+tangential"
SEEN = {"kappa_per_mm": 2e-5, "k1": 2e-3, "p1": 3e-4, "p2": -2e-4}


def grid(dots: int) -> tuple[int, int]:
    """Rows and columns, as square as whole numbers allow."""
    rows = max(n for n in range(1, int(np.sqrt(dots)) + 1) if dots % n == 0)
    return rows, dots // rows


def make_problem(views: int, dots: int, rng: np.random.Generator) -> tuple[Problem, State]:
    """The problem and its closed-form start; model `MODEL`, every dot in every image."""
    side = Pose.from_rotvec((0.02, np.pi / 2, -0.01), (0.0, 0.0, 0.0))
    nominal = tuple(
        Camera.create(name, (1024, 1024), 32.0, camera_from_rig=pose)
        for name, pose in (("left", Pose.identity()), ("right", side))
    )
    truth = [c.with_parameters(scale_px_per_mm=s, **SEEN) for c, s in zip(nominal, (31.8, 32.1))]
    rows, columns = grid(dots)
    pitch = (2 * HALF_MM / columns, 2 * HALF_MM / rows)
    place = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2) * pitch
    flat = np.concatenate([place, np.zeros((dots, 1))], 1)
    state = _truth(truth, flat + rng.normal(scale=PRINT_MM, size=flat.shape), views, rng)
    view, camera, dot = (a.ravel() for a in np.indices((views, 2, dots)))
    variance = np.tile(SIGMA_PX**2 * np.eye(2), (len(view), 1, 1))
    uv = np.zeros((len(view), 2))
    obs = Observations(view, camera, dot, uv, variance, np.zeros((views, 2)))
    uv = pixels(state, obs, tuple(c.rho_mm for c in nominal))
    uv += rng.normal(scale=SIGMA_PX, size=uv.shape)
    far = dots - 1
    length = float(np.linalg.norm(state.dots_mm[far] - state.dots_mm[0]))
    problem = Problem(
        nominal, Target(rows=rows, columns=columns, pitch_mm=pitch),
        tuple(f"{v:04}" for v in range(views)), np.arange(dots), flat,
        np.full((dots, 3), PRINT_MM), view, camera, dot, uv, np.zeros_like(uv), variance,
        np.ones(len(view)), ((), ()), ((0, far), length, 0.001), np.zeros((views, 2)),
    ).with_model(MODEL)  # fmt: skip
    return problem, known_target.stereo_states(problem, flat)[0]


def _truth(cameras: list[Camera], dots: Array, views: int, rng: np.random.Generator) -> State:
    """Views half way between the cameras, tilted by up to 30 degrees any way."""
    poses = np.tile(np.eye(4), (views, 1, 1))
    turn = rotation_from_rotvec(rng.uniform(-0.5, 0.5, (views, 3)))
    poses[:, :3, :3] = rotation_from_rotvec(np.array([0.0, -np.pi / 4, 0.0])) @ turn
    middle = dots.mean(0)
    poses[:, :3, 3] = rng.uniform(-1, 1, (views, 3)) - poses[:, :3, :3] @ middle
    intrinsics = np.array([c.intrinsics for c in cameras])
    return State(intrinsics, np.array([c.rig_from_camera.matrix for c in cameras]), poses, dots)


def with_solver(problem: Problem, solver: str) -> Problem:
    return replace(problem, solver=solver)
