"""The tracks of a run, in memory or on disk, as a smoothing problem has them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.estimator.sensors.given import numbers, times
from telerig.estimator.smoothing.problem.problem import Bubble, Observations
from telerig.rig.camera import Camera

if TYPE_CHECKING:
    import pandas as pd


_PIXELS = ("u_px", "v_px", "suu_px2", "suv_px2", "svv_px2")
_LOOSE_PX = 0.5
"""Added in quadrature where a bubble's centre of volume would need a view that is missing."""

_SHARPEST_PX = 0.01
"""Added in quadrature to the standard deviation of each centre: tables may state next to none."""

_SOME, _FRAMES_AT_ONCE = 200, 2000


def frames_between(tracks: Any, first: int, end: int) -> Any:
    """Return `Tracks` or a table of tracks in the frames from ``first`` to before ``end``."""
    if tracks is None:
        return None
    if hasattr(tracks, "between"):
        return tracks.between(first, end)
    if hasattr(tracks, "table"):
        parts = {name: getattr(tracks, name) for name in ("table", "detections")}
        return replace(tracks, **{n: frames_between(part, first, end) for n, part in parts.items()})
    return tracks[(tracks["frame"] >= first) & (tracks["frame"] < end)]


@dataclass(frozen=True)
class Tracked:
    """The tracks of a run in the form that the smoothing needs.

    tracks : the tracks as they were given.
    sample : some rows of their table, evenly spread; all rows of a table in memory.
    particles : numbers of the bubbles, in ascending order.
    observations : pixels of the bubbles, with indices into ``particles``.
    t_s : (F,) times of the frames.
    places : for each bubble its first frame, and its positions (n, 3) in mm in the rig frame from
        this frame on, NaN in frames without a position.
    """

    tracks: Any
    sample: pd.DataFrame
    particles: list[int]
    observations: Observations
    t_s: Array
    places: list[tuple[int, Array]]

    def between(self, first: int, end: int) -> pd.DataFrame:
        """Return the table's rows in the frames from ``first`` to before ``end``."""
        rows: pd.DataFrame = frames_between(getattr(self.tracks, "table", self.tracks), first, end)
        return rows


def read_tracks(tracks: Any, cameras: Sequence[Camera], frame_times_s: Array | None) -> Tracked:
    """Read the pixels of bubbles from tracks and from detections that only one camera made.

    tracks : `Tracks`, `StoredTracks`, or a table with the columns of tracks.csv.
    frame_times_s : (F,) times of the frames; None to take them from the tracks.

    Raises InputError for missing columns, cameras that the calibration does not have, and NaN.
    """
    ends: dict[int, tuple[int, int]] = {}
    corrected, samples, times_of = {c.name: False for c in cameras}, [], []
    for table, _ in parts_of(tracks):
        _check(table, cameras)
        spans = table.groupby("particle")["frame"].agg(["min", "max"])
        for particle, low, high in zip(spans.index, spans["min"], spans["max"]):
            before = ends.get(int(particle), (low, high))
            ends[int(particle)] = min(int(low), before[0]), max(int(high), before[1])
        for camera in cameras:
            corrected[camera.name] |= _corrected(table, camera.name)
        samples.append(table if _in_memory(tracks) else table.iloc[:: len(table) // _SOME + 1])
        if frame_times_s is None and "t_s" in table:
            times_of.append(table.drop_duplicates("frame")[["frame", "t_s"]])
    import pandas as pd

    sample = samples[0] if len(samples) == 1 else pd.concat(samples, ignore_index=True)
    known = pd.concat(times_of, ignore_index=True) if times_of else sample
    t_s = _times(known, max(last for _, last in ends.values()), frame_times_s)
    particles = sorted(ends)
    number = {p: i for i, p in enumerate(particles)}
    places = [(ends[p][0], np.full((ends[p][1] - ends[p][0] + 1, 3), np.nan)) for p in particles]
    files = None if _in_memory(tracks) else (TemporaryFile(), TemporaryFile())  # noqa: SIM115
    store = _Store(files)
    for table, detections in parts_of(tracks):
        _place(table, number, places)
        parts = [_paired(table, c, camera.name, number) for c, camera in enumerate(cameras)]
        if detections is not None and "particle" in detections:
            parts += [
                _single(table, detections, c, camera.name, number, ends, corrected)
                for c, camera in enumerate(cameras)
            ]
        found = Observations(*(np.concatenate(p) for p in zip(*parts)))
        store.add(found.of(np.lexsort((found.camera, found.item, found.frame))))
    return Tracked(tracks, sample, particles, store.observations(), t_s, places)


def _in_memory(tracks: Any) -> bool:
    return not hasattr(tracks, "between")


def parts_of(tracks: Any) -> Iterator[tuple[pd.DataFrame, pd.DataFrame | None]]:
    """Yield tables of tracks and of detections: one pair, or one for each part of stored tracks."""
    if _in_memory(tracks):
        yield getattr(tracks, "table", tracks), getattr(tracks, "detections", None)
        return
    for first in range(0, int(tracks.table.last[-1]) + 1, _FRAMES_AT_ONCE):
        part = tracks.between(first, first + _FRAMES_AT_ONCE)
        if len(part.table):
            yield part.table, part.detections


def _place(table: pd.DataFrame, number: dict[int, int], places: list[tuple[int, Array]]) -> None:
    """Copy the positions of a table into those of the bubbles."""
    frame, item = table["frame"].to_numpy(np.int64), table["particle"].map(number).to_numpy()
    points = table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    order = np.argsort(item, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(item[order])) + 1):
        first, place = places[int(item[mine[0]])]
        place[frame[mine] - first] = points[mine]


@dataclass
class _Store:
    """Collects observations in memory, or their pixels in files.

    files : of uv_px and covariance_px2, which vanish with the process; None for memory.
    """

    files: tuple[IO[bytes], IO[bytes]] | None
    parts: list[Observations] = field(default_factory=list)

    def add(self, part: Observations) -> None:
        if self.files is not None:
            for file, values in zip(self.files, (part.uv_px, part.covariance_px2)):
                file.write(np.ascontiguousarray(values).tobytes())
            none = Observations.none()
            part = replace(
                part, item=part.item.astype(np.int32), frame=part.frame.astype(np.int32),
                camera=part.camera.astype(np.int8), uv_px=none.uv_px,
                covariance_px2=none.covariance_px2,
            )  # fmt: skip
        self.parts.append(part)

    def observations(self) -> Observations:
        names = ("item", "frame", "camera", "uv_px", "covariance_px2")
        joined = [np.concatenate([getattr(p, name) for p in self.parts]) for name in names]
        if self.files is not None:
            count = len(joined[0])
            shapes: tuple[tuple[int, ...], ...] = (count, 2), (count, 2, 2)
            joined[3:] = [
                cast("Array", OnDisk(file, shape)) for file, shape in zip(self.files, shapes)
            ]
        return Observations(*joined)


@dataclass(frozen=True)
class OnDisk:
    """An array of numbers in a temporary file; parts of it are read when needed."""

    file: IO[bytes] = field(repr=False)
    shape: tuple[int, ...]

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, which: Any) -> Array:
        self.file.flush()
        return np.array(np.memmap(self.file, np.float64, "r", shape=self.shape)[which])


def _check(table: pd.DataFrame, cameras: Sequence[Camera]) -> None:
    if len(cameras) < 2:
        raise InputError(
            "bubbles are smoothed with two cameras or more, and the calibration has one",
            where="tracks",
            todo="give the calibration of all cameras of the run",
        )
    needed = ["frame", "particle", "x_mm", "y_mm", "z_mm"]
    needed += [f"{c.name}_{column}" for c in cameras for column in _PIXELS]
    missing = [column for column in needed if column not in table]
    if missing:
        raise InputError(
            f"the tracks have no column {', '.join(missing[:4])}",
            where="tracks",
            todo="give the tracks.csv that `telerig track` wrote with this calibration",
        )
    if not len(table):
        raise InputError(
            "the tracks have no rows: no bubble was followed", where="tracks",
            todo="look at the report of `telerig track` for the reasons, and track again",
        )  # fmt: skip
    names = [p for p in table["particle"].unique() if isinstance(p, str)]
    if names:
        raise InputError(
            f"particle {names[0]!r} is no whole number",
            where="tracks",
            todo="number the bubbles in detections.csv and track them again",
        )
    values = np.stack([numbers(table[column], "tracks", column) for column in needed], -1)
    seen = values[:, 5:].reshape(len(values), len(cameras), -1)
    # a camera that does not see the bubble has no number in the row
    bad = ~np.isfinite(values[:, :5]).all(1) | (np.isnan(seen).all(-1).sum(1) > len(cameras) - 2)
    bad |= ~(np.isfinite(seen) | np.isnan(seen).all(-1, keepdims=True)).all((1, 2))
    if bad.any():
        raise InputError(
            f"{int(bad.sum())} rows hold values that are not finite, the first is row "
            f"{int(np.flatnonzero(bad)[0]) + 2}",
            where="tracks",
            todo="leave those rows out",
        )
    for number, column in enumerate(("frame", "particle")):
        whole = values[:, number] == np.floor(values[:, number])
        wrong = np.flatnonzero(~whole | ((column == "frame") & (values[:, number] < 0)))
        if len(wrong):
            raise InputError(
                f"{column} is {values[wrong[0], number]:g} in row {int(wrong[0]) + 2}",
                where="tracks",
                todo="give whole numbers; frames count from 0",
            )
    if table.duplicated(["frame", "particle"]).any():
        row = int(np.flatnonzero(table.duplicated(["frame", "particle"]))[0]) + 2
        raise InputError(
            f"row {row} repeats a frame of a particle", where="tracks", todo="keep one of them"
        )


def _times(table: pd.DataFrame, last: int, frame_times_s: Array | None) -> Array:
    """Return the times of frames 0 to ``last``, from a table if they are not given."""
    if frame_times_s is not None:
        if len(frame_times_s) <= last:
            raise InputError(
                f"there are {len(frame_times_s)} frame times, but tracks reach frame {last}",
                todo="give the times of all frames of the run",
            )
        return np.asarray(frame_times_s, float)
    if "t_s" not in table:
        raise InputError("the tracks have no times", todo="give a column t_s, or t_s=")
    first = table.drop_duplicates("frame").sort_values("frame")
    known, t = first["frame"].to_numpy(float), times(first["t_s"], "tracks")
    frames = np.arange(last + 1)
    if len(known) < 2:
        raise InputError("the tracks cover one frame", todo="give at least two frames")
    step = float(np.median(np.diff(t) / np.diff(known)))
    before = t[0] + (frames - known[0]) * step
    return np.asarray(np.where(frames < known[0], before, np.interp(frames, known, t)))


def _paired(
    table: pd.DataFrame, index: int, camera: str, number: dict[int, int]
) -> tuple[Any, ...]:
    """Return one camera's detections of bubbles that several see, corrected to the projected centre
    of volume where it is known."""
    columns = [f"{camera}_{c}" for c in _PIXELS]
    values = table[columns].to_numpy(float)
    shift = [f"{camera}_du_px", f"{camera}_dv_px"]
    uv = values[:, :2].copy()
    if all(c in table for c in shift):
        uv += np.nan_to_num(table[shift].to_numpy(float))
    seen = np.isfinite(values).all(1)
    item = table["particle"].map(number).to_numpy(np.int64)[seen]
    frame = table["frame"].to_numpy(np.int64)[seen]
    return item, frame, np.full(len(item), index), uv[seen], _covariance(values[seen], camera)


def _single(
    table: pd.DataFrame,
    detections: pd.DataFrame,
    index: int,
    camera: str,
    number: dict[int, int],
    ends: dict[int, tuple[int, int]],
    corrected: dict[str, bool],
) -> tuple[Any, ...]:
    """Return the detections of tracks in frames in which only this camera sees the bubble."""
    rows = detections[(detections["camera"] == camera) & detections["particle"].notna()]
    ids = rows["particle"].to_numpy(float).astype(np.int64)
    paired = set(zip(table["frame"].tolist(), table["particle"].tolist()))
    inside = [
        p in number and (f, p) not in paired and ends[p][0] <= f <= ends[p][1]
        for f, p in zip(rows["frame"].tolist(), ids.tolist())
    ]
    kept = np.array(inside, bool) if inside else np.zeros(0, bool)
    rows, ids = rows[kept], ids[kept]
    values = np.array(rows[list(_PIXELS)], float)
    values[~np.isfinite(values).all(1), 2:] = 1.0, 0.0, 1.0
    good = np.isfinite(values[:, :2]).all(1)
    values, ids = values[good], ids[good]
    frame = rows["frame"].to_numpy(np.int64)[good]
    item = np.array([number[int(p)] for p in ids], np.int64)
    # its own correction towards the centre of volume needs both views
    loose = _covariance(values, camera) + _LOOSE_PX**2 * np.eye(2) * corrected[camera]
    return item, frame, np.full(len(item), index), values[:, :2], loose


def _corrected(table: pd.DataFrame, camera: str) -> bool:
    column = f"{camera}_du_px"
    return column in table and bool(np.any(np.nan_to_num(table[column].to_numpy(float))))


def _covariance(values: Array, camera: str) -> Array:
    """Return the covariances (n, 2, 2) of pixels; InputError for one that is not positive."""
    out = values[:, [2, 3, 3, 4]].reshape(-1, 2, 2) + _SHARPEST_PX**2 * np.eye(2)
    wrong = np.flatnonzero((out[:, 0, 0] <= 0) | (np.linalg.det(out) <= 0))
    if len(wrong):
        shown = ", ".join(f"{v:g}" for v in values[wrong[0], 2:])
        raise InputError(
            f"suu_px2, suv_px2, svv_px2 of camera {camera} are {shown}, which is no covariance",
            where="tracks",
            todo="state variances that are positive, and a covariance less than their mean",
        )
    return np.asarray(out)


def bubbles_of(tracked: Tracked, positions_mm: Array, axis: Array) -> tuple[Bubble, ...]:
    """Return the bubbles with positions in the laboratory, linearly interpolated over gaps."""
    out, t = [], tracked.t_s
    for particle, (first, places) in zip(tracked.particles, tracked.places):
        frames = first + np.flatnonzero(np.isfinite(places[:, 0]))
        lab = places[frames - first] + positions_mm[frames, None] * axis
        every = np.arange(first, first + len(places))
        guess = np.stack([np.interp(t[every], t[frames], column) for column in lab.T], -1)
        out.append(Bubble(particle, int(every[0]), int(every[-1]), guess[0], guess))
    return tuple(out)
