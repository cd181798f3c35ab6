"""The protocols of serial devices: one parser each, which takes its bytes in any pieces."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol as Interface

import numpy as np

from telerig.arrays import Array, Bools, Ints
from telerig.io.rig_file.description import DeviceDescription, Kind
from telerig.io.rig_file.devices import LinePattern

LONGEST_LINE = 4096
"""More bytes than this without an end of line are malformed."""

_TEXT = bytes(range(32, 127)) + b"\t\r"
_NUMBER = r"[+-]?+(?:\d++\.?+\d*+|\.\d++)(?:[eE][+-]?+\d++)?+"
"""Possessive: what has matched is not tried again, so that a long run of digits costs no time."""
_STREAMS: dict[Kind, str] = {
    "encoder": r"(?P<t>\d+),(?P<counts>[+-]?\d+)(?:,\w*)?",
    "accelerometer": rf"(?P<t>\d+),(?P<ax>{_NUMBER}),(?P<ay>{_NUMBER}),(?P<az>{_NUMBER})",
    "frames": r"(?P<t>\d+),(?P<frame>\d+)",
}
_ZABER = r"@\d\d \d(?: \d\d)? OK (?:IDLE|BUSY) \S\S (?P<counts>-?\d+)(?::[0-9A-F]{2})?"
_GRBL_AXES = {axis: rf"(?:{_NUMBER},){{{i}}}" for i, axis in enumerate("xyz")}

SYNC = b"\xa5\x5a"
"""Start of a binary packet; then, little-endian, u32 stamp, the values, and the sum of all bytes
before modulo 256."""
PACKETS: dict[Kind, list[tuple[str, str]]] = {
    "encoder": [("t", "<u4"), ("counts", "<i4")],
    "accelerometer": [("t", "<u4"), ("ax", "<i2"), ("ay", "<i2"), ("az", "<i2")],
}


@dataclass(frozen=True)
class Readings:
    """Hold the N readings in some bytes of a serial line, and the bytes that are no reading.

    arrived_ns : (N,) the host's time at which the last byte of each reading arrived.
    values : the numbers (N,) of the readings, by the name of the quantity.
    spans : (N, 2) first byte and number of bytes of each reading, counted over all bytes of the
        line.
    malformed, malformed_spans : (M,), (M, 2) time of arrival in ns, and first byte and number of
        bytes, of each stretch of bytes that is no reading.
    garbage : (M,) False for text that the device may send between its readings.
    samples : the first malformed bytes, for messages.
    """

    arrived_ns: Ints
    values: dict[str, Array]
    spans: Ints
    malformed: Ints
    malformed_spans: Ints
    garbage: Bools
    samples: tuple[bytes, ...] = ()

    @property
    def malformed_bytes(self) -> int:
        """Number of bytes that belong to no reading."""
        return int(self.malformed_spans[:, 1].sum())


def joined(parts: Sequence[Readings]) -> Readings:
    """Join the readings of successive parts of a line, at least one part."""
    return Readings(
        np.concatenate([p.arrived_ns for p in parts]),
        {name: np.concatenate([p.values[name] for p in parts]) for name in parts[0].values},
        np.concatenate([p.spans for p in parts]),
        np.concatenate([p.malformed for p in parts]),
        np.concatenate([p.malformed_spans for p in parts]),
        np.concatenate([p.garbage for p in parts]),
        tuple(sample for p in parts for sample in p.samples),
    )


class Parser(Interface):
    """Keeps an incomplete reading until the rest of it arrives."""

    def feed(self, chunks: Sequence[tuple[int, bytes]]) -> Readings:
        """Take the next bytes of the line, and return the readings that end in them.

        chunks : (time of arrival in ns, bytes) of each piece.
        """

    def cut(self) -> int:
        """Drop the incomplete reading, as is necessary at the start of a connection.

        Returns the number of bytes that were dropped.
        """


def parser(device: DeviceDescription) -> Parser:
    """Return the parser of a device, at the start of a connection."""
    if device.protocol == "packets":
        return PacketParser(PACKETS[device.kind])
    return LineParser(device)


def poll_command(device: DeviceDescription) -> bytes | None:
    """Return the bytes that poll the device for one reading; None for a stream."""
    known = {"zaber": b"/1 get pos\n", "grbl": b"?"}
    own = device.poll.encode() if device.poll else None
    return known.get(device.protocol, own)


def line_pattern(device: DeviceDescription) -> str:
    """Return the regular expression of a known protocol's whole lines without their ends."""
    if device.protocol == "zaber":
        return _ZABER
    if device.protocol == "grbl":
        before = _GRBL_AXES[device.axis]
        return rf"<\w+(?::\d)?\|(?:[^|>]*\|)*?MPos:{before}(?P<position_mm>{_NUMBER})[^>]*>"
    return _STREAMS[device.kind]


def xor_checksum(line: bytes) -> bytes:
    """Return `*hh`, the exclusive or of all bytes of a line in hexadecimal (NMEA 0183)."""
    total = 0
    for byte in line:
        total ^= byte
    return b"*%02X" % total


class _Joined:
    """Joins received pieces; incomplete readings stay in `_tail`, which begins at byte `_begin`."""

    def __init__(self) -> None:
        self._tail = b""
        self._begin = 0
        self._begun = False

    def _join(self, chunks: Sequence[tuple[int, bytes]]) -> tuple[bytes, Ints, Ints]:
        """Return the bytes to parse, where each piece ends in them, and when it arrived (ns)."""
        data = self._tail + b"".join(piece for _, piece in chunks)
        ends = np.cumsum([len(self._tail), *(len(piece) for _, piece in chunks)])[1:]
        return data, ends, np.array([stamp for stamp, _ in chunks], np.int64)

    def _keep(self, tail: bytes, parsed: int) -> int:
        """Keep the tail of bytes of which ``parsed`` are done; the place of the first of them."""
        begin, self._begin, self._tail = self._begin, self._begin + parsed, tail
        return begin

    def cut(self) -> int:
        dropped = len(self._tail)
        self._keep(b"", dropped)
        self._begun = False
        return dropped


class LineParser(_Joined):
    """Parser of lines that end in LF or CR LF; each line must match a regular expression."""

    def __init__(self, device: DeviceDescription) -> None:
        super().__init__()
        self._xor = device.checksum == "xor"
        self._only_readings = device.protocol == "stream"
        self._cells: Callable[[bytes], tuple[bytes | None, ...] | None]
        if device.protocol == "regex":
            own = LinePattern(device.pattern or "")
            self._cells, self._groups = own.cells, list(own.names)
        else:
            known = re.compile(line_pattern(device).encode())
            self._groups = list(known.groupindex)
            self._cells = partial(_cells, known, self._groups)

    def feed(self, chunks: Sequence[tuple[int, bytes]]) -> Readings:
        data, ends, stamps = self._join(chunks)
        lines = data.split(b"\n")
        tail = lines.pop()
        if len(tail) > LONGEST_LINE:
            lines.append(tail)
            tail = b""
        begin = self._keep(tail, len(data) - len(tail))
        length = np.array([len(line) for line in lines], np.int64)
        start = np.cumsum(length + 1) - length - 1
        found = [self._found(line) for line in lines]
        good = np.array([cells is not None for cells in found], bool)
        bad = np.array([bool(line.strip(b"\r")) for line in lines], bool) & ~good
        if lines and not self._begun:
            self._begun, bad[0] = True, False  # the connection may have begun within this line
        arrived = _arrival(np.minimum(start + length, len(data) - 1), ends, stamps)
        spans = np.column_stack([begin + start, length])
        columns = list(zip(*(c for c in found if c is not None))) or [()] * len(self._groups)
        return Readings(
            arrived[good],
            {name: _numbers(column) for name, column in zip(self._groups, columns)},
            spans[good],
            arrived[bad],
            spans[bad],
            np.array([self._garbage(lines[i]) for i in np.flatnonzero(bad)], bool),
            tuple(lines[i] for i in np.flatnonzero(bad)[:3]),
        )

    def _garbage(self, line: bytes) -> bool:
        """Whether a malformed line cannot be text of another kind that the device sends."""
        return self._only_readings or bool(line.translate(None, _TEXT))

    def _found(self, line: bytes) -> tuple[bytes | None, ...] | None:
        line = line.rstrip(b"\r")
        if self._xor:
            line, check = line[:-3], line[-3:]
            if check != xor_checksum(line):
                return None
        return self._cells(line)


def _cells(
    expression: re.Pattern[bytes], groups: list[str], line: bytes
) -> tuple[bytes | None, ...] | None:
    found = expression.fullmatch(line)
    return found.group(*groups, 0)[:-1] if found else None


def _numbers(cells: Sequence[bytes | None]) -> Array:
    """Return (N,) numbers; NaN for an empty group, and for text in a user's expression."""
    try:
        return np.array(list(map(float, cells)))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return np.array([_number(cell) for cell in cells])


def _number(cell: bytes | None) -> float:
    try:
        return float(cell or b"nan")
    except ValueError:
        return float("nan")


class PacketParser(_Joined):
    """Parser of binary packets, which consist of `SYNC`, the fields, and the sum of all bytes.

    After malformed bytes it continues at the next packet.
    """

    def __init__(self, fields: list[tuple[str, str]]) -> None:
        super().__init__()
        self._type = np.dtype([("sync", "S2"), *fields, ("sum", "u1")])

    def feed(self, chunks: Sequence[tuple[int, bytes]]) -> Readings:
        data, ends, stamps = self._join(chunks)
        size = self._type.itemsize
        starts = self._packets(data)
        done = max(int(starts[-1]) + size if starts.size else 0, len(data) - size + 1)
        done = min(done, len(data))
        begin = self._keep(data[done:], done)
        rows = np.frombuffer(data, np.uint8)[starts[:, None] + np.arange(size)]
        table = np.ascontiguousarray(rows).view(self._type)[:, 0]
        names = [n for n in self._type.names or () if n not in ("sync", "sum")]
        gaps = _between(starts, size, done)
        if len(gaps) and gaps[0, 0] == 0 and not self._begun:
            gaps = gaps[1:]
        self._begun = self._begun or bool(starts.size)
        return Readings(
            _arrival(starts + size - 1, ends, stamps),
            {name: table[name].astype(float) for name in names},
            np.column_stack([begin + starts, np.full(len(starts), size)]),
            _arrival(gaps.sum(axis=1) - 1, ends, stamps),
            gaps + np.array([begin, 0]),
            np.ones(len(gaps), bool),
            tuple(data[a : a + n] for a, n in gaps[:3].tolist()),
        )

    def _packets(self, data: bytes) -> Ints:
        """Return where valid packets start; of overlapping ones the first."""
        size, raw = self._type.itemsize, np.frombuffer(data, np.uint8)
        if len(raw) < size:
            return np.zeros(0, np.int64)
        begin = raw[: len(raw) - size + 1]
        where = np.flatnonzero((begin == SYNC[0]) & (raw[1 : len(begin) + 1] == SYNC[1]))
        total = np.concatenate([[0], np.cumsum(raw, dtype=np.int64)])
        last = where + size - 1
        where = where[(total[last] - total[where]) % 256 == raw[last]]
        kept, free = [], 0
        for start in where.tolist():
            if start >= free:
                kept.append(start)
                free = start + size
        return np.array(kept, np.int64)


def _between(starts: Ints, size: int, done: int) -> Ints:
    """Return (gaps, 2) begin and length of the bytes before ``done`` that belong to no packet."""
    begin, end = np.append(0, starts + size), np.append(starts, done)
    return np.column_stack([begin, end - begin])[end > begin].astype(np.int64)


def _arrival(position: Ints, ends: Ints, stamps: Ints) -> Ints:
    if not len(stamps) or not len(position):
        return np.zeros(0, np.int64)
    return stamps[np.minimum(np.searchsorted(ends, position, "right"), len(stamps) - 1)]
