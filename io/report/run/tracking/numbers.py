"""What the tables of a tracked run add up to."""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array, Ints
from telerig.io.report.run.tracking.results import TrackResults

_MOST_ROWS = 20_000
_LEAST_SPREAD_MM = 0.1
_LEAST_ROWS = 12
NORMAL_MEDIAN = 0.6745
"""Of the absolute value, in standard deviations."""


def ray_miss_sd_mm(results: TrackResults) -> Array | None:
    """(N,) sd of ``ray_miss_mm`` that the outlines' covariances predict; None if it is not known.

    The cameras are not in the folder, but the points and their pixels are: an affine camera
    fitted to them gives the rays' directions and what a pixel is worth along the common
    perpendicular, to the lens's residual perspective. It takes points that fill some space.
    """
    worth = _mm_per_px(results)
    if worth is None:
        return None
    variance = np.zeros(len(results.tracks))
    for camera, per_px in zip(results.cameras, worth):
        columns = [f"{camera}_{name}" for name in ("suu_px2", "suv_px2", "svv_px2")]
        uu, uv, vv = results.tracks[columns].to_numpy(float).T
        variance += per_px[0] ** 2 * uu + 2 * per_px[0] * per_px[1] * uv + per_px[1] ** 2 * vv
    return np.sqrt(np.where(variance > 0, variance, np.nan))


def learnt_sd_mm(results: TrackResults) -> float | None:
    """What pairs were found to scatter besides: shake of the cameras against each other, shapes.

    From ``frame_px`` and ``scatter_px`` of tracking.json; None where that is not known.
    """
    worth = _mm_per_px(results)
    frame, scatter = results.pairs.frame_px, results.pairs.scatter_px
    if worth is None or frame is None or scatter is None:
        return None
    apart_px = np.linalg.norm(np.array([frame, scatter], float))
    return float(apart_px * np.linalg.norm(worth, axis=1).mean())


def _mm_per_px(results: TrackResults) -> Array | None:
    """(2, 2) by camera, what one px of u and of v moves a ray along the common perpendicular."""
    maps = [_affine(results, camera) for camera in results.cameras]
    known = [m for m in maps if m is not None]
    if len(known) != 2:
        return None
    first, second = (np.cross(m[0], m[1]) for m in known)
    across = np.cross(first, second)
    length = np.linalg.norm(across)
    if length < 1e-9:
        return None
    return np.array([np.linalg.lstsq(m.T, across / length, rcond=None)[0] for m in known])


def _affine(results: TrackResults, camera: str) -> Array | None:
    """(2, 3) px per mm, or None where the points do not tell."""
    uv = results.tracks[[f"{camera}_u_px", f"{camera}_v_px"]].to_numpy(float)
    both = np.c_[results.points_mm, uv]
    both = both[np.isfinite(both).all(axis=1)]
    both = both[:: len(both) // _MOST_ROWS + 1]
    if len(both) < _LEAST_ROWS:
        return None
    points, pixels = both[:, :3] - both[:, :3].mean(axis=0), both[:, 3:] - both[:, 3:].mean(axis=0)
    if np.linalg.svd(points, compute_uv=False)[2] < _LEAST_SPREAD_MM * np.sqrt(len(both)):
        return None
    return np.asarray(np.linalg.lstsq(points, pixels, rcond=None)[0].T)


def ray_miss_ratio(
    results: TrackResults, predicted_mm: Array | None, *, centred: bool = False
) -> float | None:
    """Typical ray miss over its predicted sd: 1 when the covariances tell the whole story.

    From the medians, so that a few wrong pairs do not count. centred : about the median miss.
    """
    if predicted_mm is None:
        return None
    miss = results.tracks["ray_miss_mm"].to_numpy(float)
    units = np.abs(miss - (median(miss) or 0.0 if centred else 0.0)) / predicted_mm
    units = units[np.isfinite(units)]
    return float(np.median(units)) / NORMAL_MEDIAN if len(units) else None


def median(values: Array) -> float | None:
    """None where no value is finite."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else None


def rms(values: Array) -> float | None:
    """None where no value is finite."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else None


def frame_count(results: TrackResults) -> int:
    """Of the run, else up to the last frame with a bubble."""
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
    """(K,) points of each track."""
    return np.asarray(results.tracks["particle"].value_counts().to_numpy(np.int64))
