"""The GTSAM factor graph of a self-calibration, and Levenberg-Marquardt over it.

The loop is ours (GTSAM copies all values for every Python callback when its own optimizer owns
the loop, see docs/decisions/002), the graph, its linearisation and its variables are GTSAM's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from telerig.errors import CalibrationError, GeometryError
from telerig.estimator.calibration.solver.array_system import ArraySystem
from telerig.estimator.calibration.solver.normal_equations import NormalEquations
from telerig.estimator.calibration.solver.problem import (
    GAUGE_SIGMA_MM,
    Problem,
    parameter_unit,
    prior_sigma,
)
from telerig.estimator.calibration.solver.schur import Posterior
from telerig.factors.priors import (
    custom_factor,
    depth_gauge_residual,
    diagonal_prior,
    distance_residual,
)
from telerig.factors.projection import ImageFactors, ImageKeys, State, state_from_values

Array = NDArray[np.float64]
MANY_DOTS, MANY_VIEWS = 50, 100
NEARLY_UNDAMPED = 1e-6
"""Marquardt damping below which a step promises what Gauss-Newton could still gain."""
Progress = Callable[[int, float], None]


@dataclass(frozen=True)
class DenseEquations:
    """J^T J and -J^T r of the whole graph.

    common : how many numbers come before the dots.
    """

    matrix: Array
    gradient: Array
    common: int

    def information(self) -> Array:
        return self.matrix

    def step(self, damping: float) -> tuple[Array, float]:
        """Damped step, and the decrease of the cost that it promises."""
        return _damped_step(self.matrix, self.gradient, damping)

    def posterior(self, whole: bool) -> Posterior:
        """The inverse of J^T J, equilibrated before it is factorised; all of it in any case.

        Raises CalibrationError when it is singular to working precision.
        """
        del whole
        untouched = np.diag(self.matrix) <= 0
        matrix = self.matrix + np.diag(untouched.astype(float))
        scale = 1 / np.sqrt(np.diag(matrix))
        try:
            factor = cho_factor(matrix * scale[:, None] * scale)
        except np.linalg.LinAlgError as error:
            raise CalibrationError(
                "the measurements leave a direction of the calibration undetermined",
                todo="add views with other tilts, or fix the model with --model",
            ) from error
        inverse = cho_solve(factor, np.eye(len(scale))) * scale[:, None] * scale
        return Posterior.of(inverse, self.common, untouched)


@dataclass(frozen=True)
class Solution:
    """State at the minimum; ``cost`` = half the sum of squared whitened residuals and priors."""

    state: State
    cost: float
    iterations: int
    equations: DenseEquations | NormalEquations
    slots: dict[str, list[slice]]

    @property
    def information(self) -> Array:
        """(D, D) dense J^T J."""
        return self.equations.information()


def build(problem: Problem, start: State) -> tuple[Any, Any, ImageKeys]:
    """(gtsam.NonlinearFactorGraph, gtsam.Values, keys) of a problem at a starting state."""
    import gtsam

    keys = problem.keys()
    graph = gtsam.NonlinearFactorGraph()
    images = ImageFactors(problem.observations(), keys, start, problem.rho_mm)
    for factor in images.graph_factors():
        graph.add(factor)
    sigma = np.broadcast_to(problem.dot_sigma_mm, problem.nominal_mm.shape)
    graph.add(diagonal_prior(keys.dots, problem.nominal_mm.ravel(), sigma.ravel()))
    if problem.scale is not None:
        graph.add(_distance_factor(keys.dots, problem.nominal_mm.size, problem.scale))
    for c in range(len(problem.cameras)):
        _add_camera(graph, problem, keys, start, c)
    for factor in _view_priors(problem, keys):
        graph.add(factor)
    return graph, _values(problem, start, keys), keys


def _values(problem: Problem, start: State, keys: ImageKeys) -> Any:
    import gtsam

    values = gtsam.Values()
    for key, view in zip(keys.view, start.rig_from_target):
        values.insert(key, gtsam.Pose3(view))
    for c in range(len(problem.cameras)):
        if len(keys.free[c]):
            values.insert(keys.intrinsics[c], np.zeros(len(keys.free[c])))
        if c:
            values.insert(keys.camera[c], gtsam.Pose3(start.rig_from_camera[c]))
    values.insert(keys.dots, start.dots_mm.ravel())
    return values


def _distance_factor(key: int, size: int, scale: tuple[tuple[int, int], float, float]) -> Any:
    pair, distance, sigma = scale

    def residual(values: Any) -> tuple[Array, list[Array]]:
        value, jac = distance_residual(values.atVector(key).reshape(-1, 3), pair, distance, sigma)
        return value, [jac]

    return custom_factor([key], 1, [size], residual)


def _add_camera(graph: Any, problem: Problem, keys: ImageKeys, start: State, c: int) -> None:
    free = keys.free[c]
    if len(free):
        nominal = problem.cameras[c]
        unit = parameter_unit(nominal)[free]
        mean = (nominal.intrinsics - start.intrinsics[c])[free] / unit
        graph.add(diagonal_prior(keys.intrinsics[c], mean, prior_sigma(nominal)[free] / unit))
    if c:
        key = keys.camera[c]

        def residual(values: Any) -> tuple[Array, list[Array]]:
            value, jac = depth_gauge_residual(values.atPose3(key).matrix(), GAUGE_SIGMA_MM)
            return value, [jac]

        graph.add(custom_factor([key], 2, [6], residual))


def _view_priors(problem: Problem, keys: ImageKeys) -> list[Any]:
    """A loose prior on each view's place: bounds the depth that a single camera cannot see."""
    import gtsam

    noise = gtsam.noiseModel.Isotropic.Sigma(3, 10 * max(problem.rho_mm))
    return [gtsam.PoseTranslationPrior3D(key, gtsam.Pose3(), noise) for key in keys.view]


def slots(problem: Problem) -> dict[str, list[slice]]:
    """Where each variable's components stand in the information matrix."""
    out: dict[str, list[slice]] = {"intrinsics": [], "camera": [], "view": [], "dots": []}
    at = 0
    sizes = [("intrinsics", len(f)) for f in problem.free]
    sizes += [("camera", 0 if c == 0 else 6) for c in range(len(problem.cameras))]
    sizes += [("view", 6)] * len(problem.views) + [("dots", problem.nominal_mm.size)]
    for name, size in sizes:
        out[name].append(slice(at, at + size))
        at += size
    return out


def _ordering(problem: Problem, keys: ImageKeys) -> Any:
    import gtsam

    ordering = gtsam.Ordering()
    for c in range(len(problem.cameras)):
        if len(keys.free[c]):
            ordering.push_back(keys.intrinsics[c])
    for c in range(1, len(problem.cameras)):
        ordering.push_back(keys.camera[c])
    for key in (*keys.view, keys.dots):
        ordering.push_back(key)
    return ordering


class GraphSystem:
    """A problem as GTSAM's graph; points are `gtsam.Values`."""

    def __init__(self, problem: Problem, start: State) -> None:
        self.problem, self.start = problem, start
        self.graph, self.values, self.keys = build(problem, start)
        self.ordering = _ordering(problem, self.keys)

    def first(self) -> Any:
        return self.values

    def cost(self, values: Any) -> float:
        return float(self.graph.error(values))

    def linearised(self, values: Any) -> DenseEquations:
        matrix, gradient = self.graph.linearize(values).hessian(self.ordering)
        return DenseEquations(matrix, gradient, slots(self.problem)["dots"][0].start)

    def moved(self, values: Any, step: Array) -> Any:
        return values.retract(_vector_values(step, self.keys, self.problem))

    def state(self, values: Any) -> State:
        return state_from_values(values, self.keys, self.start)


def is_large(problem: Problem) -> bool:
    """Whether the graph's dense Hessian would be what costs; see docs/decisions/002."""
    return len(problem.dot_ids) > MANY_DOTS or len(problem.views) > MANY_VIEWS


def solve(
    problem: Problem,
    start: State,
    *,
    max_iterations: int = 60,
    relative: float = 1e-11,
    progress: Progress | None = None,
) -> Solution:
    """Levenberg-Marquardt with Marquardt's scaling, until no more than ``relative`` can be gained.

    On GTSAM's graph, or for large problems (``problem.solver`` "auto") on the same normal
    equations with the dots eliminated.

    Raises CalibrationError when the cost is not finite at the start.
    """
    schur = problem.solver == "schur" or (problem.solver == "auto" and is_large(problem))
    system: Any = ArraySystem(problem, start) if schur else GraphSystem(problem, start)
    point = system.first()
    cost = _cost(system, point)
    if not np.isfinite(cost):
        raise CalibrationError("the starting point has no finite cost", todo="check rig.toml")
    damping, iteration = 1e-4, 0
    equations = system.linearised(point)
    for iteration in range(1, max_iterations + 1):
        step, promised = equations.step(damping)
        if promised <= relative * cost and damping <= NEARLY_UNDAMPED:
            break
        trial = system.moved(point, step)
        trial_cost = _cost(system, trial)
        gained = cost - trial_cost
        if np.isfinite(trial_cost) and gained >= -1e-13 * cost:
            done = promised <= relative * cost and gained <= relative * cost
            point, cost, damping = trial, trial_cost, max(damping / 10, 1e-12)
            equations = system.linearised(point)
            if progress is not None:
                progress(iteration, cost)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e12:
                break
    return Solution(system.state(point), float(cost), iteration, equations, slots(problem))


def _cost(system: Any, point: Any) -> float:
    """Infinite where a camera cannot see a dot through its wall at all: a step too far."""
    try:
        return float(system.cost(point))
    except GeometryError:
        return float("inf")


def _damped_step(information: Array, gradient: Array, damping: float) -> tuple[Array, float]:
    diagonal = np.diag(information)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    equilibrated = information * scale[:, None] * scale
    # a variable that no measurement touches (a view left out) stays where it is
    equilibrated[np.diag_indices_from(equilibrated)] += np.where(diagonal > 0, damping, 1.0)
    scaled = gradient * scale
    step = cho_solve(cho_factor(equilibrated, check_finite=False), scaled, check_finite=False)
    return step * scale, float(0.5 * step @ scaled)


def _vector_values(step: Array, keys: ImageKeys, problem: Problem) -> Any:
    import gtsam

    out = gtsam.VectorValues()
    place = slots(problem)
    for c in range(len(problem.cameras)):
        if len(keys.free[c]):
            out.insert(keys.intrinsics[c], step[place["intrinsics"][c]])
        if c:
            out.insert(keys.camera[c], step[place["camera"][c]])
    for key, where in zip(keys.view, place["view"]):
        out.insert(key, step[where])
    out.insert(keys.dots, step[place["dots"][0]])
    return out
