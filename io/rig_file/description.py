"""What `rig.toml` states: the rig before calibration. Lengths mm, directions unit vectors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from telerig.errors import InputError, suggestion
from telerig.io.rig_file.device_description import DeviceDescription
from telerig.rig.target import Polarity, Target
from telerig.rig.windows import Wall

Vector = tuple[float, float, float]

SCHEMA = 1
"""The newest `schema` of rig.toml that is read, and the one that is written."""

CARRIAGE = "carriage"
"""`mounted_on` of an accelerometer that sits on the stage itself; no camera may be called so."""


@dataclass(frozen=True)
class CameraDescription:
    """image_size_px : (width, height). scale_px_per_mm : nominal.

    telecentricity_per_mm : nominal residual perspective kappa; None when the file is silent.
    """

    name: str
    image_size_px: tuple[int, int]
    scale_px_per_mm: float
    telecentricity_per_mm: float | None = None


@dataclass(frozen=True)
class StageDescription:
    """axis : nominal travel direction, up : away from gravity; unit vectors in rig axes.

    scale_sigma : sd of the encoder's relative scale error, 0 if it is exact; None: not stated.
    """

    axis: Vector
    up: Vector
    position_sigma_mm: float = 0.005
    scale_sigma: float | None = None


@dataclass(frozen=True)
class AccelerometerDescription:
    """axes : rows are the sensor's x, y, z as unit vectors in rig axes.

    mounted_on : a camera's name or "carriage". noise_density_ug_sqrt_hz : micro-g per root hertz.
    """

    name: str
    mounted_on: str
    axes: tuple[Vector, Vector, Vector]
    noise_density_ug_sqrt_hz: float
    bias_sigma_m_s2: float = 0.2


@dataclass(frozen=True)
class ReferencesDescription:
    """Dots at unknown places fixed to the tank and seen by the cameras."""

    kind: Literal["dots"] = "dots"
    polarity: Polarity = "black_on_white"
    dot_diameter_mm: float = 1.0


@dataclass(frozen=True)
class WallDescription:
    """Plane glass between a camera and the water, in that camera's frame.

    normal : unit vector pointing away from the camera (z > 0).
    indices : of the medium on the camera's side, the glass, and the medium behind it.
    distance_mm : along the camera's axis from its origin to the wall's near face, negative where
    that lies before the origin; None where nothing but the image's place depends on it (kappa = 0).
    normal_sigma_deg : how well the normal is known, 0 for exactly.
    """

    camera: str
    normal: Vector
    indices: Vector
    thickness_mm: float
    distance_mm: float | None = None
    normal_sigma_deg: float = 0.0

    def wall(self) -> Wall:
        """For `Camera.wall`; without a distance the near face is at the camera's origin."""
        return Wall(
            np.array(self.normal), self.distance_mm or 0.0, self.thickness_mm, self.indices,
            float(np.radians(self.normal_sigma_deg)),
        )  # fmt: skip


@dataclass(frozen=True)
class RigDescription:
    """The whole of `rig.toml`; the first camera's frame is the rig frame.

    second_from_first_rotvec_deg : nominal rotation, decides the mirror twin; None if not given.
    stage, references : None when the file has no such table.
    devices : sensors on serial lines, by name.
    """

    name: str
    cameras: Mapping[str, CameraDescription]
    target: Target
    second_from_first_rotvec_deg: Vector | None = None
    stage: StageDescription | None = None
    accelerometers: Mapping[str, AccelerometerDescription] = field(default_factory=dict)
    references: ReferencesDescription | None = None
    walls: Mapping[str, WallDescription] = field(default_factory=dict)
    devices: Mapping[str, DeviceDescription] = field(default_factory=dict)

    @property
    def first(self) -> str:
        """Name of the first camera, whose frame is the rig frame."""
        return next(iter(self.cameras))

    @property
    def second(self) -> str | None:
        """Name of the second camera; None for a rig of one camera."""
        return next(iter(list(self.cameras)[1:]), None)

    def camera_name(self, camera: str | int) -> str:
        """The camera's name from its name or its index. Raises InputError for an unknown one."""
        names = list(self.cameras)
        if isinstance(camera, int) and 0 <= camera < len(names):
            return names[camera]
        if isinstance(camera, str) and camera in self.cameras:
            return camera
        raise InputError(
            f"no camera {camera!r} in the rig", where="camera", todo=suggestion(str(camera), names)
        )
