"""The telecentric projection factor: dots of a target seen by the cameras of the rig.

The residuals of *all* images are one pure function of arrays (`whitened_residuals`); the GTSAM
factor of one image reads its rows from an evaluation that all images share (`ImageFactors`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.rig import projection
from telerig.rig.pose import hat
from telerig.rig.windows import Wall

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class State:
    """Everything that is estimated, as arrays.

    intrinsics : (C, 20), order `telerig.rig.projection.PARAMETERS`.
    rig_from_camera : (C, 4, 4); the first is the identity.
    rig_from_target : (V, 4, 4).
    dots_mm : (N, 3) in the target's frame.
    """

    intrinsics: Array
    rig_from_camera: Array
    rig_from_target: Array
    dots_mm: Array


@dataclass(frozen=True)
class Observations:
    """Dots measured in images, sorted by image (view, camera).

    view, camera, dot : (M,) indices.  uv_px : (M, 2).
    whitener : (M, 2, 2), W with W^T W = inverse covariance; a weight multiplies its square.
    plate_shift : (V, C) +1 or -1 where the camera sees the dots through the plate, else 0.
    plate : (thickness_mm, index).
    walls : per camera, the glass that it sees the dots through; () where they are in air.
    """

    view: Ints
    camera: Ints
    dot: Ints
    uv_px: Array
    whitener: Array
    plate_shift: Array
    plate: tuple[float, float] = (0.0, 1.5)
    walls: tuple[Wall | None, ...] = ()

    def subset(self, rows: Ints) -> Observations:
        """Only some of the measurements."""
        parts = {n: getattr(self, n)[rows] for n in ("view", "camera", "dot", "uv_px", "whitener")}
        return replace(self, **parts)

    def wall(self, camera: int) -> Wall | None:
        return self.walls[camera] if self.walls else None

    def __len__(self) -> int:
        return len(self.view)


@dataclass(frozen=True)
class Residuals:
    """Whitened residuals (M, 2) and their derivatives (M, 2, k).

    by_dot : 3 columns; by_view, by_camera : 6, GTSAM's Pose3 tangent (rotation, translation),
    right perturbation of rig_from_target and rig_from_camera; by_intrinsics : 20.
    """

    value: Array
    by_dot: Array
    by_view: Array
    by_camera: Array
    by_intrinsics: Array


def apparent_shift_mm(cosine: Array, thickness_mm: float, index: float) -> tuple[Array, Array]:
    """How much nearer a dot looks, along the plate's normal, through a parallel plate.

    Snell's law for the parallel rays of a telecentric lens at angle acos(cosine) to the normal:
    d (1 - tan(refracted) / tan(incident)). Returns the shift and its slope d(shift)/d(cosine).
    """
    root2 = index**2 - 1 + cosine**2
    shift = thickness_mm * (1 - cosine / np.sqrt(root2))
    return shift, -thickness_mm * (index**2 - 1) / root2**1.5


def camera_points(state: State, obs: Observations) -> tuple[Array, Array, Array]:
    """Dots in their camera's frame: (M, 3) camera points, (M, 3) target points, (M, 3, 3) rotation.

    The target points carry the shift of the plate that they are seen through.
    """
    points = state.dots_mm[obs.dot]
    view, camera = state.rig_from_target, state.rig_from_camera
    camera_from_rig = np.swapaxes(camera[:, :3, :3], -1, -2)
    rotations = camera_from_rig[None] @ view[:, None, :3, :3]
    if np.any(obs.plate_shift):
        shift, _ = apparent_shift_mm(np.abs(rotations[..., 2, 2]), *obs.plate)
        points = points.copy()
        points[:, 2] += (obs.plate_shift * shift)[obs.view, obs.camera]
    offset = view[:, None, :3, 3] - camera[None, :, :3, 3]
    offset = np.einsum("cij,vcj->vci", camera_from_rig, offset)
    rotation = rotations[obs.view, obs.camera]
    in_camera = np.einsum("mij,mj->mi", rotation, points) + offset[obs.view, obs.camera]
    return in_camera, points, rotation


def pixels(state: State, obs: Observations, rho_mm: Sequence[float]) -> Array:
    """(M, 2) predicted pixels."""
    in_camera, _, _ = camera_points(state, obs)
    out = np.empty((len(obs), 2))
    for c, rho in enumerate(rho_mm):
        mine = obs.camera == c
        out[mine] = projection.pixel_from_camera(
            in_camera[mine], state.intrinsics[c], rho, obs.wall(c)
        )
    return out


def whitened_error(state: State, obs: Observations, rho_mm: Sequence[float]) -> Array:
    """(M, 2) whitened residuals, predicted minus measured, without derivatives."""
    residual = pixels(state, obs, rho_mm) - obs.uv_px
    return np.asarray(np.einsum("mij,mj->mi", obs.whitener, residual))


def whitened_residuals(state: State, obs: Observations, rho_mm: Sequence[float]) -> Residuals:
    """Whitened residuals, predicted minus measured, with all derivatives."""
    in_camera, in_target, rotation = camera_points(state, obs)
    uv = np.empty((len(obs), 2))
    by_point = np.empty((len(obs), 2, 3))
    by_intrinsics = np.empty((len(obs), 2, len(projection.PARAMETERS)))
    for c, rho in enumerate(rho_mm):
        mine = obs.camera == c
        uv[mine], by_point[mine], by_intrinsics[mine] = projection.pixel_jacobians(
            in_camera[mine], state.intrinsics[c], rho, obs.wall(c)
        )
    white_by_point = obs.whitener @ by_point
    by_dot = white_by_point @ rotation
    by_view = np.concatenate([-by_dot @ hat(in_target), by_dot], -1)
    # right perturbation of rig_from_target moves the point by R (w x X + v) in camera axes
    by_camera = np.concatenate([white_by_point @ hat(in_camera), -white_by_point], -1)
    if np.any(obs.plate_shift):
        _add_plate_slopes(by_view, by_camera, by_dot[..., 2], rotation, obs)
    value = np.einsum("mij,mj->mi", obs.whitener, uv - obs.uv_px)
    return Residuals(value, by_dot, by_view, by_camera, obs.whitener @ by_intrinsics)


def _add_plate_slopes(
    by_view: Array, by_camera: Array, by_normal: Array, rotation: Array, obs: Observations
) -> None:
    cosine = rotation[:, 2, 2]
    _, slope = apparent_shift_mm(np.abs(cosine), *obs.plate)
    slope = obs.plate_shift[obs.view, obs.camera] * slope * np.sign(cosine)
    gain = by_normal * slope[:, None]
    by_view[..., 0] -= gain * rotation[:, 2, 1, None]
    by_view[..., 1] += gain * rotation[:, 2, 0, None]
    by_camera[..., 0] -= gain * rotation[:, 1, 2, None]
    by_camera[..., 1] += gain * rotation[:, 0, 2, None]


@dataclass(frozen=True)
class ImageKeys:
    """The graph's keys, and which intrinsics are free.

    free : per camera, indices into `PARAMETERS`; unit : per camera, the step of each free
    parameter that moves a pixel at the image corner by about one, so that all variables of the
    graph are alike in size.
    """

    intrinsics: tuple[int, ...]
    camera: tuple[int, ...]
    view: tuple[int, ...]
    dots: int
    free: tuple[Ints, ...]
    unit: tuple[Array, ...]


class ImageFactors:
    """GTSAM factors, one per image, over one shared evaluation of all residuals.

    GTSAM asks for one image at a time, NumPy is fast only for all at once. The first image asked
    at a new point evaluates every image; the others find their own variables unchanged and take
    their rows. An image whose variables differ from the shared point evaluates again, so what is
    returned is always that of the values given. Derivatives are always evaluated too: a point
    whose cost is asked is nearly always linearised next.
    """

    def __init__(
        self, obs: Observations, keys: ImageKeys, start: State, rho_mm: Sequence[float]
    ) -> None:
        self.obs, self.keys, self.rho_mm = obs, keys, tuple(rho_mm)
        self._start = start
        self._shared: dict[int, bytes] = {}
        self._full: Residuals | None = None
        self._by_free: list[Array] = []

    def graph_factors(self) -> list[Any]:
        """One `gtsam.CustomFactor` for each image that has dots."""
        import gtsam

        image = self.obs.view * len(self.rho_mm) + self.obs.camera
        edges = np.r_[0, np.flatnonzero(np.diff(image)) + 1, len(image)].tolist()
        out = []
        for first, last in pairwise(edges):
            view, camera = int(self.obs.view[first]), int(self.obs.camera[first])
            noise = gtsam.noiseModel.Unit.Create(2 * (last - first))
            callback = self._callback(slice(first, last), view, camera)
            out.append(gtsam.CustomFactor(noise, self._image_keys(view, camera), callback))
        return out

    def _image_keys(self, view: int, camera: int) -> list[int]:
        keys = [self.keys.view[view], self.keys.dots]
        if len(self.keys.free[camera]):
            keys.append(self.keys.intrinsics[camera])
        if camera:
            keys.append(self.keys.camera[camera])
        return keys

    def _callback(self, rows: slice, view: int, camera: int) -> Any:
        me, has_free = self, len(self.keys.free[camera]) > 0
        size, width = 2 * (rows.stop - rows.start), self._start.dots_mm.size
        of_dots = np.arange(size)[:, None] * width + np.repeat(3 * self.obs.dot[rows], 2)[:, None]
        of_dots = (of_dots + np.arange(3)).ravel()

        def error(_this: Any, values: Any, jacobians: list[Array] | None) -> Array:
            full = me._move_to(values, view, camera)
            if jacobians is None:
                return full.value[rows].ravel()
            by_dots = np.zeros(size * width)
            by_dots[of_dots] = full.by_dot[rows].ravel()
            jacobians[0] = full.by_view[rows].reshape(size, 6)
            jacobians[1] = by_dots.reshape(size, width)
            if has_free:
                jacobians[2] = me._by_free[camera][rows].reshape(size, -1)
            if camera:
                jacobians[-1] = full.by_camera[rows].reshape(size, 6)
            return full.value[rows].ravel()

        return error

    def _move_to(self, values: Any, view: int, camera: int) -> Residuals:
        """The shared evaluation, renewed unless it is of this image's variables in ``values``."""
        if self._full is None or not self._unchanged(values, view, camera):
            state = state_from_values(values, self.keys, self._start)
            self._shared = _as_bytes(values, self.keys)
            self._full = whitened_residuals(state, self.obs, self.rho_mm)
            free = zip(self.keys.free, self.keys.unit)
            self._by_free = [self._full.by_intrinsics[..., f] * unit for f, unit in free]
        return self._full

    def _unchanged(self, values: Any, view: int, camera: int) -> bool:
        keys, shared = self.keys, self._shared
        poses = [keys.view[view], keys.camera[camera]] if camera else [keys.view[view]]
        vectors = [keys.dots]
        if len(keys.free[camera]):
            vectors.append(keys.intrinsics[camera])
        return all(shared[k] == values.atPose3(k).matrix().tobytes() for k in poses) and all(
            shared[k] == values.atVector(k).tobytes() for k in vectors
        )


def _as_bytes(values: Any, keys: ImageKeys) -> dict[int, bytes]:
    """Every variable of the images: equality of bytes is exact and cheap to test."""
    poses = (*keys.view, *keys.camera[1:])
    vectors = (keys.dots, *(k for k, free in zip(keys.intrinsics, keys.free) if len(free)))
    return {k: values.atPose3(k).matrix().tobytes() for k in poses} | {
        k: values.atVector(k).tobytes() for k in vectors
    }


def intrinsics_from_values(values: Any, keys: ImageKeys, start: State, camera: int) -> Array:
    """(20,) intrinsics of one camera: the start with the free ones moved."""
    out: Array = start.intrinsics[camera].copy()
    if len(keys.free[camera]):
        out[keys.free[camera]] += values.atVector(keys.intrinsics[camera]) * keys.unit[camera]
    return out


def state_from_values(values: Any, keys: ImageKeys, start: State) -> State:
    """Read a `gtsam.Values` into arrays; what is not in the graph is taken from ``start``."""
    intrinsics = [
        intrinsics_from_values(values, keys, start, c) for c in range(len(start.intrinsics))
    ]
    cameras = start.rig_from_camera.copy()
    for c in range(1, len(cameras)):
        cameras[c] = values.atPose3(keys.camera[c]).matrix()
    views = np.array([values.atPose3(k).matrix() for k in keys.view])
    dots = values.atVector(keys.dots).reshape(-1, 3)
    return State(np.array(intrinsics), cameras, views, dots)
