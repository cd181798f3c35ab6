"""Motion of bubbles, shake and stage between two frames, exact for any time between them.

The state of a bubble has 12 components in the rig frame: position (mm), velocity (mm/s),
acceleration (mm/s^2) and drift velocity (mm/s), three components each. The velocity is relative to
the laboratory once an encoder has given the stage's speed, and relative to the rig before that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from telerig.arrays import Array
from telerig.estimator.tracking.filter.types import TrackerSettings
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
