"""Many bubbles, solved by conjugate gradients, against the joint graph of the same run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shake_problem
from numpy.typing import NDArray
from shake_cases import SCENARIOS, generate
from shake_learning_data import run, true_model, with_comings_and_goings

from telerig.estimator.smoothing.graph import crowd
from telerig.estimator.smoothing.graph.solve import Options, Solution, drawn, solve
from telerig.estimator.smoothing.problem.problem import Bubble, ShakeModel, SmoothingProblem

Array = NDArray[np.float64]


def _both(
    problem: SmoothingProblem, model: ShakeModel, monkeypatch: pytest.MonkeyPatch
) -> tuple[Solution, Solution]:
    """The solution of the joint graph, and that of the crowd."""
    monkeypatch.setattr(crowd, "jointly", lambda _: True)
    joint = solve(problem, model)
    monkeypatch.setattr(crowd, "jointly", lambda _: False)
    return joint, solve(problem, model)


def _sigma(solution: Solution, rows: Array) -> Array:
    found = solution.covariances
    assert found is not None
    return np.asarray(np.sqrt(np.einsum("id,nde,ie->ni", rows, found.bubbles, rows, optimize=True)))


def _compare(joint: Solution, found: Solution, spread: float) -> None:
    """Estimates alike to a hundredth of their standard deviations, and these to ``spread``."""
    assert joint.covariances is not None
    assert found.covariances is not None
    for rows in (joint.graph.bubble.position, joint.graph.bubble.velocity):
        sigma = _sigma(joint, rows)
        off = (found.state.bubbles - joint.state.bubbles) @ rows.T
        assert np.max(np.abs(off) / sigma) < 0.01
        ratio = _sigma(found, rows) / sigma
        np.testing.assert_allclose(np.median(ratio, axis=0), 1, atol=spread / 2)
        np.testing.assert_allclose(ratio, 1, atol=spread)
    offset = joint.graph.shake.offset[:-1]
    if not offset.size:
        return
    each = [np.einsum("cid,fde,cie->fci", offset, s.covariances.shake, offset, optimize=True)
            for s in (joint, found) if s.covariances is not None]  # fmt: skip
    moving = each[0] > 1e-12
    np.testing.assert_allclose(np.sqrt(each[1][moving] / each[0][moving]), 1, atol=spread)


def test_bubbles_that_are_all_seen_all_the_time_are_solved_exactly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem, *_ = run(np.random.default_rng(1), bubbles=20, seconds=0.3)
    joint, found = _both(problem, true_model(), monkeypatch)
    _compare(joint, found, 1e-4)
    assert found.log_evidence == pytest.approx(joint.log_evidence, abs=1e-3)
    assert found.covariances is not None
    assert joint.covariances is not None
    one, other = joint.covariances, found.covariances
    np.testing.assert_allclose(other.means, one.means, atol=1e-4 * np.abs(one.means).max())


def test_where_bubbles_come_and_go_the_estimates_are_those_of_the_joint_graph(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(2)
    problem, *_ = run(rng, bubbles=20, seconds=0.4, kept=0.9)
    cut = with_comings_and_goings(problem, rng, 40)
    assert len(cut.bubbles) > 30
    joint, found = _both(cut, true_model(), monkeypatch)
    _compare(joint, found, 0.06)
    assert found.log_evidence == pytest.approx(joint.log_evidence, abs=3)


def test_times_without_any_bubble_are_bridged(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    problem, *_ = run(rng, bubbles=6, seconds=0.3)
    parts = []
    for bubble in problem.bubbles:
        first, last = (0, 24) if bubble.particle < 3 else (30, 59)
        guess = bubble.guess_mm[first : last + 1]
        parts.append(Bubble(bubble.particle, first, last, guess[0], guess))
    seen = problem.observations
    early = seen.item < 3
    inside = np.where(early, seen.frame <= 24, seen.frame >= 30)
    cut = replace(problem, bubbles=tuple(parts), observations=seen.of(inside))
    joint, found = _both(cut, true_model(), monkeypatch)
    _compare(joint, found, 0.03)


def test_a_rig_that_does_not_shake_has_a_crowd_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, *_ = run(np.random.default_rng(3), bubbles=4, seconds=0.2)
    joint, found = _both(problem, replace(true_model(), modes=()), monkeypatch)
    _compare(joint, found, 1e-4)


@pytest.mark.parametrize("information", ["arms", "references"])
def test_sensors_and_marks_join_the_crowd(
    information: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = replace(SCENARIOS["S2"], frames=60)
    runs = generate(scenario, 1, np.random.default_rng(5))
    five = shake_problem.problem(scenario, "five", runs)
    sensors = shake_problem.problem(scenario, information, runs)
    problem = replace(sensors, bubbles=five.bubbles, observations=five.observations)
    model = shake_problem.true_model(scenario, information)
    if information == "references":  # its variance is far below what the gradients leave of others
        model = replace(model, encoder_scale_sigma=1e-3)
    joint, found = _both(problem, model, monkeypatch)
    _compare(joint, found, 0.02)
    assert joint.covariances is not None
    assert found.covariances is not None
    for name in ("sensors", "marks", "clocks"):
        one, other = (getattr(s.covariances, name) for s in (joint, found))
        np.testing.assert_allclose(other, one, atol=0.02 * np.abs(one).max(initial=0.0))
    if information == "references":
        parts = [s.covariances.by_scale for s in (joint, found) if s.covariances is not None]
        assert parts[0] is not None and parts[1] is not None
        np.testing.assert_allclose(parts[1], parts[0], rtol=0.02, atol=0.01 * parts[0].max())


def test_draws_of_a_crowds_errors_have_the_spread_that_it_states() -> None:
    rng = np.random.default_rng(4)
    problem, *_ = run(rng, bubbles=12, seconds=0.3)
    cut = with_comings_and_goings(problem, rng, 40)
    found = solve(cut, true_model(), Options(draws=True))
    draws, anew = found.draws, drawn(replace(found, draws=None))
    assert draws is not None
    assert drawn(found) is draws
    assert not crowd.jointly(found.graph)
    rows = found.graph.bubble.position
    each = found.graph.bubbles_moved(draws.of_family(found.graph, "bubbles")[..., 0]) @ rows.T
    assert 0.7 < np.sqrt(np.mean((each / _sigma(found, rows)) ** 2)) < 1.3
    np.testing.assert_allclose(anew.errors, draws.errors, atol=1e-4 * np.abs(draws.errors).max())
    np.testing.assert_allclose(anew.pixels, draws.pixels, atol=0.02)


def test_a_start_far_from_the_solution_takes_no_more_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run of eight bubbles began 3e12 standard deviations away, and ended with an error."""
    problem, *_ = run(np.random.default_rng(6), bubbles=12, seconds=0.3)
    made = []
    true = crowd.eliminate_crowd

    def kept(*given: Any, **named: Any) -> crowd.EliminatedCrowd:
        made.append(true(*given, **named))
        return made[-1]

    monkeypatch.setattr(crowd, "eliminate_crowd", kept)
    cut = with_comings_and_goings(problem, np.random.default_rng(7), 40)
    graph = solve(cut, true_model(), Options(covariances=False)).graph
    size = sum(n * d for n, d in graph.counts())
    side = np.random.default_rng(8).standard_normal((size, 1))
    schur, steps = crowd.EliminatedCrowd._schur, list[Array]()
    monkeypatch.setattr(
        crowd.EliminatedCrowd, "_schur", lambda self, way: steps.append(way) or schur(self, way)
    )
    near, far = made[-1].solved(side), made[-1].solved(1e14 * side)
    assert len(steps) < 20
    np.testing.assert_allclose(far / 1e14, near, atol=1e-4 * np.abs(near).max())
