"""Priors, known distance and depth gauge of the self-calibration, each a pure whitened residual."""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array
from telerig.rig.pose import hat


def distance_residual(
    first_mm: Array, second_mm: Array, distance_mm: float, sigma_mm: float
) -> tuple[Array, Array]:
    """The known distance of two dots (..., 3), which sets the scale.

    Returns (...,) residuals and (..., 3) derivatives by the first dot; those by the second are
    their negative.
    """
    difference = first_mm - second_mm
    length = np.linalg.norm(difference, axis=-1)
    return (
        np.asarray((length - distance_mm) / sigma_mm),
        np.asarray(difference / (length * sigma_mm)[..., None]),
    )


def depth_gauge_residual(rig_from_camera: Array, sigma_mm: float) -> tuple[Array, Array]:
    """The rig origin lies where two optical axes come closest.

    (..., 4, 4) poses -> (..., 2) their translations along the first camera's axis and along their
    own, and (..., 2, 6) by GTSAM's Pose3 tangent. Neither is observable of the second camera, only
    that along its own axis of a further one; see `docs/theory.md`.
    """
    rotation, translation = rig_from_camera[..., :3, :3], rig_from_camera[..., :3, 3]
    axis = rotation[..., 2]
    along_own = (translation * axis).sum(-1)
    jacobian = np.zeros((*translation.shape[:-1], 2, 6))
    jacobian[..., 0, 3:] = rotation[..., 2, :]
    turned = np.einsum("...i,...ij->...j", translation, rotation)
    jacobian[..., 1, :3] = -turned @ hat(np.array([0.0, 0.0, 1.0]))
    jacobian[..., 1, 3:] = np.einsum("...i,...ij->...j", axis, rotation)
    return np.stack([translation[..., 2], along_own], -1) / sigma_mm, jacobian / sigma_mm


def place_residual(rig_from_target: Array, sigma_mm: float) -> tuple[Array, Array]:
    """A loose prior on the target's place: bounds a depth that a single camera cannot see.

    (..., 4, 4) poses -> (..., 3) residuals and (..., 3, 6) by GTSAM's Pose3 tangent.
    """
    rotation, translation = rig_from_target[..., :3, :3], rig_from_target[..., :3, 3]
    jacobian = np.concatenate([np.zeros_like(rotation), rotation], -1) / sigma_mm
    return np.asarray(translation / sigma_mm), jacobian
