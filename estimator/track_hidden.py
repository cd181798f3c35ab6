"""Where a bubble is that one image hides behind another: by its track before and after.

One outline in one image may show two bubbles which the other image separates. The hidden one is
seen exactly by one camera; what that camera cannot tell comes from the motion between the frames
in which both saw it (fixed-interval smoother of Rauch, Tung and Striebel, AIAA J. 3:1445, 1965).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.track_motion import birth_covariance
from telerig.estimator.track_types import Motion, TrackerSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reading:
    """What a frame says of a bubble: value (k,) of by_point (k, 3) @ point, covariance (k, k)."""

    value: Array
    covariance: Array
    by_point: Array

    @staticmethod
    def point(point_mm: Array, covariance_mm2: Array) -> Reading:
        return Reading(point_mm, covariance_mm2, np.eye(3))


def smooth_points(
    readings: Sequence[Reading | None], motions: Sequence[Motion | None], settings: TrackerSettings
) -> tuple[Array, Array]:
    """(F, 3) points (mm, rig) and (F, 3, 3) covariances of one bubble in consecutive frames.

    readings : None where it was not seen; the first is a point.  motions : into each frame, that
    into the first is not used.
    """
    first = readings[0]
    assert first is not None and len(first.value) == 3
    p = birth_covariance(settings, first.covariance, encoder=False)
    x = np.zeros(len(p))
    x[:3] = first.value
    filtered, predicted = [(x, p)], [(x, p)]
    for reading, motion in zip(readings[1:], motions[1:]):
        assert motion is not None
        x = motion.matrix @ x + motion.offset
        p = motion.matrix @ p @ motion.matrix.T + motion.noise
        predicted.append((x, p))
        x, p = _updated(x, p, reading)
        filtered.append((x, p))
    out = [(x[:3], p[:3, :3])]
    for k in range(len(filtered) - 2, -1, -1):
        motion, (xf, pf), (xp, pp) = motions[k + 1], filtered[k], predicted[k + 1]
        assert motion is not None
        gain = np.linalg.solve(pp, motion.matrix @ pf).T
        x, p = xf + gain @ (x - xp), pf + gain @ (p - pp) @ gain.T
        out.append((x[:3], p[:3, :3]))
    points, covariances = zip(*out[::-1])
    return np.array(points), np.array(covariances)


def _updated(x: Array, p: Array, reading: Reading | None) -> tuple[Array, Array]:
    if reading is None:
        return x, p
    h = np.zeros((len(reading.value), len(x)))
    h[:, :3] = reading.by_point
    gain = np.linalg.solve(h @ p @ h.T + reading.covariance, h @ p).T
    keep = np.eye(len(x)) - gain @ h
    left = reading.value - h @ x
    return x + gain @ left, keep @ p @ keep.T + gain @ reading.covariance @ gain.T
