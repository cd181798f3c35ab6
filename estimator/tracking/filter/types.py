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
    """Defaults suit bubbles of 5 mm that rise at 280 mm/s, seen at 100 to 1000 Hz.

    rise_mm_s, birth_speed_sd_mm_s : velocity of a new track along the travel axis and its sd on
        each axis; without an encoder the mean is 0 and the sd birth_speed_sd_no_encoder_mm_s.
    lateral_acceleration_mm_s2, rise_acceleration_mm_s2 : RMS across and along the travel axis.
    acceleration_time_s : correlation time of the acceleration along the axis (Singer's model).
    zigzag_hz, zigzag_damping : frequency at which the velocity across the travel axis oscillates,
        and its damping ratio: small for one frequency, 0.7 for any up to it.
    drift_sd_mm_s, drift_time_s : of the slow velocity across the axis about which it oscillates.
    shake_sd_mm, shake_time_s : offset common to all bubbles in a frame, sd and correlation time.
    stage_acceleration_mm_s2 : of the stage, where the encoder does not give its position.
    size_scatter : relative sd of d_eq_mm from frame to frame; size_cap_log_ratio : largest penalty
        (log-likelihood) of a wrong size.
    detection_probability, missed_again_probability : of a bubble in a frame; of one that was
        missed in the frame before to be missed again. end_probability : to leave for good in a
        frame; so a track that was missed for long hardly claims a measurement.
    new_per_mm3, new_per_px2 : density of clutter and new bubbles in space and in one image.
    gate_probability : that a true continuation lies inside its gate.
    margin_log_ratio : least log-likelihood ratio to the runner-up for a safe decision when the
        window ends; prune_log_ratio : hypotheses further behind the best are dropped at once.
    window_frames : how long a conflict may stay open. max_hypotheses : per conflict.
    confirm_hits, confirm_frames : a new track needs so many measurements in its first frames.
    gap_s, gap_frames : a track unseen for longer than both ends.
    balance_tolerance : of the volume, to call a birth a split or an end a merger.
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
    """Bubbles that one camera saw without a partner in the other.

    camera : (L,) index; uv_px : (L, 2); covariance_px2 : (L, 2, 2).
    """

    camera: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    uv_px: Array = field(default_factory=lambda: np.zeros((0, 2)))
    covariance_px2: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))

    def __len__(self) -> int:
        return len(self.uv_px)


@dataclass(frozen=True)
class FrameMeasurements:
    """One frame's bubbles, in the rig frame.

    points_mm : (M, 3); covariance_mm2 : (M, 3, 3); d_eq_mm : (M,), NaN where unknown;
    confidence : (M,) in (0, 1]; particle : (M,) given ids, -1 where there is none.
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
        """Checked: raises InputError for shapes that do not fit, or values that are not finite."""
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
        """Positions of the bubbles with given ids."""
        return np.flatnonzero(self.particle != NO_PARTICLE)

    @property
    def free(self) -> Ints:
        """Positions of the others."""
        return np.flatnonzero(self.particle == NO_PARTICLE)


@dataclass(frozen=True)
class TrackEvent:
    """kind : birth, death, gap, break, resolved, split or merge.

    particles : the tracks concerned, the older first; frame, t_s : when; reason : a sentence.
    """

    kind: str
    frame: int
    t_s: float
    particles: tuple[int, ...]
    reason: str


@dataclass(frozen=True)
class FrameIds:
    """Final: particle : (M,) and single : (L,) ids of a frame's measurements, -1 for none."""

    frame: int
    particle: Ints
    single: Ints


@dataclass(frozen=True)
class SeenAlone:
    """A track after its update by one camera alone: point_mm (3,), d_eq_mm (NaN if unknown)."""

    point_mm: Array
    d_eq_mm: float


@dataclass(frozen=True)
class Motion:
    """From the frame before: a bubble's state x -> matrix @ x + offset (n,), plus noise (n, n).

    The offset holds the stage's travel and the shift common to all bubbles.
    """

    matrix: Array
    noise: Array
    offset: Array

    def shifted(self, shift: Array, covariance_mm2: Array) -> Motion:
        """With the common shift (n,) and the covariance of its position (3, 3)."""
        noise = self.noise.copy()
        noise[:3, :3] += covariance_mm2
        return Motion(self.matrix, noise, self.offset + shift)


@dataclass(frozen=True)
class FrameResult:
    """particle, single : ids as of now, the best guess where a conflict or a birth is still open.

    final : the earlier frames (and this one, if nothing is open) whose ids are final now, in
        order; write these to the tables. events : what became known in this frame.
    alone : by index of the single measurement, the tracks that one camera alone continued.
    motion : None in the first frame.
    """

    frame: int
    particle: Ints
    single: Ints
    events: tuple[TrackEvent, ...]
    final: tuple[FrameIds, ...]
    alone: Mapping[int, SeenAlone] = field(default_factory=dict)
    motion: Motion | None = None
