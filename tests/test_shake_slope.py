"""The slope of the evidence against differences of the evidence itself, and dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from shake_learning_data import run, true_model

from telerig.estimator.shake_channels import Channel, channels_of, pooled
from telerig.estimator.shake_evidence import Factor, channel_evidence
from telerig.estimator.shake_likelihood import evidence, evidence_slope, laplace_sigma
from telerig.estimator.shake_parameters import log_prior, names_of, prior_of, value_of, with_values
from telerig.estimator.shake_slope import channel_slope, inverse_blocks
from telerig.estimator.smoother.model import BroadBand, ShakeModel

Array = NDArray[np.float64]

BANDS = (BroadBand((0.1, 0.05, 0.1), 0, slow_rms_mm=0.02), BroadBand((0.0, 0.1, 0.0)))
MODELS = {
    "modes": true_model(),
    "bands": replace(true_model(0.4), broad_bands=BANDS),
    "forced": replace(
        true_model(), modes=tuple(replace(m, force_hz=60.0) for m in true_model().modes)
    ),
}


def differences(channel: Channel, model: ShakeModel, names: list[str]) -> Array:
    h, out = 1e-4, []
    for name in names:
        at = value_of(model, name)
        up, down = (with_values(model, [name], [at * np.exp(s * h)]) for s in (1, -1))
        out.append((channel_evidence(channel, up) - channel_evidence(channel, down)) / (2 * h))
    return np.array(out)


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize(("kept", "marks"), [(0.8, 2), (0.9, 0), (1.0, 0)])
def test_slope_equals_differences_of_the_evidence(kind: str, kept: float, marks: int) -> None:
    problem, _, _ = run(np.random.default_rng(3), bubbles=3, seconds=0.3, marks=marks, kept=kept)
    model = replace(MODELS[kind], pixel_inflation=1.2)
    names = names_of(model)
    for channel in channels_of(problem)[:2]:
        for part in (channel, *pooled(channel)):
            value, slope = channel_slope(part, model, names)
            assert value == pytest.approx(channel_evidence(part, model), abs=1e-9)
            # differences of an evidence of 1e4 nats are good to about 1e-2 with broad bands
            np.testing.assert_allclose(slope, differences(part, model, names), atol=0.03, rtol=1e-4)


def test_slope_with_frames_at_uneven_times_and_a_still_target() -> None:
    problem, _, _ = run(np.random.default_rng(4), bubbles=2, seconds=0.3, kept=0.7)
    uneven = problem.t_s + np.random.default_rng(5).uniform(0, 4e-3, len(problem.t_s))
    names = names_of(true_model())
    for fixed in (False, True):
        channel = channels_of(replace(problem, t_s=uneven), fixed=fixed)[0]
        slope = channel_slope(channel, true_model(), names)[1]
        np.testing.assert_allclose(
            slope, differences(channel, true_model(), names), atol=2e-3, rtol=1e-5
        )
        # what does not move has no motion to learn
        moves = [n.startswith("bubble") and slope[i] != 0 for i, n in enumerate(names)]
        assert any(moves) != fixed


def test_blocks_of_the_inverse_equal_the_dense_inverse() -> None:
    problem, _, _ = run(np.random.default_rng(6), bubbles=2, seconds=0.1)
    factor = Factor(channels_of(problem)[0], true_model())
    size, count = factor.rows.shape[-1], len(problem.t_s)
    lower = np.zeros((size * count,) * 2)
    for offset, row in enumerate(factor.factor):
        lower += np.diag(row[: size * count - offset], -offset)
    dense = np.linalg.inv(lower @ lower.T).reshape(count, size, count, size)
    own, below = inverse_blocks(factor)
    at = np.arange(count)
    np.testing.assert_allclose(own, dense[at, :, at], atol=1e-9 * np.abs(dense).max())
    np.testing.assert_allclose(below, dense[at[1:], :, at[:-1]], atol=1e-9 * np.abs(dense).max())


def test_laplace_equals_second_differences_of_the_posterior() -> None:
    problem, _, _ = run(np.random.default_rng(7), bubbles=3)
    parts, names = pooled(channels_of(problem)[0]), ["modes.0.rms_mm", "bubble.velocity_tau_s"]
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
    found = np.linalg.inv(laplace_sigma(parts, true_model(), names)) * scale[:, None] * scale
    np.testing.assert_allclose(found, second, rtol=0.02, atol=0.02 * np.abs(second).max())


def test_a_model_that_is_not_sound_has_no_slope(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _, _ = run(np.random.default_rng(8), seconds=0.1)
    channels = channels_of(problem)[:1]

    def fails(*_: object) -> None:
        raise np.linalg.LinAlgError

    monkeypatch.setattr("telerig.estimator.shake_likelihood.channel_slope", fails)
    value, slope = evidence_slope(channels, true_model(), names_of(true_model()))
    assert value < -1e11
    assert not slope.any()


def test_what_a_parameter_does_not_touch_is_left_out() -> None:
    problem, _, _ = run(np.random.default_rng(9), bubbles=3, seconds=0.2)
    apart = pooled(channels_of(problem)[0])[1]
    names = names_of(true_model())
    slope = dict(zip(names, channel_slope(apart, true_model(), names)[1]))
    assert all(slope[n] == 0 for n in names if n.startswith("modes"))
    assert slope["bubble.zigzags.1.rms_mm"] != 0
