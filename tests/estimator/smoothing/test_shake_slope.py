"""The slope of the evidence against differences of the evidence itself, and dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from shake_learning_data import run, true_model

from telerig.estimator.smoothing.learning.evidence import (
    eliminated,
    signal_evidence,
    signal_gradient,
)
from telerig.estimator.smoothing.learning.likelihood import (
    evidence,
    evidence_gradient,
    laplace_covariance,
)
from telerig.estimator.smoothing.learning.lines_of_sight import Signal, pooled, signals_of
from telerig.estimator.smoothing.learning.parameters import (
    log_prior,
    names_of,
    prior_of,
    value_of,
    with_values,
)
from telerig.estimator.smoothing.problem.problem import BroadBand, ShakeModel
from telerig.factors.bubble_motion import Zigzag

Array = NDArray[np.float64]

BANDS = (BroadBand((0.1, 0.05, 0.1), 0), BroadBand((0.0, 0.1, 0.0)))


def driven(model: ShakeModel, force_hz: float) -> ShakeModel:
    """The model whose modes' forces have a corner."""
    return replace(model, modes=tuple(replace(m, force_hz=force_hz) for m in model.modes))


def partly_forced() -> ShakeModel:
    white = true_model()
    common, left, _ = driven(white, 45.0).modes
    line = Zigzag(common.frequency_hz, common.damping, common.rms_mm, common.force_hz)
    bubble = replace(white.bubble, zigzags=(*white.bubble.zigzags, line))
    return replace(white, modes=(common, left, white.modes[2]), bubble=bubble)


MODELS = {
    "modes": true_model(),
    "bands": replace(true_model(0.4), broad_bands=BANDS),
    "with_low_pass_force": driven(true_model(), 60.0),
    "partly with_low_pass_force": partly_forced(),
}


def differences(signal: Signal, model: ShakeModel, names: list[str]) -> Array:
    h, out = 5e-4, []
    for name in names:
        at = value_of(model, name)
        up, down = (with_values(model, [name], [at * np.exp(s * h)]) for s in (1, -1))
        out.append((signal_evidence(signal, up) - signal_evidence(signal, down)) / (2 * h))
    return np.array(out)


@pytest.mark.parametrize(
    ("kind", "kept", "marks"),
    [
        ("modes", 0.8, 2),
        ("modes", 0.9, 0),
        ("bands", 1.0, 0),
        ("with_low_pass_force", 0.9, 0),
        ("partly with_low_pass_force", 0.8, 2),
        ("partly with_low_pass_force", 1.0, 0),
    ],
)
def test_slope_equals_differences_of_the_evidence(kind: str, kept: float, marks: int) -> None:
    problem, _, _ = run(np.random.default_rng(3), bubbles=3, seconds=0.3, marks=marks, kept=kept)
    model = replace(MODELS[kind], pixel_inflation=1.2)
    names = names_of(model)
    for signal in signals_of(problem)[: 2 if kind == "modes" else 1]:
        for part in (signal, *pooled(signal)):
            value, slope = signal_gradient(part, model, names)
            assert value == pytest.approx(signal_evidence(part, model), abs=1e-9)
            # the evidence of broad bands, stiff in double precision, has noise of 1e-5
            np.testing.assert_allclose(slope, differences(part, model, names), atol=0.03, rtol=1e-4)


def test_slope_with_frames_at_uneven_times() -> None:
    problem, _, _ = run(np.random.default_rng(4), bubbles=2, seconds=0.3, kept=0.7)
    uneven = problem.t_s + np.random.default_rng(5).uniform(0, 4e-3, len(problem.t_s))
    names = names_of(true_model())
    signal = signals_of(replace(problem, t_s=uneven))[0]
    slope = signal_gradient(signal, true_model(), names)[1]
    np.testing.assert_allclose(
        slope, differences(signal, true_model(), names), atol=2e-3, rtol=1e-5
    )


def test_the_chains_solution_and_covariances_equal_dense_algebra() -> None:
    rng = np.random.default_rng(6)
    frames, size = 7, 3
    own = np.array([a @ a.T + 3 * np.eye(size) for a in rng.normal(size=(frames, size, size))])
    below, sides = rng.normal(0, 0.4, (frames - 1, size, size)), rng.normal(size=(frames, 2, size))
    dense = np.zeros((frames, size, frames, size))
    for t in range(frames):
        dense[t, :, t] = own[t]
    for t in range(frames - 1):
        dense[t + 1, :, t], dense[t, :, t + 1] = below[t], below[t].T
    precision = dense.reshape(frames * size, -1)
    inverse = np.linalg.inv(precision)
    blocks = inverse.reshape(dense.shape)
    chain = eliminated(own, below, sides)
    assert chain.log_det() == pytest.approx(np.linalg.slogdet(precision)[1] / 2)
    mean, spread, across = chain.moments(chain.sides)
    whole = (inverse @ np.swapaxes(sides, 0, 1).reshape(2, -1).T).reshape(frames, size, 2)
    np.testing.assert_allclose(mean, np.swapaxes(whole, -1, -2), atol=1e-12)
    at = np.arange(frames)
    np.testing.assert_allclose(spread, blocks[at, :, at], atol=1e-12)
    np.testing.assert_allclose(across, blocks[at[1:], :, at[:-1]], atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        eliminated(-np.ones((2, 1, 1)), np.zeros((1, 1, 1)), np.zeros((2, 1, 1)))


def test_laplace_equals_second_differences_of_the_posterior() -> None:
    problem, _, _ = run(np.random.default_rng(7), bubbles=3)
    parts, names = pooled(signals_of(problem)[0]), ["modes.0.rms_mm", "bubble.velocity_tau_s"]
    at = np.log([value_of(true_model(), n) for n in names])
    scale = np.array([prior_of(n).step for n in names])

    def cost(step: Array) -> float:
        moved = with_values(true_model(), names, np.exp(at + step * scale).tolist())
        return -evidence(parts, moved) - log_prior(moved, names)

    h, unit = 0.25, np.eye(2)
    second = np.array(
        [[cost(h * (a + b)) - cost(h * (a - b)) - cost(h * (b - a)) + cost(-h * (a + b))
          for b in unit] for a in unit]
    ) / (4 * h * h)  # fmt: skip
    found = np.linalg.inv(laplace_covariance(parts, true_model(), names)) * scale[:, None] * scale
    np.testing.assert_allclose(found, second, rtol=0.02, atol=0.02 * np.abs(second).max())


def test_a_model_that_is_not_sound_has_no_slope(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _, _ = run(np.random.default_rng(8), seconds=0.1)
    signals = signals_of(problem)[:1]

    def fails(*_: object) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr("telerig.estimator.smoothing.learning.likelihood.signal_gradient", fails)
    value, slope = evidence_gradient(signals, true_model(), names_of(true_model()))
    assert value < -1e11
    assert not slope.any()


def test_what_a_parameter_does_not_touch_is_left_out() -> None:
    problem, _, _ = run(np.random.default_rng(9), bubbles=3, seconds=0.2)
    apart = pooled(signals_of(problem)[0])[1]
    names = names_of(true_model())
    slope = dict(zip(names, signal_gradient(apart, true_model(), names)[1]))
    assert all(slope[n] == 0 for n in names if n.startswith("modes"))
    assert slope["bubble.zigzags.1.rms_mm"] != 0
