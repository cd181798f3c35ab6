"""What the residuals of one camera share is found, and noise is not taken for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from seeds import first_or_all
from shake_cases import SCENARIOS
from shake_learning_data import run, true_model
from shake_scene import RISE_MM_S, UP, Case, simulate

import telerig
from telerig.arrays import Array
from telerig.estimator.sensors.response import FALSE_ALARMS
from telerig.estimator.smoothing.graph.draws import Draws
from telerig.estimator.smoothing.graph.solve import drawn, solve
from telerig.estimator.smoothing.problem.problem import Observations, SmoothingProblem
from telerig.estimator.smoothing.verdict import shared
from telerig.estimator.smoothing.verdict.contradiction import contradictions
from telerig.estimator.smoothing.verdict.evidence import Evidence, Span
from telerig.estimator.smoothing.verdict.shared import Scores, strongest
from telerig.io.results.smoothing import Disagreement
from telerig.io.results.verdict_words import words_of_contradiction

FRAMES, DRAWS = 400, 16


def noise(
    rng: np.random.Generator, share: float, memory: float = 0.0, draws: int = DRAWS
) -> Scores:
    """Scores of unit variance in each frame, of which the fit leaves a share."""
    from scipy.signal import lfilter

    seen = rng.standard_normal(FRAMES) * np.sqrt(1 - memory**2)
    drawn_ones = rng.standard_normal((FRAMES, draws))
    seen = np.asarray(lfilter([1.0], [1.0, -memory], seen))
    return Scores(share**0.5 * seen, share**0.5 * drawn_ones, np.ones(FRAMES))


@pytest.mark.parametrize("draws", [DRAWS, 2])
def test_noise_is_as_improbable_as_it_is_said_to_be(draws: int) -> None:
    rng = np.random.default_rng(1)
    found = [one for _ in range(400) for one in strongest(noise(rng, 0.5, draws=draws))]
    for step in (True, False):
        chance = np.array([one.chance for one in found if (one.hz is None) == step])
        assert len(chance) == 400
        assert np.count_nonzero(chance < 0.1) <= 55, "at most 40 +- 6"
        assert chance.min() > 1e-4


def test_correlated_noise_is_no_motion() -> None:
    """Its low frequencies have 4 times the power that the draws show; as noise it is counted."""
    rng = np.random.default_rng(4)
    chance = [one.chance for _ in range(400) for one in strongest(noise(rng, 0.5, memory=0.5))]
    assert min(chance) > FALSE_ALARMS / 64


@pytest.mark.parametrize(("share", "draws"), [(1.0, DRAWS), (0.3, DRAWS), (1.0, 2)])
def test_a_step_and_a_line_have_their_size(share: float, draws: int) -> None:
    """Long runs with many bubbles have two draws."""
    rng, t = np.random.default_rng(2), np.arange(FRAMES)
    step, line = np.where(t >= 200, 1.0, 0.0), np.sin(2 * np.pi * 40 / FRAMES * t)
    clean = noise(rng, share, draws=draws)
    moved = clean._replace(seen=clean.seen + share * 1.5 * (step - step.mean()))
    one = next(f for f in strongest(moved) if f.hz is None)
    assert one.start == 200 and one.size_px == pytest.approx(1.5, abs=0.8)
    assert one.chance < 1e-6
    swung = clean._replace(seen=clean.seen + share * 1.5 * line)
    one = next(f for f in strongest(swung) if f.hz is not None)
    assert one.hz == pytest.approx(40 / FRAMES) and one.size_px == pytest.approx(1.5, abs=0.5)
    assert one.chance < 1e-9


def test_what_is_seen_in_a_part_of_the_run_is_no_step() -> None:
    for seed in range(20):
        part = noise(np.random.default_rng(seed), 0.5)
        inside = np.arange(FRAMES) >= FRAMES // 2
        offset = part.seen + 2.0
        part = Scores(offset * inside, part.drawn * inside[:, None], part.full * inside)
        assert min(one.chance for one in strongest(part)) > 1e-3


def test_what_the_fit_follows_is_not_tested() -> None:
    assert not list(strongest(noise(np.random.default_rng(3), 0.001)))


def test_bubbles_that_come_together_are_no_growth() -> None:
    """From 3 to 0.15 mm, 1.5 px each: measured pixels contain the noise that residuals contain, so
    that the score along them jumped as the bubbles came near (36 standard deviations)."""
    side = np.array([[1.0, 0, 0.5], [-1, 0, 0.5], [0, 0, -1], [0.6, 0.5, 0], [-0.6, -0.5, 0]])

    def bubbles(t: Array) -> tuple[Array, Array]:
        away = 0.15 + 2.85 / (1 + np.exp(30 * ((t - t[0]) / (t[-1] - t[0]) - 0.5)))
        whole = np.stack([away, np.gradient(away, t)])[:, None, :, None]
        rise = np.stack([RISE_MM_S * t, np.full_like(t, RISE_MM_S)])[:, None, :, None]
        place, velocity = side[:, None] * whole + rise * UP
        return place, velocity

    case = Case(replace(SCENARIOS["S2"], noise_px=1.5, frames=400))
    seen = simulate(case, np.random.default_rng(1), bubbles=bubbles)
    found = telerig.smooth(**seen.inputs("five") | {"references": seen.references})
    assert found.verdict["verdict"] == "RESOLVED"


def with_right_pixels(problem: SmoothingProblem, of: str, moved: Array) -> SmoothingProblem:
    """The problem with other pixels of its second camera."""
    seen: Observations = getattr(problem, of)
    pixels = np.where((seen.camera == 1)[:, None], moved, seen.uv_px)
    return replace(problem, **{of: replace(seen, uv_px=pixels)})


def rolled(problem: SmoothingProblem) -> SmoothingProblem:
    """The second camera rolls by 0.2 degrees in the middle of the run."""
    for of in ("observations", "references"):
        seen: Observations = getattr(problem, of)
        angle = np.deg2rad(0.2) * (seen.frame >= len(problem.t_s) // 2)
        middle = (np.array(problem.cameras[1].image_size_px) - 1) / 2
        away = (seen.uv_px - middle)[:, ::-1] * [-1.0, 1.0]
        problem = with_right_pixels(problem, of, seen.uv_px + angle[:, None] * away)
    return problem


def swinging(
    problem: SmoothingProblem, px: float = 3.0, hz: float = 9.0, item: int | None = None
) -> SmoothingProblem:
    """The bubbles of the second camera swing, or one of them."""
    seen = problem.observations
    swing = px * np.sin(2 * np.pi * hz * problem.t_s[seen.frame])
    if item is not None:
        swing = swing * (seen.item == item)
    return with_right_pixels(problem, "observations", seen.uv_px + swing[:, None])


@pytest.mark.parametrize("seed", first_or_all(*range(4)))
def test_a_rolled_camera_and_swinging_images_are_named(seed: int) -> None:
    problem = run(np.random.default_rng(seed), bubbles=5, marks=4)[0]
    for fault, kind, words in (
        (rolled, Disagreement.TURN, "turn together"),
        (swinging, Disagreement.SHIFT, "shift together at"),
    ):
        solution = solve(fault(problem), true_model())
        evidence = Evidence.of(solution, drawn(solution))
        found = contradictions(solution, evidence).found
        one = next(f for f in found if f.test == kind)
        assert words in words_of_contradiction(one)
        if kind == Disagreement.SHIFT:  # of which of two cameras, nothing shows
            assert one.hz == pytest.approx(9.0, abs=0.7)
        else:
            assert one.camera == problem.cameras[1].name
            assert one.from_s == pytest.approx(problem.t_s[len(problem.t_s) // 2], abs=0.2)


def test_a_line_of_one_bubble_is_no_motion_of_its_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = swinging(
        run(np.random.default_rng(0), bubbles=5, marks=4)[0], px=1.0, hz=40.0, item=0
    )
    solution = solve(problem, true_model())
    assert not Evidence.of(solution, drawn(solution)).shared
    monkeypatch.setattr(shared, "_LEAST_OF_OTHERS", 0.0)
    assert Evidence.of(solution, drawn(solution)).shared


def test_a_shift_is_not_tested_where_only_bubbles_show_the_shake() -> None:
    problem = swinging(run(np.random.default_rng(0), bubbles=5, marks=4)[0])
    bare = replace(problem, references=Observations.none(), marks=())
    solution = solve(bare, true_model())
    found = Evidence.of(solution, drawn(solution)).shared
    assert all(one.motion != Disagreement.SHIFT for one in found.values())


def test_the_pieces_of_a_run_keep_the_strongest() -> None:
    solution = solve(swinging(run(np.random.default_rng(0), bubbles=5, marks=4)[0]), true_model())
    draws: Draws = drawn(solution)
    t_s, count = solution.graph.problem.t_s, len(solution.graph.problem.t_s)
    parts = [
        Evidence.of(solution, draws, Span(own, 0, t_s))
        for own in (range(count // 3), range(count // 3, count))
    ]
    both = (parts[0] + parts[1]).shared["bubbles"]
    assert both.sigmas == max(p.shared["bubbles"].sigmas for p in parts if p.shared)
