"""A running recording: reader threads, the raw log, and the status that the screen shows."""

from __future__ import annotations

import copy
import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.recording.log import END, LOST, RECEIVED, Entry, LogHeader, RawLog
from telerig.io.recording.ports import Reader, open_port
from telerig.io.recording.protocols import Readings, parser
from telerig.io.recording.replay import GAP_INTERVALS
from telerig.io.rig_file.description import DeviceDescription

LOG_NAME = "recording.raw"
FAILED_NAME = "recording.failed.raw"
TICK_S = 0.5
"""Interval at which the log goes to the disk and the status is reported; a power cut costs this."""
GARBAGE_S = 2.0
"""A line on which no reading comes for so long has the wrong baud rate, or another protocol."""


class GarbageError(InputError):
    """Bytes come over a line, but no reading."""


@dataclass
class DeviceStatus:
    """The status of a device for the screen. rate_hz : of readings since the last report.

    lost : readings that are missing by the device's own stamps. gaps : steps that they lie in.
    """

    name: str
    connected: bool = True
    readings: int = 0
    rate_hz: float = 0.0
    byte_count: int = 0
    malformed: int = 0
    lost: int = 0
    gaps: int = 0
    unplugged: int = 0
    sample: bytes = b""
    _last: float = field(default=np.nan, repr=False)
    _step: float = field(default=np.nan, repr=False)

    def add(self, device: DeviceDescription, found: Readings) -> None:
        """Count the readings, and those that are missing between them."""
        self.readings += len(found.arrived_ns)
        self.malformed += len(found.malformed)
        self.sample = found.samples[0] if found.samples else self.sample
        if device.poll is None and "t" in found.values and len(found.arrived_ns):
            self._count_gaps(found.values["t"], 2.0**device.time_bits if device.time_bits else 0.0)

    def _count_gaps(self, stamps: Array, wrap: float) -> None:
        steps = np.diff(np.concatenate([[self._last], stamps]))
        steps = np.mod(steps, wrap) if wrap else steps
        steps = steps[np.isfinite(steps) & (steps > 0)]
        self._last = float(stamps[-1])
        if steps.size >= 8:
            self._step = float(np.median(steps))
        wide = steps[(steps > GAP_INTERVALS * self._step) & (steps < 1e5 * self._step)]
        self.gaps += len(wide)
        self.lost += int(np.sum(np.round(wide / self._step) - 1))


@dataclass(frozen=True)
class Status:
    """The status of the whole recording, reported every `TICK_S`."""

    seconds: float
    log_bytes: int
    devices: tuple[DeviceStatus, ...]


def record(
    devices: Sequence[DeviceDescription],
    folder: Path,
    *,
    cameras: Sequence[str] = (),
    seconds: float | None = None,
    stop: threading.Event | None = None,
    tell: Callable[[Status], None] = lambda _: None,
) -> Path:
    """Record all devices into ``folder``/recording.raw until ``stop`` is set or time is up.

    Returns the path of the log, from which `telerig.io.recording.tables.write_tables` makes the
    tables of the run. Raises InputError for a port that cannot be opened, a log that cannot be
    written, and a device that sends bytes but no reading in the first `GARBAGE_S`.
    """
    if not devices:
        raise InputError("no device to record", todo="add a table [devices.<name>] to rig.toml")
    stop = stop or threading.Event()
    log_path = folder / LOG_NAME
    ports: list[Any] = []
    try:
        for device in devices:
            ports.append(open_port(device))
    except InputError:
        _close_all(ports)
        raise
    try:
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        header = LogHeader(time.monotonic_ns(), now, tuple(cameras), tuple(devices))
        log = RawLog(log_path, header)
    except InputError:
        _close_all(ports)
        raise
    with log:
        try:
            _Session(header, ports, log).run(seconds, stop, tell)
        except GarbageError:
            log_path.rename(folder / FAILED_NAME)
            raise
    return log_path


def _close_all(ports: list[Any]) -> None:
    for port in ports:
        port.close()


class _Session:
    def __init__(self, header: LogHeader, ports: list[Any], log: RawLog) -> None:
        self._devices, self._start_ns = header.devices, header.start_ns
        self._log = log
        self._queue: queue.SimpleQueue[Entry] = queue.SimpleQueue()
        self._readers = [
            Reader(i, device, port, self._queue.put)
            for i, (device, port) in enumerate(zip(self._devices, ports))
        ]
        self._parsers = [parser(device) for device in self._devices]
        self._status = [DeviceStatus(device.name) for device in self._devices]
        self._unread = set(range(len(self._devices)))
        self._drained = time.monotonic()

    def run(
        self, seconds: float | None, stop: threading.Event, tell: Callable[[Status], None]
    ) -> None:
        for reader in self._readers:
            reader.start()
        try:
            self._ticks(seconds, stop, tell)
        finally:
            for reader in self._readers:
                reader.stop()
            for reader in self._readers:
                reader.join(2.0)
        self._drain()
        self._log.append(Entry(END, 0, time.monotonic_ns(), b""))
        self._log.flush()
        tell(self._report())

    def _ticks(
        self, seconds: float | None, stop: threading.Event, tell: Callable[[Status], None]
    ) -> None:
        begin = due = time.monotonic()
        end = float("inf") if seconds is None else begin + seconds
        while not stop.is_set() and due < end:
            due = min(due + TICK_S, end)
            stop.wait(max(0.0, due - time.monotonic()))
            self._drain()
            self._check(time.monotonic() - begin)
            tell(self._report())

    def _drain(self) -> None:
        """Bring what has come to the disk, then count the readings in it."""
        chunks: list[list[tuple[int, bytes]]] = [[] for _ in self._devices]
        before = [status.readings for status in self._status]
        now = time.monotonic()
        elapsed_s, self._drained = max(now - self._drained, 1e-3), now
        while not self._queue.empty():
            entry = self._queue.get()
            self._log.append(entry)
            if entry.kind == RECEIVED:
                chunks[entry.device].append((entry.time_ns, entry.data))
            elif entry.kind == LOST:
                self._count(entry.device, chunks[entry.device])
                chunks[entry.device] = []
                self._parsers[entry.device].cut()
                self._status[entry.device].unplugged += 1
        self._log.flush()
        for i, status in enumerate(self._status):
            self._count(i, chunks[i])
            status.rate_hz = (status.readings - before[i]) / elapsed_s
            status.connected = self._readers[i].connected

    def _count(self, i: int, chunks: list[tuple[int, bytes]]) -> None:
        self._status[i].byte_count += sum(len(data) for _, data in chunks)
        self._status[i].add(self._devices[i], self._parsers[i].feed(chunks))

    def _check(self, elapsed_s: float) -> None:
        """Raises what ended a reader, and InputError for a line on which no reading has come."""
        for reader in self._readers:
            if reader.fault is not None:
                raise reader.fault
        self._unread = {i for i in self._unread if not self._status[i].readings}
        if elapsed_s < GARBAGE_S:
            return
        for i in sorted(self._unread):
            if self._status[i].byte_count:
                raise _no_reading(self._devices[i], self._status[i])
        self._unread = set()

    def _report(self) -> Status:
        seconds = (time.monotonic_ns() - self._start_ns) * 1e-9
        return Status(seconds, self._log.bytes, tuple(map(copy.copy, self._status)))


def _no_reading(device: DeviceDescription, status: DeviceStatus) -> GarbageError:
    shown = f", like {status.sample[:40]!r}" if status.sample else ""
    return GarbageError(
        f"{status.byte_count} bytes came in {GARBAGE_S:g} s, but not one reading{shown}",
        where=f"devices.{device.name} port {device.port}",
        todo=f"set baud in rig.toml to the device's baud rate (now {device.baud}); "
        f"if the bytes look right, correct its protocol (now {device.protocol})",
    )
