"""Times of readings without stamps: none is left out, and the stated uncertainty is honest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated_log import simulated_log

from telerig.io.recording.replay import REGULAR_CLOCK
from telerig.io.recording.simulated.devices import Faults, SimulatedDevice, true_values
from telerig.io.recording.tables import write_tables
from telerig.io.recording.unstamped import spread_arrivals
from telerig.io.rig_file.description import DeviceDescription

Array = NDArray[np.float64]
UNSTAMPED = DeviceDescription(
    "e", "encoder", "x", protocol="regex", pattern=r"(?P<counts>-?\d+)", counts_per_mm=1000.0
)


def bunched(made: Array, rng: np.random.Generator) -> Array:
    flushes = np.cumsum(rng.uniform(0, 0.016, int(300 * (np.ptp(made) + 1))))
    return flushes[np.searchsorted(flushes, made)]


@pytest.mark.parametrize("rate_hz", [20, 100, 1000, 4000])
def test_a_regular_stream(rate_hz: int) -> None:
    made = np.arange(10 * rate_hz) / rate_hz * (1 + 40e-6)
    arrived = bunched(made, np.random.default_rng(rate_hz))
    found = spread_arrivals(arrived, np.arange(len(made)))
    assert found.regular and np.all(np.diff(found.t_s) > 0) and np.all(found.t_s < arrived + 1e-9)
    error = np.sqrt(np.mean((found.t_s - made) ** 2))
    assert error < 0.3e-3 and error < 2 * found.sd_s
    assert np.sqrt(np.mean((arrived - made) ** 2)) > 5e-3, "which the arrivals are off"


@pytest.mark.parametrize("counted", [True, False])
def test_missing_lines_shift_the_count_where_they_are_missing(counted: bool) -> None:
    """A malformed line has a number of its own; a lost one leaves no trace but later arrivals."""
    rng = np.random.default_rng(1)
    made = np.arange(20_000) / 1000
    kept = rng.random(len(made)) > 1e-3
    kept[9000:9300] = False
    arrived = bunched(made, rng)[kept]
    slot = np.flatnonzero(kept) if counted else np.arange(kept.sum())
    found = spread_arrivals(arrived, slot)
    error = found.t_s - made[kept]
    assert found.regular and np.max(np.abs(error)) < (0.2e-3 if counted else 3e-3)
    assert np.sqrt(np.mean(error**2)) < 2 * found.sd_s


@pytest.mark.parametrize("seed", range(5))
def test_garbage_that_is_no_line_of_the_device(seed: int) -> None:
    """It takes a number, but no reading is missing: the count is lower from there on."""
    rng = np.random.default_rng(seed)
    made = np.arange(5000) / 1000
    extra = np.zeros(5000, np.int64)
    extra[[500, 2000, 4000]] = 1
    flushes = np.cumsum(rng.uniform(0, 0.002, 6000))
    arrived = flushes[np.searchsorted(flushes, made)]
    found = spread_arrivals(arrived, np.arange(5000) + np.cumsum(extra))
    error = found.t_s - made
    assert found.regular and np.max(np.abs(error)) < 1.5e-3
    assert np.mean(np.abs(error) > 0.3e-3) < 2e-3 and np.sqrt(np.mean(error**2)) < 2 * found.sd_s


def test_a_device_that_sends_now_and_then_has_no_regular_clock() -> None:
    rng = np.random.default_rng(2)
    made = np.cumsum(rng.exponential(0.01, 3000))
    found = spread_arrivals(bunched(made, rng), np.arange(3000))
    assert not found.regular and np.all(np.diff(found.t_s) > 0)
    assert found.sd_s > 1e-3


@pytest.mark.parametrize("count", [0, 1, 2, 30])
def test_a_few_readings(count: int) -> None:
    found = spread_arrivals(np.full(count, 5.0), np.arange(count))
    assert np.all(np.diff(found.t_s) > 0) and np.all((found.t_s > 4.98) & (found.t_s < 5 + 1e-4))


def test_no_reading_of_an_unstamped_stream_is_left_out(tmp_path: Path) -> None:
    sim = SimulatedDevice(UNSTAMPED, 1000.0, drift_ppm=80.0)
    (truth,) = simulated_log(tmp_path / "r.raw", [sim], 10.0, np.random.default_rng(3))
    done = write_tables(tmp_path / "r.raw")
    told = done.summary["devices"]["e"]
    assert told["readings"] == truth.sent and told["left_out"] == {} and told["lost"] == 0
    assert told["time_from"] == REGULAR_CLOCK and told["time_sd_ms"] < 0.5
    table = np.genfromtxt(tmp_path / "stage.csv", delimiter=",", skip_header=1)
    number = np.arange(truth.sent)
    assert np.array_equal(table[:, 1], true_values(sim, number)["counts"] / 1000)
    assert np.max(np.abs(table[:, 0] - sim.due_s(number))) < 0.5e-3


def test_an_unstamped_stream_that_loses_bytes(tmp_path: Path) -> None:
    sim = SimulatedDevice(UNSTAMPED, 1000.0, faults=Faults(lost_byte=0.01))
    (truth,) = simulated_log(tmp_path / "r.raw", [sim], 10.0, np.random.default_rng(4))
    done = write_tables(tmp_path / "r.raw")
    table = np.genfromtxt(tmp_path / "stage.csv", delimiter=",", skip_header=1)
    assert len(table) > 0.97 * truth.sent and not done.errors
    true = 20 * (1 - np.cos(2 * np.pi * table[:, 0] / 10))
    assert np.max(np.abs(table[:, 1] - true)) < 0.05, "12.6 mm/s, and some times are 2 ms off"


def test_a_host_that_reads_nothing_for_a_while_is_no_gap() -> None:
    rng = np.random.default_rng(5)
    made = np.arange(6000) / 1000
    arrived = bunched(made, rng)
    arrived[(arrived > 2.0) & (arrived < 2.6)] = 2.6
    found = spread_arrivals(arrived, np.arange(6000))
    assert found.regular and np.max(np.abs(found.t_s - made)) < 0.3e-3
