"""Where the cameras, what they see and all poses of the target are, for pictures of a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from telerig.arrays import Array
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import PARAMETERS
from telerig.rig.pose import Pose

_BEFORE, _BEHIND = 1.7, 1.2
"""How far a drawn field reaches before and behind the poses, in radii of the poses."""


@dataclass(frozen=True)
class CameraOutline:
    """Corners (2, 4, 3) of the seen field and of a box, and ends (2, 3) of the optical axis, in mm.

    The body's distance is drawn, not measured.
    """

    name: str
    field_mm: Array
    body_mm: Array
    axis_mm: Array


@dataclass(frozen=True)
class RigOutline:
    """plates_mm : (V, 4, 3) corners of the target in each view; dots_mm : (V, N, 3)."""

    cameras: tuple[CameraOutline, ...]
    plates_mm: Array
    dots_mm: Array


def rig_outline(
    cameras: Sequence[Camera], poses: Mapping[str, Pose], points_mm: Array
) -> RigOutline:
    """Return everything that the drawings show, in the rig frame (mm).

    poses : rig_from_target by view. points_mm : (N, 3) dots in the target's frame.
    """
    plate = plate_corners(points_mm)
    every = list(poses.values())
    plates = np.array([pose.apply(plate) for pose in every]).reshape(-1, 4, 3)
    dots = np.array([pose.apply(points_mm) for pose in every]).reshape(len(every), -1, 3)
    outlines = tuple(camera_outline(camera, plates.reshape(-1, 3)) for camera in cameras)
    return RigOutline(outlines, plates, dots)


def plate_corners(points_mm: Array, margin: float = 0.0) -> Array:
    """Return corners (4, 3) of the rectangle round dots (N, 3) of a target, widened by a share."""
    low, high = points_mm[:, :2].min(axis=0), points_mm[:, :2].max(axis=0)
    wider = margin * float((high - low).max())
    (x0, y0), (x1, y1) = low - wider, high + wider
    return np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])


def common_plane(cameras: Sequence[Camera]) -> Array:
    """Return unit vectors (2, 3), across and along the first axis, of the plane of both axes.

    Across points to the first camera's right, or down where the axes lie one above the other. For
    one camera or parallel axes they are the first camera's x and z.
    """
    right, down, along = cameras[0].camera_from_rig.rotation
    across = cameras[-1].camera_from_rig.rotation[2]
    across = across - (across @ along) * along
    if np.linalg.norm(across) < 0.05:
        across = right
    if across @ max(right, down, key=lambda side: abs(across @ side)) < 0:
        across = -across
    return np.array([across / np.linalg.norm(across), along])


def camera_outline(camera: Camera, points_mm: Array) -> CameraOutline:
    """Return what is drawn of a camera that sees points (N, 3) in the rig frame (mm)."""
    depth = camera.camera_from_rig.apply(points_mm)[:, 2]
    middle = float(depth.mean())
    half_field = 0.5 * min(camera.image_size_px) / camera["scale_px_per_mm"]
    reach = max(float(np.abs(depth - middle).max()), half_field)
    # The near end stays well in front of the centre of perspective, if there is one.
    wanted_mm = middle - _BEFORE * reach
    kappa = camera["kappa_per_mm"]
    near = max(wanted_mm, -0.95 / kappa) if kappa > 0 else wanted_mm
    field = np.array([_section(camera, z) for z in (near, middle + _BEHIND * reach)])
    centre = _on_axis(camera, near)
    face = centre + 0.55 * (field[0] - centre)
    back = camera.camera_from_rig.rotation[2] * 0.7 * half_field
    axis = [_on_axis(camera, near), _on_axis(camera, middle + _BEHIND * reach)]
    return CameraOutline(camera.name, field, np.array([face - back, face]), np.array(axis))


def _section(camera: Camera, depth_mm: float) -> Array:
    """Return points (4, 3) that the image's corners see at a depth, without distortion and tilt."""
    bent = PARAMETERS[PARAMETERS.index("k1") :]
    width, height = camera.image_size_px
    u, v = width - 0.5, height - 0.5
    corners = [[-0.5, -0.5], [u, -0.5], [u, v], [-0.5, v]]
    origin, direction = camera.with_parameters(**dict.fromkeys(bent, 0.0)).unproject(corners)
    return np.asarray(origin + direction * (depth_mm / (direction @ _axis(camera)))[:, None])


def _axis(camera: Camera) -> Array:
    return np.asarray(camera.camera_from_rig.rotation[2])


def _on_axis(camera: Camera, depth_mm: float) -> Array:
    return np.asarray(camera.rig_from_camera.translation_mm + depth_mm * _axis(camera))
