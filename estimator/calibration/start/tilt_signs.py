"""The sign of the tilt in views that one telecentric camera sees alone.

A flat target and its mirror image in depth look alike to such a camera, but the dots' relief (how
far they are from a plane) does not: its sign must agree with what the other views show of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Ints
from telerig.estimator.calibration.lens.cross_validation import pose_only
from telerig.estimator.calibration.solver.levenberg_marquardt import solve
from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.solver.robust import robust_solve
from telerig.factors.projection import State, whitened_error, whitened_residuals

_D = np.diag([1.0, 1.0, -1.0, 1.0])
_FLAT_MM = 1e-6
_MODEL = "tangential"
_ROUNDS = 6


def views_seen_alone(problem: Problem) -> tuple[Ints, Ints]:
    """Views with dots in exactly one camera, and that camera."""
    counts = np.zeros((len(problem.views), len(problem.cameras)), int)
    np.add.at(counts, (problem.view, problem.camera), problem.weight > 0)
    alone = np.flatnonzero((counts > 0).sum(1) == 1)
    return alone, counts[alone].argmax(1)


def with_tilt_signs(problem: Problem, state: State) -> State:
    """The state with the tilts of views seen alone that agree with the dots' relief.

    With one camera every view is of this kind: the signs come out right up to the mirror
    ambiguity of the whole. First all at once, from the reliefs that the views show
    (`_from_relief`), then one by one, by the cost of each view's two poses. Dots that are wrong
    under any sign are left out before.
    """
    alone, cameras = views_seen_alone(problem)
    relief = float(problem.dot_sigma_mm[:, 2].max())
    if len(alone) == 0 or relief <= _FLAT_MM:
        return state
    problem = problem.with_model(_MODEL)
    rough = robust_solve(_tolerant(problem, alone), state)
    problem, state = replace(problem, weight=rough.problem.weight), rough.solution.state
    if len(problem.cameras) == 1:
        state = _flipped(state, alone[_from_relief(problem, state, alone) < 0], 0)
    for _ in range(_ROUNDS):
        fitted = solve(problem, state, max_iterations=15, relative=1e-4).state
        other = fitted
        for c in range(len(problem.cameras)):
            other = _flipped(other, alone[cameras == c], c)
        costs = [_view_costs(problem, pose_only(problem, s)) for s in (fitted, other)]
        better = alone[(costs[1] < costs[0])[alone]]
        state = _with_views(fitted, other, better)
        if len(better) == 0:
            break
    return state


def _tolerant(problem: Problem, views: Ints) -> Problem:
    """Covariances of some views enlarged by what the dots' relief can move: no sign is wrong."""
    scale = np.array([c["scale_px_per_mm"] for c in problem.cameras])[problem.camera]
    relief_px = 2 * scale * problem.dot_sigma_mm[:, 2].max() * np.isin(problem.view, views)
    extra = relief_px[:, None, None] ** 2 * np.eye(2)
    return replace(problem, covariance_px2=problem.covariance_px2 + extra)


def _from_relief(problem: Problem, state: State, alone: Ints) -> Array:
    """(len(alone),) +-1: the signs under which the reliefs seen in all views are most alike.

    Fitted with flat dots, view v leaves residuals of the relief s_v z_i: a matrix of rank one.
    """
    sigma = problem.dot_sigma_mm.copy()
    sigma[:, 2] = _FLAT_MM
    flat = replace(problem, dot_sigma_mm=sigma)
    fitted = solve(flat, state, max_iterations=20, relative=1e-5).state
    obs = flat.observations()
    jac = whitened_residuals(fitted, obs, flat.rho_mm)
    by_relief = jac.by_dot[..., 2]
    seen = np.zeros((len(flat.views), len(flat.dot_ids)))
    weight = np.zeros_like(seen)
    np.add.at(seen, (obs.view, obs.dot), -(by_relief * jac.value).sum(-1))
    np.add.at(weight, (obs.view, obs.dot), (by_relief**2).sum(-1))
    seen = _without_plane(seen / np.maximum(weight, 1e-12), weight > 0, flat.nominal_mm)
    left, _, _ = np.linalg.svd(seen[alone], full_matrices=False)
    return np.where(left[:, 0] < 0, -1.0, 1.0)


def _without_plane(relief: Array, seen: NDArray[np.bool_], nominal_mm: Array) -> Array:
    """(V, N) reliefs less the plane through each view's dots, which is that view's pose."""
    plane = np.c_[nominal_mm[:, :2], np.ones(len(nominal_mm))]
    out = np.zeros_like(relief)
    for row, values, mine in zip(out, relief, seen):
        fit, *_ = np.linalg.lstsq(plane[mine], values[mine], rcond=None)
        row[mine] = values[mine] - plane[mine] @ fit
    return out


def _flipped(state: State, views: Ints, camera: int) -> State:
    """Some views in their mirrored pose, as one camera sees it."""
    rig_from_camera = state.rig_from_camera[camera]
    mirror = rig_from_camera @ _D @ np.linalg.inv(rig_from_camera)
    poses = state.rig_from_target.copy()
    poses[views] = mirror @ poses[views] @ _D
    return replace(state, rig_from_target=poses)


def _with_views(state: State, other: State, views: Ints) -> State:
    poses = state.rig_from_target.copy()
    poses[views] = other.rig_from_target[views]
    return replace(state, rig_from_target=poses)


def _view_costs(problem: Problem, state: State) -> Array:
    """(V,) sum of squared residuals over each view."""
    obs = problem.observations()
    squares = (whitened_error(state, obs, problem.rho_mm) ** 2).sum(-1)
    return np.asarray(np.bincount(obs.view, squares, minlength=len(problem.views)), float)
