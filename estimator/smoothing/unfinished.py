"""The finished pieces of a long run on disk, so that an interrupted smoothing goes on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from telerig.estimator.smoothing.pieces import Piece, Told
from telerig.estimator.smoothing.results_file import ResultsFile, Tables
from telerig.estimator.smoothing.verdict.evidence import Evidence
from telerig.io.files.hdf5 import hdf5_file
from telerig.io.files.typed_json import packed, unpacked
from telerig.io.results.work_folder import empty_unless

_NOTES = "notes"


class Notes(NamedTuple):
    """What the verdict and the summary need of a piece, beside its tables.

    evidence : its sums.
    sensors : estimates of its sensors by name.
    """

    evidence: Evidence
    sensors: Mapping[str, Any]


Kind = TypeVar("Kind", Notes, Told)
"""What is kept of a piece in each of the two rounds."""


@dataclass(frozen=True)
class UnfinishedPieces:
    """Keep finished pieces in a folder of their own.

    key : stands for everything on which the pieces depend; those of another key are removed.
    """

    folder: Path
    key: str

    def begin(self) -> None:
        """Make the folder, or leave what it holds of the same key."""
        empty_unless(self.folder, self.key)

    def end(self) -> None:
        """Remove the folder with all pieces."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def missing(self, kind: type[Kind], pieces: Sequence[Piece]) -> list[int]:
        """Return the numbers of the pieces of which there are no such notes."""
        return [n for n, piece in enumerate(pieces) if not self._path(kind, piece).is_file()]

    def keep(self, piece: Piece, notes: Notes | Told, tables: Tables | None = None) -> None:
        """Write the notes of a piece, and its tables."""
        with hdf5_file(self._path(type(notes), piece)) as file:
            if tables is not None:
                one = ResultsFile(file)
                one.append(tables)
                one.finish((1.0, 1.0, 1.0))
            file[_NOTES] = np.frombuffer(json.dumps(packed(notes)).encode(), np.uint8)

    def notes(self, kind: type[Kind], piece: Piece) -> Kind:
        """Read the notes of a piece."""
        import h5py

        with h5py.File(self._path(kind, piece), "r") as file:
            found: Kind = unpacked(kind, json.loads(file[_NOTES][()].tobytes()))
        return found

    def append_to(
        self, file: ResultsFile, pieces: Sequence[Piece], inflation: Sequence[float]
    ) -> None:
        """Append all pieces to results.h5, their standard deviations widened."""
        import h5py

        for piece in pieces:
            with h5py.File(self._path(Notes, piece), "r") as one:
                file.append_piece(one, inflation)

    def _path(self, kind: type[Notes | Told], piece: Piece) -> Path:
        return self.folder / f"{kind.__name__.lower()}-{'-'.join(map(str, astuple(piece)))}.h5"
