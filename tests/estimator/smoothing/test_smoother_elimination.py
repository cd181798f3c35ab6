"""GTSAM's elimination of the graph, and the covariances from it, against dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shake_cases import SCENARIOS, generate
from shake_problem import problem, true_model

from telerig.arrays import Array
from telerig.estimator.smoothing.graph import elimination
from telerig.estimator.smoothing.graph.elimination import EliminatedGraph, eliminate
from telerig.estimator.smoothing.graph.layout import GraphLayout, first_guess, graph_layout
from telerig.estimator.smoothing.graph.linear import all_factors
from telerig.estimator.smoothing.problem.problem import Bubble, SmoothingProblem
from telerig.factors.linear_factors import LinearFactors

FRAMES = 60
LIVES = ((0, 59), (0, 20), (21, 40), (35, 59), (44, 44))


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


def linearised(information: str, *, shake: bool = True) -> tuple[GraphLayout, list[LinearFactors]]:
    scenario = replace(SCENARIOS["S2"], frames=FRAMES)
    given = problem(scenario, information, generate(scenario, 1, np.random.default_rng(4)))
    model = true_model(scenario, information)
    if information == "references":  # bilinear: the scale is a variable that every frame has
        model = replace(model, encoder_scale_sigma=1e-3)
    else:
        given = cut(given)
    if not shake:
        model = replace(model, modes=())
    graph = graph_layout(given, model, np.zeros(0))
    weights = np.ones(len(given.observations)), np.ones(len(given.references))
    return graph, all_factors(graph, first_guess(graph), weights)


def dense(graph: GraphLayout, factors: list[LinearFactors]) -> tuple[Array, Array, float, Array]:
    """Solution, covariance, log |R| and first columns of the keys, from one dense matrix."""
    starts = np.r_[0, np.cumsum([d for n, d in graph.counts() for _ in range(n)])]
    rows, right = [np.zeros((0, starts[-1]))], [np.zeros(0)]
    for linear in factors:
        count, height = linear.rhs.shape
        whole = np.zeros((count, height, starts[-1]))
        for key, block in zip(linear.keys, linear.blocks):
            for m, k in enumerate(np.broadcast_to(np.asarray(key), (count,))):
                each = np.broadcast_to(block, (count, *block.shape[-2:]))[m]
                whole[m, :, starts[k] : starts[k] + block.shape[-1]] += each
        rows.append(whole.reshape(-1, starts[-1]))
        right.append(linear.rhs.ravel())
    matrix, values = np.concatenate(rows), np.concatenate(right)
    q, r = np.linalg.qr(matrix)
    inverse = np.linalg.inv(r)
    log_det = float(np.log(np.abs(np.diagonal(r))).sum())
    return inverse @ (q.T @ values), inverse @ inverse.T, log_det, starts


@pytest.mark.parametrize(
    ("information", "shake", "cholesky"),
    [("five", True, True), ("five", False, False), ("references", True, False)],
)
def test_solution_and_covariances_equal_dense_algebra(
    information: str, shake: bool, cholesky: bool
) -> None:
    graph, factors = linearised(information, shake=shake)
    found = eliminate(graph, factors, cholesky=cholesky)
    solution, covariance, log_det, starts = dense(graph, factors)
    np.testing.assert_allclose(found.vector, solution, atol=1e-6 * np.abs(solution).max())
    assert found.log_det() == pytest.approx(log_det, abs=1e-6)
    blocks = found.blocks()

    def of(one: int, two: int) -> Array:
        a, b = (slice(starts[k], starts[k + 1]) for k in (one, two))
        return covariance[a, b]

    base, counts = graph.base(), graph.counts()
    keys = [graph.nodes.of_frame] + [base[i] + np.arange(counts[i].number) for i in range(1, 7)]
    for some, own in zip(keys, blocks):
        if own.size:
            expected = np.array([of(k, k) for k in some])
            np.testing.assert_allclose(own, expected, atol=1e-6 * np.abs(expected).max())
            # a difference between both triangles can grow from frame to frame without a limit
            np.testing.assert_array_equal(own, np.swapaxes(own, 1, 2))


def test_what_is_of_one_frame_is_one_clique() -> None:
    graph, factors = linearised("five")
    fronts = [c.fronts for c in eliminate(graph, factors, cholesky=True).cliques]
    used = sum(family.number for family in graph.counts() if family.size)
    assert sorted(k for some in fronts for k in some) == list(range(used))
    assert FRAMES <= len(fronts) <= FRAMES + 1


def test_cholesky_that_keeps_too_few_digits_gives_way_to_qr(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graph, factors = linearised("five")
    expected = eliminate(graph, factors, cholesky=False)
    monkeypatch.setattr(elimination, "LEAST_PIVOT", 1.0)
    found: EliminatedGraph = eliminate(graph, factors, cholesky=True)
    np.testing.assert_array_equal(found.vector, expected.vector)
