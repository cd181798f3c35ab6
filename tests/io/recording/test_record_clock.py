"""A device's clock from one-way stamps: against a linear programme, and against simulated truth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.optimize import linprog

from telerig.io.recording.clock import fit_clock, host_times, lower_line, unwrap

Array = NDArray[np.float64]


def arrivals(
    rng: Generator, *, rate_hz: float, seconds: float, drift_ppm: float, jitter_s: float = 0.016
) -> tuple[Array, Array, Array]:
    """(made, arrived, device stamp): readings wait for the next of random flushes."""
    device = np.arange(int(rate_hz * seconds)) / rate_hz
    made = device / (1 + 1e-6 * drift_ppm)
    flushes = np.cumsum(rng.uniform(0, jitter_s, int(4 * seconds / jitter_s)))
    arrived = flushes[np.searchsorted(flushes, made)]
    return made, arrived, device


@pytest.mark.parametrize("seed", range(5))
def test_lower_line_is_the_linear_programmes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = np.sort(rng.uniform(-3, 5, 80))
    y = 0.3 * x - 1 + rng.exponential(0.5, 80)
    best = linprog(
        [-80.0, -x.sum()], A_ub=np.column_stack([np.ones(80), x]), b_ub=y, bounds=(None, None)
    )
    middle, slope = lower_line(x, y)
    intercept = middle - slope * x.mean()
    assert np.all(intercept + slope * x <= y + 1e-12)
    assert np.isclose(np.sum(y - intercept - slope * x), np.sum(y) + best.fun, rtol=1e-9)


@pytest.mark.parametrize("drift_ppm", [-150.0, 0.0, 40.0])
def test_ten_minutes_under_16_ms_of_jitter(drift_ppm: float) -> None:
    rng = np.random.default_rng(7)
    made, arrived, device = arrivals(rng, rate_hz=1000, seconds=600, drift_ppm=drift_ppm)
    found = host_times(arrived, np.mod(device + 4000.0, 4294.967296), 4294.967296)
    (fit,) = found.fits
    assert abs(fit.drift_ppm - drift_ppm) < 0.1
    assert np.max(np.abs(found.t_s - made)) < 20e-6
    assert (found.wraps, found.wrong) == (1, 0)
    assert fit.delay_median_ms > 2, "the arrival itself is milliseconds late"


def test_least_delay_cannot_be_seen_and_stays_in_the_times() -> None:
    rng = np.random.default_rng(1)
    made, arrived, device = arrivals(rng, rate_hz=1000, seconds=60, drift_ppm=10.0)
    late = host_times(arrived + 0.003, device)
    assert np.allclose(late.t_s - made, 0.003, atol=100e-6)


@pytest.mark.parametrize("bits", [16, 20, 32])
def test_wraps_between_the_host_times(bits: int) -> None:
    rng = np.random.default_rng(2)
    made, arrived, device = arrivals(rng, rate_hz=500, seconds=20, drift_ppm=0.0)
    wrap_s = 2**bits * 1e-6
    keep = np.ones(len(device), bool)
    keep[4000:6500] = False
    raw = np.mod(np.round(device[keep] * 1e6) + 17, 2**bits) * 1e-6
    found = host_times(arrived[keep], raw, wrap_s)
    assert len(found.fits) == 1 and found.wrong == 0
    assert np.max(np.abs(found.t_s - made[keep])) < 200e-6
    assert np.allclose(np.diff(unwrap(arrived[keep], raw, wrap_s)), np.diff(device[keep]))


def test_a_restarted_clock_is_a_count_of_its_own_with_the_same_drift() -> None:
    rng = np.random.default_rng(4)
    made, arrived, device = arrivals(rng, rate_hz=1000, seconds=100, drift_ppm=80.0)
    raw = device + 5.0
    raw[95_000:] -= raw[95_000]
    found = host_times(arrived, raw, 4294.967296)
    assert len(found.fits) == 2
    assert found.fits[1].drift_ppm == found.fits[0].drift_ppm
    assert np.isnan(found.fits[1].sd_drift_ppm)
    assert np.array_equal(found.segment, np.arange(len(raw)) >= 95_000)
    assert np.max(np.abs(found.t_s - made)) < 200e-6


def test_wrong_stamps_are_left_out_and_nothing_else() -> None:
    rng = np.random.default_rng(5)
    made, arrived, device = arrivals(rng, rate_hz=1000, seconds=30, drift_ppm=-30.0)
    raw = device.copy()
    bad = np.array([0, 100, 101, 7000, 15_000, 20_000, 29_999])
    raw[bad] = [900.0, 3000.0, 4.0, 7.25, 0.015, 19.9, 1e-6]
    raw[25_000] = raw[24_999]
    found = host_times(arrived, raw, 4294.967296)
    assert np.array_equal(np.flatnonzero(np.isnan(found.t_s)), np.sort([*bad, 25_000]))
    assert found.wrong == len(bad) + 1 and len(found.fits) == 1
    good = np.isfinite(found.t_s)
    assert np.max(np.abs(found.t_s - made)[good]) < 200e-6


def test_a_stamp_from_the_future_does_not_pull_the_line_down() -> None:
    rng = np.random.default_rng(6)
    made, arrived, device = arrivals(rng, rate_hz=10, seconds=600, drift_ppm=12.0, jitter_s=0.004)
    raw = device.copy()
    raw[3000] += 0.09
    found = host_times(arrived, raw)
    (fit,) = found.fits
    assert abs(fit.drift_ppm - 12.0) < 1.0
    assert np.median(np.abs(found.t_s - made)) < 200e-6


def test_a_host_that_sleeps_for_seconds_is_no_restart() -> None:
    rng = np.random.default_rng(8)
    made, arrived, device = arrivals(rng, rate_hz=1000, seconds=30, drift_ppm=5.0)
    stalled = (arrived > 12.0) & (arrived < 14.0)
    arrived[stalled] = 14.0
    found = host_times(arrived, device, 4294.967296)
    assert len(found.fits) == 1 and found.wrong == 0
    assert np.max(np.abs(found.t_s - made)) < 200e-6


def test_the_stated_drift_error_is_of_the_order_of_the_true_one() -> None:
    errors, stated = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        _, arrived, device = arrivals(rng, rate_hz=500, seconds=30, drift_ppm=20.0)
        fit = fit_clock(arrived, device)
        errors.append(fit.drift_ppm - 20.0)
        stated.append(fit.sd_drift_ppm)
    assert np.sqrt(np.mean(np.square(errors))) < np.median(stated)
    assert np.median(stated) < 2.0


def test_a_clock_that_warms_up_is_followed() -> None:
    rng = np.random.default_rng(9)
    made = np.arange(900_000) / 1000
    device = made + 40e-6 * made + 200e-6 * np.sin(2 * np.pi * made / 600)
    flushes = np.cumsum(rng.uniform(0, 0.016, 240_000))
    arrived = flushes[np.searchsorted(flushes, made)]
    found = host_times(arrived, device)
    (fit,) = found.fits
    assert len(fit.knots_s) > 10
    assert np.max(np.abs(found.t_s - made)) < 40e-6
    straight = made - (np.polyval(np.polyfit(device, made, 1), device))
    assert np.max(np.abs(straight)) > 150e-6, "which no straight line does"


@pytest.mark.parametrize("count", [0, 1, 2, 4])
def test_few_readings(count: int) -> None:
    device = np.arange(count) / 100
    found = host_times(device + 3.0, device)
    assert np.allclose(found.t_s, device + 3.0)
    assert len(found.fits) == min(count, 1)
