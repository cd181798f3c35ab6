"""Checks of sensors on records made up: what is a fault, and what only looks like one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import telerig
from telerig.estimator.sensors.checks import check_sensors
from telerig.estimator.sensors.encoder_checks import check_encoder, encoder_faults
from telerig.estimator.sensors.findings import Code
from telerig.estimator.sensors.gravity import Gravity, fitting_axes
from telerig.estimator.sensors.stopped import clippings
from telerig.io.simulation.presets import run_preset


def test_jumps_outside_the_frames_only_warn() -> None:
    t = np.arange(1000) / 1000
    position = 280 * t + np.where(t > 0.8, 5.0, 0.0)
    kept, found = check_encoder(t, position, np.arange(0.1, 0.7, 0.002))
    assert kept.all()
    assert len(found) == 1
    assert found[0].code is None
    assert "+5 mm at 0.801 s" in found[0].warning


def test_hard_but_real_motion_is_no_jump() -> None:
    """Starts, stops and a stick-slip motion, with 1 µm noise, at three rates."""
    rng = np.random.default_rng(1)
    for rate in (50, 200, 1000):
        t = np.arange(0, 3, 1 / rate)
        speed = np.interp(t, [0, 0.5, 0.7, 1.5, 1.6, 3], [0, 0, 280, 280, 0, 0])
        slip = 0.2 * np.abs(((8 * t) % 1.0) - 0.5)
        position = np.cumsum(speed) / rate + slip + 0.001 * rng.standard_normal(len(t))
        assert encoder_faults(t, position) == []
        counts = np.round(position / 0.01) * 0.01
        assert encoder_faults(t, counts) == []


def test_a_rest_in_which_readings_repeat_is_no_measure_of_the_noise() -> None:
    """The stage stands for most of the record, before its start or because the encoder is stuck."""
    rng = np.random.default_rng(6)
    t = np.arange(0, 3, 1e-3)
    noise = 0.001 * rng.standard_normal(len(t))
    moving = 280 * (t - 2) + 0.1 * np.sin(2 * np.pi * 15 * (t - 2)) + noise
    start = np.where(t > 2, np.maximum(t - 2, 0) ** 2 * 280 + noise, 0.0)
    assert encoder_faults(t, start) == []
    stuck = np.where(t > 2, moving, moving[2000])
    assert [f for f in encoder_faults(t, stuck) if abs(f.size_mm) < 0.1] == []


def test_a_jump_is_found_under_a_hunting_servo() -> None:
    """0.1 mm RMS at 15 Hz: jumps of 50 µm at 1 kHz and 0.5 mm at 100 Hz stand out, none besides."""
    for rate, size in ((1000, 0.05), (100, 0.5)):
        rng = np.random.default_rng(7)
        t = np.arange(0, 2, 1 / rate)
        noise = 0.001 * rng.standard_normal(len(t))
        position = 280 * t + 0.14 * np.sin(2 * np.pi * 15 * t) + noise
        assert encoder_faults(t, position) == []
        at = len(t) // 3
        position[at:] += size
        (fault,) = encoder_faults(t, position)
        assert fault.t_s == t[at]
        assert fault.size_mm == pytest.approx(size, rel=0.5)


def test_a_stage_that_stops_within_the_last_step_of_a_slow_encoder_is_no_fault() -> None:
    """12 mm short of 28 mm in 0.1 s take 5 m/s^2, in 1 ms a hundred times what is possible."""
    for step_s, sound in ((0.1, True), (1e-3, False)):
        t = np.arange(20) * step_s
        position = 280 * t
        position[-1] -= 12.0
        kept, found = check_encoder(t, position, t)
        assert kept[:-1].all() and kept[-1] == sound and (not found) == sound


@pytest.mark.parametrize("size", [2, 8, 16])
def test_readings_that_were_buffered_are_refused(size: int) -> None:
    """At 1 kHz, each with the time of the last of its bunch, some microseconds apart."""
    rng = np.random.default_rng(9)
    t = np.arange(0, 1.6, 1e-3)
    position = 280 * t + 0.1 * np.sin(30 * t) + 0.001 * rng.standard_normal(len(t))
    sent = t.reshape(-1, size)[:, -1:] + 2e-6 * np.arange(size)
    frames = np.arange(0.1, 1.5, 0.002)
    _, (finding,) = check_encoder(sent.ravel(), position, frames)
    assert finding.code == Code.ENCODER_CLOCK
    assert f"in bunches: {size} of them within" in finding.warning
    at_rest = 0.001 * rng.standard_normal(len(t))
    assert check_encoder(sent.ravel(), at_rest, frames)[1] == []
    jitter = t + 4e-4 * rng.uniform(-1, 1, len(t))
    assert all(f.code is None for f in check_encoder(jitter, 280 * jitter, frames)[1])


def test_coarse_readings_are_not_clipped() -> None:
    """A 12 bit sensor in rest repeats its values, in the shape of its noise."""
    rng = np.random.default_rng(2)
    for noise in (0.3, 1.0, 3.0):
        samples = np.round(noise * rng.standard_normal((5000, 3))) * 0.01
        assert clippings(samples) == []


def test_fitting_axes_against_every_mounting() -> None:
    """For each of the 24 mountings the axes found turn the gravity that is read upwards."""
    from scipy.spatial.transform import Rotation

    up = np.array([0.0, -1.0, 0.0])
    for turn in Rotation.create_group("O").as_matrix():
        fits = fitting_axes(Gravity(turn @ (9.81 * up) + [0.1, -0.2, 0.15]), np.eye(3), up)
        assert fits is not None
        np.testing.assert_allclose(fits.T @ turn @ up, up, atol=1e-9)
        assert np.linalg.det(fits) == pytest.approx(1.0)
    tilted = Rotation.from_euler("xyz", [40, 30, 0], degrees=True).as_matrix()
    assert fitting_axes(Gravity(tilted @ up), np.eye(3), up) is None


@pytest.mark.parametrize("name", ["S0", "S4", "rise"])
def test_good_runs_of_other_scenarios(name: str, tmp_path: Path) -> None:
    """Slow frames, hard shake, a start from rest: no false alarm."""
    config = run_preset(name, frames=60)
    stage = replace(config.stage, accelerometers=("left", "right", "carriage"))
    config = replace(config, stage=stage, calibration=replace(config.calibration, views=2))
    telerig.simulate(config, rng=np.random.default_rng(8), out=tmp_path / "d", images=False)
    assert check_sensors(telerig.load_run(tmp_path / "d" / "runs" / name)) == []
