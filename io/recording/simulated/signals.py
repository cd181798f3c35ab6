"""What simulated sensors send. Every reading follows from its index, so that a lost one shows."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator

from telerig.arrays import Array, Ints
from telerig.io.recording.protocols import SYNC, xor_checksum
from telerig.io.rig_file.description import DeviceDescription
from telerig.rig.units import STANDARD_GRAVITY_M_S2

TRAVEL_MM = 20.0
PERIOD_S = 10.0
_GARBAGE_BYTES = 40


@dataclass(frozen=True)
class Faults:
    """garbage_hz, cut_hz : mean number per second of random bytes inserted, and of bytes lost.

    unplug_s : when the device is unplugged, in s from its start, for ``away_s`` each time.
    skip : frames for which a frame counter sends no line.
    """

    garbage_hz: float = 0.0
    cut_hz: float = 0.0
    unplug_s: tuple[float, ...] = ()
    away_s: float = 1.0
    skip: tuple[int, ...] = ()


@dataclass(frozen=True)
class SimulatedDevice:
    """drift_ppm : how much faster its clock runs than the host's. start_ticks : of its counter.

    jitter_s : readings wait in the adapter for a random time up to this, then arrive together.
    """

    device: DeviceDescription
    rate_hz: float
    drift_ppm: float = 0.0
    start_ticks: int = 0
    jitter_s: float = 0.016
    faults: Faults = field(default_factory=Faults)

    def due_s(self, number: Ints | int) -> Array:
        """When reading ``number`` is made, in the host's seconds from the device's start."""
        return np.asarray(self.elapsed_s(number) / (1 + 1e-6 * self.drift_ppm))

    def elapsed_s(self, number: Ints | int) -> Array:
        """The same by the device's own clock."""
        return np.round(np.asarray(number) * self._ticks_apart()) * self.device.time_unit_s

    def first_after(self, host_s: float) -> int:
        """Number of the first reading made later than ``host_s``."""
        number = int(host_s * self.rate_hz * (1 + 1e-6 * self.drift_ppm)) - 1
        while float(self.due_s(number)) <= host_s:
            number += 1
        return max(number, 0)

    def stamps(self, number: Ints) -> Ints:
        """The counter's ticks that readings carry."""
        ticks = np.round(number * self._ticks_apart()).astype(np.int64) + self.start_ticks
        return ticks % 2**self.device.time_bits if self.device.time_bits else ticks

    def _ticks_apart(self) -> float:
        return 1 / (self.rate_hz * self.device.time_unit_s)


def true_values(sim: SimulatedDevice, number: Ints) -> dict[str, Array]:
    """The values of readings, exactly as they are sent."""
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
    """The bytes of each of these readings."""
    stamps, values = sim.stamps(number).tolist(), true_values(sim, number)
    rows = list(zip(*(v.tolist() for v in values.values())))
    if sim.device.protocol == "packets":
        form = "<Ii" if sim.device.kind == "encoder" else "<Ihhh"
        return [_packet(struct.pack(form, t, *map(int, row))) for t, row in zip(stamps, rows)]
    line = "%d,%.4f,%.4f,%.4f" if sim.device.kind == "accelerometer" else "%d,%d"
    lines = [(line % (t, *row)).encode() for t, row in zip(stamps, rows)]
    if sim.device.checksum == "xor":
        lines = [text + xor_checksum(text) for text in lines]
    return [text + b"\r\n" for text in lines]


def answer(device: DeviceDescription, position_mm: float) -> bytes:
    """The answer of a polled stage."""
    if device.protocol == "grbl":
        place = {axis: position_mm if axis == device.axis else 0.0 for axis in "xyz"}
        positions = ",".join(f"{place[axis]:.3f}" for axis in "xyz")
        return f"<Run|MPos:{positions}|FS:0,0>\r\n".encode()
    return f"@01 0 OK BUSY -- {round(position_mm * (device.counts_per_mm or 1.0))}\r\n".encode()


def stage_position_mm(elapsed_s: Array) -> Array:
    """Position of the simulated stage."""
    return TRAVEL_MM * (1 - np.cos(2 * np.pi * elapsed_s / PERIOD_S))


def damage(
    pieces: list[bytes], faults: Faults, per_reading_s: float, rng: Generator
) -> tuple[bytes, list[int]]:
    """The bytes that arrive over a line with faults, and the indices of the damaged pieces."""
    if not faults.garbage_hz and not faults.cut_hz:
        return b"".join(pieces), []
    out, spoilt = list(pieces), set()
    for i, piece in enumerate(pieces):
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
