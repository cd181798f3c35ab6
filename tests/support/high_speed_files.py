"""Writes the files of high-speed cameras, from the makers' descriptions of the formats."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def packed(frame: NDArray[np.generic], bits: int) -> bytes:
    """Pixels as a string of bits, the highest first, in bytes."""
    text = "".join(format(int(value), f"0{bits}b") for value in frame.ravel())
    text += "0" * (-len(text) % 8)
    return int(text, 2).to_bytes(len(text) // 8, "big")


def write_cine(
    path: Path, frames: NDArray[np.generic], t_s: NDArray[np.float64] | None = None, *,
    bits: int = 8, rate_hz: int = 1000, first: int = -2, packing: int | None = None,
) -> None:  # fmt: skip
    """A cine file of frames (F, height, width); t_s : written as the block of times."""
    count, height, width = frames.shape
    setup = bytearray(0x1700)
    setup[140:142] = b"ST"
    struct.pack_into("<H", setup, 142, len(setup))
    struct.pack_into("<I", setup, 768, rate_hz)
    blocks = struct.pack("<IHH", 16, 1003, 0) + bytes(8)
    if t_s is not None:
        times = b"".join(
            struct.pack("<II", int((t % 1.0) * 2**32) & ~3 | 1, int(t)) for t in t_s.tolist()
        )
        blocks += struct.pack("<IHH", 8 + len(times), 1002, 0) + times
    code = packing if packing is not None else 1024 if bits == 12 else 0
    at_image, at_setup = 44, 44 + 40
    at_offsets = at_setup + len(setup) + len(blocks)
    begin = at_offsets + 8 * count
    data = [
        packed(f, 12) if bits == 12 else f[::-1].astype("<u2" if bits == 16 else "u1").tobytes()
        for f in frames
    ]
    annotated = [struct.pack("<I", 16) + bytes(8) + struct.pack("<I", len(d)) + d for d in data]
    offsets = begin + np.cumsum([0, *(len(d) for d in annotated)])[:-1]
    header = struct.pack(
        "<2sHHHiIiIIIIII", b"CI", 44, 0, 1, first, count, first, count, at_image, at_setup,
        at_offsets, 0, 0,
    )  # fmt: skip
    bitmap = struct.pack("<IiiHHI", 40, width, height, 1, 16 if bits == 12 else bits, code)
    path.write_bytes(
        header + bitmap + bytes(20) + bytes(setup) + blocks
        + offsets.astype("<i8").tobytes() + b"".join(annotated)
    )  # fmt: skip


def write_mraw(
    path: Path, frames: NDArray[np.generic], *, bits: int = 12, rate_hz: float = 2000.0,
    first: int = 5, xml: bool = True,
) -> None:  # fmt: skip
    """An mraw file of frames (F, height, width) and its header beside it."""
    count, height, width = frames.shape
    path.write_bytes(b"".join(packed(f, bits) if bits in (10, 12) else f.tobytes() for f in frames))
    if xml:
        text = (
            "<cih><fileInfo><date>2026/1/1</date></fileInfo>"
            f"<frameInfo><totalFrame>{count}</totalFrame><startFrame>{first}</startFrame></frameInfo>"
            f"<recordInfo><recordRate>{rate_hz}</recordRate></recordInfo>"
            "<imageFileInfo><fileFormat>MRaw</fileFormat></imageFileInfo><imageDataInfo>"
            f"<resolution><width>{width}</width><height>{height}</height></resolution>"
            f"<colorInfo><type>Mono</type><bit>{bits}</bit></colorInfo></imageDataInfo></cih>"
        )
        path.with_suffix(".cihx").write_bytes(bytes(range(200, 256)) + text.encode() + b"\0\0")
        return
    lines = {
        "Record Rate(fps)": rate_hz, "Total Frame": count, "Start Frame": first,
        "Image Width": width, "Image Height": height, "Color Type": "Mono", "Color Bit": bits,
        "File Format": "MRaw",
    }  # fmt: skip
    text = "#Camera Information Header\n" + "".join(f"{k} : {v}\n" for k, v in lines.items())
    path.with_suffix(".cih").write_text(text)
