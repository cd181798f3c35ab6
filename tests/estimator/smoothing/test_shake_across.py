"""Shake across the vertical, which bubbles' wide swings hide: how much of it is expected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shake_learning_data import SWING_HZ, run, true_model

from telerig.estimator.smoothing.learning.default_priors import default_model
from telerig.estimator.smoothing.learning.learn import groups_of, learn, posterior_rms
from telerig.estimator.smoothing.learning.likelihood import evidence
from telerig.estimator.smoothing.learning.lines_of_sight import signals_of
from telerig.estimator.smoothing.learning.parameters import with_values
from telerig.estimator.smoothing.problem.problem import CARRIAGE, RigMode

NAME = "modes.3.rms_mm"


def test_an_rms_that_the_data_hardly_determine_is_the_root_of_its_mean_square() -> None:
    """Against a fine integral over the same evidence and prior."""
    problem, _, _ = run(np.random.default_rng(41), bubbles=3, seconds=1.0, rate_hz=100.0)
    group = groups_of(signals_of(problem))[1]
    hidden = RigMode(1.2 * SWING_HZ, 0.03, (0.1, 0.0, 0.1), CARRIAGE, None)
    model = replace(true_model(), modes=(*true_model().modes, hidden))
    found = posterior_rms(group.fast, model, NAME, 0.1)
    fine = np.linspace(-3.25, 2.25, 111)
    values = 0.1 * np.exp(fine)
    log = np.array([evidence(group.fast, with_values(model, [NAME], [v])) for v in values])
    weight = np.exp(log - log.max() - fine**2 / 2)
    assert found == pytest.approx(np.sqrt(weight @ values**2 / weight.sum()), rel=0.05)


def test_where_nothing_tells_it_is_the_priors() -> None:
    model = replace(true_model(), modes=(*true_model().modes, RigMode(9.0, 0.03, (0.1, 0.0, 0.1))))
    found = posterior_rms((), model, NAME, 0.1)
    ratio = np.random.default_rng(1).normal(size=200_000)
    ratio = ratio[(ratio > -3.25) & (ratio < 2.25)]
    assert found == pytest.approx(0.1 * np.sqrt(np.mean(np.exp(2 * ratio))), rel=0.02)


@pytest.mark.slow
def test_a_rig_that_bubbles_swings_hide_is_not_taken_for_still() -> None:
    """Modes that are found in the vertical may move across, too."""
    problem, _, _ = run(
        np.random.default_rng(46), bubbles=3, seconds=1.2, rate_hz=100.0, common_hz=8.0
    )
    found = learn(problem, default_model(problem))
    upright = [m for m in found.modes if max(m.rms_mm) == m.rms_mm[1]]
    across = [m for m in found.modes if m not in upright and m.frequency_hz < 12]
    assert upright and across
    hidden, seen = (next(m for m in modes if m.camera == CARRIAGE) for modes in (across, upright))
    assert max(hidden.rms_mm) > 0.4 * max(seen.rms_mm)
