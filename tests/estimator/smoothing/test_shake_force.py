"""Forces with a corner, whose line it is, and the room for a rig's line beside the bubbles'."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from seeds import first_or_all
from shake_learning_data import BUBBLE_HZ, COMMON_HZ, run, true_model

from telerig.errors import InputError
from telerig.estimator.smoothing.learning.default_priors import default_model
from telerig.estimator.smoothing.learning.learn import (
    Learning,
    Step,
    free_names,
    groups_of,
    learn,
    try_low_pass_force,
    try_white_force,
)
from telerig.estimator.smoothing.learning.likelihood import evidence, maximise
from telerig.estimator.smoothing.learning.lines_of_sight import pooled, signals_of
from telerig.estimator.smoothing.learning.parameters import (
    FORCE,
    names_of,
    value_of,
    with_low_pass_force,
    with_values,
)
from telerig.estimator.smoothing.learning.spectral_lines import (
    Attribution,
    hidden_mode_weights,
    with_hidden_modes,
    with_split_lines,
)
from telerig.estimator.smoothing.problem.problem import CARRIAGE, RigMode
from telerig.factors.bubble_motion import Zigzag


def test_a_force_with_a_corner_is_told_from_a_white_one() -> None:
    problem, _, _ = run(
        np.random.default_rng(12), bubbles=1, still=True, seconds=1.0, rate_hz=500.0,
        sigma_px=0.05, common_hz=25.0, force_hz=35.0,
    )  # fmt: skip
    found = learn(problem, default_model(problem), Learning(target=True, most_modes=1))
    assert len(found.modes) >= 3
    assert found.force_hz == pytest.approx(35.0, rel=0.4)
    assert all(m.force_hz == found.force_hz for m in found.modes)
    assert 0.02 < found.learned[FORCE] < 0.5


@pytest.mark.parametrize("seed", first_or_all(21, 22))
def test_a_white_force_gets_no_corner(seed: int) -> None:
    """Both are climbed as far: what more steps gain is not laid to the corner."""
    problem, _, _ = run(
        np.random.default_rng(seed), bubbles=1, seconds=1.0, rate_hz=250.0, sigma_px=0.15,
        common_hz=9.0, force_hz=2000.0,
    )  # fmt: skip
    group = groups_of(signals_of(problem), Learning(), problem.up)[0]
    begun = replace(true_model(), modes=(replace(true_model().modes[0], damping=0.1),))
    step = Step(maximise(group.fast, begun, names_of(begun)[:3], steps=2), (CARRIAGE,))
    after = try_low_pass_force(group, step, Learning(), True)
    assert after.fit.model.force_hz is None
    assert after.fit.log_evidence > step.fit.log_evidence
    # one that was given is taken away again
    corner = maximise(
        group.fast, with_low_pass_force(after.fit.model, 200.0), names_of(after.fit.model), steps=4
    )
    assert try_white_force(group, corner, Learning()).model.force_hz is None
    held = try_white_force(group, corner, Learning(hold=(FORCE,)))
    assert held.model.force_hz == 200.0


def test_one_corner_is_every_modes_that_has_one() -> None:
    white = true_model()
    assert white.force_hz is None
    assert FORCE not in names_of(white)
    with pytest.raises(InputError, match="the model has no"):
        value_of(white, FORCE)
    swing, line = white.bubble.zigzags
    bubble = replace(white.bubble, zigzags=(swing, replace(line, force_hz=50.0)))
    modes = (replace(white.modes[0], force_hz=50.0), *white.modes[1:])
    one = replace(white, modes=modes, bubble=bubble)
    assert value_of(one, FORCE) == 50.0
    moved = with_values(one, [FORCE], [80.0])
    assert [m.force_hz for m in moved.modes] == [80.0, None, None]
    assert [z.force_hz for z in moved.bubble.zigzags] == [None, 80.0]
    assert [m.force_hz for m in with_low_pass_force(white, 30.0).modes] == [30.0] * 3


@pytest.mark.parametrize(
    ("cutoffs", "hold", "is_free"),
    [
        ((60.0, 60.0, None), (), True),
        ((60.0, 60.0, 60.0), ("modes.*.frequency_hz",), True),
        ((60.0, 60.0, 60.0), ("modes.force_hz",), False),
        ((60.0, 60.0, 60.0), ("modes.0.*",), False),
        ((None, None, None), (), False),
        ((120.0, 30.0, 30.0), (), False),
    ],
)
def test_a_corner_is_learned_unless_it_is_held_or_unlike(
    cutoffs: tuple[float | None, ...], hold: tuple[str, ...], is_free: bool
) -> None:
    problem, _, _ = run(np.random.default_rng(18), bubbles=2, seconds=0.2)
    upright, across = groups_of(signals_of(problem), Learning(), problem.up)
    modes = tuple(replace(m, force_hz=f) for m, f in zip(true_model().modes, cutoffs))
    model, options = replace(true_model(), modes=modes), Learning(hold=hold)
    assert (FORCE in free_names(model, upright, options, True)) == is_free
    assert FORCE not in free_names(model, across, options, False)


def test_an_ambiguous_line_is_halved_without_changing_one_bubbles_likelihood() -> None:
    """Also where the rig's other lines have a corner: the halves add up to the line."""
    problem, _, _ = run(np.random.default_rng(9), sigma_px=0.1)
    signals = signals_of(problem)[:1]
    for model in (true_model(), with_low_pass_force(true_model(), 20.0)):
        doubtful = [
            Attribution("rig", 0, COMMON_HZ, 0.2, 0.0),
            Attribution("bubble", 1, 13.0, 0.2, 0.0),
        ]
        halved = with_split_lines(model, doubtful)
        assert len(halved.modes) == len(model.modes) + 1
        at = evidence(signals, model)
        assert evidence(signals, halved) == pytest.approx(at, abs=1e-5)


def test_prior_weights_of_a_line_beside_the_bubbles() -> None:
    line, shares = Zigzag(12.0, 0.03, (0.0, 0.2, 0.0)), np.linspace(0, 1, 6)
    mode = RigMode(30.0, 0.03, (0.0, 0.4, 0.0))
    np.testing.assert_array_equal(hidden_mode_weights(line, []), np.ones(6))
    near = replace(mode, frequency_hz=13.5)
    np.testing.assert_array_equal(hidden_mode_weights(line, [near]), np.ones(6))
    weight = hidden_mode_weights(line, [replace(mode, frequency_hz=4.0), near, mode])
    # a fifth of a decade about 12 Hz under a log-normal prior, three modes
    each = norm.cdf(np.log(13.2 / 15), 0, 1.5) - norm.cdf(np.log(10.8 / 15), 0, 1.5)
    chance = 1 - (1 - each) ** 3
    size = shares * 0.2 / 0.4
    np.testing.assert_allclose(weight[1:], (chance + (1 - chance) * size**2)[1:], rtol=0.01)
    assert weight.sum() == pytest.approx(6.0)
    weak = replace(mode, rms_mm=(0.0, 0.02, 0.0))
    np.testing.assert_allclose(hidden_mode_weights(line, [weak])[1:], 1.0)
    # as strong as the arms': the main line is seen, and whatever lies here does so by chance
    arm = RigMode(60.0, 0.03, (0.0, 0.3, 0.0), 0)
    np.testing.assert_allclose(hidden_mode_weights(line, [mode, arm])[1:], chance, rtol=0.01)
    half = replace(mode, rms_mm=(0.0, 0.15, 0.0))
    size = np.minimum(shares * 0.2 / 0.15, 1)
    wanted = chance + (1 - chance) * (1 - 0.5**4) * size**2
    np.testing.assert_allclose(hidden_mode_weights(line, [half, arm])[1:], wanted[1:], rtol=0.01)


@pytest.mark.slow
def test_beside_a_line_is_less_room_where_the_rig_shows_a_stronger_one() -> None:
    """Elsewhere, of its own: then a second one just here would be a coincidence."""
    problem, _, _ = run(np.random.default_rng(16), bubbles=3, rate_hz=60.0)
    signals, true = pooled(signals_of(problem)[0]), true_model()

    def room(*common: RigMode) -> float:
        modes = (*common, *true.modes[1:])
        found = with_hidden_modes(signals, replace(true, modes=modes), (0, 1, 0), problem.up)
        added = found.modes[len(modes) :]
        return max((m.rms_mm[1] for m in added if round(m.frequency_hz) == BUBBLE_HZ), default=0.0)

    strong = true.modes[0]
    weak = replace(strong, rms_mm=(0.0, 0.02, 0.0))
    near = replace(strong, frequency_hz=1.2 * BUBBLE_HZ)
    across = replace(strong, rms_mm=(0.2, 0.0, 0.2))
    assert room(strong) < 0.8 * min(room(), room(weak), room(near), room(across))


def test_beside_the_rigs_hidden_line_the_bubbles_own_gets_its_width_back() -> None:
    """Fitted without the rig's, it was wider: it had to be what the bubbles have in common, too."""
    problem, _, _ = run(np.random.default_rng(19), bubbles=4, common_hz=BUBBLE_HZ)
    signals, true = pooled(signals_of(problem)[0]), true_model()
    missed = replace(true, modes=true.modes[1:])
    names = [f"bubble.zigzags.1.{n}" for n in ("frequency_hz", "damping", "rms_mm")]
    alone = maximise(signals, missed, names).model
    found = with_hidden_modes(signals, alone, (0, 1, 0), problem.up)
    assert [m.camera for m in found.modes] == [0, 1, CARRIAGE]
    wide, own = (m.bubble.zigzags[1].rms_mm[1] for m in (alone, found))
    assert abs(own - 0.18) < 0.7 * abs(wide - 0.18)
    assert own < 0.95 * wide
    assert evidence(signals, found) > evidence(signals, alone)
