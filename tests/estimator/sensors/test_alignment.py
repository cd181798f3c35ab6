"""Clocks and mounting of sensors, by motion made here and by a real box of two sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from numpy.random import Generator
from places import REAL

from telerig.arrays import Array
from telerig.estimator.sensors.accelerations import (
    Accelerations,
    Grid,
    of_positions,
    of_readings,
)
from telerig.estimator.sensors.alignment import (
    BEYOND,
    REFUSED,
    Alignment,
    Channel,
    align,
    beyond_chance,
)
from telerig.estimator.sensors.gravity import Gravity
from telerig.estimator.sensors.mounting import Expected, Regression, mounting

GRID = Grid(0.0, 0.002, 1000, 5)
BOX = REAL / "accelerometers"
UP = np.array([0.0, -1.0, 0.0])
GRAVITY = 9806.65


def motion(rng: Generator, seconds: float) -> tuple[Array, Array, Array]:
    """(t, place, acceleration) every 0.5 ms: sums of 20 sines along three axes, mm and mm/s^2."""
    t = np.arange(-round(seconds * 2000), round((2 + seconds) * 2000)) / 2000
    w = 2 * np.pi * rng.uniform(3.0, 40.0, (20, 3))
    a, phase = rng.normal(size=(20, 3)) * 170, rng.uniform(0, 2 * np.pi, (20, 3))
    sines = a * np.sin(w * t[:, None, None] + phase)
    return t, (-sines / w**2).sum(1), sines.sum(1)


def test_positions_and_readings_give_the_same_accelerations() -> None:
    """Beside the closed form: a cubic B-spline of knot spacing h weakens a sine by sinc^4."""
    t = np.arange(0, 2, 5e-4)
    w = 2 * np.pi * 12.0
    place, acceleration = np.sin(w * t)[:, None], -(w**2) * np.sin(w * t)[:, None]
    seen = of_positions(GRID, t, place)
    felt, known = of_readings(GRID, t, acceleration).at(GRID.t_s)
    both = known & seen.known
    assert np.count_nonzero(both) > 900
    expected = -(w**2) * np.sin(w * GRID.t_s) * np.sinc(12.0 * GRID.width_s) ** 4
    np.testing.assert_allclose(seen.values[both, 0], expected[both], atol=0.02 * w**2)
    np.testing.assert_allclose(felt[both, 0], expected[both], atol=0.02 * w**2)


def test_a_gap_stays_a_gap() -> None:
    t = np.delete(np.arange(0, 2, 0.002), slice(400, 450))
    found = of_positions(GRID, t, np.sin(9 * t)[:, None])
    assert not found.known[391:459].any()
    assert found.known[:380].any() and found.known[470:].any()


def aligned(
    rng: Generator, offset_s: float, *, around_s: float = 20.0, connected: bool = True
) -> Alignment:
    t, place, acceleration = motion(rng, around_s)
    felt_mm_s2 = acceleration if connected else motion(rng, around_s)[2]
    reading = felt_mm_s2 + 5.0 * rng.normal(size=acceleration.shape)
    seen = place[(t >= 0) & (t < 2)][::4]
    seen = seen + 0.02 * rng.normal(size=seen.shape)
    images = of_positions(GRID, GRID.t_s, seen)
    felt = of_readings(GRID, t + offset_s, reading)
    channels = [Channel(images.values[:, k], images.known, (0,)) for k in range(2)]
    found = align(GRID, channels, [felt], 0.006)
    assert found is not None
    return found


def test_an_offset_is_found_within_its_standard_deviation() -> None:
    errors = []
    for seed, offset_s in enumerate(3 * [0.0, -0.06, 0.3] + [17.0]):
        found = aligned(np.random.default_rng(seed), offset_s, around_s=abs(offset_s) + 3)
        assert found.unique and found.at_zero == (offset_s == 0)
        assert abs(found.offset_s - offset_s) < 5e-4
        errors.append((found.offset_s - offset_s) / found.sd_s)
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.6


def test_a_vibration_beyond_half_of_the_frame_rate_does_not_shift_a_clock() -> None:
    """At 20 Hz a carriage that vibrates at 17-21 Hz seems to move slowly, and shifted clocks by
    8 ms at a stated 0.06: 57 µm along the travel."""
    grid = Grid(0.0, 0.05 / 13, 8 * 260 + 1, 26, 13)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        t = np.arange(-4000, 20000) / 2000
        w = 2 * np.pi * np.concatenate([rng.uniform(2.0, 8.0, 6), rng.uniform(17.0, 21.0, 30)])
        size = np.where(w < 60, 10, 300)
        sines = size * np.sin(w * t[:, None] + rng.uniform(0, 2 * np.pi, len(w)))
        frames = 0.05 * np.arange(161)
        place = np.interp(frames, t, (-sines / w**2).sum(1)) + 1e-3 * rng.normal(size=161)
        reading = sines.sum(1)[:, None] * UP + 5.0 * rng.normal(size=(len(t), 3))
        seen = of_positions(grid, frames, place[:, None])
        channel = Channel(seen.values[:, 0], seen.known & grid.at_frame, (0,), grid.pace)
        found = align(grid, [channel], [of_readings(grid, t + 0.2, reading)], 0.006)
        assert found is not None and found.unique
        assert abs(found.offset_s - 0.2) < min(1e-4, found.sd_s)


def test_a_clock_is_found_in_59_frames_at_100_hz() -> None:
    grid = Grid(0.0, 0.01 / 3, 3 * 58 + 1, 6, 3)
    t, place, acceleration = motion(np.random.default_rng(3), 3.0)
    frames = 0.01 * np.arange(59)
    seen = of_positions(grid, frames, np.stack([np.interp(frames, t, p) for p in place.T], -1))
    channels = [Channel(v, seen.known & grid.at_frame, (0,), grid.pace) for v in seen.values.T]
    found = align(grid, channels, [of_readings(grid, t, acceleration)], 0.006)
    assert found is not None and found.at_zero and abs(found.offset_s) < 1e-3


def test_a_record_without_a_connection_is_not_taken() -> None:
    for seed in range(5):
        rng = np.random.default_rng(100 + seed)
        found = aligned(rng, 0.3, around_s=3.0, connected=False)
        assert not found.unique and not found.at_zero


@pytest.mark.parametrize(("times", "rate"), [(BEYOND, 0.013), (REFUSED, 0.001)])
def test_chance_is_exceeded_as_rarely_as_is_stated(times: float, rate: float) -> None:
    """Exponential log-likelihood ratios of any scale: the largest of 24, and one more."""
    rng, count = np.random.default_rng(5), 200_000
    values = 1000.0 * rng.exponential(size=(count, 25))
    beyond = [beyond_chance(v, m, times) for v, m in zip(values[:, 0], values[:, 1:].max(1))]
    assert np.mean(beyond) == pytest.approx(rate, abs=4 * np.sqrt(rate / count) + 0.05 * rate)


def test_a_single_frequency_is_ambiguous_by_whole_periods() -> None:
    t = np.arange(-5, 7, 5e-4)
    rng = np.random.default_rng(4)
    seen = -np.sin(60 * GRID.t_s)[:, None] / 3600 * 500 + 0.02 * rng.normal(size=(1000, 1))
    images = of_positions(GRID, GRID.t_s, seen)
    reading = 500 * np.sin(60 * t)[:, None] * np.ones(3) + 5 * rng.normal(size=(len(t), 3))
    channel = Channel(images.values[:, 0], images.known, (0,))
    found = align(GRID, [channel], [of_readings(GRID, t, reading)], 0.006)
    assert found is not None and not found.unique


def sensor(rng: Generator, rows: Array) -> tuple[Gravity, Accelerations, list[Expected]]:
    """Reading at rest, readings of a sensor with these axes, and what it should feel."""
    t, place, acceleration = motion(rng, 0.5)
    reading = (acceleration + GRAVITY * UP) @ rows.T + 5.0 * rng.normal(size=acceleration.shape)
    seen = place[(t >= 0) & (t < 2)][::4] + 0.02 * rng.normal(size=(1000, 3))
    images = of_positions(GRID, GRID.t_s, seen)
    felt = [Expected(d, images.values[:, k], images.known) for k, d in enumerate(np.eye(3)[:2])]
    return Gravity.of(reading), of_readings(GRID, t, reading), felt


@pytest.mark.parametrize(
    "rows",
    [
        np.eye(3),
        np.eye(3)[[2, 1, 0]],
        np.diag([-1.0, 1.0, 1.0]),
        np.eye(3)[[1, 0, 2]],
        -np.eye(3),
    ],
    ids=["right", "x and z exchanged", "x reversed", "x and y exchanged", "all reversed"],
)
def test_axes_are_named_that_fit_gravity_and_images(rows: Array) -> None:
    """Only what the images show can be told: z is not seen, so its sign is that of the nearest."""
    at_rest, readings, felt = sensor(np.random.default_rng(7), rows)
    values, known = readings.at(GRID.t_s)
    found = mounting(np.eye(3), at_rest, UP, values, known, felt)
    assert found.clear == (not np.array_equal(rows, np.eye(3)))
    np.testing.assert_allclose(np.abs(found.axes), np.abs(rows))
    np.testing.assert_allclose(found.axes[:, :2], rows[:, :2])


def test_a_gap_does_not_change_the_axes() -> None:
    at_rest, readings, felt = sensor(np.random.default_rng(10), np.eye(3))
    values, known = readings.at(GRID.t_s)
    known = known.copy()
    known[400:460] = False
    found = mounting(np.eye(3), at_rest, UP, values, known, felt)
    assert not found.clear


def test_exchanged_records_are_preferred_when_they_are_right() -> None:
    """Two arms whose motion is three quarters the same; a short run with a free bubble as noise."""
    rng, leads = np.random.default_rng(11), []
    for _ in range(10):
        common, one, two, bubble = (of_motion(rng) for _ in range(4))
        mine, other = 0.87 * common + 0.5 * one, 0.87 * common + 0.5 * two
        known = np.ones(len(mine), bool)
        fit = Regression.of(mine + bubble, known, np.column_stack([mine, other]))
        assert fit is not None
        leads.append(float(np.diff(fit.log_ratios(np.eye(2)))[0]))
    assert max(leads) < 8.0 and np.median(leads) < 0


def of_motion(rng: Generator) -> Array:
    """Smoothed accelerations along one axis, as images show them."""
    t, place, _ = motion(rng, 0.0)
    return of_positions(GRID, GRID.t_s, place[(t >= 0)][::4][:1000]).values[20:320, 0]


@pytest.mark.skipif(not BOX.is_dir(), reason="the real records are not here")
def test_two_sensors_of_one_real_box() -> None:
    """The 8 g sensor lags by 1.2 +- 0.3 ms (cross-correlation, 0.5-20 Hz)."""
    one = pd.read_csv(BOX / "accelerometer_16g.csv").to_numpy(float)
    two = pd.read_csv(BOX / "accelerometer_8g.csv").to_numpy(float)[3:]
    grid = replace(GRID, start_s=one[0, 0], count=int(np.ptp(one[:, 0]) / 0.002), knots=10)
    first = of_readings(grid, one[:, 0], GRAVITY * one[:, 1:])
    second = of_readings(grid, two[:, 0] + 4.0, GRAVITY * two[:, 1:])
    channels = [Channel(first.values[:, k], first.known, (0,)) for k in range(3)]
    found = align(first.grid, channels, [second], 0.006)
    assert found is not None and found.unique
    assert abs(found.offset_s - 4.0 - 1.2e-3) < 0.3e-3 + 2 * found.sd_s
    assert 1e-4 < found.sd_s < 5e-4
