"""What the checks of a calibration found: codes with numbers, from which everything is said.

`Code` is the only table of the checks: how good a calibration with such a finding can be, the
sentence, the advice, and the limit of the check with its reason. The verdict, its reasons and the
notes, on the terminal, in calibration.json and on the pages, are made from the list of findings.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, StrEnum, unique
from typing import Annotated, Any, Self

from pydantic import Field, PlainSerializer, PlainValidator, model_validator

from telerig.io.results.calibration_words import NO_COVARIANCE
from telerig.io.results.record import Part


class Status(StrEnum):
    """Name how far a calibration may be used, best case first.

    IMPORTED : of another program, so that its uncertainty is not known.
    """

    GOOD = "GOOD"
    USABLE = "USABLE, with warnings"
    IMPORTED = "IMPORTED"
    REJECTED = "REJECTED"


@dataclass(frozen=True)
class Kind:
    """Describe a kind of finding.

    status : the best verdict of a calibration that has it; GOOD for a note, which is no objection.
    says : the sentence. In braces stand numbers of the finding, ``text``, and its ``cameras``,
        ``views``, ``names`` and ``parameters`` (the names in words).
    todo : the advice.
    limit, because : the value from which on the check finds it; its unit and its reason.
    """

    status: Status
    says: str
    todo: str = ""
    limit: float | None = None
    because: str = ""


_FALSE_ALARM = 1e-3
_NOTE, _USABLE = Status.GOOD, Status.USABLE
_DEVIATE = (
    "the dots deviate from the lens model {text} by {scatter_px:.2g} px (standard deviation of u "
    "and of v), but the noise of the images explains only {image_noise_px:.2g} px"
)
_HALVES = (
    "of two calibrations, one from {first:.0f} and one from the other {second:.0f} views, points "
    "triangulated from the same pixels differ by {rms_um:.2g} µm RMS per axis; their covariances "
    "predict {predicted_um:.2g} µm (ratio {ratio:.2f}"
)
_RESIDUALS = "Look for a pattern in residuals.csv"
_OF_ALL_TESTS = "probability of a false alarm in any of the tests of the residuals"


@unique
class Code(Enum):
    """Name a kind of finding; the value describes it."""

    # The model does not describe the images.
    MODEL_FAILS = Kind(
        Status.REJECTED,
        _DEVIATE + ": the model does not describe these images",
        _RESIDUALS,
        0.5,
        "px, the noise floor: beyond it the robust weights would hide a wrong lens model",
    )
    FEW_KEPT = Kind(
        Status.REJECTED,
        "only {share:.0%} of the dots agree with the model",
        "See residuals.csv for those that do not",
        0.9,
        "share of the dots: with the right model real images keep 98 % or more",
    )
    SYSTEMATIC = Kind(
        _USABLE,
        _DEVIATE + ": the rest is systematic, so errors in space may exceed their stated standard "
        "deviations",
        _RESIDUALS,
        5.0,
        "noise floor over image noise: what the model lacks is then most of the residuals",
    )
    CHI_SQUARE = Kind(
        _USABLE,
        "chi-square per degree of freedom is {chi2_dof:.2f} instead of 1, so the stated noise of "
        "the dots is wrong or the model is incomplete",
        "Look for a pattern in residuals.csv",
        0.15,
        "distance from 1, and 5 of its standard deviations: a noise stated 7 % too small",
    )
    ODD_VIEW = Kind(
        _USABLE,
        "{views}, {cameras}: only {kept:.0f} of its {dots:.0f} dots agree with the other views",
        "Check whether its dots are numbered wrongly, or whether the target moved between the "
        "cameras' images",
        0.5,
        "share of an image's dots: most of them disagree",
    )
    PATTERN = Kind(
        _USABLE,
        "{cameras}: residuals point the same way in parts of the image (most in row {row:.0f}, "
        "column {column:.0f} of {cells:.0f} x {cells:.0f}, {largest_sd:.1f} sd), which the lens "
        "model does not describe; because of this pattern every standard deviation has been "
        "multiplied by {widening:.2g}",
        _RESIDUALS,
        _FALSE_ALARM,
        _OF_ALL_TESTS,
    )
    NEIGHBOURS = Kind(
        _USABLE,
        "{cameras}: residuals of neighbouring dots correlate ({correlation:.2f})",
        "Possible causes: a plate that bends from view to view, refraction, a lens error finer "
        "than the model",
        _FALSE_ALARM,
        _OF_ALL_TESTS,
    )
    NO_STRUCTURE = Kind(_NOTE, "no structure is left in the residuals")
    HALVES_DISAGREE = Kind(
        _USABLE,
        _HALVES + ", probability {p_value:.1g}): an effect that the model does not contain acts on "
        "the images. The stated standard deviations contain a factor of {widening:.2g} for "
        "patterns in the residuals; what exceeds it is missing in them",
        _RESIDUALS,
        _FALSE_ALARM,
        "probability of a false alarm",
    )
    HALVES_AGREE = Kind(_NOTE, _HALVES + "), so they agree within their covariances")
    HALVES_NOT_COMPARED = Kind(_NOTE, "the split-half check was not possible: {text}")
    # The views do not determine everything.
    FEW_VIEWS = Kind(
        _USABLE,
        "only {count:.0f} views can be used, so above all the lens distortion and the dots' "
        "positions on the target are uncertain (see their standard deviations)",
        "Add views",
        6,
        "views: so many are recommended, with different tilts",
    )
    SMALL_TILTS = Kind(
        _USABLE,
        "{cameras}: no view is tilted by more than {tilt_deg:.0f} degrees, so its scale along the "
        "depth is poorly determined",
        "Add views tilted by 20-60 degrees",
        10.0,
        "degrees: the foreshortening, which shows the depth, is 1.5 % there",
    )
    ONE_CAMERA = Kind(
        _USABLE,
        "in {views} only the dots of {cameras} can be used, which does not connect the cameras",
        "Hold the target where two cameras see it",
    )
    OFFSET = Kind(
        _USABLE,
        "{cameras}: no view is seen by this and two other cameras at once, so its offset across "
        "the common perpendiculars of the optical axes is not determined. Points that it sees "
        "together with two others are wrong by this offset",
        "Add a view that three cameras see at once",
        0.03,
        "of the precision with which the views determine the best offset",
    )
    UNUSED_VIEWS = Kind(
        _NOTE,
        "no camera has enough dots in {views}, or they are all in one row",
        limit=4,
        because="dots: fewer do not determine a pose",
    )
    COVERAGE = Kind(
        _NOTE,
        "{cameras}: dots cover {cells:.0f} of 16 parts of the image; elsewhere the distortion is "
        "extrapolated",
        "Hold the target nearer to the edges in some views",
        8,
        "of 16 parts: half of the image",
    )
    NEAR_PARALLEL = Kind(
        _NOTE,
        "the optical axes are nearly parallel ({angle_deg:.1f} degrees): depth is the least "
        "precise coordinate of points in space, and two telecentric cameras would not see it; "
        "60-90 degrees between the cameras are best",
        limit=10.0,
        because="degrees: below, the place where two axes come closest is too uncertain to be the "
        "origin of lenses with perspective",
    )
    WEAK = Kind(
        _NOTE,
        "{parameters} is hardly determined by these views: its standard deviation is {share:.0%} "
        "of that before the fit",
        limit=0.5,
        because="of the prior's: the views then tell less than three times what was known before",
    )
    LINKED = Kind(
        _NOTE,
        "{parameters} can hardly be told apart (largest correlation {correlation:+.3f}): changed "
        "together, they leave the images almost the same",
        limit=0.98,
        because="correlation: each would be five times as certain if the other were known",
    )
    # The images or the measurements disagree with rig.toml.
    ROTATION_FAR = Kind(
        _USABLE,
        "the rotation that was found for {cameras} is {angle_deg:.0f} degrees from {names} in "
        "rig.toml",
        "Correct rig.toml, or look for exchanged folders: the stated rotation has to show which "
        "of two mirror images the rig is",
        20.0,
        "degrees: the error that a stated rotation may have to decide between mirror images",
    )
    SCALE_FAR = Kind(
        _USABLE,
        "the scale of {cameras} is {found:.4g} px/mm, but rig.toml says {stated:.4g}: one of its "
        "lengths may have another unit",
        "Check pitch_mm, scale_distance_mm and scale_px_per_mm in rig.toml: all lengths in space "
        "are in the target's unit",
        2.0,
        "ratio: an inch is 2.54 cm and a cm 10 mm, and a stated scale is within 20 %",
    )
    DISTANCE_UNUSED = Kind(
        _NOTE,
        "scale_distance_mm has no effect: the dots are held at their nominal places, which are "
        "{nominal_mm:.6g} mm apart where rig.toml states a measured distance of {stated_mm:.6g} mm",
        "Give --dots 3d or --dots plane for the measured distance to set the scale",
    )
    DISTANCE_FAR = Kind(
        _USABLE,
        "scale_distance_mm, which sets the scale, is {stated_mm:.6g} mm where the nominal places "
        "of its dots are {nominal_mm:.6g} mm apart: {deviations:.0f} standard deviations of what "
        "rig.toml states of both",
        "Measure the distance again, between the centres of the two dots of scale_dots; if it is "
        "right, the print is stretched: correct pitch_mm, or raise print_sigma_mm",
        5.0,
        "standard deviations: chance gives as much once in two million cases",
    )
    EXCHANGED = Kind(
        _USABLE,
        "{cameras} seem to be exchanged: their scales are {first:.3f} and {second:.3f} px/mm, "
        "rig.toml says {first_stated:g} and {second_stated:g}",
        "Check which folder holds the images of which camera: exchanged cameras mirror every depth",
        0.05,
        "difference of the stated scales: smaller ones do not tell the cameras apart",
    )
    MIRRORED = Kind(
        _NOTE,
        "every image shows the target as a mirror image of rig.toml: this is right if its rows are "
        "numbered upwards; but if the cameras' images are flipped, the handedness of every helix "
        "is wrong",
    )
    STAGE_AXIS_FAR = Kind(
        _USABLE,
        "[stage] axis in rig.toml is {angle_deg:.0f} degrees from the measured direction of travel "
        "[{x:.3f}, {y:.3f}, {z:.3f}]",
        "Write the measured one; at 180 degrees only reverse its sign",
        10.0,
        "degrees: no stage is mounted so far from its drawing",
    )
    WRONG_READING = Kind(
        _USABLE,
        "the encoder reading {reading_mm:.6g} mm of {views} is wrong by {error_mm:.3g} mm and has "
        "almost no influence",
        "Check positions.csv",
        0.5,
        "robust weight",
    )
    MEDIA_ORDER = Kind(
        _USABLE,
        "[walls] indices put {cameras} into the denser medium (from {first:g} to {last:g})",
        "Give the camera's side first, as in [1.0, 1.52, 1.333] for air, glass, water",
    )
    WINDOW_LEANING = Kind(
        _USABLE,
        "the normal of the window of {cameras} is {angle_deg:.0f} degrees off the camera's axis",
        "Check normal in [walls.<camera>]: it is in the camera's frame, in which a window that "
        "faces the camera has [0, 0, 1]",
        30.0,
        "degrees: cameras look through their windows nearly at right angles",
    )
    WINDOW_DISTANCE = Kind(
        _USABLE,
        "[walls] states no distance_mm for the window of {cameras}, so it counts as standing at "
        "the origin; as the lens is not quite telecentric, points are wrong by up to "
        "{error_um:.1f} µm over the working volume for each 10 mm that it stands elsewhere",
        "Write distance_mm into [walls.<camera>], or calibrate with the target in the water",
        0.1,
        "µm for each 10 mm: a window 100 mm away costs as much as a good calibration",
    )
    # What was read.
    LEFT_OUT = Kind(_NOTE, "{views}, {cameras} is left out: {text}")
    TURNS_KNOWN = Kind(
        _NOTE,
        "{turns:.0f}-fold symmetric target without marks: numbered so that all cameras and all "
        "views agree. The dots' print errors show by which angle the target is turned in each view "
        "({contrast_sd:.0f} standard deviations in the least certain view)",
    )
    TURNS_UNKNOWN = Kind(
        _NOTE,
        "{turns:.0f}-fold symmetric target without marks: the cameras agree within each view. The "
        "dots' print errors are too small to show by which angle the target is turned between "
        "views ({contrast_sd:.1f} standard deviations in the least certain view), so each "
        "estimated position may be an average over several dots",
        "Marks on the target would avoid this",
        3.0,
        "standard deviations: one turn in 700 would be wrong by chance",
    )
    TURNED_DISTANCE = Kind(
        _NOTE,
        "the stated distance of dots {first:.0f} and {second:.0f} may belong to two other dots, "
        "because the symmetric target may be turned. The standard deviation of the distance is "
        "therefore taken as {sd_um:.0f} µm",
        "State the distance of two dots that are opposite each other, or put marks on the target",
    )
    NO_UNCERTAINTY = Kind(Status.IMPORTED, NO_COVARIANCE)
    # The stage.
    STAGE = Kind(
        _NOTE,
        "stage: travel along ({x:.6f}, {y:.6f}, {z:.6f}) ± {sd_deg:.2g} degrees, from "
        "{positions:.0f} positions over {range_mm:.4g} mm; the encoder reads {scale_ppm:+.0f} ± "
        "{scale_sd_ppm:.0f} ppm more than the travel",
    )
    READINGS_SCATTER = Kind(
        _NOTE,
        "the encoder readings scatter by {found_um:.2g} µm, more than the {stated_um:.2g} µm that "
        "were stated; the larger value is used",
        limit=1e-3,
        because="probability of a false alarm",
    )
    CARRIAGE_WANDERS = Kind(
        _NOTE,
        "the carriage deviates from a straight line by {found_um:.2g} µm, more than the "
        "{stated_um:.2g} µm that were stated; the larger value is used",
        limit=1e-3,
        because="probability of a false alarm",
    )
    STAGE_OUTLIERS = Kind(
        _NOTE,
        "{count:.0f} of {dots:.0f} dots of stage_axis/ lie far from their predicted pixels and "
        "have almost no influence",
        "Check the images of stage_axis/ if there are many",
        0.5,
        "robust weight",
    )
    TWO_POSITIONS = Kind(
        _NOTE,
        "two positions of the stage cannot reveal a wrong encoder reading",
        "Take three or more",
    )
    UNKNOWN_DOTS = Kind(
        _NOTE,
        "{count:.0f} dots of stage_axis/ have numbers that are not in the calibration, and are not "
        "used",
    )
    UNSEEN_POSITIONS = Kind(_NOTE, "positions.csv lists {views} without any dot; it is not used")
    # Refractive windows.
    WINDOWS_IN_AIR = Kind(
        _NOTE,
        "calibrated in air; points of runs lie in the water behind the refractive windows of "
        "{cameras}. Without the windows in the model, points would be wrong by up to "
        "{error_um:.1f} µm over the working volume",
    )
    WINDOWS_IN_WATER = Kind(
        _NOTE,
        "calibrated in the water behind the refractive windows of {cameras}. If this calibration "
        "is used for points in air, without windows, they are wrong by up to {error_um:.1f} µm",
    )
    NO_WINDOWS = Kind(
        _NOTE,
        "calibrated in the water, and rig.toml states no windows ([walls]): scales and axes hold "
        "for points in the water only",
        "With a perspective lens, state its window in [walls.<camera>] of rig.toml",
    )
    WINDOW_NORMAL = Kind(
        _NOTE,
        "the normal of the window of {cameras} has a standard deviation of {sd_deg:.2g} degrees, "
        "which shifts points by up to {shift_um:.1f} µm over the working volume; the covariances "
        "contain this",
        "If it is too much, measure the normal better, or calibrate with the target in the water",
    )
    WINDOW_TILT_SIGN = Kind(
        _NOTE,
        "the window of {cameras} may just as well be tilted by {tilt_deg:.2g} degrees to the other "
        "side: with a telecentric lens and the target in the water, images do not show the sign of "
        "the tilt. Points are not affected",
        "If you need the normal itself, state it more precisely in rig.toml",
    )
    # Sentences without a code, on the files of a dataset.
    NOTE = Kind(_NOTE, "{text}")

    def __repr__(self) -> str:
        return f"Code.{self.name}"

    @property
    def limit(self) -> float:
        """Return the value from which on the check finds it."""
        assert self.value.limit is not None
        return self.value.limit

    def found(
        self,
        numbers: Mapping[str, float] | None = None,
        /,
        *,
        cameras: str | Sequence[str] = (),
        views: str | Sequence[str] = (),
        names: str | Sequence[str] = (),
        text: str = "",
        **more: float,
    ) -> Finding:
        """Return a finding of this kind.

        numbers, more : the numbers.
        cameras, views, names, text : as in `Finding`; one name stands for itself.
        """
        where = {"cameras": cameras, "views": views, "names": names}
        places = {key: (of,) if isinstance(of, str) else tuple(of) for key, of in where.items()}
        return Finding(code=self, numbers={**(numbers or {}), **more}, text=text, **places)


LENS_FAILS = {Code.MODEL_FAILS, Code.SYSTEMATIC, Code.PATTERN, Code.HALVES_DISAGREE}
"""Objections that another lens model may answer. The first of them in a calibration has the number
``better_models``, 1 or 0, and the better model in ``names``."""
ASK_FOR_VIEWS = {Code.FEW_VIEWS, Code.SMALL_TILTS, Code.OFFSET}
"""Objections whose advice is to add views."""
TRUST = {Code.NO_STRUCTURE, Code.HALVES_AGREE, Code.HALVES_NOT_COMPARED}
"""Notes on whether the covariance can be believed."""


def _code(value: Any) -> Code:
    if isinstance(value, Code):
        return value
    if not isinstance(value, str) or value not in Code.__members__:
        raise ValueError(f"{str(value)[:60]!r} is no code of this version")
    return Code[value]


class Finding(Part):
    """Hold one finding of a check of a calibration.

    cameras, views, names : where; names are those of parameters or of keys of rig.toml.
    numbers : by name, as the sentence of the code states them.
    text : what has no code: a lens model's name, the cause of an error.
    """

    code: Annotated[Code, PlainValidator(_code), PlainSerializer(lambda code: code.name)]
    cameras: tuple[str, ...] = ()
    views: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    numbers: dict[str, float] = Field(default_factory=dict)
    text: str = ""

    @model_validator(mode="after")
    def _can_be_said(self) -> Self:
        lacking = set(re.findall(r"\{(\w+)", self.code.value.says)) - set(self._shown())
        if lacking:
            raise ValueError(f"{self.code.name} lacks {', '.join(sorted(lacking))}")
        return self

    def _shown(self) -> dict[str, Any]:
        return {
            **self.numbers,
            "cameras": _named("camera", self.cameras),
            "views": _named("view", self.views),
            "names": _listed(self.names),
            "parameters": _listed([parameter_words(name) for name in self.names]),
            "text": self.text,
        }

    @property
    def lens_advice(self) -> str:
        """Return a sentence on the lens model that fits better, "" where none was looked for."""
        if "better_models" not in self.numbers:
            return ""
        if self.names:
            return f"Choose --model {self.names[0]}, which fits better"
        return (
            "No lens parameter explains it; possible causes are a target that bends from view to "
            "view, refraction, and dots that are numbered wrongly"
        )

    @property
    def status(self) -> Status:
        """Return the best verdict that a calibration with this finding can have."""
        return self.code.value.status

    @property
    def words(self) -> str:
        """Return the finding and its advice as a sentence without a full stop."""
        kind = self.code.value
        says = kind.says.format(**self._shown())
        return ". ".join(filter(None, (says, kind.todo, self.lens_advice)))


def _named(noun: str, names: Sequence[str]) -> str:
    return f"{noun}{'s' if len(names) > 1 else ''} {_listed([repr(name) for name in names])}"


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


class Verdict(Part):
    """Hold the verdict on a calibration: its status, and the objections in sentences."""

    status: Status
    reasons: tuple[str, ...] = ()


def objections(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings that object to a calibration, the gravest first."""
    found = [finding for finding in findings if finding.status != Status.GOOD]
    return sorted(found, key=lambda finding: -list(Status).index(finding.status))


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict, which is that of the gravest finding, and GOOD without an objection."""
    against = objections(findings)
    status = against[0].status if against else Status.GOOD
    return Verdict(status=status, reasons=tuple(finding.words for finding in against))


def notes_of(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return the sentences of the findings that are no objections."""
    return tuple(finding.words for finding in findings if finding.status == Status.GOOD)


_PARAMETERS = {
    "scale_px_per_mm": "the scale", "aspect": "the aspect ratio", "skew": "the skew",
    "centre_u_px": "the image centre (u)", "centre_v_px": "the image centre (v)",
    "kappa_per_mm": "the residual perspective kappa", "tilt_x": "the sensor tilt (x)",
    "tilt_y": "the sensor tilt (y)", "image_convergence_per_mm": "the image-side convergence",
    "wall_x_rad": "the wall's tilt along x", "wall_y_rad": "the wall's tilt along y",
    "rx_rad": "the inter-camera angle about its x", "ry_rad": "the inter-camera angle about its y",
    "rz_rad": "the inter-camera angle about its axis", "tx_mm": "the offset along x",
    "ty_mm": "the offset along y", "tz_mm": "the depth origin",
}  # fmt: skip


def parameter_words(name: str) -> str:
    """Return a parameter, which is named CAMERA.PARAMETER, in words."""
    camera, _, parameter = name.rpartition(".")
    words = _PARAMETERS.get(parameter, f"the distortion coefficient {parameter}")
    return f"{words} of camera {camera!r}"
