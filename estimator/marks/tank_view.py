"""Places in the tank as one camera sees them, perpendicular to its rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.errors import GeometryError
from telerig.rig.camera import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TankView:
    """Lab places (2,) in mm: the coordinates along the travel and across it that one camera sees.

    basis : (2, 3) unit vectors in rig axes, perpendicular to the camera's middle ray. origin : (3,)
    rig mm.
    """

    camera: Camera
    axis_rig: Array
    basis: Array
    origin: Array

    @staticmethod
    def of(camera: Camera, axis_rig: Array) -> TankView:
        """Raises GeometryError for a camera that looks along the travel."""
        width, height = camera.image_size_px
        origin, ray = camera.unproject(np.array([(width - 1) / 2, (height - 1) / 2]))
        along = axis_rig - ray * (axis_rig @ ray)
        if np.linalg.norm(along) < 0.1:
            raise GeometryError(
                f"camera {camera.name!r} looks along the stage's travel, so marks fixed to the "
                "tank do not pass through its image",
                todo="check [stage] axis in rig.toml, or leave out [references]",
            )
        along = along / np.linalg.norm(along)
        return TankView(camera, axis_rig, np.stack([along, np.cross(ray, along)]), origin)

    @property
    def px_per_mm(self) -> float:
        """Scale in the middle of the image."""
        steps = self.origin + 1e-2 * np.concatenate([self.basis, -self.basis])
        uv = self.camera.project(steps)
        return float(np.sqrt(abs(np.linalg.det((uv[:2] - uv[2:]) / 2e-2))))

    @property
    def travel_px_per_mm(self) -> Array:
        """(2,) px that what is fixed to the tank moves per mm of travel, in the image's middle."""
        step_mm = 1e-3
        before, after = (self.origin + s * step_mm * self.axis_rig for s in (1, -1))
        return (self.camera.project(after) - self.camera.project(before)) / (2 * step_mm)

    def lab_mm(self, uv_px: Array, position_mm: float) -> Array:
        """(n, 2) of pixels (n, 2)."""
        if not len(uv_px):
            return np.zeros((0, 2))
        rig = self.camera.unproject(uv_px)[0] - self.origin
        return np.asarray((rig + self.axis_rig * position_mm) @ self.basis.T)

    def pixels(self, lab_mm: Array, position_mm: float) -> Array:
        """(n, 2) px of lab places (n, 2)."""
        if not len(lab_mm):
            return np.zeros((0, 2))
        across = lab_mm - self.basis @ self.axis_rig * position_mm
        return np.asarray(self.camera.project(self.origin + across @ self.basis))

    def in_image(
        self, lab_mm: Array, position_mm: float, margin_px: float = 0.0
    ) -> tuple[list[int], Array]:
        """Which of (n, 2) lab places lie in the image or a margin outside it, and their pixels."""
        width, height = self.camera.image_size_px
        offset = lab_mm - self.basis @ self.axis_rig * position_mm
        reach = 0.6 * np.hypot(width, height) / self.px_per_mm
        near = np.flatnonzero(np.linalg.norm(offset, axis=1) < reach)
        uv = self.pixels(lab_mm[near], position_mm)
        low, high = -margin_px, np.array([width, height]) - 1 + margin_px
        inside = np.all((uv > low) & (uv < high), axis=1)
        return near[inside].tolist(), uv[inside]
