"""What a smoothed run's results folder holds besides tracks, read and checked for its report."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.io.files.csv_table import Column
from telerig.io.report.page.results_files import read_object
from telerig.io.report.page.results_tables import read_columns

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

SCHEMA = 1
AXES = ("x", "y", "z")
PLACE, SPEED = "{}_mm", "v{}_mm_s"
"""Columns of trajectories.csv; with "s", "naive_" and "rts_" in front: sd and baselines."""

_AGAIN = "smooth again (`telerig smooth`), or name the right results folder"
_NUMBER = re.compile(r"-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_ALONG = 0.9


@dataclass(frozen=True)
class SmoothingResults:
    """The smoothing in memory.

    content : smoothing.json as it stands. cameras : names, in the rig's order. trajectories,
    shake : the tables, by bubble and frame. up : (3,) unit vector in rig axes.
    """

    content: Mapping[str, Any]
    cameras: tuple[str, ...]
    trajectories: pd.DataFrame
    shake: pd.DataFrame
    up: Array

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
        words = self.part("unseen").get(camera)
        numbers = [float(n) for n in _NUMBER.findall(str(words))][-3:]
        length = np.linalg.norm(numbers) if len(numbers) == 3 else 0.0
        return np.asarray(np.array(numbers) / length) if 0 < length < np.inf else None

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
    content = _content(file)
    shake, cameras = _shake(folder / "shake.csv", content)
    return SmoothingResults(content, cameras, _trajectories(folder / "trajectories.csv"), shake, up)


def _content(file: Path) -> Mapping[str, Any]:
    content = read_object(file, _AGAIN)
    schema = content.get("schema", SCHEMA)
    if not isinstance(schema, int) or schema > SCHEMA:
        raise InputError(
            f"schema {schema} is newer than this version reads ({SCHEMA})",
            where=str(file),
            todo="update telerig",
        )
    expected: dict[str, type | tuple[type, ...]] = {
        "verdict": str, "flags": list, "cameras": list, "model": dict, "residuals": dict,
        "encoder": dict, "accelerometers": dict, "bubble_means": dict, "unseen": dict,
        "words": (list, str), "axes": dict, "modes": list, "whiteness": dict,
        "accelerometer_spectra": dict,
    }  # fmt: skip
    for name, kind in expected.items():
        if content.get(name) is not None and not isinstance(content[name], kind):
            raise InputError(f"garbles {name!r}", where=str(file), todo=_AGAIN)
    return content


def _shake(file: Path, content: Mapping[str, Any]) -> tuple[pd.DataFrame, tuple[str, ...]]:
    found = [n.removesuffix("_x_mm") for n in _header(file) if n.endswith("_x_mm")]
    cameras = tuple(n for n in found if not (n[:1] == "s" and n[1:] in found))
    known = [str(c) for c in content.get("cameras") or cameras]
    if not cameras or sorted(known) != sorted(cameras):
        what = f"its columns are of cameras {list(cameras)}, smoothing.json's are {known}"
        raise InputError(what, where=f"{file} row 1", todo=_AGAIN)
    columns = [Column("frame", "whole"), Column("t_s")]
    for camera in known:
        columns += [Column(f"{camera}_{axis}_mm") for axis in AXES]
        columns += _optional([f"s{camera}_{axis}_mm" for axis in AXES])
    columns += _optional(["position_mm", "sposition_mm"])
    table = read_columns(file, columns)
    _check_times(table, file, "")
    return table, tuple(known)


def _trajectories(file: Path) -> pd.DataFrame:
    """Rows by bubble and frame. Columns that a run without bubbles leaves out are there, empty."""
    patterns = (PLACE, SPEED)
    always = [pattern.format(axis) for pattern in patterns for axis in AXES]
    besides = [f"{kind}{name}" for kind in ("s", "naive_", "rts_") for name in always]
    _header(file)
    names = [Column("frame", "whole"), Column("particle", "whole"), Column("t_s")]
    table = read_columns(file, [*names, *_optional([*always, *besides, "observed"])])
    missing = [name for name in always if name not in table]
    if len(table) and missing:
        raise InputError(f"has no column {missing[0]}", where=f"{file} row 1", todo=_AGAIN)
    table = table.assign(**{name: np.zeros(0) for name in missing})
    table = table.sort_values(["particle", "frame"], kind="stable", ignore_index=True)
    for particle, mine in table.groupby("particle", sort=False):
        _check_times(mine, file, f" of bubble {particle}")
    return table


def _optional(names: Sequence[str]) -> list[Column]:
    return [Column(name, required=False, blank=True) for name in names]


def _header(file: Path) -> list[str]:
    try:
        with file.open(encoding="utf-8-sig") as stream:
            return [name.strip() for name in stream.readline().split(",")]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read: {error}", where=str(file), todo=_AGAIN) from error


def _check_times(table: pd.DataFrame, file: Path, whose: str) -> None:
    steps = np.diff(table["t_s"].to_numpy(float))
    if len(steps) and not steps.min() > 0:
        frame = int(table["frame"].iloc[int(np.argmin(steps > 0)) + 1])
        what = f"the times{whose} do not increase at frame {frame}"
        raise InputError(what, where=f"{file}, column t_s", todo=_AGAIN)
