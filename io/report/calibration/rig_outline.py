"""The rig and the target's poses as lines in the rig frame, for drawings in two and three axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.calibration.results import CalibrationResults
from telerig.rig.camera import Camera
from telerig.rig.projection import PARAMETERS

Array = NDArray[np.float64]

_BEFORE, _BEHIND = 1.7, 1.2
"""How far a drawn field reaches before and behind the poses, in radii of the poses."""


@dataclass(frozen=True)
class CameraOutline:
    """field_mm : (2, 4, 3) corners of the seen field, near and far; body_mm : (2, 4, 3) a box.

    axis_mm : (2, 3) ends of the optical axis. The body's distance is drawn, not measured.
    """

    name: str
    field_mm: Array
    body_mm: Array
    axis_mm: Array


@dataclass(frozen=True)
class RigOutline:
    """plates_mm : (V, 4, 3) corners of the target in each view; dots_mm : (V, N, 3)."""

    cameras: tuple[CameraOutline, ...]
    view_names: tuple[str, ...]
    plates_mm: Array
    dots_mm: Array


def rig_outline(results: CalibrationResults) -> RigOutline:
    """Everything that the drawings show, in the rig frame (mm)."""
    low, high = results.points_mm[:, :2].min(axis=0), results.points_mm[:, :2].max(axis=0)
    plate = np.array(
        [[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]]
    )
    poses = list(results.views.values())
    plates = np.array([pose.apply(plate) for pose in poses]).reshape(-1, 4, 3)
    dots = np.array([pose.apply(results.points_mm) for pose in poses])
    dots = dots.reshape(len(poses), -1, 3)
    cameras = tuple(_camera_outline(camera, plates.reshape(-1, 3)) for camera in results.cameras)
    return RigOutline(cameras, tuple(results.views), plates, dots)


def common_plane(results: CalibrationResults) -> Array:
    """(2, 3) unit vectors, across and along the first optical axis, of the plane of both axes.

    Across is to the right in the first camera's image where it can be. One camera, or parallel
    axes: the first camera's x and z.
    """
    along = results.cameras[0].camera_from_rig.rotation[2]
    across = results.cameras[-1].camera_from_rig.rotation[2]
    across = across - (across @ along) * along
    if np.linalg.norm(across) < 0.05:
        across = results.cameras[0].camera_from_rig.rotation[0]
    if across @ results.cameras[0].camera_from_rig.rotation[0] < 0:
        across = -across
    return np.array([across / np.linalg.norm(across), along])


def _camera_outline(camera: Camera, points_mm: Array) -> CameraOutline:
    depth = camera.camera_from_rig.apply(points_mm)[:, 2]
    middle = float(depth.mean())
    half_field = 0.5 * min(camera.image_size_px) / camera["scale_px_per_mm"]
    reach = max(float(np.abs(depth - middle).max()), half_field)
    near = _nearest_depth(camera, middle - _BEFORE * reach)
    field = np.array([_section(camera, z) for z in (near, middle + _BEHIND * reach)])
    centre = _on_axis(camera, near)
    face = centre + 0.55 * (field[0] - centre)
    back = camera.camera_from_rig.rotation[2] * 0.7 * half_field
    axis = [_on_axis(camera, near), _on_axis(camera, middle + _BEHIND * reach)]
    return CameraOutline(camera.name, field, np.array([face - back, face]), np.array(axis))


def _nearest_depth(camera: Camera, wanted_mm: float) -> float:
    """``wanted_mm``, but well in front of the centre of perspective if there is one."""
    kappa = camera["kappa_per_mm"]
    return max(wanted_mm, -0.95 / kappa) if kappa > 0 else wanted_mm


def _section(camera: Camera, depth_mm: float) -> Array:
    """(4, 3) where the image's corners look at a depth, distortion and sensor tilt left out."""
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
