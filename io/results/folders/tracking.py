"""What a tracked run's results folder holds, read and checked, and what its tables add up to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
from telerig.io.tables.table import POINT
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian
from telerig.statistics import median

_FILES = (
    "tracking.json", "tracks.csv", "detections.csv", "events.csv", "references.csv", "run.json"
)  # fmt: skip
UP = (0.0, -1.0, 0.0)
"""In the rig frame, where tracking.json has no ``up``."""


@dataclass(frozen=True)
class TrackResults:
    """A results folder in memory.

    file : tracking.json.
    cameras : names, in the rig's order.
    rig : these cameras; empty for a folder of an older version, whose tracking.json has none.
    tracks, detections, events, references : the tables; rows of detections.csv that only say why a
        frame has no bubble are left out (tracking.json counts them).
    up : (3,) unit vector in the rig frame.
    pictures : (camera, frame as six digits) -> file.
    absent : what optional files are missing, in words.
    """

    file: TrackingFile
    cameras: tuple[str, ...]
    rig: tuple[Camera, ...]
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
        """Return whether marks were followed in a camera's images."""
        return bool((self.references["camera"] == self.cameras[camera]).any())

    @property
    def pairs(self) -> Pairs:
        """Return what the run says of its pairs of cameras; an empty one where it says nothing."""
        return self.file.pairs or Pairs()

    def image_size_px(self, camera: str) -> tuple[int, int] | None:
        """Return a camera's image size; None if tracking.json does not state it."""
        return self.file.image_size_px.get(camera)


def read_track_results(folder: Path) -> TrackResults:
    """Read a tracked run's results folder.

    tracking.json and tracks.csv are needed; detections.csv, events.csv, references.csv, run.json,
    overlays/<camera>/<frame>.jpg are used when they are there.
    Raises InputError for what is missing, cannot be read or does not fit together.
    """
    with reading(folder, _FILES):
        return _read_track_results(folder)


def _read_track_results(folder: Path) -> TrackResults:
    stated = TrackingFile.read(folder / "tracking.json")
    file = folder / "tracks.csv"
    header = header_of(file, TrackingFile.AGAIN)
    cameras = tuple(name.removesuffix("_u_px") for name in header if name.endswith("_u_px"))
    known = list(stated.frames_without_bubbles or cameras)
    if not cameras or sorted(known) != sorted(cameras):
        what = f"its columns are of cameras {list(cameras)}, tracking.json's are {known}"
        raise InputError(what, where=f"{file} row 1", todo=TrackingFile.AGAIN)
    tables = {
        one.file: one.read_known(folder / one.file, optional=True)
        for one in (DETECTIONS, EVENTS, REFERENCES)
    }
    found = tables[DETECTIONS.file]
    camera = found["camera"].to_numpy()
    Rows(folder / "detections.csv", np.arange(len(found)) + 2).refuse(
        ~np.isin(camera, cameras),
        "camera",
        lambda i: f"tracks.csv has no camera {camera[i]!r}",
        "the files are of two runs; " + TrackingFile.AGAIN,
    )
    run = RunFile.read_if_there(folder / "run.json").content()
    pictures = {
        (camera, picture.stem): picture
        for camera in cameras
        for picture in sorted((folder / "overlays" / camera).glob("*.jpg"))
    }
    absent = {
        "detections.csv (no numbers on single images)": (folder / "detections.csv").is_file(),
        "events.csv (no history of births, gaps and ends)": (folder / "events.csv").is_file(),
        "run.json (no versions, no options)": bool(run),
        "overlays/ (no pictures of the bubbles that were found)": bool(pictures),
    }
    return TrackResults(
        file=stated,
        cameras=cameras,
        rig=_rig(stated, cameras, folder),
        tracks=TRACKS.read_known(file, cameras),
        detections=found[np.isfinite(found["u_px"])].reset_index(drop=True),
        events=tables[EVENTS.file],
        references=tables[REFERENCES.file],
        run=run,
        up=unit_vector(UP if stated.up is None else stated.up),
        pictures=pictures,
        absent=tuple(text for text, present in absent.items() if not present),
    )


def _rig(stated: TrackingFile, names: tuple[str, ...], folder: Path) -> tuple[Camera, ...]:
    """Return the cameras of tracks.csv."""
    known = {camera.name: camera for camera in stated.rig_cameras()}
    if known and not set(names) <= set(known):
        what = f"its cameras are {list(known)}, those of tracks.csv {list(names)}"
        raise InputError(what, where=str(folder / "tracking.json"), todo=TrackingFile.AGAIN)
    return tuple(known[name] for name in names if known)


def unit_vector(vector: ArrayLike) -> Array:
    """Return a vector divided by its length."""
    found = np.asarray(vector, float)
    return np.asarray(found / np.linalg.norm(found))


NORMAL_MEDIAN = 0.6745
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
    tables = (results.tracks, results.detections)
    seen = max((int(t["frame"].max()) + 1 for t in tables if len(t)), default=0)
    return max(results.file.frames or 0, seen)


def per_frame(results: TrackResults) -> dict[str, Ints]:
    """Bubbles in each frame (F,): by camera, and "both" for those with a place in space."""
    frames = frame_count(results)
    found = results.detections
    counts = {
        camera: np.bincount(found["frame"][found["camera"] == camera], minlength=frames)
        for camera in results.cameras
    }
    return counts | {"both": np.bincount(results.tracks["frame"], minlength=frames)}


def track_lengths(results: TrackResults) -> Ints:
    """Return the number of points (K,) of each track."""
    return np.asarray(results.tracks["particle"].value_counts().to_numpy(np.int64))
