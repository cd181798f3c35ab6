"""Forces with a corner: one for all modes, learned with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shake_learning_data import run, true_model

from telerig.errors import InputError
from telerig.estimator.smoothing.learning.default_priors import default_model
from telerig.estimator.smoothing.learning.learn import free_names, groups_of, learn
from telerig.estimator.smoothing.learning.lines_of_sight import signals_of
from telerig.estimator.smoothing.learning.parameters import (
    FORCE,
    names_of,
    value_of,
    with_values,
)


@pytest.mark.slow
def test_a_force_with_a_corner_is_told_from_a_white_one() -> None:
    problem, _, _ = run(
        np.random.default_rng(12), bubbles=5, seconds=1.0, rate_hz=500.0,
        sigma_px=0.05, common_hz=25.0, force_hz=35.0,
    )  # fmt: skip
    found = learn(problem, default_model(problem))
    assert len(found.modes) >= 3
    assert found.force_hz == pytest.approx(35.0, rel=0.4)
    assert all(m.force_hz == found.force_hz for m in found.modes)
    assert 0.02 < found.learned[FORCE] < 0.5


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


@pytest.mark.parametrize(
    ("cutoffs", "is_free"),
    [((60.0, 60.0, None), True), ((None,) * 3, False), ((120.0, 30.0, 30.0), False)],
)
def test_a_corner_is_learned_unless_forces_are_unlike(
    cutoffs: tuple[float | None, ...], is_free: bool
) -> None:
    problem, _, _ = run(np.random.default_rng(18), bubbles=2, seconds=0.2)
    upright, across = groups_of(signals_of(problem))
    modes = tuple(replace(m, force_hz=f) for m, f in zip(true_model().modes, cutoffs))
    model = replace(true_model(), modes=modes)
    assert (FORCE in free_names(model, upright)) == is_free
    assert FORCE not in free_names(model, across)
