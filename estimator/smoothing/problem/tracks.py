"""Tracks as the smoother takes them: pixels of each bubble in each camera, frame times, guesses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.estimator.smoothing.problem.problem import Bubble, Observations

if TYPE_CHECKING:
    import pandas as pd

    from telerig.rig.camera import Camera


_PIXELS = ("u_px", "v_px", "suu_px2", "suv_px2", "svv_px2")
_LOOSE_PX = 0.5
_SHARPEST_PX = 0.01
"""Standard deviation added to that of each centre, since tables may state next to none."""


@dataclass(frozen=True)
class Tracked:
    """table : rows of tracks.csv that are used.  particles : their ids, in order.

    observations : of the bubbles by their index in ``particles``.
    """

    table: pd.DataFrame
    particles: list[int]
    observations: Observations
    t_s: Array


def read_tracks(tracks: Any, cameras: Sequence[Camera], frame_times_s: Array | None) -> Tracked:
    """Pixels out of a tracks table, and of detections that only one camera made.

    tracks : `Tracks`, or a table with the columns of tracks.csv.
    Raises InputError for missing columns, cameras that the calibration does not have, NaN.
    """
    table = getattr(tracks, "table", tracks)
    detections = getattr(tracks, "detections", None)
    _check(table, cameras)
    t_s = _times(table, frame_times_s)
    particles = sorted(int(p) for p in table["particle"].unique())
    number = {p: i for i, p in enumerate(particles)}
    parts = [_paired(table, c, camera.name, number) for c, camera in enumerate(cameras)]
    if detections is not None and "particle" in detections:
        parts += [
            _single(table, detections, c, camera.name, number) for c, camera in enumerate(cameras)
        ]
    joined = [np.concatenate(p) for p in zip(*parts)]
    observations = Observations(*joined)
    order = np.lexsort((observations.camera, observations.item, observations.frame))
    return Tracked(table, particles, observations.of(order), t_s)


def _check(table: pd.DataFrame, cameras: Sequence[Camera]) -> None:
    needed = ["frame", "particle", "x_mm", "y_mm", "z_mm"]
    needed += [f"{c.name}_{column}" for c in cameras for column in _PIXELS]
    missing = [column for column in needed if column not in table]
    if missing:
        raise InputError(
            f"the tracks have no column {', '.join(missing[:4])}",
            where="tracks",
            todo="give the tracks.csv that `telerig track` wrote with this calibration",
        )
    names = [p for p in table["particle"].unique() if isinstance(p, str)]
    if names:
        raise InputError(
            f"particle {names[0]!r} is no whole number",
            where="tracks",
            todo="number the bubbles in detections.csv and track them again",
        )
    values = table[needed].to_numpy(float)
    bad = ~np.isfinite(values).all(1)
    if bad.any():
        raise InputError(
            f"{int(bad.sum())} rows hold values that are not finite, the first is row "
            f"{int(np.flatnonzero(bad)[0]) + 2}",
            where="tracks",
            todo="leave those rows out",
        )
    if table.duplicated(["frame", "particle"]).any():
        row = int(np.flatnonzero(table.duplicated(["frame", "particle"]))[0]) + 2
        raise InputError(
            f"row {row} repeats a frame of a particle", where="tracks", todo="keep one of them"
        )


def _times(table: pd.DataFrame, frame_times_s: Array | None) -> Array:
    last = int(table["frame"].max())
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
    known, t = first["frame"].to_numpy(float), first["t_s"].to_numpy(float)
    frames = np.arange(last + 1)
    if len(known) < 2:
        raise InputError("the tracks cover one frame", todo="give at least two frames")
    step = float(np.median(np.diff(t) / np.diff(known)))
    before = t[0] + (frames - known[0]) * step
    return np.asarray(np.where(frames < known[0], before, np.interp(frames, known, t)))


def _paired(
    table: pd.DataFrame, index: int, camera: str, number: dict[int, int]
) -> tuple[Any, ...]:
    """The bubbles that both cameras saw, corrected towards the centre of volume where known."""
    columns = [f"{camera}_{c}" for c in _PIXELS]
    values = table[columns].to_numpy(float)
    shift = [f"{camera}_du_px", f"{camera}_dv_px"]
    uv = values[:, :2].copy()
    if all(c in table for c in shift):
        uv += np.nan_to_num(table[shift].to_numpy(float))
    item = table["particle"].map(number).to_numpy(np.int64)
    frame = table["frame"].to_numpy(np.int64)
    return item, frame, np.full(len(table), index), uv, _covariance(values)


def _single(
    table: pd.DataFrame, detections: pd.DataFrame, index: int, camera: str, number: dict[int, int]
) -> tuple[Any, ...]:
    """Detections of a track in frames in which the other camera did not see it."""
    rows = detections[(detections["camera"] == camera) & detections["particle"].notna()]
    ids = rows["particle"].to_numpy(float).astype(np.int64)
    paired = set(zip(table["frame"].tolist(), table["particle"].tolist()))
    ends = {p: (f.min(), f.max()) for p, f in table.groupby("particle")["frame"]}
    inside = [
        p in number and (f, p) not in paired and ends[p][0] <= f <= ends[p][1]
        for f, p in zip(rows["frame"].tolist(), ids.tolist())
    ]
    kept = np.array(inside, bool) if inside else np.zeros(0, bool)
    rows, ids = rows[kept], ids[kept]
    values = rows[list(_PIXELS)].to_numpy(float)
    values = np.where(np.isfinite(values), values, np.array([np.nan, np.nan, 1.0, 0.0, 1.0]))
    good = np.isfinite(values).all(1)
    values, ids = values[good], ids[good]
    frame = rows["frame"].to_numpy(np.int64)[good]
    item = np.array([number[int(p)] for p in ids], np.int64)
    # its own correction towards the centre of volume needs both views
    loose = _covariance(values) + _LOOSE_PX**2 * np.eye(2) * _corrected(table, camera)
    return item, frame, np.full(len(item), index), values[:, :2], loose


def _corrected(table: pd.DataFrame, camera: str) -> bool:
    column = f"{camera}_du_px"
    return column in table and bool(np.any(np.nan_to_num(table[column].to_numpy(float))))


def _covariance(values: Array) -> Array:
    a, b, c = values[:, 2], values[:, 3], values[:, 4]
    stated = np.stack([np.stack([a, b], -1), np.stack([b, c], -1)], -2)
    return np.asarray(stated + _SHARPEST_PX**2 * np.eye(2))


def bubbles_of(tracked: Tracked, positions_mm: Array, axis: Array) -> tuple[Bubble, ...]:
    """Every bubble with its lab positions from triangulation, straight lines over its gaps."""
    out = []
    for particle in tracked.particles:
        rows = tracked.table[tracked.table["particle"] == particle].sort_values("frame")
        frames = rows["frame"].to_numpy(np.int64)
        lab = rows[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
        lab = lab + positions_mm[frames, None] * axis
        every = np.arange(frames[0], frames[-1] + 1)
        t = tracked.t_s
        guess = np.stack([np.interp(t[every], t[frames], column) for column in lab.T], -1)
        out.append(Bubble(particle, int(every[0]), int(every[-1]), guess[0], guess))
    return tuple(out)
