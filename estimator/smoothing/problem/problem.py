"""What a smoothing problem is: measurements, geometry and the priors of bubbles and rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Ints
from telerig.errors import InputError
from telerig.factors.bubble_motion import BubbleModel, Triple
from telerig.rig.camera import Camera
from telerig.rig.units import STANDARD_GRAVITY_M_S2

CARRIAGE = -1
"""In place of a camera's index: a sensor on the carriage, or a mode common to all cameras."""


@dataclass(frozen=True)
class RigMode:
    """One vibration of the rig, independent along each axis where its RMS is not 0.

    camera : index of the camera whose arm shakes, or CARRIAGE for all cameras.
    force_hz : low-pass cut-off of the force (two poles); None: white, only without sensors.
    """

    frequency_hz: float
    damping: float
    rms_mm: Triple
    camera: int = CARRIAGE
    force_hz: float | None = 60.0


@dataclass(frozen=True)
class BroadBand:
    """Shake without modal knowledge, of one camera or (CARRIAGE) common to all.

    low_hz, high_hz, floor, tail : see `telerig.factors.state_space.broad_band`.  slow_rms_mm,
    slow_tau_s : an Ornstein-Uhlenbeck offset besides, which accelerometers do not measure.
    """

    rms_mm: Triple
    camera: int = CARRIAGE
    low_hz: float = 8.0
    high_hz: float = 60.0
    floor: float = 0.0
    slow_rms_mm: float = 0.0
    slow_tau_s: float = 0.1
    tail: int = 2


@dataclass(frozen=True)
class CarriageModel:
    """How the carriage moves along the axis.

    kind : "readings", no dynamics: its position at a frame is what the encoder reads there;
        "force", an acceleration of the given RMS, low-pass filtered by three poles at corner_hz,
        which accelerometers and slow encoders need.
    servo : (RMS mm, Hz, damping) of a following error besides.
    """

    kind: Literal["readings", "force"] = "readings"
    acceleration_rms_mm_s2: float = 1000.0
    corner_hz: float = 60.0
    servo: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class ShakeModel:
    """Every hyper-parameter of the smoother; each can be given.

    encoder_sigma_mm : of one reading.  encoder_scale_sigma, encoder_delay_sigma_s,
    accelerometer_scale_sigma, accelerometer_delay_sigma_s : priors of constants, 0 to hold them.
    pixel_inflation : factor on the stated pixel noise.  name : where the values come from.
    learned : sd of log-parameters, by name, of a model that was learned.
    """

    bubble: BubbleModel = field(default_factory=BubbleModel)
    modes: tuple[RigMode, ...] = ()
    broad_bands: tuple[BroadBand, ...] = ()
    carriage: CarriageModel = CarriageModel()
    encoder_sigma_mm: float = 0.005
    encoder_scale_sigma: float = 0.0
    encoder_delay_sigma_s: float = 0.0
    accelerometer_scale_sigma: float = 0.0
    accelerometer_delay_sigma_s: float = 0.0
    pixel_inflation: float = 1.0
    name: str = "given"
    learned: Mapping[str, float] = field(default_factory=dict)

    @property
    def force_hz(self) -> float | None:
        """Low-pass cut-off of the modes' forces; None where they are white, or differ."""
        cutoffs = {m.force_hz for m in self.modes if m.force_hz is not None}
        return cutoffs.pop() if len(cutoffs) == 1 else None

    def without_shake(self) -> ShakeModel:
        """The oracle's model: the cameras stand still on the carriage."""
        return replace(self, modes=(), broad_bands=())


@dataclass(frozen=True)
class Observations:
    """Pixels of one kind: frame, camera (M,), uv_px (M, 2), covariance_px2 (M, 2, 2).

    item : (M,) index of the bubble or mark.
    """

    item: Ints
    frame: Ints
    camera: Ints
    uv_px: Array
    covariance_px2: Array

    def __len__(self) -> int:
        return len(self.frame)

    def of(self, keep: NDArray[Any]) -> Observations:
        parts = (self.item, self.frame, self.camera, self.uv_px, self.covariance_px2)
        return Observations(*(p[keep] for p in parts))

    @staticmethod
    def none() -> Observations:
        ints = np.zeros(0, np.int64)
        return Observations(ints, ints, ints, np.zeros((0, 2)), np.zeros((0, 2, 2)))


@dataclass(frozen=True)
class Bubble:
    """particle : its id.  first, last : frames.  start_mm : (3,) lab, the prior's mean.

    guess_mm : (last - first + 1, 3) lab positions where the projection is linearised first.
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
    """A feature fixed to the tank. guess_mm : (3,) lab; the prior is that, within sigma_mm."""

    name: str
    guess_mm: Array
    sigma_mm: float = 30.0


@dataclass(frozen=True)
class Stage:
    """The encoder's record: t_s, position_mm (E,), a calibrated scale taken off."""

    t_s: Array
    position_mm: Array


@dataclass(frozen=True)
class Travel:
    """The stage's travel as known before the run.

    axis : (3,) unit vector in rig axes.  basis : (3, 2) unit vectors across it.
    scale : (reading - travel) / travel, already taken off the readings of `Stage`.
    covariance : (3, 3) of the axis' tilts (rad, along basis) and the scale.
    source : "stage_axis" (calibrated), "rig.toml" (stated) or "assumed".
    """

    axis: Array
    basis: Array
    scale: float
    covariance: Array
    source: Literal["stage_axis", "rig.toml", "assumed"]


@dataclass(frozen=True)
class Accelerometer:
    """One sensor. camera : index, or CARRIAGE.  t_s (N,), reading_mm_s2 (N, 3).

    axes : (3, 3) rows are its axes in rig coordinates.  sigma_mm_s2 : of one sample, each axis.
    delay_s : a reading stamped t describes t - delay.
    """

    name: str
    camera: int
    t_s: Array
    reading_mm_s2: Array
    axes: Array
    sigma_mm_s2: float
    bias_sigma_mm_s2: float = 200.0
    delay_s: float = 0.0


@dataclass(frozen=True)
class CalibrationShare:
    """What of the calibration's uncertainty reaches the pixels: unit-variance directions.

    root : (P, r), covariance = root root^T up to directions that move no pixel.
    free : per camera, names of the free intrinsics (the order of P, see `Calibration`).
    covariance : (P, P) before the run, ``root`` its part that moves pixels.
    drift : (6, 6) of a movement of the second camera since, which is part of it; None: held.
    """

    root: Array
    free: tuple[tuple[str, ...], ...]
    covariance: Array
    drift: Array | None = None


def check_increasing(t_s: Array, where: str, first_row: int) -> None:
    """Raises InputError that names the row at which times (N,) do not increase."""
    bad = np.flatnonzero(~(np.diff(t_s) > 0))
    if len(bad):
        raise InputError(
            f"times do not increase at row {int(bad[0]) + 1 + first_row}",
            where=where,
            todo="sort the rows and remove duplicates",
        )


@dataclass(frozen=True)
class SmoothingProblem:
    """Everything that was measured in one run, and the geometry it is seen through.

    t_s : (F,) frame times.  axis, up : (3,) unit vectors in rig axes.
    observations, references : pixels of ``bubbles`` and of ``marks``.
    travel : how well axis and encoder are known; None: exactly.
    gravity_m_s2 : of the laboratory, which accelerometers read at rest.
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

    @property
    def gravity_mm_s2(self) -> Array:
        """(3,) the acceleration of gravity in rig axes, downwards."""
        return -1000 * self.gravity_m_s2 * self.up

    @property
    def encoder_mm(self) -> Array:
        """(F,) the encoder's reading at the frames, interpolated; 0 without a stage."""
        if self.stage is None:
            return np.zeros(len(self.t_s))
        return np.asarray(np.interp(self.t_s, self.stage.t_s, self.stage.position_mm))

    @property
    def arms_with_sensor(self) -> set[int]:
        """Indices of the cameras whose arm carries an accelerometer."""
        return {a.camera for a in self.accelerometers} - {CARRIAGE}

    @property
    def measures_shake(self) -> bool:
        """Whether marks fixed to the tank, or an accelerometer on each arm, show the shake."""
        return len(self.references) > 0 or len(self.arms_with_sensor) == len(self.cameras)

    def __post_init__(self) -> None:
        """Raises InputError for times that do not increase or a run of fewer than two frames."""
        if len(self.t_s) < 2:
            raise InputError(
                f"a run of {len(self.t_s)} frame(s) has no motion to smooth",
                todo="give at least two frames",
            )
        stage = [] if self.stage is None else [("stage", self.stage.t_s)]
        sensors = [(f"accelerometer {a.name}", a.t_s) for a in self.accelerometers]
        for name, times in [("frames", self.t_s), *stage, *sensors]:
            check_increasing(times, name, 0)
