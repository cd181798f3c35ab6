"""The records of cameras and poses in the files of a calibration and of a tracked run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from pydantic import Field, PositiveInt, model_validator

from telerig.errors import TelerigError
from telerig.io.results.record import Matrix3, Part, Vector3
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import LENS_PARAMETERS
from telerig.rig.pose import Pose
from telerig.rig.projection import intrinsics_from
from telerig.rig.windows import Wall

_ROUNDED = 1e-6
"""How far rounded digits may take a matrix from being a rotation."""
_WIDEST = 10.0
"""Largest residual perspective times rho_mm: the tangent of the half field angle of a lens."""
_MOST_DISTORTED = 1.0


class PoseRecord(Part):
    """Hold a rigid transformation: a rotation matrix (3, 3) and a translation (3,) in mm.

    rotvec_deg : the same rotation as a rotation vector (3,) in degrees, for a human reader; None
        where the file does not have it. `pose` does not use it.
    """

    rotation: Matrix3
    rotvec_deg: Vector3 | None = None
    translation_mm: Vector3

    @model_validator(mode="after")
    def _is_rotation(self) -> Self:
        r = self.rotation
        if np.abs(r @ r.T - np.eye(3)).max() > _ROUNDED or np.linalg.det(r) < 0:
            raise ValueError("the matrix is not a rotation")
        return self

    @classmethod
    def of_pose(cls, pose: Pose) -> Self:
        """Make the record of a pose."""
        return cls(
            rotation=pose.rotation,
            rotvec_deg=np.degrees(pose.rotvec_rad),
            translation_mm=pose.translation_mm,
        )

    def pose(self) -> Pose:
        """Return the pose that the record holds."""
        return Pose(self.rotation, self.translation_mm)


class CameraRecord(Part):
    """Hold one calibrated camera.

    image_size_px : (width, height) in px.
    rho_mm : half the diagonal of the image in mm, measured in object space at the nominal scale.
    parameters : the value of each intrinsic by name.
    free : the names of the parameters that the calibration estimated.
    standard_deviations : of each free parameter in its own unit; None where it is not known.
    camera_from_rig : the camera's pose in the rig frame.
    """

    image_size_px: tuple[PositiveInt, PositiveInt]
    rho_mm: float = Field(gt=0)
    parameters: dict[str, float]
    free: tuple[str, ...] = ()
    standard_deviations: dict[str, float | None] = Field(default_factory=dict)
    camera_from_rig: PoseRecord

    @model_validator(mode="after")
    def _is_camera(self) -> Self:
        for name in (*self.free, *self.standard_deviations):
            if name not in self.parameters:
                raise ValueError(f"{name[:60]!r} is no parameter of the camera")
        for name in ("scale_px_per_mm", "aspect"):
            if self.parameters.get(name, 1.0) <= 0:
                raise ValueError(f"{name} is {self.parameters[name]:g}, it must be positive")
        perspective = abs(self.parameters.get("kappa_per_mm", 0.0)) * self.rho_mm
        if perspective > _WIDEST:
            raise ValueError(
                f"kappa_per_mm times rho_mm is {perspective:g}, more than any lens has"
            )
        names = [name for name, one in LENS_PARAMETERS.items() if one.term == "radial"]
        radial = sum(self.parameters.get(name, 0.0) for name in names)
        if abs(radial) > _MOST_DISTORTED:
            raise ValueError(
                f"{' + '.join(names)} is {radial:g}, more than any lens has: so many half "
                "diagonals the image's corner would be moved"
            )
        return self

    @classmethod
    def of_camera(cls, camera: Camera, sd: Mapping[str, float] = MappingProxyType({})) -> Self:
        """Make the record of a camera.

        sd : standard deviation of each parameter that was estimated; NaN where it is not known.
        """
        return cls(
            image_size_px=camera.image_size_px,
            rho_mm=camera.rho_mm,
            parameters={p: camera[p] for p in LENS_PARAMETERS},
            free=tuple(sd),
            standard_deviations={n: s if np.isfinite(s) else None for n, s in sd.items()},
            camera_from_rig=PoseRecord.of_pose(camera.camera_from_rig),
        )


def wall_records(cameras: Iterable[Camera]) -> dict[str, dict[str, Any]]:
    """Return the refractive window of each camera that has one."""
    return {c.name: c.wall.as_dict() for c in cameras if c.wall is not None}


def rig_cameras(
    records: Mapping[str, CameraRecord], walls: Mapping[str, Mapping[str, Any]]
) -> tuple[Camera, ...]:
    """Return the cameras with their windows, by name. Raises ValueError for a faulty record."""
    try:
        return tuple(
            Camera(
                name, c.image_size_px, c.rho_mm, intrinsics_from(c.parameters),
                c.camera_from_rig.pose(), Wall.from_dict(walls[name]) if name in walls else None,
            )
            for name, c in records.items()
        )  # fmt: skip
    except (KeyError, TypeError, TelerigError) as error:
        raise ValueError(f"lacks or misstates {error}"[:200]) from error
