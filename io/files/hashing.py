"""Compute the SHA-256 hash of a file, once for each state of the file."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

_CHUNK = 1 << 20


@dataclass(frozen=True)
class Hashed:
    """Hold the hash of a file in hexadecimal digits, and its size in bytes.

    rows : the number of lines below the first one, for a CSV table; None for other files.
    """

    sha256: str
    bytes: int
    rows: int | None


def hashed(file: Path) -> Hashed:
    """Read a file and return its hash.

    A file whose inode, size and times are those of an earlier call is not read again. Raises
    OSError when the file cannot be read.
    """
    stat = file.stat()
    return _hashed(file.absolute(), stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns)


@lru_cache(maxsize=4096)
def _hashed(file: Path, *_: int) -> Hashed:
    content, size, lines, last = hashlib.sha256(), 0, 0, b"\n"
    table = file.suffix == ".csv"
    with file.open("rb") as stream:
        while chunk := stream.read(_CHUNK):
            content.update(chunk)
            size, last = size + len(chunk), chunk[-1:]
            lines += chunk.count(b"\n") if table else 0
    lines += last != b"\n"
    return Hashed(content.hexdigest(), size, max(lines - 1, 0) if table else None)


def hash_if_there(file: Path) -> str | None:
    """Return the SHA-256 hash of a file; None when there is no such file."""
    return hashed(file).sha256 if file.is_file() else None
