"""The chain's elimination by arrays equals GTSAM's of the same factors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from shake_cases import SCENARIOS, generate
from shake_problem import problem, true_model

from telerig.estimator.smoothing.graph import chain, elimination
from telerig.estimator.smoothing.graph import solve as solving
from telerig.estimator.smoothing.graph.solve import Options, Solution, solve
from telerig.estimator.smoothing.problem.problem import Bubble, SmoothingProblem

FRAMES = 60
LIVES = ((0, 59), (0, 20), (21, 40), (35, 59), (44, 44))
"""The third may take the second's slot; the last lives for one frame."""


def cut(given: SmoothingProblem) -> SmoothingProblem:
    """Bubbles that come and go, one of them unseen for a while and by one camera to its end."""
    bubbles = tuple(
        Bubble(b.particle, first, last, b.start_mm, b.guess_mm[first : last + 1])
        for b, (first, last) in zip(given.bubbles, LIVES)
    )
    obs = given.observations
    lives = np.array(LIVES)[obs.item]
    keep = (obs.frame >= lives[:, 0]) & (obs.frame <= lives[:, 1])
    keep &= ~((obs.item == 0) & (obs.frame > 10) & (obs.frame < 18))
    keep &= ~((obs.item == 1) & (obs.frame > 0) & (obs.camera == 1))
    return replace(given, bubbles=bubbles, observations=obs.of(keep))


def scene(information: str) -> tuple[SmoothingProblem, Any]:
    scenario = replace(SCENARIOS["S2"], frames=FRAMES)
    runs = generate(scenario, 1, np.random.default_rng(4))
    given = problem(scenario, information, runs)
    model = true_model(scenario, information)
    if information == "references":  # bilinear: the scale is a variable that every frame has
        return given, replace(model, encoder_scale_sigma=1e-3)
    return cut(given), model


def both(monkeypatch: pytest.MonkeyPatch, information: str) -> tuple[Solution, Solution]:
    given, model = scene(information)
    by_arrays = solve(given, model, Options(passes=3))
    monkeypatch.setattr(chain, "is_chain_of_frames", lambda frame: False)
    return by_arrays, solve(given, model, Options(passes=3))


@pytest.mark.parametrize("information", ["five", "references"])
def test_states_covariances_and_evidence_equal_gtsams(
    monkeypatch: pytest.MonkeyPatch, information: str
) -> None:
    found, expected = both(monkeypatch, information)
    assert found.log_evidence == pytest.approx(expected.log_evidence, abs=1e-6)
    for name, value in vars(expected.state).items():
        scale = np.abs(value).max(0, initial=1e-9)
        assert np.all(np.abs(getattr(found.state, name) - value) <= 1e-7 * scale), name
    assert found.covariances is not None and expected.covariances is not None
    for name, value in vars(expected.covariances).items():
        got = getattr(found.covariances, name)
        assert got.shape == value.shape, name
        if name != "cross" and value.size:
            sigma = np.sqrt(np.diagonal(value, axis1=-2, axis2=-1))
            unit = sigma[..., :, None] * sigma[..., None, :]
            assert np.all(np.abs(got - value) <= 1e-6 * unit), name
    assert np.abs(found.covariances.cross - expected.covariances.cross).max() <= (
        1e-7 * np.abs(expected.covariances.cross).max()
    )


def test_the_chain_is_taken_where_only_frames_have_states(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError("GTSAM was asked")

    monkeypatch.setattr(elimination, "eliminate", refuse)
    solve(*scene("five"))
    with pytest.raises(AssertionError, match="GTSAM was asked"):
        sensed = replace(SCENARIOS["S2"], frames=FRAMES)
        runs = generate(sensed, 1, np.random.default_rng(4))
        solve(problem(sensed, "arms", runs), true_model(sensed, "arms"))


def test_what_cholesky_refuses_goes_to_qr(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = solve(*scene("five"))
    asked = []

    def refuse(*_: Any) -> Any:
        raise np.linalg.LinAlgError("frame 3")

    def by_gtsam(*given: Any, cholesky: bool) -> Any:
        asked.append(cholesky)
        return of_gtsam(*given, cholesky=cholesky)

    of_gtsam = elimination.eliminate
    monkeypatch.setattr(chain, "eliminate", refuse)
    monkeypatch.setattr(elimination, "eliminate", by_gtsam)
    found = solve(*scene("five"))
    assert asked and not any(asked)
    assert np.allclose(found.state.bubbles, expected.state.bubbles, rtol=1e-7, atol=1e-7)


def test_a_chain_without_pivots_is_named(rng: np.random.Generator) -> None:
    graph = solving.graph_layout(*scene("five"), np.zeros(0))
    places = chain.places_of(graph)
    count, width = len(graph.nodes.t_s), places.width
    equations = chain.NormalEquations(
        np.tile(-np.eye(width), (count, 1, 1)),
        rng.normal(size=(count, 1 + places.constants + width, width)),
        np.eye(places.constants, places.constants + 1),
    )
    with pytest.raises(np.linalg.LinAlgError, match="frame 0"):
        chain.eliminate(places, equations)


def test_a_chain_that_keeps_too_few_digits_is_refused() -> None:
    graph = solving.graph_layout(*scene("five"), np.zeros(0))
    places = chain.places_of(graph)
    count, width, constants = len(graph.nodes.t_s), places.width, places.constants
    joined = np.zeros((count, 1 + constants + width, width))
    joined[0, 1 + constants :] = np.sqrt(1 - 1e-12) * np.eye(width)
    own = np.tile(np.eye(width), (count, 1, 1))
    equations = chain.NormalEquations(own, joined, np.eye(constants, constants + 1))
    with pytest.raises(np.linalg.LinAlgError, match="digits"):
        chain.eliminate(places, equations)


def test_slots_are_shared_by_bubbles_that_do_not_meet() -> None:
    graph = solving.graph_layout(*scene("five"), np.zeros(0))
    places = chain.places_of(graph)
    taken = set(zip(graph.node_of_row.tolist(), places.slot.tolist()))
    assert len(taken) == graph.rows
    assert places.slot.max() == 2


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
