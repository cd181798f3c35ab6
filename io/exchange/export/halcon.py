"""Cameras in HALCON's area-scan models: parameters, projection, and the error of the exchange.

HALCON's documented model (reference manual, chapter Calibration): camera point = pose * world
point in metres; undistorted image coordinates (u, v) = magnification * (x, y) when telecentric,
focus * (x, y) / z when not; distortion given from distorted to undistorted, by the division model

    u = U / (1 + kappa (U^2 + V^2))

or the polynomial one, r^2 = U^2 + V^2,

    u = U (1 + K1 r^2 + K2 r^4 + K3 r^6) + P1 (r^2 + 2 U^2) + 2 P2 U V      (v likewise);

the tilt of the sensor behind an image-side telecentric lens, the inverse of the upper left 2 x 2
block of a rotation by ``tilt`` about the axis at ``rot`` in the image (Steger, IJCV 123:121, 2017);
column = U / Sx + Cx, row = V / Sy + Cy.

Distortion runs the other way in this library, so it is fitted; everything else maps exactly, but
for the residual perspective of a lens exported as telecentric and `image_convergence_per_mm`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.errors import GeometryError, InputError
from telerig.io.exchange.export.volume import Misfit, Volume, seen_points, working_volume
from telerig.rig import projection
from telerig.rig.camera import Camera
from telerig.rig.distortion import COEFFICIENTS
from telerig.rig.pose import Pose

Array = NDArray[np.float64]
Distortion = Literal["auto", "division", "polynomial"]
Lens = Literal["auto", "telecentric", "perspective"]

PERSPECTIVE_PX = 0.5
"""A lens whose residual perspective moves a point of the volume by more is exported as such."""

_POINTS_PER_EDGE = 25
_PIXELS_PER_EDGE = 41
_SQUARE = 1e-13
_NO_INVERSE = "HALCON's distortion has no inverse at some of these points"
_USE_OPENCV = "keep to a smaller volume, or export to OpenCV, which has telerig's distortion"


@dataclass(frozen=True)
class HalconCamera:
    """Parameters in HALCON's names and units (m, px, degrees), in HALCON's order.

    kind : HALCON's camera type. camera_from_rig : HALCON's external parameters, mm here.
    misfit : against the camera of this library over the working volume.
    exact : whether nothing was fitted or left out.
    """

    camera: str
    kind: str
    parameters: dict[str, float]
    camera_from_rig: Pose
    misfit: Misfit
    exact: bool
    notes: tuple[str, ...]

    def project(self, points_mm: ArrayLike) -> Array:
        """(..., 3) rig points -> (..., 2) pixels (column, row) by HALCON's model."""
        points = self.camera_from_rig.apply(np.atleast_2d(points_mm)) * 1e-3
        return _pixel_from_camera(points, self.parameters).reshape(*np.shape(points_mm)[:-1], 2)


def halcon_cameras(
    cameras: Sequence[Camera],
    *,
    distortion: Distortion = "auto",
    lens: Lens = "auto",
    volume: Volume | None = None,
) -> tuple[HalconCamera, ...]:
    """Every camera in HALCON's model.

    distortion : "auto" takes the division model with kappa 0 where there is none, else the
    polynomial one. lens : "auto" is telecentric unless that moves points of the volume by more
    than `PERSPECTIVE_PX`. volume : None takes `working_volume`.
    Raises InputError when the cameras do not see the volume, and for lens="perspective" with a
    kappa that is not positive.
    """
    points = seen_points(cameras, volume or working_volume(cameras), _POINTS_PER_EDGE)
    return tuple(_halcon_camera(c, points, distortion, lens) for c in cameras)


def _halcon_camera(
    camera: Camera, points: Array, distortion: Distortion, lens: Lens
) -> HalconCamera:
    perspective = _is_perspective(camera, points, lens)
    kappa = camera["kappa_per_mm"]
    stretch, turn = _stretch_and_turn(camera)
    sensor, tilted = _sensor(camera, stretch)
    bent = any(camera[name] != 0 for name in COEFFICIENTS)
    model = ("polynomial" if bent else "division") if distortion == "auto" else distortion
    values = {"focus": 1 / kappa} if perspective else {"magnification": 1.0}
    values |= _fitted_distortion(camera, stretch, turn, model) if bent else _no_distortion(model)
    values |= sensor
    kind = "_".join(["area_scan", *_lens_words(perspective, tilted), model])
    spin = np.eye(3)
    spin[:2, :2] = turn
    pose = Pose(spin, np.array([0, 0, 1 / kappa if perspective else 0.0])) @ camera.camera_from_rig
    if perspective:
        values["focus"] *= 1e-3
    raw = HalconCamera(camera.name, kind, values, pose, Misfit(0, 0, 0), False, ())
    misfit = Misfit.between(raw.project(points), camera.project(points))
    notes = _notes(camera, bent, perspective)
    return HalconCamera(camera.name, kind, values, pose, misfit, not notes, notes)


def _is_perspective(camera: Camera, points: Array, lens: Lens) -> bool:
    kappa = camera["kappa_per_mm"]
    if lens == "perspective" and not kappa > 0:
        raise InputError(
            f"its kappa is {kappa:.3g} per mm: HALCON's perspective models need a positive one",
            where=f"camera {camera.name}",
            todo="export it as telecentric",
        )
    if lens != "auto":
        return lens == "perspective"
    moved = camera.project(points) - camera.with_parameters(kappa_per_mm=0.0).project(points)
    return bool(kappa > 0 and np.linalg.norm(moved, axis=-1).max() > PERSPECTIVE_PX)


def _stretch_and_turn(camera: Camera) -> tuple[Array, Array]:
    """(2, 2) symmetric or diagonal px per mm, and a (2, 2) rotation before it; their product is
    the camera's linear map from distorted coordinates."""
    scale = camera["scale_px_per_mm"]
    affine = scale * np.array([[1, camera["skew"]], [0, camera["aspect"]]])
    q = np.array([camera["tilt_x"], camera["tilt_y"]])
    linear = affine @ (np.eye(2) + np.outer(q, q) / (1 + np.sqrt(1 + q @ q)))
    if max(abs(linear[0, 1]), abs(linear[1, 0])) <= _SQUARE * scale:
        return np.diag(np.diag(linear)), np.eye(2)
    u, s, vt = np.linalg.svd(linear)
    return np.asarray((u * s) @ u.T), np.asarray(u @ vt)


def _sensor(camera: Camera, stretch: Array) -> tuple[dict[str, float], bool]:
    """tilt and rot where needed, sx, sy, cx, cy and the image's size; and whether it is tilted."""
    width, height = camera.image_size_px
    values: dict[str, float] = {}
    pixels = np.diag(stretch)
    tilted = stretch[0, 1] != 0
    if tilted:
        lengths, axes = np.linalg.eigh(stretch)
        values["tilt"] = float(np.degrees(np.arctan2(np.sqrt(
            (lengths[1] - lengths[0]) * (lengths[1] + lengths[0])), lengths[0])))  # fmt: skip
        values["rot"] = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])) % 180)
        pixels = lengths[[0, 0]]
    values |= {
        "sx": 1e-3 / float(pixels[0]),
        "sy": 1e-3 / float(pixels[1]),
        "cx": camera["centre_u_px"],
        "cy": camera["centre_v_px"],
        "image_width": width,
        "image_height": height,
    }
    return values, bool(tilted)


def _lens_words(perspective: bool, tilted: bool) -> list[str]:
    if tilted:
        return ["tilt", "image_side_telecentric" if perspective else "bilateral_telecentric"]
    return [] if perspective else ["telecentric"]


def _no_distortion(model: str) -> dict[str, float]:
    names = ("kappa",) if model == "division" else ("k1", "k2", "k3", "p1", "p2")
    return dict.fromkeys(names, 0.0)


def _fitted_distortion(camera: Camera, stretch: Array, turn: Array, model: str) -> dict[str, float]:
    """Least squares over the image, in HALCON's direction, where the models are linear."""
    width, height = camera.image_size_px
    edges = [np.linspace(0, size - 1, _PIXELS_PER_EDGE) for size in (width, height)]
    uv = np.stack(np.meshgrid(*edges), -1).reshape(-1, 2)
    rho = camera.rho_mm
    centre = np.array([camera["centre_u_px"], camera["centre_v_px"]])
    bent = np.linalg.solve(stretch, (uv - centre).T).T / rho
    straight = projection.ideal_from_pixel(uv, camera.intrinsics, rho) @ turn.T / rho
    r2 = np.sum(bent**2, axis=-1, keepdims=True)
    if model == "division":
        design = (straight * r2).reshape(-1, 1)
        (kappa,) = np.linalg.lstsq(design, (bent - straight).reshape(-1), rcond=None)[0]
        return {"kappa": float(kappa) / (rho * 1e-3) ** 2}
    x, y = bent[:, :1], bent[:, 1:]
    design = np.stack(
        [
            bent * r2, bent * r2**2, bent * r2**3,
            np.concatenate([r2 + 2 * x * x, 2 * x * y], -1),
            np.concatenate([2 * x * y, r2 + 2 * y * y], -1),
        ],
        -1,
    ).reshape(-1, 5)  # fmt: skip
    found = np.linalg.lstsq(design, (straight - bent).reshape(-1), rcond=None)[0]
    powers = np.array([2, 4, 6, 1, 1])
    metric = found / (rho * 1e-3) ** powers
    return dict(zip(("k1", "k2", "k3", "p1", "p2"), metric.tolist()))


def _notes(camera: Camera, bent: bool, perspective: bool) -> tuple[str, ...]:
    notes = []
    if camera.wall is not None:
        notes.append("the glass wall left out: HALCON's models have none")
    if bent:
        notes.append("distortion fitted: HALCON's model runs from distorted to undistorted")
    if camera["kappa_per_mm"] != 0 and not perspective:
        notes.append(
            f"residual perspective kappa = {camera['kappa_per_mm']:.4g} per mm left out: a "
            "telecentric model has none"
        )
    if camera["image_convergence_per_mm"] != 0 and (camera["tilt_x"] or camera["tilt_y"]):
        notes.append("image_convergence_per_mm of the tilted sensor left out")
    return tuple(notes)


def _pixel_from_camera(points_m: Array, values: dict[str, float]) -> Array:
    flat = points_m[..., :2]
    flat = flat * values["focus"] / points_m[..., 2:] if "focus" in values else flat
    flat = flat * values.get("magnification", 1.0)
    bent = _distorted(flat, values)
    if "tilt" in values:
        angle = np.radians(values["rot"])
        axis = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-axis[1], axis[0]])
        cosine = np.cos(np.radians(values["tilt"]))
        bent = bent @ (np.outer(axis, axis) + np.outer(across, across) / cosine)
    pixel = bent / [values["sx"], values["sy"]]
    return np.asarray(pixel + [values["cx"], values["cy"]])


def _distorted(straight: Array, values: dict[str, float]) -> Array:
    """The inverse of HALCON's distortion: closed for the division model, else by fixed point.

    Raises GeometryError where there is none.
    """
    if "kappa" in values:
        r2 = np.sum(straight**2, axis=-1, keepdims=True)
        inside = 1 - 4 * values["kappa"] * r2
        if np.any(inside < 0):
            raise GeometryError(_NO_INVERSE, todo=_USE_OPENCV)
        return np.asarray(2 * straight / (1 + np.sqrt(inside)))
    k1, k2, k3, p1, p2 = (values[name] for name in ("k1", "k2", "k3", "p1", "p2"))
    bent, size = straight, float(np.max(np.abs(straight), initial=1e-6))
    step = np.inf
    for _ in range(100):
        x, y = bent[..., :1], bent[..., 1:]
        r2 = x * x + y * y
        shift = bent * (r2 * (k1 + r2 * (k2 + r2 * k3))) + np.concatenate(
            [p1 * (r2 + 2 * x * x) + 2 * p2 * x * y, 2 * p1 * x * y + p2 * (r2 + 2 * y * y)], -1
        )
        last, bent = bent, straight - shift
        step = np.max(np.abs(bent - last), initial=0.0)
        if not step < 1e3 * size:
            break
        if step < 1e-16 * size:
            return np.asarray(bent)
    if step < 1e-12 * size:
        return np.asarray(bent)
    raise GeometryError(_NO_INVERSE, todo=_USE_OPENCV)
