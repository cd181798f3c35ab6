"""The files of a calibration: calibration.json, comparison.json, tables and arrays."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    field_serializer,
    field_validator,
    model_validator,
)

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.results.cameras import CameraRecord, PoseRecord, rig_cameras
from telerig.io.results.findings import (
    Finding,
    Verdict,
    notes_of,
    objections,
    verdict_of,
)
from telerig.io.results.record import (
    Matrix2,
    Matrix3,
    Matrix3x2,
    Name,
    Numbers,
    Part,
    Points3,
    Record,
    Square,
    Vector3,
    Wholes,
)
from telerig.rig.camera import Camera

_ROUNDED = 1e-6
"""How far rounded digits may take a matrix from being symmetric."""
_AGAIN = "calibrate again (`telerig calibrate`), or name the right results folder"


class Target(Part):
    """Hold the calibrated target.

    dots : (dots,) the number of each dot.
    points_mm : (dots, 3) their positions in mm in the target's frame.
    """

    dots: Wholes
    points_mm: Points3

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if len(self.dots) != len(self.points_mm):
            raise ValueError(f"{len(self.dots)} dots, but {len(self.points_mm)} points")
        return self


class Covariance(Part):
    """Hold a covariance matrix (parameters, parameters) and the names of its rows and columns."""

    names: tuple[str, ...]
    matrix: Square

    @model_validator(mode="after")
    def _fit_together(self) -> Self:
        if self.matrix.shape != (len(self.names),) * 2:
            raise ValueError(f"{len(self.names)} names, but a matrix of {self.matrix.shape}")
        if len(set(self.names)) < len(self.names):
            raise ValueError("a name stands twice")
        if np.any(np.diag(self.matrix) < 0):
            raise ValueError("a variance is negative")
        sd = np.sqrt(np.diag(self.matrix))
        if np.any(np.abs(self.matrix - self.matrix.T) > _ROUNDED * np.outer(sd, sd)):
            raise ValueError("the matrix is not symmetric")
        units = np.where(sd > 0, sd, 1.0)
        if np.any(np.linalg.eigvalsh(self.matrix / np.outer(units, units)) < -_ROUNDED):
            raise ValueError("a variance along some direction is negative")
        return self


class Mirror(Part):
    """Hold which of the two mirror-symmetric solutions was kept, and what decided between them.

    cost, other_cost : the cost of the kept and of the other solution, which the fit minimises; None
        where it was not computed.
    decided_by, words : what decided, as a code and as a sentence.
    nominal_rotvec_deg : nominal rotation vector (3,) in degrees of the second of two cameras; for
        more cameras, one by camera name. None where rig.toml states none.
    """

    cost: float | None = None
    other_cost: float | None = None
    decided_by: str = ""
    words: str = ""
    nominal_rotvec_deg: Numbers | Mapping[str, Numbers] | None = None


class LadderStep(Part):
    """Hold one lens model that was tried. Numbers are None where they were not computed.

    model, camera : the model's name, and the camera to whose model parameters were added.
    added : the names of the added parameters.
    taken : whether the model was accepted.
    chi2_gain : decrease of chi-square.
    bic_gain : this decrease minus the penalty of the extended Bayesian information criterion.
    p_value : probability of such a decrease of chi-square if the added parameters were 0.
    """

    model: str = ""
    camera: str = ""
    added: tuple[str, ...] = ()
    taken: bool = True
    chi2_gain: float | None = None
    bic_gain: float | None = None
    p_value: float | None = None
    words: str = ""


class LensModel(Part):
    """Hold the name of the lens model, the model of each camera, and all models that were tried."""

    name: str = ""
    by_camera: dict[str, str] = Field(default_factory=dict)
    words: str = ""
    ladder: tuple[LadderStep, ...] = ()


class Stage(Part):
    """Hold the stage's calibrated travel axis and encoder scale.

    axis : (3,) unit vector of the travel in the rig frame, towards increasing encoder readings.
    basis : (3, 2) two unit vectors perpendicular to the axis, along which its two tilts (rad) are
        measured.
    axis_covariance_rad2 : (2, 2) covariance of the two tilts in rad^2; None where it is not known.
    encoder_scale : relative error of the encoder; 0.001 means that it reads 0.1 % too much.
    encoder_scale_sd : its standard deviation; None where it is not known.
    joint_covariance : (3, 3) covariance of both tilts (rad) and of the encoder scale.
    chi2_dof : chi-square per degree of freedom of the fit; None where there is none.
    position_sigma_mm, wander_sigma_mm : standard deviation in mm of the carriage's position along
        the axis and perpendicular to it; None where the file does not state it.
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


class SplitHalves(Part):
    """Check the keys of the split-half check; each may be missing.

    views : number of views in each half.
    points_mm, shift_um, sd_um : (points, 3) each.
    """

    views: tuple[int, int] = (0, 0)
    points_mm: Points3 | None = None
    shift_um: Points3 | None = None
    sd_um: Points3 | None = None


class Structure(Part):
    """Check the keys of the tests of the residuals; each may be missing."""

    widening: float = 1.0


class NextPose(Part):
    """Check one proposed pose of the target.

    after_um : standard deviation per axis of points, in µm, if a view in this pose were added.
    words, reasons : how to hold the target, and what the view adds.
    """

    words: str
    reasons: tuple[str, ...] = ()
    after_um: float
    rig_from_target: Square


class NextView(Part):
    """Check the keys of the recommended next view; each may be missing."""

    words: str = ""
    verdict: str = ""
    views: int = 0
    before_um: float = 0.0
    after_um: float = 0.0
    enough: bool = False
    size_um: float = 0.0
    marks: tuple[int, ...] = ()
    poses: tuple[NextPose, ...] = ()


def _checked(part: type[Part]) -> AfterValidator:
    """Return a validator that checks a dictionary as a ``part`` and leaves it as it is."""

    def check(value: dict[str, Any]) -> dict[str, Any]:
        part.model_validate(value)
        return value

    return AfterValidator(check)


class Diagnostics(Part):
    """Hold further findings of a calibration, which the report shows.

    gauge : how origin, axes and scale were chosen.
    dots_hull_px : by camera, the corners of the convex hull of the dots that were used, in px.
    tilts_deg : tilts in degrees by name; None where one is not known.
    halves : the split-half check.
    structure : the structure in the residuals.
    next_view : the recommended next view of the target.
    """

    gauge: str = ""
    dots_hull_px: dict[Name, tuple[tuple[float, float], ...]] = Field(default_factory=dict)
    tilts_deg: dict[str, float | None] = Field(default_factory=dict)
    halves: Annotated[dict[str, Any], _checked(SplitHalves)] = Field(default_factory=dict)
    structure: Annotated[dict[str, Any], _checked(Structure)] = Field(default_factory=dict)
    next_view: Annotated[dict[str, Any], _checked(NextView)] = Field(default_factory=dict)


class CalibrationFile(Record):
    """Hold the content of calibration.json, the result of a calibration.

    findings : what the checks found.
    verdict, notes : made from the findings: whether the calibration can be used and the objections,
        and what is no objection. A file whose status is not that of its findings is refused.
    cameras : the calibrated cameras by name; the first camera's frame is the rig frame.
    walls : the refractive window of each camera that has one, by camera name.
    target, views : the calibrated target, and its pose in each view.
    covariance : of the rig block; None where there is none, for example after an import.
    stage : travel axis and encoder scale; None where no stage was calibrated.
    twin : the decision about the mirror ambiguity.
    """

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
    findings: tuple[Finding, ...]
    verdict: Verdict
    cameras: dict[Name, CameraRecord] = Field(min_length=1)
    walls: dict[str, dict[str, Any]] = Field(default_factory=dict)
    target: Target
    views: dict[Name, PoseRecord]
    covariance: Covariance | None = None
    model: LensModel = LensModel()
    stage: Annotated[Stage | None, BeforeValidator(lambda stage: stage or None)] = None
    twin: Mirror = Mirror()
    statistics: dict[str, Any] = Field(default_factory=dict)
    diagnostics: Diagnostics = Diagnostics()
    notes: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _parameters_are_known(self) -> Self:
        self.rig_cameras(windows=True)
        return self

    @model_validator(mode="after")
    def _covariance_is_of_all_parameters(self) -> Self:
        free = sum(len(camera.free) for camera in self.cameras.values())
        count = free + 6 * (len(self.cameras) - 1)
        if self.covariance is not None and len(self.covariance.names) != count:
            raise ValueError("the size of its covariance is not the number of its parameters")
        return self

    @model_validator(mode="after")
    def _says_what_was_found(self) -> Self:
        verdict = verdict_of(self.findings)
        if verdict.status != self.verdict.status:
            against = ", ".join(finding.code.name for finding in objections(self.findings))
            raise ValueError(
                f"the status is {self.verdict.status}, but the findings make it {verdict.status} "
                f"({against or 'there is no objection'})"
            )
        return self.model_copy(update={"verdict": verdict, "notes": notes_of(self.findings)})

    @field_validator("statistics")
    @classmethod
    def _are_numbers(cls, statistics: dict[str, Any]) -> dict[str, Any]:
        for name in ("noise_floor_px", "scatter_px"):
            if not isinstance(statistics.get(name), float | int | None):
                raise ValueError(f"{name} is not a number")
        return statistics

    @field_serializer("stage")
    def _stage_or_empty(self, stage: Stage | None) -> dict[str, Any]:
        return {} if stage is None else stage.content()

    def rig_cameras(self, *, windows: bool) -> tuple[Camera, ...]:
        """Return the calibrated cameras in the order of the file.

        windows : True for cameras that look through their refractive windows into the water,
        False for the same cameras without windows.
        """
        return rig_cameras(self.cameras, self.walls if windows else {})


class Change(Part):
    """Hold by how much one quantity differs between two calibrations.

    change : value of the second minus value of the first calibration, in ``unit``.
    sd : standard deviation of the change in the same unit.
    deviations : the change divided by its standard deviation; None where that is 0.
    """

    quantity: str
    unit: str
    change: float
    sd: float
    deviations: float | None = None


class ComparisonFile(Record):
    """Hold the content of comparison.json: what changed since an earlier calibration of the rig."""

    AGAIN: ClassVar[str] = _AGAIN

    earlier: str | None = None
    verdict: str = ""
    words: str | tuple[str, ...] = ""
    changes: tuple[Change, ...] = ()


_UNCERTAINTY = ("points_mm", "calibration_mm2", "measurement_mm2", "sigma_px")


def covariance_file(calibration: Path) -> Path:
    """Return where the covariance of all parameters lies beside a calibration.json.

    It is covariance.npz, and NAME.covariance.npz beside a NAME.json, of which there may be several.
    """
    own = calibration.name == "calibration.json"
    return calibration.with_name("covariance.npz" if own else f"{calibration.stem}.covariance.npz")


def read_joint_covariance(file: Path) -> tuple[tuple[str, ...], Array]:
    """Read covariance.npz, the covariance of all estimated parameters of a calibration.

    Returns the names of the parameters and their covariance (parameters, parameters). Both are
    empty when the file does not exist. A parameter that no measurement touches has an infinite
    variance.
    Raises InputError for a file that cannot be read or whose arrays do not fit together.
    """
    if not file.is_file():
        return (), np.zeros((0, 0))
    archive = _arrays(file, ("names", "covariance"))
    names, matrix = tuple(str(name) for name in archive["names"].tolist()), archive["covariance"]
    if matrix.shape != (len(names), len(names)):
        raise _broken(file, f"{len(names)} names, but a covariance of shape {matrix.shape}")
    known = np.isfinite(matrix) if matrix.dtype.kind == "f" else np.zeros(matrix.shape, bool)
    if not (known | ((matrix == np.inf) & np.eye(len(matrix), dtype=bool))).all():
        raise _broken(file, "the covariance holds what is not a finite number")
    return names, matrix


def write_joint_covariance(file: Path, names: tuple[str, ...], matrix: Array) -> None:
    """Write covariance.npz with the names and the covariance (parameters, parameters)."""
    with file.open("wb") as stream:
        np.savez_compressed(stream, names=np.array(names), covariance=matrix.astype(np.float64))


def read_uncertainty(file: Path) -> dict[str, Array]:
    """Read uncertainty.npz, the covariance of triangulated points in the working volume.

    Returns the arrays points_mm (points, 3) in mm, calibration_mm2 and measurement_mm2 (points, 3,
    3) in mm^2, the contributions of calibration and of image noise, and the scalar sigma_px, the
    image noise in px. The dictionary is empty when the file does not exist.
    Raises InputError for a file that cannot be read or whose arrays do not fit together.
    """
    if not file.is_file():
        return {}
    arrays = _floats(file, _UNCERTAINTY)
    count = len(np.atleast_1d(arrays["points_mm"]))
    shapes = [(count, 3), (count, 3, 3), (count, 3, 3), ()]
    if [arrays[name].shape for name in _UNCERTAINTY] != shapes or count < 1:
        raise _broken(file, "its arrays do not fit together")
    return arrays


def _floats(file: Path, names: tuple[str, ...]) -> dict[str, Array]:
    """Read the named arrays of an .npz file as floats. Raises InputError when that fails."""
    try:
        return {name: np.asarray(a, float) for name, a in _arrays(file, names).items()}
    except (TypeError, ValueError) as error:
        raise _broken(file, "an array holds what is not a number") from error


def _arrays(file: Path, names: tuple[str, ...]) -> dict[str, Any]:
    """Read the named arrays of an .npz file. Raises InputError when the file lacks one."""
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            found = {name: archive[name] for name in names}
    except KeyError as error:
        raise _broken(file, f"lacks an array: {error.args[0]}") from error
    except Exception as error:  # zipfile, zlib and NumPy raise errors of many kinds
        raise _broken(file, f"cannot be read: {error}") from error
    return found


def _broken(file: Path, what: str) -> InputError:
    return InputError(what, where=str(file), todo=_AGAIN)
