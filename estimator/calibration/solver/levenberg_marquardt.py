"""Solves a calibration by Levenberg-Marquardt iteration.

GTSAM eliminates the factor graph of a calibration of usual size (`elimination.GraphEquations`). A
large calibration is solved by its Schur complement (`schur.NormalEquations`). Both use the same
whitened blocks. The reasons for an iteration of our own are in docs/decisions/002 and 020.
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
from telerig.estimator.calibration.solver.system import System
from telerig.factors.calibration import State

MANY_DOTS = 5000
"""With more measured dots than this, the Schur complement solves the problem
(docs/decisions/020)."""
MANY_PARAMETERS = 4000
"""With more parameters of views and dots than this, the full covariance matrix is too large."""
NEARLY_UNDAMPED = 1e-6
"""With less damping than this, the predicted gain of a step is what Gauss-Newton could still
gain."""
Progress = Callable[[int, float], None]
Equations = GraphEquations | NormalEquations


@dataclass(frozen=True)
class Solution:
    """Holds the state at the minimum.

    cost : half the sum of squared whitened residuals, including those of the priors.
    equations : the linearised equations at the state.
    """

    state: State
    cost: float
    iterations: int
    equations: Equations

    @property
    def information(self) -> Array:
        """The information matrix J^T J (D, D)."""
        return self.equations.information()


def is_large(problem: Problem) -> bool:
    """Return whether the Schur complement solves the problem rather than GTSAM
    (docs/decisions/020).
    """
    numbers = 6 * len(problem.views) + 3 * len(problem.dot_ids)
    return len(problem.view) > MANY_DOTS or numbers > MANY_PARAMETERS


def linearisation(problem: Problem) -> tuple[System, Callable[[State], Equations]]:
    """Return the problem's residuals, and a function that returns its linearised equations at a
    state.

    The equations are those of the solver that ``problem.solver`` asks for.
    """
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
    """Minimise the cost by Levenberg-Marquardt steps from a start.

    The damping has Marquardt's scaling. The iteration ends when a step gains less than ``relative``
    times the cost.

    Raises CalibrationError if the cost at the start is not finite, or if the measurements leave a
    direction of the calibration undetermined.
    """
    system, linearised = linearisation(problem)
    point, equations = start, _at(linearised, start)
    if equations is None:
        raise CalibrationError(
            "the cost at the start is not finite: a camera cannot see some of its dots at all",
            todo="check the cameras and windows in rig.toml",
        )
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
    return Solution(point, float(equations.cost), iteration, equations)


def _at(linearised: Callable[[State], Equations], state: State) -> Equations | None:
    """Return the equations at a state, or None if the cost is not finite there.

    The cost is not finite if a camera cannot see a dot through its window at all.
    """
    try:
        equations = linearised(state)
    except GeometryError:
        return None
    return equations if np.isfinite(equations.cost) else None
