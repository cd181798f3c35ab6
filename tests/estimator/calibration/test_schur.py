"""The array solver against the graph: same cost, information, steps and minimum."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from telerig.errors import CalibrationError
from telerig.estimator.calibration.solver import graph
from telerig.estimator.calibration.solver.array_system import ArraySystem
from telerig.estimator.calibration.solver.measurements import problem_from_dots
from telerig.estimator.calibration.solver.problem import Problem
from telerig.estimator.calibration.start import known_target
from telerig.factors.projection import State


def case(made: Any, model: str, **changes: Any) -> tuple[Problem, State]:
    problem = problem_from_dots(made.dots, made.cameras, made.target).with_model(model)
    problem = replace(problem, **changes)
    if len(made.cameras) == 1:
        return problem, known_target.mono_state(problem, problem.nominal_mm)
    return problem, known_target.stereo_states(problem, problem.nominal_mm)[0]


@pytest.fixture(
    scope="module", params=["brown", "weighted", "mono", "no scale", "plate", "view left out"]
)
def either(request: Any, scene: Any) -> tuple[Problem, State]:
    kind = request.param
    made = scene("two_sided" if kind == "plate" else "near_telecentric", 3, views=5)
    if kind == "mono":
        mine = made.dots["camera"] == "left"
        made = replace(made, dots=made.dots[mine], cameras=made.cameras[:1])
        return case(made, "tangential")
    if kind == "no scale":
        made = replace(made, target=replace(made.target, scale_dots=None))
    problem, state = case(made, "kappa+brown")
    rng = np.random.default_rng(0)
    if kind == "weighted":
        return replace(problem, weight=rng.uniform(0, 1, len(problem.view)) ** 2), state
    if kind == "plate":
        return replace(problem, plate_shift=rng.choice([-1.0, 0.0, 1.0], (5, 2))), state
    if kind == "view left out":
        return replace(problem, weight=(problem.view != 2).astype(float)), state
    return problem, state


def perturbed(problem: Problem, state: State) -> State:
    size = graph.slots(problem)["dots"][0].stop
    rng = np.random.default_rng(1)
    return ArraySystem(problem, state).moved(state, 1e-3 * rng.standard_normal(size))


def test_cost_information_and_gradient(either: tuple[Problem, State]) -> None:
    problem, start = either
    state = perturbed(problem, start)
    factors, values, keys = graph.build(problem, state)
    information, right = factors.linearize(values).hessian(graph._ordering(problem, keys))
    ours = ArraySystem(problem, state).linearised(state)
    assert ours.cost == pytest.approx(factors.error(values), rel=1e-12)
    length = np.sqrt(np.maximum(np.diag(information), 1e-30))
    difference = (ours.information() - information) / np.outer(length, length)
    assert np.abs(difference).max() < 1e-9
    mine = ours.right
    np.testing.assert_allclose(
        mine / length, right / length, atol=1e-9 * np.abs(right / length).max()
    )


@pytest.mark.parametrize("damping", [1e-8, 1e-3, 1.0])
def test_a_step_solves_the_damped_equations(damping: float, either: tuple[Problem, State]) -> None:
    problem, start = either
    ours = ArraySystem(problem, start).linearised(start)
    given = ours.right.copy()
    step, promised = ours.step(damping)
    np.testing.assert_array_equal(ours.right, given)
    dense = ours.information()
    if ours.distance is not None:
        size = ours.common
        undamped = np.r_[np.zeros(size), ours.distance]
        dense -= np.outer(undamped, undamped)
    untouched = np.diag(dense) == 0
    dense[np.diag_indices_from(dense)] *= 1 + damping
    dense[untouched, untouched] = 1
    if ours.distance is not None:
        dense += np.outer(undamped, undamped)
    right = ours.right
    scale = 1 / np.sqrt(np.diag(dense))
    expected = scale * np.linalg.solve(dense * scale[:, None] * scale, scale * right)
    np.testing.assert_allclose(
        step / scale, expected / scale, rtol=1e-5, atol=1e-7 * np.abs(expected / scale).max()
    )
    assert promised == pytest.approx(0.5 * step @ right)


def test_moves_are_gtsams_retraction_to_first_order(either: tuple[Problem, State]) -> None:
    problem, start = either
    system = ArraySystem(problem, start)
    graph_system = graph.GraphSystem(problem, start)
    size = graph.slots(problem)["dots"][0].stop
    step = 1e-5 * np.random.default_rng(2).standard_normal(size)
    mine = system.moved(start, step)
    theirs = graph_system.state(graph_system.moved(graph_system.first(), step))
    for name in ("intrinsics", "rig_from_camera", "rig_from_target", "dots_mm"):
        np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), atol=1e-8)
    assert isinstance(graph_system.first(), gtsam.Values)


@pytest.mark.parametrize("model", ["radial", "kappa+brown"])
def test_same_minimum(model: str, scene: Any) -> None:
    problem, start = case(scene("near_telecentric", 5), model)
    one, other = (graph.solve(replace(problem, solver=s), start) for s in ("gtsam", "schur"))
    assert one.cost == pytest.approx(other.cost, rel=1e-9)
    sd = np.sqrt(np.diag(np.linalg.inv(one.information)))
    place = graph.slots(problem)["dots"][0]
    moved = (other.state.dots_mm - one.state.dots_mm).ravel() / sd[place]
    assert np.abs(moved).max() < 1e-3
    length = np.sqrt(np.diag(one.information))
    same = (one.information - other.information) / np.outer(length, length)
    assert np.abs(same).max() < 1e-6


def test_auto_takes_the_array_solver_for_many_dots(scene: Any) -> None:
    small = case(scene("paper", 1), "radial")[0]
    assert not graph.is_large(small)
    large = case(scene("dense", 1, views=4), "radial")[0]
    assert graph.is_large(large)


def test_the_whole_calibration_with_either_solver(scene: Any) -> None:
    made = scene("paper", 2, outlier_share=0.05)
    one, other = (made.calibrate("radial", solver=s) for s in ("gtsam", "schur"))
    assert one.statistics["cost"] == pytest.approx(other.statistics["cost"], rel=1e-8)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-4, atol=1e-16)
    with pytest.raises(CalibrationError, match="unknown solver"):
        made.calibrate("radial", solver="ceres")


def test_all_of_a_dense_target(scene: Any) -> None:
    """400 dots in 6 views: 52 s with GTSAM's dense Hessian."""
    made = scene("dense", 2, views=6)
    calibration = made.calibrate("tangential")
    assert calibration.verdict["status"] == "GOOD"
    assert made.space_rms_um(calibration) < 0.6
    assert 0.9 < calibration.statistics["chi2_dof"] < 1.1
