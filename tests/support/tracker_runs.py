"""Frames for the tracker, and what comes of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.tracking.linking.filter import FrameResult, TrackerSettings, TrackEvent
from telerig.estimator.tracking.linking.frames import NO_PARTICLE, Bubbles
from telerig.estimator.tracking.linking.tracker import Tracker
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec

Array = NDArray[np.float64]
UP = np.array([0.0, -1.0, 0.0])
SIGMA_MM = 0.02
NOISE_MM2 = SIGMA_MM**2 * np.eye(3)
STILL = TrackerSettings(rise_mm_s=0.0, birth_speed_sd_mm_s=50.0)


def frame_of(
    points: Any,
    covariance: Any = NOISE_MM2,
    *,
    d_eq_mm: Any = np.nan,
    particle: Any = NO_PARTICLE,
    alone: Any = False,
) -> Bubbles:
    """Bubbles of a frame of two cameras; each argument for all of them or for each."""
    places = np.reshape(points, (-1, 3)).astype(float)
    many = len(places)
    rows = np.repeat(np.arange(many)[:, None], 2, axis=1)
    rows[np.broadcast_to(alone, many), 1] = -1
    given, size = np.full(many, particle), np.full(many, d_eq_mm)
    return Bubbles.of(rows, places, np.broadcast_to(covariance, (many, 3, 3)), given, size)


def run(
    tracker: Tracker, frames: list[Any], hz: float = 500.0, stage: Array | None = None
) -> tuple[list[Array], list[TrackEvent]]:
    """Final ids per frame, all events; a frame is an array of points or Bubbles."""
    results: list[FrameResult] = []
    for i, points in enumerate(frames):
        measured = points if isinstance(points, Bubbles) else frame_of(points)
        at = 0.0 if stage is None else float(stage[i])
        results.append(tracker.update(i, i / hz, measured, at))
    last = tracker.finish()
    assert last is not None
    results.append(last)
    final = [s for r in results for s in r.final]
    assert [s.frame for s in final] == list(range(len(frames)))
    return [s.particle for s in final], [e for r in results for e in r.events]


def kinds(events: list[TrackEvent]) -> list[str]:
    return [e.kind for e in events]


def cameras() -> tuple[Camera, Camera]:
    turn = Pose(rotation_from_rotvec([0.0, np.pi / 2, 0.0]), np.zeros(3))
    return (
        Camera.create("left", (800, 800), 10.0),
        Camera.create("right", (800, 800), 10.0, camera_from_rig=turn),
    )
