"""Learning: its fast likelihood against the graph, and what it finds in runs of known shake."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shake_learning_data import ARM_HZ, BUBBLE_HZ, COMMON_HZ, SWING_HZ, run, true_model
from sound_runs import drawn, judged

from telerig.errors import InputError
from telerig.estimator.smoothing.graph.solve import Options, solve
from telerig.estimator.smoothing.learning.default_priors import default_model
from telerig.estimator.smoothing.learning.evidence import (
    signal_evidence,
    signal_posterior,
)
from telerig.estimator.smoothing.learning.learn import (
    groups_of,
    learn,
    overlooked,
)
from telerig.estimator.smoothing.learning.likelihood import (
    evidence,
    laplace_covariance,
    maximise,
    with_hyperparameter_uncertainty,
)
from telerig.estimator.smoothing.learning.lines_of_sight import (
    pooled,
    sight_directions,
    signals_of,
)
from telerig.estimator.smoothing.learning.parameters import (
    log_prior,
    names_of,
    value_of,
    with_values,
)
from telerig.estimator.smoothing.problem.problem import CARRIAGE, BroadBand, ShakeModel
from telerig.factors.state_space import broad_band, driven_mode, oscillator
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

OTHER = replace(
    true_model(0.4),
    broad_bands=(
        BroadBand((0.1, 0.05, 0.1), 0, floor=0.3),
        BroadBand((0.0, 0.1, 0.0)),
    ),
)


@pytest.mark.parametrize("marks", [0, 2])
def test_evidence_and_means_equal_the_graphs(marks: int) -> None:
    problem, _, _ = run(np.random.default_rng(3), bubbles=2, seconds=0.3, marks=marks, kept=0.8)
    signals = signals_of(problem)
    quiet = Options(robust=False)
    first, second = (solve(problem, m, quiet) for m in (true_model(), OTHER))
    fast = evidence(signals, true_model()) - evidence(signals, OTHER)
    assert fast == pytest.approx(first.log_evidence - second.log_evidence, abs=1e-4)

    steep = replace(OTHER, broad_bands=tuple(replace(b, tail=3) for b in OTHER.broad_bands))
    third = solve(problem, steep, quiet).log_evidence  # so stiff a prior costs digits
    fast = evidence(signals, OTHER) - evidence(signals, steep)
    assert fast == pytest.approx(second.log_evidence - third, abs=0.02)

    states = first.state.bubbles @ first.graph.bubble.position.T
    for signal in signals[:1]:
        found = signal_posterior(signal, true_model())
        start = [bubble.start_mm @ signal.direction for bubble in problem.bubbles[:2]]
        place = (found.position_mm + np.array(start)[:, None]).ravel()
        np.testing.assert_allclose(place, states @ signal.direction, atol=1e-6)


def test_shared_coordinate_comes_first_and_depth_is_never_a_channel() -> None:
    problem, _, _ = run(np.random.default_rng(0), seconds=0.1)
    found = sight_directions(problem)
    np.testing.assert_allclose(found[0][0], [0, 1, 0], atol=1e-12)
    assert [cameras for _, cameras in found] == [(0, 1), (0,), (1,)]
    for direction, cameras in found:
        for c in cameras:
            assert abs(direction @ problem.cameras[c].camera_from_rig.rotation[2]) < 1e-12


def test_mean_and_differences_of_alike_bubbles_have_the_whole_likelihood() -> None:
    problem, _, _ = run(np.random.default_rng(1), bubbles=4, seconds=0.5)
    signal = signals_of(problem)[0]
    parts = pooled(signal)
    assert [p.shaken for p in parts] == [True, False]
    whole = signal_evidence(signal, true_model()) - signal_evidence(signal, true_model(0.4))
    assert evidence(parts, true_model()) - evidence(parts, true_model(0.4)) == pytest.approx(
        whole, abs=1e-4
    )


def test_all_bubbles_are_learned_from_where_they_cost_as_much_as_two() -> None:
    rng = np.random.default_rng(9)
    seen, _, _ = run(rng, bubbles=10, seconds=0.5)
    half, _, _ = run(rng, bubbles=10, seconds=0.5, kept=0.5)
    marked, _, _ = run(rng, bubbles=10, seconds=0.5, marks=1)
    for problem, count in ((seen, 10), (half, 6), (marked, 6)):
        assert [int(s.moving.sum()) for s in signals_of(problem)] == [count] * 3
    assert [len(pooled(signal)) for signal in signals_of(seen)] == [2] * 3


def test_density_integrates_to_the_variance() -> None:
    f = np.arange(0.01, 1000, 0.02)
    for part in (oscillator(0.3, 8, 0.05), driven_mode(0.3, 8, 0.05), broad_band(0.3)):
        assert part.density(f).sum() * 0.02 == pytest.approx(0.09, rel=0.01)


def test_parameters_by_name() -> None:
    model = true_model()
    names = names_of(model)
    values = [value_of(model, n) for n in names]
    again = with_values(model, names, values)
    assert [value_of(again, n) for n in names] == pytest.approx(values)
    doubled = with_values(model, ["bubble.zigzags.0.rms_mm"], [4.0])
    assert doubled.bubble.zigzags[0].rms_mm == (4.0, 0.0, 4.0)
    assert log_prior(model, names) < 0
    with pytest.raises(InputError, match="the model has no"):
        value_of(model, "modes.7.damping")
    with pytest.raises(InputError, match="not a hyper-parameter"):
        log_prior(model, ["encoder_sigma_mm"])


def test_maximum_is_above_the_truth_and_laplace_covers_it() -> None:
    problem, _, _ = run(np.random.default_rng(5), bubbles=3)
    parts = pooled(signals_of(problem)[0])
    names = ["modes.0.frequency_hz", "modes.0.rms_mm"]
    truth = true_model()
    fit = maximise(parts, truth, names)
    assert fit.log_posterior >= evidence(parts, truth) + log_prior(truth, names) - 1e-6
    covariance = laplace_covariance(parts, fit.model, names)
    off = np.log([value_of(truth, n) / value_of(fit.model, n) for n in names])
    assert off @ np.linalg.solve(covariance, off) < 14
    # a line of 1.5 s cannot be known better than a fraction of its width, nor worse than it
    assert 0.005 < np.sqrt(covariance[0, 0]) < 0.05


def test_a_pump_that_shakes_both_arms_at_two_frequencies_is_no_motion_of_the_bubbles() -> None:
    """More lines than one mode of the rig and one of each arm: NEES was 0.3, 46 and 28."""
    found = judged(drawn(20672))
    assert not found["alarms"] and max(found["nees"]) < 2.0


def test_several_bubbles_tell_their_own_line_from_the_rigs() -> None:
    problem, lab, _ = run(np.random.default_rng(7), bubbles=4, seconds=1.5, rate_hz=80.0)
    found = learn(problem, default_model(problem))
    common = [m for m in found.modes if m.camera == CARRIAGE and m.rms_mm[1] > 0.08]
    lines = [z for z in found.bubble.zigzags if z.rms_mm[1] > 0.08]
    assert [m.frequency_hz for m in common] == pytest.approx([COMMON_HZ], rel=0.08)
    assert [z.frequency_hz for z in lines] == pytest.approx([BUBBLE_HZ], rel=0.08)
    swing = max(found.bubble.zigzags, key=lambda z: z.rms_mm[0])
    assert swing.frequency_hz == pytest.approx(SWING_HZ, rel=0.1)

    def error(model: ShakeModel) -> float:
        place = signal_posterior(signals_of(problem)[0], model).position_mm
        off = place + lab[:, 0, 1, None] - lab[:, :, 1]
        return float(np.sqrt(np.mean(off[:, 20:-20] ** 2)))

    assert error(found) < 1.15 * error(true_model())


@pytest.mark.parametrize("bubbles", [1, 2])
def test_bubbles_too_few_to_tell_their_motion_from_the_rigs_keep_the_default(bubbles: int) -> None:
    problem, _, _ = run(np.random.default_rng(7), bubbles=bubbles, seconds=0.5, rate_hz=80.0)
    default = default_model(problem)
    assert learn(problem, default) is default


def test_learned_parameters_widen_the_covariances_by_what_they_move() -> None:
    problem, _, _ = run(np.random.default_rng(10), bubbles=2, seconds=0.5)
    names = {"modes.0.frequency_hz": 0.05}
    model = replace(true_model(), learned=names)
    solution = solve(problem, model, Options(robust=False))
    wider = with_hyperparameter_uncertainty(solution)
    assert solution.covariances is not None and wider.covariances is not None
    moved = [
        solve(
            problem,
            with_values(model, list(names), [9.0 * np.exp(s * 0.05)]),
            Options(robust=False),
        )
        for s in (1, -1)
    ]
    row = solution.graph.bubble.position[1]
    step = (moved[0].state.bubbles - moved[1].state.bubbles) @ row / 2
    added = wider.covariances.bubbles - solution.covariances.bubbles
    np.testing.assert_allclose(row @ added @ row, np.mean(step**2), rtol=1e-3)
    offset = solution.graph.shake.offset[1][1]
    nodes = solution.graph.nodes.of_frame
    step = (moved[0].state.shake - moved[1].state.shake)[nodes] @ offset / 2
    added = wider.covariances.shake - solution.covariances.shake
    np.testing.assert_allclose(offset @ added @ offset, np.mean(step**2), rtol=1e-3)
    plain = solve(problem, true_model(), Options(robust=False))
    assert with_hyperparameter_uncertainty(plain) is plain
    nothing = (np.zeros_like(solution.weights[0]), np.zeros_like(solution.weights[1]))
    unused = replace(solution, weights=nothing)
    assert with_hyperparameter_uncertainty(unused) is unused


@pytest.mark.parametrize("angle_deg", [40.0, 90.0, 140.0])
def test_lines_across_are_as_wide_whichever_way_the_cameras_look(angle_deg: float) -> None:
    """A line's RMS found along one camera's lateral direction is that along the other's."""
    problem, _, _ = run(np.random.default_rng(17), bubbles=1, seconds=0.2)
    turned = Pose.from_rotvec([0.0, np.deg2rad(angle_deg), 0.0])
    right = Camera.create("right", (1024, 1024), 10.0, camera_from_rig=turned)
    signals = signals_of(replace(problem, cameras=(problem.cameras[0], right)))
    upright, across = groups_of(signals)
    np.testing.assert_allclose(upright.pattern, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(across.pattern, [1, 0, 1], atol=1e-12)
    # one camera alone knows nothing of its own depth
    single = groups_of(signals[:2])[1]
    np.testing.assert_allclose(single.pattern, np.abs(signals[1].direction), atol=1e-12)


@pytest.mark.parametrize("seed", [2, 4])
def test_a_common_mode_at_the_bubbles_own_frequency_is_found(seed: int) -> None:
    """Without a start there it is taken for 9 and 36 Hz, in the second run with a tenth of it."""
    problem, *_ = run(np.random.default_rng(seed), bubbles=5, seconds=0.6, common_hz=BUBBLE_HZ)
    (common, *_) = learn(problem, default_model(problem)).modes
    assert common.camera == CARRIAGE
    assert common.frequency_hz == pytest.approx(BUBBLE_HZ, rel=0.1)
    assert 0.1 < common.rms_mm[1] < 0.25


def test_both_arms_are_tried_alike_after_one_took_all() -> None:
    """Only the difference of the cameras' motions is seen well, which one arm alone explains."""
    model = true_model()
    strong, weak = (replace(model.modes[1], rms_mm=(0.0, mm, 0.0)) for mm in (0.08, 0.0))
    weak = replace(weak, camera=1, frequency_hz=15.0)
    problem, *_ = run(np.random.default_rng(1), bubbles=5, seconds=0.2)
    group = groups_of(signals_of(problem))[0]
    alike, hidden = overlooked(replace(model, modes=(model.modes[0], strong, weak)), group)
    assert [m.frequency_hz for m in alike.modes] == [COMMON_HZ, ARM_HZ, ARM_HZ]
    assert [m.camera for m in alike.modes] == [CARRIAGE, 0, 1]
    np.testing.assert_allclose([m.rms_mm[1] for m in alike.modes[1:]], 0.08 / np.sqrt(2))
    assert [m.frequency_hz for m in hidden.modes] == [BUBBLE_HZ, ARM_HZ, 15.0]
