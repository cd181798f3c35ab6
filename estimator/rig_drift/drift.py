"""Models a change of the pose between the two cameras, and the ray misses that it causes.

The two rays of a pair miss each other along the common perpendicular n of both lines of sight. If
the second camera has moved by v and rotated by w, the ray miss at a rig point p is n . (v + w x p),
which is a constant plus a slope along both lines of sight. Ray misses therefore identify three of
the six components of the pose between two telecentric cameras, at any angle between them: the shift
along n, and the two rotations about axes perpendicular to n (roll about the second camera's own
axis, and pitch about the axis perpendicular to that). Shifts in the plane of the lines of sight and
the angle between the cameras (rotation about n) move the triangulated point but cause no ray miss;
they keep their calibrated values. With perspective lenses more components are identifiable, and
these are estimated too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc

from telerig.arrays import Array
from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.solver.covariance import POSE_COMPONENTS, rig_jacobian
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.triangulation import midpoint, stacked_jacobian

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration

Free = tuple[tuple[str, ...], ...]
Pair = tuple[Camera, Camera]

POSE = len(POSE_COMPONENTS)
FALSE_ALARM = 1e-4
"""Probability of reporting a movement if there is none."""

_LEAST_EFFECT = 0.02
"""A direction of movement is estimated if its ray misses are larger than this share of those of the
direction with the largest ray misses."""

_NOT_IDENTIFIED = 0.5
"""A rotation is not reported if its posterior standard deviation is larger than this share of the
prior one."""

_GRID = 0.7
_SINGULAR = 1e-10
_LEAST_SINE = 0.05


@dataclass(frozen=True)
class DriftPrior:
    """Holds the prior standard deviations of each component of a movement.

    They are wide, so that the data of the run decide. Components without effect on ray misses are
    held at 0. Raises InputError for values that are not positive.
    """

    rotation_rad: float = 5e-3
    translation_mm: float = 0.2

    def __post_init__(self) -> None:
        if not (self.rotation_rad > 0 and self.translation_mm > 0):
            raise InputError(
                f"a drift prior of {self.rotation_rad} rad and {self.translation_mm} mm",
                todo="give positive standard deviations",
            )


@dataclass(frozen=True)
class RigChange:
    """Describes the movement of the second camera relative to the first since the calibration.

    camera : name of the second camera.
    tangent, covariance : (6,) and (6, 6) of rig_from_<second camera> with the components
        `POSE_COMPONENTS`. They are 0 in the directions that ray misses do not identify.
    place_mm : (3,) mean position of the bubbles in the rig frame. The offset refers to this point.
    values, sigmas : (3,) offset along n (mm), roll and pitch (rad), and their standard deviations.
    prior_sigmas : (3,) their prior standard deviations.
    chance : p-value, the probability of such ray misses if nothing has moved.
    pairs : number of pairs from which the movement was estimated.
    refined : pose rig_from_<second camera> that calibration and run give together; None if it was
        not estimated.
    """

    camera: str
    tangent: Array
    covariance: Array
    place_mm: Array
    values: Array
    sigmas: Array
    prior_sigmas: Array
    chance: float
    pairs: int
    refined: Pose | None = None

    @property
    def moved(self) -> bool:
        """Whether calibration errors, shake and bubble shapes do not explain the ray misses."""
        return self.chance < FALSE_ALARM

    def size_words(self) -> str:
        """Return the identifiable part of the movement in words, with standard deviations."""
        offset, *turns = zip(1e6 * self.values, 1e6 * self.sigmas)
        text = f"by {_rounded(offset[0] / 1000, offset[1] / 1000)} µm along the shared coordinate"
        identified = self.sigmas[1:] < _NOT_IDENTIFIED * self.prior_sigmas[1:]
        each = zip(("rolled", "pitched"), turns, identified)
        turned = [f"{name} by {_rounded(*turn)} µrad" for name, turn, known in each if known]
        return (
            ", ".join([text, *turned]) if turned else f"{text} (its rotations cannot be determined)"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the content of ``rig_change`` in smoothing.json and tracking.json."""
        names = ("offset_mm", "roll_rad", "pitch_rad")
        out: dict[str, Any] = {"camera": self.camera, "moved": self.moved, "chance": self.chance}
        out |= {n: float(v) for n, v in zip(names, self.values)}
        out |= {f"s{n}": float(s) for n, s in zip(names, self.sigmas)}
        out |= {
            "place_mm": self.place_mm.tolist(),
            "components": list(POSE_COMPONENTS),
            "tangent": self.tangent.tolist(),
            "covariance": self.covariance.tolist(),
            "pairs": self.pairs,
            "not_seen": "Shifts in the plane of both lines of sight and the angle between them "
            "cause no ray miss. They keep their calibrated values.",
        }
        if self.refined is not None:
            out["rig_from_camera"] = {
                "rotation": self.refined.rotation.tolist(),
                "translation_mm": self.refined.translation_mm.tolist(),
            }
        return out


def _rounded(value: float, sd: float) -> str:
    """Return value and standard deviation as text, rounded to two digits of the standard
    deviation."""
    digits = max(0, 1 - math.floor(math.log10(sd))) if sd > 0 else 2
    return f"{value:+.{digits}f} ± {sd:.{digits}f}"


def common_perpendicular(cameras: Pair) -> tuple[Array, Array]:
    """Return the common perpendicular of both lines of sight, and the rig point where these are
    closest.

    The first is the unit vector n (3,) along first line of sight x second line of sight, the other
    a point (3,) in mm. Raises CalibrationError for cameras that look along one line.
    """
    rays = [c.unproject((np.array(c.image_size_px, float)[None] - 1) / 2) for c in cameras]
    cross = np.cross(rays[0][1], rays[1][1])[0]
    sine = float(np.linalg.norm(cross))
    if sine < _LEAST_SINE:
        raise CalibrationError(
            "both cameras look along one line",
            todo="a movement can be found only between cameras with different lines of sight",
        )
    middle, _ = midpoint(*rays[0], *rays[1])
    return cross / sine, middle[0]


@dataclass(frozen=True)
class RayMisses:
    """Holds the ray misses of M pairs in mm along n.

    miss_mm : (M,).
    variance_mm2 : (M,) variance due to the noise of the pixels.
    by_rig : (M, P) derivative with respect to the P parameters of the cameras.
    """

    miss_mm: Array
    variance_mm2: Array
    by_rig: Array


def ray_misses(
    cameras: Pair,
    free: Free,
    points_mm: Array,
    uv_px: Array | None = None,
    covariance_px2: Array | None = None,
) -> RayMisses:
    """Return the ray misses of M pairs, linearised at rig points near them.

    One combination of the four pixel coordinates of a pair does not change with the point; it is
    given by the left null vector of the projection's Jacobian. This combination is the ray miss. It
    is scaled to the shift of the second camera along n that would explain it.

    free : for each camera the names of its free intrinsics.
    points_mm : (M, 3) rig points.
    uv_px : (M, 2, 2) pixels of each pair in the two cameras; without them the ray misses are 0.
    covariance_px2 : (M, 2, 2, 2) their covariances; without them the variances are 0.
    """
    n, _ = common_perpendicular(cameras)
    predicted, by_point = stacked_jacobian(cameras, points_mm)
    null = np.linalg.svd(by_point)[0][..., :, 3]
    scale = -np.einsum("mi,mij,j->m", null[:, 2:], by_point[:, 2:], n)
    null = null / scale[:, None]
    by_rig = np.einsum("mi,mip->mp", null, rig_jacobian(cameras, free, points_mm))
    miss, variance = np.zeros(len(points_mm)), np.zeros(len(points_mm))
    if uv_px is not None:
        miss = np.einsum("mi,mi->m", null, uv_px.reshape(-1, 4) - predicted)
    if covariance_px2 is not None:
        by_camera = null.reshape(-1, 2, 2)
        variance = np.einsum("mci,mcij,mcj->m", by_camera, covariance_px2, by_camera)
    return RayMisses(miss, variance, by_rig)


def drift_covariance(cameras: Pair, prior: DriftPrior) -> Array:
    """Return the prior covariance (6, 6) of a movement, restricted to directions that cause ray
    misses.

    The ray misses of different directions are compared over the volume that both cameras see.
    """
    _, middle = common_perpendicular(cameras)
    reach = min(min(c.image_size_px) / c["scale_px_per_mm"] / 2 for c in cameras)
    steps = _GRID * reach * np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), -1).reshape(-1, 3)
    rows = ray_misses(cameras, ((), ()), middle + steps).by_rig
    sigma = np.repeat([prior.rotation_rad, prior.translation_mm], 3)
    _, strength, directions = np.linalg.svd(rows * sigma)
    seen = directions[: len(strength)][strength > _LEAST_EFFECT * strength[0]]
    return np.asarray(sigma[:, None] * (seen.T @ seen) * sigma)


def rig_change_from(
    cameras: Pair,
    tangent: Array,
    covariance: Array,
    prior: Array,
    place_mm: Array,
    pairs: int,
    refined: Pose | None = None,
) -> RigChange:
    """Return a movement with its offset, roll and pitch.

    tangent : (6,) estimate, as in `RigChange`.
    covariance, prior : (6, 6) posterior and prior covariance.
    place_mm : (3,) rig point to which the offset refers.
    """
    rows = offset_roll_pitch(cameras, place_mm)
    sigmas, priors = (np.sqrt(np.diagonal(rows @ c @ rows.T).clip(0)) for c in (covariance, prior))
    return RigChange(
        cameras[1].name, tangent, covariance, place_mm, rows @ tangent, sigmas, priors,
        p_value_of(tangent, covariance, prior), pairs, refined,
    )  # fmt: skip


def offset_roll_pitch(cameras: Pair, place_mm: Array) -> Array:
    """Return the matrix (3, 6) that maps the tangent of rig_from_second to offset, roll and pitch.

    The offset is the shift along n at the rig point ``place_mm`` (3,).
    """
    n, _ = common_perpendicular(cameras)
    pose = cameras[1].camera_from_rig
    across = pose.rotation @ n
    at = pose.apply(place_mm[None])[0]
    pitch = np.cross([0.0, 0.0, 1.0], across)
    offset = np.concatenate([np.cross(at, across), across])
    roll = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    return np.stack([offset, roll, np.concatenate([pitch / np.linalg.norm(pitch), np.zeros(3)])])


def p_value_of(tangent: Array, covariance: Array, prior: Array) -> float:
    """Return the p-value of an estimate under the hypothesis of no movement.

    It is a chi-square test over the directions that the prior leaves free. The prior shrinks the
    estimate towards 0, so the true p-value is smaller than the returned one.
    """
    basis = covariance_root(prior)
    if not basis.shape[1]:
        return 1.0
    inverse = np.linalg.pinv(basis)
    value, spread = inverse @ tangent, inverse @ covariance @ inverse.T
    return float(chdtrc(len(value), value @ np.linalg.solve(spread, value)))


def covariance_root(covariance: Array, singular: float = _SINGULAR) -> Array:
    """Return a square root (P, k) of a covariance (P, P): its k directions of non-zero variance.

    singular : eigenvalues of the correlation matrix below this share of the largest one count as 0.
    """
    unit = _scale(covariance)
    values, vectors = np.linalg.eigh(covariance / unit[:, None] / unit)
    kept = values > singular * max(float(values[-1]), singular)
    return np.asarray(unit[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def _scale(covariance: Array) -> Array:
    """Return the standard deviations (P,) of a covariance (P, P), with 1 in place of 0."""
    sd = np.sqrt(np.diagonal(covariance).clip(0))
    return np.where(sd > 0, sd, 1.0)


def rig_block(calibration: Calibration) -> tuple[Array, Free]:
    """Return the covariance of the cameras' parameters, and each camera's free intrinsics.

    The covariance is zero for a calibration that states none.
    """
    if calibration.covariance.size:
        return calibration.covariance, calibration.free
    return np.zeros((POSE, POSE)), ((), ())


def with_drift(covariance: Array, drift: Array) -> Array:
    """Return the covariance (P, P) of the cameras' parameters with that of a movement added.

    drift : (6, 6) covariance of a movement of the second camera.
    """
    total = covariance.copy()
    total[-POSE:, -POSE:] += drift
    return total


def drift_posterior(
    rig: Array, rig_covariance: Array, prior_rig: Array, drift: Array
) -> tuple[Array, Array]:
    """Return the movement's part of an estimated error of the cameras' parameters.

    By Gaussian conditioning, the movement is a gain matrix times the sum of calibration error and
    movement.

    rig, rig_covariance : (P,) and (P, P) posterior of the sum of calibration error and movement.
    prior_rig : (P, P) covariance of the calibration.
    drift : (6, 6) prior covariance of the movement.

    Returns the movement (6,) and its covariance (6, 6).
    """
    total = with_drift(prior_rig, drift)
    unit = _scale(total)
    inverse = np.linalg.pinv(total / unit[:, None] / unit, rcond=1e-13, hermitian=True)
    gain = np.zeros((POSE, len(total)))
    gain[:, -POSE:] = drift
    gain = (gain / unit) @ inverse / unit
    left = drift - gain @ total @ gain.T
    return gain @ rig, left + gain @ rig_covariance @ gain.T


def moved_pose(rig_from_camera: Pose, tangent: Array) -> Pose:
    """Return the pose after a small step (6,) (rotation, translation), applied as a right
    perturbation."""
    return rig_from_camera @ Pose(rotation_from_rotvec(tangent[:3]), tangent[3:])
