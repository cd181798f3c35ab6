"""Recordings with faults in real time, and the account of every reading that was sent."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.random import Generator

from telerig.arrays import Array
from telerig.io.recording.replay import DeviceRecord, replay
from telerig.io.recording.session import LOG_NAME, record
from telerig.io.recording.simulated.devices import (
    Faults,
    SimulatedDevice,
    SimulatedPorts,
    Truth,
    practice_rig,
    true_values,
)
from telerig.io.recording.tables import write_tables
from telerig.io.rig_file.description import DeviceDescription
from telerig.io.rig_file.rig_file import write_rig_toml

ENCODER = DeviceDescription("encoder", "encoder", "x", counts_per_mm=1000.0)
ARM = DeviceDescription("arm_left", "accelerometer", "x")
UNSTAMPED = replace(ENCODER, protocol="regex", pattern=r"(?P<counts>-?\d+)")
EDGE_S = 0.25
"""Readings made so shortly after the start, or before the end, may still be in the adapter."""
BUSY_S = 0.1
KILLED_S = 1.2
"""A kill costs the readings since the log was last brought to the disk."""


@dataclass(frozen=True)
class Account:
    """sent : readings made while the line was recorded. recorded : rows in the table.

    reported : readings that recording.json says are missing. edge : those made within the first
    and last moments. wrong : rows that differ from what was sent by more than a stage or an arm
    can move from one reading to the next one in the table, and by less; without stamps, rows whose
    time is off by more than 8 ms. busy : those made while the host was too busy to read for more
    than `BUSY_S`, which says nothing about when they were made. not_accounted : sent minus the
    others.
    """

    device: str
    sent: int
    recorded: int
    reported: int
    edge: int
    wrong: int
    slightly_wrong: int
    busy: int
    latest_s: float

    @property
    def not_accounted(self) -> int:
        return self.sent - self.recorded - self.reported - self.edge


def faulty_devices(rng: Generator, seconds: float) -> list[SimulatedDevice]:
    """One to four devices, each with faults of its own."""

    def faults() -> Faults:
        away = rng.integers(0, 3)
        return Faults(
            garbage_hz=float(rng.choice([0, 0, 2, 10])),
            cut_hz=float(rng.choice([0, 0, 2, 10])),
            lost_byte=float(rng.choice([0, 0, 0.01])),
            flood_s=tuple(rng.uniform(2.2, seconds, rng.integers(0, 2))),
            unplug_s=tuple(np.sort(rng.uniform(0.5, seconds, away))),
            away_s=float(rng.uniform(0.2, 0.7)),
        )

    packets = replace(ARM, name="arm_right", protocol="packets", unit_m_s2=1e-3)
    checked = replace(ARM, name="carriage", checksum="xor")
    rates = [(UNSTAMPED if rng.random() < 0.3 else ENCODER, 1000), (ARM, 2000), (packets, 2000)]
    rates.append((checked, 500))
    chosen = rng.permutation(4)[: rng.integers(1, 5)]
    return [
        SimulatedDevice(
            rates[k][0],
            float(rates[k][1]),
            drift_ppm=float(rng.uniform(-100, 100)),
            start_ticks=int(rng.integers(0, 2**32)),
            jitter_s=float(rng.choice([0.002, 0.016, 0.016, 0.1])),
            faults=faults(),
        )
        for k in chosen
    ]


def recorded_with_faults(
    sims: list[SimulatedDevice], folder: Path, rng: Generator, seconds: float, *, kill: bool = False
) -> list[Account]:
    """Record simulated devices over pseudo-terminals, or kill the recording; account for all."""
    run = folder / "runs" / "one"
    with SimulatedPorts(sims, folder / "ports", rng) as ports:
        if kill:
            write_rig_toml(practice_rig(ports.devices), folder / "rig.toml")
            command = [sys.executable, "-m", "telerig.scripts.main", "record", "--quiet", str(run)]
            process = subprocess.Popen(command)
            deadline = time.monotonic() + 60
            while not (run / LOG_NAME).exists() and time.monotonic() < deadline:
                time.sleep(0.02)
            time.sleep(seconds)
            process.kill()
            end_ns = time.monotonic_ns()
            process.wait()
        else:
            record(ports.devices, run, seconds=seconds)
            end_ns = time.monotonic_ns()
        truths = ports.truths
        time.sleep(0.05)
    done, found = write_tables(run / LOG_NAME), replay(run / LOG_NAME)
    assert done.summary["closed"] is not kill and not done.errors, done.errors
    assert done.summary["log_damaged_bytes"] < (100_000 if kill else 1)
    told = done.summary["devices"]
    start_ns = found.header.start_ns
    lost_s = KILLED_S if kill else EDGE_S
    return [
        account(sim, truth, one, told[sim.device.name]["lost"], start_ns, end_ns, lost_s)
        for sim, truth, one in zip(ports.sims, truths, found.records)
    ]


def account(
    sim: SimulatedDevice,
    truth: Truth,
    one: DeviceRecord,
    reported: int,
    start_ns: int,
    end_ns: int,
    lost_s: float,
) -> Account:
    """Compare the readings of a device with those that it sent."""
    begin_s = (start_ns - truth.start_ns) * 1e-9
    end_s = (end_ns - truth.start_ns) * 1e-9
    first, last = sim.first_after(max(begin_s, 0.0)), sim.first_after(end_s)
    stamped = "t" in one.values
    made_s = one.t_s + begin_s
    if stamped:
        ticks = np.mod(one.values["t"] - sim.start_ticks, 2.0**sim.device.time_bits)
        number = np.round(ticks * sim.device.time_unit_s * sim.rate_hz).astype(np.int64)
    else:
        number = np.round(made_s * (1 + 1e-6 * sim.drift_ppm) * sim.rate_hz).astype(np.int64)
    off = np.max([np.abs(one.values[k] - v) for k, v in true_values(sim, number).items()], axis=0)
    most = {"encoder": 5.0 if stamped else 100.0, "accelerometer": 0.2 / sim.device.unit_m_s2}
    step = np.diff(number, prepend=number[0] - 1, append=number[-1] + 1)
    wrong = off > most[sim.device.kind] * np.maximum(step[:-1], step[1:])
    first = min(first, int(number[0]))
    edge = int(number[0]) - first + last - 1 - int(number[-1])
    away = sum(np.clip(min(b, end_s) - max(a, end_s - 2), 0, None) for a, b in truth.away_s)
    away += sum(np.clip(min(b, begin_s + 2) - max(a, begin_s), 0, None) for a, b in truth.away_s)
    allowed = (lost_s + EDGE_S + away + 2 * sim.jitter_s + 0.2) * sim.rate_hz
    assert -2 <= edge <= allowed, (sim, edge, allowed)
    return Account(
        sim.device.name if stamped else "encoder without stamps",
        last - first, len(number), reported, edge,
        int(wrong.sum()), int(np.sum((off > 1e-9) & ~wrong)) if stamped else 0,
        round(_busy_s(one.arrived_s + begin_s, truth, sim) * sim.rate_hz),
        float(np.max(np.abs(one.t_s - sim.due_s(number) + begin_s))) if stamped else float("nan"),
    )  # fmt: skip


def _busy_s(arrived_s: Array, truth: Truth, sim: SimulatedDevice) -> float:
    """Time in s during which the device was there and nothing was read."""
    before, after = arrived_s[:-1], arrived_s[1:]
    idle = after - before > BUSY_S + sim.jitter_s
    for lost, found in truth.away_s:
        idle &= (after < lost) | (before > found)
    return float(np.sum((after - before)[idle]))


def table(accounts: list[Account]) -> str:
    """A table in Markdown, a row for each kind of device."""
    lines = [
        "| device | recordings | sent | in the tables | reported as missing | at begin and end "
        "| not accounted for | wrong | wrong by what motion hides |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in sorted({a.device for a in accounts}):
        own = [a for a in accounts if a.device == name]
        sums = [
            sum(getattr(a, key) for a in own) for key in ("sent", "recorded", "reported", "edge")
        ]
        rest = [sum(abs(a.not_accounted) for a in own), sum(a.wrong for a in own)]
        slight = sum(a.slightly_wrong for a in own)
        lines.append(
            f"| {name} | {len(own)} | " + " | ".join(map(str, [*sums, *rest, slight])) + " |"
        )
    return "\n".join(lines) + "\n"
