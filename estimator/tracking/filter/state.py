"""One bubble's Kalman filter, and the error that all bubbles have in common.

The error of bubble i is own_i + common: `Track.filter` carries the own part (independent between
bubbles), `Common` the part that shake and stage give to all alike. Both follow the same motion, so
prediction keeps the form; so does the update with equal gains, and a gain that differs from the
mean adds its share to the own part. Differences between bubbles are free of the common part.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.estimator.tracking.filter.motion import POSITION, STATES, Transition
from telerig.estimator.tracking.filter.types import NO_PARTICLE

_SIZE_GAIN = 0.25
_IDENTITY = np.eye(STATES)


@dataclass
class Track:
    """A bubble that is followed.

    filter : filterpy KalmanFilter, state as in `motion`; d_eq_mm : running mean, NaN if unknown;
    d_last_mm : the last measured, d_before_mm : the mean before that. seen_frame, seen_t_s : of
    the last measurement; misses : frames since. history : (frame, point) of a track that is not
    confirmed yet. parent, near : id and former size of the nearest track at its birth, and when it
    was first missed.
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

    @property
    def point_mm(self) -> Array:
        """(3,) its position in the rig frame."""
        return np.asarray(self.filter.x[POSITION])

    @property
    def point_covariance_mm2(self) -> Array:
        """(3, 3) of the position, own part."""
        return np.asarray(self.filter.P[POSITION, POSITION])

    def copy(self) -> Track:
        """Independent of the original: filterpy replaces its arrays, it never writes into them."""
        return replace(self, filter=copy(self.filter), history=list(self.history))

    def predict(self, step: Transition, control: Array) -> None:
        """control : (n,) added to the state: the stage's motion."""
        self.filter.predict(u=control, B=_IDENTITY, F=step.matrix, Q=step.noise)

    def missed(self, shift: Array, mean_gain: Array, common_mm2: Array) -> None:
        """No measurement in this frame; shift (n,) common to all, mean_gain (n, 3)."""
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
        """Record a measurement in a frame; d_eq_mm : NaN if unknown."""
        self.seen_frame, self.seen_t_s, self.misses, self.near = frame, t_s, 0, None
        if np.isfinite(d_eq_mm):
            self.d_last_mm, self.d_before_mm = d_eq_mm, self.d_eq_mm
            if np.isfinite(self.d_eq_mm):
                self.d_eq_mm += _SIZE_GAIN * (d_eq_mm - self.d_eq_mm)
            else:
                self.d_eq_mm = d_eq_mm


def new_filter(x: Array, p: Array) -> Any:
    """A filterpy KalmanFilter that measures the position; F, Q and R come with every step."""
    from filterpy.kalman import KalmanFilter

    kalman = KalmanFilter(dim_x=len(x), dim_z=3)
    kalman.H = np.eye(3, len(x))
    kalman.x, kalman.P = np.array(x, float), np.array(p, float)
    return kalman


@dataclass(frozen=True)
class Common:
    """The error common to all bubbles.

    shift : (n,) of this frame, not yet added to the tracks; covariance : (n, n).
    """

    shift: Array = field(default_factory=lambda: np.zeros(STATES))
    covariance: Array = field(default_factory=lambda: np.zeros((STATES, STATES)))

    @property
    def shift_mm(self) -> Array:
        return self.shift[POSITION]

    @property
    def covariance_mm2(self) -> Array:
        return self.covariance[POSITION, POSITION]

    def predicted(self, step: Transition) -> Common:
        grown = step.matrix @ self.covariance @ step.matrix.T + step.common_noise
        return Common(np.zeros(STATES), grown)

    def informed(self, innovations: Array, covariances: Array) -> Common:
        """After innovations (E, 3) of bubbles whose own covariances are (E, 3, 3)."""
        if len(innovations) == 0:
            return self
        information = np.linalg.inv(covariances)
        score = np.einsum("eij,ej->i", information, innovations - self.shift_mm)
        total = information.sum(0)
        gain = self.covariance[:, POSITION] @ np.linalg.inv(np.eye(3) + total @ self.covariance_mm2)
        lost = gain @ total @ self.covariance[POSITION]
        return Common(self.shift + gain @ score, self.covariance - (lost + lost.T) / 2)

    def applied(self, mean_gain: Array) -> Common:
        """The remainder once the tracks have taken the shift and their measurements."""
        keep = np.eye(STATES)
        keep[:, POSITION] -= mean_gain
        return Common(np.zeros(STATES), keep @ self.covariance @ keep.T)
