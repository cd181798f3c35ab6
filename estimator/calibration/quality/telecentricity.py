"""How telecentric each lens is: by how much its scale changes over the depth of the views."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from telerig.estimator.calibration.solver.problem import Problem, parameter_unit
from telerig.estimator.calibration.solver.robust_least_squares import Solution, linearisation
from telerig.rig.lens_parameters import INDEX, groups_of, name_of

_KAPPA = INDEX["kappa_per_mm"]


def telecentricity(
    problem: Problem, solution: Solution, models: Sequence[str]
) -> dict[str, dict[str, float]]:
    """Return for each camera, by its name, how much its scale changes with depth.

    If the camera's model holds kappa at nominal, kappa is freed here for one Gauss-Newton step.

    models : for each camera the name of its lens model.
    Each entry holds "change_per_mm", the relative change of the scale per mm at the mean depth of
    the dots; "sd_per_mm", its standard deviation; "depth_mm", the range of the dots' depths; and
    "perspective", the slope of a ray at the image's corner relative to the optical axis.
    """
    wide = problem.with_model([name_of({*groups_of(model), "kappa"}) for model in models])
    equations = linearisation(wide)[1](solution.state)
    step, _ = equations.step(1e-12)
    variance = np.diag(equations.posterior(whole=False).common)
    state = solution.state
    poses = state.rig_from_target[problem.view]
    points = np.einsum("kij,kj->ki", poses[:, :3, :3], state.dots_mm[problem.dot]) + poses[:, :3, 3]
    out: dict[str, dict[str, float]] = {}
    at = 0
    for c, camera in enumerate(problem.cameras):
        free = wide.free_indices(c).tolist()
        place, unit = at + free.index(_KAPPA), parameter_unit(camera)[_KAPPA]
        at += len(free)
        kappa = state.intrinsics[c, _KAPPA] + unit * step[place]
        camera_from_rig = np.linalg.inv(state.rig_from_camera[c])
        seen = problem.kept & (problem.camera == c)
        depth = points[seen] @ camera_from_rig[2, :3] + camera_from_rig[2, 3]
        nearer = 1.0 + kappa * float(depth.mean()) if len(depth) else 1.0
        change = float(kappa / nearer)
        out[camera.name] = {
            "change_per_mm": change,
            "sd_per_mm": float(unit * np.sqrt(max(variance[place], 0.0)) / nearer**2),
            "depth_mm": float(np.ptp(depth)) if len(depth) else 0.0,
            "perspective": abs(change) * camera.rho_mm,
        }
    return out
