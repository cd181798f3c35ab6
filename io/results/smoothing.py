"""The files of a smoothed run: smoothing.json, trajectories.csv, shake.csv."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Any, ClassVar

from pydantic import Field

from telerig.io.files.csv_table import Column
from telerig.io.results.record import Part, Record, Vector3
from telerig.io.results.tracking import RigChange

AXES = ("x", "y", "z")
POSITION, VELOCITY = "{}_mm", "v{}_mm_s"
"""Columns of trajectories.csv for an axis; with "s", "naive_" and "rts_" in front the standard
deviation and two simpler estimates."""


class Verdict(StrEnum):
    """Can the run tell the bubbles' motion from the rig's shake? From the best to the worst."""

    RESOLVED = "RESOLVED"
    PARTIAL = "PARTIAL"
    UNRESOLVED = "UNRESOLVED"


class Flag(StrEnum):
    """Conditions that qualify a verdict."""

    LABEL_AMBIGUOUS = "LABEL_AMBIGUOUS"
    SHAKE_BELOW_NOISE = "SHAKE_BELOW_NOISE"


class AttributedLine(Part):
    """A spectral line, its owner, and the log-likelihood ratio against the other owner."""

    owner: str = ""
    frequency_hz: float
    rms_mm: float | None = None
    other_owner_costs_nats: float | None = None
    ambiguous: bool = False


class AxisVerdict(Part):
    """The verdict along one axis of the rig, and the numbers behind it."""

    verdict: Verdict | None = None
    flags: tuple[str, ...] = ()
    q: float | None = None
    eta: float | None = None
    sigma_mm: float | None = None
    sigma_shake_known_mm: float | None = None
    shake_rms_mm: float | None = None
    lines: tuple[AttributedLine, ...] = ()
    words: str = ""


class Mode(Part):
    """A vibration of the rig: of the model, or a peak in the spectrum of the estimated shake."""

    where: str
    frequency_hz: float
    damping: float | None = None
    rms_mm: tuple[float, ...] | float | None = None
    source: str = ""
    remedy: str = ""


class PixelResiduals(Part):
    """Residuals of the pixels in units of their stated standard deviations."""

    pixels: int = 0
    outliers: int = 0
    rms_sigmas: float | None = None
    median_sigmas: float | None = None


class SmoothingFile(Record):
    """smoothing.json. ``depth_axes``: per camera, the direction in rig axes that it cannot see."""

    MISSING: ClassVar[str] = "this run is not smoothed"
    MAKE: ClassVar[str] = "telerig smooth RUN"
    AGAIN: ClassVar[str] = "smooth again (`telerig smooth`), or name the right results folder"

    verdict: Verdict | None = None
    flags: tuple[str, ...] = ()
    axes: dict[str, AxisVerdict] = Field(default_factory=dict)
    words: str = ""
    remedy: str = ""
    left_out: tuple[str, ...] = ()
    modes: tuple[Mode, ...] = ()
    schema_: int = Field(1, alias="schema")
    cameras: tuple[str, ...] = ()
    frames: int | None = None
    bubbles: int | None = None
    model: dict[str, Any] = Field(default_factory=dict)
    log_evidence: float | None = None
    passes: int | None = None
    states: dict[str, Any] = Field(default_factory=dict)
    unseen: dict[str, Any] = Field(default_factory=dict)
    depth_axes: dict[str, Vector3] = Field(default_factory=dict)
    residuals: dict[str, PixelResiduals] = Field(default_factory=dict)
    whiteness: dict[str, Any] = Field(default_factory=dict)
    accelerometer_spectra: dict[str, Any] = Field(default_factory=dict)
    encoder: dict[str, Any] = Field(default_factory=dict)
    travel: dict[str, Any] = Field(default_factory=dict)
    accelerometers: dict[str, Any] = Field(default_factory=dict)
    bubble_means: dict[str, Any] = Field(default_factory=dict)
    rig_change: RigChange | None = None
    warnings: tuple[str, ...] = ()


def _optional(names: Sequence[str]) -> list[Column]:
    return [Column(name, required=False, blank=True) for name in names]


def shake_columns(cameras: Sequence[str]) -> list[Column]:
    """Columns of shake.csv."""
    columns = [Column("frame", "whole"), Column("t_s")]
    for camera in cameras:
        columns += [Column(f"{camera}_{axis}_mm") for axis in AXES]
        columns += _optional([f"s{camera}_{axis}_mm" for axis in AXES])
    return columns + _optional(["position_mm", "sposition_mm"])


STATE = tuple(pattern.format(axis) for pattern in (POSITION, VELOCITY) for axis in AXES)
"""Position and velocity columns of trajectories.csv."""

TRAJECTORIES = [
    Column("frame", "whole"),
    Column("particle", "whole"),
    Column("t_s"),
    *_optional([f"{kind}{name}" for kind in ("", "s", "naive_", "rts_") for name in STATE]),
    *_optional(["observed"]),
]
