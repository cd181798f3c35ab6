"""Large CSV tables whose rows are in the order of frames, read some frames at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from telerig.arrays import Ints

if TYPE_CHECKING:
    import pandas as pd

LARGE_BYTES = 64 << 20
"""Smaller tables are read into memory as a whole."""
_BLOCK_BYTES = 1 << 20

Read = Callable[[bytes, int], "pd.DataFrame | None"]
"""Return the table of a CSV text that begins with the header, from the number of the row in the
file that follows it; None where the text is unusual."""


@dataclass(frozen=True)
class FrameTable:
    """A large CSV table, sorted by frame, which stays on disk and is read part by part.

    read : function that returns the table of a part of the file.
    header : first line of the file.
    offset : (B + 1,) bytes at which each of B blocks of rows begins, and the end of the last one.
    first, last, row : (B,) first and last frame of each block, and the number of its first row.
    rows : number of rows.
    particles : the different values in the column ``particle``, as text.
    stop : only frames before this one belong to the table; None for all.
    """

    file: Path
    read: Read
    header: bytes
    offset: Ints
    first: Ints
    last: Ints
    row: Ints
    rows: int
    particles: frozenset[str]
    stop: int | None = None

    @classmethod
    def of(cls, file: Path, read: Read, see: Callable[[pd.DataFrame], None]) -> FrameTable | None:
        """Return a table that reads the rows of single frames from a CSV file when they are needed.

        Returns None for a file that is to be read as a whole: one below `LARGE_BYTES`, one that
        ``read`` cannot read in parts, and one whose rows are not in the order of the frames.

        read : takes the bytes of a part with the header, and the number of its first row.
        see : called with each part of the table, in order.
        """
        if not file.is_file() or file.stat().st_size < LARGE_BYTES:
            return None
        offsets, firsts, lasts, rows = (list[int]() for _ in range(4))
        number = 2
        particles: set[str] = set()
        with file.open("rb") as stream:
            header = stream.readline()
            while True:
                offsets.append(stream.tell())
                block = stream.read(_BLOCK_BYTES) + stream.readline()
                if not block:
                    break
                table = read(header + block, number)
                if table is None or not len(table):
                    return None
                frame = table["frame"].to_numpy()
                if np.any(frame[1:] < frame[:-1]) or (lasts and frame[0] < lasts[-1]):
                    return None
                see(table)
                if "particle" in table:
                    particles |= set(table["particle"].unique().astype(str))
                firsts.append(int(frame[0]))
                lasts.append(int(frame[-1]))
                rows.append(number)
                number += len(table)
        blocks = [np.array(values, np.int64) for values in (offsets, firsts, lasts, rows)]
        return cls(
            file, read, header, blocks[0], blocks[1], blocks[2], blocks[3], number - 2,
            frozenset(particles),
        )  # fmt: skip

    @property
    def columns(self) -> list[str]:
        """Names of the columns in the file."""
        return self.header.decode("utf-8-sig").strip().split(",")

    def before(self, frame: int) -> FrameTable:
        """Return the table of the frames before this one."""
        return replace(self, stop=frame)

    def between(self, first: int, end: int) -> pd.DataFrame:
        """Return the rows in the frames from ``first`` to before ``end``."""
        import pandas as pd

        end = end if self.stop is None else min(end, self.stop)
        mine = np.flatnonzero((self.first < end) & (self.last >= first))
        mine = mine if len(mine) else np.zeros(1, np.int64)
        parts = []
        with self.file.open("rb") as stream:
            for block in mine.tolist():
                stream.seek(int(self.offset[block]))
                text = stream.read(int(self.offset[block + 1] - self.offset[block]))
                table = self.read(self.header + text, int(self.row[block]))
                assert table is not None, "it was read before"
                parts.append(table[(table["frame"] >= first) & (table["frame"] < end)])
        return pd.concat(parts) if len(parts) > 1 else parts[0]

    def parts(self, frames: int = 2000) -> Iterator[pd.DataFrame]:
        """Yield the table in parts of ``frames`` frames, in their order."""
        stop = int(self.last[-1]) + 1
        for first in range(0, stop if self.stop is None else min(stop, self.stop), frames):
            yield self.between(first, first + frames)
