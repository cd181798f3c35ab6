"""What the bubbles' own pairs tell of a movement of the cameras against each other.

The rays of a pair miss each other along the common perpendicular n of both lines of sight. The
gap at a rig point p, when the second camera has moved by v and turned by w, is n . (v + w x p): a
constant and a slope along both lines of sight, so of the six components of the pose between two
telecentric cameras the gaps tell three, at any angle between them: the shift along n, and the two
rotations about axes across n (roll about the second camera's own axis, pitch about the axis
across that). The shifts in the plane of the lines of sight and the angle between them (rotation
about n) move the point and leave no gap; they stay as calibrated. Perspective lenses tell more,
and get it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.solver.covariance import POSE_COMPONENTS, rig_jacobian
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.triangulation import midpoint, stacked_jacobian

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration

Array = NDArray[np.float64]
Free = tuple[tuple[str, ...], ...]
Pair = tuple[Camera, Camera]

POSE = len(POSE_COMPONENTS)
SURE = 1e-4
"""Chance of calling a movement what is none."""

_LEAST_SEEN = 0.02
_NOT_SEEN = 0.5
_GRID = 0.7
_SINGULAR = 1e-10
_LEAST_SINE = 0.05


@dataclass(frozen=True)
class DriftPrior:
    """What a movement may be, before the run: standard deviations of each component.

    Wide by default, so that the run alone decides; what no gap shows is not freed.
    """

    rotation_rad: float = 5e-3
    translation_mm: float = 0.2

    def __post_init__(self) -> None:
        """Raises InputError for values that are not positive."""
        if not (self.rotation_rad > 0 and self.translation_mm > 0):
            raise InputError(
                f"a drift prior of {self.rotation_rad} rad and {self.translation_mm} mm",
                todo="give positive standard deviations",
            )


@dataclass(frozen=True)
class RigChange:
    """How the second camera has moved against the first since the calibration.

    tangent, covariance : (6,), (6, 6) of rig_from_<second>, `POSE_COMPONENTS`, in the directions
        that gaps tell; 0 in the others.
    place_mm : (3,) where the bubbles are, in the rig; offset, roll and pitch are stated there.
    values, sigmas : (3,) offset (mm) along n, roll and pitch (rad).  prior_sigmas : before the run.
    chance : that gaps as these come about without any movement.
    refined : rig_from_<second> of calibration and run together; None where it was not refined.
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
        """Whether this is beyond what calibration, shake and the bubbles' shapes explain."""
        return self.chance < SURE

    def size_words(self) -> str:
        """The movement in numbers, what the run does not tell left out."""
        offset, *turns = (1e6 * v for v in self.values)
        sigma, *spreads = (1e6 * s for s in self.sigmas)
        text = f"by {_rounded(offset / 1000, sigma / 1000)} um along the shared coordinate"
        told = self.sigmas[1:] < _NOT_SEEN * self.prior_sigmas[1:]
        each = zip(("rolled", "pitched"), turns, spreads, told)
        names = [f"{n} by {_rounded(t, s)} urad" for n, t, s, seen in each if seen]
        return ", ".join([text, *names]) if names else text + " (its rotations are not seen)"

    def as_dict(self) -> dict[str, Any]:
        """The content of ``rig_change`` in smoothing.json and tracking.json."""
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
            "not_seen": "shifts in the plane of both lines of sight, and the angle between them: "
            "as calibrated",
        }
        if self.refined is not None:
            out["rig_from_camera"] = {
                "rotation": self.refined.rotation.tolist(),
                "translation_mm": self.refined.translation_mm.tolist(),
            }
        return out


def _rounded(value: float, sd: float) -> str:
    """Both cut where the standard deviation has two digits."""
    digits = max(0, 1 - math.floor(math.log10(sd))) if sd > 0 else 2
    return f"{value:+.{digits}f} +- {sd:.{digits}f}"


def common_perpendicular(cameras: Pair) -> tuple[Array, Array]:
    """Unit vector n = first line of sight x second, and the rig point where both pass closest.

    Raises CalibrationError for cameras that look along one line.
    """
    rays = [
        c.unproject((np.array(c.image_size_px, float)[None] - 1) / 2)
        for c in cameras
    ]  # fmt: skip
    cross = np.cross(rays[0][1], rays[1][1])[0]
    sine = float(np.linalg.norm(cross))
    if sine < _LEAST_SINE:
        raise CalibrationError(
            "both cameras look along one line", todo="a movement shows between two directions only"
        )
    middle, _ = midpoint(*rays[0], *rays[1])
    return cross / sine, middle[0]


@dataclass(frozen=True)
class Gaps:
    """Gaps of pairs: (M,) mm along n, their variance, (M, P) derivatives by the rig block.

    points_mm : (M, 3) in the rig, where they were linearised.
    """

    gap_mm: Array
    variance_mm2: Array
    by_rig: Array
    points_mm: Array


def gaps_of(
    cameras: Pair,
    free: Free,
    points_mm: Array,
    uv_px: Array | None = None,
    covariance_px2: Array | None = None,
) -> Gaps:
    """Gaps of pixels (M, 2 cameras, 2) near rig points (M, 3); without pixels, derivatives alone.

    Of a pair's four pixels one combination does not change with the point (the left null vector of
    the projection's Jacobian): the gap, here in mm by which the second camera moves along n.
    covariance_px2 : (M, 2, 2, 2).
    """
    n, _ = common_perpendicular(cameras)
    predicted, by_point, _ = stacked_jacobian(cameras, points_mm)
    null = np.linalg.svd(by_point)[0][..., :, 3]
    scale = -np.einsum("mi,mij,j->m", null[:, 2:], by_point[:, 2:], n)
    null = null / scale[:, None]
    by_rig = np.einsum("mi,mip->mp", null, rig_jacobian(cameras, free, points_mm))
    gap, variance = np.zeros(len(points_mm)), np.zeros(len(points_mm))
    if uv_px is not None:
        gap = np.einsum("mi,mi->m", null, uv_px.reshape(-1, 4) - predicted)
    if covariance_px2 is not None:
        halves = null.reshape(-1, 2, 2)
        variance = np.einsum("mci,mcij,mcj->m", halves, covariance_px2, halves)
    return Gaps(gap, variance, by_rig, points_mm)


def drift_covariance(cameras: Pair, prior: DriftPrior) -> Array:
    """(6, 6) prior covariance of a movement, in those directions alone that gaps show.

    Judged over the volume that both cameras see: a direction counts whose gaps there are more than
    2 % of the strongest one's.
    """
    _, middle = common_perpendicular(cameras)
    reach = min(min(c.image_size_px) / c["scale_px_per_mm"] / 2 for c in cameras)
    steps = _GRID * reach * np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), -1).reshape(-1, 3)
    held: Free = ((), ())
    rows = gaps_of(cameras, held, middle + steps).by_rig
    sigma = np.repeat([prior.rotation_rad, prior.translation_mm], 3)
    _, strength, directions = np.linalg.svd(rows * sigma)
    seen = directions[: len(strength)][strength > _LEAST_SEEN * strength[0]]
    return np.asarray(sigma[:, None] * (seen.T @ seen) * sigma)


def described(
    cameras: Pair,
    tangent: Array,
    covariance: Array,
    prior: Array,
    place_mm: Array,
    pairs: int,
    refined: Pose | None = None,
) -> RigChange:
    """A movement (6,), its covariance and prior (6, 6), as offset, roll and pitch."""
    rows = offset_roll_pitch(cameras, place_mm)
    sigmas, priors = (np.sqrt(np.diagonal(rows @ c @ rows.T).clip(0)) for c in (covariance, prior))
    return RigChange(
        cameras[1].name, tangent, covariance, place_mm, rows @ tangent, sigmas, priors,
        chance_of(tangent, covariance, prior), pairs, refined,
    )  # fmt: skip


def offset_roll_pitch(cameras: Pair, place_mm: Array) -> Array:
    """(3, 6): from the tangent of rig_from_second to the offset along n there, roll and pitch."""
    n, _ = common_perpendicular(cameras)
    pose = cameras[1].camera_from_rig
    across = pose.rotation @ n
    at = pose.apply(place_mm[None])[0]
    pitch = np.cross([0.0, 0.0, 1.0], across)
    offset = np.concatenate([np.cross(at, across), across])
    roll = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    return np.stack([offset, roll, np.concatenate([pitch / np.linalg.norm(pitch), np.zeros(3)])])


def chance_of(tangent: Array, covariance: Array, prior: Array) -> float:
    """Chance of an estimate as far from none: chi-square over the directions that the prior frees.

    The prior draws estimates towards none, so where it matters the chance is too large, never too
    small.
    """
    from scipy.stats import chi2

    basis = free_directions(prior)
    if not basis.shape[1]:
        return 1.0
    inverse = np.linalg.pinv(basis)
    value, spread = inverse @ tangent, inverse @ covariance @ inverse.T
    return float(chi2.sf(value @ np.linalg.solve(spread, value), len(value)))


def free_directions(prior: Array) -> Array:
    """(6, k) root of the prior's covariance: unit-variance directions."""
    scale = np.sqrt(np.diagonal(prior).clip(0))
    unit = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(prior / unit[:, None] / unit)
    kept = values > _SINGULAR * max(float(values[-1]), _SINGULAR)
    return np.asarray(unit[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def rig_block(calibration: Calibration) -> tuple[Array, Free]:
    """Covariance of the rig block and the free intrinsics; none for a calibration without."""
    if calibration.covariance.size:
        return calibration.covariance, calibration.free
    return np.zeros((POSE, POSE)), ((), ())


def with_drift(covariance: Array, drift: Array) -> Array:
    """(P, P) covariance of the rig block, a movement of the second camera added."""
    total = covariance.copy()
    total[-POSE:, -POSE:] += drift
    return total


def share_of_drift(
    rig: Array, rig_covariance: Array, prior_rig: Array, drift: Array
) -> tuple[Array, Array]:
    """The movement's part of the rig block's posterior: (6,), (6, 6).

    rig, rig_covariance : (P,), (P, P) posterior of what the calibration has wrong and the movement
    together; prior_rig : the calibration's covariance; drift : (6, 6) the movement's prior.
    Gaussian conditioning: the movement given the sum is K times the sum, plus what K leaves open.
    """
    total = with_drift(prior_rig, drift)
    scale = np.sqrt(np.diagonal(total).clip(0))
    unit = np.where(scale > 0, scale, 1.0)
    inverse = np.linalg.pinv(total / unit[:, None] / unit, rcond=1e-13, hermitian=True)
    gain = np.zeros((POSE, len(total)))
    gain[:, -POSE:] = drift
    gain = (gain / unit) @ inverse / unit
    left = drift - gain @ total @ gain.T
    return gain @ rig, left + gain @ rig_covariance @ gain.T


def moved_pose(rig_from_camera: Pose, tangent: Array) -> Pose:
    """The pose after a small step (6,), right perturbation."""
    return rig_from_camera @ Pose(rotation_from_rotvec(tangent[:3]), tangent[3:])
