"""What a smoothed run's results folder holds besides tracks, read and checked for its report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.files.csv_table import read_columns
from telerig.io.results.smoothing import (
    AXES,
    STATE,
    TRAJECTORIES,
    SmoothingFile,
    shake_columns,
)
from telerig.io.results.smoothing import POSITION as PLACE
from telerig.io.results.smoothing import VELOCITY as SPEED

__all__ = ["AXES", "PLACE", "SPEED", "SmoothingResults", "read_smoothing_results"]

_ALONG = 0.9


@dataclass(frozen=True)
class SmoothingResults:
    """The smoothing in memory.

    file : smoothing.json. cameras : names, in the rig's order. trajectories,
    shake : the tables, by bubble and frame. up : (3,) unit vector in rig axes.
    """

    file: SmoothingFile
    cameras: tuple[str, ...]
    trajectories: pd.DataFrame
    shake: pd.DataFrame
    up: Array

    @property
    def content(self) -> Mapping[str, Any]:
        """smoothing.json as it stands."""
        return self.file.content()

    def part(self, name: str) -> Mapping[str, Any]:
        """An object of smoothing.json, empty where it is not there."""
        return dict(self.content.get(name) or {})

    @property
    def bubbles(self) -> tuple[int, ...]:
        """Longest track first."""
        lengths = self.trajectories["particle"].value_counts(sort=False).sort_index()
        order = np.argsort(-lengths.to_numpy(), kind="stable")
        return tuple(int(k) for k in lengths.index.to_numpy()[order])

    def track(self, particle: int) -> pd.DataFrame:
        """One bubble's rows."""
        table: pd.DataFrame = self.trajectories.loc[self.trajectories["particle"] == particle]
        return table

    @property
    def rate_hz(self) -> float | None:
        """Frames in a second, from the typical step; None for fewer than two frames."""
        steps = np.diff(self.shake["t_s"].to_numpy(float))
        return float(1 / np.median(steps)) if len(steps) else None

    def depth(self, camera: str) -> Array | None:
        """(3,) direction in rig axes along which the camera sees nothing, if the file tells."""
        found = self.file.depth_axes.get(camera)
        return None if found is None else np.asarray(found / np.linalg.norm(found))

    def unseen(self, camera: str) -> tuple[str, ...]:
        """Axes along the camera's depth: its shake there is the prior's, not a measurement."""
        depth = self.depth(camera)
        if depth is not None:
            return tuple(axis for axis, d in zip(AXES, depth) if abs(d) > _ALONG)
        still = [not np.any(self.shake[f"{camera}_{axis}_mm"]) for axis in AXES]
        return tuple(axis for axis, none in zip(AXES, still) if none and len(self.shake))

    def seen(self, camera: str) -> tuple[str, ...]:
        return tuple(axis for axis in AXES if axis not in self.unseen(camera))


def read_smoothing_results(folder: Path, up: Array) -> SmoothingResults | None:
    """Read smoothing.json, trajectories.csv and shake.csv; None where there is no smoothing.json.

    Raises InputError for what is missing, cannot be read or does not fit together.
    """
    file = folder / "smoothing.json"
    if not file.is_file():
        return None
    found = SmoothingFile.read(file)
    shake, cameras = _shake(folder / "shake.csv", found)
    return SmoothingResults(found, cameras, _trajectories(folder / "trajectories.csv"), shake, up)


def _shake(file: Path, smoothing: SmoothingFile) -> tuple[pd.DataFrame, tuple[str, ...]]:
    found = [n.removesuffix("_x_mm") for n in _header(file) if n.endswith("_x_mm")]
    cameras = tuple(n for n in found if not (n[:1] == "s" and n[1:] in found))
    known = list(smoothing.cameras or cameras)
    if not cameras or sorted(known) != sorted(cameras):
        what = f"its columns are of cameras {list(cameras)}, smoothing.json's are {known}"
        raise InputError(what, where=f"{file} row 1", todo=SmoothingFile.AGAIN)
    table = read_columns(file, shake_columns(known))
    _check_times(table, file, "")
    return table, tuple(known)


def _trajectories(file: Path) -> pd.DataFrame:
    """Rows by bubble and frame. Columns that a run without bubbles leaves out are there, empty."""
    _header(file)
    table = read_columns(file, TRAJECTORIES)
    missing = [name for name in STATE if name not in table]
    if len(table) and missing:
        raise InputError(
            f"has no column {missing[0]}", where=f"{file} row 1", todo=SmoothingFile.AGAIN
        )
    table = table.assign(**{name: np.zeros(0) for name in missing})
    table = table.sort_values(["particle", "frame"], kind="stable", ignore_index=True)
    for particle, mine in table.groupby("particle", sort=False):
        _check_times(mine, file, f" of bubble {particle}")
    return table


def _header(file: Path) -> list[str]:
    try:
        with file.open(encoding="utf-8-sig") as stream:
            return [name.strip() for name in stream.readline().split(",")]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot be read: {error}", where=str(file), todo=SmoothingFile.AGAIN
        ) from error


def _check_times(table: pd.DataFrame, file: Path, whose: str) -> None:
    steps = np.diff(table["t_s"].to_numpy(float))
    if len(steps) and not steps.min() > 0:
        frame = int(table["frame"].iloc[int(np.argmin(steps > 0)) + 1])
        what = f"the times{whose} do not increase at frame {frame}"
        raise InputError(what, where=f"{file}, column t_s", todo=SmoothingFile.AGAIN)
