"""A camera whose lens is telecentric, nearly telecentric or, as the limit, perspective."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.errors import GeometryError
from telerig.rig import projection, windows
from telerig.rig.pose import Pose
from telerig.rig.projection import INDEX, PARAMETERS
from telerig.rig.windows import Wall


@dataclass(frozen=True)
class Camera:
    """A camera of the rig.

    intrinsics : (20,) in the order of `telerig.rig.projection.PARAMETERS`.
    rho_mm : half the image diagonal in object space at nominal scale; normalises the distortion.
    camera_from_rig : pose; the identity for the first camera, whose frame is the rig frame.
    wall : the window that the camera looks through; all points are then in the water behind it.
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
        """A camera from named parameters. Parameters that are not given are those of an ideal lens
        centred on the image.

        Raises GeometryError for an unknown parameter.
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
        """A copy with some intrinsics changed. Raises KeyError for an unknown parameter."""
        intrinsics = self.intrinsics.copy()
        for name, value in parameters.items():
            intrinsics[INDEX[name]] = value
        return replace(self, intrinsics=intrinsics)

    @property
    def rig_from_camera(self) -> Pose:
        return self.camera_from_rig.inverse()

    def project(self, points_rig_mm: ArrayLike) -> Array:
        """(..., 3) rig points -> (..., 2) pixels.

        Raises GeometryError for points behind the perspective centre (1 + kappa Z <= 0) and for
        points that no ray reaches through the window.
        """
        points = self.camera_from_rig.apply(np.atleast_2d(points_rig_mm))
        if self.wall is None and np.any(1 + self["kappa_per_mm"] * points[..., 2] <= 0):
            raise GeometryError(
                f"a point lies behind the perspective centre of camera {self.name!r} "
                f"(z < {-1 / self['kappa_per_mm']:.1f} mm)",
                todo="project only points in front of the camera",
            )
        uv = projection.pixel_from_camera(points, self.intrinsics, self.rho_mm, self.wall)
        return uv.reshape(*np.shape(points_rig_mm)[:-1], 2)

    def pixel_jacobians(self, points_camera_mm: Array) -> tuple[Array, Array, Array]:
        """`projection.pixel_jacobians` at points (..., 3) in the camera's own frame."""
        return projection.pixel_jacobians(points_camera_mm, self.intrinsics, self.rho_mm, self.wall)

    def unproject(self, uv_px: ArrayLike) -> tuple[Array, Array]:
        """(..., 2) pixels -> rays in the rig frame: (..., 3) origins and (..., 3) unit directions.

        Origins lie in the camera's plane Z = 0; rays in water are extended straight back to it.
        Raises GeometryError for pixels where the lens model cannot be inverted.
        """
        ideal = projection.ideal_from_pixel(np.asarray(uv_px, float), self.intrinsics, self.rho_mm)
        if self.wall is not None:
            wall = projection.standing_wall(self.intrinsics, self.wall)
            origin, direction = windows.water_from_ideal(ideal, self["kappa_per_mm"], wall)
        else:
            origin, direction = windows.air_rays(ideal, self["kappa_per_mm"])
            direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        rotation = self.camera_from_rig.rotation
        return (origin - self.camera_from_rig.translation_mm) @ rotation, direction @ rotation
