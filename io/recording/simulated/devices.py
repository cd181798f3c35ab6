"""Simulated sensors: what they send, each on a pseudo-terminal as a real one is on its port.

Every reading follows from its index, so that a lost one shows. A rig of them is for practice.
"""

from __future__ import annotations

import errno
import os
import select
import struct
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.random import Generator

from telerig.arrays import Array, Ints
from telerig.io.recording.protocols import SYNC, poll_command, xor_checksum
from telerig.io.rig_file.description import (
    AccelerometerDescription,
    CameraDescription,
    DeviceDescription,
    RigDescription,
    StageDescription,
)
from telerig.rig.target import Target
from telerig.rig.units import STANDARD_GRAVITY_M_S2

TRAVEL_MM = 20.0
PERIOD_S = 10.0
_GARBAGE_BYTES = 40


@dataclass(frozen=True)
class Faults:
    """garbage_hz, cut_hz : mean number per second of random bytes inserted, and of bytes lost.

    lost_byte : the share of readings that lose one byte each.
    flood_s : when the line carries ``flood_bytes`` random bytes at once, in s from its start.
    unplug_s : when the device is unplugged, in s from its start, for ``away_s`` each time.
    skip : frames for which a frame counter sends no line.
    """

    garbage_hz: float = 0.0
    cut_hz: float = 0.0
    lost_byte: float = 0.0
    flood_s: tuple[float, ...] = ()
    flood_bytes: int = 20_000
    unplug_s: tuple[float, ...] = ()
    away_s: float = 1.0
    skip: tuple[int, ...] = ()


@dataclass(frozen=True)
class SimulatedDevice:
    """One device; with the protocol "regex" its lines carry no stamps.

    drift_ppm : how much faster its clock runs than the host's.
    start_ticks : of its counter.

    jitter_s : readings wait in the adapter for a random time up to this, then arrive together.
    """

    device: DeviceDescription
    rate_hz: float
    drift_ppm: float = 0.0
    start_ticks: int = 0
    jitter_s: float = 0.016
    faults: Faults = field(default_factory=Faults)

    def due_s(self, number: Ints | int) -> Array:
        """Return when reading ``number`` is made, in the host's seconds from the device's start."""
        return np.asarray(self.elapsed_s(number) / (1 + 1e-6 * self.drift_ppm))

    def elapsed_s(self, number: Ints | int) -> Array:
        """Return the same by the device's own clock."""
        return np.round(np.asarray(number) * self._ticks_apart()) * self.device.time_unit_s

    def first_after(self, host_s: float) -> int:
        """Number of the first reading made later than ``host_s``."""
        number = int(host_s * self.rate_hz * (1 + 1e-6 * self.drift_ppm)) - 1
        while float(self.due_s(number)) <= host_s:
            number += 1
        return max(number, 0)

    def stamps(self, number: Ints) -> Ints:
        """Return the counter's ticks that readings carry."""
        ticks = np.round(number * self._ticks_apart()).astype(np.int64) + self.start_ticks
        return ticks % 2**self.device.time_bits if self.device.time_bits else ticks

    def _ticks_apart(self) -> float:
        return 1 / (self.rate_hz * self.device.time_unit_s)


def true_values(sim: SimulatedDevice, number: Ints) -> dict[str, Array]:
    """Return the values of readings, exactly as they are sent."""
    phase = 2 * np.pi * sim.elapsed_s(number) / PERIOD_S
    kind = sim.device.kind
    if kind == "frames":
        return {"frame": np.asarray(number, float)}
    if kind == "encoder":
        mm = TRAVEL_MM * (1 - np.cos(phase))
        return {"counts": np.round(mm * (sim.device.counts_per_mm or 1.0))}
    up = TRAVEL_MM * 1e-3 * (2 * np.pi / PERIOD_S) ** 2 * np.cos(phase)
    axes = {
        "ax": 0.05 * np.sin(31 * phase),
        "ay": STANDARD_GRAVITY_M_S2 + up,
        "az": 0.03 * np.cos(57 * phase),
    }
    digits = 0 if sim.device.protocol == "packets" else 4
    return {axis: np.round(a / sim.device.unit_m_s2, digits) for axis, a in axes.items()}


def messages(sim: SimulatedDevice, number: Ints) -> list[bytes]:
    """Return the bytes of each of these readings."""
    stamps, values = sim.stamps(number).tolist(), true_values(sim, number)
    rows = list(zip(*(v.tolist() for v in values.values())))
    if sim.device.protocol == "packets":
        form = "<Ii" if sim.device.kind == "encoder" else "<Ihhh"
        return [_packet(struct.pack(form, t, *map(int, row))) for t, row in zip(stamps, rows)]
    line = "%.4f,%.4f,%.4f" if sim.device.kind == "accelerometer" else "%d"
    if sim.device.protocol == "regex":
        lines = [(line % row).encode() for row in rows]
    else:
        lines = [(f"%d,{line}" % (t, *row)).encode() for t, row in zip(stamps, rows)]
    if sim.device.checksum == "xor":
        lines = [text + xor_checksum(text) for text in lines]
    return [text + b"\r\n" for text in lines]


def answer(device: DeviceDescription, position_mm: float) -> bytes:
    """Return the answer of a polled stage."""
    if device.protocol == "grbl":
        place = {axis: position_mm if axis == device.axis else 0.0 for axis in "xyz"}
        positions = ",".join(f"{place[axis]:.3f}" for axis in "xyz")
        return f"<Run|MPos:{positions}|FS:0,0>\r\n".encode()
    return f"@01 0 OK BUSY -- {round(position_mm * (device.counts_per_mm or 1.0))}\r\n".encode()


def stage_position_mm(elapsed_s: Array) -> Array:
    """Return the position (mm) of the simulated stage."""
    return TRAVEL_MM * (1 - np.cos(2 * np.pi * elapsed_s / PERIOD_S))


def damage(
    pieces: list[bytes], faults: Faults, per_reading_s: float, rng: Generator
) -> tuple[bytes, list[int]]:
    """Return the bytes that arrive over a faulty line, and the indices of the damaged pieces."""
    if not faults.garbage_hz and not faults.cut_hz and not faults.lost_byte:
        return b"".join(pieces), []
    out, spoilt = list(pieces), set()
    for i, piece in enumerate(pieces):
        if faults.lost_byte and rng.random() < faults.lost_byte:
            at = int(rng.integers(0, len(piece)))
            out[i] = piece = piece[:at] + piece[at + 1 :]
            spoilt.add(i)
        if rng.random() < faults.garbage_hz * per_reading_s:
            at = int(rng.integers(0, len(piece)))
            noise = rng.integers(0, 256, int(rng.integers(1, _GARBAGE_BYTES)), np.uint8).tobytes()
            out[i] = piece[:at] + noise + piece[at:]
            spoilt.add(i)
        if rng.random() < faults.cut_hz * per_reading_s and i + 1 < len(out):
            at = int(rng.integers(0, len(piece)))
            out[i] = out[i][:at]
            out[i + 1] = out[i + 1][int(rng.integers(0, len(pieces[i + 1]))) :]
            spoilt |= {i, i + 1}
    return b"".join(out), sorted(spoilt)


def _packet(body: bytes) -> bytes:
    body = SYNC + body
    return body + bytes([sum(body) % 256])


_POLLED_WAIT_S = 0.05
_BUFFER_S = 0.25
"""How long a device keeps readings while its port is full; after that they are lost."""


@dataclass
class Truth:
    """What a simulated device did. start_ns : the host's time of its reading 0.

    sent : number of readings made.
    spoilt : indices of the readings that a fault damaged.
    overrun : indices of those for which the port's buffer was full (the host reads too slowly).
    away_s : (from, to) of each unplug, in seconds of the host's time from the start.
    """

    start_ns: int = 0
    sent: int = 0
    spoilt: list[int] = field(default_factory=list)
    overrun: list[int] = field(default_factory=list)
    floods: int = 0
    away_s: list[tuple[float, float]] = field(default_factory=list)


class PseudoTerminal:
    """A port with a name that stays the same when the device is unplugged and plugged in again."""

    def __init__(self, name: Path) -> None:
        self.name = name
        self.master = self._slave = -1

    def plug(self) -> None:
        """Open the pseudo-terminal and link ``name`` to it."""
        import tty

        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        beside = self.name.with_name(f".{self.name.name}.new")
        beside.symlink_to(os.ttyname(self._slave))
        beside.replace(self.name)

    def unplug(self) -> None:
        """Close it and remove the link, as when a cable is pulled."""
        if self.master >= 0:
            self.name.unlink(missing_ok=True)
            os.close(self._slave)
            os.close(self.master)
            self.master = self._slave = -1

    def write(self, data: bytes) -> int:
        """Returns how many of the bytes the port's buffer took."""
        written = 0
        deadline = time.monotonic() + _BUFFER_S
        while written < len(data):
            try:
                written += os.write(self.master, data[written:])
            except OSError as error:
                if error.errno != errno.EAGAIN or time.monotonic() > deadline:
                    return written
                select.select([], [self.master], [], 0.05)
        return written


class _Runner(threading.Thread):
    def __init__(self, sim: SimulatedDevice, port: PseudoTerminal, rng: Generator) -> None:
        super().__init__(name=f"simulate {sim.device.name}", daemon=True)
        self.truth = Truth()
        self._sim, self._port, self._rng = sim, port, rng
        self._stop_asked = threading.Event()

    def stop(self) -> None:
        self._stop_asked.set()
        self.join(2.0)

    def run(self) -> None:
        self.truth.start_ns = time.monotonic_ns()
        unplugs = sorted(self._sim.faults.unplug_s)
        command = poll_command(self._sim.device)
        while not self._stop_asked.is_set():
            if unplugs and self._elapsed_s() > unplugs[0]:
                unplugs.pop(0)
                self._go_away()
            if command is None:
                self._stream()
            else:
                self._answer(command)
        self._port.unplug()

    def _elapsed_s(self) -> float:
        return (time.monotonic_ns() - self.truth.start_ns) * 1e-9

    def _go_away(self) -> None:
        begin = self._elapsed_s()
        self._port.unplug()
        self._stop_asked.wait(self._sim.faults.away_s)
        self.truth.away_s.append((begin, self._elapsed_s()))
        self.truth.sent = self._sim.first_after(self._elapsed_s())
        self._port.plug()

    def _stream(self) -> None:
        pause = float(self._rng.uniform(0, self._sim.jitter_s))
        self._stop_asked.wait(max(pause, 0.5 / self._sim.rate_hz))
        number, pieces, data = made_since_last(self._sim, self.truth, self._elapsed_s(), self._rng)
        written = self._port.write(data)
        if written < len(data):
            ends = np.cumsum([len(piece) for piece in pieces])
            self.truth.overrun += number[ends > written].tolist()

    def _answer(self, command: bytes) -> None:
        if not select.select([self._port.master], [], [], _POLLED_WAIT_S)[0]:
            return
        try:
            asked = os.read(self._port.master, 4096).count(command)
        except OSError:
            self._stop_asked.wait(_POLLED_WAIT_S)
            return
        for _ in range(asked):
            place = float(stage_position_mm(np.asarray(self._elapsed_s())))
            self._stop_asked.wait(float(self._rng.uniform(0, self._sim.jitter_s)))
            self._port.write(answer(self._sim.device, place))
            self.truth.sent += 1


class SimulatedPorts:
    """Context manager: the devices send while it is open. `devices` have their ports filled in."""

    def __init__(self, sims: Sequence[SimulatedDevice], folder: Path, rng: Generator) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.sims = [_at(sim, folder) for sim in sims]
        ports = [PseudoTerminal(Path(sim.device.port)) for sim in self.sims]
        streams = rng.spawn(len(self.sims))
        for port in ports:
            port.plug()
        self._runners = [_Runner(*parts) for parts in zip(self.sims, ports, streams)]

    @property
    def devices(self) -> list[DeviceDescription]:
        """Return the descriptions of the simulated devices, with the ports to open."""
        return [sim.device for sim in self.sims]

    @property
    def truths(self) -> list[Truth]:
        """Return what each device has sent, in the order of `devices`."""
        return [runner.truth for runner in self._runners]

    def __enter__(self) -> SimulatedPorts:
        for runner in self._runners:
            runner.start()
        return self

    def __exit__(self, *error: object) -> None:
        for runner in self._runners:
            runner.stop()


def made_since_last(
    sim: SimulatedDevice, truth: Truth, host_s: float, rng: Generator
) -> tuple[Ints, list[bytes], bytes]:
    """Return indices and bytes of the readings since the last call, and the bytes that arrive."""
    until = sim.first_after(host_s)
    number = np.arange(truth.sent, until)
    number = number[~np.isin(number, sim.faults.skip)]
    truth.sent = until
    pieces = messages(sim, number)
    data, spoilt = damage(pieces, sim.faults, 1 / sim.rate_hz, rng)
    truth.spoilt += number[spoilt].tolist()
    floods = sum(flood_s <= host_s for flood_s in sim.faults.flood_s)
    if floods > truth.floods:
        truth.floods = floods
        truth.spoilt += [until, until - 1]  # the flood ends within the line that follows
        data += rng.integers(0, 256, sim.faults.flood_bytes, np.uint8).tobytes()
    return number, pieces, data


def _at(sim: SimulatedDevice, folder: Path) -> SimulatedDevice:
    return replace(sim, device=replace(sim.device, port=str(folder / sim.device.name)))


WRAP_AFTER_S = 10.0
UNPLACED = "not placed"
"""The port of a simulated device until `SimulatedPorts` opens one for it."""


def practice_devices() -> list[SimulatedDevice]:
    """Return an encoder at 1 kHz, accelerometers at 2 kHz on each arm, a frame counter at 100 Hz.

    Their clocks drift, and the encoder's counter wraps after `WRAP_AFTER_S`.
    """
    before_wrap = 2**32 - int(WRAP_AFTER_S * 1e6)
    encoder = DeviceDescription("encoder", "encoder", UNPLACED, counts_per_mm=1000.0)
    left = DeviceDescription("arm_left", "accelerometer", UNPLACED)
    right = DeviceDescription(
        "arm_right", "accelerometer", UNPLACED, protocol="packets", unit_m_s2=1e-3
    )
    frames = DeviceDescription("frame_counter", "frames", UNPLACED, cameras=("left", "right"))
    return [
        SimulatedDevice(encoder, 1000.0, drift_ppm=40.0, start_ticks=before_wrap),
        SimulatedDevice(left, 2000.0, drift_ppm=-60.0),
        SimulatedDevice(right, 2000.0, drift_ppm=15.0, start_ticks=123_456),
        SimulatedDevice(frames, 100.0, drift_ppm=5.0),
    ]


def practice_rig(devices: Sequence[DeviceDescription]) -> RigDescription:
    """Return a rig of two cameras that knows these devices."""
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    sensors = [d.name for d in devices if d.kind == "accelerometer"]
    cameras = {name: CameraDescription(name, (512, 512), 10.0) for name in ("left", "right")}
    return RigDescription(
        name="practice",
        cameras=cameras,
        target=Target(rows=3, columns=5, pitch_mm=(7.0, 7.0), dot_diameter_mm=2.4),
        rotvec_from_first_deg={"right": (0.0, 90.0, 0.0)},
        stage=StageDescription((0.0, -1.0, 0.0), (0.0, -1.0, 0.0)),
        accelerometers={
            name: AccelerometerDescription(name, name.removeprefix("arm_"), axes, 22.5)
            for name in sensors
        },
        devices={d.name: d for d in devices},
    )
