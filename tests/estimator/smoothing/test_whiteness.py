"""Residuals beside those that the model would leave: drawn, tested, and what they tell of noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import kstest
from shake_learning_data import run, true_model

from telerig.estimator.smoothing.graph.elimination import starts_of
from telerig.estimator.smoothing.graph.linear import all_factors
from telerig.estimator.smoothing.graph.solve import Options, Solution, drawn, solve
from telerig.estimator.smoothing.learning.default_priors import adapted
from telerig.estimator.smoothing.problem.problem import Observations, ShakeModel, SmoothingProblem
from telerig.estimator.smoothing.verdict.evidence import Evidence, Span
from telerig.factors.bubble_motion import Inertia
from telerig.factors.linear_factors import product
from telerig.rig.pose import Pose

Array = NDArray[np.float64]

TRUE = true_model()
TRUE = replace(TRUE, modes=tuple(replace(m, force_hz=60.0) for m in TRUE.modes))


def solved(problem: SmoothingProblem, model: ShakeModel = TRUE) -> Solution:
    return solve(problem, model, Options(robust=False))


def stated(problem: SmoothingProblem, times: float) -> SmoothingProblem:
    """The same pixels, their stated standard deviation so many times as large."""
    obs = problem.observations
    whole = obs.item, obs.frame, obs.camera, obs.uv_px, times**2 * obs.covariance_px2
    return replace(problem, observations=Observations(*whole))


def whiteness(solution: Solution) -> dict[str, dict[str, Any]]:
    of = Evidence.of(solution, drawn(solution)).lagged
    return {name: one.compared() for name, one in of.items()}


@pytest.mark.parametrize(("seed", "kept"), [(31, 1.0), (32, 1.0), (33, 0.7), (34, 0.5)])
def test_residuals_of_the_right_model_are_as_expected(seed: int, kept: float) -> None:
    """They are not white: the fit follows part of the noise."""
    problem, _, _ = run(np.random.default_rng(seed), bubbles=2, seconds=1.5, kept=kept)
    found = whiteness(solved(problem))
    assert list(found) == ["left", "right"]
    for one in found.values():
        assert one["verdict"] == "as expected" and one["p"] > 1e-3
        assert one["expected"][0] < -0.05
        np.testing.assert_allclose(one["autocorrelation"], one["expected"], atol=0.2)
        assert one["rms_sigmas"] == pytest.approx(one["expected_rms_sigmas"], rel=0.1)


def test_cameras_that_are_turned_about_their_axes_leave_the_same() -> None:
    """The white noise along the rise is a part of the stated one; slow errors have all of it."""
    problem, _, _ = run(np.random.default_rng(36), bubbles=2, seconds=0.3)
    model = replace(
        TRUE, modes=(), bubble=replace(TRUE.bubble, inertia=Inertia((0.002,) * 3, noise=(0.3, 1.0)))
    )
    obs, sine = problem.observations, np.sqrt(0.5)
    roll = np.array([[sine, -sine, 0.0], [sine, sine, 0.0], [0.0, 0.0, 1.0]])
    cameras = tuple(
        replace(c, camera_from_rig=Pose(roll @ c.camera_from_rig.rotation, np.zeros(3)))
        for c in problem.cameras
    )
    turned = replace(obs, uv_px=511.5 + (obs.uv_px - 511.5) @ roll[:2, :2].T)
    sums = []
    for each in (problem, replace(problem, cameras=cameras, observations=turned)):
        solution = solved(each, model)
        tallies = Evidence.of(solution, drawn(solution)).tallies.values()
        sums.append(sum(t.seen.sum() for t in tallies if t.source == "bubbles"))
    assert sums[1] == pytest.approx(sums[0], rel=1e-6)


@pytest.mark.slow
def test_p_is_uniform_where_the_model_is_right() -> None:
    """Residuals drawn from the model itself, judged by others: a false alarm as often as said."""
    problem, _, _ = run(np.random.default_rng(35), bubbles=2, seconds=1.0, kept=0.7)
    solution = solved(problem)
    others = drawn(solution, 60).pixels
    found = []
    for k in range(60):
        one = whiteness(replace(solution, residuals=(others[..., k], solution.residuals[1])))
        found += [one["left"]["p"], one["right"]["p"]]
    assert kstest(found, "uniform").pvalue > 0.01


def test_drawn_residuals_are_as_small_as_the_leverages_say() -> None:
    """An independent way: what a dense fit leaves of the noise's variance."""
    problem, _, _ = run(np.random.default_rng(35), bubbles=2, seconds=0.2)
    solution = solved(problem)
    factors = all_factors(solution.graph, solution.state, solution.weights)
    starts = starts_of(solution.graph)
    blocks = product(factors, starts, np.eye(int(starts[-1])))
    whole = np.concatenate([b.reshape(-1, b.shape[-1]) for b in blocks])
    leverage = (np.linalg.qr(whole)[0] ** 2).sum(1)
    ends = np.cumsum([f.rhs.size for f in factors])
    pixels = [
        1 - leverage[end - f.rhs.size : end].reshape(-1, 2)
        for f, end in zip(factors, ends)
        if f.weight is not None and f.rhs.size
    ]
    left = (drawn(solution, 400).pixels ** 2).mean(-1)
    for camera, expected in enumerate(pixels):
        mine = left[problem.observations.camera == camera]
        np.testing.assert_allclose(mine, expected, atol=0.25)
        np.testing.assert_allclose(mine.mean(0), expected.mean(0), rtol=0.03)


def test_a_centre_that_wanders_is_seen() -> None:
    rng = np.random.default_rng(36)
    problem, _, _ = run(rng, bubbles=1, seconds=2.0, sigma_px=0.2)
    obs = problem.observations
    wander = np.zeros((2, 400, 2))
    for k in range(1, 400):
        wander[:, k] = 0.8 * wander[:, k - 1] + 0.4 * rng.normal(size=(2, 2))
    pixels = obs.uv_px + wander[obs.camera, obs.frame]
    moved = Observations(obs.item, obs.frame, obs.camera, pixels, obs.covariance_px2)
    for one in whiteness(solved(replace(problem, observations=moved))).values():
        assert one["verdict"] == "correlated" and one["p"] < 1e-5
        assert one["rms_sigmas"] > 1.4 * one["expected_rms_sigmas"]


def test_too_few_frames_are_not_judged() -> None:
    problem, _, _ = run(np.random.default_rng(37), bubbles=1, seconds=0.15)
    assert whiteness(solved(problem)) == {"left": {}, "right": {}}


def tracks(problem: SmoothingProblem, spans: list[tuple[int, int]]) -> SmoothingProblem:
    """Each bubble seen in its span of frames only."""
    obs, bubbles, keep = problem.observations, [], np.zeros(len(problem.observations), bool)
    for k, (first, last) in enumerate(spans):
        guess = problem.bubbles[k].guess_mm[first : last + 1]
        bubbles.append(replace(problem.bubbles[k], first=first, last=last, guess_mm=guess))
        keep |= (obs.item == k) & (obs.frame >= first) & (obs.frame <= last)
    whole = (a[keep] for a in (obs.item, obs.frame, obs.camera, obs.uv_px, obs.covariance_px2))
    return replace(problem, bubbles=tuple(bubbles), observations=Observations(*whole))


def test_tracks_one_after_the_other_and_pauses() -> None:
    """Later bubbles count like the first; a rig without shake has no state where none is seen."""
    problem, _, _ = run(np.random.default_rng(38), bubbles=20, seconds=3.0)
    short = tracks(problem, [(30 * k, 30 * k + 29) for k in range(20)])
    for one in whiteness(solved(short)).values():
        assert one["verdict"] == "as expected"
        assert one["rms_sigmas"] == pytest.approx(one["expected_rms_sigmas"], rel=0.12)
    apart = tracks(replace(problem, bubbles=problem.bubbles[:2]), [(0, 99), (500, 599)])
    still = solved(apart, replace(TRUE, modes=()))
    assert still.graph.shake.size == 0
    assert list(whiteness(still)) == ["left", "right"]


def test_few_draws_of_many_frames_do() -> None:
    """As many as a crowd has: the frames show the scatter, and the pieces of a run add up."""
    problem, _, _ = run(np.random.default_rng(39), bubbles=2, seconds=6.0)
    solution = solved(problem)
    draws = drawn(solution, 2)
    whole = Evidence.of(solution, draws)
    span = Span.whole(solution)
    parts = [Evidence.of(solution, draws, replace(span, own=range(a, a + 600))) for a in (0, 600)]
    for name, one in whole.lagged.items():
        assert one.compared()["verdict"] == "as expected"
        both = parts[0].lagged[name] + parts[1].lagged[name]
        widths = (np.diagonal(each.covariance) for each in (both, one))
        np.testing.assert_allclose(*widths, rtol=0.25)
        assert both.degrees == one.degrees == 24 and np.all(one.pairs - both.pairs <= 20)


@pytest.mark.parametrize(("times", "wanted"), [(0.6, 1 / 0.6), (1.0, 1.0), (2.0, 1.0)])
def test_noise_that_is_stated_too_small_is_found(times: float, wanted: float) -> None:
    """One that is stated too large is believed: outlines err slowly, which looks like motion."""
    problem, _, _ = run(np.random.default_rng(40), bubbles=2, seconds=1.5)
    better = adapted(solved(stated(problem, times)))
    found = 1.0 if better is None else better.pixel_inflation
    assert found == pytest.approx(wanted, rel=0.1)
    if times > 1:
        assert better is None
