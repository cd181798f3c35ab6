"""A running recording: reader threads, the raw log, and the status that the screen shows."""

from __future__ import annotations

import copy
import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.recording.clock import check_unit
from telerig.io.recording.judgement import GAP_INTERVALS, mostly_garbage
from telerig.io.recording.log import END, LOST, RECEIVED, Entry, LogHeader, RawLog
from telerig.io.recording.ports import Reader, open_port
from telerig.io.recording.protocols import Readings, joined, parser
from telerig.io.rig_file.description import DeviceDescription
from telerig.live import publish

LOG_NAME = "recording.raw"
FAILED_NAME = "recording.failed.raw"
"""The log of a recording that was refused; it is kept, and can be replayed."""

TICK_S = 0.5
"""Interval at which the log goes to the disk and the status is reported; a power cut costs this."""
GARBAGE_S = 2.0
"""A line on which no reading comes for so long has the wrong baud rate, or another protocol."""


def log_in(folder: Path) -> Path:
    """Return the log in a recording's folder.

    It is recording.raw, or the log of a refused recording if there is no recording.raw.
    """
    log, failed = folder / LOG_NAME, folder / FAILED_NAME
    return failed if failed.is_file() and not log.is_file() else log


class GarbageError(InputError):
    """The first bytes of a device are not the readings that its description states."""


@dataclass
class DeviceStatus:
    """The status of a device for the screen.

    readings, byte_count, malformed, unplugged : numbers so far
    rate_hz : readings per second.
    lost, gaps : number of missing readings, and of gaps, as the device's time stamps show.
    sample : malformed bytes, for messages.
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
    tables.

    cameras : names of the cameras, for the log's header.
    tell : called with the state of the recording from time to time.

    Raises InputError for a port that cannot be opened, a log that cannot be written, and a device
    that in its first `GARBAGE_S` seconds does not send what rig.toml states. A device that fails
    later does not stop the recording of the others.
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
    publish("recorder", devices=tuple(devices), cameras=tuple(cameras), folder=folder.resolve())
    with log:
        try:
            _Session(header, ports, log).run(seconds, stop, tell)
        except GarbageError:
            with suppress(OSError):
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
        self._first: list[list[Readings]] = [[] for _ in self._devices]
        self._checked = False
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
        came: list[list[Entry]] = [[] for _ in self._devices]
        now = time.monotonic()
        elapsed_s, self._drained = max(now - self._drained, 1e-3), now
        for _ in range(self._queue.qsize()):
            entry = self._queue.get()
            self._log.append(entry)
            came[entry.device].append(entry)
        self._log.flush()
        for i, status in enumerate(self._status):
            before = status.readings
            self._count(i, came[i])
            status.rate_hz = (status.readings - before) / elapsed_s
            status.connected = self._readers[i].connected

    def _count(self, i: int, entries: list[Entry]) -> None:
        """Count the readings in these entries, only for the screen: no error in it matters."""
        status, reader = self._status[i], self._parsers[i]
        chunks: list[tuple[int, bytes]] = []
        try:
            for entry in entries:
                if entry.kind == RECEIVED:
                    chunks.append((entry.time_ns, entry.data))
                    status.byte_count += len(entry.data)
                elif entry.kind == LOST:
                    self._add(i, reader.feed(chunks))
                    chunks = []
                    reader.cut()
                    status.unplugged += 1
            self._add(i, reader.feed(chunks))
        except Exception:  # noqa: BLE001
            self._parsers[i] = parser(self._devices[i])

    def _add(self, i: int, found: Readings) -> None:
        self._status[i].add(self._devices[i], found)
        arrived_s = (found.arrived_ns - self._start_ns) * 1e-9
        publish("readings", device=self._devices[i].name, arrived_s=arrived_s, values=found.values)
        if not self._checked:
            self._first[i].append(found)

    def _check(self, elapsed_s: float) -> None:
        """Raise GarbageError for a device whose first bytes are not what its description states."""
        if elapsed_s < GARBAGE_S or self._checked:
            return
        self._checked = True
        for device, status, first in zip(self._devices, self._status, self._first):
            if not status.byte_count:
                continue
            found = joined(first)
            if not status.readings:
                raise _no_reading(device, status)
            error = mostly_garbage(device, found)
            try:
                if "t" in found.values and error is None:
                    arrived_s = np.asarray(found.arrived_ns * 1e-9, np.float64)
                    check_unit(arrived_s, found.values["t"], device)
            except InputError as wrong_unit:
                error = wrong_unit
            if error is not None:
                raise GarbageError(error.what, where=error.where, todo=error.todo)
        self._first = [[] for _ in self._devices]

    def _report(self) -> Status:
        seconds = (time.monotonic_ns() - self._start_ns) * 1e-9
        rates = {status.name: status.rate_hz for status in self._status}
        publish("status", seconds=seconds, rates_hz=rates)
        return Status(seconds, self._log.bytes, tuple(map(copy.copy, self._status)))


def _no_reading(device: DeviceDescription, status: DeviceStatus) -> GarbageError:
    shown = f", like {status.sample[:40]!r}" if status.sample else ""
    return GarbageError(
        f"{status.byte_count} bytes came in {GARBAGE_S:g} s, but not one reading{shown}",
        where=f"devices.{device.name} port {device.port}",
        todo=f"set baud in rig.toml to the device's baud rate (now {device.baud}); "
        f"if the bytes look right, correct its protocol (now {device.protocol})",
    )
