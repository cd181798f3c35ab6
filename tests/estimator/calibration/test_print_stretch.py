"""The stretch that all dots of a print share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from telerig.estimator.calibration.solver.print_stretch import (
    stretch_error,
    stretch_sigma,
    with_print_stretch,
)
from telerig.estimator.calibration.solver.problem import Problem, problem_from_dots
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.estimator.calibration.solver.system import Solution
from telerig.estimator.calibration.start import known_target


def solved(scene: Any, **changes: Any) -> tuple[Problem, Solution]:
    made = scene("paper", 5, views=6)
    problem = problem_from_dots(made.dots, made.cameras, made.target).with_model("radial")
    problem = replace(problem, **changes)
    return problem, solve(problem, known_target.stereo_states(problem, problem.nominal_mm)[0])


def test_without_a_distance_the_target_has_its_nominal_size(scene: Any) -> None:
    problem, solution = solved(scene, scale=None, stretch=3e-3)
    found, there = with_print_stretch(problem, solution)
    assert abs(found.stretch) < 0.05 * stretch_sigma(problem)
    assert there.cost <= solution.cost + 1e-6
    size = [np.linalg.norm(np.ptp(s.state.dots_mm, axis=0)) for s in (solution, there)]
    assert size[1] / size[0] == pytest.approx(1 / 1.003, rel=1e-5)
    dots = stretch_error(found, there)[there.gaussian.of_blocks]
    nominal = problem.nominal_mm - problem.middle_mm
    np.testing.assert_allclose(dots, stretch_sigma(problem) * nominal, atol=3e-4)


def test_a_distance_takes_its_share(scene: Any) -> None:
    """The mean of the distance's size and the nominal one, weighed by their variances."""
    problem, _ = solved(scene)
    assert problem.scale is not None
    (a, b), _, _ = problem.scale
    nominal = float(np.linalg.norm(problem.nominal_mm[a] - problem.nominal_mm[b]))
    sigma = 2 * stretch_sigma(problem)
    distance = ((a, b), nominal * (1 + 3 * sigma), nominal * sigma)
    found, there = with_print_stretch(*solved(scene, scale=distance))
    assert found.stretch == pytest.approx(3 * sigma / 5, rel=0.1)
    assert there.cost < solved(scene, scale=distance)[1].cost
