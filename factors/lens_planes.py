"""The lens of `telerig.rig.projection`, component by component, with only what is asked for.

Every array is a plane: one number for each dot of a chunk, (I, m) or, for an intrinsic, (I, 1).
A step that does nothing to any camera (kappa = 0, no distortion, no tilt) is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.factors.image_rows import ImageRows
from telerig.rig import projection, windows
from telerig.rig.projection import INDEX

Array = NDArray[np.float64]
Matrix = tuple[tuple[Array, Array], tuple[Array, Array]]

KAPPA, SCALE, ASPECT, SKEW = (
    INDEX[n] for n in ("kappa_per_mm", "scale_px_per_mm", "aspect", "skew")
)
CU, CV = INDEX["centre_u_px"], INDEX["centre_v_px"]
K1, K2, K3, P1, P2, S1, S2, S3, S4 = range(INDEX["k1"], INDEX["s4"] + 1)
TILT = slice(INDEX["tilt_x"], INDEX["image_convergence_per_mm"] + 1)
WALL = slice(INDEX["wall_x_rad"], INDEX["wall_y_rad"] + 1)


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a chunk's images, and which steps do anything.

    value : 20 planes (I, 1).  rho : (I, 1).  radial : the highest power of r^2 in use, 0 to 3.
    """

    value: Array
    rho: Array
    kappa: bool
    radial: int
    tangential: bool
    prism: bool
    tilt: bool
    affine: bool

    def __getitem__(self, parameter: int) -> Array:
        plane: Array = self.value[parameter]
        return plane


def lens_of(intrinsics: Array, rho_mm: tuple[float, ...], rows: ImageRows) -> Lens:
    """intrinsics : (C, 20)."""
    on = np.any(intrinsics != 0, 0)
    radial = 3 if on[K3] else 2 if on[K2] else 1 if on[K1] else 0
    affine = bool(on[SKEW] or np.any(intrinsics[:, ASPECT] != 1))
    return Lens(
        intrinsics.T[:, rows.camera, None], np.asarray(rho_mm)[rows.camera, None],
        bool(on[KAPPA]), radial, bool(on[P1] or on[P2]), bool(on[S1 : S4 + 1].any()),
        bool(on[TILT].any()), affine,
    )  # fmt: skip


@dataclass(frozen=True)
class Ideal:
    """Ideal coordinates over rho, and what their derivatives need.

    by_depth : 1 / rho / (1 + kappa Z), in air.  by_point : 2 x 3 planes, by_kappa : 2,
    by_turn : 2 x 2, behind glass; None in air.
    """

    x: Array
    y: Array
    by_depth: Array
    by_point: Array | None = None
    by_kappa: Array | None = None
    by_turn: Array | None = None


def ideal(points: Array, lens: Lens, rows: ImageRows, derivatives: bool) -> Ideal:
    """points : (I, 3, m) in the camera's frame."""
    if any(rows.walls):
        return _behind_walls(points, lens, rows, derivatives)
    by_depth = 1 / lens.rho
    if lens.kappa:
        by_depth = by_depth / (1 + lens[KAPPA] * points[:, 2])
    return Ideal(points[:, 0] * by_depth, points[:, 1] * by_depth, by_depth)


def _behind_walls(points: Array, lens: Lens, rows: ImageRows, derivatives: bool) -> Ideal:
    shape = (points.shape[0], points.shape[2])
    xy, by_point = np.empty((2, *shape)), np.empty((2, 3, *shape))
    by_kappa, by_turn = np.zeros((2, *shape)), np.zeros((2, 2, *shape))
    for c, images in rows.cameras:
        wall, intrinsics = rows.walls[c], lens.value[:, images.start, 0]
        in_camera = np.swapaxes(points[images], -1, -2)
        rho, kappa = float(lens.rho[images.start, 0]), float(intrinsics[KAPPA])
        if wall is None:
            depth = 1 / (1 + kappa * in_camera[..., 2])
            xy[:, images] = np.moveaxis(in_camera[..., :2] * depth[..., None], -1, 0) / rho
            by_point[:, :, images] = 0
            by_point[0, 0, images] = by_point[1, 1, images] = depth / rho
            by_point[:, 2, images] = -kappa * depth * xy[:, images]
            by_kappa[:, images] = -in_camera[..., 2] * depth * xy[:, images]
            continue
        stands = projection.standing_wall(intrinsics, wall)
        if not derivatives:
            seen_at = windows.ideal_from_water(in_camera, kappa, stands)
            xy[:, images] = np.moveaxis(seen_at, -1, 0) / rho
            continue
        seen = windows.ideal_jacobians(in_camera, kappa, stands)
        xy[:, images] = np.moveaxis(seen.value, -1, 0) / rho
        by_point[:, :, images] = np.moveaxis(seen.by_point, (-2, -1), (0, 1)) / rho
        by_kappa[:, images] = np.moveaxis(seen.by_kappa, -1, 0) / rho
        turn = seen.by_wall[..., :2] @ wall.turn_jacobian(intrinsics[WALL])
        by_turn[:, :, images] = np.moveaxis(turn, (-2, -1), (0, 1)) / rho
    return Ideal(xy[0], xy[1], 1 / lens.rho, by_point, by_kappa, by_turn)


def distorted(x: Array, y: Array, r2: Array, lens: Lens) -> tuple[Array, Array]:
    """`telerig.rig.distortion.distort`; r2 = x^2 + y^2."""
    xd, yd = x, y
    if lens.radial:
        radial = 1 + _radial(r2, lens)
        xd, yd = x * radial, y * radial
    if lens.tangential:
        p1, p2, twice = lens[P1], lens[P2], 2 * x * y
        xd = xd + p1 * twice + p2 * (r2 + 2 * x * x)
        yd = yd + p1 * (r2 + 2 * y * y) + p2 * twice
    if lens.prism:
        xd = xd + r2 * (lens[S1] + lens[S2] * r2)
        yd = yd + r2 * (lens[S3] + lens[S4] * r2)
    return xd, yd


def _radial(r2: Array, lens: Lens) -> Array:
    out = lens[K1 + lens.radial - 1] * r2
    for k in range(lens.radial - 1, 0, -1):
        out = (out + lens[K1 + k - 1]) * r2
    return out


def distortion_slopes(x: Array, y: Array, r2: Array, lens: Lens) -> Matrix | None:
    """`telerig.rig.distortion.distortion_jacobian`; None where there is no distortion."""
    if not (lens.radial or lens.tangential or lens.prism):
        return None
    xx, xy, yx, yy = np.ones_like(x), 0.0 * x, 0.0 * x, np.ones_like(x)
    if lens.radial:
        slope = 2 * lens[K1]
        if lens.radial > 1:
            slope = slope + r2 * (4 * lens[K2] + (6 * lens[K3] * r2 if lens.radial > 2 else 0.0))
        radial = 1 + _radial(r2, lens)
        across = x * slope
        xx, yy, xy = radial + across * x, radial + slope * (y * y), across * y
        yx = xy
    if lens.tangential:
        one, two = 2 * lens[P1], 2 * lens[P2]
        both = one * x + two * y
        xx, yy = xx + one * y + 3 * two * x, yy + 3 * one * y + two * x
        xy, yx = xy + both, yx + both
    if lens.prism:
        along_x = 2 * (lens[S1] + 2 * lens[S2] * r2)
        along_y = 2 * (lens[S3] + 2 * lens[S4] * r2)
        xx, xy = xx + along_x * x, xy + along_x * y
        yx, yy = yx + along_y * x, yy + along_y * y
    return (xx, xy), (yx, yy)


def tilted(
    x: Array, y: Array, lens: Lens, rows: ImageRows
) -> tuple[tuple[Array, Array], Array, Array]:
    """`telerig.rig.projection.tilt_jacobians` in planes; x and y in mm.

    Returns sensor x and y, (2, 2, I, m) by the coordinates and (2, 3, I, m) by the tilt.
    """
    sensor, by_xy = np.empty((2, *x.shape)), np.empty((2, 2, *x.shape))
    by_tilt = np.empty((2, 3, *x.shape))
    for _, images in rows.cameras:
        flat = np.stack([x[images], y[images]], -1)
        parts = projection.tilt_jacobians(flat, lens.value[:, images.start, 0])
        sensor[:, images] = np.moveaxis(parts[0], -1, 0)
        by_xy[:, :, images] = np.moveaxis(parts[1], (-2, -1), (0, 1))
        by_tilt[:, :, images] = np.moveaxis(parts[2], (-2, -1), (0, 1))
    return (sensor[0], sensor[1]), by_xy, by_tilt


def sensor_xy(x: Array, y: Array, lens: Lens, rows: ImageRows) -> tuple[Array, Array]:
    """Sensor coordinates (mm) of distorted ones (mm)."""
    if not lens.tilt:
        return x, y
    out = np.empty((2, *x.shape))
    for _, images in rows.cameras:
        flat = np.stack([x[images], y[images]], -1)
        moved = projection.sensor_from_distorted(flat, lens.value[:, images.start, 0])
        out[:, images] = np.moveaxis(moved, -1, 0)
    return out[0], out[1]


def coefficient_basis(parameter: int, x: Array, y: Array, r2: Array) -> tuple[Array, Array] | None:
    """What `distorted` is linear in: x and y per unit of one coefficient."""
    if parameter in (K1, K2, K3):
        power = r2 ** (parameter - K1 + 1)
        return x * power, y * power
    if parameter == P1:
        return 2 * x * y, r2 + 2 * y * y
    if parameter == P2:
        return r2 + 2 * x * x, 2 * x * y
    if parameter in (S1, S2):
        return (r2 if parameter == S1 else r2 * r2), np.zeros_like(x)
    if parameter in (S3, S4):
        return np.zeros_like(x), (r2 if parameter == S3 else r2 * r2)
    return None
