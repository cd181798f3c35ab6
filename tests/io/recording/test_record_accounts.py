"""Samples sent = recorded + reported, whatever happens to the lines, in real time."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fault_recordings import (
    ARM,
    ENCODER,
    UNSTAMPED,
    Account,
    faulty_devices,
    recorded_with_faults,
    table,
)

from telerig.errors import InputError
from telerig.io.recording.simulated.devices import Faults, SimulatedDevice

SCENARIOS = {
    "lost bytes, garbage": [
        SimulatedDevice(ENCODER, 1000.0, 30.0, faults=Faults(lost_byte=0.01, garbage_hz=5.0)),
        SimulatedDevice(ARM, 2000.0, -40.0, faults=Faults(lost_byte=0.01)),
    ],
    "unplugged, flooded": [
        SimulatedDevice(ENCODER, 1000.0, faults=Faults(unplug_s=(1.0,), away_s=0.4)),
        SimulatedDevice(replace(ARM, protocol="packets"), 2000.0, faults=Faults(flood_s=(2.4,))),
    ],
    "no stamps, bursts": [
        SimulatedDevice(UNSTAMPED, 1000.0, 60.0, faults=Faults(cut_hz=2.0)),
        SimulatedDevice(ARM, 500.0, jitter_s=0.4),
    ],
}


def check(accounts: list[Account]) -> None:
    for one in accounts:
        if one.device == "encoder without stamps":
            assert abs(one.not_accounted) <= 0.01 * one.sent + one.busy, one
            assert one.wrong <= 0.02 * one.recorded + one.busy, "times off by more than 8 ms"
        else:
            assert one.wrong == 0, one
            assert abs(one.not_accounted) <= 0.02 * one.busy, one
            assert one.slightly_wrong <= 0.001 * one.sent + 3 * np.sqrt(0.001 * one.sent), one
            assert one.latest_s < 0.02, one


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_reading_is_recorded_or_reported(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(0)
    check(recorded_with_faults(SCENARIOS[name], tmp_path, rng, 3.0))


def test_a_kill_costs_the_last_second_of_every_device(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    sims = [SimulatedDevice(ENCODER, 1000.0), SimulatedDevice(ARM, 2000.0)]
    check(recorded_with_faults(sims, tmp_path, rng, 2.0, kill=True))


@pytest.mark.slow
def test_a_hundred_recordings_with_faults(tmp_path: Path) -> None:
    """About 11 minutes; TELERIG_ACCOUNTS=FILE writes the table of the benchmark results."""
    accounts, failed = [], []
    for seed in range(100):
        rng, kill = np.random.default_rng(seed), seed % 5 == 4
        sims = faulty_devices(rng, 5.0)
        if kill:  # the command takes a while to start, in which nothing may be unplugged
            sims = [replace(s, faults=replace(s.faults, unplug_s=(), flood_s=())) for s in sims]
        try:
            found = recorded_with_faults(sims, tmp_path / str(seed), rng, 5.0, kill=kill)
            accounts += found
            check(found)
        except (AssertionError, InputError) as error:
            failed.append(f"{seed}: {error}")
    slight, sent = (sum(getattr(a, k) for a in accounts) for k in ("slightly_wrong", "sent"))
    if slight > 0.001 * sent:
        failed.append(f"{slight} of {sent} are wrong by less than the motion hides")
    if file := os.environ.get("TELERIG_ACCOUNTS"):
        Path(file).write_text("\n".join([table(accounts), *failed]), encoding="utf-8")
    assert not failed, "\n".join(failed)
