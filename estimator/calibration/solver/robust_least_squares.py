"""Solves a calibration by robust least squares: Levenberg-Marquardt iteration, a weight for each
dot, and a noise floor that covers errors of the model.

Each step is that of a `Gaussian`, of which GTSAM eliminates the dots, and NumPy if they are many.
The reasons for an iteration of our own are in docs/decisions/002 and 020.

GTSAM's robust noise models give one weight to a whole factor, which is a whole image here. A single
wrong dot would reduce the weight of all other dots of its image. Dots are therefore weighted one by
one (graduated non-convexity towards truncated least squares; Yang, Antonante, Tzoumas and Carlone,
RA-L 5:1127, 2020), and every weight is reported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from telerig.arrays import Array, Ints
from telerig.errors import CalibrationError, GeometryError
from telerig.estimator.calibration.solver.covariance import joint_covariance
from telerig.estimator.calibration.solver.gaussian import Gaussian
from telerig.estimator.calibration.solver.problem import Problem, on_a_line
from telerig.estimator.calibration.solver.system import Solution, System
from telerig.estimator.calibration.thresholds import LEAST_DOTS
from telerig.factors.calibration import State, pixels
from telerig.factors.robust_loss import calibration_weights, next_limit

LINEAR = 0.9
"""After a step that gains at least this share of its predicted gain, the damping falls a
thousandfold rather than tenfold."""
NEARLY_UNDAMPED = 1e-6
"""With less damping than this, the predicted gain of a step is what Gauss-Newton could still
gain."""
Progress = Callable[[int, float], None]


def solve(
    problem: Problem,
    start: State,
    *,
    max_iterations: int = 60,
    relative: float = 1e-11,
    progress: Progress | None = None,
) -> Solution:
    """Minimise the cost of a problem by Levenberg-Marquardt steps.

    relative : the iteration ends when a step lowers the cost by less than this share.
    Raises CalibrationError if the cost at the start is not finite, or if the measurements do not
    determine all parameters.
    """
    system = System(problem)
    point, gaussian = start, gaussian_at(system, start)
    if gaussian is None:
        raise CalibrationError(
            "the start values are impossible: no ray of a camera reaches some of the dots that it "
            "has measured",
            todo="check scale and image size of the cameras, and [walls], in rig.toml",
        )
    damping, iteration = 1e-4, 0
    for iteration in range(1, max_iterations + 1):
        cost = gaussian.cost
        step, promised = gaussian.step(damping)
        if promised <= relative * cost and damping <= NEARLY_UNDAMPED:
            break
        moved = system.moved(point, step)
        trial = gaussian_at(system, moved)
        if trial is not None and cost - trial.cost >= -1e-13 * cost:
            done = promised <= relative * cost and cost - trial.cost <= relative * cost
            as_promised = cost - trial.cost > LINEAR * promised
            point, gaussian = moved, trial
            damping = max(damping / (1000 if as_promised else 10), 1e-12)
            if progress is not None:
                progress(iteration, gaussian.cost)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e12:
                break
    return Solution(point, gaussian, iteration)


def gaussian_at(system: System, state: State) -> Gaussian | None:
    """Return the Gaussian, or None where the cost is not finite (a window hides a dot)."""
    try:
        gaussian = system.gaussian(state)
    except GeometryError:
        return None
    return gaussian if np.isfinite(gaussian.cost) else None


_MEDIAN = 2 * np.log(2)  # median of chi-square with two degrees of freedom


@dataclass(frozen=True)
class RobustFit:
    """The result of a robust fit.

    problem : the problem with the final weights and with covariances that contain the noise floor.
    floor_px : noise floor, the scatter of the dots beyond their image noise.
    """

    problem: Problem
    solution: Solution
    floor_px: float


def pixel_residuals(problem: Problem, state: State) -> Array:
    """Return the residuals (M, 2) in px of all measured dots, predicted minus measured.

    Dots that were left out of the fit are included.
    """
    observed = problem.unweighted()
    return pixels(state, observed, problem.rho_mm) - observed.uv_px


def squared_distance(residual_px: Array, covariance_px2: Array) -> Array:
    """Return squared Mahalanobis distances (M,) of residuals (M, 2) with covariances (M, 2, 2)."""
    solved = np.linalg.solve(covariance_px2, residual_px[..., None])[..., 0]
    return np.asarray((residual_px * solved).sum(-1))


def noise_floor_px(residual_px: Array, covariance_px2: Array, dof: float) -> float:
    """Return the noise floor: the standard deviation of scatter beyond the dots' image noise.

    It is taken as equal along u and v, and is 0 if it is not significant. It follows from the
    median of the squared distances, so up to half of the dots may be wrong.

    residual_px : (M, 2) residuals of all dots.
    covariance_px2 : (M, 2, 2) their image noise.
    dof : degrees of freedom of the residuals.
    """
    expected = _MEDIAN * max(dof, 1.0) / residual_px.size

    def excess(floor: float) -> float:
        covariance = covariance_px2 + floor**2 * np.eye(2)
        return float(np.median(squared_distance(residual_px, covariance)) / expected - 1)

    if excess(0.0) < 5 * 1.44 / np.sqrt(len(residual_px)):
        return 0.0
    from scipy.optimize import brentq

    top = 2 * float(np.abs(residual_px).max()) + 1e-9
    return float(brentq(excess, 0.0, top, xtol=1e-7)) if excess(top) < 0 else top


def robust_solve(
    problem: Problem, start: State, *, progress: Progress | None = None, rounds: int = 25
) -> RobustFit:
    """Fit a problem robustly, so that wrong dots have no influence.

    Each round solves the problem, estimates the noise floor, and reduces the weight of dots whose
    residual exceeds a limit. The limit is lowered to ``problem.outlier_sd``. The fit ends when the
    set of kept dots no longer changes, after ``rounds`` rounds at the latest.
    """
    base, least = problem.covariance_px2, problem.outlier_sd
    begin = _without_lost_views(problem, np.ones(len(problem.view)))
    problem, placed = replace(problem, weight=begin), begin > 0
    solution = solve(problem, start, progress=progress)
    dof = joint_covariance(problem, solution, whole=False).effective_dof
    limit, floor, rows = np.inf, 0.0, np.sum(problem.kept)
    for _ in range(rounds):
        residual = pixel_residuals(problem, solution.state)
        sound = problem.kept
        floor = noise_floor_px(residual[sound], base[sound], dof * np.sum(sound) / rows)
        covariance = base + floor**2 * np.eye(2)
        distance = np.sqrt(squared_distance(residual, covariance))
        worst = float(distance[placed].max())
        previous = problem
        limit = next_limit(limit, worst, least)
        weight = placed * calibration_weights(distance, problem.weight, limit, least)
        if limit == least:
            weight = _without_lost_views(problem, weight)
        problem = replace(problem, weight=weight, covariance_px2=covariance)
        unchanged = np.allclose(weight, previous.weight, rtol=1e-3) and np.allclose(
            covariance, previous.covariance_px2, rtol=1e-3
        )
        if limit == least and unchanged:
            break
        steps = 4 if limit > least else 60
        solution = solve(problem, solution.state, max_iterations=steps, progress=progress)
    return RobustFit(problem, solution, floor)


def _without_lost_views(problem: Problem, weight: Array) -> Array:
    """Return the weights with 0 for views that have too few kept dots; see `lost_views`."""
    lost = lost_views(problem, weight)
    return np.where(np.isin(problem.view, lost), 0.0, weight)


def lost_views(problem: Problem, weight: Array) -> Ints:
    """Return the indices of the views whose kept dots do not determine the pose of the target: they
    are fewer than `LEAST_DOTS`, or in one row.

    weight : (M,) weight of each measurement.
    """
    plane, kept = problem.nominal_mm[:, :2], weight > 0
    dots = [np.unique(problem.dot[kept & (problem.view == v)]) for v in range(len(problem.views))]
    lost = [len(some) < LEAST_DOTS or on_a_line(plane[some]) for some in dots]
    return np.flatnonzero(lost)
