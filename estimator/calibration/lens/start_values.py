"""Where the fit of a lens model starts: at the nominal lens, except for a tilted sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.solver.graph import solve
from telerig.estimator.calibration.solver.problem import Problem, held_at_nominal
from telerig.factors.projection import State
from telerig.rig.lens_models import GROUPS
from telerig.rig.projection import INDEX

Array = NDArray[np.float64]

_TILT = [INDEX["tilt_x"], INDEX["tilt_y"]]
_SHAPE = [INDEX["aspect"], INDEX["skew"]]
_SCALE = INDEX["scale_px_per_mm"]


def model_start(problem: Problem, state: State) -> State:
    """A start for the problem's own model from a state fitted with another.

    A tilt acts in the second order: at zero its derivative vanishes and no solver leaves it. Its
    start is the tilt that stretches the image as the best aspect ratio and skew do.
    """
    start = held_at_nominal(problem, state)
    if not any("tilt_x" in free for free in problem.free):
        return start
    shapes = tuple(
        (*(p for p in free if p not in GROUPS["tilt"]), *GROUPS["affine"])
        if "tilt_x" in free else free
        for free in problem.free
    )  # fmt: skip
    affine = replace(problem, free=shapes)
    fitted = solve(affine, held_at_nominal(affine, state), max_iterations=20, relative=1e-5).state
    cameras = [c for c, free in enumerate(problem.free) if "tilt_x" in free]
    return held_at_nominal(problem, tilted(fitted, cameras))


def tilted(state: State, cameras: Sequence[int]) -> State:
    """The state with aspect and skew of some cameras turned into a bilateral tilt; see
    `telerig.rig.projection`: S(q) stretches by sqrt(1 + q^2) along q. The sign of q is free.
    """
    intrinsics = state.intrinsics.copy()
    for camera in cameras:
        k = intrinsics[camera]
        aspect, skew = k[_SHAPE]
        _, stretch, axes = np.linalg.svd(np.array([[1.0, skew], [0.0, aspect]]))
        k[_TILT] = np.sqrt(max((stretch[0] / stretch[1]) ** 2 - 1, 1e-6)) * axes[0]
        k[_SCALE] *= stretch[1]
        k[_SHAPE] = [1.0, 0.0]
    return replace(state, intrinsics=intrinsics)
