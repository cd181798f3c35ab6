"""Bubbles that one camera alone sees keep their track alive: a 2-D update through the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.tracking.association.advance import Scan
from telerig.estimator.tracking.association.likelihoods import best_assignment, gate2
from telerig.estimator.tracking.filter.state import Track
from telerig.estimator.tracking.filter.types import (
    Ids,
    SeenAlone,
    SingleMeasurements,
    TrackerSettings,
)
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Seen:
    """What one camera should see of tracks: pixels (K, 2), by the rig point (K, 2, 3), and the
    pixels' covariance (K, 2, 2) from the tracks' own."""

    uv_px: Array
    by_point: Array
    covariance_px2: Array


def expected(camera: Camera, tracks: Sequence[Track], common_mm2: Array) -> Seen:
    points = np.array([t.filter.x[:3] for t in tracks])
    spread = np.array([t.filter.P[:3, :3] for t in tracks]) + common_mm2
    uv, by_point, _ = stacked_jacobian((camera,), points)
    return Seen(uv, by_point, by_point @ spread @ np.swapaxes(by_point, -1, -2))


def update_pixels(
    track: Track, uv_px: Array, covariance_px2: Array, seen_uv_px: Array, by_point: Array
) -> None:
    """filterpy's update with a pixel (2,), linearised where the track is expected."""
    h = np.zeros((2, len(track.filter.x)))
    h[:, :3] = by_point
    linear = uv_px - seen_uv_px + h @ track.filter.x
    track.filter.update(linear.reshape(-1), R=covariance_px2, H=h)


def pair_singles(
    seen: Seen, singles: SingleMeasurements, indices: Ids, settings: TrackerSettings
) -> list[tuple[int, int]]:
    """(track, index into the singles) of the pairings without a rival within the margin."""
    between = singles.uv_px[indices][None] - seen.uv_px[:, None]
    covariance = seen.covariance_px2[:, None] + singles.covariance_px2[indices][None]
    distance2 = np.einsum("kli,klij,klj->kl", between, np.linalg.inv(covariance), between)
    row, local = np.nonzero(distance2 <= gate2(settings, 2))
    certain = settings.detection_probability
    base = np.log(certain / (1 - certain) / settings.new_per_px2) - np.log(2 * np.pi)
    score = base - np.log(np.linalg.det(covariance))[row, local] / 2 - distance2[row, local] / 2
    chosen = best_assignment(len(between), row, local, score)
    safe = unrivalled(row, local, score, chosen, settings.margin_nats)
    return [(int(r), int(indices[chosen[r]])) for r in np.flatnonzero(safe)]


def continue_alone(
    missed: Sequence[Track], scan: Scan, cameras: Sequence[Camera], common_mm2: Array
) -> list[tuple[Track, int]]:
    """Update the tracks by the singles that are theirs; which single (its index) updated which."""
    singles, out = scan.measured.singles, []
    for index, camera in enumerate(cameras):
        mine = np.flatnonzero(singles.camera == index)
        if not len(mine) or not len(missed):
            continue
        seen = expected(camera, missed, common_mm2)
        for row, single in pair_singles(seen, singles, mine, scan.settings):
            track, noise = missed[row], singles.covariance_px2[single]
            update_pixels(track, singles.uv_px[single], noise, seen.uv_px[row], seen.by_point[row])
            track.saw(scan.frame, scan.t_s, float("nan"))
            out.append((track, single))
    return out


def seen_alone(found: Sequence[tuple[Track, int]], common_mm2: Array) -> SeenAlone:
    """Where the tracks are after their updates by single cameras."""
    if not found:
        return SeenAlone()
    return SeenAlone(
        np.array([single for _, single in found], np.int64),
        np.array([t.particle for t, _ in found], np.int64),
        np.array([t.filter.x[:3] for t, _ in found]),
        np.array([t.filter.P[:3, :3] for t, _ in found]) + common_mm2,
        np.array([t.d_eq_mm for t, _ in found]),
    )


def unrivalled(row: Ids, column: Ids, score: Array, chosen: Ids, margin_nats: float) -> Ids:
    """(K,) chosen and without a pairing of the same track or measurement nearly as good."""
    out = chosen >= 0
    for r in np.flatnonzero(out):
        mine = (row == r) & (column == chosen[r])
        rival = ((row == r) | (column == chosen[r])) & ~mine
        best_rival = np.max(score[rival], initial=-np.inf)
        out[r] = best_rival < score[mine].max() - margin_nats
    return np.asarray(out)
