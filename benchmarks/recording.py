"""Does `telerig record` lose a line, and are its times right?

Usage: python benchmarks/recording.py [--minutes 10] [--bad-seconds 60] [--seed 0] [--out FILE.md]

Simulated devices in a process of their own speak over pseudo-terminals in real time; readings wait
up to 16 ms before they are sent. Each reading follows from its number, so that a lost or changed
one shows. CPU is that of the recording process, in percent of one core.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.recording.replay import DeviceRecord, replay
from telerig.io.recording.session import record
from telerig.io.recording.simulated.devices import (
    Faults,
    SimulatedDevice,
    SimulatedPorts,
    Truth,
    practice_rig,
    stage_position_mm,
    true_values,
)
from telerig.io.recording.tables import write_tables
from telerig.io.rig_file.description import DeviceDescription
from telerig.io.rig_file.rig_file import write_rig_toml

Array = NDArray[np.float64]

EDGE_S = 0.06
"""Readings made so shortly before an unplug may be in the adapter still."""


def clean_devices() -> list[SimulatedDevice]:
    encoder = DeviceDescription("encoder", "encoder", "x", counts_per_mm=1000.0)
    arms = [DeviceDescription(f"arm_{side}", "accelerometer", "x") for side in ("left", "right")]
    return [
        SimulatedDevice(encoder, 1000.0, drift_ppm=40.0, start_ticks=2**32 - 20_000_000),
        SimulatedDevice(arms[0], 2000.0, drift_ppm=-60.0),
        SimulatedDevice(arms[1], 2000.0, drift_ppm=15.0, start_ticks=123_456_789),
    ]


def bad_devices() -> list[SimulatedDevice]:
    faults = Faults(garbage_hz=1.0, cut_hz=1.0, unplug_s=(15.0, 35.0), away_s=2.0)
    made = clean_devices()
    checked = replace(made[1].device, name="arm_checked", checksum="xor")
    packets = replace(made[2].device, name="arm_packets", protocol="packets", unit_m_s2=1e-3)
    made += [replace(made[1], device=checked), replace(made[2], device=packets)]
    return [replace(sim, faults=faults) for sim in made]


def _simulate(
    sims: list[SimulatedDevice], folder: Path, seed: int, ready: Any, stop: Any, told: Any
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with SimulatedPorts(sims, folder, np.random.default_rng(seed)) as ports:
        ready.set()
        stop.wait()
    told.put(ports.truths)


class Devices:
    """Simulated devices in another process; `truths` once they have ended."""

    def __init__(self, sims: list[SimulatedDevice], folder: Path, seed: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._ready, self._stop, self._told = context.Event(), context.Event(), context.Queue()
        self.devices = [replace(s.device, port=str(folder / s.device.name)) for s in sims]
        self.truths: list[Truth] = []
        channels = (self._ready, self._stop, self._told)
        self._process = context.Process(target=_simulate, args=(sims, folder, seed, *channels))
        self._process.start()
        self._ready.wait(60)

    def end(self) -> None:
        self._stop.set()
        self.truths = self._told.get(timeout=60)
        self._process.join()


@contextmanager
def speaking(sims: list[SimulatedDevice], folder: Path, seed: int) -> Iterator[Devices]:
    devices = Devices(sims, folder, seed)
    try:
        yield devices
    finally:
        devices.end()


@dataclass(frozen=True)
class Judged:
    """missing : readings between the first and the last that came that are not there, apart from
    those spoilt by faults and those of an unplug; wrong : readings whose values are not as sent."""

    name: str
    came: int
    missing: int
    spoilt: int
    wrong: int
    malformed: int
    overrun: int
    gaps: int
    unplugged: int
    drift_error_ppm: float
    drift_sd_ppm: float
    least_delay_us: float
    offset_error_us: float
    worst_time_us: float
    sd_offset_us: float


def judge(sim: SimulatedDevice, truth: Truth, record_: DeviceRecord, start_ns: int) -> Judged:
    begin_s = (truth.start_ns - start_ns) * 1e-9
    ticks = np.mod(record_.values["t"] - sim.start_ticks, 2.0**sim.device.time_bits)
    number = np.round(ticks * sim.device.time_unit_s * sim.rate_hz).astype(np.int64)
    due = begin_s + sim.due_s(number)
    every = np.arange(number.min(), number.max() + 1)
    gone = every[~np.isin(every, number)]
    gone = gone[~np.isin(gone, truth.spoilt)]
    at = np.asarray(sim.due_s(gone))
    for lost, back in truth.away_s:
        gone, at = (v[(at < lost - EDGE_S) | (at > back + 0.4)] for v in (gone, at))
    true = true_values(sim, number)
    wrong = np.any([np.abs(record_.values[k] - v) > 1e-9 for k, v in true.items()], axis=0)
    error = record_.t_s - due
    least = float(np.min(record_.arrived_s - due))
    longest = max(record_.clocks, key=lambda c: c.readings)
    made = set(every.tolist())
    return Judged(
        sim.device.name, len(number), len(gone), len(made & set(truth.spoilt)), int(wrong.sum()),
        len(record_.malformed_s), len(made & set(truth.overrun)),
        int(np.sum(np.diff(record_.t_s) > 1.5 / sim.rate_hz)), len(record_.away_s),
        longest.drift_ppm - sim.drift_ppm, longest.sd_drift_ppm,
        1e6 * least, 1e6 * (float(np.mean(error)) - least),
        1e6 * float(np.max(np.abs(error - least))), longest.sd_offset_us,
    )  # fmt: skip


def run(
    sims: list[SimulatedDevice], seconds: float, seed: int, folder: Path
) -> tuple[list[Judged], dict[str, float]]:
    with speaking(sims, folder / "ports", seed) as devices:
        before, began = resource.getrusage(resource.RUSAGE_SELF), time.monotonic()
        log = record(devices.devices, folder / "run", seconds=seconds)
        after, spent = resource.getrusage(resource.RUSAGE_SELF), time.monotonic() - began
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    begin = time.process_time()
    write_tables(log)
    tables_s = time.process_time() - begin
    first = hashes(folder / "run")
    write_tables(log, folder / "again")
    found = replay(log)
    judged = [
        judge(sim, truth, one, found.header.start_ns)
        for sim, truth, one in zip(sims, devices.truths, found.records)
    ]
    return judged, {
        "seconds": spent,
        "cpu": 100 * cpu / spent,
        "tables_s": tables_s,
        "log_mb": log.stat().st_size / 1e6,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "same": float(first == hashes(folder / "again")),
    }


def hashes(folder: Path) -> dict[str, str]:
    names = sorted(p for p in folder.iterdir() if p.suffix in (".csv", ".json"))
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in names}


def power_loss(folder: Path, seed: int) -> float:
    """Seconds of readings that a recording loses when its process is killed."""
    with speaking(clean_devices(), folder / "ports", seed) as devices:
        write_rig_toml(practice_rig(devices.devices), folder / "rig.toml")
        command = [sys.executable, "-m", "telerig.scripts.main", "record", "--quiet"]
        process = subprocess.Popen([*command, str(folder / "runs" / "cut")])
        log = folder / "runs" / "cut" / "recording.raw"
        deadline = time.monotonic() + 60
        while not log.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        time.sleep(6.3)
        process.send_signal(signal.SIGKILL)
        killed_ns = time.monotonic_ns()
        process.wait()
    found = replay(log)
    last = min(float(r.t_s[-1]) for r in found.records)
    return (killed_ns - found.header.start_ns) * 1e-9 - last


def polled(protocol: str, seconds: float, seed: int, folder: Path) -> tuple[int, float, float]:
    """Readings, half of question to answer (ms), and RMS of the time's error (ms)."""
    device = DeviceDescription(
        "stage", "encoder", "x", protocol=protocol, counts_per_mm=20000.0, poll_hz=50.0
    )  # type: ignore[arg-type]
    with SimulatedPorts(
        [SimulatedDevice(device, 50.0)], folder, np.random.default_rng(seed)
    ) as ports:
        log = record(ports.devices, folder / "run", seconds=seconds)
    (one,) = (found := replay(log)).records
    elapsed = one.t_s - (ports.truths[0].start_ns - found.header.start_ns) * 1e-9
    position = one.values.get("position_mm", one.values.get("counts", np.zeros(0)) / 20000.0)
    late = np.arange(-0.05, 0.05, 1e-4)
    errors = []
    for t, p in zip(elapsed, position):
        if abs(np.sin(2 * np.pi * t / 10.0)) > 0.5:
            errors.append(late[np.argmin(np.abs(stage_position_mm(t + late) - p))])
    return len(position), 1e3 * one.half_width_s, 1e3 * float(np.sqrt(np.mean(np.square(errors))))


def clean_text(judged: Sequence[Judged], costs: dict[str, float]) -> Iterator[str]:
    yield f"## {costs['seconds'] / 60:.1f} minutes: encoder 1 kHz, two accelerometers 2 kHz\n\n"
    yield "| device | readings | missing | of these overrun in the port | wrong "
    yield (
        "| drift error ppm (sd) | least delay us | offset error us (sd) | worst time us |\n"
        + "|"
        + "---|" * 9
        + "\n"
    )
    for j in judged:
        yield f"| {j.name} | {j.came} | {j.missing} | {j.overrun} | {j.wrong} "
        yield f"| {j.drift_error_ppm:+.4f} ({j.drift_sd_ppm:.4f}) | {j.least_delay_us:.0f} "
        yield f"| {j.offset_error_us:+.1f} ({j.sd_offset_us:.0f}) | {j.worst_time_us:.1f} |\n"
    yield "\nOffset error and worst time are beyond the line's least delay, which one-way stamps "
    yield "cannot see and which is in all times of that device.\n\n"
    yield f"CPU while recording: {costs['cpu']:.1f} % of one core. Tables: {costs['tables_s']:.1f} "
    yield f"s of CPU. Log: {costs['log_mb']:.0f} MB. Memory: {costs['memory_mb']:.0f} MB at most. "
    yield f"Tables made twice are the same, byte for byte: {'yes' if costs['same'] else 'NO'}.\n\n"


def bad_text(judged: Sequence[Judged], costs: dict[str, float]) -> Iterator[str]:
    yield f"## {costs['seconds']:.0f} s of bad lines\n\n"
    yield "Once a second, at random, up to 40 bytes of garbage in the middle of a reading, and "
    yield "once a second the bytes between two readings are lost; unplugged twice for 2 s.\n\n"
    yield "| device | came | spoilt by faults | sound but missing | malformed | wrong values let "
    yield (
        "through | gaps | unplugged | drift error ppm | worst time us |\n"
        + "|"
        + "---|" * 10
        + "\n"
    )
    for j in judged:
        yield f"| {j.name} | {j.came} | {j.spoilt} | {j.missing} | {j.malformed} | {j.wrong} "
        yield f"| {j.gaps} | {j.unplugged} | {j.drift_error_ppm:+.3f} | {j.worst_time_us:.0f} |\n"
    yield f"\nCPU: {costs['cpu']:.1f} %. A damaged line that reads like a line is told from a "
    yield "sound one by its neighbours, unless it is wrong by less than motion can be.\n\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--bad-seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    text = "# Recording\n\n"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bad").mkdir()
        bad = run(bad_devices(), options.bad_seconds, options.seed, folder / "bad")
        print("".join(bad_text(*bad)), flush=True)
        lost_s = power_loss(folder / "cut", options.seed)
        print(lost_s, flush=True)
        stages = [(p, *polled(p, 15.0, options.seed, folder / p)) for p in ("zaber", "grbl")]
        clean = run(clean_devices(), 60 * options.minutes, options.seed, folder / "clean")
    text += "".join(clean_text(*clean)) + "".join(bad_text(*bad))
    text += f"## Killed while recording\n\nReadings of the last {lost_s:.2f} s are lost.\n\n"
    text += "## Polled stages, answers up to 16 ms late\n\n"
    text += "| protocol | readings | half of question to answer ms | RMS of time ms |\n"
    text += "|---|---|---|---|\n"
    for row in stages:
        text += f"| {row[0]} | {row[1]} | {row[2]:.2f} | {row[3]:.2f} |\n"
    load = os.getloadavg()[2]
    text += f"\n{os.cpu_count()} cores, shared with other work (load {load:.1f} over 15 minutes).\n"
    print(text)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
