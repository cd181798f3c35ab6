"""Input, output and settings of the tracker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Ints
from telerig.errors import InputError

NO_PARTICLE = -1


@dataclass(frozen=True)
class TrackerSettings:
    """Hold the settings of the tracker.

    The defaults suit bubbles of 5 mm that rise at 280 mm/s and are recorded at 100 to 1000 Hz.
    "Along" and "across" refer to the stage's travel axis. Raises InputError for values outside
    their range.

    rise_mm_s : mean velocity of a new track along the axis, used if an encoder gives the stage's
        motion; otherwise the mean is 0.
    birth_speed_sd_mm_s, birth_speed_sd_no_encoder_mm_s : standard deviation (sd) of a new track's
        velocity in each coordinate, with and without an encoder.
    lateral_acceleration_mm_s2, rise_acceleration_mm_s2 : RMS acceleration across and along the
        axis.
    acceleration_time_s : correlation time of the acceleration along the axis (Singer's model).
    zigzag_hz, zigzag_damping : frequency at which the velocity across the axis oscillates, and its
        damping ratio. A small ratio means one frequency; 0.7 means any frequency up to zigzag_hz.
    drift_sd_mm_s, drift_time_s : sd and correlation time of the slow velocity across the axis about
        which the velocity oscillates.
    shake_sd_mm, shake_time_s : sd and correlation time of the offset that all bubbles of a frame
        share.
    stage_acceleration_mm_s2 : acceleration of the stage in frames without an encoder position.
    size_scatter : relative sd of d_eq_mm (equivalent diameter) from frame to frame.
    size_cap_log_ratio : largest penalty of a wrong size, as a difference of log-likelihoods.
    detection_probability : probability that a bubble is detected in a frame.
    missed_again_probability : probability that a bubble which was missed in the frame before is
        missed again.
    end_probability : probability that a bubble leaves for good in a frame. Because of it, a track
        that was missed for long hardly claims a measurement.
    new_per_mm3, new_per_px2 : density of false detections and new bubbles in space (1/mm^3) and in
        one image (1/px^2).
    gate_probability : probability that the true continuation of a track lies inside its gate.
    margin_log_ratio : smallest log-likelihood ratio between the best and the second-best hypothesis
        for which the best one counts as safe when the window ends.
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
    size_scatter: float = 0.05
    size_cap_log_ratio: float = 4.5
    detection_probability: float = 0.95
    missed_again_probability: float = 0.5
    end_probability: float = 0.002
    new_per_mm3: float = 1e-5
    new_per_px2: float = 1e-5
    gate_probability: float = 0.9999
    margin_log_ratio: float = 4.6
    prune_log_ratio: float = 9.0
    window_frames: int = 25
    max_hypotheses: int = 30
    confirm_hits: int = 3
    confirm_frames: int = 4
    gap_s: float = 0.05
    gap_frames: int = 3
    balance_tolerance: float = 0.25

    def __post_init__(self) -> None:
        probabilities = ("detection_probability", "missed_again_probability", "gate_probability")
        positive = ("acceleration_time_s", "drift_time_s", "shake_time_s", "size_scatter")
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name in probabilities:
                good, todo = 0 < value < 1, "give a number between 0 and 1"
            elif item.name in positive:
                good, todo = value > 0, "give a positive number"
            else:
                good, todo = value >= 0, "give a number of at least 0"
            if not good:
                raise InputError(f"{item.name} = {value}", todo=todo)
        if not 1 <= self.confirm_hits <= self.confirm_frames:
            raise InputError(
                f"confirm_hits = {self.confirm_hits}, confirm_frames = {self.confirm_frames}",
                todo="give confirm_hits from 1 to confirm_frames",
            )


@dataclass(frozen=True)
class SingleMeasurements:
    """Hold the L bubbles of one frame that only one camera saw.

    camera : (L,) index of the camera.
    uv_px : (L, 2) pixel (u, v).
    covariance_px2 : (L, 2, 2) covariance of the pixel in px^2.
    """

    camera: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    uv_px: Array = field(default_factory=lambda: np.zeros((0, 2)))
    covariance_px2: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))

    def __len__(self) -> int:
        return len(self.uv_px)


@dataclass(frozen=True)
class FrameMeasurements:
    """Hold the M bubbles of one frame that both cameras saw, and the bubbles seen by only one
    camera.

    points_mm : (M, 3) positions in the rig frame.
    covariance_mm2 : (M, 3, 3) covariances of the positions.
    d_eq_mm : (M,) equivalent diameters, NaN where unknown.
    confidence : (M,) confidence in (0, 1] that the pair of detections is one bubble.
    particle : (M,) ids given with the data, -1 where no id is given.
    singles : the bubbles that only one camera saw.
    """

    points_mm: Array
    covariance_mm2: Array
    d_eq_mm: Array
    confidence: Array
    particle: Ints
    singles: SingleMeasurements

    @staticmethod
    def create(
        points_mm: ArrayLike,
        covariance_mm2: ArrayLike,
        *,
        d_eq_mm: ArrayLike | None = None,
        confidence: ArrayLike | None = None,
        particle: ArrayLike | None = None,
        singles: SingleMeasurements | None = None,
    ) -> FrameMeasurements:
        """Return the measurements of a frame after checking them.

        points_mm : (M, 3).  covariance_mm2 : (M, 3, 3), or one (3, 3) for all points.
        d_eq_mm : (M,); None if all diameters are unknown.
        confidence : (M,); None for 1 everywhere.
        particle : (M,) whole numbers, -1 for no id; None if no ids are given.
        singles : bubbles seen by only one camera; None for none.

        Raises InputError for shapes that do not fit, for points or covariances that are not finite,
        and for an id that occurs twice.
        """
        points = np.asarray(points_mm, float).reshape(-1, 3)
        m = len(points)
        covariance = np.broadcast_to(np.asarray(covariance_mm2, float), (m, 3, 3))
        size = np.full(m, np.nan) if d_eq_mm is None else np.asarray(d_eq_mm, float)
        sure = np.ones(m) if confidence is None else np.asarray(confidence, float)
        ids = np.full(m, NO_PARTICLE) if particle is None else np.asarray(particle)
        for name, values in (("d_eq_mm", size), ("confidence", sure), ("particle", ids)):
            if values.shape != (m,):
                raise InputError(
                    f"{name} has shape {values.shape} for {m} points", todo="give one per point"
                )
        if not (np.isfinite(points).all() and np.isfinite(covariance).all()):
            raise InputError(
                "points or covariances are not finite",
                todo="leave out bubbles that could not be triangulated",
            )
        given = ids[ids != NO_PARTICLE]
        if len(np.unique(given)) < len(given):
            raise InputError("a particle id occurs twice in one frame", todo="give each id once")
        alone = SingleMeasurements() if singles is None else singles
        return FrameMeasurements(points, covariance, size, sure, ids.astype(np.int64), alone)

    def __len__(self) -> int:
        return len(self.points_mm)

    @property
    def labelled(self) -> Ints:
        """Indices of the bubbles whose ids were given with the data."""
        return np.flatnonzero(self.particle != NO_PARTICLE)

    @property
    def free(self) -> Ints:
        """Indices of the bubbles without a given id."""
        return np.flatnonzero(self.particle == NO_PARTICLE)


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
    particles: tuple[int, ...]
    reason: str


@dataclass(frozen=True)
class FrameIds:
    """Hold the final track ids of one frame's measurements.

    frame : number of the frame.
    particle : (M,) ids of the bubbles that both cameras saw, -1 for no track.
    single : (L,) ids of the bubbles that one camera saw, -1 for no track.
    """

    frame: int
    particle: Ints
    single: Ints


@dataclass(frozen=True)
class SeenAlone:
    """Describe a track after an update by a measurement of only one camera.

    point_mm : (3,) position in the rig frame.
    d_eq_mm : equivalent diameter, NaN if unknown.
    """

    point_mm: Array
    d_eq_mm: float


@dataclass(frozen=True)
class Motion:
    """Describe the motion of every bubble from the frame before to this frame.

    A bubble's state x (see `motion`) becomes matrix @ x + offset, plus random noise.

    matrix : (12, 12).
    noise : (12, 12) covariance of the random part.
    offset : (12,) effect of the stage's travel and of the shift that all bubbles share.
    """

    matrix: Array
    noise: Array
    offset: Array

    def shifted(self, shift: Array, covariance_mm2: Array) -> Motion:
        """Return this motion with the shift of a frame added, which all bubbles share.

        shift : (12,) is added to the offset.
        covariance_mm2 : (3, 3) covariance of the shift's position, which is added to the noise.
        """
        noise = self.noise.copy()
        noise[:3, :3] += covariance_mm2
        return Motion(self.matrix, noise, self.offset + shift)


@dataclass(frozen=True)
class FrameResult:
    """Hold what the tracker returns for one frame with M pairs and L single-camera measurements.

    particle, single : (M,) and (L,) ids as known now, -1 for no track. While a conflict or a birth
        is undecided, they are the best guess.
    events : events that became known in this frame.
    final : ids of earlier frames that are final now, in the order of the frames; this frame is
        among them if nothing in it is undecided. Write these ids to the tables.
    alone : tracks that only one camera continued, by index of the single-camera measurement.
    motion : motion of the bubbles since the frame before; None in the first frame.
    """

    frame: int
    particle: Ints
    single: Ints
    events: tuple[TrackEvent, ...]
    final: tuple[FrameIds, ...]
    alone: Mapping[int, SeenAlone] = field(default_factory=dict)
    motion: Motion | None = None
