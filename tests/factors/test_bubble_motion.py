"""The processes of a bubble: what smoothing, learning and tracking take from one place."""

from __future__ import annotations

import numpy as np
import pytest

from telerig.estimator.smoothing.graph.layout import bubble_layout
from telerig.factors.bubble_motion import (
    BubbleModel,
    Zigzag,
    bubble_processes,
    lateral_motion,
    rise_motion,
)
from telerig.factors.state_space import exact_step, stationary_covariance

MODEL = BubbleModel(
    velocity_sigma_mm_s=12.0,
    zigzags=(Zigzag(6.0, 0.03, (2.0, 0.0, 1.5)), Zigzag(12.0, 0.04, (0.0, 0.2, 0.0), 60.0)),
)


def test_the_smoother_lays_out_these_processes_along_each_axis() -> None:
    layout = bubble_layout(MODEL, 2)
    processes = [bubble_processes(MODEL, axis) for axis in np.eye(3)]
    assert [len(p) for p in processes] == [2, 2, 2]
    names = [c.name for c in layout.components]
    assert names == ["ou_velocity"] * 3 + ["oscillator", "oscillator", "driven_mode"]
    assert layout.components[5] is processes[1][1].component
    assert layout.components[3].input.shape[1] == 0 and layout.components[0].input.shape[1] == 1


def test_the_mean_of_bubbles_has_their_share_of_the_variance() -> None:
    direction = np.array([0.6, 0.0, 0.8])
    one = bubble_processes(MODEL, direction, mean_known=True)
    mean = bubble_processes(MODEL, direction, bubbles=4, mean_known=True)
    assert [p.stem for p in one] == ["bubble", "bubble.zigzags.0"]
    for single, pooled in zip(one, mean):
        np.testing.assert_allclose(
            pooled.component.start_covariance, single.component.start_covariance / 4
        )
    assert one[0].component.input.shape[1] == 0, "the mean velocity is no input of the states"
    rms = np.sqrt(one[1].component.start_covariance[0, 0])
    assert rms == pytest.approx(np.hypot(0.6 * 2.0, 0.8 * 1.5))


def test_a_moved_hyper_parameter_changes_that_one_alone() -> None:
    path, zigzag = bubble_processes(MODEL, np.eye(3)[0])
    assert path.moved("velocity_tau_s", 2.0).drift[1, 1] == pytest.approx(-1 / 0.6)
    assert zigzag.moved("rms_mm", 3.0).start_covariance[0, 0] == pytest.approx(36.0)
    assert zigzag.component is bubble_processes(MODEL, np.eye(3)[0])[1].component


def test_a_trackers_motions_have_the_stated_rms() -> None:
    drift, noise = rise_motion(1800.0, 0.02)
    assert stationary_covariance(drift[2:3, 2:3], noise[2:3]) == pytest.approx(1800.0**2)
    drift, noise = lateral_motion(3000.0, 6.5, 0.2, 100.0, 0.5)
    assert stationary_covariance(drift[3:, 3:], noise[3:, 1:]) == pytest.approx(100.0**2)
    still = drift[1:3, 1:3]
    found = stationary_covariance(still, noise[1:3, :1])
    assert found[1, 1] == pytest.approx(3000.0**2), "acceleration of the oscillation alone"


def test_a_tracker_may_know_a_motion_without_noise() -> None:
    transition, covariance = exact_step(*rise_motion(0.0, 0.02), 0.01)
    assert np.all(covariance == 0) and transition[0, 1] == pytest.approx(0.01)
    assert transition[3, 3] == 1
