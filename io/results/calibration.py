"""The files of a calibration: calibration.json, comparison.json, tables and arrays."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import BeforeValidator, Field, field_serializer, model_validator

from telerig.arrays import Array
from telerig.errors import InputError, TelerigError
from telerig.io.files.csv_table import Column
from telerig.io.results.record import (
    Matrix2,
    Matrix3,
    Matrix3x2,
    Numbers,
    Part,
    Points3,
    Record,
    Square,
    Vector3,
    Wholes,
)
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.projection import intrinsics_from
from telerig.rig.windows import Wall

_AGAIN = "calibrate again (`telerig calibrate`), or name the right results folder"


class Status(StrEnum):
    """How far a calibration may be used."""

    GOOD = "GOOD"
    USABLE = "USABLE, with warnings"
    REJECTED = "REJECTED"
    IMPORTED = "IMPORTED"


class Verdict(Part):
    status: Status
    reasons: tuple[str, ...] = ()


class PoseRecord(Part):
    """A rigid transformation; ``rotvec_deg`` says the rotation once more for a reader."""

    rotation: Matrix3
    rotvec_deg: Vector3 | None = None
    translation_mm: Vector3

    @classmethod
    def of_pose(cls, pose: Pose) -> Self:
        return cls(
            rotation=pose.rotation,
            rotvec_deg=np.degrees(pose.rotvec_rad),
            translation_mm=pose.translation_mm,
        )

    def pose(self) -> Pose:
        return Pose(self.rotation, self.translation_mm)


class CameraRecord(Part):
    """A calibrated camera. ``standard_deviations`` are of the ``free`` parameters."""

    image_size_px: tuple[int, int]
    rho_mm: float = Field(gt=0)
    parameters: dict[str, float]
    free: tuple[str, ...] = ()
    standard_deviations: dict[str, float | None] = Field(default_factory=dict)
    camera_from_rig: PoseRecord


class Target(Part):
    """``points_mm`` (N, 3) of the ``dots`` (N,), in the target's frame."""

    dots: Wholes
    points_mm: Points3

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if len(self.dots) != len(self.points_mm):
            raise ValueError(f"{len(self.dots)} dots, but {len(self.points_mm)} points")
        return self


class Covariance(Part):
    """``matrix`` (P, P) of the components ``names``."""

    names: tuple[str, ...]
    matrix: Square

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if self.matrix.shape != (len(self.names),) * 2:
            raise ValueError(f"{len(self.names)} names, but a matrix of {self.matrix.shape}")
        return self


class Mirror(Part):
    """Which of the two mirror-symmetric solutions was kept, and what decided.

    nominal_rotvec_deg : of the second of two cameras, or by camera of more.
    """

    cost: float | None = None
    other_cost: float | None = None
    decided_by: str = ""
    words: str = ""
    nominal_rotvec_deg: Numbers | Mapping[str, Numbers] | None = None


class LadderStep(Part):
    """A lens model that was tried. Numbers are None for a model that was not fitted.

    held_out : mean squared error of the prediction of left-out views.
    """

    model: str = ""
    camera: str = ""
    added: tuple[str, ...] = ()
    taken: bool = True
    chi2_gain: float | None = None
    bic_gain: float | None = None
    p_value: float | None = None
    words: str = ""
    parameters: int | None = None
    chi2_dof: float | None = None
    bic: float | None = None
    rms_px: float | None = None
    held_out: float | None = None
    held_out_before: float | None = None


class LensModel(Part):
    """The lens model of each camera, and the ladder of models that were tried."""

    name: str = ""
    by_camera: dict[str, str] = Field(default_factory=dict)
    words: str = ""
    ladder: tuple[LadderStep, ...] = ()


class Stage(Part):
    """Travel axis and encoder scale.

    axis : unit vector in the rig frame.  basis : two unit vectors across it, about which its
        tilts are counted.  encoder_scale : the share by which the encoder reads too much.
    joint_covariance : of both tilts (rad) and the scale.
    wander_sigma_mm : of the carriage across the axis, position_sigma_mm : along it.
    """

    axis: Vector3
    basis: Matrix3x2
    axis_covariance_rad2: Matrix2 | None = None
    encoder_scale: float
    encoder_scale_sd: float | None = None
    joint_covariance: Matrix3
    chi2_dof: float | None = None
    position_sigma_mm: float | None = None
    wander_sigma_mm: float | None = None
    notes: tuple[str, ...] = ()


class Diagnostics(Part):
    gauge: str = ""
    weak: tuple[str, ...] = ()
    tilts_deg: dict[str, float | None] = Field(default_factory=dict)
    halves: dict[str, Any] = Field(default_factory=dict)
    structure: dict[str, Any] = Field(default_factory=dict)
    next_view: dict[str, Any] = Field(default_factory=dict)


class CalibrationFile(Record):
    """calibration.json."""

    KIND: ClassVar[str] = "telerig calibration"
    MISSING: ClassVar[str] = "no calibration here"
    MAKE: ClassVar[str] = "telerig calibrate DATASET"
    AGAIN: ClassVar[str] = _AGAIN

    schema_: int = Field(1, alias="schema")
    kind: str
    name: str = ""
    pixel_origin: str = "centre"
    units: dict[str, str] = Field(default_factory=dict)
    gauge: str = ""
    medium: str = "air"
    verdict: Verdict
    cameras: dict[str, CameraRecord] = Field(min_length=1)
    walls: dict[str, dict[str, Any]] = Field(default_factory=dict)
    target: Target
    views: dict[str, PoseRecord]
    covariance: Covariance | None = None
    model: LensModel = LensModel()
    stage: Annotated[Stage | None, BeforeValidator(lambda stage: stage or None)] = None
    twin: Mirror = Mirror()
    statistics: dict[str, Any] = Field(default_factory=dict)
    diagnostics: Diagnostics = Diagnostics()
    notes: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _parameters_are_known(self) -> Self:
        try:
            self.rig_cameras(behind_walls=True)
        except (KeyError, TypeError, TelerigError) as error:
            raise ValueError(f"lacks or garbles {error}"[:200]) from error
        return self

    @field_serializer("stage")
    def _stage_or_empty(self, stage: Stage | None) -> dict[str, Any]:
        return {} if stage is None else stage.content()

    def rig_cameras(self, *, behind_walls: bool) -> tuple[Camera, ...]:
        """The cameras, with the glass walls of the water tank before them or without."""
        walls = self.walls if behind_walls else {}
        return tuple(
            Camera(
                name, c.image_size_px, c.rho_mm, intrinsics_from(c.parameters),
                c.camera_from_rig.pose(), Wall.from_dict(walls[name]) if name in walls else None,
            )
            for name, c in self.cameras.items()
        )  # fmt: skip


class Change(Part):
    """One quantity: ``change`` of the second minus the first calibration, in ``unit``.

    deviations : the change over its standard deviation; None where that is 0.
    """

    quantity: str
    unit: str
    change: float
    sd: float
    deviations: float | None = None


class ComparisonFile(Record):
    """comparison.json: what changed since an earlier calibration of the same rig."""

    AGAIN: ClassVar[str] = _AGAIN

    earlier: str | None = None
    verdict: str = ""
    words: str | tuple[str, ...] = ""
    changes: tuple[Change, ...] = ()


RESIDUALS = [
    *(Column(name, "text") for name in ("view", "camera")),
    *(Column(name, "whole") for name in ("dot", "row", "column")),
    *(Column(name) for name in ("u_px", "v_px", "du_px", "dv_px", "weight")),
    Column("reason", "text", blank=True),
]
DOT_COVARIANCE = ("suu_px2", "suv_px2", "svv_px2")
DOTS = [
    *(Column(name, "text") for name in ("view", "camera")),
    Column("dot", "whole"),
    *(Column(name, required=False) for name in DOT_COVARIANCE),
]
_UNCERTAINTY = ("points_mm", "calibration_mm2", "measurement_mm2", "sigma_px")
_DOT_EXAMPLE = ("patch", "model", "u0", "v0", "u_px", "v_px", "a_px", "b_px", "angle_rad", "noise")


def read_joint_covariance(file: Path) -> tuple[tuple[str, ...], Array]:
    """Names (P,) and matrix (P, P) of covariance.npz, the whole estimate; empty without a file."""
    if not file.is_file():
        return (), np.zeros((0, 0))
    archive = _arrays(file, ("names", "covariance"))
    names, matrix = tuple(str(name) for name in archive["names"].tolist()), archive["covariance"]
    if matrix.shape != (len(names), len(names)):
        raise _broken(file, f"{len(names)} names, but a covariance of shape {matrix.shape}")
    if matrix.dtype.kind != "f" or not np.isfinite(matrix).all():
        raise _broken(file, "the covariance holds what is not a finite number")
    return names, matrix


def write_joint_covariance(file: Path, names: tuple[str, ...], matrix: Array) -> None:
    with file.open("wb") as stream:
        np.savez_compressed(stream, names=np.array(names), covariance=matrix.astype(np.float64))


def read_uncertainty(file: Path) -> dict[str, Array]:
    """Arrays of uncertainty.npz, covariances over the working volume; empty without a file."""
    if not file.is_file():
        return {}
    arrays = _floats(file, _UNCERTAINTY)
    count = len(np.atleast_1d(arrays["points_mm"]))
    shapes = [(count, 3), (count, 3, 3), (count, 3, 3), ()]
    if [arrays[name].shape for name in _UNCERTAINTY] != shapes or count < 1:
        raise _broken(file, "its arrays do not fit together")
    return arrays


def read_dot_example(file: Path) -> dict[str, Array]:
    """Arrays of dot_example.npz, one dot and its fitted model; empty without a file."""
    if not file.is_file():
        return {}
    arrays = _floats(file, _DOT_EXAMPLE)
    patch, model = arrays["patch"], arrays["model"]
    if patch.ndim != 2 or patch.shape != model.shape or min(patch.shape) < 3:
        raise _broken(file, f"patch {patch.shape} and model {model.shape} are no pair of images")
    return arrays


def _floats(file: Path, names: tuple[str, ...]) -> dict[str, Array]:
    try:
        return {name: np.asarray(a, float) for name, a in _arrays(file, names).items()}
    except (TypeError, ValueError) as error:
        raise _broken(file, "an array holds what is not a number") from error


def _arrays(file: Path, names: tuple[str, ...]) -> dict[str, Any]:
    try:
        with np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in names}
    except KeyError as error:
        raise _broken(file, f"lacks an array: {error.args[0]}") from error
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise _broken(file, f"cannot be read: {error}") from error


def _broken(file: Path, what: str) -> InputError:
    return InputError(what, where=str(file), todo=_AGAIN)
