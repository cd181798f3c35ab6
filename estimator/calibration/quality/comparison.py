"""Two calibrations of one rig: what moved, by how much, and is that more than their uncertainty?

Only what images can tell is compared (the gauge is set aside): each camera's rotation against the
first, its offset along the common perpendicular of their optical axes, the scales, and how far the
same pixels triangulate apart over the working volume after the best rigid motion.

The split-half check compares two halves of one calibration in the same way: is it as repeatable as
its covariance says? Every second view calibrates the rig anew, and so do the others, each by one
Gauss-Newton step from the calibration of all views. The covariance does not know of errors that the
views share (a wrong lens model), but they act differently in two halves with other tilts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from typing import Any, Protocol

import numpy as np
from scipy.special import chdtrc

from telerig.arrays import Array, Ints
from telerig.errors import LOAD, CalibrationError, InputError, need_kind
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.solver.gaussian import Estimate
from telerig.estimator.calibration.solver.problem import HELD_SCALE, Problem, cameras_from_state
from telerig.estimator.calibration.solver.system import System
from telerig.estimator.calibration.start.known_target import overlap_tree
from telerig.estimator.calibration.thresholds import LEAST_DOTS, LEAST_VIEWS, SURE_SD, UNLIKELY
from telerig.factors.calibration import State
from telerig.io.results.findings import Code, Finding
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotvec_from_rotation
from telerig.rig.triangulation import aligned_covariance, triangulate_any, working_volume
from telerig.short_text import number, with_sd

_ROUNDING = 1e-6
_LEAST_CHANCE = 1e-12


@dataclass(frozen=True)
class Rig:
    """The part of a calibration that is compared.

    free : for each camera the names of its free intrinsics.
    covariance : (P, P) of the free intrinsics and then of the poses of all cameras but the first.
    """

    cameras: tuple[Camera, ...]
    free: tuple[tuple[str, ...], ...]
    covariance: Array


@dataclass(frozen=True)
class Change:
    """The change of one quantity from the first calibration to the second.

    unit : "urad", "um" or "ppm".
    sd : standard deviation of the change that both covariances give.
    """

    quantity: str
    unit: str
    change: float
    sd: float

    @property
    def deviations(self) -> float:
        """Return the change divided by its standard deviation; infinite if only the latter is 0."""
        if self.sd > 0:
            return self.change / self.sd
        return float(np.copysign(np.inf, self.change)) if self.change else 0.0


@dataclass(frozen=True)
class FieldDifference:
    """How far the points that two calibrations triangulate from the same pixels lie apart.

    A rigid motion that is common to all points has been removed.

    points_mm, shift_mm : (N, 3) points, and their shift from the first calibration to the second.
    sd_mm : (N, 3) standard deviation of the shift that both covariances predict.
    p_value : of a chi-square test that the predicted errors alone cause the shift.
    """

    points_mm: Array
    shift_mm: Array
    sd_mm: Array
    p_value: float

    @property
    def rms_um(self) -> float:
        """Return the RMS of the shift per axis, in µm."""
        return float(1e3 * np.sqrt(np.mean(self.shift_mm**2)))

    @property
    def predicted_um(self) -> float:
        """Return the value of `rms_um` that both covariances predict for a rig without change."""
        return float(1e3 * np.sqrt(np.mean(self.sd_mm**2)))


@dataclass(frozen=True)
class RigComparison:
    """The comparison of two calibrations of one rig with C cameras.

    cameras : their names.
    changes : for each camera but the first, the changes of its rotation about x, y and z and of its
        offset along the common perpendicular, relative to the first; then the C changes of the
        scales.
    field : the differences of points in space.
    p_moved : probability that errors alone cause changes of the poses as large as these.
    exchanged : whether two cameras have exchanged their scales.
    media : "air" or "water", for each of the two calibrations.
    known : whether the covariance is known, for each of the two calibrations.
    """

    cameras: tuple[str, ...]
    changes: tuple[Change, ...]
    field: FieldDifference
    p_moved: float
    exchanged: bool = False
    media: tuple[str, str] = ("air", "air")
    known: tuple[bool, bool] = (True, True)

    @property
    def identical(self) -> bool:
        """Whether both calibrations agree to rounding, so that they come from the same views."""
        return self.field.rms_um < _ROUNDING * max(self.field.predicted_um, 1.0)

    @property
    def moved(self) -> bool:
        """Return whether a camera moved relative to the first by more than chance explains."""
        return self.p_moved < UNLIKELY

    @property
    def differs(self) -> bool:
        """Return whether points in space differ by more than chance explains."""
        return self.field.p_value < UNLIKELY

    def words(self) -> str:
        """Return the result as one sentence for the user."""
        if self.identical:
            return (
                "both calibrations are equal except for rounding, so they come from the same "
                "views. To learn whether the rig moved, compare with a calibration from other views"
            )
        size = "; ".join(self._size(c) for c in range(1, len(self.cameras)))
        first = (
            f"the rig moved: {size}"
            if self.moved
            else f"no movement of the cameras against each other is seen ({size})"
        )
        field = self.field
        apart, expected = (number(um, 2) for um in (field.rms_um, field.predicted_um))
        second = (
            f"points triangulated from the same pixels differ by {apart} µm RMS per axis; the "
            f"uncertainty of the two calibrations explains {expected} µm"
        )
        if self.differs:
            chance = chance_words(field.p_value)
            second += (
                f", so the rig has changed ({chance}); use each calibration only for the runs of "
                "its own time"
            )
        return "; ".join(
            [first, *self._scale_words(), second, *self._medium_words(), *self._unknown_words()]
        )

    def _size(self, camera: int) -> str:
        """Return in words how far a camera (by index) moved relative to the first."""
        own = self.changes[4 * camera - 4 : 4 * camera]
        shift, turn = own[3], _norm(own[:3])
        between = "the cameras"
        if len(self.cameras) > 2:
            between = f"cameras {self.cameras[0]} and {self.cameras[camera]}"
        return (
            f"{with_sd(abs(shift.change), shift.sd)} µm and {with_sd(turn.change, turn.sd)} µrad "
            f"between {between}"
        )

    def _scale_words(self) -> list[str]:
        """Return the sentence about scales that changed by more than chance; empty if none did."""
        if self.exchanged:
            return [
                "each camera has the scale that the other one had, as if their images or cables "
                "were exchanged"
            ]
        scales = self.changes[-len(self.cameras) :]
        changed = [c for c in scales if chdtrc(1, c.deviations**2) < UNLIKELY]
        if not changed:
            return []
        said = (f"{with_sd(c.change, c.sd)} ppm ({c.quantity})" for c in changed)
        return [f"the magnification changed: {', '.join(said)}"]

    def _medium_words(self) -> list[str]:
        if self.media[0] == self.media[1]:
            return []
        return [
            f"the earlier one was made in {_of(self.media[0])}, this one in {_of(self.media[1])}: "
            "a refractive window that [walls] of rig.toml lacks appears as a change of the rig"
        ]

    def _unknown_words(self) -> list[str]:
        named = zip(("the earlier calibration", "this calibration"), self.known)
        return [
            f"the uncertainty of {name} is unknown and taken as zero, so changes look surer than "
            "they are"
            for name, known in named if not known
        ]  # fmt: skip

    def as_dict(self) -> dict[str, Any]:
        """Return the content of `comparison.json`."""
        return {
            "verdict": "MOVED" if self.moved else "DIFFERENT" if self.differs else "SAME",
            "words": self.words(),
            "changes": [asdict(c) | {"deviations": c.deviations} for c in self.changes],
            "space": {
                "rms_um": self.field.rms_um,
                "predicted_um": self.field.predicted_um,
                "p_value": self.field.p_value,
            },
            "p_moved": self.p_moved,
        }


def compare_calibrations(first: Calibration, second: Calibration) -> RigComparison:
    """Compare two calibrations of one rig: how did the rig change from ``first`` to ``second``?

    The errors of both calibrations are taken as independent. If they share errors, for example of
    the target's stated distance, the standard deviations of the changes are too large, never too
    small. Refractive windows are left out, so points are compared in air.

    Returns a `RigComparison`; its ``words()`` are a sentence for the user. Raises InputError if the
    two calibrations have different cameras or image sizes, or only one camera.
    """
    for one in (first, second):
        need_kind(one, "cameras", "telerig.compare_calibrations", LOAD)
    check_same_rig(first.cameras, second.cameras)
    found = compare_rigs(_rig(first), _rig(second))
    known = (first.covariance_known, second.covariance_known)
    return replace(found, media=(first.medium, second.medium), known=known)


class Named(Protocol):
    """A camera with a name and an image size, whether calibrated or only described in rig.toml."""

    @property
    def name(self) -> str:
        """Return the camera's name."""

    @property
    def image_size_px(self) -> tuple[int, int]:
        """Return (width, height) of its images."""


def check_same_rig(first: Sequence[Named], second: Sequence[Named]) -> None:
    """Raise InputError if the cameras of two rigs differ in name, order or image size.

    It is raised for rigs of a single camera, too, because nothing can be compared then.
    """
    mine, theirs = ([(c.name, tuple(c.image_size_px)) for c in k] for k in (first, second))
    if len(mine) < 2 and len(theirs) < 2:
        raise InputError(
            "both calibrations have one camera only, and the comparison is about the poses of "
            "cameras relative to each other",
            todo="compare calibrations of two cameras or more",
        )
    if mine == theirs:
        return
    todo = "compare calibrations with the same camera names, order and image sizes"
    if sorted(mine) == sorted(theirs):
        todo = "give the cameras in the same order in rig.toml: the first one is the rig's frame"
    raise InputError(
        f"these are calibrations of different rigs: {_named(mine)} and {_named(theirs)}", todo=todo
    )


def _rig(calibration: Calibration) -> Rig:
    bare = calibration.in_air()
    return Rig(bare.cameras, bare.free, bare.covariance)


def _named(cameras: list[tuple[str, tuple[int, ...]]]) -> str:
    return ", ".join(f"{name} {'x'.join(map(str, size))}" for name, size in cameras)


def compare_rigs(first: Rig, second: Rig) -> RigComparison:
    """Return the changes between two rigs, second minus first.

    The covariance of a change is the sum of both covariances.
    """
    cameras = tuple(camera.name for camera in first.cameras)
    pose = _pose_change(first, second)
    names = [f"rotation about {a}" for a in "xyz"] + ["offset along the common perpendicular"]
    if len(cameras) > 2:
        names = [f"{name} of camera {camera}" for camera in cameras[1:] for name in names]
    others = len(cameras) - 1
    units = others * ["urad", "urad", "urad", "um"]
    factors = np.tile([1e6, 1e6, 1e6, 1e3], others)
    changes = [
        Change(n, u, float(f * c), float(f * s))
        for n, u, f, c, s in zip(names, units, factors, pose.value, pose.sd)
    ]
    changes += [_scale_change(first, second, i) for i in range(len(cameras))]
    field = field_difference(first, second)
    exchanged = _exchanged(first, second, changes[4 * others :])
    return RigComparison(cameras, tuple(changes), field, pose.p_value(), exchanged)


def _exchanged(first: Rig, second: Rig, scales: list[Change]) -> bool:
    """Return whether two cameras have exchanged their scales, beyond the uncertainty."""
    before, after = ([c["scale_px_per_mm"] for c in r.cameras] for r in (first, second))
    left = [abs(c.deviations) > SURE_SD for c in scales]
    came = [
        [abs(1e6 * (a / b - 1)) < SURE_SD * scale.sd for b in before]
        for a, scale in zip(after, scales)
    ]
    return any(
        left[i] and left[j] and came[i][j] and came[j][i]
        for i, j in combinations(range(len(scales)), 2)
    )


def chance_words(p_value: float) -> str:
    """Return a p-value in words, down to 1e-12."""
    return f"chance {p_value:.0e}" if p_value >= _LEAST_CHANCE else "chance below 1e-12"


def _of(medium: str) -> str:
    return "the water" if medium == "water" else medium


def _pose_change(first: Rig, second: Rig) -> Estimate:
    """Return how each camera but the first moved relative to the first.

    A camera has four numbers: the rotation about the x, y and z axis of the rig frame (rad) and the
    offset along the common perpendicular (mm).
    """
    others = len(first.cameras) - 1
    changes, rows = [], np.zeros((4 * others, 6 * others))
    for c in range(others):
        a, b = (r.cameras[c + 1].camera_from_rig.inverse() for r in (first, second))
        turn = a.rotation @ rotvec_from_rotation(a.rotation.T @ b.rotation)
        across = np.cross([0.0, 0.0, 1.0], a.rotation[:, 2])
        across /= max(np.linalg.norm(across), 1e-12)  # parallel axes have no such perpendicular
        changes.append(np.r_[turn, across @ (b.translation_mm - a.translation_mm)])
        rows[4 * c : 4 * c + 3, 6 * c : 6 * c + 3] = a.rotation
        rows[4 * c + 3, 6 * c + 3 : 6 * c + 6] = across @ a.rotation
    blocks = sum(r.covariance[-6 * others :, -6 * others :] for r in (first, second))
    return Estimate(np.concatenate(changes), rows @ blocks @ rows.T)


def _scale_change(first: Rig, second: Rig, camera: int) -> Change:
    name = "scale_px_per_mm"
    values, variance = [], 0.0
    for rig in (first, second):
        scale = rig.cameras[camera][name]
        values.append(scale)
        if name in rig.free[camera]:
            at = sum(len(f) for f in rig.free[:camera]) + rig.free[camera].index(name)
            variance += rig.covariance[at, at] / scale**2
    change = 1e6 * (values[1] / values[0] - 1)
    label = f"scale of camera {first.cameras[camera].name}"
    return Change(label, "ppm", float(change), float(1e6 * np.sqrt(variance)))


def difference_from_truth(
    calibration: Calibration, cameras: Sequence[Camera], points_mm: Array | None = None
) -> FieldDifference:
    """Return how far points that a calibration triangulates are from the truth.

    cameras : the true cameras, whose frame may differ from the calibration's by a rigid motion.
    points_mm : as for `field_difference`.
    """
    poses = np.zeros((6 * (len(cameras) - 1),) * 2)
    exact = Rig(tuple(cameras), ((),) * len(cameras), poses)
    return field_difference(exact, _rig(calibration), points_mm)


def field_difference(first: Rig, second: Rig, points_mm: Array | None = None) -> FieldDifference:
    """Return how far points differ that two rigs triangulate from the same pixels.

    The pixels are those at which the first rig sees the points.
    points_mm : (N, 3) these points; None takes a cubic grid over the first rig's working volume.
    """
    points = working_volume(first.cameras, 5) if points_mm is None else points_mm
    pixels = [camera.project(points) for camera in first.cameras]
    found = triangulate_any(second.cameras, pixels, 1.0).points_mm
    shift = Pose.aligning(found, points).apply(found) - points
    one, other = (
        aligned_covariance(rig.cameras, rig.free, rig.covariance, points) for rig in (first, second)
    )
    both = Estimate(shift.ravel(), one + other)
    return FieldDifference(points, shift, both.sd.reshape(-1, 3), both.p_value())


def _norm(parts: tuple[Change, ...]) -> Change:
    """Return the length of a vector of changes, with the standard deviation along it."""
    vector, sd = (np.array([getattr(p, k) for p in parts]) for k in ("change", "sd"))
    length = float(np.linalg.norm(vector))
    along = float(np.sqrt(((vector / max(length, 1e-12)) ** 2 * sd**2).sum()))
    return Change("rotation", parts[0].unit, length, along)


def split_half_check(
    problem: Problem, state: State, widening: float = 1.0
) -> tuple[dict[str, Any], list[Finding]]:
    """Calibrate from each half of the views and compare the two rigs.

    state : the solution with all views. widening : factor by which the stated standard deviations
    are larger than those of ``problem``, because of a pattern in the residuals.
    Returns the content of `Calibration.diagnostics`, entry "halves", and the finding. The entry is
    empty if the check was not possible; else it has the number of views of each half, the RMS
    difference of points and its prediction (µm per axis), the p-value, and the differences at a
    grid of points.
    Both halves use the same size of the target, so the check says nothing about this size: the
    known distance of two dots, or else the estimated distance of two dots far apart, is taken as
    exact in both.
    """
    if len(problem.cameras) < 2:
        return _not_compared("it compares points in space, which one camera does not see")
    used = _in_turn(problem)
    parts = [used[0::2], used[1::2]]
    if min(len(p) for p in parts) < LEAST_VIEWS:
        return _not_compared(f"{len(used)} views are too few, it needs {2 * LEAST_VIEWS} or more")
    problem = replace(problem, scale=problem.scale or _size(problem, state, parts))
    try:
        first, second = (_rig_of(problem, state, views) for views in parts)
    except CalibrationError as error:
        return _not_compared(f"one half of the views does not determine the rig: {error.what}")
    field = field_difference(first, second)
    compared = {
        "rms_um": field.rms_um, "predicted_um": field.predicted_um, "p_value": field.p_value
    }  # fmt: skip
    ratio = field.rms_um / max(field.predicted_um, 1e-12)
    numbers = {
        "first": len(parts[0]), "second": len(parts[1]), "ratio": ratio, "widening": widening
    }  # fmt: skip
    agree = field.p_value >= Code.HALVES_DISAGREE.limit
    code = Code.HALVES_AGREE if agree else Code.HALVES_DISAGREE
    return compared | {
        "views": [len(p) for p in parts],
        "points_mm": np.round(field.points_mm, 4).tolist(),
        "shift_um": np.round(1e3 * field.shift_mm, 4).tolist(),
        "sd_um": np.round(1e3 * field.sd_mm, 4).tolist(),
    }, [code.found(compared | numbers)]


def _not_compared(why: str) -> tuple[dict[str, Any], list[Finding]]:
    return {}, [Code.HALVES_NOT_COMPARED.found(text=why)]


def _size(
    problem: Problem, state: State, parts: list[Ints]
) -> tuple[tuple[int, int], float, float] | None:
    """Return two dots far apart that both halves see, their estimated distance (mm), and 0 for
    its standard deviation (mm); None if the halves share fewer than two dots."""
    weighed = problem.kept
    one, other = (problem.dot[weighed & np.isin(problem.view, views)] for views in parts)
    both = np.intersect1d(one, other)
    if len(both) < 2:
        return None
    points = state.dots_mm[both]
    first = int(np.argmax(np.linalg.norm(points - points.mean(0), axis=-1)))
    distance = np.linalg.norm(points - points[first], axis=-1)
    second = int(np.argmax(distance))
    return (int(both[first]), int(both[second])), float(distance[second]), 0.0


def _rig_of(problem: Problem, state: State, views: Ints) -> Rig:
    half = problem.subset(np.isin(problem.view, views) & problem.kept)
    overlap_tree(half, _images(half))
    if half.scale is not None:
        pair, distance, _ = half.scale
        half = replace(half, scale=(pair, distance, HELD_SCALE * distance))
    system = System(half)
    gaussian = system.gaussian(state)
    step, _ = gaussian.step()
    covariance = gaussian.marginal(np.arange(gaussian.rig))
    return Rig(cameras_from_state(half, system.moved(state, step)), half.free, covariance)


def _in_turn(problem: Problem) -> Ints:
    """Return the used views in the order in which the halves take turns.

    With three or more cameras, views that the same cameras see stand together.
    """
    used = np.unique(problem.view[problem.kept])
    if len(problem.cameras) == 2:
        return used
    images = _images(problem)
    kind = {int(v): tuple(c for w, c in sorted(images) if w == v) for v in used}
    return np.array(sorted(kind, key=lambda v: (kind[v], v)), np.int64)


def _images(problem: Problem) -> set[tuple[int, int]]:
    """Return (view, camera) of each image with enough dots to determine the target's pose."""
    kept = problem.kept
    images, counts = np.unique(
        np.stack([problem.view[kept], problem.camera[kept]], 1), axis=0, return_counts=True
    )
    return {(int(v), int(c)) for v, c in images[counts >= LEAST_DOTS]}
