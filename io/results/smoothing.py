"""Describe smoothing.json, the summary of a smoothed run."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from telerig.io.results.cameras import CameraRecord, rig_cameras
from telerig.io.results.record import Name, Part, Record, Vector3
from telerig.io.results.tracking import RigChange
from telerig.io.tables.smoothing import AXES
from telerig.rig.camera import Camera


class Verdict(StrEnum):
    """Name whether a run can separate the bubbles' motion from the rig's shake, best case first.

    CONTRADICTED means that the measurements disagree, so that no standard deviation can be right.
    """

    RESOLVED = "RESOLVED"
    PARTIAL = "PARTIAL"
    UNRESOLVED = "UNRESOLVED"
    CONTRADICTED = "CONTRADICTED"


RESOLVED_Q, PARTIAL_Q = 1.25, 2.0
"""Largest q (`AxisVerdict`) of an axis that is RESOLVED whatever its eta, and of one that is
PARTIAL. A quarter is less than the scatter of a standard deviation from a few periods of shake; at
2, three quarters of a position's variance are the shake's.
"""
RESOLVED_ETA, PARTIAL_ETA = 0.95, 0.75
"""Smallest eta of an axis that is RESOLVED whatever its q, and of one that is PARTIAL. At most 22 %
of the shake's RMS is then left in the paths, and at most half of it.
"""


class Flag(StrEnum):
    """Name a condition under which a verdict has to be read with care.

    SHAKE_BELOW_NOISE : the shake is smaller than the noise of the positions.
    SHAKE_UNMEASURED : nothing but the motion of one or two bubbles at a time shows the shake, so
        that all numbers depend on the priors.
    ARMS_UNMEASURED : an accelerometer measures the carriage, and nothing but the motion of one or
        two bubbles at a time shows how the cameras' arms move on it.
    """

    SHAKE_BELOW_NOISE = "SHAKE_BELOW_NOISE"
    SHAKE_UNMEASURED = "SHAKE_UNMEASURED"
    ARMS_UNMEASURED = "ARMS_UNMEASURED"


class Remedy(StrEnum):
    """Name the measurements that would separate the shake better."""

    STRIP = "strip"
    ARMS = "arms"
    BARE_ARMS = "bare arms"
    LONGER = "longer"


class Disagreement(StrEnum):
    """Name the test that showed a contradiction."""

    RESIDUALS = "residuals"
    OUTLIERS = "outliers"
    BIAS = "bias"
    DELAY = "delay"
    SPEED = "speed"
    SHIFT = "shift"
    TURN = "turn"
    GROWTH = "growth"


class Quantity(StrEnum):
    """Name a quantity of the bubbles for which a run may be good."""

    MEAN_VELOCITY = "mean velocity"
    PATH = "path"
    PLACE = "place"
    ZIGZAG_AMPLITUDE = "zigzag amplitude"
    ZIGZAG_FREQUENCY = "zigzag frequency"
    VELOCITY = "velocity"
    ACCELERATION = "acceleration"


class Grade(StrEnum):
    """Name how well a run determines a quantity, best case first."""

    GOOD = "good"
    LIMITED = "limited"
    NO = "no"


class Place(StrEnum):
    """Name the part of the rig that a vibration moves.

    If only one camera sees the axis of a vibration, it is not known whether the camera's arm or the
    whole rig vibrates.
    """

    COMMON = "common"
    ARM = "arm"
    ONE_VIEW = "seen only by"
    SERVO = "servo"


class AxisVerdict(Part):
    """Hold the verdict along one axis of the rig, and the numbers on which it is based.

    Numbers are None where they were not computed.
    q : standard deviation of a position divided by the one it would have if the shake were known.
    eta : share of the shake's variance that the data have removed, 1 at best. The shake is the one
        that the run shows: its estimate's mean square plus variance.
    sigma_mm, sigma_shake_known_mm : these two standard deviations of a position in mm.
    sigma_encoder_mm : standard deviation that the encoder's scale and the travel axis add to all
        positions alike, in mm. `sigma_mm` is without it.
    sigma_offset_mm : standard deviation in mm of an offset that all positions share: the encoder's
        delay and where the cameras stood are not known. No other standard deviation contains it.
    shake_rms_mm : RMS of the shake in mm of the camera that shakes most.
    """

    verdict: Verdict | None = None
    flags: tuple[str, ...] = ()
    q: float | None = None
    eta: float | None = None
    sigma_mm: float | None = None
    sigma_shake_known_mm: float | None = None
    sigma_encoder_mm: float | None = None
    sigma_offset_mm: float | None = None
    shake_rms_mm: float | None = None


def worst_of(axes: Mapping[str, AxisVerdict]) -> Verdict:
    """Return the worst of the verdicts along the axes, which is that of the run."""
    found = [axis.verdict for axis in axes.values() if axis.verdict is not None]
    return max(found, key=list(Verdict).index)


def vertical_axis(up: Vector3) -> str:
    """Return the axis nearest to the vertical.

    up : (3,) unit vector against gravity.
    """
    return AXES[int(np.abs(up).argmax())]


class Contradiction(Part):
    """Hold a source of measurements that disagrees with others.

    source : "bubbles", "marks", "encoder", or the name of an accelerometer.
    axis : axis of the rig or of the sensor; "" for all.
    from_s, to_s : the first and the last time at which they disagree.
    statistic : how many times larger than expected the disagreement is, in standard deviations.
    test : the test that showed the disagreement; None in files of other programs.
    against : the sources with which this one disagrees; () if they are not known.
    camera : the camera in whose images it shows; "" if not in those of one alone.
    hz : frequency of a motion that the images of this camera share; None for one from ``from_s``
        on, and for other tests.
    """

    source: str
    axis: str = ""
    from_s: float
    to_s: float
    statistic: float
    test: Disagreement | None = None
    against: tuple[str, ...] = ()
    camera: str = ""
    hz: float | None = None


class Use(Part):
    """Hold how well a run determines one quantity of the bubbles.

    A place is compared with the path about a line: its standard deviation contains what all places
    share, which that of the path does not.

    axis : axis of the rig.
    value : the median over the bubbles; None if there is none.
    sd : standard deviation of the quantity for a typical bubble; None if it is not known.
    unit : unit of value and sd.
    below_hz : for a path, the frequency up to which ``sd`` holds; for an acceleration, the
        frequency up to which it is followed; None for other quantities.
    assumes : records on which the value depends, and whose sign, unit or scale nothing in the run
        confirms.
    """

    quantity: Quantity
    axis: str
    value: float | None = None
    sd: float | None = None
    unit: str
    grade: Grade
    below_hz: float | None = None
    assumes: tuple[str, ...] = ()


class Mode(Part):
    """Hold a vibration of the rig: one of the model, or a peak in the estimated shake's spectrum.

    where : the part of the rig that vibrates.
    frequency_hz : its frequency in Hz.
    damping : damping ratio; None where it is not known.
    rms_mm : RMS of the displacement in mm, in total or for each axis; None where it is not known.
    source : the probable cause in words.
    place, camera : ``where`` as a code and the name of a camera.
    """

    where: str
    place: Place
    camera: str = ""
    frequency_hz: float
    damping: float | None = None
    rms_mm: tuple[float, ...] | float | None = None
    source: str = ""


class PixelResiduals(Part):
    """Hold statistics of pixel residuals, divided by the standard deviations of their white noise.

    pixels, outliers : number of detections, and how many of them are outliers.
    rms_sigmas, median_sigmas : RMS and median of these ratios; None where there are none.
    """

    pixels: int = 0
    outliers: int = 0
    rms_sigmas: float | None = None
    median_sigmas: float | None = None


class SmoothingFile(Record):
    """Hold the content of smoothing.json, the result of smoothing a run.

    Sentences in the file (``words``, ``remedy``) are for people; nothing reads them.

    verdict, flags, axes : the verdict on the run, conditions under which it has to be read with
        care (`Flag`), and the verdict by axis.
    contradictions : the sources that disagree, the worst first.
    inflation : factor by axis by which the standard deviations in the tables have been multiplied
        because of contradictions; () without.
    usable_for : what this run is good for, by quantity and axis.
    vertical, remedies : the axis nearest to the vertical, and the remedy as codes.
    rig, walls : the calibrated cameras and refractive windows that the run was smoothed with, by
        name.
    frames, bubbles : how many were smoothed.
    modes : the vibrations of the rig.
    log_evidence : logarithm of the model's probability density for the data; None if not computed.
    up, gravity_m_s2 : unit vector against gravity in rig axes, and gravity.
    fluid : the keys of [fluid] in rig.toml; empty without one.
    bodies : how far the bubbles of the run are from spheroids, and their outlines from ellipses.
    swarm : numbers per volume of liquid.
    depth_axes : by camera, unit vector (3,) in rig axes along which that camera cannot measure.
    learning : from which part of a long run the modes were learned, and how well they fit the other
        parts.
    seconds : wall time by phase.
    rig_change : movement of the cameras relative to each other; None where it was not tested.
    acceleration_bandwidth_hz : by axis, the frequency up to which accelerations are followed by at
        least half; {} without accelerations.
    inertia_s, inertia_by_axis_s, force_intensity, swing_damping : time constant of the low-pass
        filter through which forces move a bubble, the longest and by axis, and by axis the
        intensity of the path's forces and the damping of the zigzags, divided by those in the
        model; None and {} without accelerations.
    white_noise : standard deviation of the pixels' white noise "along" the rise and "across" it,
        divided by the stated one.
    along_path : variances of "velocity" and "acceleration" along the bubbles' paths, divided by
        those that errors independent along the axes would have; {} without accelerations.
    """

    MISSING: ClassVar[str] = "this run is not smoothed"
    MAKE: ClassVar[str] = "telerig smooth RUN"
    AGAIN: ClassVar[str] = "smooth again (`telerig smooth`), or name the right results folder"

    VERDICT: ClassVar[tuple[str, ...]] = (
        "verdict", "flags", "axes", "contradictions", "inflation", "usable_for", "words", "remedy",
        "remedies", "vertical", "left_out", "modes",
    )  # fmt: skip
    """The keys that belong to the verdict, `Smoothing.verdict`; the others are the summary."""

    verdict: Verdict | None = None
    flags: tuple[str, ...] = ()
    axes: dict[str, AxisVerdict] = Field(default_factory=dict)
    contradictions: tuple[Contradiction, ...] = ()
    inflation: tuple[float, ...] = ()
    usable_for: tuple[Use, ...] = ()
    remedies: tuple[Remedy, ...] = ()
    vertical: str = ""
    left_out: tuple[str, ...] = ()
    modes: tuple[Mode, ...] = ()
    schema_: int = Field(1, alias="schema")
    cameras: tuple[Name, ...] = ()
    rig: dict[Name, CameraRecord] = Field(default_factory=dict)
    walls: dict[str, dict[str, Any]] = Field(default_factory=dict)
    frames: int | None = None
    bubbles: int | None = None
    model: dict[str, Any] = Field(default_factory=dict)
    log_evidence: float | None = None
    passes: int | None = None
    states: dict[str, Any] = Field(default_factory=dict)
    unseen: dict[str, Any] = Field(default_factory=dict)
    up: Vector3 | None = None
    gravity_m_s2: float | None = None
    fluid: dict[str, Any] = Field(default_factory=dict)
    bodies: dict[str, float] = Field(default_factory=dict)
    swarm: dict[str, Any] = Field(default_factory=dict)
    depth_axes: dict[str, Vector3] = Field(default_factory=dict)
    residuals: dict[str, PixelResiduals] = Field(default_factory=dict)
    whiteness: dict[str, Any] = Field(default_factory=dict)
    accelerometer_spectra: dict[str, Any] = Field(default_factory=dict)
    encoder: dict[str, Any] = Field(default_factory=dict)
    travel: dict[str, Any] = Field(default_factory=dict)
    accelerometers: dict[str, Any] = Field(default_factory=dict)
    bubble_means: dict[str, Any] = Field(default_factory=dict)
    acceleration_bandwidth_hz: dict[str, float] = Field(default_factory=dict)
    inertia_s: float | None = None
    inertia_by_axis_s: dict[str, float] = Field(default_factory=dict)
    force_intensity: dict[str, float] = Field(default_factory=dict)
    swing_damping: dict[str, float] = Field(default_factory=dict)
    white_noise: dict[str, float] = Field(default_factory=dict)
    along_path: dict[str, float] = Field(default_factory=dict)
    rig_change: RigChange | None = None
    learning: dict[str, Any] = Field(default_factory=dict)
    seconds: dict[str, float] = Field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    accepted: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _parameters_are_known(self) -> Self:
        self.rig_cameras()
        return self

    def rig_cameras(self) -> tuple[Camera, ...]:
        """Return the cameras that the run was smoothed with."""
        return rig_cameras(self.rig, self.walls)
