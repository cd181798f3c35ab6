"""Rows of a tracked run before its corrections, on disk: a correction repeats no tracking."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.estimator.bubbles.pairing.model import Finding, LogRatioModel, PairModel
from telerig.estimator.bubbles.shape.shapes import Shapes
from telerig.estimator.tracking.linking.filter import TrackEvent
from telerig.estimator.tracking.linking.frames import NO_PARTICLE
from telerig.estimator.tracking.linking.frames_to_rows import Linked
from telerig.io.files.atomic import atomic_path, write_text_atomic

_TABLES = ("tracks", "detections")


@dataclass
class Linking:
    """Hold what the tracking of a run tells beside its rows; complete when all rows were read.

    pairs, misplaced : what `RigModel` says of each pair of cameras, and of one of them.
    shapes : what the run tells of its bubbles' shapes.
    events : events of the tracks.
    frames_without : for each camera, how often each reason for a frame without bubbles occurred.
    """

    pairs: dict[tuple[int, int], PairModel]
    shapes: Shapes
    events: list[TrackEvent]
    frames_without: dict[str, dict[str, int]]
    misplaced: tuple[int, float, float] | None = None


@dataclass(frozen=True)
class LinkedRows:
    """Keep the rows of a run in a folder, as arrays: one file for some frames at a time."""

    folder: Path

    @property
    def _mark(self) -> Path:
        return self.folder / "linked.json"

    def _file(self, part: int) -> Path:
        return self.folder / f"linked-{part:06d}.npz"

    def linking(self) -> Linking | None:
        """Return what was told beside the rows; None unless all of them are there."""
        if not self._mark.is_file():
            return None
        content = json.loads(self._mark.read_bytes(), object_hook=_from_json)
        return Linking(
            {(a, b): _pair_model(model) for a, b, model in content["pairs"]},
            Shapes(**content["shapes"]),
            [TrackEvent(**{**e, "particles": tuple(e["particles"])}) for e in content["events"]],
            content["frames_without"],
            content["misplaced"] and tuple(content["misplaced"]),
        )

    def kept(self) -> Iterator[Linked]:
        """Yield the rows, in the parts in which they were written."""
        for part in range(json.loads(self._mark.read_bytes())["parts"]):
            with np.load(self._file(part)) as arrays:
                yield _linked(arrays)

    def keep(self, parts: Iterator[Linked], linking: Linking) -> Iterator[Linked]:
        """Write the rows while they are read, and ``linking`` after the last of them."""
        count = 0
        for count, part in enumerate(parts, 1):
            arrays = _arrays(part)
            with atomic_path(self._file(count - 1)) as staged:
                np.savez(staged, **arrays)
            yield _linked(arrays)
        pairs = [[*pair, asdict(model)] for pair, model in linking.pairs.items()]
        content = {"parts": count, **asdict(linking), "pairs": pairs}
        write_text_atomic(self._mark, json.dumps(content, default=_as_json))


def _arrays(part: Linked) -> dict[str, Any]:
    """Return the columns as arrays by the name of table and column; text without NaN."""
    out = {}
    for table in _TABLES:
        for name, column in getattr(part, table).infer_objects().items():
            if isinstance(column.dtype, pd.Int64Dtype):
                array = column.fillna(NO_PARTICLE).to_numpy(np.int64)
            elif column.dtype.kind in "biuf":
                array = column.to_numpy()
            else:
                array = column.where(column.notna(), "").to_numpy(str)
            out[f"{table}/{name}"] = array
    return out


def _linked(arrays: Mapping[str, NDArray[Any]]) -> Linked:
    """Return the rows of which `_arrays` made arrays."""
    columns: dict[str, dict[str, Any]] = {table: {} for table in _TABLES}
    for key, array in arrays.items():
        table, _, name = key.partition("/")
        columns[table][name] = array.astype(object) if array.dtype.kind == "U" else array
    particle = columns["detections"]["particle"]
    columns["detections"]["particle"] = pd.arrays.IntegerArray(particle, particle == NO_PARTICLE)
    return Linked(*(pd.DataFrame(columns[table]) for table in _TABLES))


def _as_json(value: Any) -> Any:
    if isinstance(value, Finding):
        return value.name
    return {"array": value.tolist()} if isinstance(value, np.ndarray) else value.item()


def _from_json(content: dict[str, Any]) -> Any:
    return np.array(content["array"]) if content.keys() == {"array"} else content


def _pair_model(content: Mapping[str, Any]) -> PairModel:
    found: dict[str, Any] = {}
    for name, value in content.items():
        if isinstance(value, dict):
            found[name] = LogRatioModel(**value)
        else:
            found[name] = tuple(value) if isinstance(value, list) else value
    return PairModel(**{**found, "findings": tuple(Finding[n] for n in found["findings"])})
