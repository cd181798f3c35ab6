"""Measurements that disagree are called so, and the bands then hold the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from seeds import first_or_all
from shake_learning_data import run, true_model

from telerig.errors import CalibrationError
from telerig.estimator.smoothing.graph.layout import GraphLayout, State
from telerig.estimator.smoothing.graph.outliers import Truncation
from telerig.estimator.smoothing.graph.solve import (
    Options,
    Solution,
    _check_converged,
    drawn,
    solve,
)
from telerig.estimator.smoothing.learning.default_priors import adapted
from telerig.estimator.smoothing.problem.problem import (
    Accelerometer,
    BroadBand,
    SmoothingProblem,
)
from telerig.estimator.smoothing.result import trajectories
from telerig.estimator.smoothing.verdict.contradiction import contradictions, speed_warnings
from telerig.estimator.smoothing.verdict.evidence import Evidence
from telerig.estimator.smoothing.verdict.judge import judge
from telerig.factors.bubble_motion import Inertia
from telerig.io.results.smoothing import Contradiction, Disagreement

BANDS = replace(
    true_model(), modes=(), broad_bands=tuple(BroadBand((0.02, 0.2, 0.02), j) for j in (0, 1))
)


def marked(seed: int) -> SmoothingProblem:
    return run(np.random.default_rng(seed), marks=4)[0]


def late_marks(problem: SmoothingProblem) -> SmoothingProblem:
    """The marks of one camera, measured a quarter of a second after what they are said to show."""
    seen = problem.references
    count = len(problem.t_s)
    frame = np.where(seen.camera == 0, (seen.frame + 50) % count, seen.frame)
    return replace(problem, references=replace(seen, frame=frame))


def found_in(solution: Solution) -> tuple[Contradiction, ...]:
    return contradictions(solution, Evidence.of(solution, drawn(solution))).found


@pytest.mark.parametrize("seed", first_or_all(*range(3)))
def test_measurements_that_agree_are_not_contradicted(seed: int) -> None:
    for problem in (marked(seed), run(np.random.default_rng(seed), bubbles=2)[0]):
        assert found_in(solve(problem, true_model())) == ()


def test_residuals_within_what_is_stated_do_not_contradict_the_white_part_of_it() -> None:
    """What changes slowly in outlines is stated, and weighs no image."""
    bubble = replace(true_model().bubble, inertia=Inertia((1e-3,) * 3, noise=(0.4, 0.4)))
    solution = solve(marked(1), replace(true_model(), bubble=bubble))
    assert np.mean(solution.residuals[0] ** 2) > 1.8
    assert found_in(solution) == ()


def test_marks_of_another_time_are_named_and_the_bands_are_widened() -> None:
    problem = late_marks(marked(1))
    solution = solve(problem, BANDS, Options(robust=False))
    verdict = judge(problem, BANDS, solution)
    assert verdict["verdict"] == "CONTRADICTED"
    found = [Contradiction.model_validate(one) for one in verdict["contradictions"]]
    assert {"marks"} <= {found[0].source, *found[0].against}
    assert "marks" in verdict["words"]
    factor = verdict["inflation"]["xyz".index("y")]
    assert factor > 1.2
    plain = trajectories(solution, None)
    wide = trajectories(solution, None, verdict["inflation"])
    np.testing.assert_allclose(wide["sy_mm"], factor * plain["sy_mm"])
    assert verdict["axes"]["y"]["verdict"] == "CONTRADICTED"
    assert {use["grade"] for use in verdict["usable_for"]} <= {"limited", "no"}
    assert "good to" not in verdict["words"], "no path is good to anything"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [7, 8])
def test_a_centre_that_wanders_with_the_outline_is_noise_and_no_contradiction(seed: int) -> None:
    """Along the columns; the path along the rows is so free that it takes up the same wander."""
    problem, rng = marked(seed), np.random.default_rng(seed)
    seen, wander = problem.observations, np.zeros((2, len(problem.t_s)))
    for k in range(1, len(problem.t_s)):
        wander[:, k] = 0.4 * wander[:, k - 1] + 0.6 * rng.normal(size=2)
    pixels = seen.uv_px + [0, 1] * wander[seen.camera, seen.frame, None]
    problem = replace(problem, observations=replace(seen, uv_px=pixels))
    stated = solve(problem, BANDS)
    assert {(f.source, f.axis) for f in found_in(stated)} == {("bubbles", "y")}
    better = adapted(stated)
    assert better is not None and better.pixel_inflation > 1.5
    assert found_in(solve(problem, better)) == ()


def test_marks_with_more_noise_than_is_stated_contradict_nothing() -> None:
    """The bubbles' noise is theirs alone, and marks of another time have none."""
    problem, rng = marked(1), np.random.default_rng(1)
    seen = problem.references
    noise = 2 * np.sqrt(seen.covariance_px2[:, :1, 0]) * rng.normal(size=seen.uv_px.shape)
    noisy = replace(problem, references=replace(seen, uv_px=seen.uv_px + noise))
    better = adapted(solve(noisy, BANDS))
    assert better is not None and better.pixel_inflation < 1.15
    assert better.mark_inflation == pytest.approx(np.sqrt(5), rel=0.1)
    assert found_in(solve(noisy, better)) == ()
    late = adapted(solve(late_marks(problem), BANDS))
    assert late is not None and late.mark_inflation == 1


def test_a_bias_that_no_sensor_has_is_a_contradiction() -> None:
    problem = marked(2)
    count = len(problem.t_s)
    still = np.tile(-problem.gravity_mm_s2, (count, 1))
    sensors = tuple(
        Accelerometer(f"arm {c}", c, problem.t_s, still + [0.0, 3000.0 * c, 0.0], np.eye(3), 1000.0)
        for c in range(2)
    )
    problem = replace(problem, accelerometers=sensors)
    biased = [one for one in found_in(solve(problem, BANDS)) if one.test == Disagreement.BIAS]
    assert [(one.source, one.axis) for one in biased] == [("arm 1", "y")]


def test_so_many_outliers_are_none() -> None:
    solution = solve(marked(3), true_model())
    share = np.where(np.arange(len(solution.weights[1])) % 10 < 8, 0.0, 1.0)
    found = found_in(replace(solution, weights=(solution.weights[0], share)))
    assert any(o.source == "marks" and o.test == Disagreement.OUTLIERS for o in found)


def test_normal_noise_of_many_pixels_has_no_outliers() -> None:
    """The largest of a million is above five standard deviations, and is none."""
    rng, weights = np.random.default_rng(8), (np.ones(1_000_000), np.zeros(0))
    touched = 0
    for _ in range(10):
        residuals = (rng.standard_normal((len(weights[0]), 2)), np.zeros((0, 2)))
        touched += Truncation(True).update(weights, residuals)[1]
    assert touched <= 3  # one in twenty is expected
    residuals[0][7] = [6.5, 0.0]
    (fresh, _), changed = Truncation(True).update(weights, residuals)
    assert changed and fresh[7] < fresh[:7].min()


def test_a_bubble_that_is_lost_at_its_end_is_uncertain_there() -> None:
    """Its last pixels are gross outliers, for whose weights the passes do not suffice."""
    problem = marked(6)
    observed = problem.observations
    last = (observed.item == 0) & (observed.frame >= len(problem.t_s) - 8)
    wrong = 80.0 * np.random.default_rng(6).choice([-1.0, 1.0], observed.uv_px.shape)
    uv = observed.uv_px + last[:, None] * wrong
    spoilt = replace(problem, observations=replace(observed, uv_px=uv))
    calm, found = (
        solve(one, replace(true_model(), accelerometer_scale_sigma=0.01))
        for one in (problem, spoilt)
    )
    assert (found.weights[0][last] == 0).all() and found.weights[0][~last].mean() > 0.99
    assert calm.covariances is not None and found.covariances is not None
    rows = found.graph.bubble.position
    off = (found.state.bubbles - calm.state.bubbles) @ rows.T
    variance = np.diagonal(rows @ found.covariances.bubbles @ rows.T, axis1=1, axis2=2)
    end = found.graph.first_row[1] - 1
    assert (variance[end] > 4 * variance[end - 40]).all()
    assert (np.abs(off[end]) < 4 * np.sqrt(variance[end])).all()


@pytest.mark.parametrize(("rise", "word"), [(-50.0, "sink"), (0.0, "hover"), (50.0, "")])
def test_bubbles_that_do_not_rise_are_a_warning(rise: float, word: str) -> None:
    from telerig.estimator.smoothing.problem.problem import Stage

    problem = marked(4)
    problem = replace(problem, stage=Stage(problem.t_s, 100 * problem.t_s))
    means = np.tile(rise * problem.up, (len(problem.bubbles), 1))
    warnings = speed_warnings(problem, means)
    assert bool(warnings) == bool(word)
    assert all(word in warning for warning in warnings)


def _with_clock(late_s: float) -> tuple[GraphLayout, State]:
    problem = marked(6)
    reading = np.tile(-problem.gravity_mm_s2, (len(problem.t_s), 1))
    sensor = Accelerometer("arm", 0, problem.t_s, reading, np.eye(3), 10.0)
    solution = solve(
        replace(problem, accelerometers=(sensor,)),
        replace(BANDS, accelerometer_delay_sigma_s=1e-4),
        Options(covariances=False),
    )
    return solution.graph, replace(solution.state, clocks=np.full((1, 1), late_s))


def test_a_clock_that_still_moves_is_an_error() -> None:
    graph, state = _with_clock(5e-3)
    with pytest.raises(CalibrationError, match="delay of accelerometer arm does not converge"):
        _check_converged(graph, state, 0.0)
    calm = replace(state, clocks=np.zeros((1, 1)))
    _check_converged(graph, calm, 0.1)
    with pytest.raises(CalibrationError, match="moved a bubble by 30 px"):
        _check_converged(graph, calm, 30.0)
    with pytest.raises(CalibrationError, match="not finite"):
        _check_converged(graph, replace(calm, means=np.full_like(calm.means, np.nan)), 0.0)
