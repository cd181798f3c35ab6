"""A factor between stage and arms: known where they move together, open where an arm resonates."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import Generator
from scipy.signal import lfilter

from telerig.arrays import Array
from telerig.estimator.sensors.response import CommonGain, Response

STEP_S, COUNT = 0.002, 1000
ALL = np.ones(COUNT, bool)


def resonant(push: Array, hz: float, share: float) -> Array:
    """Absolute acceleration of an arm on a stage: a mode of 3 % damping takes a share."""
    w, damping = 2 * np.pi * hz * STEP_S, 0.03
    r = np.exp(-damping * w)
    mode = lfilter([1, -2, 1], [1, -2 * r * np.cos(w), r * r], push)
    return np.asarray(push - share * mode)


def common(stage: Array, *arms: Array) -> CommonGain:
    found = CommonGain.of([Response.of(arm, stage, ALL) for arm in arms])
    assert found is not None
    return found


@pytest.fixture
def rng() -> Generator:
    return np.random.default_rng(16)


@pytest.mark.parametrize("factor", [1.0, 1000.0, 25.4, -1.0, 4.0])
def test_arms_that_move_with_the_stage_show_the_factor_of_the_encoder(
    rng: Generator, factor: float
) -> None:
    push = rng.normal(size=COUNT)
    found = common(push / factor, push + 0.5 * rng.normal(size=COUNT), push)
    assert found.gain == pytest.approx(abs(factor), rel=0.2)
    assert found.excludes(1.0) == (abs(factor) != 1) and not found.excludes(abs(factor))
    assert found.opposed == (factor < 0)


def test_arms_that_resonate_show_no_wrong_factor(rng: Generator) -> None:
    """A rate of false alarms of 1 in 1,000: none in 300, with arms of 6 to 40 Hz."""
    for _ in range(300):
        push = rng.normal(size=COUNT)
        arms = [resonant(push, hz, rng.uniform(0.4, 0.9)) for hz in rng.uniform(6, 40, 2)]
        found = common(push, *(arm + 0.1 * rng.normal(size=COUNT) for arm in arms))
        assert not found.excludes(1.0) and not found.opposed


def test_unrelated_motions_show_nothing(rng: Generator) -> None:
    bands = [len(Response.of(*rng.normal(size=(2, COUNT)), ALL).band) for _ in range(200)]
    assert sum(bands) <= 5  # of 1,400, of which 1 in 1,000 is chance


def test_slow_motions_that_end_before_the_record_show_nothing(rng: Generator) -> None:
    """Cut off in the middle of their taper they leak into all bands, where both look alike."""
    known, t = np.zeros(COUNT, bool), np.linspace(0, 1, COUNT)
    known[220:780] = True
    for _ in range(20):
        slow = np.sin(
            2 * np.pi * (rng.uniform(0.3, 0.7, 2)[:, None] * t + rng.uniform(size=(2, 1)))
        )
        both = 20 * slow + rng.normal(size=(2, COUNT))
        assert not len(Response.of(*both, known).band)


@pytest.mark.parametrize(("seen", "gap"), [(60, 40), (40, 60), (30, 220)])
def test_slow_motions_between_gaps_show_nothing(rng: Generator, seen: int, gap: int) -> None:
    """Bubbles that come one by one: cut off at each gap they leak in the same way."""
    known, t = np.arange(COUNT) % (seen + gap) < seen, np.linspace(0, 1, COUNT)
    for _ in range(50):
        hz = rng.uniform(2.0, 8.0, (2, 1))
        both = 20 * np.sin(2 * np.pi * (hz * t + rng.uniform(size=(2, 1))))
        assert len(Response.of(*both + rng.normal(size=(2, COUNT)), known).band) <= 1


def test_a_factor_is_found_between_gaps(rng: Generator) -> None:
    push, known = rng.normal(size=COUNT), np.arange(COUNT) % 250 < 120
    arms = [push + 0.5 * rng.normal(size=COUNT), push]
    found = CommonGain.of([Response.of(arm, push / -25.4, known) for arm in arms])
    assert found is not None and found.opposed and found.excludes(1.0)
    assert found.gain == pytest.approx(25.4, rel=0.2)


def test_noise_of_the_motion_widens_the_bounds(rng: Generator) -> None:
    """A coarse encoder makes the gain too small: the bounds contain 1 with either as the cause."""
    push = rng.normal(size=COUNT)
    found = common(push + rng.normal(size=COUNT), push)
    assert found.gain < 0.7 and found.low < 0 < found.high + 0.1
    assert not found.excludes(1.0)
