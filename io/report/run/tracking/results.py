"""What a tracked run's results folder holds, read and checked for its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.files.csv_table import read_columns
from telerig.io.results.run_record import RunFile
from telerig.io.results.tracking import (
    DETECTIONS,
    EVENTS,
    POINT,
    REFERENCES,
    Pairs,
    TrackingFile,
    tracks_columns,
)

UP = (0.0, -1.0, 0.0)
"""In the rig frame, where tracking.json has no ``up``."""


@dataclass(frozen=True)
class TrackResults:
    """A results folder in memory.

    file : tracking.json. cameras : names, in the rig's order.
    tracks, detections, events, references : the tables; rows of detections.csv that only say why
        a frame has no bubble are left out (tracking.json counts them).
    up : (3,) unit vector in the rig frame.
    pictures : (camera or "camera, binary", frame as six digits) -> file.
    absent : what optional files are missing, in words.
    """

    file: TrackingFile
    cameras: tuple[str, ...]
    tracks: pd.DataFrame
    detections: pd.DataFrame
    events: pd.DataFrame
    references: pd.DataFrame
    run: Mapping[str, Any]
    up: Array
    pictures: Mapping[tuple[str, str], Path]
    absent: tuple[str, ...]

    @property
    def content(self) -> Mapping[str, Any]:
        """tracking.json as it stands."""
        return self.file.content()

    @property
    def points_mm(self) -> Array:
        """(N, 3)."""
        return self.tracks[list(POINT)].to_numpy(float)

    @property
    def height_mm(self) -> Array:
        """(N,) along ``up``."""
        return np.asarray(self.points_mm @ self.up)

    @property
    def sd_um(self) -> Array:
        """(N, 3) of the measurement, per rig axis."""
        variances = self.tracks[["sxx_mm2", "syy_mm2", "szz_mm2"]].to_numpy(float)
        return 1e3 * np.sqrt(np.where(variances >= 0, variances, np.nan))

    def marked(self, camera: int) -> bool:
        """Whether marks fixed to the tank were followed in a camera's images."""
        return bool((self.references["camera"] == self.cameras[camera]).any())

    @property
    def pairs(self) -> Pairs:
        return self.file.pairs or Pairs()

    def image_size_px(self, camera: str) -> tuple[int, int] | None:
        """From tracking.json, if it tells."""
        return self.file.image_size_px.get(camera)


def read_track_results(folder: Path) -> TrackResults:
    """Read a tracked run's results folder.

    tracking.json and tracks.csv are needed; detections.csv, events.csv, references.csv, run.json,
    overlays/<camera>/<frame>.jpg and binary/<camera>/<frame>.png are used when they are there.
    Raises InputError for what is missing, cannot be read or does not fit together.
    """
    file = TrackingFile.read(folder / "tracking.json")
    cameras = _cameras(file, folder / "tracks.csv")
    tracks = read_columns(folder / "tracks.csv", tracks_columns(cameras))
    detections = _detections(folder / "detections.csv", cameras)
    events = read_columns(folder / "events.csv", EVENTS, optional=True)
    references = read_columns(folder / "references.csv", REFERENCES, optional=True)
    run = RunFile.read_if_there(folder / "run.json").content()
    pictures = _pictures(folder, cameras)
    absent = {
        "detections.csv (no numbers on single images)": (folder / "detections.csv").is_file(),
        "events.csv (no history of births, gaps and ends)": (folder / "events.csv").is_file(),
        "run.json (no versions, no hashes of what went in)": bool(run),
        "overlays/ and binary/ (no pictures of the bubbles that were found)": bool(pictures),
    }
    return TrackResults(
        file, cameras, tracks, detections, events, references, run,
        unit_vector(UP if file.up is None else file.up),
        pictures,
        tuple(text for text, present in absent.items() if not present),
    )  # fmt: skip


def unit_vector(vector: ArrayLike) -> Array:
    found = np.asarray(vector, float)
    return np.asarray(found / np.linalg.norm(found))


def _cameras(tracking: TrackingFile, file: Path) -> tuple[str, ...]:
    """The two cameras that the header of tracks.csv names."""
    try:
        with file.open(encoding="utf-8-sig") as stream:
            header = [name.strip() for name in stream.readline().split(",")]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot be read: {error}", where=str(file), todo=TrackingFile.AGAIN
        ) from error
    found = tuple(name.removesuffix("_u_px") for name in header if name.endswith("_u_px"))
    known = list(tracking.frames_without_bubbles or found)
    if not found or sorted(known) != sorted(found):
        what = f"its columns are of cameras {list(found)}, tracking.json's are {known}"
        raise InputError(what, where=f"{file} row 1", todo=TrackingFile.AGAIN)
    return found


def _detections(file: Path, cameras: Sequence[str]) -> pd.DataFrame:
    table = read_columns(file, DETECTIONS, optional=True)
    strange = ~table["camera"].isin(cameras).to_numpy(bool)
    if strange.any():
        row = int(np.flatnonzero(strange)[0])
        raise InputError(
            f"tracks.csv has no camera {table['camera'].iloc[row]!r}",
            where=f"{file} row {row + 2}",
            todo="the files are of two runs; " + TrackingFile.AGAIN,
        )
    found: pd.DataFrame = table.loc[np.isfinite(table["u_px"].to_numpy(float))]
    return found.reset_index(drop=True)


def _pictures(folder: Path, cameras: Sequence[str]) -> dict[tuple[str, str], Path]:
    found = {}
    for camera in cameras:
        for column, kind, suffix in (
            (camera, "overlays", ".jpg"),
            (binary_column(camera), "binary", ".png"),
        ):
            for file in sorted((folder / kind / camera).glob(f"*{suffix}")):
                found[column, file.stem] = file
    return found


def binary_column(camera: str) -> str:
    """Name of the contact sheet's column that holds a camera's binary pictures."""
    return f"{camera}, binary"
