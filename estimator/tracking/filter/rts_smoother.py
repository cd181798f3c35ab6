"""Positions of bubbles in every frame, smoothed over the frames before and after.

One outline in one image may show two bubbles which the other image separates. One camera alone
sees the hidden bubble; its depth in that camera follows from the motion between the frames in which
both saw it (fixed-interval smoother of Rauch, Tung and Striebel, AIAA J. 3:1445, 1965).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.tracking.filter.motion import POSITION, birth_covariance
from telerig.estimator.tracking.filter.types import Motion, TrackerSettings

Array = NDArray[np.float64]

_ANYWHERE_MM = 100.0


@dataclass(frozen=True)
class Readings:
    """Measurements of K bubbles in F frames in information form.

    information : (F, K, 3, 3) on their points (1/mm2), 0 where nothing was seen.
    pull : (F, K, 3) information @ point (1/mm).
    """

    information: Array
    pull: Array

    @staticmethod
    def none(frames: int, bubbles: int) -> Readings:
        return Readings(np.zeros((frames, bubbles, 3, 3)), np.zeros((frames, bubbles, 3)))

    def add(
        self, frame: int, bubble: int, value: Array, covariance: Array, by_point: Array
    ) -> None:
        """A measurement value (k,) = by_point (k, 3) @ point, with covariance (k, k)."""
        weighted = np.linalg.solve(covariance, by_point).T
        self.information[frame, bubble] += weighted @ by_point
        self.pull[frame, bubble] += weighted @ value


def smooth_points(
    readings: Readings,
    motions: Sequence[Motion | None],
    settings: TrackerSettings,
) -> tuple[Array, Array]:
    """(F, K, 3) points (mm, rig) and (F, K, 3, 3) covariances.

    motions : into each frame; the first is not used.
    """
    filtered, predicted = _filtered(readings, motions, settings)
    x, p = filtered[-1]
    out = [(x[:, POSITION], p[:, POSITION, POSITION])]
    for k in range(len(filtered) - 2, -1, -1):
        motion, (xf, pf), (xp, pp) = motions[k + 1], filtered[k], predicted[k + 1]
        assert motion is not None
        gain = np.swapaxes(np.linalg.solve(pp, motion.matrix @ pf), -1, -2)
        x = xf + (gain @ (x - xp)[..., None])[..., 0]
        p = pf + gain @ (p - pp) @ np.swapaxes(gain, -1, -2)
        out.append((x[:, POSITION], p[:, POSITION, POSITION]))
    points, covariances = zip(*out[::-1])
    return np.array(points), np.array(covariances)


def _filtered(
    readings: Readings,
    motions: Sequence[Motion | None],
    settings: TrackerSettings,
) -> tuple[list[tuple[Array, Array]], list[tuple[Array, Array]]]:
    """States (K, n) and covariances (K, n, n) after and before each frame's readings."""
    bubbles = readings.information.shape[1]
    prior = birth_covariance(settings, _ANYWHERE_MM**2 * np.eye(3), encoder=False)
    p = np.tile(prior, (bubbles, 1, 1))
    x = np.zeros((bubbles, len(prior)))
    total = readings.information.sum(0) + 1e-9 * np.eye(3)
    x[:, POSITION] = np.linalg.solve(total, readings.pull.sum(0)[..., None])[..., 0]
    filtered, predicted = [], []
    for k, motion in enumerate(motions):
        if k:
            assert motion is not None
            x = x @ motion.matrix.T + motion.offset
            p = motion.matrix @ p @ motion.matrix.T + motion.noise
        predicted.append((x, p))
        x, p = _updated(x, p, readings.information[k], readings.pull[k])
        filtered.append((x, p))
    return filtered, predicted


def _updated(x: Array, p: Array, information: Array, pull: Array) -> tuple[Array, Array]:
    """States after a frame's information on their positions."""
    mixed = np.eye(3) + information @ p[:, POSITION, POSITION]
    gain = p[..., POSITION] @ np.linalg.inv(mixed)
    left = pull - (information @ x[:, POSITION, None])[..., 0]
    lost = gain @ information @ p[:, POSITION]
    x = x + (gain @ left[..., None])[..., 0]
    return x, p - (lost + np.swapaxes(lost, -1, -2)) / 2
