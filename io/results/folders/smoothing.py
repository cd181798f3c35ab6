"""What a smoothed run's results folder holds besides tracks, and what it adds up to.

Standard deviations are computed here; the files are checked as they are read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.files.csv_table import header_of
from telerig.io.results.manifest import reading
from telerig.io.results.smoothing import SmoothingFile
from telerig.io.tables.smoothing import (
    AXES,
    BODY_COLUMNS,
    BUBBLES,
    SHAKE,
    STATE,
    SUMMARY,
    TRAJECTORIES,
)
from telerig.io.tables.smoothing import POSITION as PLACE
from telerig.io.tables.smoothing import VELOCITY as SPEED
from telerig.io.tables.table import POINT
from telerig.statistics import median, rms

__all__ = ["AXES", "PLACE", "SPEED", "SmoothingResults", "read_smoothing_results"]

_ALONG = 0.9


@dataclass(frozen=True)
class SmoothingResults:
    """The results folder of a smoothed run; each file is read and checked when it is asked for.

    up : (3,) unit vector in rig axes.
    Reading raises InputError for what is missing, cannot be read or does not fit together.
    """

    folder: Path
    up: Array = field(default_factory=lambda: np.array([0.0, -1.0, 0.0]))

    FILES: ClassVar[tuple[str, ...]] = (
        "smoothing.json", "shake.csv", "trajectories.csv", "bubbles.csv", "bubble_summary.csv",
    )  # fmt: skip

    @cached_property
    def file(self) -> SmoothingFile:
        """smoothing.json."""
        return SmoothingFile.read(self.folder / "smoothing.json")

    @property
    def content(self) -> Mapping[str, Any]:
        """smoothing.json as it stands."""
        return self.file.content()

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Names, in the rig's order."""
        file = self.folder / "shake.csv"
        header = header_of(file, SmoothingFile.AGAIN)
        found = [name.removesuffix("_x_mm") for name in header if name.endswith("_x_mm")]
        cameras = tuple(n for n in found if not (n[:1] == "s" and n[1:] in found))
        known = self.file.cameras or cameras
        if not cameras or sorted(known) != sorted(cameras):
            what = f"its columns are of cameras {list(cameras)}, smoothing.json's are {list(known)}"
            raise InputError(what, where=f"{file} row 1", todo=SmoothingFile.AGAIN)
        return tuple(known)

    @cached_property
    def shake(self) -> pd.DataFrame:
        """shake.csv, by frame."""
        file = self.folder / "shake.csv"
        table = SHAKE.read(file, self.cameras)
        _check_times(table, file, "")
        return table

    @cached_property
    def rows(self) -> pd.DataFrame:
        """trajectories.csv as it stands, also with columns that telerig does not know."""
        file = self.folder / "trajectories.csv"
        table = TRAJECTORIES.read(file)
        _check_columns(table, POINT, file)
        return table

    @cached_property
    def trajectories(self) -> pd.DataFrame:
        """trajectories.csv sorted by bubble and frame; without bubbles it has all columns, too."""
        empty = {name: np.zeros(0) for name in STATE if not len(self.rows)}
        table = self.rows.assign(**empty)
        table = table.sort_values(["particle", "frame"], kind="stable", ignore_index=True)
        for particle, mine in table.groupby("particle", sort=False):
            _check_times(mine, self.folder / "trajectories.csv", f" of bubble {particle}")
        return table

    @cached_property
    def bubble_frames(self) -> pd.DataFrame:
        """bubbles.csv; empty where it is not."""
        return BUBBLES.read(self.folder / BUBBLES.file, optional=True)

    @cached_property
    def shaped(self) -> pd.DataFrame:
        """`trajectories`, with the bubbles' sizes and shapes where bubbles.csv has them."""
        keys, table = ["frame", "particle"], self.trajectories
        bodies = self.bubble_frames.drop_duplicates(keys)
        if not len(bodies):
            return table
        new = [n for n in BODY_COLUMNS if n in bodies and (n in keys or n not in table)]
        return table.merge(bodies[new], "left", on=keys)

    @cached_property
    def bubble_summary(self) -> pd.DataFrame:
        """bubble_summary.csv; empty where it is not."""
        return SUMMARY.read(self.folder / SUMMARY.file, optional=True)

    def part(self, name: str) -> Mapping[str, Any]:
        """Return an object of smoothing.json; {} if it is missing."""
        return dict(self.content.get(name) or {})

    @property
    def bubbles(self) -> tuple[int, ...]:
        """Longest track first."""
        lengths = self.trajectories["particle"].value_counts(sort=False).sort_index()
        order = np.argsort(-lengths.to_numpy(), kind="stable")
        return tuple(int(k) for k in lengths.index.to_numpy()[order])

    def track(self, particle: int) -> pd.DataFrame:
        """Return the rows of one bubble."""
        table: pd.DataFrame = self.trajectories.loc[self.trajectories["particle"] == particle]
        return table

    @property
    def rate_hz(self) -> float | None:
        """Frames in a second, from the typical step; None for fewer than two frames."""
        steps = np.diff(self.shake["t_s"].to_numpy(float))
        return float(1 / np.median(steps)) if len(steps) else None

    def depth(self, camera: str) -> Array | None:
        """Return the direction (3,) along which a camera sees nothing; None if not stated."""
        found = self.file.depth_axes.get(camera)
        return None if found is None else np.asarray(found / np.linalg.norm(found))

    def unseen(self, camera: str) -> tuple[str, ...]:
        """Return the axes along a camera's depth, where its shake is not measured."""
        depth = self.depth(camera)
        if depth is not None:
            return tuple(axis for axis, d in zip(AXES, depth) if abs(d) > _ALONG)
        still = [not np.any(self.shake[f"{camera}_{axis}_mm"]) for axis in AXES]
        return tuple(axis for axis, none in zip(AXES, still) if none and len(self.shake))

    def seen(self, camera: str) -> tuple[str, ...]:
        """Return the rig axes ("x", "y", "z") along which the shake of a camera can be seen."""
        return tuple(axis for axis in AXES if axis not in self.unseen(camera))


def read_smoothing_results(folder: Path, up: Array) -> SmoothingResults | None:
    """Read a smoothed run's folder for a page, a film or the viewer; None without smoothing.json.

    up : (3,) unit vector in rig axes, where smoothing.json states none. Raises InputError for what
    is missing, cannot be read or does not fit together.
    """
    if not (folder / "smoothing.json").is_file():
        return None
    results = SmoothingResults(folder, up)
    with reading(folder, SmoothingResults.FILES):
        if results.file.up is not None:
            results = replace(results, up=results.file.up)
        _ = results.shake, results.bubble_frames, results.bubble_summary
        _check_columns(results.trajectories, STATE, folder / "trajectories.csv")
    return results


def _check_columns(table: pd.DataFrame, needed: Sequence[str], file: Path) -> None:
    missing = [name for name in needed if name not in table]
    if len(table) and missing:
        what = f"has no column {missing[0]}"
        raise InputError(what, where=f"{file} row 1", todo=SmoothingFile.AGAIN)


def _check_times(table: pd.DataFrame, file: Path, whose: str) -> None:
    steps = np.diff(table["t_s"].to_numpy(float))
    if len(steps) and not steps.min() > 0:
        frame = int(table["frame"].iloc[int(np.argmin(steps > 0)) + 1])
        what = f"the times{whose} do not increase at frame {frame}"
        raise InputError(what, where=f"{file}, column t_s", todo=SmoothingFile.AGAIN)


def column(table: pd.DataFrame, name: str) -> Array:
    """Return a column's values; NaN if the file has none."""
    if name not in table:
        return np.full(len(table), np.nan)
    return table[name].to_numpy(float)


def known_parts(results: SmoothingResults, part: str, needed: str) -> dict[str, Mapping[str, Any]]:
    """Return the objects in a part of smoothing.json that have the needed key, by name."""
    return {
        str(name): found
        for name, found in results.part(part).items()
        if isinstance(found, Mapping) and needed in found
    }


def axis_sd(results: SmoothingResults, pattern: str = PLACE) -> list[float | None]:
    """Return the median sd of the bubbles by axis, in mm or mm/s; None if it is not known."""
    return [median(column(results.trajectories, "s" + pattern.format(axis))) for axis in AXES]


def taken_away(
    results: SmoothingResults, kind: str = "naive_", pattern: str = PLACE
) -> list[float | None]:
    """Return the RMS of a baseline minus smoothed by axis, in mm or mm/s."""
    table = results.trajectories
    return [
        rms(column(table, kind + pattern.format(a)) - column(table, pattern.format(a)))
        for a in AXES
    ]


def shake_rms_um(results: SmoothingResults, camera: str, axis: str) -> float | None:
    """Return the RMS of a camera's shake about its mean; None along an axis it does not see."""
    if axis in results.unseen(camera) or not len(results.shake):
        return None
    return float(1e3 * np.std(column(results.shake, f"{camera}_{axis}_mm")))
