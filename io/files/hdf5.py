"""Write HDF5 files completely or not at all, and read arrays of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.files.atomic import atomic_path

if TYPE_CHECKING:
    import h5py


class _Disk(FileIO):
    """A file that keeps the first error of writing, and then pretends to write.

    The HDF5 library may crash the process when the disk is full while it writes.
    """

    error: OSError | None = None

    def write(self, content: Any) -> int:
        size = memoryview(content).nbytes
        if self.error is None:
            try:
                done = super().write(content)
                while done < size:
                    done += super().write(memoryview(content).cast("B")[done:])
            except OSError as error:
                self.error = error
        return size


@contextmanager
def hdf5_file(path: str | PathLike[str]) -> Iterator[h5py.File]:
    """Yield a new HDF5 file, which appears at ``path`` when it is complete.

    Raises InputError when the file cannot be written.
    """
    import h5py

    with atomic_path(path) as temporary, _Disk(temporary, "w+b") as disk:
        try:
            with h5py.File(disk, "w") as file:
                yield file
        except Exception:
            if disk.error is None:
                raise
        if disk.error is not None:
            raise disk.error


def read_arrays(path: str | PathLike[str], group: str) -> dict[str, Array]:
    """Read all arrays of numbers of a group. Raises InputError when this is not possible."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            return {name: np.asarray(data[()], float) for name, data in file[group].items()}
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"cannot be read as HDF5 with the group {group!r}: {error}",
            where=str(path),
            todo="run the command again that made this file",
        ) from error
