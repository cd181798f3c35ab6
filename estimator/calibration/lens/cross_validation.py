"""Views that a fit has not seen: how well does it predict them?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from telerig.arrays import Array
from telerig.estimator.calibration.solver.levenberg_marquardt import linearisation
from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.solver.system import System, images_of, retracted
from telerig.factors.projection import State, whitened_error

FOLDS = 4
DAMPING = 1e-6
POSE_STEPS = 3
"""Of Gauss-Newton, from the pose that the view had in the fit of all."""


def pose_only(problem: Problem, state: State, steps: int = 15) -> State:
    """Refine every view's pose with cameras and dots held: Gauss-Newton on 6 unknowns a view."""
    system = System(problem)
    for _ in range(steps):
        normal = np.zeros((len(problem.views), 6, 6))
        right = np.zeros((len(problem.views), 6))
        for c, obs in enumerate(system.images):
            columns = system.columns(state, c)[-7:]
            for v, a, b in images_of(obs):
                flat = columns[..., a:b].reshape(7, -1)
                normal[v] += flat[:-1] @ flat[:-1].T
                right[v] -= flat[:-1] @ flat[-1]
        # a view seen by one telecentric camera has a depth that nothing moves
        normal += (1e-9 + 1e-9 * np.trace(normal, axis1=-2, axis2=-1))[:, None, None] * np.eye(6)
        step = np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], np.float64)
        state = replace(state, rig_from_target=retracted(state.rig_from_target, step))
        if np.abs(step).max() < 1e-10:
            break
    return state


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
        system, linearised = linearisation(problem.subset(~mine))
        step, _ = linearised(state).step(DAMPING)
        trained = replace(system.moved(state, step), rig_from_target=state.rig_from_target)
        test = problem.subset(mine)
        fitted = pose_only(test, trained, steps=POSE_STEPS)
        obs = test.observations()
        squares = (whitened_error(fitted, obs, problem.rho_mm) ** 2).sum(-1)
        for v in left_out:
            if np.any(obs.view == v):
                out[v] = squares[obs.view == v].mean()
    return out
