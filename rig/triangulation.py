"""Triangulates points in space from their pixels, by the mid-point of rays or by maximum
likelihood.

`triangulate` takes two cameras that both see every point. `triangulate_views` takes any number of
cameras, and each point may be seen by only some of them.

The *rig block* of a calibration's covariance holds P parameters of the cameras: the free intrinsics
of all cameras, then the pose (6) of each camera but the first. `rig_jacobian` and
`point_shift_jacobian` are their effect on pixels and on triangulated points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.arrays import Array, as_pixels
from telerig.errors import GeometryError, InputError
from telerig.rig import projection
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import INDEX
from telerig.rig.pose import hat
from telerig.rig.windows import affine_map
from telerig.short_text import ShortText, counted, xarray_dataset

if TYPE_CHECKING:
    import pandas as pd
    import xarray

POSE_COMPONENTS = ("rx_rad", "ry_rad", "rz_rad", "tx_mm", "ty_mm", "tz_mm")
LEAST_SINE = 0.05
"""Of the angle between two lines of sight that show a depth."""
VOLUME_SHARE = 0.6
"""Edge of the working volume, as a share of the smallest field of view of the cameras."""
UNKNOWN_MM = 100.0
"""Standard deviation of a coordinate that nothing has measured: several times the volume's edge."""

_STEPS = 20
_BLOCK = 4096
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_ROWS = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True, repr=False)
class Triangulation(ShortText):
    """Holds triangulated points with their covariance.

    points_mm : (..., 3) in the rig frame.
    covariance_mm2 : (..., 3, 3), with the calibration's own uncertainty if a calibration
        triangulates
    measurement_covariance_mm2 : its part from the noise of the pixels.
    ray_miss_mm : (...) signed distance from the first ray to the second, along first direction x
        second direction. From `triangulate_views` it is (..., C), the distance of the point from
        the ray of each of the C cameras, NaN for a camera that does not see the point.
    seen_by : (...) number of cameras that saw each point; None if two cameras saw all points. A
        point that fewer than two cameras saw is NaN.
    """

    points_mm: Array
    covariance_mm2: Array
    ray_miss_mm: Array
    measurement_covariance_mm2: Array
    seen_by: NDArray[np.int64] | None = None

    @property
    def unplaced(self) -> int:
        """The number of points that fewer than two cameras saw, so that they have no position."""
        return 0 if self.seen_by is None else int((self.seen_by < 2).sum())

    def title(self) -> str:
        """Return the number of points."""
        return f"Triangulation of {counted(self.points_mm[..., 0].size, 'point')}"

    def facts(self) -> dict[str, str]:
        """Return the medians of the standard deviations and of the ray miss, in words."""
        placed = np.isfinite(self.points_mm).all(-1)
        if not placed.any():
            return {"placed": "none" if placed.size else ""}
        facts = {}
        for name, covariance in (
            ("sd", self.covariance_mm2), ("of the pixels", self.measurement_covariance_mm2)
        ):  # fmt: skip
            variance = np.diagonal(covariance, axis1=-2, axis2=-1)[placed]
            x, y, z = 1e3 * np.sqrt(np.median(variance, axis=0))
            facts[name] = f"x {x:.3g}, y {y:.3g}, z {z:.3g} µm (median)"
        miss = 1e3 * np.nanmedian(np.abs(self.ray_miss_mm))
        facts["ray miss"] = f"{miss:.3g} µm (median)"
        facts["not placed"] = str(self.unplaced or "")
        return facts

    def to_pandas(self) -> pd.DataFrame:
        """Return a table with one row per point: position in mm, covariance in mm^2, ray miss in
        mm.

        The columns have the names of tracks.csv. With a ray miss for each of C cameras there are
        columns ray_miss_0_mm to ray_miss_(C-1)_mm in its place, and ``seen_by``.
        """
        import pandas as pd

        points, covariance = self.points_mm.reshape(-1, 3), self.covariance_mm2.reshape(-1, 3, 3)
        columns: dict[str, NDArray[Any]] = {f"{a}_mm": points[:, i] for i, a in enumerate("xyz")}
        columns |= {f"s{'xyz'[i]}{'xyz'[j]}_mm2": covariance[:, i, j] for i, j in _UPPER}
        if self.ray_miss_mm.shape == self.points_mm.shape[:-1]:
            columns["ray_miss_mm"] = self.ray_miss_mm.reshape(-1)
        else:
            misses = self.ray_miss_mm.reshape(len(points), -1).T
            columns |= {f"ray_miss_{c}_mm": miss for c, miss in enumerate(misses)}
        if self.seen_by is not None:
            columns["seen_by"] = self.seen_by.reshape(-1)
        return pd.DataFrame(columns)

    def to_xarray(self) -> xarray.Dataset:
        """Return an `xarray.Dataset` with units; its dimension ``obs`` has one entry per point.

        It has the coordinates x, y and z, ``covariance`` and ``measurement_covariance``
        (obs, axis, axis_of) and ``ray_miss_mm``; from `triangulate_views` this is (obs, camera),
        and there is ``seen_by``. Raises InputError if xarray is not installed.
        """
        points = self.points_mm.reshape(-1, 3)
        square = ("obs", "axis", "axis_of")
        variables: dict[str, tuple[Any, ...]] = {}
        for name, of in (("covariance", ""), ("measurement_covariance", ", the pixels' share")):
            words = {"units": "mm2", "long_name": f"covariance of the position{of}"}
            variables[name] = (square, getattr(self, f"{name}_mm2").reshape(-1, 3, 3), words)
        cameras = self.ray_miss_mm.shape[self.points_mm.ndim - 1 :]
        misses = self.ray_miss_mm.reshape(len(points), *cameras)
        words = {"units": "mm", "long_name": "distance between the rays"}
        variables["ray_miss_mm"] = ("obs", "camera")[: misses.ndim], misses, words
        if self.seen_by is not None:
            words = {"units": "1", "long_name": "number of cameras that saw the point"}
            variables["seen_by"] = ("obs",), self.seen_by.reshape(-1), words
        places = {
            a: (("obs",), points[:, i], {"units": "mm", "long_name": f"position along {a}"})
            for i, a in enumerate("xyz")
        }
        axes = {"axis": list("xyz"), "axis_of": list("xyz")}
        return xarray_dataset(variables, places | axes, {"title": self.title()})


def midpoint(
    origin_a: Array, direction_a: Array, origin_b: Array, direction_b: Array
) -> tuple[Array, Array]:
    """Return the middle (..., 3) of the shortest segment between two rays, and its signed length.

    Rays are a point (..., 3) and a unit direction (..., 3). Raises GeometryError if they are
    parallel.
    """
    normal = cross(direction_a, direction_b)
    sine2 = (normal**2).sum(-1)
    if np.any(sine2 < 1e-8):
        raise GeometryError(
            "the rays of the two cameras are parallel",
            todo="triangulate with two cameras that look in different directions",
        )
    between = origin_b - origin_a
    along_a = (cross(between, direction_b) * normal).sum(-1) / sine2
    along_b = (cross(between, direction_a) * normal).sum(-1) / sine2
    point_a = origin_a + along_a[..., None] * direction_a
    point_b = origin_b + along_b[..., None] * direction_b
    return (point_a + point_b) / 2, (between * normal).sum(-1) / np.sqrt(sine2)


def cross(first: Array, second: Array) -> Array:
    """Return the cross product of vectors (..., 3); `numpy.cross` is slow for few vectors."""
    (a, b, c), (d, e, f) = np.moveaxis(first, -1, 0), np.moveaxis(second, -1, 0)
    return np.stack([b * f - c * e, c * d - a * f, a * e - b * d], -1)


def pixel_covariance(sigma_px: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return covariances (..., 2, 2) in px^2 from standard deviations or from covariances.

    sigma_px : one standard deviation, an array of them (...), or covariances (..., 2, 2). An array
    of the points' ``shape`` holds standard deviations, even if that is (2, 2). Raises InputError
    for a standard deviation that is not positive, a covariance that is not positive definite, and
    a wrong shape.
    """
    sigma = np.asarray(sigma_px, float)
    full = sigma.shape != shape and sigma.ndim >= 2 and sigma.shape[-2:] == (2, 2)
    try:
        np.broadcast_to(sigma, (*shape, 2, 2) if full else shape)
    except ValueError:
        raise InputError(
            f"sigma_px of shape {sigma.shape} does not belong to points of shape {shape}",
            todo="give one number, one for each point, or a covariance (2, 2) for each",
        ) from None
    if full:
        determinant = sigma[..., 0, 0] * sigma[..., 1, 1] - sigma[..., 0, 1] * sigma[..., 1, 0]
        if np.any(~((sigma[..., 0, 0] > 0) & (determinant > 0))):
            raise InputError(
                "a covariance of pixels is not positive definite",
                where="sigma_px",
                todo="give covariances in px^2, with positive variances and correlations below 1",
            )
        return np.broadcast_to(sigma, (*shape, 2, 2))
    if np.any(~(sigma > 0)):
        raise InputError("sigma_px must be positive", todo="give the pixel noise in px")
    return np.broadcast_to(sigma**2, shape)[..., None, None] * np.eye(2)


def triangulate(
    cameras: tuple[Camera, Camera],
    uv_px: tuple[ArrayLike, ArrayLike],
    sigma_px: ArrayLike | tuple[ArrayLike, ArrayLike],
    method: str = "ml",
    *,
    rays: Sequence[tuple[Array, Array]] | None = None,
) -> Triangulation:
    """Return the points that two cameras see at the given pixels, two arrays (..., 2).

    sigma_px : noise as in `pixel_covariance`; a tuple of two gives each camera its own.
    method : "ml" minimises the whitened reprojection error by Gauss-Newton steps from the
        mid-point; "midpoint" takes the middle of the shortest segment between both rays.
    rays : what ``unproject`` of each camera gives for the pixels, if it is known.

    Raises InputError for unequal shapes, pixels that are not finite or an unknown method, and
    GeometryError for parallel rays.
    """
    first, second = (as_pixels(uv, "triangulate") for uv in uv_px)
    if first.shape != second.shape:
        raise InputError(
            f"pixels of shapes {first.shape} and {second.shape} do not pair up",
            todo="give two arrays (N, 2), row i of one matching row i of the other",
        )
    bad = ~(np.isfinite(first) & np.isfinite(second)).all(-1)
    if np.any(bad):
        raise InputError(
            f"{int(bad.sum())} of {bad.size} points have pixels that are not finite",
            todo="leave out the points that one camera did not see",
        )
    if method not in ("ml", "midpoint"):
        raise InputError(f"unknown method {method!r}", todo='use "ml" or "midpoint"')
    shape = first.shape[:-1]
    pair = sigma_px if isinstance(sigma_px, tuple) else (sigma_px, sigma_px)
    _check_count(pair, 2)
    covariances = [pixel_covariance(s, shape) for s in pair]
    if rays is None:
        rays = [camera.unproject(uv) for camera, uv in zip(cameras, (first, second))]
    middle, miss = midpoint(*rays[0], *rays[1])
    if method == "midpoint":
        covariance = _midpoint_covariance(cameras, middle, covariances)
        return Triangulation(middle, covariance, miss, covariance)
    points, covariance = _maximum_likelihood(cameras, (first, second), covariances, middle)
    return Triangulation(points, covariance, miss, covariance)


def triangulate_views(
    cameras: Sequence[Camera],
    uv_px: Sequence[ArrayLike],
    sigma_px: ArrayLike | tuple[ArrayLike, ...],
    method: str = "ml",
) -> Triangulation:
    """Return the points that C cameras see at the given pixels; each needs at least two of them.

    uv_px : C arrays (..., 2), with NaN where a camera does not see a point.
    sigma_px : as in `triangulate`.
    method : "ml" as there, but from the point nearest to all rays; "midpoint" returns that point. A
        point that fewer than two cameras see gets NaN; ``seen_by`` of the result counts the
        cameras.

    Raises InputError for unequal shapes or an unknown method, and GeometryError for parallel rays.
    """
    pixels = [np.asarray(uv, float) for uv in uv_px]
    shapes = {uv.shape for uv in pixels}
    if len(pixels) != len(cameras) or len(shapes) != 1 or pixels[0].shape[-1:] != (2,):
        raise InputError(
            f"pixels of shapes {', '.join(str(uv.shape) for uv in pixels)} for {len(cameras)} "
            "cameras do not belong together",
            todo="give an array (N, 2) for each camera, row i of the same point in all",
        )
    if method not in ("ml", "midpoint"):
        raise InputError(f"unknown method {method!r}", todo='use "ml" or "midpoint"')
    shape = pixels[0].shape[:-1]
    sigmas = sigma_px if isinstance(sigma_px, tuple) else (sigma_px,) * len(cameras)
    _check_count(sigmas, len(cameras))
    uv = np.array([p.reshape(-1, 2) for p in pixels])
    seen = np.isfinite(uv).all(-1)
    noise = np.array(
        [
            seen_covariance(s, mine.reshape(shape)).reshape(-1, 2, 2)
            for s, mine in zip(sigmas, seen, strict=True)
        ]
    )
    count = uv.shape[1]
    points, covariance = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    miss = np.full((count, len(cameras)), np.nan)
    for pattern in np.unique(seen.T, axis=0):
        used = np.flatnonzero(pattern)
        rows = np.flatnonzero((pattern == seen.T).all(-1))
        if len(used) < 2:
            continue
        some = tuple(camera for camera, sees in zip(cameras, pattern) if sees)
        measured, own = uv[np.ix_(used, rows)], list(noise[np.ix_(used, rows)])
        rays = [camera.unproject(pixel) for camera, pixel in zip(some, measured)]
        place = nearest_to_rays(*(np.array(part) for part in zip(*rays)))
        if method == "ml":
            place, spread = _maximum_likelihood(some, measured, own, place)
        else:
            spread = _midpoint_covariance(some, place, own)
        points[rows], covariance[rows] = place, spread
        miss[np.ix_(rows, used)] = np.transpose([_distance(place, *ray) for ray in rays])
    covariance = covariance.reshape(*shape, 3, 3)
    return Triangulation(
        points.reshape(*shape, 3),
        covariance,
        miss.reshape(*shape, len(cameras)),
        covariance,
        seen.sum(0).reshape(shape),
    )


def _check_count(sigmas: tuple[ArrayLike, ...], cameras: int) -> None:
    if len(sigmas) != cameras:
        raise InputError(
            f"{len(sigmas)} entries of sigma_px for {cameras} cameras",
            todo="give one number, or a tuple with one entry for each camera",
        )


def nearly_parallel(cameras: Sequence[Camera]) -> bool:
    """Return whether two cameras look along nearly the same line, so that they show no depth."""
    first, second = (camera.camera_from_rig.rotation[2] for camera in cameras)
    return bool(np.linalg.norm(np.cross(first, second)) < LEAST_SINE)


def triangulate_any(
    cameras: Sequence[Camera], uv_px: Sequence[ArrayLike], sigma_px: float
) -> Triangulation:
    """Return `triangulate` for two cameras and `triangulate_views` for more."""
    if len(cameras) == 2:
        return triangulate((cameras[0], cameras[1]), (uv_px[0], uv_px[1]), sigma_px)
    return triangulate_views(cameras, uv_px, sigma_px)


def nearest_to_rays(origins: Array, directions: Array) -> Array:
    """Return the points (..., 3) with the least sum of squared distances from C rays each.

    Rays are points and unit directions (C, ..., 3). Raises GeometryError if all are parallel.
    """
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    total = across.sum(0)
    if np.any(np.linalg.eigvalsh(total)[..., 0] < 1e-8):
        raise GeometryError(
            "the rays of all cameras that see a point are parallel",
            todo="triangulate with cameras that look in different directions",
        )
    right = (across @ origins[..., None]).sum(0)
    return np.asarray(np.linalg.solve(total, right)[..., 0])


def on_rays(camera: Camera, uv_px: Array, covariance_px2: Array) -> tuple[Array, Array, Array]:
    """Return N pixels as points in space whose depth is unknown.

    uv_px, covariance_px2 : (N, 2), (N, 2, 2) pixels.

    Returns the points (N, 3) of the rays that are nearest to the rig's origin (mm), covariances
    (N, 3, 3) (mm^2) with `UNKNOWN_MM` along the ray, and derivatives (N, 3, 2) of the points by the
    pixels (mm/px), across the ray.
    """
    origin, along = camera.unproject(uv_px)
    points = origin - (origin * along).sum(-1, keepdims=True) * along
    _, by_point = stacked_jacobian((camera,), points)
    information = by_point.mT @ np.linalg.solve(covariance_px2, by_point)
    information += along[:, :, None] * along[:, None] / UNKNOWN_MM**2
    by_pixel = by_point.mT @ np.linalg.inv(by_point @ by_point.mT)
    return points, np.linalg.inv(information), np.asarray(by_pixel)


def _distance(points: Array, origin: Array, direction: Array) -> Array:
    """Return the distance (N,) of N points (N, 3) from rays with unit directions (N, 3)."""
    return np.asarray(np.linalg.norm(np.cross(points - origin, direction), axis=-1))


def seen_covariance(sigma_px: ArrayLike, seen: NDArray[np.bool_]) -> Array:
    """Return `pixel_covariance` (..., 2, 2) of the pixels that are seen, 1 px^2 for others."""
    sigma = np.asarray(sigma_px, float)
    if sigma.shape == seen.shape:
        sigma = np.where(seen, sigma, 1.0)
    elif sigma.shape == (*seen.shape, 2, 2):
        sigma = np.where(seen[..., None, None], sigma, np.eye(2))
    covariance = pixel_covariance(sigma, seen.shape)
    return np.where(seen[..., None, None], covariance, np.eye(2))


def stacked_jacobian(cameras: tuple[Camera, ...], points_mm: Array) -> tuple[Array, Array]:
    """Return pixels (..., 2C) of rig points (..., 3) in C cameras, and derivatives (..., 2C, 3)."""
    pixels, jacobians = [], []
    for camera in cameras:
        in_camera = camera.camera_from_rig.apply(points_mm.reshape(-1, 3)).reshape(points_mm.shape)
        uv, by_point, _ = camera.pixel_jacobians(in_camera, ())
        pixels.append(uv)
        jacobians.append(by_point @ camera.camera_from_rig.rotation)
    return np.concatenate(pixels, -1), np.concatenate(jacobians, -2)


def _maximum_likelihood(
    cameras: tuple[Camera, ...],
    uv_px: Sequence[Array] | Array,
    covariances: list[Array],
    points: Array,
) -> tuple[Array, Array]:
    """Return the most likely points (..., 3) and their covariances, from pixels and a start.

    Gauss-Newton steps are done in blocks that fit into the processor's cache.
    """
    flat = points.reshape(-1, 3).T
    measured = np.concatenate([uv.reshape(-1, 2) for uv in uv_px], -1).T
    weights = np.array([_weights(covariance) for covariance in covariances])
    out, covariance = np.empty_like(flat, order="C"), np.empty((flat.shape[1], 3, 3))
    for start in range(0, flat.shape[1], _BLOCK):
        block = slice(start, start + _BLOCK)
        out[:, block], covariance[block] = _gauss_newton(
            cameras, measured[:, block], weights[..., block], flat[:, block]
        )
    shape = points.shape
    return np.ascontiguousarray(out.T).reshape(shape), covariance.reshape(*shape, 3)


def _weights(covariance: Array) -> Array:
    """Return the entries uu, uv and vv (3, N) of the inverses of N covariances (..., 2, 2)."""
    a, b, c = (covariance[..., i, j].ravel() for i, j in ((0, 0), (0, 1), (1, 1)))
    determinant = a * c - b * b
    return np.array([c / determinant, -b / determinant, a / determinant])


def _gauss_newton(
    cameras: tuple[Camera, ...], measured: Array, weights: Array, points: Array
) -> tuple[Array, Array]:
    """Return the most likely N rig points (3, N) in mm and their covariances (N, 3, 3) in mm^2.

    measured : (2C, N) u and v of the first camera, then of the next. weights : (C, 3, N) in 1/px^2,
    as `_weights` returns them. points : (3, N) from which the iteration starts.
    """
    points = np.ascontiguousarray(points)
    inverse = np.empty((6, points.shape[1]))
    for _ in range(_STEPS):
        normal, right = np.zeros((6, points.shape[1])), np.zeros((3, points.shape[1]))
        for c, camera in enumerate(cameras):
            predicted, jacobian = _point_jacobian(camera, points)
            off = measured[2 * c : 2 * c + 2] - predicted
            uu, uv, vv = weights[c]
            left = (uu * jacobian[0] + uv * jacobian[1], uv * jacobian[0] + vv * jacobian[1])
            for i, (j, k) in enumerate(_UPPER):
                normal[i] += left[0][j] * jacobian[0, k] + left[1][j] * jacobian[1, k]
            right += left[0] * off[0] + left[1] * off[1]
        inverse = _symmetric_inverse(normal)
        step = np.array([(inverse[row] * right).sum(0) for row in _ROWS])
        points = points + step
        if np.max(np.abs(step), initial=0.0) < 1e-9:
            break
    return points, np.ascontiguousarray(inverse[_ROWS].transpose(2, 0, 1))


def _point_jacobian(camera: Camera, points: Array) -> tuple[Array, Array]:
    """Return pixels (2, N) of N rig points (3, N), and derivatives (2, 3, N); fast without tilt."""
    pose = camera.camera_from_rig
    x, y, z = pose.rotation @ points + pose.translation_mm[:, None]
    kappa = camera["kappa_per_mm"]
    if np.any(camera.intrinsics[INDEX["tilt_x"] : INDEX["wall_x_rad"]]) or (kappa and camera.wall):
        uv, by_tilted, _ = camera.pixel_jacobians(np.stack([x, y, z], -1), ())
        return uv.T, np.moveaxis(by_tilted @ pose.rotation, 0, -1)
    if camera.wall is not None:
        matrix, offset = affine_map(projection.turned_wall(camera.intrinsics, camera.wall))
        x, y = matrix @ np.array([x, y, z]) + offset[:, None]
        by_x, by_y = (matrix @ pose.rotation)[:, :, None]
    else:
        shrink = 1 / (1 + kappa * z)
        x, y = x * shrink, y * shrink
        across, down, depth = pose.rotation[:, :, None]
        by_x, by_y = (across - kappa * x * depth) * shrink, (down - kappa * y * depth) * shrink
    coefficients = camera.intrinsics[INDEX["k1"] : INDEX["tilt_x"]]
    if np.any(coefficients):
        normal = np.stack([x, y], -1) / camera.rho_mm
        x, y = projection.distort(normal, coefficients).T * camera.rho_mm
        (xx, xy), (yx, yy) = np.moveaxis(
            projection.distortion_jacobian(normal, coefficients), 0, -1
        )
        by_x, by_y = xx * by_x + xy * by_y, yx * by_x + yy * by_y
    scale, skew, aspect = camera["scale_px_per_mm"], camera["skew"], camera["aspect"]
    pixel = [scale * (x + skew * y), scale * aspect * y]
    by_point = np.array([scale * (by_x + skew * by_y), scale * aspect * by_y])
    return np.array([pixel[0] + camera["centre_u_px"], pixel[1] + camera["centre_v_px"]]), by_point


def _symmetric_inverse(matrix: Array) -> Array:
    """Return the inverses of N symmetric 3x3 matrices; entries (6, N) as in `_UPPER`."""
    a, b, c, d, e, f = matrix
    cofactors = np.array(
        [d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b]
    )
    return np.asarray(cofactors / (a * cofactors[0] + b * cofactors[1] + c * cofactors[2]))


def _midpoint_covariance(
    cameras: tuple[Camera, ...], points: Array, covariances: list[Array]
) -> Array:
    """Return the covariance (N, 3, 3) of mid-points to first order in the noise."""
    projectors, gains = [], []
    for camera in cameras:
        _, direction = camera.unproject(camera.project(points))
        projectors.append(np.eye(3) - direction[..., :, None] * direction[..., None, :])
        _, jacobian = stacked_jacobian((camera,), points)
        gains.append(projectors[-1] @ np.linalg.pinv(jacobian))
    total = np.linalg.inv(sum(projectors[1:], projectors[0]))
    spread = sum(g @ c @ g.mT for g, c in zip(gains, covariances))
    return np.asarray(total @ spread @ total.mT)


def working_volume(cameras: tuple[Camera, ...], steps: int = 5) -> Array:
    """Return points (steps^3, 3) in mm of a cubic grid round the rig's origin."""
    field = min(min(c.image_size_px) / c["scale_px_per_mm"] for c in cameras)
    axis = np.linspace(-0.5, 0.5, steps) * VOLUME_SHARE * field
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)


def rig_jacobian(
    cameras: tuple[Camera, ...], free: tuple[tuple[str, ...], ...], points_mm: Array
) -> Array:
    """Return the derivative of points' pixels with respect to the parameters of the rig.

    free : for each of the C cameras the names of its free intrinsics.
    points_mm : (..., 3) in the rig frame.

    Returns (..., 2C, P) in px per unit of each parameter. The P parameters are the free intrinsics
    of all cameras, then the pose (rotation, translation) of each camera but the first.
    """
    lens = np.cumsum([0, *map(len, free)])
    out = np.zeros((*points_mm.shape[:-1], 2 * len(cameras), lens[-1] + 6 * (len(cameras) - 1)))
    for c, camera in enumerate(cameras):
        rows = out[..., 2 * c : 2 * c + 2, :]
        in_camera = camera.camera_from_rig.apply(points_mm.reshape(-1, 3)).reshape(points_mm.shape)
        names = [INDEX[name] for name in free[c]]
        _, by_point, rows[..., lens[c] : lens[c + 1]] = camera.pixel_jacobians(in_camera, names)
        if c:
            at = lens[-1] + 6 * (c - 1)
            rows[..., at : at + 6] = np.concatenate([by_point @ hat(in_camera), -by_point], -1)
    return out


def aligned_covariance(
    cameras: tuple[Camera, ...],
    free: tuple[tuple[str, ...], ...],
    covariance: Array,
    points_mm: Array,
) -> Array:
    """Return the covariance (3 N, 3 N) in mm^2 of N triangulated points due to the calibration.

    Rigid motions are projected out as in `aligned_shift`.

    free : as in `rig_jacobian`.
    points_mm : (N, 3) in the rig frame.
    covariance : (P, P) of the P parameters of the rig, in the order of `rig_jacobian`.
    """
    inner = aligned_shift(cameras, free, points_mm)
    return np.asarray(inner @ covariance @ inner.T)


def aligned_shift(
    cameras: tuple[Camera, ...], free: tuple[tuple[str, ...], ...], points_mm: Array
) -> Array:
    """Return the derivative (3 N, P) of N triangulated points, without their common rigid motion.

    The derivative is that of `point_shift_jacobian`, with equal noise of all pixels. A motion that
    is common to all points is projected out, because the place of the rig frame is a matter of
    definition (Baarda's S-transformation to the points' own frame). The result describes errors of
    shapes, distances and motions inside the rig.

    free : as in `rig_jacobian`. points_mm : (N, 3) in the rig frame.
    """
    rows = 2 * len(cameras)
    information = np.broadcast_to(np.eye(rows), (len(points_mm), rows, rows))
    shift = point_shift_jacobian(cameras, free, points_mm, information)
    shift = shift.reshape(-1, shift.shape[-1])
    centred = points_mm - points_mm.mean(0)
    motion = np.concatenate([np.tile(np.eye(3), (len(points_mm), 1, 1)), -hat(centred)], -1)
    basis, _ = np.linalg.qr(motion.reshape(-1, 6))
    return np.asarray(shift - basis @ (basis.T @ shift))


def point_shift_jacobian(
    cameras: tuple[Camera, ...],
    free: tuple[tuple[str, ...], ...],
    points_mm: Array,
    information_px: Array,
) -> Array:
    """Return the derivative (..., 3, P) of triangulated points by the P parameters of the rig.

    free, points_mm : as in `rig_jacobian`, which also gives the order of the parameters.
    information_px : (..., 2C, 2C) inverse covariance of the pixels in C cameras, in 1/px^2.
    """
    _, by_point = stacked_jacobian(cameras, points_mm)
    weighted = np.swapaxes(by_point, -1, -2) @ information_px
    by_rig = rig_jacobian(cameras, free, points_mm)
    return np.asarray(-np.linalg.solve(weighted @ by_point, weighted @ by_rig), np.float64)
