"""From a raw log to the readings of each device in host time, without those that are damaged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Ints
from telerig.io.recording.clock import ClockFit, host_times
from telerig.io.recording.log import (
    END,
    FOUND,
    LOST,
    RECEIVED,
    SENT,
    Entry,
    LogHeader,
    read_header,
    read_log,
)
from telerig.io.recording.protocols import Readings, parser
from telerig.io.rig_file.description import DeviceDescription

GAP_INTERVALS = 1.5
"""A step longer than so many usual ones is a gap."""
_NEIGHBOURS = 8
_FAR_RESIDUALS = 5.0
"""Far from a parabola through the neighbours: more than so many times their largest residual."""
_BLOCK_BYTES = 1 << 19
TIME_DIGITS = 7
"""Decimals of t_s in the tables: a tenth of a microsecond."""


@dataclass(frozen=True)
class DeviceRecord:
    """The readings of one device, in the order of time.

    t_s : (N,) since the beginning of the recording, strictly increasing. arrived_s : (N,) when the
    host received it. values : (N,) each, as sent. malformed_s : arrival of what could not be read.
    away_s : (lost, found) of each unplug; found is NaN if it never came back. faults : number of
    readings left out, by the reason. half_width_s : half the time from question to answer.
    """

    device: DeviceDescription
    t_s: Array
    arrived_s: Array
    values: dict[str, Array]
    malformed_s: Array
    malformed_bytes: int
    samples: tuple[str, ...]
    partial_bytes: int
    away_s: tuple[tuple[float, float], ...]
    clocks: tuple[ClockFit, ...]
    wraps: int
    faults: dict[str, int]
    time_from: str
    half_width_s: float


@dataclass(frozen=True)
class Replay:
    """end_s : time of the last entry. ended : whether the recording was closed, not cut off."""

    header: LogHeader
    records: tuple[DeviceRecord, ...]
    end_s: float
    ended: bool


@dataclass
class _Line:
    """The entries of one device while the log is read."""

    device: DeviceDescription
    chunks: list[tuple[int, bytes]] = field(default_factory=list)
    waiting: int = 0
    found: list[Readings] = field(default_factory=list)
    sent_ns: list[int] = field(default_factory=list)
    lost_ns: list[int] = field(default_factory=list)
    found_ns: list[int] = field(default_factory=list)
    partial_bytes: int = 0

    def __post_init__(self) -> None:
        self._parser = parser(self.device)

    def take(self, entry: Entry) -> None:
        if entry.kind == RECEIVED:
            self.chunks.append((entry.time_ns, entry.data))
            self.waiting += len(entry.data)
            if self.waiting > _BLOCK_BYTES:
                self.parse()
        elif entry.kind == SENT:
            self.sent_ns.append(entry.time_ns)
        elif entry.kind == LOST:
            self.cut()
            self.lost_ns.append(entry.time_ns)
        elif entry.kind == FOUND:
            self.found_ns.append(entry.time_ns)

    def parse(self) -> None:
        self.found.append(self._parser.feed(self.chunks))
        self.chunks, self.waiting = [], 0

    def cut(self) -> None:
        self.parse()
        self.partial_bytes += self._parser.cut()


def replay(path: Path) -> Replay:
    """The readings of a raw log. The same log gives the same numbers, to the last bit.

    Raises InputError for a file that is no log.
    """
    header = read_header(path)
    lines = [_Line(device) for device in header.devices]
    end_ns, ended = header.start_ns, False
    for entry in read_log(path):
        end_ns, ended = entry.time_ns, entry.kind == END
        if not ended:
            lines[entry.device].take(entry)
    for line in lines:
        line.cut()
    records = tuple(_record(line, header.start_ns) for line in lines)
    return Replay(header, records, (end_ns - header.start_ns) * 1e-9, ended)


def _record(line: _Line, start_ns: int) -> DeviceRecord:
    device = line.device
    arrived = _seconds(np.concatenate([r.arrived_ns for r in line.found]), start_ns)
    names = line.found[0].values
    values = {name: np.concatenate([r.values[name] for r in line.found]) for name in names}
    good = np.all([np.isfinite(v) for v in values.values()], axis=0) & np.isfinite(arrived)
    faults = {"not a number": int(np.sum(~good))}
    arrived, values = arrived[good], {name: v[good] for name, v in values.items()}
    clocks: tuple[ClockFit, ...] = ()
    wraps, half = 0, 0.0
    if "t" in values:
        wrap_s = 2.0**device.time_bits * device.time_unit_s if device.time_bits else 0.0
        clock = host_times(arrived, values["t"] * device.time_unit_s, wrap_s)
        t_s, time_from = clock.t_s - device.latency_s, "device"
        clocks, wraps = clock.fits, clock.wraps
        faults["wrong or repeated stamp"] = clock.wrong
    elif line.sent_ns:
        t_s, half = _between(arrived, _seconds(np.array(line.sent_ns), start_ns))
        time_from = "middle of question and answer"
        faults["which question it answers is not known"] = int(np.sum(np.isnan(t_s)))
        faults["question without answer"] = len(line.sent_ns) - len(arrived)
    else:
        t_s, time_from = arrived - device.latency_s, "arrival"
    t_s = np.round(t_s, TIME_DIGITS)
    kept = _in_order(t_s, faults)
    if "t" in values and device.kind != "frames" and device.checksum == "none":
        sound = beside_gaps(t_s[kept], [v[kept] for k, v in values.items() if k != "t"])
        faults["far from its neighbours, beside lost bytes"] = int(np.sum(~sound))
        kept = kept[sound]
    lost = _seconds(np.array(line.lost_ns), start_ns)
    back = _seconds(np.array(line.found_ns), start_ns)
    back = np.append(back, np.full(len(lost) - len(back), np.nan))
    return DeviceRecord(
        device=device,
        t_s=t_s[kept],
        arrived_s=arrived[kept],
        values={name: v[kept] for name, v in values.items()},
        malformed_s=_seconds(np.concatenate([r.malformed for r in line.found]), start_ns),
        malformed_bytes=sum(r.malformed_bytes for r in line.found),
        samples=tuple(repr(s[:60]) for r in line.found for s in r.samples)[:5],
        partial_bytes=line.partial_bytes,
        away_s=tuple(zip(lost.tolist(), back.tolist())),
        clocks=clocks,
        wraps=wraps,
        faults={reason: count for reason, count in faults.items() if count > 0},
        time_from=time_from,
        half_width_s=half,
    )


def _seconds(time_ns: NDArray[np.generic], start_ns: int) -> Array:
    return np.asarray((time_ns.astype(np.int64) - start_ns) * 1e-9, np.float64)


def _between(arrived: Array, sent: Array) -> tuple[Array, float]:
    """(N,) mid-time of question and answer, NaN where they cannot be paired; median half width."""
    asked = np.searchsorted(sent, arrived, "right") - 1
    answers = np.bincount(np.maximum(asked, 0), minlength=len(sent))
    clear = (asked >= 0) & (answers[asked] == 1) & ((asked < 1) | (answers[asked - 1] > 0))
    half = (arrived - sent[asked]) / 2
    t_s = np.where(clear, arrived - half, np.nan)
    return t_s, float(np.median(half[clear])) if clear.any() else 0.0


def _in_order(t_s: Array, faults: dict[str, int]) -> Ints:
    """Indices of the readings that have a time later than all before them."""
    timed = np.flatnonzero(np.isfinite(t_s))
    later = np.ones(len(timed), bool)
    later[1:] = t_s[timed][1:] > np.maximum.accumulate(t_s[timed])[:-1]
    faults["not later than the one before"] = int(np.sum(~later))
    return timed[later]


def beside_gaps(t_s: Array, values: Sequence[Array]) -> Bools:
    """(N,) False for a reading beside a gap whose value is far from what its neighbours predict.

    Where bytes are lost, two lines may become one that reads like a line: its stamp is right, its
    value is wrong, and the next reading is missing. Only readings beside a gap are tested.
    """
    sound = np.ones(len(t_s), bool)
    step = np.diff(t_s)
    if step.size < 4 * _NEIGHBOURS:
        return sound
    wide = np.flatnonzero(step > GAP_INTERVALS * np.median(step))
    suspects = np.unique(np.concatenate([wide, wide + 1]))
    plain = np.ones(len(t_s), bool)
    plain[suspects] = False
    for i in suspects:
        window = np.arange(max(i - 2 * _NEIGHBOURS, 0), min(i + 2 * _NEIGHBOURS + 1, len(t_s)))
        near = window[plain[window]]
        near = near[np.argsort(np.abs(t_s[near] - t_s[i]), kind="stable")[: 2 * _NEIGHBOURS]]
        if len(near) > _NEIGHBOURS:
            sound[i] = not any(_far(t_s[near] - t_s[i], v[near] - v[i]) for v in values)
    return sound


def _far(t_s: Array, value: Array) -> bool:
    """Whether 0 at 0 s is far from a parabola through these neighbours."""
    scale = float(np.max(np.abs(t_s)))
    powers = np.vander(t_s / scale, 3)
    found, *_ = np.linalg.lstsq(powers, value, rcond=None)
    residual = float(np.max(np.abs(powers @ found - value)))
    steps = np.diff(np.unique(value))
    resolution = float(np.min(steps)) if steps.size else 0.0
    return bool(abs(found[-1]) > _FAR_RESIDUALS * max(residual, resolution) + 1e-9)
