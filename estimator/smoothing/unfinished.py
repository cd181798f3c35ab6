"""The finished pieces of a long run on disk, so that an interrupted smoothing goes on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from telerig.arrays import Array
from telerig.estimator.smoothing.pieces import Constants, Piece
from telerig.estimator.smoothing.problem.problem import SmoothingProblem
from telerig.estimator.smoothing.results_file import ResultsFile
from telerig.estimator.smoothing.verdict.evidence import Evidence
from telerig.io.files.atomic import atomic_path
from telerig.io.files.hdf5 import hdf5_file
from telerig.io.files.typed_json import packed, unpacked
from telerig.io.results.work_folder import empty_unless

if TYPE_CHECKING:
    import pandas as pd

_CONSTANTS = "constants.json"
_NOTES = "notes"


class Notes(NamedTuple):
    """What the verdict and the summary need of a piece, beside its tables.

    evidence : its sums.
    sensors : estimates of its sensors by name.
    """

    evidence: Evidence
    sensors: Mapping[str, Any]


class _Told(NamedTuple):
    prior: Array
    prior_mean: Array
    information: Array
    side: Array


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

    def constants(self, problem: SmoothingProblem, pieces: Sequence[Piece]) -> Constants | None:
        """Return the information on the run's constants; None if it is not there."""
        path = self.folder / _CONSTANTS
        if not path.is_file():
            return None
        return Constants(problem, tuple(pieces), *unpacked(_Told, json.loads(path.read_bytes())))

    def keep_constants(self, constants: Constants) -> None:
        """Write the information on the run's constants."""
        told = _Told(
            constants.prior, constants.prior_mean, constants.information, constants.side
        )  # fmt: skip
        with atomic_path(self.folder / _CONSTANTS) as staged:
            staged.write_text(json.dumps(packed(told)), encoding="utf-8")

    def missing(self, pieces: Sequence[Piece]) -> list[int]:
        """Return the numbers of the pieces that are not there."""
        return [n for n, piece in enumerate(pieces) if not self._path(piece).is_file()]

    def keep(
        self,
        piece: Piece,
        notes: Notes,
        tables: tuple[pd.DataFrame, pd.DataFrame],
        states: Mapping[str, Array],
        bodies: pd.DataFrame | None,
    ) -> None:
        """Write a piece: notes, and what `ResultsFile.append` takes."""
        with hdf5_file(self._path(piece)) as file:
            one = ResultsFile(file)
            one.append(*tables, states, bodies)
            one.finish((1.0, 1.0, 1.0))
            text = json.dumps(packed(notes)).encode()
            file[_NOTES] = np.frombuffer(text, np.uint8)

    def notes(self, piece: Piece) -> Notes:
        """Read the notes of a piece."""
        import h5py

        with h5py.File(self._path(piece), "r") as file:
            found: Notes = unpacked(Notes, json.loads(file[_NOTES][()].tobytes()))
        return found

    def append_to(
        self, file: ResultsFile, pieces: Sequence[Piece], inflation: Sequence[float]
    ) -> None:
        """Append all pieces to results.h5, their standard deviations widened."""
        import h5py

        for piece in pieces:
            with h5py.File(self._path(piece), "r") as one:
                file.append_piece(one, inflation)

    def _path(self, piece: Piece) -> Path:
        return self.folder / f"piece-{'-'.join(map(str, astuple(piece)))}.h5"
