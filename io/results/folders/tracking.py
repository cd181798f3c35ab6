"""What a tracked run's results folder holds, read and checked, and what its tables add up to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from telerig.arrays import Array, Ints
from telerig.errors import InputError
from telerig.io.files.csv_table import Rows, header_of
from telerig.io.results.manifest import reading
from telerig.io.results.record import RunFile
from telerig.io.results.tracking import Pairs, TrackingFile
from telerig.io.tables.run import DETECTIONS, EVENTS, REFERENCES, TRACKS
from telerig.io.tables.table import POINT, Table
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian
from telerig.statistics import NORMAL_FROM_MEDIAN, median

UP = (0.0, -1.0, 0.0)
"""In the rig frame, where tracking.json has no ``up``."""


@dataclass(frozen=True)
class TrackResults:
    """The results folder of a tracked run; each file is read and checked when it is asked for.

    Reading raises InputError for what is missing, cannot be read or does not fit together.
    """

    folder: Path

    FILES: ClassVar[tuple[str, ...]] = (
        "tracking.json", "tracks.csv", "detections.csv", "events.csv", "references.csv", "run.json",
    )  # fmt: skip
    NEED: ClassVar[tuple[str, ...]] = ("frame", "particle", "t_s", *POINT)
    """Columns of tracks.csv without which it is no table of tracks."""

    @cached_property
    def file(self) -> TrackingFile:
        """tracking.json."""
        return TrackingFile.read(self.folder / "tracking.json")

    @property
    def content(self) -> Mapping[str, Any]:
        """tracking.json as it stands."""
        return self.file.content()

    @cached_property
    def tracks(self) -> pd.DataFrame:
        """tracks.csv, also with columns that telerig does not know; ids may be names."""
        return read_track_table(self.folder / "tracks.csv")

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Names, in the order of the columns."""
        found = _cameras_of(self.tracks.columns)
        known = list(self.file.frames_without_bubbles or found)
        if sorted(known) != sorted(found):
            what = f"its columns are of cameras {list(found)}, tracking.json's are {known}"
            raise InputError(
                what, where=f"{self.folder / 'tracks.csv'} row 1", todo=TrackingFile.AGAIN
            )
        return found

    @cached_property
    def rig(self) -> tuple[Camera, ...]:
        """These cameras; empty where tracking.json has none."""
        known = {camera.name: camera for camera in self.file.rig_cameras()}
        if known and not set(self.cameras) <= set(known):
            what = f"its cameras are {list(known)}, those of tracks.csv {list(self.cameras)}"
            raise InputError(
                what, where=str(self.folder / "tracking.json"), todo=TrackingFile.AGAIN
            )
        return tuple(known[name] for name in self.cameras if known)

    def has(self, name: str) -> bool:
        """Return whether the folder has a file."""
        return (self.folder / name).is_file()

    def _table(self, table: Table) -> pd.DataFrame:
        return table.read(self.folder / table.file, optional=True)

    @cached_property
    def detections(self) -> pd.DataFrame:
        """detections.csv, with the rows that only say why an image gave nothing."""
        found = self._table(DETECTIONS)
        camera = found["camera"].to_numpy()
        Rows(self.folder / "detections.csv", np.arange(len(found)) + 2).refuse(
            ~np.isin(camera, self.cameras or camera),
            "camera",
            lambda i: f"tracks.csv has no camera {camera[i]!r}",
            "the files are of two runs; " + TrackingFile.AGAIN,
        )
        return found

    @cached_property
    def outlines(self) -> pd.DataFrame:
        """The rows of detections.csv that have a place."""
        found: pd.DataFrame = self.detections[np.isfinite(self.detections["u_px"])]
        return found.reset_index(drop=True)

    @cached_property
    def events(self) -> pd.DataFrame:
        """events.csv."""
        return self._table(EVENTS)

    @cached_property
    def references(self) -> pd.DataFrame:
        """references.csv."""
        return self._table(REFERENCES)

    @cached_property
    def run(self) -> Mapping[str, Any]:
        """run.json."""
        return RunFile.read_if_there(self.folder / "run.json").content()

    @cached_property
    def up(self) -> Array:
        """(3,) unit vector in the rig frame."""
        return unit_vector(UP if self.file.up is None else self.file.up)

    @cached_property
    def pictures(self) -> Mapping[tuple[str, str], Path]:
        """(camera, frame as six digits) -> file."""
        return {
            (camera, picture.stem): picture
            for camera in self.cameras
            for picture in sorted((self.folder / "overlays" / camera).glob("*.jpg"))
        }

    @property
    def absent(self) -> tuple[str, ...]:
        """What optional files are missing, in words."""
        there = {
            "detections.csv (no numbers on single images)": self.has("detections.csv"),
            "events.csv (no history of births, gaps and ends)": self.has("events.csv"),
            "run.json (no versions, no options)": bool(self.run),
            "overlays/ (no pictures of the bubbles that were found)": bool(self.pictures),
        }
        return tuple(text for text, present in there.items() if not present)

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
        """Return whether marks were followed in a camera's images."""
        return bool((self.references["camera"] == self.cameras[camera]).any())

    @property
    def pairs(self) -> Pairs:
        """Return what the run says of its pairs of cameras; an empty one where it says nothing."""
        return self.file.pairs or Pairs()

    @property
    def image_sizes_px(self) -> dict[str, tuple[int, int]]:
        """Return the image sizes by camera, as far as tracking.json states them."""
        return {name: size for name, size in self.file.image_size_px.items() if size is not None}


def read_track_table(file: Path) -> pd.DataFrame:
    """Read tracks.csv, or a table of tracks that another program made.

    Returns all columns of the file. Raises InputError for a table without frame, particle, t_s and
    the position (mm), and for cells that are not what their column says.
    """
    cameras = _cameras_of(header_of(file, TrackingFile.AGAIN))
    return TRACKS.read(file, cameras, need=TrackResults.NEED)


def _cameras_of(columns: Iterable[str]) -> tuple[str, ...]:
    return tuple(name.removesuffix("_u_px") for name in columns if name.endswith("_u_px"))


def read_track_results(folder: Path) -> TrackResults:
    """Read a tracked run's results folder for a page, a film or the viewer.

    tracking.json and tracks.csv are needed, with all columns that telerig writes and with whole
    numbers as ids; detections.csv, events.csv, references.csv, run.json and
    overlays/<camera>/<frame>.jpg are used when they are there. Raises InputError for anything else.
    """
    results = TrackResults(folder)
    with reading(folder, TrackResults.FILES):
        file = folder / "tracks.csv"
        needed = [one.name for one in TRACKS.of(results.cameras) if one.required]
        lacking = [name for name in needed if name not in results.tracks]
        if lacking or not results.cameras:
            named = repr(lacking[0]) if lacking else "of a camera's pixels, like 'left_u_px'"
            what = f"has no column {named}, which a page needs"
            raise InputError(what, where=f"{file} row 1", todo=TrackingFile.AGAIN)
        for table, place in (
            (results.tracks, file),
            (results.detections, folder / DETECTIONS.file),
        ):
            ids = table["particle"]
            names = [] if ids.dtype.kind in "if" else [name for name in ids.unique() if name]
            if names:
                name = next((n for n in names if not n.isdecimal()), names[0])
                raise InputError(
                    f"particle {name!r} is no whole number, which a page needs",
                    where=f"{place}, column particle",
                    todo="number the bubbles in the run's detections.csv, and track again",
                )
        _ = results.rig, results.events, results.references, results.run, results.up
    return results


def unit_vector(vector: ArrayLike) -> Array:
    """Return a vector divided by its length."""
    found = np.asarray(vector, float)
    return np.asarray(found / np.linalg.norm(found))


NORMAL_MEDIAN = 1 / NORMAL_FROM_MEDIAN
"""Of the absolute value, in standard deviations."""


def ray_miss_sd_mm(results: TrackResults) -> Array | None:
    """(N,) sd of ``ray_miss_mm`` that the outlines' covariances predict; None if it is not known.

    The cameras' magnification and directions are those in the middle of the points.
    """
    worth = _mm_per_px(results)
    if worth is None:
        return None
    variance = np.zeros(len(results.tracks))
    for camera, per_px in zip(results.cameras, worth):
        columns = [f"{camera}_{name}" for name in ("suu_px2", "suv_px2", "svv_px2")]
        uu, uv, vv = np.nan_to_num(results.tracks[columns].to_numpy(float)).T
        variance += per_px[0] ** 2 * uu + 2 * per_px[0] * per_px[1] * uv + per_px[1] ** 2 * vv
    if len(results.cameras) > 2:  # of n rays the deviations have 2 n - 3 degrees of freedom
        many = views(results)
        variance *= np.where(many > 2, (2 * many - 3) / np.maximum(many, 1) ** 2, 1.0)
    return np.sqrt(np.where(variance > 0, variance, np.nan))


def views(results: TrackResults) -> Ints:
    """Return how many cameras (N,) see the bubble of each row."""
    return np.asarray(results.tracks[[f"{c}_u_px" for c in results.cameras]].notna().sum(axis=1))


def learnt_sd_mm(results: TrackResults) -> float | None:
    """Return the sd of ray misses beyond the outlines' noise, by shake and shapes.

    From ``frame_px`` and ``scatter_px`` of tracking.json; None where that is not known.
    """
    worth = _mm_per_px(results)
    frame, scatter = results.pairs.frame_px, results.pairs.scatter_px
    if worth is None or frame is None or scatter is None:
        return None
    apart_px = np.linalg.norm(np.array([frame, scatter], float))
    return float(apart_px * np.linalg.norm(worth, axis=1).mean())


def _mm_per_px(results: TrackResults) -> Array | None:
    """Return by camera what one px of u and v moves a ray along the common perpendicular; of more
    than two cameras in any direction across the ray."""
    if len(results.rig) < 2 or not len(results.tracks):
        return None
    middle = np.nanmedian(results.points_mm, axis=0)
    known = stacked_jacobian(results.rig, middle[None])[1].reshape(-1, 2, 3)
    if len(known) > 2:
        scale = [float(np.linalg.det(m @ m.T)) ** 0.25 for m in known]
        return np.repeat(np.sqrt(0.5) / np.array(scale)[:, None], 2, axis=1)
    first, second = (np.cross(m[0], m[1]) for m in known)
    across = np.cross(first, second)
    length = np.linalg.norm(across)
    if length < 1e-9:
        return None
    return np.array([np.linalg.lstsq(m.T, across / length, rcond=None)[0] for m in known])


def ray_miss_ratio(
    results: TrackResults, predicted_mm: Array | None, *, centred: bool = False
) -> float | None:
    """Typical ray miss over its predicted sd: 1 when the covariances tell the whole story.

    From the medians, so that a few wrong pairs do not count. centred : about the median miss.
    """
    if predicted_mm is None:
        return None
    miss = results.tracks["ray_miss_mm"].to_numpy(float)
    if len(results.cameras) > 2:
        from scipy.special import chdtri

        free = np.maximum(2 * views(results) - 3, 1)
        predicted_mm = predicted_mm * np.sqrt(chdtri(free, 0.5) / free) / NORMAL_MEDIAN
    centred &= len(results.cameras) == 2
    units = np.abs(miss - (median(miss) or 0.0 if centred else 0.0)) / predicted_mm
    units = units[np.isfinite(units)]
    return float(np.median(units)) / NORMAL_MEDIAN if len(units) else None


def frame_count(results: TrackResults) -> int:
    """Return the number of frames of the run, or up to the last one with a bubble."""
    tables = (results.tracks, results.outlines)
    seen = max((int(t["frame"].max()) + 1 for t in tables if len(t)), default=0)
    return max(results.file.frames or 0, seen)


def per_frame(results: TrackResults) -> dict[str, Ints]:
    """Bubbles in each frame (F,): by camera, and "both" for those with a place in space."""
    frames = frame_count(results)
    found = results.outlines
    counts = {
        camera: np.bincount(found["frame"][found["camera"] == camera], minlength=frames)
        for camera in results.cameras
    }
    return counts | {"both": np.bincount(results.tracks["frame"], minlength=frames)}


def track_lengths(results: TrackResults) -> Ints:
    """Return the number of points (K,) of each track."""
    return np.asarray(results.tracks["particle"].value_counts().to_numpy(np.int64))
