"""Cross-validation tests how well a fit predicts views that it has not used."""

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
"""Number of Gauss-Newton steps of a left-out view's pose, from its pose in the fit to all views."""


def pose_only(problem: Problem, state: State, steps: int = 15) -> State:
    """Return the state after the pose of every view was refined, with cameras and dots held fixed.

    These are Gauss-Newton steps on the 6 unknowns of each view.
    """
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
        # a view that only one telecentric camera sees has an undetermined depth
        normal += (1e-9 + 1e-9 * np.trace(normal, axis1=-2, axis2=-1))[:, None, None] * np.eye(6)
        step = np.asarray(np.linalg.solve(normal, right[..., None])[..., 0], np.float64)
        state = replace(state, rig_from_target=retracted(state.rig_from_target, step))
        if np.abs(step).max() < 1e-10:
            break
    return state


def held_out_chi2(problem: Problem, state: State, folds: int = FOLDS) -> Array:
    """Return the mean squared whitened residual (V,) of each of V views, predicted by a fit without
    it.

    A fit without some views is one Gauss-Newton step from ``state``. The pose of a left-out view is
    then fitted to it, with the cameras and dots of the other views. Views whose fold cannot be left
    out get NaN.

    state : the minimum with all views.
    folds : number of parts into which the views are divided; one part is left out at a time.
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
