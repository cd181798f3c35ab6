"""Rows of tracks.csv for bubbles that one camera sees and the other hides behind another bubble."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.track_hidden import Reading, smooth_points
from telerig.estimator.track_types import (
    FrameIds,
    FrameMeasurements,
    Motion,
    SeenAlone,
    TrackerSettings,
)
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FRAMES_BEFORE, FRAMES_AFTER = 15, 40
"""Frames around a hidden one that tell where its bubble is."""

FLAG = "shared"
_SHARPNESS = 0.08
"""Largest sd of a hidden centre, as a share of the bubble's diameter."""

_BEHIND = 0.25
"""Sd of "behind that outline", as a share of the outline's semi-axis."""

_CONFIDENCE = 0.95
"""Share of such points that are right, in simulated swarms."""


@dataclass(frozen=True)
class Pairs:
    """Rows of the two tables that show the same bubble.

    particle : (M,) ids given by the user, -1 where the pair was found here.
    """

    first: Index
    second: Index
    confidence: Array
    ambiguous: NDArray[np.bool_]
    particle: Index


@dataclass
class Frame:
    """One frame on its way to the tables; ids are None until they are final."""

    number: int
    t_s: float
    tables: tuple[pd.DataFrame, pd.DataFrame]
    pairs: Pairs
    singles: tuple[Index, Index]
    measured: FrameMeasurements
    alone: SeenAlone
    motion: Motion | None
    ids: FrameIds | None = None

    def hidden(self) -> list[tuple[int, int]]:
        """(particle, row of ``alone``) of the tracks that exactly one camera sees here."""
        assert self.ids is not None
        mine = self.ids.single[self.alone.single]
        counts = {p: int((mine == p).sum()) for p in mine.tolist()}
        return [(p, k) for k, p in enumerate(mine.tolist()) if p >= 0 and counts[p] == 1]


def shared_rows(
    before: Sequence[Frame],
    frames: Sequence[Frame],
    after: Sequence[Frame],
    cameras: tuple[Camera, Camera],
    settings: TrackerSettings,
) -> list[dict[str, Any]]:
    """Rows for the hidden bubbles of ``frames``; what is around them is context.

    The hidden view's pixel is that of the point; its covariance says no more than that the bubble
    is behind that outline, so that motion is not counted twice when tracks are smoothed.
    """
    every = [*before, *frames, *after]
    wanted = {p for f in frames for p, _ in f.hidden()}
    out = []
    for particle in sorted(wanted):
        run = _unbroken(every, particle)
        out += _rows(run, {f.number for f in frames}, particle, cameras, settings) if run else []
    return out


def _unbroken(frames: Sequence[Frame], particle: int) -> Sequence[Frame]:
    """The frames from the first in which both cameras see it; none where one of them is missing."""
    first = next((i for i, f in enumerate(frames) if _column(f, particle) >= 0), len(frames))
    run = frames[first:]
    unbroken = all(b.number == a.number + 1 and b.motion is not None for a, b in pairwise(run))
    return run if unbroken else []


def _column(frame: Frame, particle: int) -> int:
    assert frame.ids is not None
    found = np.flatnonzero(frame.ids.particle == particle)
    return int(found[0]) if len(found) else -1


def _rows(
    run: Sequence[Frame],
    wanted: set[int],
    particle: int,
    cameras: tuple[Camera, Camera],
    settings: TrackerSettings,
) -> list[dict[str, Any]]:
    at = [dict(f.hidden()).get(particle, -1) for f in run]
    readings = [_reading(f, particle, k, cameras) for f, k in zip(run, at)]
    points, covariances = smooth_points(readings, [f.motion for f in run], settings)
    out = []
    for i, (frame, k) in enumerate(zip(run, at)):
        if frame.number in wanted and k >= 0:
            row = _row(frame, particle, k, points[i], covariances[i], cameras)
            out += [] if row is None else [row]
    return out


def _reading(
    frame: Frame, particle: int, alone: int, cameras: tuple[Camera, Camera]
) -> Reading | None:
    column, measured = _column(frame, particle), frame.measured
    if column >= 0:
        return Reading.point(measured.points_mm[column], measured.covariance_mm2[column])
    if alone < 0:
        return None
    single, point = int(frame.alone.single[alone]), frame.alone.points_mm[alone]
    camera = cameras[int(measured.singles.camera[single])]
    uv, by_point, _ = stacked_jacobian((camera,), point[None])
    value = measured.singles.uv_px[single] - uv[0] + by_point[0] @ point
    return Reading(value, measured.singles.covariance_px2[single], by_point[0])


def _row(
    frame: Frame,
    particle: int,
    alone: int,
    point: Array,
    covariance: Array,
    cameras: tuple[Camera, Camera],
) -> dict[str, Any] | None:
    """None where the point is too vague, or no other bubble explains why it is not seen."""
    single = int(frame.alone.single[alone])
    seen = int(frame.measured.singles.camera[single])
    offset = len(frame.singles[0]) if seen else 0
    mine = frame.tables[seen].iloc[int(frame.singles[seen][single - offset])]
    other = cameras[1 - seen]
    uv, by_point, _ = stacked_jacobian((other,), point[None])
    spread = by_point[0] @ covariance @ by_point[0].T
    px_per_mm = np.linalg.det(by_point[0] @ by_point[0].T) ** 0.25
    d_eq_mm = float(frame.alone.d_eq_mm[alone])
    diameter = d_eq_mm * px_per_mm
    sd = float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
    reach = _outline_over(frame.tables[1 - seen], uv[0], diameter / 2)
    if not (sd <= _SHARPNESS * diameter and reach > 0):
        return None
    behind = spread + (_BEHIND * reach) ** 2 * np.eye(2)
    per_camera = {
        cameras[seen].name: mine[["u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"]].tolist(),
        other.name: [*uv[0], behind[0, 0], behind[0, 1], behind[1, 1]],
    }
    names = ("u_px", "v_px", "suu_px2", "suv_px2", "svv_px2")
    flags = sorted({FLAG, *filter(None, str(mine["flags"] or "").split("|"))})
    upper = ("xx", "xy", "xz", "yy", "yz", "zz")
    return {
        "frame": frame.number,
        "particle": particle,
        "t_s": frame.t_s,
        **dict(zip(("x_mm", "y_mm", "z_mm"), point)),
        **{f"s{n}_mm2": v for n, v in zip(upper, covariance[np.triu_indices(3)])},
        **{f"{c}_{n}": v for c, values in per_camera.items() for n, v in zip(names, values)},
        **{f"{c}_{n}": 0.0 for c in per_camera for n in ("du_px", "dv_px")},
        "d_eq_mm": d_eq_mm,
        "confidence": _CONFIDENCE,
        "centre": "silhouettes",
        **dict(zip(("silhouettes_x_mm", "silhouettes_y_mm", "silhouettes_z_mm"), point)),
        "flags": "|".join(flags),
    }


def _outline_over(table: pd.DataFrame, uv_px: Array, radius_px: float) -> float:
    """Semi-axis (px) of the largest outline that covers a part of the disc; 0 if there is none."""
    away = np.hypot(table["u_px"] - uv_px[0], table["v_px"] - uv_px[1]).to_numpy(float)
    long = table["a_px"].to_numpy(float)
    covering = away < long + 0.5 * radius_px
    return float(np.max(long[covering], initial=0.0))
