"""Points in space from two pixels: mid-point of the rays, and maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.errors import GeometryError, InputError
from telerig.rig import projection
from telerig.rig.camera import Camera

Array = NDArray[np.float64]

_STEPS = 20


@dataclass(frozen=True)
class Triangulation:
    """points_mm : (..., 3) in the rig frame.

    covariance_mm2 : (..., 3, 3), of the measurement alone, or with the calibration's share added
        where a calibration did the triangulation; measurement_covariance_mm2 is without it.
    ray_miss_mm : (...,) signed distance of the two rays, along their common perpendicular
        (first direction x second direction), from the first ray to the second.
    """

    points_mm: Array
    covariance_mm2: Array
    ray_miss_mm: Array
    measurement_covariance_mm2: Array


def midpoint(
    origin_a: Array, direction_a: Array, origin_b: Array, direction_b: Array
) -> tuple[Array, Array]:
    """(..., 3) middle of the shortest segment between two rays, and its signed (...,) length.

    Raises GeometryError when rays are parallel.
    """
    cross = np.cross(direction_a, direction_b)
    sine2 = (cross**2).sum(-1)
    if np.any(sine2 < 1e-8):
        raise GeometryError(
            "the rays of the two cameras are parallel", todo="triangulation needs two directions"
        )
    between = origin_b - origin_a
    along_a = (np.cross(between, direction_b) * cross).sum(-1) / sine2
    along_b = (np.cross(between, direction_a) * cross).sum(-1) / sine2
    point_a = origin_a + along_a[..., None] * direction_a
    point_b = origin_b + along_b[..., None] * direction_b
    return (point_a + point_b) / 2, (between * cross).sum(-1) / np.sqrt(sine2)


def pixel_covariance(sigma_px: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Standard deviations (scalar or (...,)) or covariances (..., 2, 2) -> (..., 2, 2).

    An array of the points' own shape is taken for standard deviations, even when that is (2, 2).
    """
    sigma = np.asarray(sigma_px, float)
    if sigma.shape != shape and sigma.ndim >= 2 and sigma.shape[-2:] == (2, 2):
        return np.broadcast_to(sigma, (*shape, 2, 2))
    if np.any(~(sigma > 0)):
        raise InputError("sigma_px must be positive", todo="give the pixel noise in px")
    return np.broadcast_to(sigma**2, shape)[..., None, None] * np.eye(2)


def triangulate(
    cameras: tuple[Camera, Camera],
    uv_px: tuple[ArrayLike, ArrayLike],
    sigma_px: ArrayLike | tuple[ArrayLike, ArrayLike],
    method: str = "ml",
) -> Triangulation:
    """Points from pixels in two cameras.

    uv_px : two arrays (..., 2).  sigma_px : scalar, (...,) or covariances (..., 2, 2); a tuple of
    two for the two cameras.  method : "ml" (minimum of the whitened reprojection error,
    Gauss-Newton from the mid-point) or "midpoint" (the 2004 method; its covariance is propagated
    through its own formula's weights, equal for both rays).

    Raises InputError for unequal shapes, pixels that are not finite or an unknown method,
    GeometryError for parallel rays.
    """
    first, second = (np.asarray(uv, float) for uv in uv_px)
    if first.shape != second.shape or first.shape[-1:] != (2,):
        raise InputError(
            f"pixels of shapes {first.shape} and {second.shape} do not pair up",
            todo="give two arrays (N, 2), row i of one matching row i of the other",
        )
    bad = ~(np.isfinite(first) & np.isfinite(second)).all(-1)
    if np.any(bad):
        raise InputError(
            f"{int(bad.sum())} of {bad.size} points have pixels that are not finite",
            todo="leave out points that one camera did not see",
        )
    if method not in ("ml", "midpoint"):
        raise InputError(f"unknown method {method!r}", todo='use "ml" or "midpoint"')
    shape = first.shape[:-1]
    pair = sigma_px if isinstance(sigma_px, tuple) else (sigma_px, sigma_px)
    covariances = [pixel_covariance(s, shape) for s in pair]
    rays = [camera.unproject(uv) for camera, uv in zip(cameras, (first, second))]
    middle, miss = midpoint(*rays[0], *rays[1])
    if method == "midpoint":
        covariance = _midpoint_covariance(cameras, middle, covariances)
        return Triangulation(middle, covariance, miss, covariance)
    points, covariance = _maximum_likelihood(cameras, (first, second), covariances, middle)
    return Triangulation(points, covariance, miss, covariance)


def stacked_jacobian(cameras: tuple[Camera, ...], points_mm: Array) -> tuple[Array, Array, Array]:
    """(..., 2C) pixels, (..., 2C, 3) by the rig point, (C, ..., 2, 18) by the intrinsics."""
    pixels, jacobians, by_intrinsics = [], [], []
    for camera in cameras:
        in_camera = camera.camera_from_rig.apply(points_mm.reshape(-1, 3)).reshape(points_mm.shape)
        uv, by_point, by_k = projection.pixel_jacobians(in_camera, camera.intrinsics, camera.rho_mm)
        pixels.append(uv)
        jacobians.append(by_point @ camera.camera_from_rig.rotation)
        by_intrinsics.append(by_k)
    return np.concatenate(pixels, -1), np.concatenate(jacobians, -2), np.array(by_intrinsics)


def _information(covariances: list[Array]) -> Array:
    shape = covariances[0].shape[:-2]
    out = np.zeros((*shape, 4, 4))
    out[..., :2, :2] = np.linalg.inv(covariances[0])
    out[..., 2:, 2:] = np.linalg.inv(covariances[1])
    return out


def _maximum_likelihood(
    cameras: tuple[Camera, Camera],
    uv_px: tuple[Array, Array],
    covariances: list[Array],
    points: Array,
) -> tuple[Array, Array]:
    measured = np.concatenate(uv_px, -1)
    weight = _information(covariances)
    normal = np.zeros((*points.shape, 3))
    for _ in range(_STEPS):
        predicted, jacobian, _ = stacked_jacobian(cameras, points)
        weighted = np.swapaxes(jacobian, -1, -2) @ weight
        normal = weighted @ jacobian
        step = np.linalg.solve(normal, weighted @ (measured - predicted)[..., None])[..., 0]
        points = points + step
        if np.max(np.abs(step), initial=0.0) < 1e-9:
            break
    return points, np.linalg.inv(normal)


def _midpoint_covariance(
    cameras: tuple[Camera, Camera], points: Array, covariances: list[Array]
) -> Array:
    """First order: the mid-point is the least-squares point of object-space ray distances."""
    _, jacobian, _ = stacked_jacobian(cameras, points)
    gain = np.zeros((*points.shape, 4))
    projectors, inverse_maps = [], []
    for c, camera in enumerate(cameras):
        _, direction = camera.unproject(camera.project(points))
        projectors.append(np.eye(3) - direction[..., :, None] * direction[..., None, :])
        inverse_maps.append(np.linalg.pinv(jacobian[..., 2 * c : 2 * c + 2, :]))
    total = np.linalg.inv(projectors[0] + projectors[1])
    for c in range(2):
        gain[..., 2 * c : 2 * c + 2] = total @ projectors[c] @ inverse_maps[c]
    covariance = np.linalg.inv(_information(covariances))
    return np.asarray(gain @ covariance @ np.swapaxes(gain, -1, -2))
