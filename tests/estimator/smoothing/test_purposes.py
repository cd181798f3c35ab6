"""What a run is good for: signals, standard deviations and grades."""

from __future__ import annotations

import numpy as np
import pytest
from shake_learning_data import SWING_HZ, run, true_model

from telerig.estimator.smoothing.graph.solve import Options, drawn, solve
from telerig.estimator.smoothing.verdict.purposes import grade_of, uses
from telerig.io.results.smoothing import Grade, Quantity


@pytest.mark.parametrize(
    ("sd", "grade"), [(1.0, Grade.GOOD), (3.0, Grade.LIMITED), (5.0, Grade.NO)]
)
def test_grades_are_signals_over_standard_deviations(sd: float, grade: Grade) -> None:
    assert grade_of(-10.0, sd) == grade


def test_an_unresolved_run_is_still_good_for_its_zigzag_and_mean_velocity() -> None:
    errors = []
    for seed in range(6):
        problem, lab, _ = run(np.random.default_rng(seed), seconds=1.5)
        solution = solve(problem, true_model(), Options(robust=False))
        found = {(u.quantity, u.axis): u for u in uses(solution, drawn(solution))}
        swings = [u for (quantity, _), u in found.items() if quantity == Quantity.ZIGZAG_FREQUENCY]
        assert {u.axis for u in swings} <= {"x", "z"} and swings
        for swing in swings:
            assert swing.value == pytest.approx(SWING_HZ, abs=0.8)
            assert swing.grade == Grade.GOOD
        assert found[Quantity.PATH, "x"].below_hz is not None
        rise = found[Quantity.MEAN_VELOCITY, "y"]
        true = (lab[0, -1, 1] - lab[0, 0, 1]) / problem.t_s[-1]
        assert rise.value is not None and rise.sd
        errors.append((rise.value - true) / rise.sd)
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 2


def test_nothing_is_good_where_measurements_disagree() -> None:
    problem, _, _ = run(np.random.default_rng(0))
    solution = solve(problem, true_model(), Options(robust=False))
    draws = drawn(solution)
    plain, wide = uses(solution, draws), uses(solution, draws, (2.0, 2.0, 2.0))
    assert Grade.GOOD in {u.grade for u in plain}
    assert Grade.GOOD not in {u.grade for u in wide}
    for a, b in zip(plain, wide):
        if a.quantity == Quantity.MEAN_VELOCITY:
            assert b.sd == pytest.approx(2 * (a.sd or 0))
