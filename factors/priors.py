"""Defines the residuals of the self-calibration that are not images: known distance, depth gauge,
weak priors.

Each is a pure function that returns whitened residuals and their derivatives.
"""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array
from telerig.rig.pose import hat


def distance_residual(
    first_mm: Array, second_mm: Array, distance_mm: float, sigma_mm: float
) -> tuple[Array, Array]:
    """Return the residual of the known distance between two dots, which sets the scale.

    first_mm, second_mm : (..., 3) positions of the two dots.

    Returns the residuals (...) and their derivatives (..., 3) with respect to the first dot. The
    derivatives with respect to the second dot are the negative of these.
    """
    difference = first_mm - second_mm
    length = np.linalg.norm(difference, axis=-1)
    return (
        np.asarray((length - distance_mm) / sigma_mm),
        np.asarray(difference / (length * sigma_mm)[..., None]),
    )


def depth_gauge_residual(rig_from_camera: Array, sigma_mm: float) -> tuple[Array, Array]:
    """Return the residuals that put the rig origin where two optical axes come closest.

    rig_from_camera : (..., 4, 4) poses of the second camera or a further one.

    Returns the residuals (..., 2), which are the translation along the axis of the first camera and
    along the camera's own axis, both over ``sigma_mm``, and their derivatives (..., 2, 6) with
    respect to GTSAM's Pose3 tangent. Images do not determine either translation for the second
    camera. For a further camera they leave only the translation along its own axis undetermined;
    see `docs/theory.md`.
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
    """Return the residuals of a weak prior on the target's position in a view.

    It bounds the depth of a view that only one telecentric camera sees.

    rig_from_target : (..., 4, 4).

    Returns the residuals (..., 3) and their derivatives (..., 3, 6) with respect to GTSAM's Pose3
    tangent.
    """
    rotation, translation = rig_from_target[..., :3, :3], rig_from_target[..., :3, 3]
    jacobian = np.concatenate([np.zeros_like(rotation), rotation], -1) / sigma_mm
    return np.asarray(translation / sigma_mm), jacobian
