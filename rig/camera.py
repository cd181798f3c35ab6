"""This module defines the camera, whose lens is telecentric, nearly telecentric or, in the limit,
perspective."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, as_pixels, as_points
from telerig.errors import GeometryError
from telerig.rig import projection, windows
from telerig.rig.lens_parameters import COEFFICIENTS, INDEX, PARAMETERS, Scales
from telerig.rig.pose import Pose
from telerig.rig.windows import Wall


@dataclass(frozen=True)
class Camera:
    """One camera of the rig.

    intrinsics : (20,) parameters of the lens and the sensor, in the order of
        `telerig.rig.lens_parameters.PARAMETERS`.
    rho_mm : half the image's diagonal in object space at the nominal scale, by which coordinates
        are divided before the distortion.
    camera_from_rig : pose; the identity for the first camera, whose frame is the rig frame.
    wall : the window through which the camera looks, or None. With a window, all points are in the
        water behind it.
    """

    name: str
    image_size_px: tuple[int, int]
    rho_mm: float
    intrinsics: Array
    camera_from_rig: Pose
    wall: Wall | None = None

    @staticmethod
    def create(
        name: str,
        image_size_px: tuple[int, int],
        scale_px_per_mm: float,
        *,
        camera_from_rig: Pose | None = None,
        rho_mm: float | None = None,
        **parameters: float,
    ) -> Camera:
        """Return a camera with the given parameters; all others are those of an ideal centred lens.

        parameters : intrinsics by name, see `telerig.rig.lens_parameters`. rho_mm : see `Camera`;
        by default it follows from the image size and the scale. Raises GeometryError for an unknown
        parameter.
        """
        unknown = set(parameters) - set(PARAMETERS)
        if unknown:
            raise GeometryError(
                f"unknown camera parameter {', '.join(sorted(unknown))}",
                todo=f"use one of {', '.join(PARAMETERS)}",
            )
        width, height = image_size_px
        values = dict.fromkeys(PARAMETERS, 0.0) | {
            "scale_px_per_mm": scale_px_per_mm,
            "aspect": 1.0,
            "centre_u_px": (width - 1) / 2,
            "centre_v_px": (height - 1) / 2,
        }
        values |= parameters
        rho = float(np.hypot(width, height) / 2 / scale_px_per_mm) if rho_mm is None else rho_mm
        pose = Pose.identity() if camera_from_rig is None else camera_from_rig
        intrinsics = np.array([values[p] for p in PARAMETERS], float)
        return Camera(name, (int(width), int(height)), rho, intrinsics, pose)

    def __getitem__(self, parameter: str) -> float:
        return float(self.intrinsics[INDEX[parameter]])

    def with_parameters(self, **parameters: float) -> Camera:
        """Return a copy with some intrinsics changed. Raises KeyError for an unknown parameter."""
        intrinsics = self.intrinsics.copy()
        for name, value in parameters.items():
            intrinsics[INDEX[name]] = value
        return replace(self, intrinsics=intrinsics)

    def undistorted(self) -> Camera:
        """Return this camera without the distortion of its lens.

        Its pose, scale, aspect ratio, skew, residual perspective and tilt of the sensor remain.
        """
        return self.with_parameters(**dict.fromkeys(COEFFICIENTS, 0.0))

    def distorted_pixel(self, uv_px: ArrayLike) -> Array:
        """Return the pixels (..., 2) in this camera of pixels (..., 2) of `undistorted`.

        Raises InputError for another shape.
        """
        intrinsics = self.undistorted().intrinsics
        uv = as_pixels(uv_px, f"camera {self.name}, distorted_pixel")
        ideal = projection.ideal_from_pixel(uv, intrinsics, self.rho_mm)
        at_depth_0 = np.concatenate([ideal, np.zeros_like(ideal[..., :1])], -1)
        return projection.pixel_from_camera(at_depth_0, self.intrinsics, self.rho_mm)

    @property
    def scales(self) -> Scales:
        """Return the camera's scale (px/mm), half diagonal (mm) and image width (px)."""
        return Scales(self["scale_px_per_mm"], self.rho_mm, self.image_size_px[0])

    @property
    def rig_from_camera(self) -> Pose:
        """Return the pose of the camera in the rig frame."""
        return self.camera_from_rig.inverse()

    def project(self, points_rig_mm: ArrayLike) -> Array:
        """Return the pixels (..., 2) at which the camera sees the points (..., 3) of the rig frame.

        Raises InputError for another shape, and GeometryError for points behind the perspective
        centre, or that no ray reaches.
        """
        given = as_points(points_rig_mm, f"camera {self.name}, project")
        own = self.camera_from_rig.apply(np.atleast_2d(given))
        if self.wall is None and np.any(1 + self["kappa_per_mm"] * own[..., 2] <= 0):
            raise GeometryError(
                f"a point lies behind the perspective centre of camera {self.name!r} "
                f"(z < {-1 / self['kappa_per_mm']:.1f} mm)",
                todo="project only points in front of the camera",
            )
        uv = projection.pixel_from_camera(own, self.intrinsics, self.rho_mm, self.wall)
        return uv.reshape(*given.shape[:-1], 2)

    def pixel_jacobians(
        self, points_camera_mm: Array, free: Sequence[int] = range(len(PARAMETERS))
    ) -> tuple[Array, Array, Array]:
        """Return `projection.pixel_jacobians` of this camera, for points (..., 3) in its frame."""
        return projection.pixel_jacobians(
            points_camera_mm, self.intrinsics, self.rho_mm, self.wall, free
        )

    def unproject(self, uv_px: ArrayLike) -> tuple[Array, Array]:
        """Return the rays at pixels (..., 2): origins (..., 3) in mm and unit directions (..., 3).

        They are in the rig frame. An origin lies in the camera's plane Z = 0; a ray in water is
        extended backwards to it in a straight line. Raises InputError for another shape, and
        GeometryError where the lens model has no inverse.
        """
        uv = as_pixels(uv_px, f"camera {self.name}, unproject")
        ideal = projection.ideal_from_pixel(uv, self.intrinsics, self.rho_mm)
        if self.wall is not None:
            wall = projection.turned_wall(self.intrinsics, self.wall)
            origin, direction = windows.water_from_ideal(ideal, self["kappa_per_mm"], wall)
        else:
            origin, direction = windows.air_rays(ideal, self["kappa_per_mm"])
            direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        rotation = self.camera_from_rig.rotation
        return (origin - self.camera_from_rig.translation_mm) @ rotation, direction @ rotation
