"""Kalman filter of one bubble, its motion model, and the error that all bubbles have in common.

The state of a bubble has 12 components in the rig frame: position (mm), velocity (mm/s),
acceleration (mm/s^2) and drift velocity (mm/s), three components each. The velocity is relative to
the laboratory once an encoder has given the stage's speed, and relative to the rig before that.

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
from functools import lru_cache
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.estimator.tracking.filter.types import NO_PARTICLE, TrackerSettings
from telerig.factors.bubble_motion import lateral_motion, rise_motion
from telerig.factors.state_space import exact_step

POSITION, VELOCITY, ACCELERATION, DRIFT = (slice(3 * i, 3 * i + 3) for i in range(4))
STATES = 12


@dataclass(frozen=True)
class Transition:
    """Describe how states change over one interval: x becomes matrix @ x, plus random noise.

    matrix : (12, 12).
    noise : (12, 12) covariance of each bubble's own random motion.
    common_noise : (12, 12) covariance of the motion that all bubbles share: the shake and, without
        an encoder, the motion of the stage.
    """

    matrix: Array
    noise: Array
    common_noise: Array


@lru_cache(maxsize=256)
def transition(
    settings: TrackerSettings, up: tuple[float, float, float], dt_s: float, encoder: bool
) -> Transition:
    """Return the transition of every bubble over an interval.

    up : unit vector in the rig frame along which bubbles rise.
    dt_s : length of the interval.
    encoder : whether an encoder gives the stage's motion over this interval.
    """
    along = np.outer(up, up)
    rise = rise_motion(settings.rise_acceleration_mm_s2, settings.acceleration_time_s)
    lateral = lateral_motion(
        settings.lateral_acceleration_mm_s2,
        settings.zigzag_hz,
        settings.zigzag_damping,
        settings.drift_sd_mm_s,
        settings.drift_time_s,
    )
    full, noise = np.zeros((STATES, STATES)), np.zeros((STATES, STATES))
    for model, direction in ((rise, along), (lateral, np.eye(3) - along)):
        matrix, spread = exact_step(*model, dt_s)
        full += np.kron(matrix, direction)
        noise += np.kron(spread, direction)
    return Transition(full, noise, _common_noise(settings, dt_s, encoder))


def _common_noise(settings: TrackerSettings, dt_s: float, encoder: bool) -> Array:
    """Return the covariance (12, 12) of the motion that all bubbles share.

    The shake is an Ornstein-Uhlenbeck process. The unknown acceleration of the stage is constant
    over the interval.
    """
    out = np.zeros((STATES, STATES))
    forgotten = -np.expm1(-dt_s / settings.shake_time_s)
    out[POSITION, POSITION] = 2 * settings.shake_sd_mm**2 * forgotten * np.eye(3)
    if not encoder:
        speed = settings.stage_acceleration_mm_s2 * dt_s
        gain = np.kron(np.array([dt_s / 2, 1.0]), np.eye(3)).reshape(3, 6).T * speed
        out[:6, :6] += gain @ gain.T
    return out


def birth_covariance(settings: TrackerSettings, measured: Array, encoder: bool) -> Array:
    """Return the covariance (12, 12) of a new track's state.

    measured : (3, 3) covariance of the measured position in mm^2.
    encoder : whether an encoder has given the stage's speed.
    """
    out = np.zeros((STATES, STATES))
    speed = settings.birth_speed_sd_mm_s
    if not encoder:
        speed = settings.birth_speed_sd_no_encoder_mm_s
    out[POSITION, POSITION] = measured
    out[VELOCITY, VELOCITY] = speed**2 * np.eye(3)
    out[ACCELERATION, ACCELERATION] = settings.lateral_acceleration_mm_s2**2 * np.eye(3)
    out[DRIFT, DRIFT] = settings.drift_sd_mm_s**2 * np.eye(3)
    return out


@dataclass(frozen=True)
class StageStep:
    """Describe the stage's motion over one interval.

    moved_mm : travel of the stage along its axis.
    known : whether the encoder gave it.
    found_speed_mm_s : the stage's speed in the one interval that ends with the second reading of
        the encoder, otherwise 0. Before that reading, velocities are relative to the rig.
    """

    moved_mm: float
    known: bool
    found_speed_mm_s: float


@dataclass
class StageMotion:
    """Follow the stage's motion, which is the known input of all filters, with and without an
    encoder.

    in_lab : whether velocities are relative to the laboratory, because the encoder has given a
        speed.
    read_mm, read_t_s : position and time of the last reading of the encoder, NaN before the first.
    assumed_mm : position of the stage that the filters assume.
    speed_mm_s : speed between the last two readings.
    """

    in_lab: bool = False
    read_mm: float = float("nan")
    read_t_s: float = float("nan")
    assumed_mm: float = float("nan")
    speed_mm_s: float = 0.0

    def step(self, position_mm: float | None, t_s: float, dt_s: float) -> StageStep:
        """Return the stage's motion over one interval and remember the reading.

        position_mm : reading of the encoder at the end of the interval. If it is None or NaN, the
            last speed is assumed to continue, and the next reading corrects the position.
        t_s : time of the end of the interval.  dt_s : its length.
        """
        if position_mm is None or not np.isfinite(position_mm):
            moved = self.speed_mm_s * dt_s if self.in_lab else 0.0
            self.assumed_mm += moved
            return StageStep(moved, False, 0.0)
        if not np.isfinite(self.read_mm):
            self._read(position_mm, t_s)
            return StageStep(0.0, False, 0.0)
        speed = (position_mm - self.read_mm) / (t_s - self.read_t_s)
        moved = position_mm - self.assumed_mm if self.in_lab else speed * dt_s
        found = 0.0 if self.in_lab else speed
        self.in_lab, self.speed_mm_s = True, speed
        self._read(position_mm, t_s)
        return StageStep(moved, True, found)

    def _read(self, position_mm: float, t_s: float) -> None:
        self.read_mm = self.assumed_mm = float(position_mm)
        self.read_t_s = float(t_s)


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
