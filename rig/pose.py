"""Describes rigid transformations by a rotation and a translation. Tangent vectors have the order
of GTSAM's Pose3, rotation first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array


def hat(v: ArrayLike) -> Array:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3): hat(v) w = v x w."""
    v = np.asarray(v, float)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def across(direction: ArrayLike) -> Array:
    """Return two orthonormal vectors, as columns (3, 2), perpendicular to a direction (3,)."""
    return np.asarray(np.linalg.svd(np.asarray(direction, float)[None])[2][1:].T)


def rotation_from_rotvec(rotvec_rad: ArrayLike) -> Array:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad (Rodrigues)."""
    w = np.asarray(rotvec_rad, float)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    k = hat(w)
    half = np.sinc(angle / (2 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * half**2 * (k @ k))


def rotvec_from_rotation(rotation: ArrayLike) -> Array:
    """Return the rotation vectors (..., 3), of angles in [0, pi], of rotation matrices (..., 3, 3).

    The unit quaternion q is computed first (Shepperd, J. Guidance and Control 1, 1978): every
    column of 4 q q^T is a multiple of q, and the longest column is used.
    """
    r = np.asarray(rotation, float)
    trace = np.trace(r, axis1=-2, axis2=-1)[..., None]
    turned = r.mT
    outer = np.empty((*r.shape[:-2], 4, 4))
    outer[..., :3, :3] = r + turned
    outer[..., range(3), range(3)] = 1 - trace + 2 * np.diagonal(r, axis1=-2, axis2=-1)
    skew = r - turned
    outer[..., :3, 3] = outer[..., 3, :3] = skew[..., [2, 0, 1], [1, 2, 0]]
    outer[..., 3, 3] = 1 + trace[..., 0]
    longest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, longest[..., None, None], axis=-1)[..., 0]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True) * np.where(q[..., 3:] < 0, -1.0, 1.0)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., 3:])
    return np.asarray(q[..., :3] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 2.0))


def nearest_rotation(matrix: ArrayLike) -> Array:
    """Return the proper rotation (..., 3, 3) nearest to each matrix in the Frobenius norm."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, float))
    u[..., :, 2] *= np.linalg.det(u @ vt)[..., None]
    return np.asarray(u @ vt)


@dataclass(frozen=True)
class Pose:
    """The rigid transformation target_from_source: x_target = rotation @ x_source + translation."""

    rotation: Array
    translation_mm: Array

    @staticmethod
    def identity() -> Pose:
        """Return the pose that changes nothing."""
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_rotvec(rotvec_rad: ArrayLike, translation_mm: ArrayLike = (0.0, 0.0, 0.0)) -> Pose:
        """Return the pose of a rotation vector (3,) in rad and a translation (3,) in mm."""
        return Pose(rotation_from_rotvec(rotvec_rad), np.asarray(translation_mm, float))

    @staticmethod
    def aligning(source_mm: Array, target_mm: Array) -> Pose:
        """Return the pose that moves points (N, 3) to others with the least squared distances."""
        a, b = source_mm.mean(0), target_mm.mean(0)
        rotation = nearest_rotation((target_mm - b).T @ (source_mm - a))
        return Pose(rotation, b - rotation @ a)

    @property
    def rotvec_rad(self) -> Array:
        """Return the rotation vector (3,) in rad."""
        return rotvec_from_rotation(self.rotation)

    @property
    def matrix(self) -> Array:
        """The transformation of homogeneous coordinates (4, 4)."""
        return np.block([[self.rotation, self.translation_mm[:, None]], [0.0, 0.0, 0.0, 1.0]])

    def apply(self, points_mm: ArrayLike) -> Array:
        """Return points (..., N, 3) in target coordinates, from those in source coordinates."""
        rotated = np.asarray(points_mm, float) @ self.rotation.mT
        return np.asarray(rotated + self.translation_mm[..., None, :])

    def inverse(self) -> Pose:
        """Return ``source_from_target``."""
        back = self.rotation.mT
        return Pose(back, -np.einsum("...ij,...j->...i", back, self.translation_mm))

    def adjoint(self) -> Array:
        """Return the matrices (..., 6, 6) with T Exp(x) T^-1 = Exp(adjoint x), for tangents x."""
        out = np.zeros((*self.rotation.shape[:-2], 6, 6))
        out[..., :3, :3] = out[..., 3:, 3:] = self.rotation
        out[..., 3:, :3] = hat(self.translation_mm) @ self.rotation
        return out

    def __matmul__(self, other: Pose) -> Pose:
        turned = np.einsum("...ij,...j->...i", self.rotation, other.translation_mm)
        return Pose(self.rotation @ other.rotation, turned + self.translation_mm)
