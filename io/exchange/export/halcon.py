"""Cameras in HALCON's area-scan models: their parameters, their error, and HALCON's files.

HALCON's documented model (reference manual, chapter Calibration): camera point = pose * world
point in metres; undistorted image coordinates (u, v) = magnification * (x, y) when telecentric,
focus * (x, y) / z when not. Distortion is given from distorted coordinates (U, V) to undistorted
ones, by the polynomial model, with r^2 = U^2 + V^2,

    u = U (1 + K1 r^2 + K2 r^4 + K3 r^6) + P1 (r^2 + 2 U^2) + 2 P2 U V      (v likewise),

or by the division model, which is exported for lenses without distortion only (its kappa is 0).
The tilt of the sensor behind an image-side telecentric lens is the inverse of the upper left 2 x 2
block of a rotation by ``tilt`` about the axis at ``rot`` in the image (Steger, IJCV 123:121, 2017);
column = U / Sx + Cx, row = V / Sy + Cy.

telerig's distortion runs from undistorted to distorted coordinates, so HALCON's is fitted;
everything else maps exactly, but for the residual perspective of a lens that is exported as
telecentric and `image_convergence_per_mm`.

The `.dat` layouts are those of the reference manual (read_cam_par, write_pose). Before HALCON 13 a
telecentric camera is one with Focus 0 and Sx, Sy the pixel's size in the object; here the
magnification is 1, so that the numbers are the same in both conventions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.errors import GeometryError
from telerig.io.exchange.export.volume import (
    Misfit,
    Volume,
    refuse_unknown_parameters,
    seen_points,
    working_volume,
)
from telerig.io.files.atomic import atomic_folder
from telerig.io.files.names import check_name
from telerig.rig import projection
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import COEFFICIENTS
from telerig.rig.pose import Pose
from telerig.rig.projection import (
    coefficient_jacobian,
    distortion_jacobian,
    undistort,
)

PERSPECTIVE_PX = 0.5
"""The largest error (px) that exporting a lens as telecentric may cause in the volume.

A lens whose residual perspective moves a point by more is exported as perspective.
"""

_POINTS_PER_EDGE = 25
_PIXELS_PER_EDGE = 41
_DIAGONAL = 1e-13
_POLYNOMIAL = {"k1": ("k1", 2), "k2": ("k2", 4), "k3": ("k3", 6), "p1": ("p2", 1), "p2": ("p1", 1)}
"""For each of telerig's distortion coefficients that HALCON has: its name in HALCON, where p1 and
p2 are exchanged, and the power of length in HALCON's unit of it."""


@dataclass(frozen=True)
class HalconCamera:
    """Hold one camera's parameters in HALCON's names, order and units (m, px, degrees).

    kind : HALCON's camera type.
    camera_from_rig : pose of the camera, here in mm.
    misfit : difference of the pixels from those of telerig's camera, over the working volume.
    notes : what was fitted or left out.
    """

    camera: str
    kind: str
    parameters: dict[str, float]
    camera_from_rig: Pose
    misfit: Misfit
    notes: tuple[str, ...]

    def project(self, points_mm: ArrayLike) -> Array:
        """Project rig points (..., 3) in mm to (column, row) (..., 2) in px by HALCON's model.

        Raises GeometryError where HALCON's distortion has no inverse.
        """
        points = self.camera_from_rig.apply(np.atleast_2d(points_mm)) * 1e-3
        return _pixel_from_camera(points, self.parameters).reshape(*np.shape(points_mm)[:-1], 2)


def export_halcon(
    cameras: Sequence[Camera], out: Path, volume: Volume, *, remarks: Sequence[str] = ()
) -> list[str]:
    """Write the HALCON files of all cameras into the folder ``out``.

    Returns one line of text per camera. Raises InputError as `halcon_cameras` does.
    """
    exported = halcon_cameras(cameras, volume)
    write_halcon(exported, out, remarks)
    return [
        f"{c.camera}: {c.kind}; {'; '.join(c.notes) or 'exact'}; {c.misfit.words()}"
        for c in exported
    ]


def halcon_cameras(
    cameras: Sequence[Camera], volume: Volume | None = None
) -> tuple[HalconCamera, ...]:
    """Convert every camera to HALCON's model.

    A camera becomes a telecentric one, unless this moves points of the volume by more than
    `PERSPECTIVE_PX` in the image.

    volume : where HALCON's model is compared with telerig's; None takes `working_volume`.
    Raises InputError if the cameras do not see the volume, and for an unknown lens parameter.
    """
    refuse_unknown_parameters(cameras, "HALCON")
    points = seen_points(cameras, volume or working_volume(cameras), _POINTS_PER_EDGE)
    return tuple(_halcon_camera(camera, points) for camera in cameras)


def _halcon_camera(camera: Camera, points: Array) -> HalconCamera:
    from scipy.linalg import polar

    moved = camera.project(points) - camera.with_parameters(kappa_per_mm=0.0).project(points)
    largest_px = np.linalg.norm(moved, axis=-1).max()
    perspective = bool(camera["kappa_per_mm"] > 0 and largest_px > PERSPECTIVE_PX)
    kappa = camera["kappa_per_mm"]
    linear = _linear_map(camera)
    if max(abs(linear[0, 1]), abs(linear[1, 0])) <= _DIAGONAL * camera["scale_px_per_mm"]:
        rotation, stretch = np.eye(2), np.diag(np.diag(linear))
    else:
        rotation, stretch = polar(linear, side="left")
    distorted = any(camera[name] != 0 for name in COEFFICIENTS)
    values = {"focus": 1e-3 / kappa} if perspective else {"magnification": 1.0}
    values |= _fitted_distortion(camera, stretch, rotation) if distorted else {"kappa": 0.0}
    values |= _sensor(camera, stretch)
    spin = np.eye(3)
    spin[:2, :2] = rotation
    pose = Pose(spin, np.array([0, 0, 1 / kappa if perspective else 0.0])) @ camera.camera_from_rig
    words = ["area_scan"]
    if "tilt" in values:
        words += ["tilt", "image_side_telecentric" if perspective else "bilateral_telecentric"]
    elif not perspective:
        words.append("telecentric")
    kind = "_".join([*words, "polynomial" if distorted else "division"])
    notes = []
    if camera.wall is not None:
        notes.append("the refractive window is left out, because HALCON's models have none")
    if distorted:
        notes.append(
            "the distortion is approximated by a fit, because HALCON's model goes the other way, "
            "from distorted to undistorted pixels"
        )
    if camera["kappa_per_mm"] != 0 and not perspective:
        notes.append(
            "the residual perspective (relative change of scale with depth), kappa_per_mm = "
            f"{camera['kappa_per_mm']:.4g}, is left out, because HALCON's telecentric model has no "
            "such parameter"
        )
    if camera["image_convergence_per_mm"] != 0 and (camera["tilt_x"] or camera["tilt_y"]):
        notes.append("image_convergence_per_mm of the tilted sensor is left out")
    made = HalconCamera(camera.name, kind, values, pose, Misfit(0, 0, 0), tuple(notes))
    return replace(made, misfit=Misfit.between(made.project(points), camera.project(points)))


def _linear_map(camera: Camera) -> Array:
    """Return the map (2, 2) in px per mm, from distorted telecentric coordinates to pixels."""
    affine = camera["scale_px_per_mm"] * np.array([[1, camera["skew"]], [0, camera["aspect"]]])
    q = np.array([camera["tilt_x"], camera["tilt_y"]])
    return np.asarray(affine @ (np.eye(2) + np.outer(q, q) / (1 + np.sqrt(1 + q @ q))))


def _sensor(camera: Camera, stretch: Array) -> dict[str, float]:
    """Return tilt and rot where the sensor is tilted; sx, sy, cx, cy and the image's size."""
    width, height = camera.image_size_px
    values: dict[str, float] = {}
    px_per_mm = np.diag(stretch)
    if stretch[0, 1] != 0:
        lengths, axes = np.linalg.eigh(stretch)
        sine = np.sqrt((lengths[1] - lengths[0]) * (lengths[1] + lengths[0]))
        values["tilt"] = float(np.degrees(np.arctan2(sine, lengths[0])))
        values["rot"] = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])) % 180)
        px_per_mm = lengths[[0, 0]]
    return values | {
        "sx": 1e-3 / float(px_per_mm[0]),
        "sy": 1e-3 / float(px_per_mm[1]),
        "cx": camera["centre_u_px"],
        "cy": camera["centre_v_px"],
        "image_width": width,
        "image_height": height,
    }


def _fitted_distortion(camera: Camera, stretch: Array, rotation: Array) -> dict[str, float]:
    """Return the distortion, fitted over the image in HALCON's direction, where it is linear."""
    width, height = camera.image_size_px
    edges = [np.linspace(0, size - 1, _PIXELS_PER_EDGE) for size in (width, height)]
    uv = np.stack(np.meshgrid(*edges), -1).reshape(-1, 2)
    rho = camera.rho_mm
    centre = np.array([camera["centre_u_px"], camera["centre_v_px"]])
    distorted = np.linalg.solve(stretch, (uv - centre).T).T / rho
    undistorted = projection.ideal_from_pixel(uv, camera.intrinsics, rho) @ rotation.T / rho
    design = coefficient_jacobian(distorted, _places()).reshape(uv.size, -1)
    found = np.linalg.lstsq(design, (undistorted - distorted).reshape(-1), rcond=None)[0]
    in_metres = {
        name: float(value) / (rho * 1e-3) ** power
        for value, (name, power) in zip(found, _POLYNOMIAL.values())
    }
    return {name: in_metres[name] for name in ("k1", "k2", "k3", "p1", "p2")}


def _places() -> list[int]:
    """Return the index in `COEFFICIENTS` of each coefficient of `_POLYNOMIAL`."""
    return [COEFFICIENTS.index(name) for name in _POLYNOMIAL]


def _pixel_from_camera(points_m: Array, values: dict[str, float]) -> Array:
    lens = values["focus"] / points_m[..., 2:] if "focus" in values else values["magnification"]
    distorted = _distorted(points_m[..., :2] * lens, values)
    if "tilt" in values:
        angle = np.radians(values["rot"])
        axis = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-axis[1], axis[0]])
        cosine = np.cos(np.radians(values["tilt"]))
        distorted = distorted @ (np.outer(axis, axis) + np.outer(across, across) / cosine)
    pixel = distorted / [values["sx"], values["sy"]]
    return np.asarray(pixel + [values["cx"], values["cy"]])


def _distorted(undistorted_m: Array, values: dict[str, float]) -> Array:
    """Return the inverse of HALCON's distortion. Raises GeometryError where there is none."""
    if "kappa" in values:
        return undistorted_m
    coefficients = np.zeros(len(COEFFICIENTS))
    coefficients[_places()] = [values[name] for name, _ in _POLYNOMIAL.values()]
    failure = GeometryError(
        "HALCON's distortion has no inverse at some of these points",
        todo="keep to a smaller volume, or export to OpenCV, which has telerig's distortion",
    )
    try:
        distorted = undistort(undistorted_m, coefficients)
    except GeometryError as error:
        raise failure from error
    from_centre = np.multiply.outer(np.linspace(0, 1, 17), distorted)
    if np.any(np.linalg.det(distortion_jacobian(from_centre, coefficients)) <= 0):
        raise failure  # a solution beyond a fold of the polynomial
    return distorted


_DAT = {
    "focus": ("Focus:foc", "DOUBLE:0.0:", "Focal length of the lens [meter]"),
    "kappa": ("Kappa:kappa", "DOUBLE::", "Radial distortion coefficient [1/(meter*meter)]"),
    **{
        name: (f"Poly{i}:poly{i}", "DOUBLE::", f"{nth} polynomial distortion coefficient")
        for i, name, nth in zip(
            range(1, 6), ("k1", "k2", "k3", "p1", "p2"), ("1st", "2nd", "3rd", "4th", "5th")
        )
    },
    "sx": ("Sx:sx", "DOUBLE:0.0:", "Width of a cell on the sensor [meter]"),
    "sy": ("Sy:sy", "DOUBLE:0.0:", "Height of a cell on the sensor [meter]"),
    "cx": ("Cx:cx", "DOUBLE::", "X-coordinate of the image center [pixel]"),
    "cy": ("Cy:cy", "DOUBLE::", "Y-coordinate of the image center [pixel]"),
    "image_width": ("ImageWidth:imgw", "INT:1:32767", "Width of the images [pixel]"),
    "image_height": ("ImageHeight:imgh", "INT:1:32767", "Height of the images [pixel]"),
}


def write_halcon(
    cameras: Sequence[HalconCamera], folder: str | PathLike[str], remarks: Sequence[str] = ()
) -> list[str]:
    """Write cameras.hdev.txt, and <camera>.dat and <camera>_pose.dat for each camera.

    A camera with a tilted sensor gets no `.dat` file, because the layout of such a file is not
    documented. remarks : sentences that are written as comments.
    Returns the names of the files.
    """
    names = []
    for camera in cameras:
        check_name(camera.camera, str(folder), "camera")
    with atomic_folder(folder) as place:
        for camera in cameras:
            if "tilt" not in camera.parameters:
                names.append(_write(place / f"{camera.camera}.dat", _parameters_text(camera)))
            names.append(_write(place / f"{camera.camera}_pose.dat", _pose_text(camera)))
        names.append(_write(place / "cameras.hdev.txt", hdevelop_lines(cameras, remarks)))
    for camera in cameras:
        if f"{camera.camera}.dat" not in names:  # of an earlier export
            (Path(folder) / f"{camera.camera}.dat").unlink(missing_ok=True)
    return names


def hdevelop_lines(cameras: Sequence[HalconCamera], remarks: Sequence[str] = ()) -> str:
    """Return lines of HDevelop code that assign CamParam<i> and Pose<i> for each camera.

    remarks : sentences that come first, as comments.
    """
    lines = [
        *(f"* {remark}" for remark in remarks),
        "* World: telerig's rig frame, the first camera's.",
        "* Pixels: the centre of the top-left pixel is (0, 0).",
        "* CamParam: camera type, then its parameters in HALCON's order (m, px, degrees).",
        "* Pose: the world relative to the camera (camera point = Pose * world point), m, degrees.",
    ]
    for i, camera in enumerate(cameras, 1):
        error = "; ".join(camera.notes) or "exact"
        values = ", ".join(_number(v) for v in camera.parameters.values())
        pose = ", ".join(repr(float(v)) for v in pose_tuple(camera.camera_from_rig))
        lines += [
            "",
            f"* {camera.camera}: {error}",
            f"* error against telerig over the working volume: {camera.misfit.words()}",
            f"CamParam{i} := ['{camera.kind}', {values}]",
            f"Pose{i} := [{pose}, 0]",
        ]
    return "\n".join(lines) + "\n"


def pose_tuple(pose: Pose) -> Array:
    """Return a pose in HALCON's form of type 0, as (6,): translation in m, then angles in degrees.

    The rotation matrix is Rx Ry Rz.
    """
    r = pose.rotation
    beta = np.arctan2(r[0, 2], np.hypot(r[1, 2], r[2, 2]))
    alpha = np.arctan2(-r[1, 2], r[2, 2]) if np.hypot(r[1, 2], r[2, 2]) > 1e-9 else 0.0
    c, s = np.cos(alpha), np.sin(alpha)
    second = c * r[1] + s * r[2]
    gamma = np.arctan2(second[0], second[1])
    return np.concatenate([pose.translation_mm * 1e-3, np.degrees([alpha, beta, gamma]) % 360])


def _parameters_text(camera: HalconCamera) -> str:
    values = dict(camera.parameters)
    if "magnification" in values:
        values = {"focus": 0.0} | {k: v for k, v in values.items() if k != "magnification"}
    lines = [
        f"# {camera.camera}: {camera.kind}, magnification 1, Sx and Sy in the object",
        *(f"# {note}" for note in camera.notes),
        f"# error against telerig over the working volume: {camera.misfit.words()}",
        "# INTERNAL CAMERA PARAMETERS",
        "",
        "ParGroup: Camera: Parameter;",
        '  "Internal camera parameters";',
    ]
    for name, value in values.items():
        head, kind, words = _DAT[name]
        lines += ["", f"{head}: {_number(value)};", f"  {kind};", f'  "{words}";']
    return "\n".join(lines) + "\n"


def _pose_text(camera: HalconCamera) -> str:
    x, y, z, alpha, beta, gamma = (repr(float(v)) for v in pose_tuple(camera.camera_from_rig))
    return (
        f"# {camera.camera}: the rig frame relative to the camera\n"
        "# 3D POSE PARAMETERS: rotation and translation\n\n"
        "# Used representation type:\nf 0\n\n"
        f"# Rotation angles [deg] or Rodriguez vector:\nr {alpha} {beta} {gamma}\n\n"
        f"# Translation vector (x y z [m]):\nt {x} {y} {z}\n"
    )


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else repr(float(value))


def _write(path: Path, text: str) -> str:
    path.write_text(text, encoding="utf-8")
    return path.name
