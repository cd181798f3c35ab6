"""Pairing of tracks with detections of one camera alone, and the 2-D update through the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.estimator.tracking.association.advance import Scan
from telerig.estimator.tracking.association.likelihoods import best_assignment, gate2, unrivalled
from telerig.estimator.tracking.filter.motion import POSITION
from telerig.estimator.tracking.filter.state import Track
from telerig.estimator.tracking.filter.types import SeenAlone, TrackerSettings
from telerig.rig.camera import Camera
from telerig.rig.triangulation import stacked_jacobian

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Projected:
    """Points in one camera: pixels (K, 2), their derivatives by the rig point (K, 2, 3), and the
    pixels' covariance (K, 2, 2) from the points' own."""

    uv_px: Array
    by_point: Array
    covariance_px2: Array


def projected(camera: Camera, points_mm: Array, covariance_mm2: Array) -> Projected:
    """Of rig points (K, 3) with covariances (K, 3, 3)."""
    uv, by_point, _ = stacked_jacobian((camera,), points_mm)
    return Projected(uv, by_point, by_point @ covariance_mm2 @ np.swapaxes(by_point, -1, -2))


def px_per_mm(by_point: Array) -> Array:
    """(K,) scale across the line of sight, from derivatives (K, 2, 3) of pixels by the point."""
    return np.asarray(np.linalg.det(by_point @ np.swapaxes(by_point, -1, -2)) ** 0.25)


def pair_pixels(
    expected: Projected,
    uv_px: Array,
    covariance_px2: Array,
    settings: TrackerSettings,
    *,
    size_score: ArrayLike = 0.0,
    allowed: ArrayLike = True,
) -> list[int]:
    """For each expected track the detection that continues it, -1 for none or with a rival.

    uv_px (L, 2), covariance_px2 (L, 2, 2) : the detections.
    size_score, allowed : (K, L) or less, log-likelihood ratio of the sizes, and pairings to try.
    """
    between = uv_px[None] - expected.uv_px[:, None]
    covariance = expected.covariance_px2[:, None] + covariance_px2[None]
    distance2 = np.einsum("kli,klij,klj->kl", between, np.linalg.inv(covariance), between)
    row, column = np.nonzero((distance2 <= gate2(settings, 2)) & allowed)
    seen = settings.detection_probability
    base = np.log(seen / (1 - seen) / settings.new_per_px2) - np.log(2 * np.pi)
    ratio = base - np.log(np.linalg.det(covariance)) / 2 - distance2 / 2 + size_score
    score = ratio[row, column]
    chosen = best_assignment(len(between), row, column, score)
    safe = unrivalled(row, column, score, chosen, settings.margin_nats)
    return [int(c) if ok else -1 for c, ok in zip(chosen, safe)]


def update_pixels(
    track: Track, uv_px: Array, covariance_px2: Array, expected_px: Array, by_point: Array
) -> None:
    """filterpy's update with a pixel (2,), linearised where the track is expected."""
    h = np.zeros((2, len(track.filter.x)))
    h[:, POSITION] = by_point
    linear = uv_px - expected_px + h @ track.filter.x
    track.filter.update(linear.reshape(-1), R=covariance_px2, H=h)


def continue_alone(
    missed: Sequence[Track], scan: Scan, cameras: Sequence[Camera], common_mm2: Array
) -> list[tuple[Track, int, SeenAlone]]:
    """Update the tracks by single-camera measurements: track, index of the measurement, where the
    track is then."""
    singles = scan.measured.singles
    out = []
    for index, camera in enumerate(cameras):
        mine = np.flatnonzero(singles.camera == index)
        if not len(mine) or not len(missed):
            continue
        points = np.array([t.point_mm for t in missed])
        spread = np.array([t.point_covariance_mm2 for t in missed]) + common_mm2
        expected = projected(camera, points, spread)
        uv, noise = singles.uv_px[mine], singles.covariance_px2[mine]
        for k, j in enumerate(pair_pixels(expected, uv, noise, scan.settings)):
            if j >= 0:
                track = missed[k]
                update_pixels(track, uv[j], noise[j], expected.uv_px[k], expected.by_point[k])
                track.saw(scan.frame, scan.t_s, float("nan"))
                out.append((track, int(mine[j])))
    return [(t, single, SeenAlone(t.point_mm, t.d_eq_mm)) for t, single in out]
