"""A dotted plate as one camera sees it: where rays meet it, and where its points are imaged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose


@dataclass(frozen=True)
class Plate:
    """A flat plate with round dots, in the target's frame; its front is the side of negative z.

    dots_mm : (N, 3) centres; each dot is a disc parallel to the plate at its own z.
    diameter_mm, hole_mm : (N,) outer diameter, and the diameter of the hole of a ring (else 0).
    outline_mm : (x0, y0, x1, y1) of the plate; None: it fills every image.
    thickness_mm, index : of the glass that a camera behind the plate looks through.
    dot_albedo, plate_albedo, background_albedo : grey levels as fractions of full scale.
    dirt_mm, dirt_diameter_mm, dirt_albedo : (M, 3), (M,) specks that cover what is below them.
    """

    dots_mm: Array
    diameter_mm: Array
    hole_mm: Array
    outline_mm: tuple[float, float, float, float] | None = None
    thickness_mm: float = 0.0
    index: float = 1.5
    dot_albedo: float = 0.75
    plate_albedo: float = 0.1
    background_albedo: float = 0.25
    dirt_mm: Array | None = None
    dirt_diameter_mm: Array | None = None
    dirt_albedo: float = 0.3


def plate_from_pixel(
    camera: Camera, rig_from_target: Pose, uv_px: ArrayLike, plate: Plate, z_mm: ArrayLike = 0.0
) -> Array:
    """(..., 2) pixels -> (..., 2) x, y where their rays meet the plane at z_mm of the target."""
    origin, direction = camera.unproject(uv_px)
    target_from_rig = rig_from_target.inverse()
    origin = target_from_rig.apply(np.atleast_2d(origin))
    direction = direction @ target_from_rig.rotation.T
    along = (np.asarray(z_mm) - origin[..., 2]) / direction[..., 2]
    hit = origin[..., :2] + along[..., None] * direction[..., :2]
    return np.asarray(hit - _glass_shift(direction, plate)).reshape(np.shape(uv_px))


def pixel_from_plate(
    camera: Camera, rig_from_target: Pose, points_mm: ArrayLike, plate: Plate
) -> Array:
    """(..., 3) points on the plate -> (..., 2) exact pixels, through the glass if seen from behind.

    A ray's shift by the glass depends on its direction, which for kappa = 0 all rays share; else
    the fixed point contracts by about kappa times the thickness.
    """
    points = np.asarray(points_mm, float)
    uv = camera.project(rig_from_target.apply(points))
    if plate.thickness_mm == 0:
        return uv
    target_from_rig = rig_from_target.inverse()
    for _ in range(4 if camera["kappa_per_mm"] else 1):
        direction = camera.unproject(uv)[1] @ target_from_rig.rotation.T
        apparent = points.copy()
        apparent[..., :2] += _glass_shift(direction, plate)
        uv = camera.project(rig_from_target.apply(apparent))
    return uv


def _glass_shift(direction: Array, plate: Plate) -> Array:
    """(..., 3) directions in the target's frame -> (..., 2): straight hit minus refracted hit."""
    lateral = direction[..., :2]
    if plate.thickness_mm == 0:
        return np.zeros_like(lateral)
    inside = lateral / plate.index
    refracted = inside / np.sqrt(1 - np.sum(inside**2, -1, keepdims=True))
    straight = lateral / np.abs(direction[..., 2:])
    return np.asarray(
        np.where(direction[..., 2:] < 0, plate.thickness_mm * (straight - refracted), 0.0)
    )
