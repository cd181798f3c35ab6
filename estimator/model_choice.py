"""Which lens model the data support: fit each, predict views that were left out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.graph import solve
from telerig.estimator.problem import Problem, held_at_nominal
from telerig.factors.projection import Observations, State, whitened_error, whitened_residuals
from telerig.rig.pose import rotation_from_rotvec

Array = NDArray[np.float64]

LADDER = (
    "none", "radial", "tangential", "kappa", "kappa+radial", "kappa+tangential", "kappa+brown",
)  # fmt: skip
FOLDS = 4


@dataclass(frozen=True)
class Rung:
    """One model: its fit, its prediction of left-out views, and the words for the report.

    chi2_dof : of the fit.  held_out : mean squared whitened residual of left-out dots.
    per_view : (V,) of it.  rms_px : of the fit.
    """

    model: str
    parameters: int
    chi2_dof: float
    bic: float
    rms_px: float
    held_out: float
    per_view: Array
    state: State


def pose_only(problem: Problem, state: State, steps: int = 15) -> State:
    """Refine every view's pose with cameras and dots held: Gauss-Newton on 6 unknowns a view."""
    obs = problem.observations()
    views = state.rig_from_target.copy()
    for _ in range(steps):
        jac = whitened_residuals(replace(state, rig_from_target=views), obs, problem.rho_mm)
        normal = np.tile(1e-9 * np.eye(6), (len(views), 1, 1))
        right = np.zeros((len(views), 6))
        np.add.at(normal, obs.view, np.swapaxes(jac.by_view, -1, -2) @ jac.by_view)
        np.add.at(right, obs.view, -np.einsum("mij,mi->mj", jac.by_view, jac.value))
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

    The left-out view's own pose is fitted to it, with cameras and dots of the other views.
    """
    views = np.arange(len(problem.views))
    out = np.full(len(views), np.nan)
    for fold in range(folds):
        left_out = views[fold::folds]
        if len(left_out) == 0:
            continue
        mine = np.isin(problem.view, left_out)
        if len(views) - len(left_out) < 2:
            continue
        trained = solve(problem.subset(~mine), state, max_iterations=12, relative=1e-6).state
        trained = replace(trained, rig_from_target=state.rig_from_target)
        test = problem.subset(mine)
        fitted = pose_only(test, trained)
        obs = test.observations()
        squares = (whitened_error(fitted, obs, problem.rho_mm) ** 2).sum(-1)
        for v in left_out:
            if np.any(obs.view == v):
                out[v] = squares[obs.view == v].mean()
    return out


def climb(problem: Problem, start: State, models: tuple[str, ...] = LADDER) -> list[Rung]:
    """Fit every model of the ladder from one start and score it on held-out views."""
    rungs = []
    for model in models:
        candidate = problem.with_model(model)
        begin = held_at_nominal(candidate, start)
        solution = solve(candidate, begin, max_iterations=40, relative=1e-7)
        obs = candidate.observations()
        rungs.append(_rung(model, candidate, solution.state, solution.cost, obs))
    return rungs


def _rung(model: str, problem: Problem, state: State, cost: float, obs: Observations) -> Rung:
    per_view = held_out_chi2(problem, state)
    count = sum(len(f) for f in problem.free)
    error = whitened_error(state, obs, problem.rho_mm)
    sigma = np.sqrt(np.trace(problem.covariance_px2, axis1=-2, axis2=-1).mean() / 2)
    rows = error.size
    return Rung(
        model, count, 2 * cost / rows, float(2 * cost + count * np.log(rows)),
        float(np.sqrt((error**2).mean()) * sigma), float(np.nanmean(per_view)), per_view, state,
    )  # fmt: skip


def choose(rungs: list[Rung]) -> tuple[Rung, str]:
    """The lowest information criterion among the models that predict left-out views well.

    Well: not worse than the best predictor by more than two standard errors of the difference,
    paired by view, nor by more than 5 %.
    """
    best = min(rungs, key=lambda r: r.held_out)
    good = [r for r in rungs if r is best or _predicts_as_well(r, best)]
    chosen = min(good, key=lambda r: r.bic)
    return chosen, _words(chosen, rungs)


def _predicts_as_well(rung: Rung, best: Rung) -> bool:
    loss = rung.per_view - best.per_view
    loss = loss[np.isfinite(loss)]
    error = loss.std(ddof=1) / np.sqrt(len(loss)) if len(loss) > 1 else np.inf
    return bool(loss.mean() < 2 * error and loss.mean() < 0.05 * best.held_out)


def _words(chosen: Rung, rungs: list[Rung]) -> str:
    others = [r for r in rungs if r.parameters < chosen.parameters]
    if not others:
        return f"{chosen.model}: no richer model predicts left-out views better"
    nearest = min(others, key=lambda r: r.held_out)
    return (
        f"{chosen.model}: left-out views are predicted {nearest.held_out / chosen.held_out:.3g} "
        f"times better (mean square) than by {nearest.model}"
    )
