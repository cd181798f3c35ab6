"""The verdict: known answers for what one bubble, several bubbles and marks can tell."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from shake_learning_data import ARM_HZ, COMMON_HZ, run, true_model

from telerig.estimator.smoothing.graph.solve import Options, Solution, solve
from telerig.estimator.smoothing.learning.default_priors import adapted, default_model
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    Accelerometer,
    BroadBand,
    CalibrationShare,
    ShakeModel,
    Stage,
)
from telerig.estimator.smoothing.verdict.evidence import shake_of
from telerig.estimator.smoothing.verdict.identifiability import (
    Measured,
    axis_verdict,
    expected_shake,
    measured_shake,
    rule,
    shake_share,
    verdicts,
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
    assert found["flags"] == []
    y = found["axes"]["y"]  # type: ignore[index]
    assert y["q"] > 2
    words = str(found["words"])
    assert "y (vertical): bubble motion and shake cannot be separated" in words
    assert "fix a strip of dots to the tank inside both views" in words
    json.dumps(found)


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
    of_left = marked.references.of(marked.references.camera == 0)
    strip, arms = "fix a strip of dots", "one accelerometer on each camera arm"
    for problem, said, unsaid in (
        (alone, (strip, arms), ()),
        (marked, (arms,), (strip,)),
        (replace(alone, accelerometers=sensors), (strip,), (arms,)),
        (replace(alone, accelerometers=sensors[:1]), (strip, "arm that has none"), (arms,)),
        (replace(marked, references=of_left), (strip, arms), ()),
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
    solution = solve(problem, replace(true_model(), modes=()), QUIET)
    assert shake_share(solution, shake_of(solution)) == [None, None, None]
    y = verdict_of(solution)["y"]
    assert y.q == pytest.approx(1, abs=1e-6)
    assert y.shake_rms_mm == 0


@pytest.mark.parametrize("known", ["calibration", "what is open of the calibration"])
def test_q_is_the_ratio_to_the_same_run_without_shake(known: str) -> None:
    """Read from the solution, not solved again: the same pixels with a rig that stands still."""
    problem, _, _ = run(np.random.default_rng(5), seconds=0.6, bubbles=2)
    if known != "calibration":
        free, root = (("scale_px_per_mm",), ("scale_px_per_mm",)), 1e-3 * np.eye(8)
        problem = replace(problem, calibration=CalibrationShare(root, free, root @ root.T))
    solution = solve(problem, true_model(), QUIET)
    still = solve(problem, replace(true_model(), modes=()), QUIET)
    assert solution.covariances is not None and still.covariances is not None
    row = solution.graph.bubble.position[1]
    each = [np.einsum("d,nde,e->n", row, s.covariances.bubbles, row) for s in (solution, still)]  # type: ignore[union-attr]
    inner = np.r_[12:108, 132:228]
    ratio = np.sqrt(each[0] / each[1])[inner]
    assert verdict_of(solution)["y"].q == pytest.approx(np.median(ratio), rel=1e-3)


def test_eta_is_of_the_shake_that_the_run_shows_not_of_a_wide_prior() -> None:
    problem, _, _ = run(np.random.default_rng(6), seconds=0.6, marks=2)
    for model in (true_model(), true_model(20.0)):
        solution = solve(problem, model, QUIET)
        assert solution.covariances is not None
        share = []
        for camera in (0, 1):
            row = solution.graph.shake.offset[camera][1]
            inner = solution.covariances.shake[12:-12]
            left = np.einsum("d,fde,e->f", row, inner, row).mean()
            found = solution.state.shake[solution.graph.nodes.of_frame[12:-12]] @ row
            share.append(1 - left / (left + np.mean(found**2)))
        eta = shake_share(solution, shake_of(solution))[1]
        assert eta == pytest.approx(min(share), rel=1e-6)


def test_a_planned_run_is_expected_to_show_the_variance_of_its_prior() -> None:
    problem, _, _ = run(np.random.default_rng(6), seconds=0.4, marks=2)
    solution = solve(problem, true_model(), QUIET)
    expected = expected_shake(solution)
    assert expected is not None
    for seen, square in zip(solution.graph.shake.seen, expected.square, strict=True):
        assert square / expected.frames == pytest.approx(0.04 * seen[:, 1] ** 2, abs=1e-9)


@pytest.mark.parametrize(
    ("q", "eta", "arms", "verdict"),
    [
        (1.25, None, True, "RESOLVED"),
        (1.25, 0.0, False, "RESOLVED"),
        (1.251, None, True, "PARTIAL"),
        (2.0, 0.749, False, "PARTIAL"),
        (2.001, None, True, "UNRESOLVED"),
        (14.6, 0.95, True, "RESOLVED"),
        (14.6, 0.949, True, "PARTIAL"),
        (14.6, 0.75, True, "PARTIAL"),
        (14.6, 0.749, True, "UNRESOLVED"),
        (14.6, 0.99, False, "PARTIAL"),
    ],
)
def test_the_rule(q: float, eta: float | None, arms: bool, verdict: str) -> None:
    assert rule(q, eta, arms=arms) == verdict


def _axis(q: float, eta: float | None = None, **more: object) -> AxisVerdict:
    known = np.full(9, 0.01)
    return axis_verdict(q * known, known, 0 * known, eta, 0.1, **more)  # type: ignore[arg-type]


def test_without_a_measurement_of_the_shake_only_a_given_prior_counts() -> None:
    alone = _axis(1.0, 0.99, measured=Measured.NOTHING)
    assert (alone.verdict, alone.flags) == ("UNRESOLVED", ("SHAKE_UNMEASURED",))
    given = _axis(1.0, 0.99, measured=Measured.NOTHING, given=True)
    assert (given.verdict, given.flags) == ("RESOLVED", ())
    assert _axis(3.0, 0.99, measured=Measured.NOTHING, given=True).verdict == "UNRESOLVED"
    assert _axis(3.0, 0.99).verdict == "RESOLVED"


def test_a_sensor_on_the_carriage_does_not_measure_the_arms() -> None:
    found = _axis(3.0, 0.99, measured=Measured.CARRIAGE)
    assert (found.verdict, found.flags) == ("PARTIAL", ("ARMS_UNMEASURED",))
    assert _axis(1.2, 0.5, measured=Measured.CARRIAGE).verdict == "RESOLVED"
    assert _axis(3.0, 0.99, measured=Measured.CARRIAGE, given=True).verdict == "RESOLVED"
    assert _axis(3.0, 0.5, measured=Measured.CARRIAGE).verdict == "UNRESOLVED"


def test_contradicted_comes_before_all() -> None:
    assert _axis(1.0, 1.0, inflation=1.26).verdict == "CONTRADICTED"
    assert _axis(1.0, inflation=1.25).verdict == "RESOLVED"
    judged = _axis(1.2, inflation=1.2)
    assert (judged.verdict, judged.q) == ("PARTIAL", pytest.approx(1.44)), "by the q that is told"
    assert _axis(1.0, measured=Measured.NOTHING, inflation=4.0).verdict == "CONTRADICTED"


def test_what_measures_the_shake_along_which_axis() -> None:
    """The left camera sees x and y, the right one y and z."""
    alone, _, _ = run(np.random.default_rng(2), seconds=0.2)
    marked, _, _ = run(np.random.default_rng(2), seconds=0.2, marks=2)
    pair, _, _ = run(np.random.default_rng(2), seconds=0.2, bubbles=2)
    several, _, _ = run(np.random.default_rng(2), seconds=0.2, bubbles=3)
    third, seen = several.bubbles[2], several.observations
    seldom = replace(
        several,
        bubbles=(*several.bubbles[:2], replace(third, last=15, guess_mm=third.guess_mm[:16])),
        observations=seen.of((seen.item < 2) | (seen.frame <= 15)),
    )
    last = seen.frame == seen.frame.max()
    gaps = replace(several, observations=seen.of((seen.frame % 3 == seen.item) | last))

    def sensor(camera: int, *unused: int) -> Accelerometer:
        still = np.zeros((len(alone.t_s), 3))
        return Accelerometer("a", camera, alone.t_s, still, np.eye(3), 10.0, unused_axes=unused)

    for problem, measured in (
        (alone, (0, 0, 0)),
        (pair, (0, 0, 0)),
        (several, (2, 2, 2)),
        (seldom, (0, 0, 0)),
        (gaps, (0, 0, 0)),
        (replace(marked, references=marked.references.of(marked.references.camera == 0)),
         (2, 2, 0)),
        (replace(marked, references=marked.references.of(marked.references.frame < 19)),
         (0, 0, 0)),
        (replace(alone, accelerometers=(sensor(1).of(slice(19)),)), (0, 0, 0)),
        (replace(alone, accelerometers=(sensor(1),)), (0, 2, 2)),
        (replace(alone, accelerometers=(sensor(1, 1),)), (0, 0, 2)),
        (replace(alone, accelerometers=(sensor(CARRIAGE),)), (1, 1, 1)),
        (replace(alone, accelerometers=(sensor(CARRIAGE, 1),)), (1, 0, 1)),
        (replace(alone, accelerometers=(sensor(CARRIAGE), sensor(1))), (1, 2, 2)),
    ):  # fmt: skip
        solution = solve(problem, true_model(), replace(QUIET, covariances=False))
        assert measured_shake(solution) == measured


def test_one_bubble_alone_is_unresolved_with_default_priors() -> None:
    """Across the vertical, where the bubble's swing hides it, the shake is expected as along it."""
    problem, _, _ = run(np.random.default_rng(0), across_mm=0.07, seconds=0.75)
    model, solution = default_model(problem), None
    for _ in range(5):
        solution = solve(problem, model, QUIET)
        model = adapted(solution) or model
    assert solution is not None
    axes = verdict_of(solution)
    assert min(axes["x"].q or 0, axes["z"].q or 0) > 2
    assert {axis.verdict for axis in axes.values()} == {"UNRESOLVED"}
    assert all("SHAKE_UNMEASURED" in axis.flags for axis in axes.values())
    assert not any("SHAKE_BELOW_NOISE" in axis.flags for axis in axes.values())


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
