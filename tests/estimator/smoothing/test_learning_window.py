"""From which frames of a long run its hyper-parameters are learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shake_learning_data import run, true_model, with_comings_and_goings

from telerig.estimator.smoothing.graph.solve import solve
from telerig.estimator.smoothing.learning.cross_validation import learning_record
from telerig.estimator.smoothing.learning.evidence import signal_evidence
from telerig.estimator.smoothing.learning.likelihood import with_hyperparameter_uncertainty
from telerig.estimator.smoothing.learning.lines_of_sight import pooled
from telerig.estimator.smoothing.learning.window import (
    MOST_FRAMES,
    first_of_most_seen,
    learning_parts,
    learning_signals,
    learning_window,
    other_windows,
)
from telerig.estimator.smoothing.problem.problem import SmoothingProblem, Stage


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


@pytest.mark.parametrize(
    ("seen_from", "recorded_to", "first"),
    [(0, 1000, 400), (300, 1000, 400), (800, 1000, 800), (0, 350, 0)],
)
def test_a_window_lies_where_bubbles_and_encoder_tell_most(
    seen_from: int, recorded_to: int, first: int
) -> None:
    """Of 1,000 frames 200 are chosen: the middle, unless far more is known elsewhere."""
    problem = _long(1000)
    seen = problem.observations
    stage = Stage(problem.t_s[:recorded_to], np.zeros(recorded_to))
    known = replace(problem, observations=seen.of(seen.frame >= seen_from), stage=stage)
    assert abs(first_of_most_seen(known, 200) - first) <= 50


def _coming_and_going(frames: int, track: int, bubbles: int = 8) -> SmoothingProblem:
    rng = np.random.default_rng(5)
    problem, _, _ = run(rng, bubbles=bubbles, seconds=frames / 200.0)
    return with_comings_and_goings(problem, rng, track)


def test_tracks_that_come_and_go_are_learned_from_in_pieces_with_enough_of_them() -> None:
    problem = _coming_and_going(1600, 200)
    signals = learning_signals(problem)
    assert len(signals) == 3
    for signal in signals:
        frames, pairs, pieces = signal.value_mm.shape
        assert frames == len(signal.t_s)
        assert pairs == int(signal.moving.sum()) * len(signal.cameras)
        assert signal.moving.sum() >= 3
        assert 50 < frames < 300
        assert pieces * frames >= 750
        assert np.ptp(signal.t_s) == pytest.approx((frames - 1) / 200.0)
        assert len(pooled(signal)) == 2


def test_the_evidence_of_pieces_is_the_sum_of_theirs() -> None:
    signal = learning_signals(_coming_and_going(1600, 200))[0]
    pieces = [replace(signal, value_mm=v) for v in np.moveaxis(signal.value_mm, -1, 0)]
    each, apart = [], []
    for model in (true_model(), true_model(0.3)):
        each.append(sum(signal_evidence(one, model) for one in pieces))
        assert signal_evidence(signal, model) == pytest.approx(each[-1], rel=1e-9)
        apart.append(sum(signal_evidence(part, model) for part in pooled(signal)))
    assert apart[1] - apart[0] == pytest.approx(each[1] - each[0], rel=0.02)


@pytest.mark.parametrize("frames", [600, 3 * MOST_FRAMES])
def test_frames_outside_the_encoders_record_are_not_learned_from(frames: int) -> None:
    problem = _long(frames)
    low, high = frames // 5, frames // 2
    stage = Stage(problem.t_s[low:high], np.zeros(high - low))
    (window,) = learning_parts(replace(problem, stage=stage))
    end = window.first + len(window.problem.t_s)
    assert low <= window.first < end <= high
    assert end - window.first == min(high - low, MOST_FRAMES)
    np.testing.assert_array_equal(window.problem.t_s, problem.t_s[window.first : end])
    np.testing.assert_array_equal(window.bubbles, [0, 1])
    assert other_windows(replace(problem, stage=stage), window, 5) == []


@pytest.mark.slow
def test_the_record_states_the_pieces_and_holds_the_rest_of_the_run_against_them() -> None:
    problem = _coming_and_going(4 * MOST_FRAMES, 200, bubbles=20)
    parts = learning_parts(problem)
    assert [p.first for p in parts] == sorted(p.first for p in parts)
    record, _ = learning_record(problem, replace(true_model(), learned={}))
    assert record["frames"] == sum(len(p.problem.t_s) for p in parts)
    assert record["from_s"] == parts[0].problem.t_s[0]
    assert record["to_s"] == parts[-1].problem.t_s[-1]
    assert record["held_out"]
    assert all(one["from_s"] > record["to_s"] for one in record["held_out"])


def test_short_runs_marks_and_lasting_bubbles_are_learned_from_as_before() -> None:
    whole, _, _ = run(np.random.default_rng(3), bubbles=3, seconds=800 / 200.0)
    marked, _, _ = run(np.random.default_rng(3), bubbles=1, seconds=800 / 200.0, marks=2)
    for problem in (whole, marked, _coming_and_going(400, 60)):
        assert all(signal.value_mm.ndim == 2 for signal in learning_signals(problem))


def test_hyperparameters_widen_no_path_by_where_a_bubble_would_be_when_out_of_sight() -> None:
    problem = _coming_and_going(300, 50)
    model = replace(true_model(), learned={"bubble.velocity_tau_s": 0.3, "modes.0.rms_mm": 0.1})
    before = solve(problem, model)
    after = with_hyperparameter_uncertainty(before)
    row = before.graph.bubble.position[1]
    variance = [
        row @ s.covariances.bubbles @ row for s in (before, after) if s.covariances is not None
    ]
    ratio = np.sqrt(variance[1] / variance[0])
    assert 1.0 < np.median(ratio) < 1.5
    assert np.quantile(ratio, 0.99) < 2
