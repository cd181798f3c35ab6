"""Levenberg-Marquardt over the elimination of a calibration's factor graph.

GTSAM eliminates the graph of a calibration of usual size (`elimination.GraphEquations`), the Schur
complement that of a large one (`schur.NormalEquations`); both read the same whitened blocks.
The loop is ours: see docs/decisions/002 and 020.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array
from telerig.errors import CalibrationError, GeometryError
from telerig.estimator.calibration.solver.elimination import GraphEquations, GraphLayout
from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.solver.schur import NormalEquations
from telerig.estimator.calibration.solver.system import System, slots
from telerig.factors.projection import State

MANY_DOTS = 5000
"""Measured dots above which arrays solve the problem; see docs/decisions/020."""
MANY_NUMBERS = 4000
"""Numbers of a calibration above which the covariance of all with all is too large."""
NEARLY_UNDAMPED = 1e-6
"""Marquardt damping below which a step promises what Gauss-Newton could still gain."""
Progress = Callable[[int, float], None]
Equations = GraphEquations | NormalEquations


@dataclass(frozen=True)
class Solution:
    """State at the minimum; ``cost`` = half the sum of squared whitened residuals and priors."""

    state: State
    cost: float
    iterations: int
    equations: Equations
    slots: dict[str, list[slice]]

    @property
    def information(self) -> Array:
        """(D, D) dense J^T J."""
        return self.equations.information()


def is_large(problem: Problem) -> bool:
    """Whether arrays solve the problem rather than GTSAM; see docs/decisions/020."""
    numbers = 6 * len(problem.views) + 3 * len(problem.dot_ids)
    return len(problem.view) > MANY_DOTS or numbers > MANY_NUMBERS


def linearisation(problem: Problem) -> tuple[System, Callable[[State], Equations]]:
    """The problem's residuals, and its equations at any state for the solver that it asks for."""
    system = System(problem)
    if problem.solver == "schur" or (problem.solver == "auto" and is_large(problem)):
        return system, lambda state: NormalEquations(system, state)
    layout = GraphLayout(system)
    return system, lambda state: GraphEquations(layout, state)


def solve(
    problem: Problem,
    start: State,
    *,
    max_iterations: int = 60,
    relative: float = 1e-11,
    progress: Progress | None = None,
) -> Solution:
    """Levenberg-Marquardt with Marquardt's scaling, until no more than ``relative`` can be gained.

    Raises CalibrationError when the cost is not finite at the start, or a direction undetermined.
    """
    system, linearised = linearisation(problem)
    point, equations = start, _at(linearised, start)
    if equations is None:
        raise CalibrationError("the starting point has no finite cost", todo="check rig.toml")
    damping, iteration = 1e-4, 0
    for iteration in range(1, max_iterations + 1):
        cost = equations.cost
        step, promised = equations.step(damping)
        if promised <= relative * cost and damping <= NEARLY_UNDAMPED:
            break
        moved = system.moved(point, step)
        trial = _at(linearised, moved)
        if trial is not None and cost - trial.cost >= -1e-13 * cost:
            done = promised <= relative * cost and cost - trial.cost <= relative * cost
            point, equations, damping = moved, trial, max(damping / 10, 1e-12)
            if progress is not None:
                progress(iteration, equations.cost)
            if done:
                break
        else:
            damping *= 10
            if damping > 1e12:
                break
    return Solution(point, float(equations.cost), iteration, equations, slots(problem))


def _at(linearised: Callable[[State], Equations], state: State) -> Equations | None:
    """None where the cost is not finite: a camera cannot see a dot through its window at all."""
    try:
        equations = linearised(state)
    except GeometryError:
        return None
    return equations if np.isfinite(equations.cost) else None
