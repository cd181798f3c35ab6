"""Hyper-parameters held against parts of a run that they were not learned from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shake_learning_data import ARM_HZ, run, true_model

from telerig.estimator.smoothing.learning import window
from telerig.estimator.smoothing.learning.cross_validation import cross_validate, learning_record


@pytest.fixture(autouse=True)
def _short_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "MOST_FRAMES", 300)


def test_a_right_model_holds_in_the_rest_of_the_run() -> None:
    problem, _, _ = run(np.random.default_rng(1), bubbles=4, seconds=6)
    model = true_model()
    found = cross_validate(problem, model)
    assert len(found) == 3
    for one in found:
        assert 0.85 < one.square < 1.15
        assert one.to_s - one.from_s == pytest.approx(1.495)
        assert not one.drifted(model)
    record, warnings = learning_record(problem, model)
    assert record["frames"] == 300
    assert len(record["held_out"]) == 3
    assert not warnings


def test_a_mode_that_drifts_along_the_run_is_said() -> None:
    problem, _, _ = run(np.random.default_rng(1), bubbles=4, seconds=4)
    model = true_model()
    other = tuple(
        replace(m, frequency_hz=1.2 * ARM_HZ) if m.camera == 0 else m for m in model.modes
    )
    _, warnings = learning_record(problem, replace(model, modes=other))
    assert any("drifts along the run: 24 Hz" in words for words in warnings)


def test_a_model_that_does_not_describe_the_rest_of_the_run_is_said() -> None:
    problem, _, _ = run(np.random.default_rng(1), bubbles=4, seconds=4)
    _, warnings = learning_record(problem, replace(true_model(), pixel_inflation=0.5))
    assert any("does not describe the run" in words for words in warnings)
