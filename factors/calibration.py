"""Defines the factors of a self-calibration: images of dots, known distance, depth gauge, weak
priors.

Each is a pure function that returns whitened residuals and their derivatives. All solvers use
`image_columns`, which computes those of all dots that one camera measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Ints
from telerig.rig import projection
from telerig.rig.lens_parameters import PARAMETERS
from telerig.rig.pose import hat
from telerig.rig.windows import Wall


@dataclass(frozen=True)
class State:
    """Holds all quantities that a calibration estimates, for C cameras, V views and N dots.

    intrinsics : (C, 20) in the order of `telerig.rig.lens_parameters.PARAMETERS`.
    rig_from_camera : (C, 4, 4); the first is the identity.
    rig_from_target : (V, 4, 4).
    dots_mm : (N, 3) in the target frame.
    """

    intrinsics: Array
    rig_from_camera: Array
    rig_from_target: Array
    dots_mm: Array


@dataclass(frozen=True)
class Observations:
    """Holds M dots measured in images by C cameras in V views, sorted by image (view, camera).

    view, camera, dot : (M,) indices of each measurement.
    uv_px : (M, 2).
    whitener : (M, 2, 2) matrices W with W^T W = inverse covariance, multiplied by the square root
        of the measurement's weight.
    plate_shift : (V, C) +1 or -1 if the camera sees the dots through the plate of the target, and 0
        otherwise.
    plate : thickness (mm) and refractive index of the plate.
    walls : for each camera the window through which it sees the dots, or None; () if all dots are
        in air.
    """

    view: Ints
    camera: Ints
    dot: Ints
    uv_px: Array
    whitener: Array
    plate_shift: Array
    plate: tuple[float, float] = (0.0, 1.5)
    walls: tuple[Wall | None, ...] = ()

    def subset(self, rows: Ints | NDArray[np.bool_] | slice) -> Observations:
        """Return only the measurements in ``rows``."""
        parts = {n: getattr(self, n)[rows] for n in ("view", "camera", "dot", "uv_px", "whitener")}
        return replace(self, **parts)

    def wall(self, camera: int) -> Wall | None:
        """Return the window before a camera, by the camera's index; None for none."""
        return self.walls[camera] if self.walls else None

    def __len__(self) -> int:
        return len(self.view)


def apparent_shift_mm(cosine: Array, thickness_mm: float, index: float) -> tuple[Array, Array]:
    """Return how much nearer a dot appears through a parallel plate, along the plate's normal.

    By Snell's law, a telecentric camera whose rays make an angle with the normal sees the shift d
    (1 - tan(angle in the plate) / tan(angle in air)), with d the thickness.

    cosine : cosine of the angle in air.

    Returns the shift in mm and its derivative with respect to ``cosine``, both of the shape of
    ``cosine``.
    """
    root2 = index**2 - 1 + cosine**2
    shift = thickness_mm * (1 - cosine / np.sqrt(root2))
    return shift, -thickness_mm * (index**2 - 1) / root2**1.5


@dataclass(frozen=True)
class _Placed:
    """Holds the positions of M dots that one camera sees. Components come first, so that each is
    contiguous.

    rotation : (3, 3, M) camera from target.
    target : (3, M) coordinates in the target frame, with the shift of the plate through which the
        dots are seen.
    camera : (3, M) coordinates in the camera frame.
    """

    rotation: Array
    target: Array
    camera: Array


def _placed(state: State, obs: Observations, camera: int) -> _Placed:
    view, rig_from_camera = state.rig_from_target, state.rig_from_camera[camera]
    camera_from_rig = rig_from_camera[:3, :3].T
    pose = np.empty((3, 4, len(view)))
    pose[:, :3] = np.moveaxis(camera_from_rig @ view[:, :3, :3], 0, -1)
    pose[:, 3] = camera_from_rig @ (view[:, :3, 3] - rig_from_camera[:3, 3]).T
    target = np.take(state.dots_mm.T, obs.dot, axis=1)
    if np.any(obs.plate_shift):
        shift, _ = apparent_shift_mm(np.abs(pose[2, 2]), *obs.plate)
        target[2] += (obs.plate_shift[:, camera] * shift)[obs.view]
    pose = np.take(pose, obs.view, axis=2)
    x, y, z = target
    return _Placed(
        pose[:, :3], target, pose[:, 0] * x + pose[:, 1] * y + pose[:, 2] * z + pose[:, 3]
    )


def whitened_error(state: State, obs: Observations, rho_mm: Sequence[float]) -> Array:
    """Return the whitened residuals (M, 2), predicted minus measured, without derivatives."""
    residual = pixels(state, obs, rho_mm) - obs.uv_px
    return np.asarray(np.einsum("mij,mj->mi", obs.whitener, residual))


def pixels(state: State, obs: Observations, rho_mm: Sequence[float]) -> Array:
    """Return the predicted pixels (M, 2).

    rho_mm : for each camera the length that normalises the distortion, see `Camera`.
    """
    out = np.empty((len(obs), 2))
    for c, rho in enumerate(rho_mm):
        mine = obs.camera == c
        out[mine] = _pixels(state, obs.subset(mine), c, rho)
    return out


def _pixels(state: State, obs: Observations, camera: int, rho_mm: float) -> Array:
    points = _placed(state, obs, camera).camera.T
    return projection.pixel_from_camera(points, state.intrinsics[camera], rho_mm, obs.wall(camera))


def image_columns(
    state: State, obs: Observations, camera: int, rho_mm: float, free: Sequence[int]
) -> Array:
    """Return the whitened residuals of one camera's M dots, and their derivatives: the image
    factor.

    obs : measurements of this camera only.
    free : indices into `PARAMETERS` of the F intrinsics for which derivatives are wanted.

    Returns columns (F + 13, 2, M), or (F + 7, 2, M) for the first camera, because its frame is the
    rig frame and its pose is fixed. The columns are the derivatives with respect to the F
    intrinsics, to rig_from_camera (6, left out for the first camera) and to rig_from_target (6),
    and then the residual, predicted minus measured. Poses use GTSAM's Pose3 tangent (rotation,
    translation; right perturbation). The derivative with respect to a dot equals that with respect
    to the target's translation; see `dot_columns`.
    """
    at, count = _placed(state, obs, camera), len(free)
    uv, by_point, by_free = projection.pixel_jacobians(
        at.camera.T, state.intrinsics[camera], rho_mm, obs.wall(camera), free
    )
    out = np.empty((count + (13 if camera else 7), 2, len(obs)))
    residual = (uv - obs.uv_px).T
    white = obs.whitener.transpose(1, 2, 0)
    of_lens, of_camera, of_view = out[:count], out[count:-7], out[-7:-1]
    of_point = np.empty((3, 2, len(obs)))
    for result, plain in (
        (of_lens, by_free.transpose(2, 1, 0)),
        (of_point, by_point.transpose(2, 1, 0)),
        (out[-1:], residual[None]),
    ):
        for row in range(2):
            np.multiply(plain[:, 0], white[row, 0], out=result[:, row])
            result[:, row] += plain[:, 1] * white[row, 1]
    if camera:
        np.negative(of_point, out=of_camera[3:])
        _cross(of_point, at.camera, of_camera[:3])
    by_dot = of_view[3:]
    for j in range(3):
        np.multiply(of_point[0], at.rotation[0, j], out=by_dot[j])
        for i in (1, 2):
            by_dot[j] += of_point[i] * at.rotation[i, j]
    _cross(at.target, by_dot, of_view[:3])
    if np.any(obs.plate_shift[:, camera]):
        _add_plate_slopes(of_view, of_camera, at.rotation, obs, camera)
    return out


def dot_columns(columns: Array) -> Array:
    """Return the derivatives (3, 2, M) with respect to each dot's position, from
    `image_columns`."""
    return columns[-4:-1]


def _cross(first: Array, second: Array, out: Array) -> None:
    """Write first x second to ``out`` (3, 2, M). Both factors are (3, M) or (3, 2, M)."""
    a, b = (p[:, None] if p.ndim < out.ndim else p for p in (first, second))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[j], b[k], out=out[i])
        out[i] -= a[k] * b[j]


def _add_plate_slopes(
    of_view: Array, of_camera: Array, rotation: Array, obs: Observations, camera: int
) -> None:
    cosine = rotation[2, 2]
    _, slope = apparent_shift_mm(np.abs(cosine), *obs.plate)
    gain = of_view[5] * (obs.plate_shift[obs.view, camera] * slope * np.sign(cosine))
    of_view[0] -= gain * rotation[2, 1]
    of_view[1] += gain * rotation[2, 0]
    if camera:
        of_camera[0] -= gain * rotation[1, 2]
        of_camera[1] += gain * rotation[0, 2]


@dataclass(frozen=True)
class Residuals:
    """Holds whitened residuals of M dots and their derivatives.

    value : (M, 2) residuals.
    by_dot : (M, 2, 3) with respect to the dot.
    by_view, by_camera : (M, 2, 6) with respect to the poses, as in `image_columns`; by_camera is
        zero for the first camera.
    by_intrinsics : (M, 2, 20) with respect to all intrinsics.
    """

    value: Array
    by_dot: Array
    by_view: Array
    by_camera: Array
    by_intrinsics: Array


def whitened_residuals(state: State, obs: Observations, rho_mm: Sequence[float]) -> Residuals:
    """Return `image_columns` of all cameras, in the order of the measurements, with all
    derivatives.
    """
    every = range(len(PARAMETERS))
    first = len(every)
    columns = np.zeros((first + 13, 2, len(obs)))
    for c, rho in enumerate(rho_mm):
        mine = np.flatnonzero(obs.camera == c)
        found = image_columns(state, obs.subset(mine), c, rho, every)
        columns[: len(found) - 7, :, mine], columns[-7:, :, mine] = found[:-7], found[-7:]
    parts = (dot_columns(columns), columns[first + 6 : -1], columns[first : first + 6])
    dot, view, camera = (np.moveaxis(part, -1, 0).swapaxes(1, 2) for part in parts)
    lens = np.moveaxis(columns[:first], -1, 0).swapaxes(1, 2)
    return Residuals(columns[-1].T, dot, view, camera, lens)


def distance_residual(
    first_mm: Array, second_mm: Array, distance_mm: float, sigma_mm: float
) -> tuple[Array, Array]:
    """Return the residual of the known distance between two dots, which sets the scale.

    first_mm, second_mm : (..., 3) positions of the two dots.

    Returns the residuals (...) and their derivatives (..., 3) with respect to the first dot. The
    derivatives with respect to the second dot are the negative of these.
    """
    difference = first_mm - second_mm
    length = np.linalg.norm(difference, axis=-1)
    return (
        np.asarray((length - distance_mm) / sigma_mm),
        np.asarray(difference / (length * sigma_mm)[..., None]),
    )


def depth_gauge_residual(rig_from_camera: Array, sigma_mm: float) -> tuple[Array, Array]:
    """Return the residuals that put the rig origin where two optical axes come closest.

    rig_from_camera : (..., 4, 4) poses of the second camera or a further one.

    Returns the residuals (..., 2), which are the translation along the axis of the first camera and
    along the camera's own axis, both over ``sigma_mm``, and their derivatives (..., 2, 6) with
    respect to GTSAM's Pose3 tangent. Images do not determine either translation for one camera,
    `Problem.origin_camera`. For a further camera they leave only the translation along its own axis
    undetermined; see `docs/theory.md`.
    """
    rotation, translation = rig_from_camera[..., :3, :3], rig_from_camera[..., :3, 3]
    axis = rotation[..., 2]
    along_own = (translation * axis).sum(-1)
    jacobian = np.zeros((*translation.shape[:-1], 2, 6))
    jacobian[..., 0, 3:] = rotation[..., 2, :]
    turned = np.einsum("...i,...ij->...j", translation, rotation)
    jacobian[..., 1, :3] = -turned @ hat(np.array([0.0, 0.0, 1.0]))
    jacobian[..., 1, 3:] = np.einsum("...i,...ij->...j", axis, rotation)
    return np.stack([translation[..., 2], along_own], -1) / sigma_mm, jacobian / sigma_mm


def place_residual(rig_from_target: Array, sigma_mm: float) -> tuple[Array, Array]:
    """Return the residuals of a weak prior on the target's position in a view.

    It bounds the depth of a view that only one telecentric camera sees.

    rig_from_target : (..., 4, 4).

    Returns the residuals (..., 3) and their derivatives (..., 3, 6) with respect to GTSAM's Pose3
    tangent.
    """
    rotation, translation = rig_from_target[..., :3, :3], rig_from_target[..., :3, 3]
    jacobian = np.concatenate([np.zeros_like(rotation), rotation], -1) / sigma_mm
    return np.asarray(translation / sigma_mm), jacobian
