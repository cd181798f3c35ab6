"""The protocols of serial devices: one parser each, which takes its bytes in any pieces."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol as Interface

import numpy as np

from telerig.arrays import Array, Ints
from telerig.io.rig_file.description import DeviceDescription, Kind

LONGEST_LINE = 4096
"""More bytes than this without an end of line are malformed."""

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
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
    """values : (N,) each, by the name of the group. arrived_ns : (N,) of each reading's last byte.

    malformed : arrival (ns) of each line or run of bytes that is no reading.
    malformed_bytes : number of bytes in these. samples : the first of them, for messages.
    """

    arrived_ns: Ints
    values: dict[str, Array]
    malformed: Ints
    malformed_bytes: int = 0
    samples: tuple[bytes, ...] = ()


class Parser(Interface):
    """Keeps an incomplete reading until the rest of it arrives."""

    def feed(self, chunks: Sequence[tuple[int, bytes]]) -> Readings:
        """The readings whose last byte is in these (arrival_ns, bytes)."""

    def cut(self) -> int:
        """Drop the incomplete reading, as at the start of a connection; number of bytes dropped."""


def parser(device: DeviceDescription) -> Parser:
    """The parser of a device, at the start of a connection."""
    if device.protocol == "packets":
        return PacketParser(PACKETS[device.kind])
    return LineParser(line_pattern(device), xor=device.checksum == "xor")


def poll_command(device: DeviceDescription) -> bytes | None:
    """The bytes that poll the device for one reading; None for a stream."""
    known = {"zaber": b"/1 get pos\n", "grbl": b"?"}
    own = device.poll.encode() if device.poll else None
    return known.get(device.protocol, own)


def line_pattern(device: DeviceDescription) -> str:
    """The regular expression that one whole line, without its end, must match."""
    if device.protocol == "regex":
        return device.pattern or ""
    if device.protocol == "zaber":
        return _ZABER
    if device.protocol == "grbl":
        before = _GRBL_AXES[device.axis]
        return rf"<\w+(?::\d)?\|(?:[^|>]*\|)*?MPos:{before}(?P<position_mm>{_NUMBER})[^>]*>"
    return _STREAMS[device.kind]


def xor_checksum(line: bytes) -> bytes:
    """`*hh`, the exclusive or of all bytes of a line in hexadecimal (NMEA 0183)."""
    total = 0
    for byte in line:
        total ^= byte
    return b"*%02X" % total


class _Joined:
    """Joins received pieces; incomplete readings stay in `_tail`."""

    def __init__(self) -> None:
        self._tail = b""
        self._begun = False

    def _join(self, chunks: Sequence[tuple[int, bytes]]) -> tuple[bytes, Ints, Ints]:
        """The bytes to parse; where each piece ends in them, and when it arrived (ns)."""
        data = self._tail + b"".join(piece for _, piece in chunks)
        ends = np.cumsum([len(self._tail), *(len(piece) for _, piece in chunks)])[1:]
        return data, ends, np.array([stamp for stamp, _ in chunks], np.int64)

    def cut(self) -> int:
        dropped, self._tail, self._begun = len(self._tail), b"", False
        return dropped


class LineParser(_Joined):
    """Lines that end in LF or CR LF, each of which must match an expression as a whole."""

    def __init__(self, pattern: str, *, xor: bool = False) -> None:
        super().__init__()
        expression = re.compile(pattern.encode())
        self._match, self._groups = expression.fullmatch, list(expression.groupindex)
        self._xor = xor

    def feed(self, chunks: Sequence[tuple[int, bytes]]) -> Readings:
        data, ends, stamps = self._join(chunks)
        lines = data.split(b"\n")
        self._tail = lines.pop()
        if len(self._tail) > LONGEST_LINE:
            lines.append(self._tail)
            self._tail = b""
        if not lines:
            return self._readings([], np.zeros(0, np.int64), [])
        last = np.cumsum([len(line) + 1 for line in lines]) - 1
        arrived = _arrival(last, ends, stamps)
        if not self._begun:
            self._begun, lines, arrived = True, *self._first(lines, arrived)
        return self._readings(lines, arrived, [self._found(line) for line in lines])

    def _first(self, lines: list[bytes], arrived: Ints) -> tuple[list[bytes], Ints]:
        """Without the first line, if the connection began in the middle of it."""
        return (lines, arrived) if self._found(lines[0]) else (lines[1:], arrived[1:])

    def _found(self, line: bytes) -> re.Match[bytes] | None:
        line = line.rstrip(b"\r")
        if self._xor:
            line, check = line[:-3], line[-3:]
            if check != xor_checksum(line):
                return None
        return self._match(line)

    def _readings(
        self, lines: list[bytes], arrived: Ints, found: list[re.Match[bytes] | None]
    ) -> Readings:
        good = np.array([m is not None for m in found], bool)
        cells = [m.group(*self._groups, 0) for m in found if m]
        columns = list(zip(*cells)) or [()] * len(self._groups)
        bad = [line for line, m in zip(lines, found) if m is None and line.strip(b"\r")]
        empty = np.array([not line.strip(b"\r") for line in lines], bool)
        return Readings(
            arrived[good],
            {name: _numbers(column) for name, column in zip(self._groups, columns)},
            arrived[~good & ~empty],
            sum(map(len, bad)),
            tuple(bad[:3]),
        )


def _numbers(cells: Sequence[bytes | None]) -> Array:
    """(N,) numbers; NaN for an empty group, and for text that a user's own expression matches."""
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
    """Binary packets: `SYNC`, fields, sum of bytes; found again after any malformed bytes."""

    def __init__(self, fields: list[tuple[str, str]]) -> None:
        super().__init__()
        self._type = np.dtype([("sync", "S2"), *fields, ("sum", "u1")])

    def feed(self, chunks: Sequence[tuple[int, bytes]]) -> Readings:
        data, ends, stamps = self._join(chunks)
        size = self._type.itemsize
        starts = self._packets(data)
        done = max(int(starts[-1]) + size if starts.size else 0, len(data) - size + 1)
        done = min(done, len(data))
        self._tail = data[done:]
        rows = np.frombuffer(data, np.uint8)[starts[:, None] + np.arange(size)]
        table = np.ascontiguousarray(rows).view(self._type)[:, 0]
        names = [n for n in self._type.names or () if n not in ("sync", "sum")]
        gaps = _between(starts, size, done)
        if gaps and gaps[0][0] == 0 and not self._begun:
            gaps = gaps[1:]
        self._begun = self._begun or bool(starts.size)
        return Readings(
            _arrival(starts + size - 1, ends, stamps),
            {name: table[name].astype(float) for name in names},
            _arrival(np.array([b - 1 for _, b in gaps], np.int64), ends, stamps),
            sum(b - a for a, b in gaps),
            tuple(data[a:b] for a, b in gaps[:3]),
        )

    def _packets(self, data: bytes) -> Ints:
        """Where valid packets start; of overlapping ones the first."""
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


def _between(starts: Ints, size: int, done: int) -> list[tuple[int, int]]:
    """The (begin, end) of the bytes before ``done`` that belong to no packet."""
    begin, end = [0, *(starts + size).tolist()], [*starts.tolist(), done]
    return [(a, b) for a, b in zip(begin, end) if b > a]


def _arrival(position: Ints, ends: Ints, stamps: Ints) -> Ints:
    if not len(stamps) or not len(position):
        return np.zeros(0, np.int64)
    return stamps[np.minimum(np.searchsorted(ends, position, "right"), len(stamps) - 1)]
