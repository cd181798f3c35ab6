"""OpenPTV's `.ori` and `.addpar` files as cameras of this library.

OpenPTV (liboptv: imgcoord, trafo, calibration) has photogrammetric axes (x right, y up, the camera
looks along -z), sensor coordinates in mm, Brown's distortion about the *sensor's* centre after the
principal point (xh, yh) has been added, then scx and she, and pixels counted from the corner of the
top-left one. The import is exact without distortion, and with it where xh = yh = 0; otherwise the
distortion is fitted about the principal point, and a note states the error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.exchange.importing.pinhole import ImportedCameras, Pinhole, cameras_from_pinholes
from telerig.io.files.text import LARGEST_NUMBER, read_text
from telerig.rig import projection
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import COEFFICIENTS
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.projection import distort

WORST_FIT_PX = 0.5
"""A camera whose distortion cannot be fitted better than this is refused."""
LEAST_PIXEL_MM = 1e-6
"""No sensor has smaller pixels; with such a number the focal length in pixels overflows."""

_FREE = ("scale_px_per_mm", "aspect", "skew", "centre_u_px", "centre_v_px",
         "k1", "k2", "k3", "p1", "p2", "s1", "s2", "s3", "s4")  # fmt: skip


@dataclass(frozen=True)
class Sensor:
    """The content of OpenPTV's ptv.par: (width, height) of the image, and of a pixel in mm."""

    image_size_px: tuple[int, int]
    pixel_size_mm: tuple[float, float]


@dataclass(frozen=True)
class _Orientation:
    """position (3,) mm, rotation (3, 3) world_from_camera; distortion k1 k2 k3 p1 p2 scx she."""

    path: Path
    position: Array
    rotation: Array
    principal: Array
    distance: float
    added: Array


def read_openptv_cameras(
    paths: Sequence[str | PathLike[str]],
    sensor: Sensor,
    names: Sequence[str] | None = None,
) -> ImportedCameras:
    """Read the cameras of `.ori` files, with the `.addpar` file beside each.

    sensor : see `read_ptv_par`. names : by default the files' names up to the first point. Raises
    InputError for files that cannot be read and distortion that cannot be fitted within
    `WORST_FIT_PX`.
    """
    files = [_read(Path(p)) for p in paths]
    if not files:
        raise InputError("no .ori files", todo="name at least one")
    labels = [f.path.name.split(".")[0] for f in files] if names is None else list(names)
    cameras, rig_from_world, _ = cameras_from_pinholes([_pinhole(f, sensor) for f in files], labels)
    notes = [
        f"{f.path.name}: there is no .addpar file beside it, so it has no distortion"
        for f in files
        if not f.path.with_suffix(".addpar").is_file()
    ]
    out = []
    for file, camera in zip(files, cameras):
        if np.any(file.added[:5]) and np.any(file.principal):
            camera, note = _fitted(file, camera, sensor)
            notes.append(note)
        out.append(camera)
    first = out[0].camera_from_rig
    in_rig = [
        replace(c, camera_from_rig=c.camera_from_rig @ first.inverse() if i else Pose.identity())
        for i, c in enumerate(out)
    ]
    return ImportedCameras(tuple(in_rig), first @ rig_from_world, tuple(notes))


def read_ptv_par(path: str | PathLike[str]) -> Sensor:
    """Read image and pixel size from OpenPTV's ptv.par.

    Raises InputError when it cannot be read, and for refraction, which a pinhole camera does not
    have.
    """
    file = Path(path)
    lines = read_text(file).split("\n")
    try:
        count = int(lines[0])
        values = [float(line) for line in lines[1 + 2 * count :] if line.strip()]
        width, height, pixel_x, pixel_y = values[3:7]
        interlaced, *indices = values[7:11]
        if len(indices) < 3:
            raise ValueError("the refractive indices are missing")
        if not np.all(np.abs(values) <= LARGEST_NUMBER):
            raise ValueError("a number is not finite or too large")
    except (ValueError, IndexError) as error:
        raise InputError(
            f"is not a ptv.par of OpenPTV ({error})",
            where=str(file),
            todo="give the image size and the pixel size instead",
        ) from error
    if interlaced != 0:
        raise InputError(
            "is of an interlaced camera", where=str(file), todo="give full frames (chfield 0)"
        )
    if max(indices) - min(indices) > 1e-9:
        raise InputError(
            f"has refraction (indices {', '.join(f'{n:g}' for n in indices)})",
            where=str(file),
            todo="calibrate with telerig, with the target in the liquid: a pinhole model cannot "
            "represent the refraction at the glass wall",
        )
    return Sensor((int(width), int(height)), (pixel_x, pixel_y))


def _read(path: Path) -> _Orientation:
    values = _numbers(path, 21)
    omega, phi, kappa = values[3:6]
    turns = [rotation_from_rotvec(angle * axis) for angle, axis in
             zip((omega, phi, kappa), np.eye(3))]  # fmt: skip
    beside = path.with_suffix(".addpar")
    added = _numbers(beside, 7)[:7] if beside.is_file() else np.array([0.0] * 5 + [1.0, 0.0])
    if not values[17] > 0:
        raise InputError(
            f"its principal distance is {values[17]:g} mm", where=str(path), todo="give one > 0"
        )
    return _Orientation(
        path, values[:3], turns[0] @ turns[1] @ turns[2], values[15:17], float(values[17]), added
    )


def _numbers(path: Path, least: int) -> Array:
    try:
        values = np.array([float(word) for word in read_text(path).split()])
    except ValueError as error:
        raise InputError(
            f"holds something that is no number ({error})", where=str(path), todo="export it again"
        ) from error
    if len(values) < least or not (np.abs(values) <= LARGEST_NUMBER).all():
        raise InputError(
            f"holds {len(values)} numbers, {least} are needed",
            where=str(path),
            todo="give an .ori file (its .addpar is found beside it)",
        )
    return values


def _pixel_from_metric(file: _Orientation, sensor: Sensor) -> Array:
    """Return (3, 3) from distorted sensor coordinates in mm, y down, to telerig's pixels."""
    scx, she = file.added[5:]
    (width, height), (pixel_x, pixel_y) = sensor.image_size_px, sensor.pixel_size_mm
    return np.array(
        [
            [scx / pixel_x, np.sin(she) / pixel_x, width / 2 - 0.5],
            [0, np.cos(she) / pixel_y, height / 2 - 0.5],
            [0, 0, 1],
        ]
    )


def _pinhole(file: _Orientation, sensor: Sensor) -> Pinhole:
    if min(sensor.image_size_px) <= 0 or min(sensor.pixel_size_mm) < LEAST_PIXEL_MM:
        raise InputError(
            f"image {sensor.image_size_px} px, pixel {sensor.pixel_size_mm} mm",
            where=str(file.path),
            todo="give the sizes in ptv.par: px, and mm of one pixel, about 0.01",
        )
    (x, y), distance = file.principal, file.distance
    k1, k2, k3, p1, p2 = file.added[:5]
    exact = np.zeros(5) if x or y else np.array(
        [k1 * distance**2, k2 * distance**4, -p2 * distance, p1 * distance, k3 * distance**6]
    )  # fmt: skip
    lens = np.array([[distance, 0, x], [0, distance, -y], [0, 0, 1]])
    rotation = np.diag([1.0, -1.0, -1.0]) @ file.rotation.T
    matrix = _pixel_from_metric(file, sensor) @ lens
    where = str(file.path)
    return Pinhole(where, sensor.image_size_px, matrix, rotation, -rotation @ file.position, exact)


def _fitted(file: _Orientation, camera: Camera, sensor: Sensor) -> tuple[Camera, str]:
    """Return the camera with its distortion fitted over the image, with a turn about its axis."""
    from scipy.optimize import least_squares

    width, height = sensor.image_size_px
    edges = [np.linspace(0, size - 1, 25) for size in (width, height)]
    straight_px = np.stack(np.meshgrid(*edges), -1).reshape(-1, 2)
    points = projection.ideal_from_pixel(straight_px, camera.intrinsics, camera.rho_mm)
    points = np.c_[points, np.zeros(len(points))]
    wanted = _distorted_px(file, straight_px, sensor)
    inside = np.all((wanted > -1) & (wanted < np.array(sensor.image_size_px)), axis=-1)
    points, wanted = points[inside], wanted[inside]

    def fitted(x: Array) -> tuple[Camera, Pose]:
        free = {name: camera[name] + value for name, value in zip(_FREE, x)}
        turn = Pose(rotation_from_rotvec(np.array([0, 0, x[-1]])), np.zeros(3))
        return camera.with_parameters(**free), turn

    def residual_px(x: Array) -> Array:
        changed, turn = fitted(x)
        uv = projection.pixel_from_camera(turn.apply(points), changed.intrinsics, camera.rho_mm)
        return np.asarray((uv - wanted).reshape(-1))

    start = np.zeros(len(_FREE) + 1)
    found = least_squares(residual_px, start, x_scale="jac", xtol=1e-15, ftol=1e-15)
    worst = float(np.linalg.norm(residual_px(found.x).reshape(-1, 2), axis=-1).max())
    if worst > WORST_FIT_PX:
        raise InputError(
            f"its distortion differs by {worst:.2g} px from the nearest that telerig's model has",
            where=str(file.path),
            todo="calibrate with telerig",
        )
    changed, turn = fitted(found.x)
    note = f"{file.path.name}: distortion fitted about the principal point, to {worst:.2g} px"
    return replace(changed, camera_from_rig=turn @ camera.camera_from_rig), note


def _distorted_px(file: _Orientation, straight_px: Array, sensor: Sensor) -> Array:
    """Return OpenPTV's distortion between pixels without and with it."""
    matrix = _pixel_from_metric(file, sensor)
    flat = np.linalg.solve(matrix[:2, :2], (straight_px - matrix[:2, 2]).T).T
    k1, k2, k3, p1, p2 = file.added[:5]
    given = {"k1": k1, "k2": k2, "k3": k3, "p1": p2, "p2": p1}
    coefficients = np.array([given.get(name, 0.0) for name in COEFFICIENTS])
    distorted = distort(flat * [1, -1], coefficients)
    return distorted * [1, -1] @ matrix[:2, :2].T + matrix[:2, 2]
