"""Which lens model the data support: fit each, predict views that were left out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.graph import solve
from telerig.estimator.model_start import model_start
from telerig.estimator.problem import Problem
from telerig.factors.image_blocks import view_gram
from telerig.factors.image_rows import in_chunks
from telerig.factors.projection import State, pixels, whitened_error
from telerig.io.parallel import ordered_map, quick_workers
from telerig.rig.pose import rotation_from_rotvec

Array = NDArray[np.float64]
Fit = tuple[str, Problem, State, float]

LADDER = (
    "none", "radial", "tangential", "kappa", "kappa+radial", "kappa+tangential", "kappa+brown",
    "affine+radial", "tilt+radial",
)  # fmt: skip
FOLDS = 4
HOPELESS = 10.0
FOLD_COST = 1e-4
"""Relative change of cost that ends a fold's fit: a model must predict 5 % better to matter."""


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
        trained = solve(problem.subset(~mine), state, max_iterations=12, relative=FOLD_COST).state
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
    """Fit every model of the ladder from one start; score those that fit on held-out views.

    A model whose own fit is `HOPELESS` times worse than the best is not asked to predict: its
    ``held_out`` is infinite.
    """
    # a copy of a process in which GTSAM has worked may wait for threads that it does not have
    workers = 1 if problem.solver == "gtsam" else quick_workers(len(models))
    fits = list(ordered_map(partial(_fit, problem, start), models, workers))
    best = min(cost for *_, cost in fits)
    return list(ordered_map(partial(_rung, best), fits, workers))


def _fit(problem: Problem, start: State, model: str) -> Fit:
    candidate = problem.with_model(model)
    begin = model_start(candidate, start)
    solution = solve(candidate, begin, max_iterations=40, relative=1e-7)
    return model, candidate, solution.state, solution.cost


def _rung(best: float, fit: Fit) -> Rung:
    model, problem, state, cost = fit
    obs = problem.observations()
    views = len(problem.views)
    predict = cost < HOPELESS * best
    per_view = held_out_chi2(problem, state) if predict else np.full(views, np.inf)
    count = sum(len(f) for f in problem.free)
    rows = 2 * len(obs)
    residual = pixels(state, obs, problem.rho_mm) - obs.uv_px
    finite = per_view[~np.isnan(per_view)]
    return Rung(
        model, count, 2 * cost / rows, float(2 * cost + count * np.log(rows)),
        float(np.sqrt((residual**2).mean())), float(finite.mean()) if len(finite) else np.inf,
        per_view, state,
    )  # fmt: skip


def choose(rungs: list[Rung]) -> tuple[Rung, str]:
    """The lowest information criterion among the models that predict left-out views well.

    Well: not worse than the best predictor by more than two standard errors of the difference,
    paired by view, nor by more than 5 %. With too few views to leave any out, the criterion alone.
    """
    if not np.isfinite([r.held_out for r in rungs]).any():
        chosen = min(rungs, key=lambda r: r.bic)
        return chosen, f"{chosen.model}: lowest information criterion; too few views to leave out"
    best = min(rungs, key=lambda r: r.held_out)
    good = [r for r in rungs if r is best or _predicts_as_well(r, best)]
    chosen = min(good, key=lambda r: r.bic)
    return chosen, _words(chosen, rungs)


def _predicts_as_well(rung: Rung, best: Rung) -> bool:
    if not np.isfinite(rung.held_out):
        return False
    loss = rung.per_view - best.per_view
    loss = loss[np.isfinite(loss)]
    error = loss.std(ddof=1) / np.sqrt(len(loss)) if len(loss) > 1 else np.inf
    return bool(loss.mean() < 2 * error and loss.mean() < 0.05 * best.held_out)


def _words(chosen: Rung, rungs: list[Rung]) -> str:
    simpler = [r for r in rungs if r.parameters < chosen.parameters and np.isfinite(r.held_out)]
    words = f"{chosen.model}: no richer model predicts left-out views better"
    if simpler:
        nearest = min(simpler, key=lambda r: r.held_out)
        words = (
            f"{chosen.model}: left-out views are predicted "
            f"{nearest.held_out / chosen.held_out:.3g} times better (mean square) than by "
            f"{nearest.model}"
        )
    without = [r for r in rungs if "kappa" not in r.model]
    if "kappa" in chosen.model and without:
        nearest = min(without, key=lambda r: r.rms_px)
        words += (
            f"; kappa = 0 is rejected: the scale changes with depth, and the best model without "
            f"it ({nearest.model}) leaves {nearest.rms_px:.3g} px RMS against {chosen.rms_px:.3g}"
        )
    return words
