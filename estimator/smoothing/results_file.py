"""results.h5: the tables of a smoothed run, its states and their covariances, piece by piece."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.files.csv_table import append_table, write_table
from telerig.io.files.hdf5 import hdf5_file, read_arrays
from telerig.io.tables.smoothing import AXES

if TYPE_CHECKING:
    import h5py
    import pandas as pd

NAME = "results.h5"
TABLES = ("trajectories", "shake")
_ROWS_AT_ONCE = 50_000
_SAMPLED = 20_000


class ResultsFile:
    """Append the tables and states of pieces of a run to an open HDF5 file.

    The file's attribute ``rows`` explains how positions and velocities follow from the states. The
    covariances are those of the solution; the attribute ``inflation`` holds the factors of the
    standard deviations along x, y and z by which contradicting measurements widen the tables'.
    """

    def __init__(self, file: h5py.File) -> None:
        self.file = file
        self.rows = list[int]()

    def append(self, tables: Tables) -> None:
        """Append rows of the tables and the states that belong to them.

        Bodies are columns that are kept beside those of the trajectories, row by row.
        """
        for name in TABLES:
            self._table(name, getattr(tables, name))
        if tables.bodies is not None:
            self._table("bodies", tables.bodies)
        for name, array in tables.states.items():
            if not name.endswith("_rows") or f"states/{name}" not in self.file:
                self._add(f"states/{name}", array)
        self.rows.append(len(tables.trajectories))

    def _table(self, name: str, table: pd.DataFrame) -> None:
        if name not in self.file:
            self.file.create_group(name, track_order=True)
        for column in table.columns:
            self._add(f"{name}/{column}", table[column].to_numpy())

    def _add(self, name: str, values: Array) -> None:
        if name in self.file:
            data = self.file[name]
            count = len(data)
            data.resize(count + len(values), axis=0)
            data[count:] = values
            return
        # level 1 of shuffled bytes is three times as fast as the default, and not larger
        self.file.create_dataset(
            name, data=values, maxshape=(None, *values.shape[1:]), chunks=True,
            compression="gzip", compression_opts=1, shuffle=True,
        )  # fmt: skip

    def finish(self, inflation: Sequence[float]) -> None:
        """Write the attributes, with the number of rows of each piece."""
        from telerig.io.results.smoothing import SmoothingFile

        self.file.attrs["schema"] = SmoothingFile.SCHEMA
        self.file.attrs["rows_of_pieces"] = self.rows
        self.file.attrs["inflation"] = tuple(inflation)
        self.file.attrs["rows"] = "a state times its rows gives mm, mm/s in the lab (rig axes)"

    def append_piece(self, piece: h5py.File, inflation: Sequence[float]) -> None:
        """Append what another such file holds, its tables' standard deviations multiplied by
        factors (3,) along each axis."""
        for name in (*TABLES, "bodies", "states"):
            group = piece.get(name, {})
            if name in piece and name not in self.file:
                self.file.create_group(name, track_order=True)
            for column, data in group.items():
                widened = name in TABLES and column[1:] in group
                factor = _factor(column, inflation) if widened else 1.0
                if not (column.endswith("_rows") and f"{name}/{column}" in self.file):
                    self._add(f"{name}/{column}", data[()] * factor if factor != 1 else data[()])
        self.rows += list(map(int, piece.attrs["rows_of_pieces"]))


def _factor(column: str, inflation: Sequence[float]) -> float:
    """Return the factor of a column: that of its axis for an sd, else 1."""
    for axis, factor in zip(AXES, inflation):
        if column[:1] == "s" and column.endswith((f"{axis}_mm", f"{axis}_mm_s", f"{axis}_mm_s2")):
            return float(factor)
    return 1.0


@contextmanager
def results_file(folder: Path) -> Iterator[ResultsFile]:
    """Yield the file results.h5 of a folder, which appears when it is complete."""
    with hdf5_file(folder / NAME) as file:
        yield ResultsFile(file)


@dataclass(frozen=True)
class Tables:
    """Hold the tables of a run in memory; `Smoothing` describes them."""

    trajectories: pd.DataFrame
    shake: pd.DataFrame
    states: Mapping[str, Array] = field(default_factory=dict)
    bodies: pd.DataFrame | None = None

    def typical(self, columns: Sequence[str]) -> pd.DataFrame:
        """Return the columns that the trajectories have."""
        return self.trajectories[[name for name in columns if name in self.trajectories]]

    def sizes(self) -> tuple[int, int]:
        """Return the number of bubbles and of frames."""
        return int(self.trajectories["particle"].nunique()), len(self.shake)

    def write(self, out: Path, inflation: Sequence[float]) -> None:
        """Write trajectories.csv, shake.csv and results.h5 into a folder."""
        write_table(self.trajectories, out / "trajectories.csv")
        write_table(self.shake, out / "shake.csv")
        with results_file(out) as file:
            file.append(replace(self, bodies=None))
            file.finish(inflation)

    def parts(self) -> Iterator[Tables]:
        """Yield the tables in parts; here all rows are one part."""
        yield self

    def last_parts(self) -> dict[int, int]:
        """Return by particle the number of the last part in which it has rows."""
        return dict.fromkeys(self.trajectories["particle"].unique().tolist(), 0)


@dataclass(frozen=True)
class StoredTables:
    """Hold the tables of a run that was smoothed in pieces: in a folder, and read when asked for.

    Their rows are by piece, then by bubble and frame.

    folder : which holds results.h5.
    keep : a temporary folder that lives as long as the tables.
    """

    folder: Path
    keep: TemporaryDirectory[str] | None = field(default=None, repr=False)

    @cached_property
    def trajectories(self) -> pd.DataFrame:
        """The whole table."""
        return self._table("trajectories")

    @cached_property
    def shake(self) -> pd.DataFrame:
        """The whole table."""
        return self._table("shake")

    @cached_property
    def states(self) -> Mapping[str, Array]:
        """All states."""
        return read_arrays(self.folder / NAME, "states")

    @property
    def bodies(self) -> pd.DataFrame | None:
        """The whole table; None without bodies."""
        import pandas as pd

        found = [part.bodies for part in self.parts() if part.bodies is not None]
        return pd.concat(found, ignore_index=True) if found else None

    def of_pieces(self) -> bool:
        """Return whether the file holds the tables of a run that was smoothed in pieces."""
        with self._open() as file:
            return set(TABLES) <= set(file) and np.size(file.attrs.get("rows_of_pieces")) > 1

    def sizes(self) -> tuple[int, int]:
        """Return the number of bubbles and of frames."""
        with self._open() as file:
            return len(np.unique(file["trajectories/particle"][()])), len(file["shake/frame"])

    def typical(self, columns: Sequence[str]) -> pd.DataFrame:
        """Return some 20,000 rows, evenly spread, of the columns that the trajectories have."""
        import pandas as pd

        with self._open() as file:
            table = file["trajectories"]
            step = max(1, len(table["frame"]) // _SAMPLED)
            return pd.DataFrame({n: table[n][()][::step] for n in columns if n in table})

    def last_parts(self) -> dict[int, int]:
        """Return by particle the number of the last part in which it has rows."""
        with self._open() as file:
            rows = file.attrs["rows_of_pieces"]
            particles = file["trajectories/particle"][()]
        names, back = np.unique(particles[::-1], return_index=True)
        last = np.searchsorted(np.cumsum(rows), len(particles) - 1 - back, side="right")
        return dict(zip(names.tolist(), last.tolist()))

    def parts(self) -> Iterator[Tables]:
        """Yield the trajectories piece by piece, and the bodies."""
        import pandas as pd

        with self._open() as file:
            first = 0
            for count in file.attrs["rows_of_pieces"]:
                mine = slice(first, first + int(count))
                first = mine.stop
                paths = pd.DataFrame({n: d[mine] for n, d in file["trajectories"].items()})
                bodies = None
                if "bodies" in file:
                    columns = {n: d[mine] for n, d in file["bodies"].items()}
                    bodies = pd.DataFrame({n: paths[n] for n in ("frame", "particle")} | columns)
                    bodies = bodies[bodies["d_eq_mm"].notna()].reset_index(drop=True)
                yield Tables(paths, pd.DataFrame(), {}, bodies)

    def write(self, out: Path, inflation: Sequence[float]) -> None:
        """Write trajectories.csv and shake.csv into a folder, and results.h5 if it is not there.

        inflation : is in the tables already.
        """
        import pandas as pd

        if out.resolve() != self.folder.resolve():
            shutil.copyfile(self.folder / NAME, out / NAME)
        for part in self.parts():
            append_table(part.trajectories, out / "trajectories.csv")
        with self._open() as file:
            for first in range(0, len(file["shake/frame"]), _ROWS_AT_ONCE):
                mine = slice(first, first + _ROWS_AT_ONCE)
                rows = pd.DataFrame({name: data[mine] for name, data in file["shake"].items()})
                append_table(rows, out / "shake.csv")

    def _table(self, name: str) -> pd.DataFrame:
        import pandas as pd

        with self._open() as file:
            return pd.DataFrame({column: data[()] for column, data in file[name].items()})

    @contextmanager
    def _open(self) -> Iterator[h5py.File]:
        import h5py

        path = self.folder / NAME
        try:
            file = h5py.File(path, "r")
        except OSError as error:
            raise InputError(
                f"cannot be read: {error}", where=str(path), todo="smooth the run again"
            ) from error
        with file:
            yield file
