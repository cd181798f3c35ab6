"""From which frames of a long run its hyper-parameters are learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from shake_learning_data import run

from telerig.estimator.smoothing.learning.window import (
    MOST_FRAMES,
    learning_window,
    other_windows,
)
from telerig.estimator.smoothing.problem.problem import SmoothingProblem


def _long(frames: int) -> SmoothingProblem:
    problem, _, _ = run(np.random.default_rng(3), bubbles=2, seconds=frames / 200.0)
    return problem


def test_a_short_run_is_learned_from_as_a_whole() -> None:
    problem = _long(300)
    assert learning_window(problem).problem is problem
    assert other_windows(problem, learning_window(problem), 3) == []


def test_a_long_run_is_learned_from_where_the_bubbles_are_seen_most() -> None:
    problem = _long(3 * MOST_FRAMES)
    seen = problem.observations
    late = seen.frame >= 2 * MOST_FRAMES
    fewer = replace(problem, observations=seen.of(late | (seen.frame % 2 == 0)))
    window = learning_window(fewer)
    assert window.first == 2 * MOST_FRAMES
    assert len(window.problem.t_s) == MOST_FRAMES
    np.testing.assert_array_equal(window.problem.t_s, problem.t_s[2 * MOST_FRAMES :])
    assert window.problem.observations.frame.max() == MOST_FRAMES - 1
    for one in (*other_windows(fewer, window, 5), window):
        assert len(one.problem.t_s) == MOST_FRAMES
        for bubble in one.problem.bubbles:
            whole = problem.bubbles[bubble.particle].guess_mm
            np.testing.assert_array_equal(
                bubble.guess_mm, whole[one.first : one.first + len(bubble)]
            )
    assert [w.first for w in other_windows(fewer, window, 5)] == [0, MOST_FRAMES]
