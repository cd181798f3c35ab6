"""The raw log of a recording: every byte that a port received, with the host's time, append-only.

A file is `MAGIC`, one header of JSON, then entries: marker, kind, device, monotonic time (ns),
length, payload, CRC-32 of all of it but the marker. Damage, or a file cut off at its end, affects
only the entries that it touches.
"""

from __future__ import annotations

import errno
import json
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import BinaryIO

from telerig.errors import InputError
from telerig.io.rig_file.description import DeviceDescription

MAGIC = b"telerig recording 1\n"
MARKER = b"\xa7\x1e\xc0\x9d"
_HEAD = struct.Struct("<BBqI")
_CRC = struct.Struct("<I")
_LEAST = len(MARKER) + _HEAD.size + _CRC.size
_BLOCK = 1 << 22

RECEIVED, SENT, LOST, FOUND, END = 1, 2, 3, 4, 5
"""Kinds of entry: bytes in, bytes out, port lost, port found again, recording ended."""


@dataclass(frozen=True)
class Entry:
    """Hold one entry of the raw log.

    kind : `RECEIVED`, `SENT`, `LOST`, `FOUND` or `END`. device : index of the device in the header.
    time_ns : the host's monotonic time in ns. data : the bytes that were received or sent.
    """

    kind: int
    device: int
    time_ns: int
    data: bytes


@dataclass(frozen=True)
class LogHeader:
    """Hold the header of a raw log.

    start_ns : the host's monotonic time in ns at 0 s of the run. started : date and time then.
    cameras : the names of the cameras. devices : the devices that were recorded.
    """

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
        try:
            _make(path.parent)
            self._file: BinaryIO = path.open("xb", buffering=0)
        except FileExistsError as error:
            raise InputError(
                "exists, and a recording is never written over",
                where=str(path),
                todo="give the new run another name, or move this one away",
            ) from error
        except OSError as error:
            raise log_error(path, error) from error
        text = json.dumps(asdict(header), ensure_ascii=False).encode()
        self._waiting = [MAGIC + _CRC.pack(len(text)) + text + _CRC.pack(zlib.crc32(text))]
        self.bytes = 0
        self.flush()
        # Bring the folder's list of files to the disk: a power cut could lose the new one.
        handle = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)

    def append(self, entry: Entry) -> None:
        self._waiting.append(packed(entry))

    def flush(self) -> None:
        """Write the entries in memory and wait until they are on the disk. Raises InputError."""
        if not self._waiting:
            return
        data, self._waiting = b"".join(self._waiting), []
        try:
            written = 0
            while written < len(data):
                written += self._file.write(memoryview(data)[written:])
            os.fsync(self._file.fileno())
        except OSError as error:
            raise log_error(self.path, error) from error
        self.bytes += len(data)

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> RawLog:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise InputError(
            "is a file, and a folder is needed", where=str(folder), todo="give another name"
        ) from error


def packed(entry: Entry) -> bytes:
    """Return the bytes of one entry as they stand in the file."""
    head = _HEAD.pack(entry.kind, entry.device, entry.time_ns, len(entry.data))
    crc = zlib.crc32(entry.data, zlib.crc32(head))
    return b"".join((MARKER, head, entry.data, _CRC.pack(crc)))


def log_error(path: Path, error: OSError) -> InputError:
    """Return the error for a log that cannot be written."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return InputError(
            "the disk is full: the recording ends here",
            where=str(path),
            todo=f"make room; `telerig record --replay {path}` reads what was recorded until now",
        )
    return InputError(
        f"cannot be written: {error.strerror or error}",
        where=str(path),
        todo="choose a folder that can be written",
    )


def read_header(path: Path) -> LogHeader:
    """Read the header of a raw log. Raises InputError for a file that is no log."""
    return _open(path)[0]


def read_log(path: Path) -> Iterator[Entry]:
    """Read a raw log and yield every undamaged entry, in the order of writing.

    Raises InputError for a file that is no log. Damaged parts are skipped (see `damaged_bytes`).
    """
    header, start = _open(path)
    for piece in _pieces(path, start):
        if isinstance(piece, Entry) and piece.device < max(len(header.devices), 1):
            yield piece


def damaged_bytes(path: Path) -> int:
    """Read a raw log and return the number of bytes that belong to no undamaged entry."""
    _, start = _open(path)
    return sum(p for p in _pieces(path, start) if isinstance(p, int))


def _open(path: Path) -> tuple[LogHeader, int]:
    try:
        with path.open("rb") as stream:
            head = stream.read(len(MAGIC) + _CRC.size)
            if not head.startswith(MAGIC) or len(head) < len(MAGIC) + _CRC.size:
                raise _no_log(path, "is no recording of telerig")
            (length,) = _CRC.unpack(head[-_CRC.size :])
            text = stream.read(length)
            crc = stream.read(_CRC.size)
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}", where=str(path), todo="check the path"
        ) from error
    if len(crc) < _CRC.size or _CRC.unpack(crc)[0] != zlib.crc32(text):
        raise _no_log(path, "has a damaged header, so its devices are not known")
    try:
        raw = json.loads(text)
        devices = tuple(DeviceDescription(**d) for d in raw["devices"])
        devices = tuple(replace(d, cameras=tuple(d.cameras)) for d in devices)
        header = LogHeader(raw["start_ns"], raw["started"], tuple(raw["cameras"]), devices)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"has a header that this version of telerig does not know ({error})",
            where=str(path),
            todo="replay it with the version of telerig that recorded it, or a newer one",
        ) from error
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
    """Return the entry at ``at``, or the length of a damaged part, and where the next piece begins.

    Returns None when more data are needed, and at the end of the data.
    """
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
