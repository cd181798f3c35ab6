"""Samples that cannot be right are masked one by one; sound records lose none."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
from places import REAL

from telerig.estimator.sensors.encoder_checks import check_encoder
from telerig.estimator.sensors.given import Sensor
from telerig.estimator.sensors.record_numbers import noise_density, sampling_rate
from telerig.estimator.sensors.samples import mostly_masked, screened
from telerig.estimator.sensors.spikes import shifted_samples, spike_samples
from telerig.estimator.sensors.stopped import frozen_samples
from telerig.rig.units import STANDARD_GRAVITY_M_S2

RATE, DENSITY = 2000.0, 22.5
T = np.arange(3000) / RATE
SIGMA = DENSITY * 1e-6 * STANDARD_GRAVITY_M_S2 * np.sqrt(RATE / 2)
BOX = REAL / "accelerometers"


def shaken(seed: int = 1) -> Any:
    """An arm that vibrates at 8 and 13 Hz, with the noise of a good sensor."""
    rng = np.random.default_rng(seed)
    wave = 0.6 * np.sin(2 * np.pi * 8 * T + 1) + 0.3 * np.sin(2 * np.pi * 13 * T)
    motion = wave[:, None] * [1.0, 0.7, -0.4]
    return motion + [0.0, -STANDARD_GRAVITY_M_S2, 0.0] + SIGMA * rng.standard_normal((3000, 3))


def screen(reading: Any, t: Any = T, **fields: Any) -> tuple[Sensor, list[str]]:
    given = {"noise_density_ug_sqrt_hz": DENSITY, "range_m_s2": None} | fields
    sensor = Sensor(
        "box", "box", t, reading, "m/s^2", "left", np.eye(3), given["noise_density_ug_sqrt_hz"],
        0.2, given["range_m_s2"], "frames", np.ones(len(t), bool),
    )  # fmt: skip
    found, findings = screened(sensor)
    return found, [f.warning for f in findings]


def coarse(reading: Any, step: float) -> Any:
    return np.round(reading / step) * step


@pytest.mark.parametrize("step", [0.0, 0.001, 0.0383])
def test_a_sound_record_is_left_alone(step: float) -> None:
    """With the 3.9 mg steps of a cheap sensor, too, in motion and at rest."""
    reading = shaken() if step == 0 else coarse(shaken(), step)
    rest = np.tile(reading[0], (3000, 1))
    rest[1500:] = reading[1500:]
    for one in (reading, rest) if step == 0.0383 else (reading,):
        found, words = screen(one)
        assert words == []
        assert found.kept.all()


def test_spikes_are_masked_one_by_one_and_interpolated() -> None:
    rng = np.random.default_rng(2)
    clean, at = shaken(), rng.choice(np.arange(20, 2980, 20), 30, replace=False)
    spoilt = clean.copy()
    spoilt[at, rng.integers(0, 3, 30)] += rng.choice([-1, 1], 30) * rng.uniform(2, 100, 30)
    found, words = screen(spoilt)
    assert np.flatnonzero(~found.kept).tolist() == sorted(at.tolist())
    assert words == [
        f"box: 30 of 3000 samples are spikes and are not used, the first at {T[at.min()]:.6g} s"
    ]
    np.testing.assert_allclose(found.reading_m_s2, clean, atol=8 * SIGMA)


def test_an_impact_is_no_spike() -> None:
    """A knock that rings on for 20 ms is motion."""
    ringing = np.where(T > 0.7, np.exp(-(T - 0.7) / 0.006) * np.sin(2 * np.pi * 300 * (T - 0.7)), 0)
    assert not spike_samples(shaken()[:, 0] + 20 * ringing).any()


@pytest.mark.parametrize("length", [5, 20, 200])
def test_a_shifted_stretch_is_masked(length: int) -> None:
    reading = shaken()
    reading[1000 : 1000 + length] += [0.5, -0.3, 0.4]
    found, words = screen(reading)
    assert np.flatnonzero(~found.kept).tolist() == list(range(1000, 1000 + length))
    assert [f"{length} of 3000 samples are offset" in one for one in words] == [True]


def test_an_impact_and_a_jump_that_stays_are_no_shift() -> None:
    after = np.maximum(T - 0.7, 0)
    ringing = np.where(T > 0.7, np.exp(-after / 0.006) * np.sin(2 * np.pi * 300 * after), 0)
    for added in (20 * ringing, 2.0 * (T > 0.7), 2.0 * ((T > 0.7) ^ (T > 1.2)), 30 * after**2):
        assert not shifted_samples(shaken() + added[:, None] * [1.0, 0.3, -0.5]).any()


@pytest.mark.parametrize("length", [10, 200])
@pytest.mark.parametrize("first", [0, 1000, None])
def test_a_sensor_that_stops_is_masked(length: int, first: int | None) -> None:
    first = 3000 - length if first is None else first
    reading = shaken()
    reading[first : first + length] = reading[first]
    found, words = screen(reading)
    assert np.flatnonzero(~found.kept).tolist() == list(range(first + 1, first + length))
    assert len(words) == 1 and f"{length - 1} of 3000 samples repeat" in words[0]


def test_a_stop_in_motion_is_seen_with_coarse_steps() -> None:
    reading = coarse(shaken(), 0.0383)
    reading[1000:1100] = reading[1000]
    assert 99 <= np.count_nonzero(~screen(reading)[0].kept) <= 102


def test_samples_that_a_logger_holds_are_not_frozen() -> None:
    """A logger at 2 kHz reads a sensor that samples at 500 Hz: each value four times."""
    held = np.repeat(shaken()[::4], 4, axis=0)
    assert not frozen_samples(held, SIGMA).any()


def test_few_clipped_samples_are_masked_and_an_axis_that_is_often_clipped_is_not_used() -> None:
    for quantile, unused in ((0.03, ()), (0.6, (1,))):
        reading = shaken()
        limit = float(np.quantile(reading[:, 1], quantile))
        expected = np.count_nonzero(reading[:, 1] <= limit)
        reading[:, 1] = reading[:, 1].clip(min=limit)
        found, words = screen(reading)
        assert len(words) == 1 and f"{expected} of 3000 samples of ay are clipped" in words[0]
        assert found.unused_axes == unused
        assert np.count_nonzero(~found.kept) == (0 if unused else expected)


def test_a_range_that_is_stated() -> None:
    reading = shaken()
    reading[500:503, 0] = 20.0
    found, words = screen(reading, range_m_s2=20.0)
    assert np.flatnonzero(~found.kept).tolist() == [500, 501, 502]
    assert "3 of 3000 samples of ax are clipped at 20 m/s^2" in words[0]


def test_axes_that_never_change() -> None:
    reading = shaken()
    reading[:, 0] = 0.0
    found, words = screen(reading)
    assert found.unused_axes == (0,) and "ax never changes" in words[0]
    assert mostly_masked(found) is None
    still, _ = screen(np.zeros((3000, 3)))
    left_out = mostly_masked(still)
    assert left_out is not None and "left out" in left_out.words


def test_gaps_are_said() -> None:
    kept = np.r_[0:1000, 1100:2000, 2200:3000]
    found, words = screen(shaken()[kept], T[kept])
    assert found.kept.all()
    assert words == ["box: samples are missing in 2 gaps, the first of 50.5 ms at 0.4995 s, the "
                     "longest of 101 ms"]  # fmt: skip
    assert sampling_rate(T[kept]) == pytest.approx(RATE)


def test_a_noise_density_is_estimated() -> None:
    assert noise_density(T, shaken()) == pytest.approx(DENSITY, rel=0.15)
    found, words = screen(shaken(), noise_density_ug_sqrt_hz=None)
    assert found.noise_density_ug_sqrt_hz == pytest.approx(DENSITY, rel=0.15)
    assert "no noise density is given" in words[0]


def test_axes_that_are_not_used_show_no_noise() -> None:
    """A sensor of one axis, whose other columns are 0; and a clipped axis."""
    one = shaken() * [0.0, 1.0, 0.0]
    assert noise_density(T, one) == pytest.approx(DENSITY, rel=0.15)
    clipped = shaken()
    clipped[:, 0] = clipped[:, 0].clip(-0.1, 0.1)
    for reading, unused in ((one, (0, 2)), (clipped, (0,))):
        found, _ = screen(reading, noise_density_ug_sqrt_hz=None)
        assert found.unused_axes == unused
        assert found.noise_density_ug_sqrt_hz == pytest.approx(DENSITY, rel=0.15)
    still, _ = screen(0 * one, noise_density_ug_sqrt_hz=None)
    assert still.unused_axes == (0, 1, 2)


@pytest.mark.skipif(not BOX.is_dir(), reason="the real records of ../shared/real are not here")
@pytest.mark.parametrize(("file", "first", "density"), [("8g", 3, 18), ("16g", 0, 300)])
def test_real_records_lose_nothing_but_two_knocks(file: str, first: int, density: float) -> None:
    """A box moved by hand, at rest for 4 s: no sample is frozen or clipped. Each sensor reads one
    knock as a single sample, which looks like a spike.
    """
    table = pd.read_csv(BOX / f"accelerometer_{file}.csv")[first:]
    reading = STANDARD_GRAVITY_M_S2 * table[["ax_g", "ay_g", "az_g"]].to_numpy()
    found, words = screen(reading, table["time_s"].to_numpy(), noise_density_ug_sqrt_hz=None)
    assert found.noise_density_ug_sqrt_hz == pytest.approx(density, rel=0.2)
    assert np.count_nonzero(~found.kept) <= 1
    assert not any("repeat" in w or "clipped" in w for w in words)


@pytest.mark.parametrize(("at", "length"), [(400, 1), (400, 3), (0, 1), (0, 2), (999, 1)])
def test_wrong_readings_of_the_encoder_are_masked(at: int, length: int) -> None:
    rng = np.random.default_rng(5)
    t = np.arange(1000) / 1000
    position = 280 * t + 0.14 * np.sin(2 * np.pi * 15 * t) + 0.001 * rng.standard_normal(1000)
    position[at : at + length] += 3.0
    kept, findings = check_encoder(t, position, t[10:-10:2])
    assert np.flatnonzero(~kept).tolist() == list(range(at, min(at + length, 1000)))
    assert len(findings) == 1 and findings[0].code is None
    assert "not used" in findings[0].words
