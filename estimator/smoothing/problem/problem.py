"""Definition of a smoothing problem: measurements, geometry, and the priors of bubbles and rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Ints
from telerig.errors import InputError
from telerig.factors.bubble_motion import BubbleModel, Triple
from telerig.rig.camera import Camera
from telerig.rig.units import STANDARD_GRAVITY_M_S2

if TYPE_CHECKING:
    from telerig.estimator.rig_drift.movement import Movement

CARRIAGE = -1
"""This value in place of a camera's index stands for a sensor on the carriage of the stage, or for
a vibration that is common to all cameras.
"""

ARMS = -2
"""In place of a camera's index: what all arms do alike, and a sensor on the carriage does not feel.
"""

DELAY_SIGMA_S = 0.002
"""Prior standard deviation of the delay of a record that is on the frames' clock."""

FEWEST_BUBBLES = 3
"""So many bubbles tell their own motion from that of the rig: with fewer, a line of one and of the
other fit nearly alike."""


@dataclass(frozen=True)
class RigMode:
    """One vibration mode of the rig, with independent motion along x, y and z.

    frequency_hz, damping : natural frequency and damping ratio.
    rms_mm : RMS displacement along x, y and z of the rig frame.
    camera : index of the camera whose arm vibrates, or CARRIAGE for all cameras.
    force_hz : cut-off frequency of the two-pole low-pass filter of the driving force. None for a
        white force, which is possible only without accelerometers.
    """

    frequency_hz: float
    damping: float
    rms_mm: Triple
    camera: int = CARRIAGE
    force_hz: float | None = 60.0


@dataclass(frozen=True)
class BroadBand:
    """Prior of shake with unknown modes, of one camera or of all cameras.

    rms_mm : RMS displacement along x, y and z of the rig frame.
    camera : index of the camera, or CARRIAGE or ARMS for all cameras.
    low_hz, high_hz, floor, tail : see `telerig.factors.state_space.broad_band`.
    """

    rms_mm: Triple
    camera: int = CARRIAGE
    low_hz: float = 8.0
    high_hz: float = 60.0
    floor: float = 0.0
    tail: int = 2


@dataclass(frozen=True)
class CarriageModel:
    """Prior of the carriage's motion along the travel axis.

    kind : "readings" for no dynamics: the position at a frame is the interpolated encoder reading.
        "force" for a random acceleration, which accelerometers and slow encoders need.
    acceleration_rms_mm_s2 : RMS of this acceleration.
    corner_hz : cut-off frequency of its three-pole low-pass filter.
    servo : (RMS (mm), frequency (Hz), damping ratio) of an additional oscillation, or None.
    """

    kind: Literal["readings", "force"] = "readings"
    acceleration_rms_mm_s2: float = 1000.0
    corner_hz: float = 60.0
    servo: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class ShakeModel:
    """All hyper-parameters of a smoothing: priors of bubbles and shake, and noise of the sensors.

    bubble : prior of the bubbles' motion.
    modes, broad_bands : priors of the rig's vibrations.
    carriage : prior of the carriage's motion.
    encoder_sigma_mm : standard deviation of an encoder reading.
    encoder_scale_sigma, accelerometer_scale_sigma : prior standard deviations of the relative scale
        errors; 0 if they are not estimated.
    accelerometer_delay_sigma_s : the same for the delay.
    pixel_inflation, mark_inflation : factors on the stated noise of the bubbles' and the marks'
        pixels.
    name : origin of the values: "given", "default" or "learned".
    learned : {hyper-parameter: standard deviation of its natural logarithm} of the learned ones.
    """

    bubble: BubbleModel = field(default_factory=BubbleModel)
    modes: tuple[RigMode, ...] = ()
    broad_bands: tuple[BroadBand, ...] = ()
    carriage: CarriageModel = CarriageModel()
    encoder_sigma_mm: float = 0.005
    encoder_scale_sigma: float = 0.0
    accelerometer_scale_sigma: float = 0.0
    accelerometer_delay_sigma_s: float = 0.0
    pixel_inflation: float = 1.0
    mark_inflation: float = 1.0
    name: str = "given"
    learned: Mapping[str, float] = field(default_factory=dict)

    @property
    def force_hz(self) -> float | None:
        """Cut-off frequency of the modes' forces; None if they are white or differ."""
        cutoffs = {m.force_hz for m in self.modes if m.force_hz is not None}
        return cutoffs.pop() if len(cutoffs) == 1 else None


@dataclass(frozen=True)
class Observations:
    """M measured pixels of bubbles or of marks.

    item, frame, camera : (M,) indices of the bubble or mark, the frame and the camera.
    uv_px : (M, 2).
    covariance_px2 : (M, 2, 2).
    """

    item: Ints
    frame: Ints
    camera: Ints
    uv_px: Array
    covariance_px2: Array

    def __len__(self) -> int:
        return len(self.frame)

    def of(self, keep: NDArray[Any]) -> Observations:
        """Return the chosen observations.

        keep : (M,) booleans, or indices.
        """
        parts = (self.item, self.frame, self.camera, self.uv_px, self.covariance_px2)
        return Observations(*(p[keep] for p in parts))

    @cached_property
    def in_order(self) -> bool:
        """Whether the observations are sorted by frame."""
        return bool(np.all(self.frame[1:] >= self.frame[:-1]))

    def between(self, first: int, end: int) -> Observations:
        """Return the observations in frames ``first`` to ``end`` - 1, with frames counted from
        ``first``.
        """
        keep: Any = (
            (self.frame >= first) & (self.frame < end)
            if not self.in_order
            else slice(*np.searchsorted(self.frame, (first, end)).tolist())
        )
        inside = self.of(keep)
        return replace(inside, frame=inside.frame - first)

    @staticmethod
    def none() -> Observations:
        """Return an empty set of observations."""
        ints = np.zeros(0, np.int64)
        return Observations(ints, ints, ints, np.zeros((0, 2)), np.zeros((0, 2, 2)))


@dataclass(frozen=True)
class Bubble:
    """One bubble to be smoothed.

    particle : its number in the tracks.
    first, last : its first and last frame.
    start_mm : (3,) prior mean of its first position in the laboratory frame.
    guess_mm : (last - first + 1, 3) positions at which the projection is first linearised.
    """

    particle: int
    first: int
    last: int
    start_mm: Array
    guess_mm: Array

    def __len__(self) -> int:
        return self.last - self.first + 1


@dataclass(frozen=True)
class Mark:
    """A mark fixed to the tank.

    guess_mm : (3,) prior mean of its position in the laboratory frame.
    sigma_mm : prior standard deviation along each axis.
    """

    name: str
    guess_mm: Array
    sigma_mm: float = 30.0


@dataclass(frozen=True)
class Stage:
    """E readings of the encoder.

    t_s : (E,) times.
    position_mm : (E,) positions, corrected for a calibrated scale error.
    delay_sigma_s : standard deviation of how much later than the frames' clock the times are.
    """

    t_s: Array
    position_mm: Array
    delay_sigma_s: float = DELAY_SIGMA_S


@dataclass(frozen=True)
class Travel:
    """Prior of the stage's travel axis and of the encoder's scale.

    axis : (3,) unit vector in the rig frame.
    basis : (3, 2) two unit vectors perpendicular to it.
    scale : relative scale error of the encoder, for which the readings of `Stage` are corrected.
    covariance : (3, 3) of the axis' two tilts (rad, along ``basis``) and of the scale.
    source : "stage_axis" if calibrated, "rig.toml" if stated there, "given" if a given model holds
        the scale, or "assumed".
    """

    axis: Array
    basis: Array
    scale: float
    covariance: Array
    source: Literal["stage_axis", "rig.toml", "given", "assumed"]


@dataclass(frozen=True)
class Accelerometer:
    """The record of one accelerometer with N samples.

    camera : index of the camera that carries it, or CARRIAGE.
    t_s : (N,).
    reading_mm_s2 : (N, 3).
    axes : (3, 3) the sensor's axes as rows, in the rig frame.
    sigma_mm_s2 : noise standard deviation of one sample.
    bias_sigma_mm_s2 : prior standard deviation of the bias of each axis.
    delay_s : prior mean of the delay; a sample with time t was measured at t - delay_s.
    clock : "frames" if its times are those of the frames' clock, "unknown" if the offset has to be
        found by alignment with the images.
    kept : (N,) whether each sample is used; the others are interpolated. None for all.
    unused_axes : indices of axes that are not used.
    offset_s, drift_ppm : clock offset and drift that the alignment subtracted from the times.
    offset_sd_s : standard deviation of the offset; None if none was found.
    confirmed : whether the images confirm its clock; None if this was not tested.
    clock_number : sensors with the same number were sampled together; None to tell that from their
        times.
    """

    name: str
    camera: int
    t_s: Array
    reading_mm_s2: Array
    axes: Array
    sigma_mm_s2: float
    bias_sigma_mm_s2: float = 200.0
    delay_s: float = 0.0
    clock: Literal["frames", "unknown"] = "frames"
    kept: Bools | None = None
    unused_axes: tuple[int, ...] = ()
    offset_s: float = 0.0
    offset_sd_s: float | None = None
    drift_ppm: float = 0.0
    confirmed: bool | None = None
    clock_number: int | None = None

    def of(self, which: NDArray[Any]) -> Accelerometer:
        """Return the sensor with some of its samples: (N,) booleans, indices, or a slice."""
        kept = None if self.kept is None else self.kept[which]
        return replace(
            self, t_s=self.t_s[which], reading_mm_s2=self.reading_mm_s2[which], kept=kept
        )


@dataclass(frozen=True)
class CalibrationShare:
    """Uncertainty of the calibration that affects pixels, in r independent directions of unit
    variance.

    root : (P, r); root root^T is the covariance of the rig block's P parameters, without directions
        that affect no pixel.
    free : names of the free intrinsics of each camera.
    covariance : (P, P) prior covariance.
    drift : a movement of a camera since the calibration, whose prior is included in it; None if
        none is assumed to have moved.
    """

    root: Array
    free: tuple[tuple[str, ...], ...]
    covariance: Array
    drift: Movement | None = None


ConstantFamily = Literal["sensors", "constants", "marks", "clocks"]


@dataclass(frozen=True)
class Known:
    """Information from other pieces of a run about constants x_k: the cost |sum_k A_k x_k - b|^2.

    keys : (family, index) of each constant.
    blocks : A_k (n, d_k).
    side : (n,) b.
    """

    keys: tuple[tuple[ConstantFamily, int], ...]
    blocks: tuple[Array, ...]
    side: Array


def check_increasing(t_s: Array, where: str) -> None:
    """Raise InputError, which names the row, if the times (N,) do not increase.

    where : name of the table for the message, in which rows count from 0.
    """
    bad = np.flatnonzero(~(np.diff(t_s) > 0))
    if len(bad):
        raise InputError(
            f"times do not increase at row {int(bad[0]) + 1}",
            where=where,
            todo="sort the rows and remove duplicates",
        )


@dataclass(frozen=True)
class SmoothingProblem:
    """Everything that was measured in one run of F frames, and the geometry of the rig.

    cameras : calibrated cameras.
    t_s : (F,) times of the frames.
    axis, up : (3,) unit vectors in the rig frame: the travel axis, and the direction opposite to
        gravity.
    bubbles, observations : the bubbles and their pixels.
    stage : record of the encoder; None without an encoder.
    accelerometers : records of the accelerometers.
    marks, references : the marks fixed to the tank and their pixels.
    calibration : uncertainty of the calibration; None if it affects no pixel.
    travel : prior of travel axis and encoder scale; None if they are exact.
    gravity_m_s2 : gravity in the laboratory.
    known : for a piece of a run, information from the other pieces about its constants.

    Raises InputError for times that do not increase and for fewer than two frames.
    """

    cameras: tuple[Camera, ...]
    t_s: Array
    axis: Array
    up: Array
    bubbles: tuple[Bubble, ...] = ()
    observations: Observations = field(default_factory=Observations.none)
    stage: Stage | None = None
    accelerometers: tuple[Accelerometer, ...] = ()
    marks: tuple[Mark, ...] = ()
    references: Observations = field(default_factory=Observations.none)
    calibration: CalibrationShare | None = None
    travel: Travel | None = None
    gravity_m_s2: float = STANDARD_GRAVITY_M_S2
    known: tuple[Known, ...] = ()

    @property
    def gravity_mm_s2(self) -> Array:
        """Acceleration of gravity (3,) in the rig frame, which points downwards."""
        return -1000 * self.gravity_m_s2 * self.up

    @property
    def encoder_mm(self) -> Array:
        """Readings (F,) of the encoder, interpolated at the frames; 0 without an encoder."""
        if self.stage is None:
            return np.zeros(len(self.t_s))
        return np.asarray(np.interp(self.t_s, self.stage.t_s, self.stage.position_mm))

    @property
    def in_encoder_record(self) -> Bools:
        """Whether each frame (F,) is within the encoder's record; True without an encoder."""
        if self.stage is None:
            return np.ones(len(self.t_s), bool)
        first, last = self.stage.t_s[[0, -1]]
        return np.asarray((self.t_s >= first - 1e-9) & (self.t_s <= last + 1e-9))

    def read(self, observed: Observations) -> Observations:
        """Return the observations in frames within the encoder's record: outside it `encoder_mm` is
        the reading at its end, whatever the carriage does."""
        inside = self.in_encoder_record
        return observed if inside.all() else observed.of(inside[observed.frame])

    @property
    def arms_with_sensor(self) -> set[int]:
        """Indices of the cameras whose arm carries an accelerometer."""
        return {a.camera for a in self.accelerometers} - {CARRIAGE}

    @property
    def measures_shake(self) -> bool:
        """Whether the shake is measured: by marks fixed to the tank, or a sensor on each arm."""
        return len(self.references) > 0 or len(self.arms_with_sensor) == len(self.cameras)

    def __post_init__(self) -> None:
        """Raise InputError for times that do not increase or a run of fewer than two frames."""
        if len(self.t_s) < 2:
            raise InputError(
                f"the run has {len(self.t_s)} frame(s), which show no motion",
                todo="give at least two frames",
            )
        stage = [] if self.stage is None else [("stage", self.stage.t_s)]
        sensors = [(f"accelerometer {a.name}", a.t_s) for a in self.accelerometers]
        for name, times in [("frames", self.t_s), *stage, *sensors]:
            check_increasing(times, name)
