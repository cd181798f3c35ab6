"""One camera: a lens that is telecentric, nearly so, or (as the limit) perspective."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.errors import GeometryError
from telerig.rig import projection
from telerig.rig.pose import Pose
from telerig.rig.projection import INDEX, PARAMETERS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A camera of the rig.

    intrinsics : (18,) in the order of `telerig.rig.projection.PARAMETERS`.
    rho_mm : half the image diagonal in object space at nominal scale; normalises the distortion.
    camera_from_rig : pose; the identity for the first camera, whose frame is the rig frame.
    """

    name: str
    image_size_px: tuple[int, int]
    rho_mm: float
    intrinsics: Array
    camera_from_rig: Pose

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
        """A camera from named parameters; what is not named is ideal, the centre that of the image.

        Raises GeometryError for an unknown parameter.
        """
        unknown = set(parameters) - set(PARAMETERS)
        if unknown:
            raise GeometryError(
                f"unknown camera parameter {sorted(unknown)}",
                todo=f"known: {', '.join(PARAMETERS)}",
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
        """A copy with some intrinsics changed."""
        intrinsics = self.intrinsics.copy()
        for name, value in parameters.items():
            intrinsics[INDEX[name]] = value
        return replace(self, intrinsics=intrinsics)

    @property
    def rig_from_camera(self) -> Pose:
        return self.camera_from_rig.inverse()

    def project(self, points_rig_mm: ArrayLike) -> Array:
        """(..., 3) rig points -> (..., 2) pixels.

        Raises GeometryError for points behind the perspective centre (1 + kappa Z <= 0).
        """
        points = self.camera_from_rig.apply(np.atleast_2d(points_rig_mm))
        if np.any(1 + self["kappa_per_mm"] * points[..., 2] <= 0):
            raise GeometryError(
                f"a point lies behind the perspective centre of camera {self.name!r} "
                f"(z < {-1 / self['kappa_per_mm']:.1f} mm)",
                todo="keep to points in front of the camera",
            )
        uv = projection.pixel_from_camera(points, self.intrinsics, self.rho_mm)
        return uv.reshape(*np.shape(points_rig_mm)[:-1], 2)

    def unproject(self, uv_px: ArrayLike) -> tuple[Array, Array]:
        """(..., 2) pixels -> rays in the rig frame: (..., 3) origins and (..., 3) unit directions.

        Origins lie in the camera's plane Z = 0. Raises GeometryError outside the invertible region.
        """
        ideal = projection.ideal_from_pixel(np.asarray(uv_px, float), self.intrinsics, self.rho_mm)
        zero, one = np.zeros((*ideal.shape[:-1], 1)), np.ones((*ideal.shape[:-1], 1))
        origin = np.concatenate([ideal, zero], -1)
        direction = np.concatenate([self["kappa_per_mm"] * ideal, one], -1)
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        rotation = self.camera_from_rig.rotation
        return (origin - self.camera_from_rig.translation_mm) @ rotation, direction @ rotation

    def twin(self) -> Camera:
        """The mirror twin's camera: mirrored pose, opposite kappa, the same pixels."""
        pose = self.camera_from_rig.twin()
        return replace(
            self.with_parameters(kappa_per_mm=-self["kappa_per_mm"]), camera_from_rig=pose
        )
