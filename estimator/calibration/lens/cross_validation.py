"""Views that a fit has not seen: how well does it predict them?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.calibration.solver.array_system import ArraySystem
from telerig.estimator.calibration.solver.problem import Problem
from telerig.factors.image_blocks import view_gram
from telerig.factors.image_rows import in_chunks
from telerig.factors.projection import State, whitened_error
from telerig.rig.pose import rotation_from_rotvec

Array = NDArray[np.float64]

FOLDS = 4
DAMPING = 1e-6
POSE_STEPS = 3
"""Of Gauss-Newton, from the pose that the view had in the fit of all."""


def pose_only(problem: Problem, state: State, steps: int = 15) -> State:
    """Refine every view's pose with cameras and dots held: Gauss-Newton on 6 unknowns a view."""
    chunks = in_chunks(problem.observations(), len(problem.dot_ids))
    views = state.rig_from_target.copy()
    for _ in range(steps):
        normal = np.tile(1e-9 * np.eye(6), (len(views), 1, 1))
        right = np.zeros((len(views), 6))
        for rows in chunks:
            gram = view_gram(replace(state, rig_from_target=views), rows, problem.rho_mm)
            for _, images in rows.cameras:
                normal[rows.view[images]] += gram[images, :6, :6]
                right[rows.view[images]] -= gram[images, :6, 6]
        # a view seen by one telecentric camera has a depth that nothing moves
        normal += 1e-9 * np.trace(normal, axis1=-2, axis2=-1)[:, None, None] * np.eye(6)
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        views[:, :3, 3] += np.einsum("vij,vj->vi", views[:, :3, :3], step[:, 3:])
        views[:, :3, :3] = views[:, :3, :3] @ rotation_from_rotvec(step[:, :3])
        if np.abs(step).max() < 1e-10:
            break
    return replace(state, rig_from_target=views)


def held_out_chi2(problem: Problem, state: State, folds: int = FOLDS) -> Array:
    """(V,) mean squared whitened residual of each view, predicted by a fit without it.

    state : the minimum with all views. The fit without some is one Gauss-Newton step away.
    The left-out view's own pose is fitted to it, with cameras and dots of the other views.
    """
    views = np.arange(len(problem.views))
    out = np.full(len(views), np.nan)
    for fold in range(folds):
        left_out = views[fold::folds]
        if len(left_out) == 0 or len(views) - len(left_out) < 2:
            continue
        mine = np.isin(problem.view, left_out)
        system = ArraySystem(problem.subset(~mine), state)
        step, _ = system.linearised(state).step(DAMPING)
        trained = replace(system.moved(state, step), rig_from_target=state.rig_from_target)
        test = problem.subset(mine)
        fitted = pose_only(test, trained, steps=POSE_STEPS)
        obs = test.observations()
        squares = (whitened_error(fitted, obs, problem.rho_mm) ** 2).sum(-1)
        for v in left_out:
            if np.any(obs.view == v):
                out[v] = squares[obs.view == v].mean()
    return out
