"""Simulated calibrations in memory, shared by the benchmarks of the self-calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.estimator.calibration.calibrate import nominal_cameras
from telerig.estimator.calibration.solver.problem import (
    Problem,
    nominal_state,
    problem_from_dots,
)
from telerig.factors.calibration import State
from telerig.io.simulation.calibration.scene import (
    TrueTarget,
    View,
    hand_held_views,
    true_cameras,
    true_target,
)
from telerig.io.simulation.calibration_files import exact_dots, rig_description
from telerig.io.simulation.config import SimulationConfig
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.target import Target

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """One simulated calibration: truth, what is known, and what is measured."""

    cameras: Mapping[str, Camera]
    true_target: TrueTarget
    views: list[View]
    nominal: tuple[Camera, ...]
    target: Target
    nominal_rotvec_deg: tuple[float, float, float] | None
    dots: pd.DataFrame

    def problem(self) -> Problem:
        return problem_from_dots(self.dots, self.nominal, self.target)

    def true_state(self, problem: Problem, *, held_centres: bool = True) -> State:
        """The truth; as a start, with the centres where the problem holds them."""
        intrinsics = np.array([c.intrinsics for c in self.cameras.values()])
        if held_centres:
            intrinsics[:, 3:5] = nominal_state(problem).intrinsics[:, 3:5]
        cameras = np.array([_matrix(c.rig_from_camera) for c in self.cameras.values()])
        poses = {v.name: _matrix(v.rig_from_target) for v in self.views}
        at = dict(zip(self.true_target.ids.tolist(), self.true_target.points_mm))
        dots = np.array([at[int(d)] for d in problem.dot_ids])
        return State(intrinsics, cameras, np.array([poses[v] for v in problem.views]), dots)


def _matrix(pose: Pose) -> Array:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = pose.rotation, pose.translation_mm
    return out


def make_scene(
    config: SimulationConfig,
    rng: np.random.Generator,
    *,
    views: list[View] | None = None,
) -> Scene:
    """A scene; with ``views`` given, only the target and the noise are drawn.

    What is measured are the centres of the projected discs.

    Raises InputError when no pose meets the configuration's demands.
    """
    cameras = true_cameras(config)
    target = true_target(config, rng)
    poses = hand_held_views(config, cameras, target, rng) if views is None else views
    exact = exact_dots(config, cameras, target, poses)
    dots = exact[exact["inside"] == 1].reset_index(drop=True)
    variance: Any = config.sigma_px**2
    dots = dots.assign(suu_px2=variance, suv_px2=0.0, svv_px2=variance)
    rig = rig_description(config, target)
    nominal = nominal_cameras(rig)
    side = next(iter(rig.rotvec_from_first_deg.values()), None)
    scene = Scene(cameras, target, poses, nominal, rig.target, side, dots)
    uv = dots[["u_px", "v_px"]].to_numpy()
    if not np.array_equal(scene.problem().uv_px, uv):
        raise RuntimeError("the table is not in the problem's order")
    noise = config.sigma_px * rng.standard_normal((len(dots), 2))
    return replace(scene, dots=dots.assign(**_pixels(uv + noise)))


def _pixels(uv_px: Array) -> dict[str, Array]:
    return {"u_px": uv_px[:, 0], "v_px": uv_px[:, 1]}
