"""From a raw log to the readings of each device in host time, without those that are damaged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.io.files.text import LARGEST_NUMBER
from telerig.io.recording.clock import ClockFit, check_unit, host_times
from telerig.io.recording.judgement import amid_garbage, far_from_neighbours, mostly_garbage
from telerig.io.recording.log import (
    END,
    FOUND,
    LOST,
    RECEIVED,
    SENT,
    Entry,
    LogHeader,
    read_log,
    received_bytes,
    scan_log,
)
from telerig.io.recording.protocols import Readings, joined, parser
from telerig.io.recording.unstamped import spread_arrivals
from telerig.io.rig_file.description import DeviceDescription

_BLOCK_BYTES = 1 << 19
REPLAY_WITH_RIG = "run `telerig record --replay RUN --rig rig.toml`"
"""The advice for a recording whose devices were described wrongly."""
TIME_DIGITS = 7
"""Decimals of t_s in the tables: a tenth of a microsecond."""
MALFORMED = "malformed"
REGULAR_CLOCK = "arrival, by a regular clock"
_ACCELERATION_MM_S2 = 5000.0
"""A stage accelerates less, so that an encoder's reading beyond it is doubtful."""


def _none() -> Array:
    return np.zeros(0)


@dataclass(frozen=True)
class Refused:
    """Hold the R lines of a device that were refused, so that they are in no table.

    spans : (R, 2) first byte and number of bytes, counted over all bytes of the device.
    t_s : (R,) time in s, NaN if it is not known.
    arrived_s : (R,) time of arrival.
    reason : (R,) why each line was refused.
    lines : the bytes of each line.
    """

    spans: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    t_s: Array = field(default_factory=_none)
    arrived_s: Array = field(default_factory=_none)
    reason: NDArray[np.object_] = field(default_factory=lambda: np.zeros(0, np.object_))
    lines: tuple[bytes, ...] = ()


@dataclass(frozen=True)
class DeviceRecord:
    """Hold the readings of one device, in the order of time.

    t_s : (N,) times since the beginning of the recording, strictly increasing.
    arrived_s : (N,) when the host received each reading.
    values : arrays (N,) by the name of the quantity, as sent.
    malformed_s : times of arrival of bytes that are no reading.
    malformed_bytes : their number.
    samples : some of them.
    partial_bytes : number of bytes of incomplete readings.
    away_s : for each time that the device was unplugged, when it was lost and when it was found
        again (NaN for never).
    clocks : the fits of the device's clock.
    wraps : how often its counter wrapped.
    faults : number of readings that were left out, by the reason.
    refused : these readings.
    time_from : what the times are derived from.
    half_width_s : for a polled device, half the time between question and answer.
    time_sd_s : standard deviation of the times, without the unknown least delay of the line; None
        if the clock fits state it.
    error : why the readings cannot be used as described, or None.
    """

    device: DeviceDescription
    t_s: Array = field(default_factory=_none)
    arrived_s: Array = field(default_factory=_none)
    values: dict[str, Array] = field(default_factory=dict)
    malformed_s: Array = field(default_factory=_none)
    malformed_bytes: int = 0
    samples: tuple[str, ...] = ()
    partial_bytes: int = 0
    away_s: tuple[tuple[float, float], ...] = ()
    clocks: tuple[ClockFit, ...] = ()
    wraps: int = 0
    faults: dict[str, int] = field(default_factory=dict)
    time_from: str = "nothing"
    half_width_s: float = 0.0
    time_sd_s: float | None = None
    refused: Refused = field(default_factory=Refused)
    error: InputError | None = None


@dataclass(frozen=True)
class Replay:
    """The content of a raw log.

    records : the readings of each device.
    end_s : time of the last entry.
    ended : whether the recording was ended properly; False if it was cut off.
    damaged_bytes : number of bytes of the log that belong to no undamaged entry of this recording.
    """

    header: LogHeader
    records: tuple[DeviceRecord, ...]
    end_s: float
    ended: bool
    damaged_bytes: int


@dataclass
class _Line:
    """The entries of one device while the log is read; ``error`` if they cannot be parsed."""

    device: DeviceDescription
    chunks: list[tuple[int, bytes]] = field(default_factory=list)
    waiting: int = 0
    found: list[Readings] = field(default_factory=list)
    sent_ns: list[int] = field(default_factory=list)
    away_ns: list[tuple[int, int | None]] = field(default_factory=list)
    partial_bytes: int = 0
    error: InputError | None = None

    def __post_init__(self) -> None:
        try:
            self._parser = parser(self.device)
        except (ValueError, KeyError) as error:
            self.error = InputError(
                f"the protocol of the device, or the pattern of its lines, cannot be used: {error}",
                where=_place(self.device),
                todo=f"correct [devices.{self.device.name}] in rig.toml, then {REPLAY_WITH_RIG}",
            )

    def take(self, entry: Entry) -> None:
        if self.error is not None:
            return
        if entry.kind == RECEIVED:
            self.chunks.append((entry.time_ns, entry.data))
            self.waiting += len(entry.data)
            if self.waiting > _BLOCK_BYTES:
                self.parse()
        elif entry.kind == SENT:
            self.sent_ns.append(entry.time_ns)
        elif entry.kind == LOST:
            self.cut()
            self.away_ns.append((entry.time_ns, None))
        elif entry.kind == FOUND and self.away_ns and self.away_ns[-1][1] is None:
            self.away_ns[-1] = self.away_ns[-1][0], entry.time_ns

    def parse(self) -> None:
        self.found.append(self._parser.feed(self.chunks))
        self.chunks, self.waiting = [], 0

    def cut(self) -> None:
        self.parse()
        self.partial_bytes += self._parser.cut()


def replay(path: Path, devices: Mapping[str, DeviceDescription] | None = None) -> Replay:
    """Read a raw log and return the readings of all devices.

    The same log always gives exactly the same numbers. A fault of one device is stated in its
    record and does not affect the others.

    devices : descriptions by name that replace those in the log. Raises InputError for a file that
    is no log.
    """
    scan = scan_log(path)
    named = devices or {}
    header = replace(scan.header, devices=tuple(named.get(d.name, d) for d in scan.header.devices))
    lines = [_Line(device) for device in header.devices]
    end_ns, ended = header.start_ns, False
    for entry in read_log(path, scan):
        end_ns, ended = max(end_ns, entry.time_ns), ended or entry.kind == END
        if entry.kind != END:
            lines[entry.device].take(entry)
    records = [_record(line, header.start_ns) for line in lines]
    texts = received_bytes(path, scan, [record.refused.spans for record in records])
    records = [
        replace(record, refused=replace(record.refused, lines=tuple(text)))
        for record, text in zip(records, texts)
    ]
    end_s = (end_ns - header.start_ns) * 1e-9
    return Replay(header, tuple(records), end_s, ended, scan.damaged_bytes)


def _place(device: DeviceDescription) -> str:
    return f"devices.{device.name}"


def _record(line: _Line, start_ns: int) -> DeviceRecord:
    """Return the record of one device, whatever is wrong with it."""
    if line.error is not None:
        return _without_readings(line, line.error)
    line.cut()
    try:
        return _judged(line, start_ns, _times)
    except InputError as error:
        return _without_readings(line, error)
    except Exception as error:  # noqa: BLE001
        fault = InputError(
            f"its clock could not be fitted ({error!r:.200}); its times are those of arrival",
            where=_place(line.device),
            todo="this is a fault of telerig: report it with the recording.raw",
        )
    return replace(_judged(line, start_ns, _arrival_times), error=fault)


def _without_readings(line: _Line, error: InputError) -> DeviceRecord:
    found = joined(line.found) if line.found else None
    return DeviceRecord(
        line.device, malformed_bytes=found.malformed_bytes if found else 0, samples=_samples(line),
        partial_bytes=line.partial_bytes, error=error,
    )  # fmt: skip


def _samples(line: _Line) -> tuple[str, ...]:
    return tuple(repr(s[:60]) for r in line.found for s in r.samples)[:5]


@dataclass(frozen=True)
class _Timed:
    """The times of readings. t_s : (N,) NaN for a reading that is refused for the ``reason``."""

    t_s: Array
    time_from: str
    reason: str = ""
    clocks: tuple[ClockFit, ...] = ()
    wraps: int = 0
    half_width_s: float = 0.0
    sd_s: float | None = None


def _times(line: _Line, arrived_s: Array, t: Array | None, slot: Ints, start_ns: int) -> _Timed:
    """Return the times of a device's readings from its stamps ``t``, its polls, or the arrivals."""
    device = line.device
    if t is not None:
        check_unit(arrived_s, t, device)
        clock = host_times(arrived_s, t * device.time_unit_s, device.wrap_s)
        return _Timed(
            clock.t_s - device.latency_s, "device", "wrong or repeated stamp", clock.fits,
            clock.wraps,
        )  # fmt: skip
    if line.sent_ns:
        t_s, half = _between(arrived_s, _seconds(np.array(line.sent_ns), start_ns))
        reason = "which question it answers is not known"
        how = "middle of question and answer"
        return _Timed(t_s - device.latency_s, how, reason, half_width_s=half)
    return _arrival_times(line, arrived_s, None, slot, start_ns)


def _arrival_times(line: _Line, arrived_s: Array, _: Array | None, slot: Ints, __: int) -> _Timed:
    """Return the times of a device's readings from their arrivals alone."""
    spread = spread_arrivals(arrived_s, slot)
    how = REGULAR_CLOCK if spread.regular else "arrival, spread evenly"
    return _Timed(spread.t_s - line.device.latency_s, how, sd_s=spread.sd_s)


def _judged(line: _Line, start_ns: int, times: Callable[..., _Timed]) -> DeviceRecord:
    """Return the readings of a device without those that cannot be right."""
    device, found = line.device, joined(line.found)
    count = len(found.arrived_ns)
    arrived = _seconds(found.arrived_ns, start_ns)
    kept, t_s = np.arange(count), np.full(count, np.nan)
    reason = np.full(count, None, np.object_)

    def refuse(bad: Bools, why: str) -> None:
        nonlocal kept
        reason[kept[bad]] = why
        kept = kept[~bad]

    numbers = np.column_stack([*found.values.values(), np.zeros(count)])
    refuse(~np.all(np.abs(numbers) < LARGEST_NUMBER, axis=1), "not a number")
    garbage = found.malformed_spans[found.garbage]
    refuse(amid_garbage(found.spans[kept], garbage), "amid garbage")
    error = mostly_garbage(device, found)
    if error is not None and not len(kept):
        raise error
    slot = kept + np.searchsorted(found.malformed_spans[:, 0], found.spans[kept, 0])
    stamps = found.values["t"][kept] if "t" in found.values else None
    timed = times(line, arrived[kept], stamps, slot, start_ns)
    t_s[kept] = np.round(timed.t_s, TIME_DIGITS)
    refuse(np.isnan(t_s[kept]), timed.reason)
    latest = np.maximum.accumulate(np.append(-np.inf, t_s[kept][:-1]))
    refuse(t_s[kept] <= latest, "not later than the one before")
    if device.kind != "frames":
        unit = device.counts_per_mm or 1.0 if "counts" in found.values else 1.0
        most = _ACCELERATION_MM_S2 * abs(unit) if device.kind == "encoder" else 0.0
        measured = [v[kept] for name, v in found.values.items() if name != "t"]
        refuse(far_from_neighbours(t_s[kept], measured, most), "far from its neighbours")
    faults = {str(why): int(np.sum(reason == why)) for why in dict.fromkeys(reason) if why}
    if line.sent_ns and len(line.sent_ns) > count:
        faults["question without answer"] = len(line.sent_ns) - count
    malformed = _seconds(found.malformed, start_ns)
    return DeviceRecord(
        device=device,
        t_s=t_s[kept],
        arrived_s=arrived[kept],
        values={name: v[kept] for name, v in found.values.items()},
        malformed_s=malformed,
        malformed_bytes=found.malformed_bytes,
        samples=_samples(line),
        partial_bytes=line.partial_bytes,
        away_s=tuple(
            ((lost - start_ns) * 1e-9, np.nan if back is None else (back - start_ns) * 1e-9)
            for lost, back in line.away_ns
        ),
        clocks=timed.clocks,
        wraps=timed.wraps,
        faults=faults,
        time_from=timed.time_from,
        half_width_s=timed.half_width_s,
        time_sd_s=timed.sd_s,
        refused=_refused(found, reason, t_s, arrived, malformed),
        error=error,
    )


def _refused(
    found: Readings, reason: NDArray[np.object_], t_s: Array, arrived: Array, malformed: Array
) -> Refused:
    """Return the refused readings and the malformed lines, in the order of their bytes."""
    out = np.flatnonzero(reason != None)  # noqa: E711
    spans = np.concatenate([found.spans[out], found.malformed_spans])
    order = np.argsort(spans[:, 0], kind="stable")
    return Refused(
        spans[order],
        np.append(t_s[out], np.full(len(malformed), np.nan))[order],
        np.append(arrived[out], malformed)[order],
        np.append(reason[out], np.full(len(malformed), MALFORMED, np.object_))[order],
    )


def _seconds(time_ns: NDArray[np.generic], start_ns: int) -> Array:
    return np.asarray((time_ns.astype(np.int64) - start_ns) * 1e-9, np.float64)


def _between(arrived: Array, sent: Array) -> tuple[Array, float]:
    """Return mid-times (N,) of question and answer, NaN for unpaired ones; median half width."""
    asked = np.searchsorted(sent, arrived, "right") - 1
    answers = np.bincount(np.maximum(asked, 0), minlength=len(sent))
    clear = (asked >= 0) & (answers[asked] == 1) & ((asked < 1) | (answers[asked - 1] > 0))
    half = (arrived - sent[asked]) / 2
    t_s = np.where(clear, arrived - half, np.nan)
    return t_s, float(np.median(half[clear])) if clear.any() else 0.0
