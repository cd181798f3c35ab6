"""Write HDF5 files completely or not at all, and read arrays of them."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.files.atomic import atomic_path

if TYPE_CHECKING:
    import h5py


@contextmanager
def hdf5_file(path: str | PathLike[str]) -> Iterator[h5py.File]:
    """Yield an HDF5 file in memory, and write it to ``path`` at the end.

    The HDF5 library may crash the process when the disk is full while it writes, so it does not
    write to the disk itself.
    Raises InputError when the file cannot be written.
    """
    import h5py

    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        yield file
    with atomic_path(path) as temporary:
        temporary.write_bytes(memory.getbuffer())


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
