"""Random access to the files of high-speed cameras: Phantom .cine, Photron .mraw with .cihx, .cih.

Written from the makers' descriptions of the formats. Pixels are returned as the sensor gave them:
no flip for display, no gamma, no white balance.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Ints
from telerig.errors import InputError
from telerig.io.files.text import read_bytes
from telerig.io.images.read import Image, damaged, refuse_too_large

HIGH_SPEED_EXTENSIONS = (".cine", ".mraw")

_MOST_HEADER_BYTES = 20_000_000
_MOST_FRAMES = 2**31
_TODO = "save it with 8, 12 or 16 bits of grey per pixel in the camera's software"


@dataclass(frozen=True)
class HighSpeedFrames:
    """Give access to the frames of a high-speed camera's file.

    bits : per pixel in the file: 8, 10 (packed), 12 (packed) or 16.
    bottom_up : whether the last row comes first.
    offsets : (frames,) byte at which each frame's pixels begin.
    first : number of the first frame, counted from the trigger.
    t_s : (frames,) times in s, from 0.
    cut_short : whether the file ends within its last frame.
    """

    path: Path
    width: int
    height: int
    bits: int
    bottom_up: bool
    offsets: Ints
    first: int
    t_s: Array
    cut_short: bool = False

    def __len__(self) -> int:
        return len(self.offsets)

    def where(self, position: int) -> str:
        return f"{self.path} (frame {position}, from 0)"

    def numbers(self) -> Ints | None:
        return self.first + np.arange(len(self), dtype=np.int64)

    def read(self, position: int) -> Image:
        """Read the frame at ``position`` (from 0); pixels (height, width), uint8 or uint16."""
        size = -(-self.width * self.height * self.bits // 8)
        with self.path.open("rb") as file:
            file.seek(int(self.offsets[position]))
            data = file.read(size)
        if len(data) < size:
            raise damaged(Path(self.where(position)), "the file ends within this frame")
        pixels: NDArray[Any] = _unpacked(np.frombuffer(data, np.uint8), self.bits)
        frame = pixels[: self.width * self.height].reshape(self.height, self.width)
        return np.ascontiguousarray(frame[::-1] if self.bottom_up else frame)


def _unpacked(data: NDArray[np.uint8], bits: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Return the pixels (N,) of packed bytes; the first bit is the highest of the first pixel."""
    if bits == 8:
        return data
    if bits == 16:
        return data.view("<u2").astype(np.uint16)
    group = {10: 5, 12: 3}[bits]
    padded = np.zeros(-(-len(data) // group) * group, np.uint64)
    padded[: len(data)] = data
    word = np.zeros(len(padded) // group, np.uint64)
    for byte in padded.reshape(-1, group).T:
        word = word << np.uint64(8) | byte
    count = 8 * group // bits
    shifts = np.arange(count - 1, -1, -1, dtype=np.uint64) * np.uint64(bits)
    pixels = word[:, None] >> shifts & np.uint64(2**bits - 1)
    return pixels.ravel().astype(np.uint16)


def open_high_speed(path: Path) -> HighSpeedFrames:
    """Open a .cine or .mraw file; InputError if it is damaged or of a kind that is not read."""
    if path.suffix.lower() == ".cine":
        return _open_cine(path)
    return _open_mraw(path)


_FILE_HEADER = struct.Struct("<2sHHHiIiIIIIII")
_BITMAP_HEADER = struct.Struct("<IiiHHI")
_RATE_AT, _MARK_AT = 768, 140
_TIMES_BLOCK = 1002


def _open_cine(path: Path) -> HighSpeedFrames:
    size = path.stat().st_size
    head = _part(path, 0, _FILE_HEADER.size)
    mark, _, compression, _, _, _, first, count, at_image, at_setup, at_offsets, *_ = (
        _FILE_HEADER.unpack(head)
    )
    if mark != b"CI":
        raise InputError("is no Phantom cine file", where=str(path), todo="check the file")
    bitmap = _BITMAP_HEADER.unpack(_part(path, at_image, _BITMAP_HEADER.size))
    _, width, height, _, bits, packing = bitmap
    bits = {0: bits, 1024: 12}.get(packing, 0) if compression == 0 else 0
    if bits not in (8, 12, 16) or (bits == 12 and packing == 0):
        kind = "10 bits with a companding curve" if packing == 256 else f"code {packing}"
        what = f"its pixels are in colour, compressed or packed in a way that is not read ({kind})"
        raise InputError(what, where=str(path), todo=_TODO)
    if width <= 0 or height == 0 or not 0 < count < _MOST_FRAMES or at_offsets + 8 * count > size:
        raise damaged(path, "its header states an impossible size or number of frames")
    refuse_too_large(width, abs(height), 2 if bits > 8 else 1, path)
    setup = _part(path, at_setup, min(_RATE_AT + 4, size - at_setup))
    if len(setup) < _RATE_AT + 4 or setup[_MARK_AT : _MARK_AT + 2] != b"ST":
        raise damaged(path, "it has no setup header")
    (length,) = struct.unpack_from("<H", setup, _MARK_AT + 2)
    (rate_hz,) = struct.unpack_from("<I", setup, _RATE_AT)
    tables = np.frombuffer(_part(path, at_offsets, 8 * count), "<i8")
    if np.any(tables < 0) or np.any(np.diff(tables) <= 0):
        raise damaged(path, "its table of frames is not in order")
    whole = tables + 8 <= size
    offsets = []
    with path.open("rb") as file:
        for at in tables[whole].tolist():
            file.seek(at)
            offsets.append(at + struct.unpack("<I", file.read(4))[0])
    if not offsets:
        raise damaged(path, "it has no frame")
    t_s = _cine_times(path, at_setup + length, at_offsets, count)
    if t_s is None:
        t_s = np.arange(count) / _rate(rate_hz, path)
    end = offsets[-1] + width * abs(height) * bits // 8
    return HighSpeedFrames(
        path, width, abs(height), bits, packing == 0 and height > 0, np.array(offsets, np.int64),
        first, t_s[: len(offsets)] - t_s[0], not np.all(whole) or end > size,
    )  # fmt: skip


def _cine_times(path: Path, begin: int, end: int, count: int) -> Array | None:
    """Return the (count,) times in s of the tagged block between two bytes; None without one."""
    data = _part(path, begin, end - begin) if 0 < end - begin < _MOST_HEADER_BYTES else b""
    at = 0
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<IH", data, at)
        if length < 8 or at + length > len(data):
            return None
        if kind == _TIMES_BLOCK and length >= 8 + 8 * count:
            pairs = np.frombuffer(data, "<u4", 2 * count, at + 8).reshape(-1, 2).astype(np.int64)
            # the two lowest bits of the fraction are flags
            fraction = (pairs[:, 0] & ~np.int64(3)) / 2.0**32
            t_s = (pairs[:, 1] - pairs[0, 1]) + fraction
            return np.asarray(t_s) if np.all(np.diff(t_s) > 0) else None
        at += length
    return None


def _open_mraw(path: Path) -> HighSpeedFrames:
    header = next(
        (
            p
            for p in (path.with_suffix(s) for s in (".cihx", ".cih", ".CIHX", ".CIH"))
            if p.is_file()
        ),
        None,
    )
    if header is None:
        todo = f"put {path.stem}.cihx (or .cih), which the camera's software writes, beside it"
        raise InputError("has no header file", where=str(path), todo=todo)
    known = _cih(header)
    width, height, bits, frames, first = (
        _whole(known, key, header) for key in ("width", "height", "bit", "frames", "first")
    )
    if "mono" not in known.get("type", "mono").lower():
        raise InputError("holds colour frames", where=str(header), todo=_TODO)
    if known.get("format", "mraw").lower() != "mraw" or bits not in (8, 10, 12, 16):
        what = f"is of the format {known.get('format', '')!r} with {bits} bits"
        raise InputError(what[:200], where=str(header), todo=_TODO)
    if width <= 0 or height <= 0 or not 0 < frames < _MOST_FRAMES:
        raise damaged(header, "it states an impossible size or number of frames")
    refuse_too_large(width, height, 2 if bits > 8 else 1, path)
    try:
        rate_hz = float(known.get("rate", ""))
    except ValueError:
        rate_hz = 0.0
    step = -(-width * height * bits // 8)
    there = path.stat().st_size / step
    count = min(frames, int(np.ceil(there)))
    if count == 0:
        raise damaged(path, "it has no frame")
    return HighSpeedFrames(
        path, width, height, bits, False, step * np.arange(count, dtype=np.int64), first,
        np.arange(count) / _rate(rate_hz, header), there < frames,
    )  # fmt: skip


_XML = {
    "width": ("imageDataInfo", "resolution", "width"),
    "height": ("imageDataInfo", "resolution", "height"),
    "bit": ("imageDataInfo", "colorInfo", "bit"),
    "type": ("imageDataInfo", "colorInfo", "type"),
    "frames": ("frameInfo", "totalFrame"),
    "first": ("frameInfo", "startFrame"),
    "rate": ("recordInfo", "recordRate"),
    "format": ("imageFileInfo", "fileFormat"),
}
_LINES = {
    "width": "Image Width", "height": "Image Height", "bit": "Color Bit", "type": "Color Type",
    "frames": "Total Frame", "first": "Start Frame", "rate": "Record Rate(fps)",
    "format": "File Format",
}  # fmt: skip


def _cih(file: Path) -> dict[str, str]:
    """Return the values of a .cih file ("key : value") or of the tags of a .cihx file."""
    if file.stat().st_size > _MOST_HEADER_BYTES:
        raise damaged(file, "it is too large for a header")
    text = read_bytes(file).decode("utf-8", errors="replace")
    if file.suffix.lower() == ".cih":
        lines = (line.partition(":") for line in text.splitlines())
        values = {key.strip(): value.strip() for key, _, value in lines}
        return {name: values[key] for name, key in _LINES.items() if key in values}
    found = {}
    for name, tags in _XML.items():
        part: str | None = text
        for tag in tags:
            begin = part.find(f"<{tag}>") if part is not None else -1
            end = part.find(f"</{tag}>", begin) if part is not None else -1
            part = part[begin + len(tag) + 2 : end] if part and 0 <= begin < end else None
        if part is not None:
            found[name] = part.strip()
    return found


def _whole(known: Mapping[str, str], key: str, file: Path) -> int:
    """Return a whole number; the number of the first frame is 0 if it is not stated."""
    text = known.get(key, "0" if key == "first" else "")
    if not re.fullmatch(r"[+-]?\d{1,10}", text):
        stated = repr(text[:50]) if text else "missing"
        raise damaged(file, f"{_LINES[key]} is {stated}, not a whole number")
    return int(text)


def _rate(rate_hz: float, file: Path) -> float:
    if not 0 < rate_hz < 1e9:
        raise damaged(file, "it states no frame rate")
    return rate_hz


def _part(path: Path, at: int, size: int) -> bytes:
    """Return ``size`` bytes of a file. Raises InputError if it ends earlier."""
    if at < 0 or size < 0:
        raise damaged(path, "its header points outside the file")
    with path.open("rb") as file:
        file.seek(at)
        data = file.read(size)
    if len(data) < size:
        raise damaged(path, "its header is cut off")
    return data
