"""Fingerprints of the files from which results were made, to notice that these have changed."""

from __future__ import annotations

import hashlib
import json
import os
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from telerig.io.files.hashing import hash_if_there
from telerig.io.results.record import Part

_MOST_SAMPLED = 256
_PARTS, _PART_BYTES = 16, 256


class Input(Part):
    """Hold the fingerprint of one input.

    sha256 : the hash of the file; None if there was no such file.
    tables : if only some tables of a TOML file count, their names; ``sha256`` is the hash of these
        tables alone. Empty for a whole file.
    cameras : for a folder of images, the cameras whose images count.
    files, bytes : number and total size of these images.
    sampled : hash of parts of their content.
    """

    sha256: str | None = None
    tables: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    files: int | None = None
    bytes: int | None = None
    sampled: str | None = None

    def change(self, path: Path, *, alone: bool = True) -> str:
        """Return in words how ``path`` differs from the fingerprint; "" if it does not differ.

        alone : whether the results may have been copied without their inputs, so that one that is
            no longer there does not count as changed.
        """
        if not path.exists():
            there = self.sha256 is not None or bool(self.files)
            return "is no longer there" if there and not alone else ""
        if self.sha256 is None and not self.cameras:
            return "was added after they were made"
        now = Source(path, self.tables, self.cameras).fingerprint()
        keys = ("sha256", "files", "bytes", "sampled")
        same = all(getattr(now, key) == getattr(self, key) for key in keys)
        return "" if same else "has changed since they were made"


@dataclass(frozen=True)
class Source:
    """Name an input: a file, the tables of a TOML file, or the images of cameras in a folder."""

    path: Path
    tables: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()

    def fingerprint(self) -> Input:
        """Read the input and return its fingerprint. Raises OSError when it cannot be read."""
        if self.cameras:
            files = sorted(_recorded(self.path, self.cameras))
            sizes = [file.stat().st_size for file in files]
            return Input(
                cameras=self.cameras,
                files=len(sizes),
                bytes=sum(sizes),
                sampled=_sampled_hash(self.path, files, sizes),
            )
        if self.tables and self.path.is_file():
            return Input(sha256=_hash_of_tables(self.path, self.tables), tables=self.tables)
        return Input(sha256=hash_if_there(self.path))


def fingerprints(folder: Path, sources: Iterable[Path | Source]) -> dict[str, Input]:
    """Return the fingerprint of each input by its path relative to the results folder.

    A path stands for the whole file; a file that does not exist is recorded as absent.
    Raises OSError when a file cannot be read.
    """
    found = {}
    for source in sources:
        named = Source(source) if isinstance(source, Path) else source
        found[relative(named.path, folder)] = named.fingerprint()
    return found


def relative(path: Path, folder: Path) -> str:
    """Return a path relative to a folder, or the whole path where there is no way to it."""
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:  # on another drive
        return path.resolve().as_posix()


def _recorded(folder: Path, cameras: Sequence[str]) -> Iterator[Path]:
    """Yield the images of the cameras: files in ``folder/camera``, and files ``camera.*``."""
    if not folder.is_dir():
        return
    for entry in folder.iterdir():
        if entry.name in cameras and entry.is_dir():
            yield from (p for p in entry.iterdir() if p.is_file() and p.name[0] != ".")
        elif entry.stem in cameras and entry.is_file():
            yield entry


def _sampled_hash(folder: Path, files: Sequence[Path], sizes: Sequence[int]) -> str:
    """Hash the names and sizes of all images, and evenly spaced bytes of at most 256 of them."""
    content = hashlib.sha256()
    for file, size in zip(files, sizes):
        name = file.relative_to(folder).as_posix()
        content.update(f"{name} {size}\n".encode(errors="surrogateescape"))
    step = -(-len(files) // _MOST_SAMPLED) or 1
    for file, size in zip(files[::step], sizes[::step]):
        with file.open("rb") as stream:
            if size <= _PARTS * _PART_BYTES:
                content.update(stream.read())
                continue
            for part in range(_PARTS):
                stream.seek(part * (size - _PART_BYTES) // (_PARTS - 1))
                content.update(stream.read(_PART_BYTES))
    return content.hexdigest()


def _hash_of_tables(file: Path, tables: Sequence[str]) -> str:
    """Hash the content of some tables, so that comments and other tables do not count."""
    content = file.read_bytes()
    try:
        parsed = tomllib.loads(content.decode("utf-8-sig"))
        content = json.dumps([parsed.get(t) for t in tables], default=str).encode()
    except ValueError:
        pass
    return hashlib.sha256(content).hexdigest()
