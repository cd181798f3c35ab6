"""A stretch that all dots of a print share: the priors on their places do not contain it.

A printer that feeds paper by 0.2 % too much errs for all dots alike, so that the places of many
dots tell the size of the target no better than one does. The stretch is a further variable, with
the standard deviation of a dot's place over the RMS distance of the dots from their middle. Only a
known distance tells its value; without one the target has its nominal size, as uncertain as that.

Images do not depend on the size of target and rig together. So the variable is eliminated last:
each step of it moves all others by their response to it (Schur complement of one variable), and a
step of Gauss and Newton follows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from telerig.arrays import Array
from telerig.estimator.calibration.solver.problem import HELD_MM, Problem
from telerig.estimator.calibration.solver.robust_least_squares import gaussian_at
from telerig.estimator.calibration.solver.system import Solution, System

_MOST_STEPS, _STOP_SD = 5, 1e-2
"""Number of steps, and the size of one, in standard deviations of the stretch, that ends them."""


def stretch_sigma(problem: Problem) -> float:
    """Return the standard deviation of the stretch before any distance is known."""
    plane = (problem.nominal_mm - problem.middle_mm)[:, :2]
    reach_mm = max(float(np.sqrt((plane**2).sum(-1).mean())), 1e-9)
    return float(problem.dot_sigma_mm[:, :2].min()) / reach_mm


def stretched_to_distance(problem: Problem) -> Problem:
    """Return the problem to start from: its nominal places agree with the known distance.

    Two dots that are pulled apart from all others would be taken for outliers.
    """
    if problem.scale is None or problem.dot_sigma_mm[:, :2].min() <= HELD_MM:
        return problem
    (a, b), distance_mm, _ = problem.scale
    nominal_mm = float(np.linalg.norm(problem.nominal_mm[a] - problem.nominal_mm[b]))
    return replace(problem, stretch=distance_mm / nominal_mm - 1)


def with_print_stretch(problem: Problem, solution: Solution) -> tuple[Problem, Solution]:
    """Return the problem with the most likely stretch of its nominal places, and its solution.

    A step that raises the cost, as in directions that hardly anything determines, is not taken.
    """
    for _ in range(_MOST_STEPS):
        slope, moved, information = _response(problem, solution)
        off = System(problem).priors(solution.state).dots[0]
        pull = -float((off * slope).sum()) - problem.stretch / stretch_sigma(problem) ** 2
        step = pull / information
        if abs(step) < _STOP_SD / np.sqrt(information):
            break
        further = replace(problem, stretch=problem.stretch + step)
        there = _stepped(further, solution, step * moved)
        refined = there and _stepped(further, there, there.gaussian.step()[0])
        best = min(filter(None, (there, refined)), key=lambda s: s.cost, default=None)
        if best is None or not _cost(further, best) < _cost(problem, solution):
            break
        problem, solution = further, best
    return problem, solution


def _stepped(problem: Problem, solution: Solution, step: Array) -> Solution | None:
    """Return the solution after a step (D,); None where a window would hide a dot."""
    system = System(problem)
    state = system.moved(solution.state, step)
    gaussian = gaussian_at(system, state)
    return None if gaussian is None else replace(solution, state=state, gaussian=gaussian)


def _cost(problem: Problem, solution: Solution) -> float:
    """Return the cost with that of the stretch itself."""
    return solution.cost + 0.5 * (problem.stretch / stretch_sigma(problem)) ** 2


def stretch_error(problem: Problem, solution: Solution) -> Array:
    """Return the error (D,) of all parameters that one standard deviation of the stretch causes."""
    _, moved, information = _response(problem, solution)
    return np.asarray(moved / np.sqrt(information))


def _response(problem: Problem, solution: Solution) -> tuple[Array, Array, float]:
    """Return how the priors' residuals (N, 3) change with the stretch, how all parameters (D,) move
    with it, and the information about it.

    A dot's deviation is stretched with the print: else a smaller target would have smaller ones,
    and seem more likely.
    """
    gaussian, (_, sigma) = solution.gaussian, problem.stretched_mm
    slope = -(solution.state.dots_mm - problem.middle_mm) / ((1 + problem.stretch) * sigma)
    right = np.zeros(len(gaussian.right))
    right[gaussian.of_blocks] = -slope / sigma
    moved, _ = replace(gaussian, right=right).step()
    known = float((slope**2).sum() - right @ moved)
    return slope, moved, max(known, 0.0) + 1 / stretch_sigma(problem) ** 2
