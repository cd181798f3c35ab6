"""The verdict: known answers for what one bubble, several bubbles and marks can tell."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from shake_learning_data import ARM_HZ, COMMON_HZ, run, true_model

from telerig.estimator.smoothing.graph.solve import Options, Solution, solve
from telerig.estimator.smoothing.problem.problem import Accelerometer, BroadBand, ShakeModel, Stage
from telerig.estimator.smoothing.verdict.evidence import shake_of
from telerig.estimator.smoothing.verdict.identifiability import (
    shake_share,
    verdicts,
    window_of,
    without_sensors,
)
from telerig.estimator.smoothing.verdict.judge import judge, remedies_of
from telerig.estimator.smoothing.verdict.modes import shake_modes
from telerig.io.results.smoothing import AxisVerdict, Mode, Place
from telerig.io.results.verdict_words import mode_remedy, remedy_words

QUIET = Options(robust=False)
BANDS = replace(
    true_model(), modes=(), broad_bands=tuple(BroadBand((0.02, 0.2, 0.02), j) for j in (0, 1))
)


def verdict_of(solution: Solution) -> dict[str, AxisVerdict]:
    return verdicts(solution, shake_of(solution))


def verdict(problem: object, model: ShakeModel) -> dict[str, object]:
    return judge(problem, model, solve(problem, model, QUIET))  # type: ignore[arg-type]


def test_one_bubble_cannot_be_told_from_the_rig() -> None:
    problem, _, _ = run(np.random.default_rng(0))
    found = verdict(problem, true_model())
    assert found["verdict"] == "UNRESOLVED"
    assert found["flags"] == ["LABEL_AMBIGUOUS"]
    y = found["axes"]["y"]  # type: ignore[index]
    assert y["q"] > 2
    assert y["eta"] < 0.99
    rig = [line for line in y["lines"] if line["owner"] == "rig"]
    assert [line["frequency_hz"] for line in rig] == [COMMON_HZ]
    assert abs(rig[0]["other_owner_costs_nats"]) < 1e-3
    words = str(found["words"])
    assert "y (vertical): bubble motion and shake cannot be separated" in words
    assert "fix a strip of dots to the tank inside both views" in words
    json.dumps(found)


def test_several_bubbles_decide_the_label_but_not_the_amplitude() -> None:
    problem, _, _ = run(np.random.default_rng(1), bubbles=5)
    y = verdict_of(solve(problem, true_model(), QUIET))["y"]
    assert "LABEL_AMBIGUOUS" not in y.flags
    assert all(line.other_owner_costs_nats > 5 for line in y.lines)
    alone, _, _ = run(np.random.default_rng(1))
    assert y.q < verdict_of(solve(alone, true_model(), QUIET))["y"].q


def test_marks_fixed_to_the_tank_resolve_it() -> None:
    problem, _, _ = run(np.random.default_rng(2), marks=4)
    for model in (true_model(), BANDS):
        found = verdict(problem, model)
        assert found["axes"]["y"]["verdict"] == "RESOLVED"  # type: ignore[index]
        assert found["flags"] == []
    assert found["remedy"] == "" or found["verdict"] != "RESOLVED"


def test_the_remedy_is_never_what_the_run_already_has() -> None:
    alone, _, _ = run(np.random.default_rng(2), seconds=0.2)
    marked, _, _ = run(np.random.default_rng(2), seconds=0.2, marks=4)
    sensors = tuple(
        Accelerometer(f"arm {c}", c, alone.t_s, np.zeros((len(alone.t_s), 3)), np.eye(3), 10.0)
        for c in range(2)
    )
    strip, arms = "fix a strip of dots", "one accelerometer on each camera arm"
    for problem, said, unsaid in (
        (alone, (strip, arms), ()),
        (marked, (arms,), (strip,)),
        (replace(alone, accelerometers=sensors), (strip,), (arms,)),
        (replace(alone, accelerometers=sensors[:1]), (strip, arms), ()),
        (replace(marked, accelerometers=sensors), ("longer record",), (strip, arms)),
    ):
        words = remedy_words(remedies_of(problem))
        assert all(word in words for word in said)
        assert not any(word in words for word in unsaid)


def test_shake_far_below_the_noise_is_called_so() -> None:
    problem, _, _ = run(np.random.default_rng(3), shake_mm=0.002, sigma_px=2.0)
    found = verdict(problem, true_model(0.002))
    assert found["verdict"] == "RESOLVED"
    assert found["flags"] == ["SHAKE_BELOW_NOISE"]
    assert "below the noise" in str(found["words"])


def test_a_model_without_shake_has_nothing_to_share() -> None:
    problem, _, _ = run(np.random.default_rng(4), shake_mm=0.0)
    solution = solve(problem, true_model().without_shake(), QUIET)
    assert shake_share(solution, shake_of(solution)) == [None, None, None]
    y = verdict_of(solution)["y"]
    assert y.q == pytest.approx(1, abs=1e-6)
    assert y.shake_rms_mm == 0


def test_q_is_the_ratio_to_the_same_run_without_shake() -> None:
    problem, _, _ = run(np.random.default_rng(5), seconds=0.6)
    solution = solve(problem, true_model(), QUIET)
    still = solve(problem, true_model().without_shake(), QUIET)
    assert solution.covariances is not None and still.covariances is not None
    row = solution.graph.bubble.position[1]
    each = [np.einsum("d,nde,e->n", row, s.covariances.bubbles, row) for s in (solution, still)]  # type: ignore[union-attr]
    ratio = np.sqrt(each[0] / each[1])[12:-12]
    assert verdict_of(solution)["y"].q == pytest.approx(np.median(ratio), rel=1e-3)


def test_eta_follows_from_the_prior_and_what_is_left() -> None:
    problem, _, _ = run(np.random.default_rng(6), seconds=0.6, marks=2)
    solution = solve(problem, true_model(), QUIET)
    assert solution.covariances is not None
    left = []
    for camera in (0, 1):
        row = solution.graph.shake.offset[camera][1]
        inner = solution.covariances.shake[12:-12]
        left.append(np.einsum("d,fde,e->f", row, inner, row).mean())
    eta = shake_share(solution, shake_of(solution))[1]
    assert eta == pytest.approx(1 - max(left) / 0.04, rel=1e-6)


def test_only_the_window_is_looked_at_and_keeps_its_pixels() -> None:
    problem, _, _ = run(np.random.default_rng(7), bubbles=4, marks=2, seconds=0.5)
    solution = solve(problem, true_model(), replace(QUIET, covariances=False))
    window = window_of(solution)
    assert window.first == 0
    assert len(window.bubbles) == 3
    assert len(window.problem.observations) == 3 * 2 * 100
    assert len(without_sensors(window.problem).references) == 0
    for new, old in enumerate(window.bubbles):
        kept = window.problem.observations
        whole = problem.observations
        np.testing.assert_array_equal(kept.uv_px[kept.item == new], whole.uv_px[whole.item == old])


def test_without_bubbles_or_covariances_there_is_no_verdict() -> None:
    problem, _, _ = run(np.random.default_rng(8), seconds=0.2)
    solution = solve(problem, true_model(), replace(QUIET, covariances=False))
    assert judge(problem, true_model(), solution) == {}


def test_table_of_modes_names_places_and_remedies() -> None:
    problem, _, _ = run(np.random.default_rng(9), seconds=0.3)
    rows = shake_modes(solve(problem, true_model(), QUIET))
    assert [r.where for r in rows] == ["common", "arm left", "arm right"]
    assert rows[0].frequency_hz == COMMON_HZ
    arm = Mode(where="arm left", place=Place.ARM, camera="left", frequency_hz=20.0, damping=0.01)
    assert "camera left" in mode_remedy(arm) and "damping" in mode_remedy(arm)
    slow = Mode(where="common", place=Place.COMMON, frequency_hz=3.0, damping=0.1)
    assert "ramp" in mode_remedy(slow)
    assert mode_remedy(Mode(where="common", frequency_hz=3.0, remedy="brace it")) == "brace it"


def test_modes_are_read_from_estimated_shake_and_encoder_when_the_model_has_none() -> None:
    problem, _, _ = run(np.random.default_rng(10), seconds=3.0, rate_hz=100.0, marks=3)
    t = np.arange(0, 3, 1e-3)
    servo = 0.1 * np.sqrt(2) * np.sin(2 * np.pi * 15 * t)
    problem = replace(problem, stage=Stage(t, 1e-9 * t))
    solution = solve(problem, BANDS, QUIET)
    moving = replace(
        solution,
        graph=replace(solution.graph, problem=replace(problem, stage=Stage(t, 50 * t + servo))),
    )
    rows = {r.where: r for r in reversed(shake_modes(moving))}
    assert rows["common"].frequency_hz == pytest.approx(COMMON_HZ, abs=0.8)
    assert rows["arm left"].frequency_hz == pytest.approx(ARM_HZ, abs=1.2)
    assert rows["servo"].frequency_hz == pytest.approx(15, abs=0.5)
    assert rows["servo"].rms_mm[1] == pytest.approx(0.1, rel=0.15)
