"""The raw log of a recording: every byte that a port received, with the host's time, append-only.

A file is `MAGIC`, one header of JSON, then entries: marker, kind, device, monotonic time (ns),
length, payload, CRC-32 of all of it but the marker. Damage, or a file cut off at its end, affects
only the entries that it touches.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from pydantic import TypeAdapter, ValidationError

from telerig.arrays import Ints
from telerig.errors import InputError
from telerig.io.files.atomic import make_parent, unwritable
from telerig.io.files.names import check_name
from telerig.io.rig_file.description import DeviceDescription

MAGIC = b"telerig recording 1\n"
MARKER = b"\xa7\x1e\xc0\x9d"
_HEAD = struct.Struct("<BBqI")
_CRC = struct.Struct("<I")
_LEAST = len(MARKER) + _HEAD.size + _CRC.size
_BLOCK = 1 << 22
_EARLIEST_NS = 60 * 10**9
"""An entry that is older than the recording by more than this time in ns is of another one."""

RECEIVED, SENT, LOST, FOUND, END = 1, 2, 3, 4, 5
"""Kinds of entry: bytes in, bytes out, port lost, port found again, recording ended."""


@dataclass(frozen=True)
class Entry:
    """Hold one entry of the raw log.

    kind : see the kinds above.
    device : index of the device in the header.
    time_ns : the host's monotonic time.
    data : the bytes.
    """

    kind: int
    device: int
    time_ns: int
    data: bytes


@dataclass(frozen=True)
class LogHeader:
    """Hold the header of a raw log; start_ns : the host's monotonic time at 0 s of the run."""

    start_ns: int
    started: str
    cameras: tuple[str, ...]
    devices: tuple[DeviceDescription, ...]


class RawLog:
    """Write a raw log; `append` keeps entries in memory, `flush` writes them to the disk.

    Raises InputError when the file exists already or cannot be written.
    """

    def __init__(self, path: Path, header: LogHeader) -> None:
        self.path = path
        text = json.dumps(asdict(header), ensure_ascii=False).encode()
        head = MAGIC + _CRC.pack(len(text)) + text + _CRC.pack(zlib.crc32(text))
        self._waiting: list[bytes] = []
        self.bytes = 0
        make_parent(path)
        try:
            self._file: BinaryIO = path.open("x+b", buffering=0)
        except FileExistsError as error:
            raise recorded_already(path) from error
        except OSError as error:
            raise log_error(path, error, recorded=False) from error
        try:
            self._write(head)
            _sync_folder(path.parent)
        except OSError as error:
            self._file.close()
            path.unlink(missing_ok=True)
            raise log_error(path, error, recorded=False) from error

    def append(self, entry: Entry) -> None:
        """Add an entry, which `flush` writes to the disk."""
        self._waiting.append(packed(entry))

    def flush(self) -> None:
        """Write the entries in memory and wait until they are on the disk.

        Raises InputError when they cannot be written, or when somebody has deleted the file, which
        is then made again with everything that was recorded.
        """
        if not self._waiting:
            return
        data, self._waiting = b"".join(self._waiting), []
        try:
            self._write(data)
            deleted = os.fstat(self._file.fileno()).st_nlink == 0
        except OSError as error:
            raise log_error(self.path, error) from error
        if deleted:
            self._write_again()
            raise InputError(
                "was deleted while it was being recorded, so the recording ends here",
                where=str(self.path),
                todo="everything that was recorded until now has been written to a new log; "
                "`telerig record --replay "
                f"{self.path}` makes the tables",
            )

    def _write(self, data: bytes) -> None:
        written = 0
        while written < len(data):
            written += self._file.write(memoryview(data)[written:])
        os.fsync(self._file.fileno())
        self.bytes += len(data)

    def _write_again(self) -> None:
        """Write the content of the deleted file, which its handle still holds, to its old place."""
        self._file.seek(0)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("xb") as copy:
                shutil.copyfileobj(self._file, copy)
                copy.flush()
                os.fsync(copy.fileno())
        except OSError as error:
            raise log_error(self.path, error) from error

    def close(self) -> None:
        """Close the file; what was appended since the last `flush` is lost."""
        self._file.close()

    def __enter__(self) -> RawLog:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _sync_folder(folder: Path) -> None:
    """Bring the folder's list of files to the disk: a power cut could lose the new one."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def packed(entry: Entry) -> bytes:
    """Return the bytes of one entry as they stand in the file."""
    head = _HEAD.pack(entry.kind, entry.device, entry.time_ns, len(entry.data))
    crc = zlib.crc32(entry.data, zlib.crc32(head))
    return b"".join((MARKER, head, entry.data, _CRC.pack(crc)))


def recorded_already(file: Path) -> InputError:
    """Return the error for a file that a recording would replace."""
    return InputError(
        "exists, and a recording is never written over",
        where=str(file),
        todo="give the new run another name, or move this one away",
    )


def log_error(path: Path, error: OSError, *, recorded: bool = True) -> InputError:
    """Return the error for a log that cannot be written.

    recorded : whether a part of the recording has been written already.
    """
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return InputError(
            "the disk is full: " + ("the recording ends here" if recorded else "nothing recorded"),
            where=str(path),
            todo=f"make room; `telerig record --replay {path}` reads what was recorded until now"
            if recorded
            else "make room, then run again",
        )
    return unwritable(path, error)


@dataclass(frozen=True)
class LogScan:
    """Hold what a first look at a raw log has found.

    damaged_bytes : number of bytes that belong to no undamaged entry of this recording. ordered :
        whether each device's entries are in the order of time.
    end_ns : time of the closing entry, or None.
    """

    header: LogHeader
    damaged_bytes: int
    ordered: bool
    end_ns: int | None


def scan_log(path: Path) -> LogScan:
    """Read a raw log to see what is damaged in it. Raises InputError for another file."""
    header, start = _open(path)
    damaged, ordered, end_ns = 0, True, None
    latest: dict[tuple[int, int], int] = {}
    late: list[tuple[int, int]] = []
    for piece in _pieces(path, start):
        if isinstance(piece, int) or not _belongs(piece, header):
            damaged += piece if isinstance(piece, int) else len(packed(piece))
            continue
        if piece.kind == END:
            end_ns = min(piece.time_ns, end_ns or piece.time_ns)
            continue
        key = (piece.device, piece.kind)
        ordered = ordered and end_ns is None and piece.time_ns > latest.get(key, -(1 << 63))
        latest[key] = piece.time_ns
        if end_ns is not None:
            late.append((piece.time_ns, len(packed(piece))))
    damaged += sum(size for time_ns, size in late if time_ns > (end_ns or 0))
    return LogScan(header, damaged, ordered, end_ns)


def _belongs(entry: Entry, header: LogHeader) -> bool:
    """Whether an entry can be of this recording and not of another log, joined to it."""
    known = entry.kind == END or (
        RECEIVED <= entry.kind < END and entry.device < len(header.devices)
    )
    return known and entry.time_ns > header.start_ns - _EARLIEST_NS


def read_log(path: Path, scan: LogScan | None = None) -> Iterator[Entry]:
    """Read a raw log and yield every undamaged entry of the recording, in the order of time.

    A log whose parts were exchanged or doubled is put in order, for which it is held in memory.
    Raises InputError for a file that is no log.
    """
    scan = scan or scan_log(path)
    _, start = _open(path)
    found = (
        piece
        for piece in _pieces(path, start)
        if isinstance(piece, Entry) and _belongs(piece, scan.header)
    )
    if scan.ordered:
        yield from found
        return
    once = dict.fromkeys(e for e in found if scan.end_ns is None or e.time_ns <= scan.end_ns)
    yield from sorted(once, key=lambda entry: entry.time_ns)


def received_bytes(path: Path, scan: LogScan, spans: Sequence[Ints]) -> list[list[bytes]]:
    """Read some lines of each device from a raw log.

    spans : for each device (N, 2), the first byte and the number of bytes of each line, in
    increasing order. Bytes are counted over all bytes that were received from the device.
    """
    found: list[list[bytes]] = [[] for _ in spans]
    waiting = [[tuple(span) for span in np.asarray(s).tolist()][::-1] for s in spans]
    kept, begin = [b""] * len(spans), [0] * len(spans)
    for entry in read_log(path, scan):
        if entry.kind != RECEIVED or not waiting[entry.device]:
            continue
        k = entry.device
        data = kept[k] + entry.data
        while waiting[k] and sum(waiting[k][-1]) <= begin[k] + len(data):
            first, length = waiting[k].pop()
            found[k].append(data[first - begin[k] : first - begin[k] + length])
        done = min((waiting[k][-1][0] if waiting[k] else begin[k]) - begin[k], len(data))
        kept[k], begin[k] = data[done:], begin[k] + done
    return found


def _open(path: Path) -> tuple[LogHeader, int]:
    try:
        with path.open("rb") as stream:
            head = stream.read(len(MAGIC) + _CRC.size)
            if not head.startswith(MAGIC) or len(head) < len(MAGIC) + _CRC.size:
                raise _no_log(path, "is no recording of telerig")
            (length,) = _CRC.unpack(head[-_CRC.size :])
            if length > path.stat().st_size:
                raise _no_log(path, "its header is damaged")
            text = stream.read(length)
            crc = stream.read(_CRC.size)
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}", where=str(path), todo="check the path"
        ) from error
    if len(crc) < _CRC.size or _CRC.unpack(crc)[0] != zlib.crc32(text):
        raise _no_log(path, "has a damaged header, so its devices are not known")
    try:
        header = TypeAdapter(LogHeader).validate_json(text)
    except ValidationError as error:
        fault = error.errors(include_url=False, include_input=False)[0]
        what = f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}"
        raise InputError(
            f"has a header that this version of telerig does not know ({what:.200})",
            where=str(path),
            todo="replay it with the version of telerig that recorded it, or a newer one",
        ) from error
    for thing, names in (
        ("device", [device.name for device in header.devices]),
        ("camera", header.cameras),
    ):
        for name in names:
            check_name(name, str(path), thing)
    return header, len(head) + length + _CRC.size


def _no_log(path: Path, what: str) -> InputError:
    return InputError(what, where=str(path), todo="give the recording.raw of a run")


def _pieces(path: Path, start: int) -> Iterator[Entry | int]:
    """Yield the entries of a log, and the length in bytes of each damaged part between them."""
    with path.open("rb") as stream:
        stream.seek(start)
        data, at = b"", 0
        while True:
            block = stream.read(_BLOCK)
            data, at = data[at:] + block, 0
            while (found := _entry(data, at, final=not block)) is not None:
                piece, at = found
                yield piece
            if not block:
                return


def _entry(data: bytes, at: int, *, final: bool) -> tuple[Entry | int, int] | None:
    """Return the entry, or the length of a damaged part, and where the next piece begins."""
    left = len(data) - at
    if left == 0 or (left < _LEAST and not final):
        return None
    if left >= _LEAST and data.startswith(MARKER, at):
        body = at + len(MARKER)
        kind, device, time_ns, length = _HEAD.unpack_from(data, body)
        end = body + _HEAD.size + length
        if end + _CRC.size <= len(data):
            if _CRC.unpack_from(data, end)[0] == zlib.crc32(memoryview(data)[body:end]):
                payload = data[body + _HEAD.size : end]
                return Entry(kind, device, time_ns, payload), end + _CRC.size
        elif not final and length <= _BLOCK:
            return None
    following = data.find(MARKER, at + 1)
    if following < 0:
        following = len(data) if final else max(at + 1, len(data) - len(MARKER) + 1)
    return following - at, following
