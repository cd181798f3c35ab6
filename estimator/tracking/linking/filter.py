"""Holds the tracker's settings, its results of a frame, and the Kalman filter of one bubble with
its motion model.

The state of a bubble has 12 components in the rig frame: position (mm), velocity (mm/s),
acceleration (mm/s^2) and drift velocity (mm/s), three components each. The velocity is relative to
the laboratory once an encoder has given the stage's speed, and relative to the rig before that.

The error of a bubble is its own error plus the common error. `States.p` is the covariance of the
own error, which is independent between bubbles; `Common` carries the error that shake and stage
give to all bubbles alike. Both follow the same equation of motion, so that a prediction keeps this
form. The Kalman gain is the matrix by which a filter multiplies the measured minus the predicted
position to correct its state. An update keeps the form if all bubbles have the same gain; a gain
that differs from the mean adds its share to the own error. Differences between bubbles are free of
the common error.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from telerig.arrays import Array, Bools, Ints, Rows
from telerig.estimator.tracking.linking.frames import NO_PARTICLE, Bubbles, Motion
from telerig.factors.bubble_motion import lateral_motion, rise_motion
from telerig.factors.state_space import exact_step


@dataclass(frozen=True)
class TrackerSettings:
    """Hold the settings of the tracker.

    The defaults suit bubbles of 5 mm that rise at 280 mm/s and are recorded at 100 to 1000 Hz.
    "Along" and "across" refer to the direction in which bubbles rise.

    rise_mm_s : mean velocity of a new track along it, used if an encoder gives the stage's
        motion; otherwise the mean is 0.
    birth_speed_sd_mm_s, birth_speed_sd_no_encoder_mm_s : standard deviation (sd) of a new track's
        velocity in each coordinate, with and without an encoder.
    lateral_acceleration_mm_s2, rise_acceleration_mm_s2 : RMS acceleration across and along it.
    acceleration_time_s : correlation time of the acceleration along it (Singer's model).
    zigzag_hz, zigzag_damping : frequency at which the velocity across it oscillates, and its
        damping ratio. A small ratio means one frequency; 0.7 means any frequency up to zigzag_hz.
    drift_sd_mm_s, drift_time_s : sd and correlation time of the slow velocity across it about
        which the velocity oscillates.
    shake_sd_mm, shake_time_s : sd and correlation time of the offset that all bubbles of a frame
        share.
    stage_acceleration_mm_s2 : RMS acceleration of the stage in frames without an encoder position.
    missed_again_probability : probability that a bubble which was missed in the frame before is
        missed again.
    end_probability : probability that a bubble leaves for good in a frame. Because of it, a track
        that was missed for many frames is less likely to be given a measurement.
    new_per_mm3 : density of false detections and new bubbles in space (1/mm^3).
    margin_log_ratio : smallest log-likelihood ratio between the best and the second-best hypothesis
        for which the best one counts as unambiguous when the window ends; below it, the tracks are
        cut.
    prune_log_ratio : a hypothesis whose log-likelihood is smaller than the best one's by more than
        this is dropped at once.
    window_frames : number of frames for which a conflict (tracks that compete for the same
        measurements) may stay undecided.
    max_hypotheses : largest number of hypotheses in one conflict.
    confirm_hits, confirm_frames : a new track is confirmed if it has at least confirm_hits
        measurements in its first confirm_frames frames.
    gap_s, gap_frames : a track that is unseen for longer than both of these ends.
    balance_tolerance : largest difference between the volumes before and after, as a share of the
        larger bubble's volume, for which a birth counts as a split or a death as a merger.
    """

    rise_mm_s: float = 280.0
    birth_speed_sd_mm_s: float = 120.0
    birth_speed_sd_no_encoder_mm_s: float = 300.0
    lateral_acceleration_mm_s2: float = 3000.0
    rise_acceleration_mm_s2: float = 1800.0
    acceleration_time_s: float = 0.02
    zigzag_hz: float = 6.5
    zigzag_damping: float = 0.2
    drift_sd_mm_s: float = 100.0
    drift_time_s: float = 0.5
    shake_sd_mm: float = 0.3
    shake_time_s: float = 0.01
    stage_acceleration_mm_s2: float = 3000.0
    missed_again_probability: float = 0.5
    end_probability: float = 0.002
    new_per_mm3: float = 1e-5
    margin_log_ratio: float = 4.6
    prune_log_ratio: float = 9.0
    window_frames: int = 25
    max_hypotheses: int = 30
    confirm_hits: int = 3
    confirm_frames: int = 4
    gap_s: float = 0.05
    gap_frames: int = 3
    balance_tolerance: float = 0.25


@dataclass(frozen=True)
class TrackEvent:
    """Describe one event in the life of tracks.

    kind : "birth", "death", "gap" (frames without a measurement were bridged), "break" (a track was
        cut because its continuation was not safe), "resolved" (a conflict was decided), "split" or
        "merge".
    frame, t_s : frame and its time in s.
    particles : ids of the tracks concerned, the older track first.
    reason : the reason in words.
    """

    kind: str
    frame: int
    t_s: float
    particles: tuple[int | str, ...]
    reason: str


@dataclass(frozen=True)
class FrameIds:
    """Hold the final track ids (M,) of the measurements of a frame, -1 for no track."""

    frame: int
    particle: Ints


@dataclass(frozen=True)
class FrameResult:
    """Hold what the tracker returns for one frame.

    events : events that became known in this frame.
    final : ids of frames that are final now, in the order of the frames; this frame is among them
        if nothing in it is undecided. Write these ids to the tables.
    motion : motion of the bubbles since the frame before; None in the first frame.
    """

    events: tuple[TrackEvent, ...]
    final: tuple[FrameIds, ...]
    motion: Motion | None = None


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

    def step(self, position_mm: float | None, t_s: float, dt_s: float) -> tuple[float, bool, float]:
        """Return the stage's motion over one interval and remember the reading.

        Returns the travel along the axis (mm), whether the encoder gave it, and the stage's speed
        (mm/s) in the one interval that ends with the second reading, otherwise 0: before that
        reading, velocities are relative to the rig.

        position_mm : reading of the encoder at the end of the interval. If it is None or NaN, the
            last speed is assumed to continue, and the next reading corrects the position.
        t_s : time of the end of the interval.
        dt_s : its length.
        """
        if position_mm is None or not np.isfinite(position_mm):
            moved = self.speed_mm_s * dt_s if self.in_lab else 0.0
            self.assumed_mm += moved
            return moved, False, 0.0
        if not np.isfinite(self.read_mm):
            self._read(position_mm, t_s)
            return 0.0, False, 0.0
        speed = (position_mm - self.read_mm) / (t_s - self.read_t_s)
        moved = position_mm - self.assumed_mm if self.in_lab else speed * dt_s
        found = 0.0 if self.in_lab else speed
        self.in_lab, self.speed_mm_s = True, speed
        self._read(position_mm, t_s)
        return moved, True, found

    def _read(self, position_mm: float, t_s: float) -> None:
        self.read_mm = self.assumed_mm = float(position_mm)
        self.read_t_s = float(t_s)


_SIZE_GAIN = 0.25
"""Weight of a new diameter in a track's running mean."""


@dataclass(frozen=True)
class Scan:
    """One frame: its number, its time and the bubbles that are measured in it."""

    frame: int
    t_s: float
    measured: Bubbles
    settings: TrackerSettings


@dataclass(frozen=True)
class States(Rows):
    """K states of bubbles that are followed. A track has one for each hypothesis about it.

    x, p : (K, 12), (K, 12, 12) states and the covariances of their own errors.
    track : (K,) ids of the tracks; below `NO_PARTICLE` until they are confirmed.
    given : (K,) whether the id came with the data; such a track follows its id alone.
    sizes_mm : (K, 3) running means of the equivalent diameter, the same before the last
        measurement, and the last measured diameter; NaN where unknown.
    born_frame, seen_frame, seen_t_s : (K,) frames of the first and last measurements, and its time.
    hits : (K,) numbers of measurements.
    """

    x: Array
    p: Array
    track: Ints
    given: Bools
    sizes_mm: Array
    born_frame: Ints
    seen_frame: Ints
    seen_t_s: Array
    hits: Ints

    @staticmethod
    def born(
        scan: Scan, columns: Ints, tracks: Ints, velocity_mm_s: Array, encoder: bool
    ) -> States:
        """Return new tracks (K,) at measurements of a frame, with a velocity (3,) and the
        covariance of `birth_covariance`."""
        measured, settings, many = scan.measured, scan.settings, len(columns)
        x = np.zeros((many, STATES))
        x[:, POSITION], x[:, VELOCITY] = measured.points_mm[columns], velocity_mm_s
        p = np.tile(birth_covariance(settings, np.zeros((3, 3)), encoder), (many, 1, 1))
        p[:, POSITION, POSITION] = measured.covariance_mm2[columns]
        size = measured.d_eq_mm[columns]
        now = np.full(many, scan.frame)
        return States(
            x, p, tracks, measured.given[columns] != NO_PARTICLE,
            np.stack([size, np.full(many, np.nan), size], -1), now, now.copy(),
            np.full(many, scan.t_s), np.ones(many, np.int64),
        )  # fmt: skip

    @property
    def points_mm(self) -> Array:
        """Positions (K, 3) in the rig frame."""
        return self.x[:, POSITION]

    def predicted(self, step: Transition, found_mm_s: Array, control: Array) -> States:
        """Return the states in the next frame.

        found_mm_s : (3,) added to the velocities before the step. control : (12,) added after it.
        """
        x = self.x.copy()
        x[:, VELOCITY] += found_mm_s
        p = step.matrix @ self.p @ step.matrix.T + step.noise
        return replace(self, x=x @ step.matrix.T + control, p=p)

    def updated(
        self, scan: Scan, columns: Ints, shift: Array, common_mm2: Array, mean_gain: Array
    ) -> States:
        """Return the states after a frame in which each has a measurement, or none.

        columns : (K,) indices of the measurements, -1 for none.
        shift, common_mm2 : (K, 12), (K, 3, 3) shift of the frame, common to all bubbles, and the
            covariance of the common position error, under each hypothesis.
        mean_gain : (12, 3) mean Kalman gain of the bubbles that were measured.
        """
        measured, seen, at = scan.measured, columns >= 0, columns[columns >= 0]
        x, p = self.x + shift, self.p.copy()
        gain = np.zeros((len(self), STATES, 3))
        own, noise = p[seen], measured.covariance_mm2[at]
        gain[seen] = mine = own[..., POSITION] @ np.linalg.inv(own[:, POSITION, POSITION] + noise)
        left = measured.points_mm[at] - x[seen][:, POSITION]
        x[seen] += (mine @ left[..., None])[..., 0]
        kept = np.tile(np.eye(STATES), (len(own), 1, 1))
        kept[..., POSITION] -= mine
        p[seen] = kept @ own @ kept.mT + mine @ noise @ mine.mT  # Joseph's form: keeps it positive
        unequal = mean_gain - gain
        p += unequal @ common_mm2 @ unequal.mT
        size = np.full(len(self), np.nan)
        size[seen] = np.where(measured.alone[at], np.nan, measured.d_eq_mm[at])
        mean = self.sizes_mm[:, 0]
        grown = np.where(np.isfinite(mean), mean + _SIZE_GAIN * (size - mean), size)
        sizes = np.where(
            np.isfinite(size)[:, None], np.stack([grown, mean, size], -1), self.sizes_mm
        )
        return replace(
            self, x=x, p=p, sizes_mm=sizes, hits=self.hits + seen,
            seen_frame=np.where(seen, scan.frame, self.seen_frame),
            seen_t_s=np.where(seen, scan.t_s, self.seen_t_s),
        )  # fmt: skip


_JUMP = 10.0
"""Standard deviation of an unusual movement of the rig in a frame, over that of the shake."""

_SHAKE_GAIN = 0.25
"""Weight of a new shift in the running mean of the shake's variance."""


@dataclass(frozen=True)
class Common:
    """Hold the error that all bubbles of a frame have in common.

    shift : (12,) estimate of the common shift of this frame's states; it is not yet added to the
        tracks.
    covariance : (12, 12) covariance of the shift.
    usual_mm2 : mean square that shake and stage are expected to move the bubbles in this frame.
    excess : what it was in the last frames, over that; at least 1.
    """

    shift: Array = field(default_factory=lambda: np.zeros(STATES))
    covariance: Array = field(default_factory=lambda: np.zeros((STATES, STATES)))
    usual_mm2: float = np.inf
    excess: float = 1.0

    @property
    def shift_mm(self) -> Array:
        """Return the shift (3,) that all bubbles have in common."""
        return self.shift[POSITION]

    @property
    def covariance_mm2(self) -> Array:
        """Return the covariance (3, 3) of `shift_mm`."""
        return self.covariance[POSITION, POSITION]

    def predicted(self, step: Transition) -> Common:
        """Return the error that all tracks share in the next frame, before its measurements.

        Its mean is 0, because the last estimate has been added to the tracks' states. Its
        covariance has grown by the noise of the transition, which is larger in a run that shakes
        more than the settings say.
        """
        grown = step.matrix @ self.covariance @ step.matrix.T + self.excess * step.common_noise
        usual = float(np.trace(step.common_noise[POSITION, POSITION]))
        return Common(np.zeros(STATES), grown, usual, self.excess)

    def jumped(self, settings: TrackerSettings) -> Common:
        """Return the common error in a frame in which the rig has moved unusually far."""
        covariance = self.covariance.copy()
        covariance[POSITION, POSITION] += (_JUMP * settings.shake_sd_mm) ** 2 * np.eye(3)
        return replace(self, covariance=covariance)

    def informed(self, innovations: Array, information: Array) -> Common:
        """Return the common error after it has been estimated from E bubbles.

        innovations : (E, 3) measured minus predicted positions in mm.
        information : (E, 3, 3) inverse covariances of the innovations in 1/mm^2, without the common
            error.
        """
        if len(innovations) == 0:
            return self
        score = np.einsum("eij,ej->i", information, innovations - self.shift_mm)
        total = information.sum(0)
        gain = self.covariance[:, POSITION] @ np.linalg.inv(np.eye(3) + total @ self.covariance_mm2)
        lost = gain @ total @ self.covariance[POSITION]
        covariance = self.covariance - (lost + lost.T) / 2
        return replace(self, shift=self.shift + gain @ score, covariance=covariance)

    def applied(self, mean_gain: Array) -> Common:
        """Return the error that remains after the tracks have taken over the shift and their
        measurements.

        mean_gain : (12, 3) mean Kalman gain of the measured tracks.
        """
        keep = np.eye(STATES)
        keep[:, POSITION] -= mean_gain
        # nothing moves the rig where the settings say so
        moved = float(self.shift_mm @ self.shift_mm) / (self.usual_mm2 or np.inf)
        excess = max(1.0, self.excess + _SHAKE_GAIN * (moved - self.excess))
        return Common(np.zeros(STATES), keep @ self.covariance @ keep.T, excess=excess)
