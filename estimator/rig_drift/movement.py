"""A movement of one camera since the calibration: its prior, and its posterior from a run.

Directions that cause no ray miss keep their calibrated values. With perspective lenses more
components are identifiable than with telecentric ones, and are estimated too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.estimator.rig_drift.ray_misses import Free, Pair, common_perpendicular
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.triangulation import (
    POSE_COMPONENTS,
    nearly_parallel,
    rig_jacobian,
    stacked_jacobian,
)

if TYPE_CHECKING:
    from telerig.estimator.calibration.result.calibration import Calibration


POSE = len(POSE_COMPONENTS)

_LEAST_EFFECT = 0.02
"""A direction of movement is estimated if its ray misses are larger than this share of those of the
direction with the largest ray misses."""

_GRID = 0.7
_SINGULAR = 1e-12


@dataclass(frozen=True)
class DriftPrior:
    """Prior standard deviations of how far a camera has moved since the calibration.

    The movement is that against the others, along and about each axis of the camera. The defaults
    are wide. Raises InputError for values that are not positive.
    """

    rotation_rad: float = 5e-3
    translation_mm: float = 0.2

    def __post_init__(self) -> None:
        if not (self.rotation_rad > 0 and self.translation_mm > 0):
            raise InputError(
                f"the prior standard deviations of a movement are {self.rotation_rad} rad and "
                f"{self.translation_mm} mm",
                todo="give two positive numbers",
            )


@dataclass(frozen=True)
class Movement:
    """A movement of one of C cameras since the calibration, before it is known.

    moved, against : indices of the camera, and of another with which it makes ray misses.
    by_movement : (6 (C - 1), 6) derivative of the poses of all cameras but the first, which the rig
        frame moves with, by the movement.
    covariance : (6, 6) prior covariance of the movement: rotation (rad), translation (mm).
    """

    moved: int
    against: int
    by_movement: Array
    covariance: Array

    @staticmethod
    def of(cameras: Sequence[Camera], moved: int, against: int, prior: DriftPrior) -> Movement:
        """Return the movement of a camera with the prior of `drift_covariance`."""
        by = np.zeros((len(cameras) - 1, POSE, POSE))
        if moved:
            by[moved - 1] = np.eye(POSE)
        else:  # the others move in the frame of the first
            for j, camera in enumerate(cameras[1:]):
                by[j] = -camera.camera_from_rig.adjoint()
        covariance = drift_covariance(cameras, prior, moved)
        return Movement(moved, against, by.reshape(-1, POSE), covariance)

    def pair(self, cameras: Sequence[Camera]) -> Pair:
        """Return the camera that it is against, and the camera that moves."""
        return cameras[self.against], cameras[self.moved]

    def applied(self, cameras: Sequence[Camera], tangent: Array) -> tuple[Camera, ...]:
        """Return the cameras after a movement (6,)."""
        steps = (self.by_movement @ tangent).reshape(-1, POSE)
        poses = (moved_pose(c.camera_from_rig.inverse(), t) for c, t in zip(cameras[1:], steps))
        others = (replace(c, camera_from_rig=p.inverse()) for c, p in zip(cameras[1:], poses))
        return (cameras[0], *others)


def drift_covariance(cameras: Sequence[Camera], prior: DriftPrior, moved: int = 1) -> Array:
    """Return the prior covariance (6, 6) of a movement of one camera.

    Directions of movement that hardly move any pixels from those of one point, in the volume that
    the cameras see, have the variance 0. The components are `POSE_COMPONENTS` (rad, mm).
    """
    others = [c for k, c in enumerate(cameras) if k != moved]
    every = (*others, cameras[moved])
    beside = next((c for c in others if not nearly_parallel((c, every[-1]))), others[0])
    _, middle = common_perpendicular((beside, every[-1]))
    reach = min(min(c.image_size_px) / c["scale_px_per_mm"] / 2 for c in cameras)
    steps = _GRID * reach * np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), -1).reshape(-1, 3)
    _, by_point = stacked_jacobian(every, middle + steps)
    by_pose = rig_jacobian(every, ((),) * len(every), middle + steps)[..., -POSE:]
    rows = by_pose - by_point @ (np.linalg.pinv(by_point) @ by_pose)
    sigma = np.repeat([prior.rotation_rad, prior.translation_mm], 3)
    _, strength, directions = np.linalg.svd(rows.reshape(-1, POSE) * sigma, full_matrices=False)
    seen = directions[strength > _LEAST_EFFECT * strength[0]]
    return np.asarray(sigma[:, None] * (seen.T @ seen) * sigma)


def p_value_of(tangent: Array, covariance: Array, prior: Array) -> float:
    """Return the p-value of an estimated movement under the hypothesis that nothing has moved.

    It is a chi-square test over the directions with a prior variance above 0. The prior shrinks the
    estimate towards 0, so the true p-value is smaller.

    tangent, covariance, prior : (6,), (6, 6), (6, 6) estimate, its covariance and the covariance of
    its prior.
    """
    from scipy.special import chdtrc

    basis = covariance_root(prior)
    if not basis.shape[1]:
        return 1.0
    inverse = np.linalg.pinv(basis)
    value, spread = inverse @ tangent, inverse @ covariance @ inverse.T
    return float(chdtrc(len(value), value @ np.linalg.solve(spread, value)))


def covariance_root(covariance: Array) -> Array:
    """Return a matrix R (P, k) with R R^T = covariance (P, P) of rank k.

    Eigenvalues of the correlation matrix below 1e-12 of the largest one count as 0.
    """
    unit = _scale(covariance)
    values, vectors = np.linalg.eigh(covariance / unit[:, None] / unit)
    kept = values > _SINGULAR * max(float(values[-1]), _SINGULAR)
    return np.asarray(unit[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def _scale(covariance: Array) -> Array:
    """Return the standard deviations (P,) of a covariance (P, P), with 1 in place of 0."""
    sd = np.sqrt(np.diagonal(covariance).clip(0))
    return np.where(sd > 0, sd, 1.0)


def rig_block(calibration: Calibration) -> tuple[Array, Free]:
    """Return the covariance (P, P) of the cameras' parameters, and for each camera the names of its
    free intrinsics.

    The P parameters are ordered as in `rig_jacobian`. A calibration without a covariance gives a
    matrix of zeros and no free intrinsics.
    """
    if calibration.covariance.size:
        return calibration.covariance, calibration.free
    count = len(calibration.cameras)
    return np.zeros((POSE * (count - 1), POSE * (count - 1))), ((),) * count


def with_drift(covariance: Array, movement: Movement) -> Array:
    """Return the covariance (P, P) of the cameras' parameters with that of a movement added."""
    by, total = movement.by_movement, covariance.copy()
    total[-len(by) :, -len(by) :] += by @ movement.covariance @ by.T
    return total


def drift_posterior(
    rig: Array, rig_covariance: Array, prior_rig: Array, movement: Movement
) -> tuple[Array, Array]:
    """Return the movement (6,) of a camera, and its covariance (6, 6).

    A run determines only the sum of the calibration's error and the movement. By Gaussian
    conditioning, the movement is a gain times this sum.

    rig, rig_covariance : (P,), (P, P) posterior of the sum, for the cameras' P parameters.
    prior_rig : (P, P) covariance of the calibration.
    """
    total, drift = with_drift(prior_rig, movement), movement.covariance
    unit = _scale(total)
    inverse = np.linalg.pinv(total / unit[:, None] / unit, rcond=1e-13, hermitian=True)
    gain = np.zeros((POSE, len(total)))
    gain[:, -len(movement.by_movement) :] = drift @ movement.by_movement.T
    gain = (gain / unit) @ inverse / unit
    left = drift - gain @ total @ gain.T
    return gain @ rig, left + gain @ rig_covariance @ gain.T


def moved_pose(rig_from_camera: Pose, tangent: Array) -> Pose:
    """Return the pose after a small step (6,) (rotation, translation), a right perturbation."""
    return rig_from_camera @ Pose(rotation_from_rotvec(tangent[:3]), tangent[3:])
