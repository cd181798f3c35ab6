"""Describe tracking.json, the summary of a tracked run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

from pydantic import Field, model_validator

from telerig.arrays import Array
from telerig.io.results.cameras import CameraRecord, rig_cameras
from telerig.io.results.record import Name, Part, Record, Vector3
from telerig.rig.camera import Camera


class WorstFrame(Part):
    """Hold a frame that a person should inspect, because its tracking is doubtful.

    score : how doubtful the frame is; None if the file does not state it.
    why : the reason in words.
    """

    frame: int
    score: float | None = None
    why: str = ""


class Pairs(Part):
    """Hold the statistics of the ray misses of all pairs of detections.

    The numbers are in px; None where they were not computed.

    bias_px : the systematic part of the ray miss: a constant, or the coefficients of a polynomial
        in the position whose first one is the constant.
    rms_px : four RMS values of the ray misses, each less the shift that the pairs of its frame
        share: as they are; minus the constant; minus the whole systematic part; and minus the
        systematic part that all other pairs give.
    scatter_px : standard deviation of the scatter of single pairs beyond the noise of their
        detections.
    frame_px : RMS of the shift that all pairs of a frame share, for example because of shake.
    calibration_problem : whether the ray misses indicate a wrong calibration.
    words : sentences for the user.
    """

    bias_px: float | tuple[float, ...] | None = None
    rms_px: tuple[float | None, ...] = ()
    scatter_px: float | None = None
    frame_px: float | None = None
    calibration_problem: bool = False
    words: tuple[str, ...] = ()


class RigChange(Part):
    """Hold how far a camera has moved relative to another one since the calibration.

    camera : the camera that is described.
    against : the other one.
    culprit : of more than two cameras the one that has moved, if all others agree.
    moved : whether the movement is significant.
    offset_mm : its part along the common perpendicular in mm; None where it is not known.
    """

    camera: str = ""
    against: str = ""
    culprit: str = ""
    moved: bool = False
    offset_mm: float | None = None
    words: str = ""


class TrackingFile(Record):
    """Hold the content of tracking.json, the result of tracking a run.

    frames, detections, points, tracks : their numbers; None where they were not counted.
    cameras, walls : the calibrated cameras and refractive windows that the run was tracked with, by
        name.
    events : number of events of each kind.
    pairs : statistics of the ray miss, or None.
    rig_change : movement of the cameras relative to each other; None where it was not tested.
    up : (3,) unit vector against gravity in the rig frame; None where it is not known.
    extrapolated : share of the points beyond the dots of the calibration; None if it is not known.
    calibration_sd_mm : RMS over the points of the standard deviations (3,) by the calibration.
    """

    KIND: ClassVar[str] = "telerig tracks"
    MISSING: ClassVar[str] = "no tracks here"
    MAKE: ClassVar[str] = "telerig track RUN"
    AGAIN: ClassVar[str] = "track again (`telerig track`), or name the right results folder"

    schema_: int = Field(1, alias="schema")
    kind: str
    run: str = ""
    pixel_origin: str = "centre"
    frame_of_reference: str = ""
    image_size_px: dict[Name, tuple[int, int] | None] = Field(default_factory=dict)
    cameras: dict[Name, CameraRecord] = Field(default_factory=dict)
    walls: dict[str, dict[str, Any]] = Field(default_factory=dict)
    frames: int | None = None
    detections: int | None = None
    points: int | None = None
    tracks: int | None = None
    detections_without_partner_or_track: int | None = None
    frames_without_bubbles: dict[Name, dict[str, int]] = Field(default_factory=dict)
    events: dict[str, int] = Field(default_factory=dict)
    pairs: Pairs | None = None
    shapes: dict[str, float] = Field(default_factory=dict)
    covariance: str = ""
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    rig_change: RigChange | None = None
    references: dict[str, Any] | None = None
    worst_frames: tuple[WorstFrame, ...] = ()
    up: Vector3 | None = None
    extrapolated: float | None = None
    calibration_sd_mm: Vector3 | None = None

    @model_validator(mode="after")
    def _parameters_are_known(self) -> Self:
        self.rig_cameras()
        return self

    def rig_cameras(self) -> tuple[Camera, ...]:
        """Return the cameras that the run was tracked with."""
        return rig_cameras(self.cameras, self.walls)


def share_words(sd_mm: Sequence[float] | Array | None, extrapolated: float | None) -> list[str]:
    """Return sentences on the errors that the calibration causes, and on extrapolated positions.

    sd_mm : (3,) as in `TrackingFile.calibration_sd_mm`; None if it is not known. extrapolated :
    share of the positions that lie beyond the dots of the calibration; None if it is not known.
    """
    words = []
    if sd_mm is not None:
        x, y, z = (f"{1e3 * sd:.2g}" for sd in sd_mm)
        words.append(
            f"The calibration adds errors of {x}, {y} and {z} µm in x, y and z (1 sd, RMS over the "
            "positions), which are common to the run: calibration_sx_mm, _sy_mm and _sz_mm."
        )
    if extrapolated:
        words.append(
            f"{100 * extrapolated:.2g} % of the positions lie beyond the dots of the calibration "
            "in an image, where the lens is extrapolated (extrapolated = 1). Views with the target "
            "there would show how good it is."
        )
    return words
