"""What a tracked run's results folder holds, read and checked for its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.io.files.csv_table import Column
from telerig.io.report.page.results_files import check_kind, read_object
from telerig.io.report.page.results_tables import optional_columns, read_columns

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

SCHEMA = 1
UP = (0.0, -1.0, 0.0)
"""In the rig frame, where tracking.json has no ``up``."""

_AGAIN = "track again (`telerig track`), or name the right results folder"
_COVARIANCE = ["sxx_mm2", "sxy_mm2", "sxz_mm2", "syy_mm2", "syz_mm2", "szz_mm2"]
_POINT = ["x_mm", "y_mm", "z_mm"]
_SILHOUETTES = ["silhouettes_x_mm", "silhouettes_y_mm", "silhouettes_z_mm"]
_PIXEL = ["u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"]


@dataclass(frozen=True)
class TrackResults:
    """A results folder in memory.

    content : tracking.json as it stands. cameras : names, in the rig's order.
    tracks, detections, events, references : the tables; rows of detections.csv that only say why
        a frame has no bubble are left out (tracking.json counts them).
    up : (3,) unit vector in the rig frame.
    pictures : (camera or "camera, binary", frame as six digits) -> file.
    absent : what optional files are missing, in words.
    """

    content: Mapping[str, Any]
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
    def points_mm(self) -> Array:
        """(N, 3)."""
        return self.tracks[_POINT].to_numpy(float)

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
    def pairs(self) -> Mapping[str, Any]:
        return dict(self.content.get("pairs") or {})

    def image_size_px(self, camera: str) -> tuple[int, int] | None:
        """From tracking.json, if it tells."""
        size = (self.content.get("image_size_px") or {}).get(camera)
        return (int(size[0]), int(size[1])) if size else None


def read_track_results(folder: Path) -> TrackResults:
    """Read a tracked run's results folder.

    tracking.json and tracks.csv are needed; detections.csv, events.csv, references.csv, run.json,
    overlays/<camera>/<frame>.jpg and binary/<camera>/<frame>.png are used when they are there.
    Raises InputError for what is missing, cannot be read or does not fit together.
    """
    content = _content(folder / "tracking.json")
    cameras = _cameras(content, folder / "tracks.csv")
    tracks = read_columns(folder / "tracks.csv", _track_columns(cameras))
    detections = _detections(folder / "detections.csv", cameras)
    events = optional_columns(folder / "events.csv", _EVENTS)
    references = optional_columns(folder / "references.csv", _REFERENCES)
    run = read_object(folder / "run.json", _AGAIN) if (folder / "run.json").is_file() else {}
    pictures = _pictures(folder, cameras)
    absent = {
        "detections.csv (no numbers on single images)": (folder / "detections.csv").is_file(),
        "events.csv (no history of births, gaps and ends)": (folder / "events.csv").is_file(),
        "run.json (no versions, no hashes of what went in)": bool(run),
        "overlays/ and binary/ (no pictures of the bubbles that were found)": bool(pictures),
    }
    return TrackResults(
        content, cameras, tracks, detections, events, references, run, _up(content, folder),
        pictures,
        tuple(text for text, present in absent.items() if not present),
    )  # fmt: skip


def _content(file: Path) -> Mapping[str, Any]:
    if not file.is_file():
        raise InputError("no tracks here", where=str(file), todo="run `telerig track RUN` first")
    content = read_object(file, _AGAIN)
    check_kind(content, file, "tracks", SCHEMA, _AGAIN)
    expected = {
        "frames": int, "frames_without_bubbles": dict, "events": dict, "pairs": dict,
        "notes": list, "warnings": list, "worst_frames": list, "image_size_px": dict,
    }  # fmt: skip
    for name, kind in expected.items():
        if content.get(name) is not None and not isinstance(content[name], kind):
            raise InputError(f"garbles {name!r}", where=str(file), todo=_AGAIN)
    for i, frame in enumerate(content.get("worst_frames") or []):
        if not isinstance(frame, dict) or not isinstance(frame.get("frame"), int):
            raise InputError(f"garbles 'worst_frames'[{i}]", where=str(file), todo=_AGAIN)
    return content


def _up(content: Mapping[str, Any], folder: Path) -> Array:
    try:
        up = np.array(content.get("up") or UP, float).reshape(3)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"garbles 'up': {error}", where=str(folder / "tracking.json"), todo=_AGAIN
        ) from error
    return np.asarray(up / np.linalg.norm(up))


def _cameras(content: Mapping[str, Any], file: Path) -> tuple[str, ...]:
    """The two cameras that the header of tracks.csv names."""
    try:
        with file.open(encoding="utf-8-sig") as stream:
            header = [name.strip() for name in stream.readline().split(",")]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read: {error}", where=str(file), todo=_AGAIN) from error
    found = tuple(name.removesuffix("_u_px") for name in header if name.endswith("_u_px"))
    known = list(content.get("frames_without_bubbles") or found)
    if not found or sorted(known) != sorted(found):
        what = f"its columns are of cameras {list(found)}, tracking.json's are {known}"
        raise InputError(what, where=f"{file} row 1", todo=_AGAIN)
    return found


def _numbers(names: Sequence[str], *, required: bool = True) -> list[Column]:
    return [Column(name, required=required, blank=True) for name in names]


def _track_columns(cameras: Sequence[str]) -> list[Column]:
    per_camera = [f"{camera}_{name}" for camera in cameras for name in _PIXEL]
    return [
        Column("frame", "whole"),
        Column("particle", "whole"),
        Column("t_s"),
        *_numbers([*_POINT, *_COVARIANCE, *per_camera, "ray_miss_mm", "d_eq_mm", "confidence"]),
        *_numbers(["sd_eq_mm", *_SILHOUETTES], required=False),
        *(Column(name, "text", required=False, blank=True) for name in ("centre", "flags")),
    ]


_DETECTIONS = [
    Column("frame", "whole"),
    Column("camera", "text"),
    Column("particle", "whole", blank=True),
    *_numbers(["u_px", "v_px"]),
    *_numbers(["a_px", "b_px", "d_eq_px", "edge_px", "chi2_dof"], required=False),
    *(Column(name, "text", required=False, blank=True) for name in ("flags", "reason")),
]
_REFERENCES = [
    Column("frame", "whole"),
    Column("camera", "text"),
    Column("mark", "text"),
    *_numbers(["u_px", "v_px"]),
    *_numbers(["sigma_px"], required=False),
]
_EVENTS = [
    Column("frame", "whole"),
    Column("t_s", blank=True),
    Column("kind", "text"),
    Column("particles", "text", blank=True),
    Column("reason", "text", blank=True),
]


def _detections(file: Path, cameras: Sequence[str]) -> pd.DataFrame:
    table: pd.DataFrame = optional_columns(file, _DETECTIONS)
    strange = ~table["camera"].isin(cameras).to_numpy(bool)
    if strange.any():
        row = int(np.flatnonzero(strange)[0])
        raise InputError(
            f"tracks.csv has no camera {table['camera'].iloc[row]!r}",
            where=f"{file} row {row + 2}",
            todo="the files are of two runs; " + _AGAIN,
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
