"""Describe the volume that all cameras see, by points at which two camera models are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import PARAMETERS


@dataclass(frozen=True)
class Volume:
    """Hold a box in the rig frame by two corners: lower_mm (3,) and upper_mm (3,), in mm."""

    lower_mm: Array
    upper_mm: Array

    def grid(self, per_edge: int) -> Array:
        """Return the points (per_edge^3, 3) in mm of a regular grid, which includes the faces."""
        edges = [np.linspace(a, b, per_edge) for a, b in zip(self.lower_mm, self.upper_mm)]
        return np.stack(np.meshgrid(*edges, indexing="ij"), -1).reshape(-1, 3)

    def words(self) -> str:
        """Return the box in words, for a file's header."""
        return ", ".join(
            f"{axis} {a:.6g} to {b:.6g} mm"
            for axis, a, b in zip("xyz", self.lower_mm, self.upper_mm)
        )


@dataclass(frozen=True)
class Misfit:
    """Hold the distance (RMS and maximum, px) between two projections of the same points."""

    rms_px: float
    max_px: float
    points: int

    @staticmethod
    def between(one_px: Array, other_px: Array) -> Misfit:
        """Compute the misfit of two projections, one_px and other_px, both (points, 2) in px."""
        distance = np.linalg.norm(one_px - other_px, axis=-1)
        rms = float(np.sqrt(np.mean(distance**2)))
        return Misfit(rms, float(distance.max()), len(distance))

    def words(self) -> str:
        """Return both distances and the number of points in words."""
        return f"RMS {self.rms_px:.3g} px, largest {self.max_px:.3g} px, at {self.points} points"


EXPORTED = (
    "scale_px_per_mm", "aspect", "skew", "centre_u_px", "centre_v_px", "kappa_per_mm",
    "k1", "k2", "k3", "p1", "p2", "s1", "s2", "s3", "s4",
    "tilt_x", "tilt_y", "image_convergence_per_mm", "wall_x_rad", "wall_y_rad",
)  # fmt: skip
"""The lens parameters that the exports to HALCON and OpenCV express, or name in a note."""


def refuse_unknown_parameters(cameras: Sequence[Camera], program: str) -> None:
    """Raise InputError for a camera with a lens parameter that the export cannot express.

    It is a parameter that is not 0 and not in `EXPORTED`. program : name of the program, for the
    message.
    """
    for camera in cameras:
        for name, value in zip(PARAMETERS, camera.intrinsics):
            if name not in EXPORTED and value != 0:
                raise InputError(
                    f"camera {camera.name} has the lens parameter {name} = {value:.6g}, which the "
                    f"export to {program} does not know",
                    todo=f"calibrate with a --model without {name}",
                )


def volume_of(bounds_mm: ArrayLike) -> Volume:
    """Return the box ((x_low, x_high), (y_low, y_high), (z_low, z_high)) in mm.

    Raises InputError when the bounds have another shape or the box is empty.
    """
    bounds = np.asarray(bounds_mm, float)
    if bounds.shape != (3, 2) or not np.all(bounds[:, 0] < bounds[:, 1]):
        raise InputError(
            f"volume {bounds.tolist()} is no box",
            todo="give ((x_low, x_high), (y_low, y_high), (z_low, z_high)) in mm",
        )
    return Volume(bounds[:, 0], bounds[:, 1])


def working_volume(cameras: Sequence[Camera]) -> Volume:
    """Return a cube around the point where the rays of the image centres come closest.

    Its edge is the shortest image edge in mm. Parts of it may lie outside an image: see
    `seen_points`.
    """
    if not cameras:
        raise InputError("no camera", todo="give at least one")
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras:
        middle = (np.array(camera.image_size_px, float) - 1) / 2
        origin, direction = camera.unproject(middle)
        across = np.eye(3) - np.outer(direction, direction)
        normal, right = normal + across, right + across @ origin
    centre = np.asarray(np.linalg.lstsq(normal, right, rcond=1e-6)[0], np.float64)
    half = min(min(c.image_size_px) / c["scale_px_per_mm"] for c in cameras) / 2
    return Volume(np.asarray(centre - half), np.asarray(centre + half))


def seen_points(cameras: Sequence[Camera], volume: Volume, per_edge: int) -> Array:
    """Return the points (points, 3) in mm of the volume's grid that every camera sees.

    Raises InputError when fewer than 100 points are seen.
    """
    points = volume.grid(per_edge)
    seen = np.ones(len(points), bool)
    for camera in cameras:
        depth = camera.camera_from_rig.apply(points)[:, 2]
        seen &= 1 + camera["kappa_per_mm"] * depth > 0
    points = points[seen]
    for camera in cameras:
        uv, size = camera.project(points), np.array(camera.image_size_px)
        points = points[np.all((uv >= -0.5) & (uv <= size - 0.5), axis=-1)]
    if len(points) < 100:
        raise InputError(
            f"only {len(points)} of {per_edge**3} points of the volume ({volume.words()}) are in "
            "every camera's image",
            todo="give a smaller volume, or one about the middle of the fields of view (--volume)",
        )
    return points
