"""Rows of tracks.csv for bubbles that one camera sees and another bubble hides from the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.tracking.association.single_camera import projected, px_per_mm
from telerig.estimator.tracking.filter.rts_smoother import smooth_points
from telerig.estimator.tracking.filter.types import NO_PARTICLE, TrackerSettings
from telerig.estimator.tracking.frame_rows import (
    CENTRE_PX,
    COVARIANCE_MM2,
    Frame,
    Single,
    readings_of,
)
from telerig.rig.camera import Camera

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

FRAMES_BEFORE, FRAMES_AFTER = 15, 40
"""Frames around a hidden one by which its position is smoothed."""

FLAG = "shared"
_SHARPNESS, _SHARPNESS_PX = 0.1, 3.0
"""Largest sd of a hidden centre, as a share of the bubble's diameter and in px."""

_APART = 0.5
"""Least distance of two bubbles' centres, as a share of their distance when they touch."""

_BEHIND = 0.25
"""Standard deviation of a pixel "behind that outline", as a share of the outline's semi-axis."""

_CONFIDENCE = 0.95
"""Share of such points that were right in simulated swarms."""


def shared_rows(
    before: Sequence[Frame],
    frames: Sequence[Frame],
    after: Sequence[Frame],
    cameras: tuple[Camera, Camera],
    settings: TrackerSettings,
) -> list[dict[str, Any]]:
    """Rows for the hidden bubbles of ``frames``; the frames before and after are context.

    The hidden view's pixel is that of the point; its covariance states only that the bubble is
    behind that outline, so that motion is not counted twice when tracks are smoothed.
    """
    every = [*before, *frames, *after]
    seen = {int(p) for f in every for p in f.particle}
    particles = sorted({s.particle for f in frames for s in f.hidden()} & seen)
    if not particles:
        return []
    readings = readings_of(every, particles, cameras)
    motions = [f.motion for f in every]
    points, covariances = smooth_points(readings, motions, settings)
    place = {p: k for k, p in enumerate(particles)}
    out = []
    for i, frame in enumerate(frames, len(before)):
        known = frame.particle != NO_PARTICLE
        where, sizes = [*frame.pairs.points_mm[known]], frame.pairs.d_eq_mm[known].tolist()
        singles = [s for s in frame.hidden() if s.particle in place]
        for single in sorted(singles, key=lambda s: np.trace(covariances[i, place[s.particle]])):
            k = place[single.particle]
            point, covariance = points[i, k], covariances[i, k]
            row = _row(frame, single, point, covariance, cameras)
            if row is not None and not _taken(single, point, where, sizes):
                out.append(row)
                where.append(point)
                sizes.append(single.d_eq_mm)
    return out


def _taken(
    single: Single, point_mm: Array, others_mm: Sequence[Array], sizes_mm: Sequence[float]
) -> bool:
    """Whether another track's bubble occupies the place of this one."""
    away = np.linalg.norm(np.reshape(others_mm, (-1, 3)) - point_mm, axis=1)
    return bool((away < _APART * (np.array(sizes_mm) + single.d_eq_mm) / 2).any())


def _row(
    frame: Frame,
    single: Single,
    point: Array,
    covariance: Array,
    cameras: tuple[Camera, Camera],
) -> dict[str, Any] | None:
    """None where the point is too uncertain, or no other bubble explains why it is not seen."""
    seen = single.camera
    mine = frame.tables[seen].iloc[single.row]
    other = cameras[1 - seen]
    view = projected(other, point[None], covariance[None])
    uv, spread = view.uv_px[0] + frame.offset_px[1 - seen], view.covariance_px2[0]
    diameter = single.d_eq_mm * px_per_mm(view.by_point)[0]
    sd = float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
    reach = _outline_over(frame.tables[1 - seen], uv, diameter / 2)
    if not (sd <= min(_SHARPNESS * diameter, _SHARPNESS_PX) and reach > 0):
        return None
    behind = spread + (_BEHIND * reach) ** 2 * np.eye(2)
    per_camera = {
        cameras[seen].name: mine[CENTRE_PX].tolist(),
        other.name: [*uv, behind[0, 0], behind[0, 1], behind[1, 1]],
    }
    flags = sorted({FLAG, *filter(None, str(mine["flags"] or "").split("|"))})
    return {
        "frame": frame.number,
        "particle": single.particle,
        "t_s": frame.t_s,
        **{f"{x}_mm": v for x, v in zip("xyz", point)},
        **dict(zip(COVARIANCE_MM2, covariance[np.triu_indices(3)])),
        **{f"{c}_{n}": v for c, values in per_camera.items() for n, v in zip(CENTRE_PX, values)},
        **{f"{c}_{n}": 0.0 for c in per_camera for n in ("du_px", "dv_px")},
        "d_eq_mm": single.d_eq_mm,
        "confidence": _CONFIDENCE,
        "centre": "silhouettes",
        **{f"silhouettes_{x}_mm": v for x, v in zip("xyz", point)},
        "flags": "|".join(flags),
    }


def _outline_over(table: pd.DataFrame, uv_px: Array, radius_px: float) -> float:
    """Semi-axis (px) of the largest outline that covers a part of the disc; 0 if there is none."""
    away = np.hypot(table["u_px"] - uv_px[0], table["v_px"] - uv_px[1]).to_numpy(float)
    long = table["a_px"].to_numpy(float)
    covering = away < long + 0.5 * radius_px
    return float(np.max(long[covering], initial=0.0))
