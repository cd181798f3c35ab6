"""Kalman filter of one bubble, and the error that all bubbles have in common.

The error of a bubble is its own error plus the common error. `Track.filter` carries the own error,
which is independent between bubbles; `Common` carries the error that shake and stage give to all
bubbles alike. Both follow the same equation of motion, so that a prediction keeps this form. The
Kalman gain is the matrix by which a filter multiplies the measured minus the predicted position to
correct its state. An update keeps the form if all bubbles have the same gain; a gain that differs
from the mean adds its share to the own error. Differences between bubbles are free of the common
error.
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
    """Hold the state of one bubble that is followed.

    filter : filterpy KalmanFilter; its state (12,) is described in `motion`.
    particle : id of the track, -1 as long as it has none.
    d_eq_mm : running mean of the equivalent diameter, NaN if unknown.
    d_last_mm : last measured diameter.
    d_before_mm : running mean before the last measurement.
    born_frame : frame of the first measurement.
    seen_frame, seen_t_s : frame and time of the last measurement.
    misses : number of frames since the last measurement.
    history : (frame, index of the measurement) for each measurement of a track that is not
        confirmed.
    parent : id and former diameter (mm) of the nearest track at this track's birth; None if no
        track was near enough to touch it.
    near : the same for the nearest track at the time when this track was first missed; None while
        the track is seen.
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
        """Position (3,) in the rig frame."""
        return np.asarray(self.filter.x[POSITION])

    @property
    def point_covariance_mm2(self) -> Array:
        """Covariance (3, 3) of the position, without the error that all bubbles have in common."""
        return np.asarray(self.filter.P[POSITION, POSITION])

    def copy(self) -> Track:
        """Return a copy that can be changed without changing this track.

        The arrays are shared, because filterpy replaces its arrays and never writes into them.
        """
        return replace(self, filter=copy(self.filter), history=list(self.history))

    def predict(self, step: Transition, control: Array) -> None:
        """Move the state to the next frame.

        step : the transition over the time between the frames.
        control : (12,) vector that is added to the state because of the stage's motion.
        """
        self.filter.predict(u=control, B=_IDENTITY, F=step.matrix, Q=step.noise)

    def missed(self, shift: Array, mean_gain: Array, common_mm2: Array) -> None:
        """Update the track for a frame in which it has no measurement.

        shift : (12,) shift of this frame, common to all bubbles.
        mean_gain : (12, 3) mean Kalman gain of the bubbles that were measured.
        common_mm2 : (3, 3) covariance of the common position error.
        """
        self.misses += 1
        self.filter.x = self.filter.x + shift
        self.filter.P = self.filter.P + mean_gain @ common_mm2 @ mean_gain.T

    def update(self, z: Array, r: Array, shift: Array, mean_gain: Array, common_mm2: Array) -> None:
        """Update the track by a measured position.

        z : (3,) position in mm.  r : (3, 3) its covariance in mm^2.
        shift : (12,) shift of this frame, common to all bubbles.
        mean_gain : (12, 3) mean Kalman gain of the bubbles that were measured.
        common_mm2 : (3, 3) covariance of the common position error.
        """
        self.filter.x = self.filter.x + shift
        self.filter.update(z, R=r)
        unequal = mean_gain - self.filter.K
        self.filter.P = self.filter.P + unequal @ common_mm2 @ unequal.T

    def saw(self, frame: int, t_s: float, d_eq_mm: float) -> None:
        """Record that the track was measured in a frame.

        d_eq_mm : measured equivalent diameter, NaN if unknown.
        """
        self.seen_frame, self.seen_t_s, self.misses, self.near = frame, t_s, 0, None
        if np.isfinite(d_eq_mm):
            self.d_last_mm, self.d_before_mm = d_eq_mm, self.d_eq_mm
            if np.isfinite(self.d_eq_mm):
                self.d_eq_mm += _SIZE_GAIN * (d_eq_mm - self.d_eq_mm)
            else:
                self.d_eq_mm = d_eq_mm


def new_filter(x: Array, p: Array) -> Any:
    """Return a filterpy KalmanFilter that measures the position of a bubble.

    x : (12,) first state.  p : (12, 12) its covariance.

    The matrices F, Q and R are given with each prediction and each update.
    """
    from filterpy.kalman import KalmanFilter

    kalman = KalmanFilter(dim_x=len(x), dim_z=3)
    kalman.H = np.eye(3, len(x))
    kalman.x, kalman.P = np.array(x, float), np.array(p, float)
    return kalman


@dataclass(frozen=True)
class Common:
    """Hold the error that all bubbles of a frame have in common.

    shift : (12,) estimate of the common shift of this frame's states; it is not yet added to the
        tracks.
    covariance : (12, 12) covariance of the shift.
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
        """Return the common error in the next frame: the shift is 0, and the covariance has
        grown.
        """
        grown = step.matrix @ self.covariance @ step.matrix.T + step.common_noise
        return Common(np.zeros(STATES), grown)

    def informed(self, innovations: Array, covariances: Array) -> Common:
        """Return the common error after it has been estimated from E bubbles.

        innovations : (E, 3) measured minus predicted positions in mm.
        covariances : (E, 3, 3) covariances of the innovations in mm^2, without the common error.
        """
        if len(innovations) == 0:
            return self
        information = np.linalg.inv(covariances)
        score = np.einsum("eij,ej->i", information, innovations - self.shift_mm)
        total = information.sum(0)
        gain = self.covariance[:, POSITION] @ np.linalg.inv(np.eye(3) + total @ self.covariance_mm2)
        lost = gain @ total @ self.covariance[POSITION]
        return Common(self.shift + gain @ score, self.covariance - (lost + lost.T) / 2)

    def applied(self, mean_gain: Array) -> Common:
        """Return the error that remains after the tracks have taken over the shift and their
        measurements.

        mean_gain : (12, 3) mean Kalman gain of the measured tracks.
        """
        keep = np.eye(STATES)
        keep[:, POSITION] -= mean_gain
        return Common(np.zeros(STATES), keep @ self.covariance @ keep.T)
