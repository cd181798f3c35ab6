"""One bubble's filter, and what all bubbles have in common.

The error of bubble i is own_i + common: `Track.filter` carries the own part (independent between
bubbles), `Common` the part that shake and stage give to all alike. Both follow the same motion, so
prediction keeps the form; so does the update with equal gains, and a gain that differs from the
mean adds its share to the own part. Differences between bubbles are free of the common part.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.tracking.filter.motion import Transition
from telerig.estimator.tracking.filter.types import NO_PARTICLE

Array = NDArray[np.float64]

_SIZE_GAIN = 0.25


@dataclass
class Track:
    """A bubble under way.

    filter : filterpy KalmanFilter, state as in `track_motion`; d_eq_mm : running mean, NaN if
    unknown; d_last_mm : the last measured, d_before_mm : the mean before that. seen : frame and
    time of the last measurement; misses : frames since. history : (frame, point) of a track that
    is not confirmed yet. parent, near : the track beside it when it was born, and when it was
    missed first, with that one's size before.
    """

    filter: Any
    particle: int = NO_PARTICLE
    d_eq_mm: float = float("nan")
    d_last_mm: float = float("nan")
    d_before_mm: float = float("nan")
    born_frame: int = 0
    seen_frame: int = 0
    seen_t_s: float = 0.0
    misses: int = 0
    history: list[tuple[int, int]] = field(default_factory=list)
    parent: tuple[int, float] | None = None
    near: tuple[int, float] | None = None

    def copy(self) -> Track:
        """Independent of the original: filterpy replaces its arrays, it never writes into them."""
        return replace(self, filter=copy(self.filter), history=list(self.history))

    def missed(self, shift: Array, mean_gain: Array, common_mm2: Array) -> None:
        self.misses += 1
        self.filter.x = self.filter.x + shift
        self.filter.P = self.filter.P + mean_gain @ common_mm2 @ mean_gain.T

    def update(self, z: Array, r: Array, shift: Array, mean_gain: Array, common_mm2: Array) -> None:
        """Measured at z (3,) with covariance r (3, 3), the common shift (n,) being known."""
        self.filter.x = self.filter.x + shift
        self.filter.update(z, R=r)
        unequal = mean_gain - self.filter.K
        self.filter.P = self.filter.P + unequal @ common_mm2 @ unequal.T

    def saw(self, frame: int, t_s: float, d_eq_mm: float) -> None:
        self.seen_frame, self.seen_t_s, self.misses, self.near = frame, t_s, 0, None
        if np.isfinite(d_eq_mm):
            self.d_last_mm, self.d_before_mm = d_eq_mm, self.d_eq_mm
            first = not np.isfinite(self.d_eq_mm)
            self.d_eq_mm += 0.0 if first else _SIZE_GAIN * (d_eq_mm - self.d_eq_mm)
            self.d_eq_mm = d_eq_mm if first else self.d_eq_mm


def new_filter(x: Array, p: Array) -> Any:
    """A filterpy KalmanFilter that measures the position; F, Q and R come with every step."""
    from filterpy.kalman import KalmanFilter

    kalman = KalmanFilter(dim_x=len(x), dim_z=3)
    kalman.H = np.eye(3, len(x))
    kalman.x, kalman.P = np.array(x, float), np.array(p, float)
    return kalman


def predict(track: Track, step: Transition, control: Array) -> None:
    """control : (n,) added to the state, the stage's motion and the mean velocity's drift."""
    track.filter.predict(u=control, B=_identity(len(control)), F=step.matrix, Q=step.noise)


@lru_cache(maxsize=4)
def _identity(n: int) -> Array:
    return np.eye(n)


@dataclass(frozen=True)
class Common:
    """shift : (n,) of this frame, not yet added to the tracks; covariance : (n, n)."""

    shift: Array
    covariance: Array

    @staticmethod
    def start(n: int) -> Common:
        return Common(np.zeros(n), np.zeros((n, n)))

    @property
    def shift_mm(self) -> Array:
        return self.shift[:3]

    @property
    def covariance_mm2(self) -> Array:
        return self.covariance[:3, :3]

    def predicted(self, step: Transition) -> Common:
        grown = step.matrix @ self.covariance @ step.matrix.T + step.common_noise
        return Common(np.zeros(len(self.shift)), grown)

    def informed(self, innovations: Array, covariances: Array) -> Common:
        """After innovations (E, 3) of bubbles whose own covariances are (E, 3, 3)."""
        if len(innovations) == 0:
            return self
        information = np.linalg.inv(covariances)
        score = np.einsum("eij,ej->i", information, innovations - self.shift_mm)
        total = information.sum(0)
        gain = self.covariance[:, :3] @ np.linalg.inv(np.eye(3) + total @ self.covariance_mm2)
        lost = gain @ total @ self.covariance[:3]
        return Common(self.shift + gain @ score, self.covariance - (lost + lost.T) / 2)

    def applied(self, mean_gain: Array) -> Common:
        """What is left once the tracks have taken the shift and their measurements."""
        keep = np.eye(len(self.shift))
        keep[:, :3] -= mean_gain
        return Common(np.zeros(len(self.shift)), keep @ self.covariance @ keep.T)
