"""Models refraction at a plane window (a glass wall) between a camera and the water.

The window is given in the camera's frame: its near face meets the camera's axis at
``distance_mm``. Let d be the unit direction of a ray in air, n the normal of the window and
T = d - (n.d) n the part of d along the window. By Snell's law this part keeps its direction and is
multiplied by the ratio of the refractive indices. Per mm of travel along n the ray therefore moves
sideways by T m / sqrt(1 - m^2 T.T), where m is n_air / n_glass in the glass (m_g) and
n_air / n_water in the water (m_w); see Born and Wolf, Principles of Optics, 1.5. A point X in the
water, at the height h = n.X - (n.X of the far face) above the window, lies on the ray that enters
the glass at H when

    X = H + (thickness + h) n + A T,   A = thickness m_g / sqrt(...) + h m_w / sqrt(...).

For kappa = 0 all rays have the same T, and this is an affine map in closed form. Otherwise the ray
is found by Newton's method. Points in front of the window are treated as if the water extended to
them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.errors import GeometryError

_STEPS = 60
_WEAK = 1e-3
"""If kappa times the distance is below this value, the affine map is a good enough start for
Newton's method."""


@dataclass(frozen=True)
class Wall:
    """A plane window in the camera's frame.

    normal : (3,) unit vector that points away from the camera (z > 0).
    distance_mm : from the camera's origin to where its axis meets the near face.
    indices : refractive indices on the camera's side, of the glass, and behind it.
    normal_sigma_rad : prior standard deviation of the normal.
    """

    normal: Array
    distance_mm: float
    thickness_mm: float
    indices: tuple[float, float, float]
    normal_sigma_rad: float = 0.0

    @property
    def ratios(self) -> tuple[float, float]:
        """Ratios of refractive indices: camera's side to glass, camera's side to tank's side."""
        return self.indices[0] / self.indices[1], self.indices[0] / self.indices[2]

    @property
    def near_mm(self) -> float:
        """The value of n.X for all points X of the near face."""
        return float(self.normal[2] * self.distance_mm)

    def turned(self, tangent: Array) -> Wall:
        """Return the window with a normal turned by ``tangent`` (2,) rad in its `tangent_basis`."""
        if not np.any(tangent):
            return self
        normal = self.normal + tangent_basis(self.normal) @ np.asarray(tangent, float)
        return replace(self, normal=normal / np.linalg.norm(normal))

    def turn_jacobian(self, tangent: Array) -> Array:
        """Return the derivative (2, 2) of the turned normal, in its `tangent_basis`."""
        turned, length = self.turned(tangent), float(np.sqrt(1 + np.sum(np.square(tangent))))
        return np.asarray(tangent_basis(turned.normal).T @ tangent_basis(self.normal) / length)

    def as_dict(self) -> dict[str, Any]:
        """Return the window in the form in which it is written to calibration.json."""
        return {
            "normal": [float(v) for v in self.normal],
            "distance_mm": self.distance_mm,
            "thickness_mm": self.thickness_mm,
            "indices": list(self.indices),
            "normal_sigma_deg": float(np.degrees(self.normal_sigma_rad)),
        }

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Wall:
        """Return the window of `as_dict`; KeyError, TypeError or ValueError for other contents."""
        normal = np.array(data["normal"], float).reshape(3)
        if not (0 < np.linalg.norm(normal) < np.inf and normal[2] > 0):
            raise ValueError("the normal of a window has no direction away from the camera (z > 0)")
        air, glass, behind = (float(n) for n in data["indices"])
        if not min(air, glass, behind) > 0:
            raise ValueError("a refractive index of a window is not positive")
        return Wall(
            normal / np.linalg.norm(normal), float(data["distance_mm"]),
            float(data["thickness_mm"]), (air, glass, behind),
            float(np.radians(data["normal_sigma_deg"])),
        )  # fmt: skip


@dataclass(frozen=True)
class IdealPrediction:
    """Telecentric coordinates (..., 2) of points in water, in mm, and their derivatives.

    by_point : (..., 2, 3), by_kappa : (..., 2), by_wall : (..., 2, 3); the last with respect to the
        two tangents of `Wall.turned` and to the distance.
    """

    value: Array
    by_point: Array
    by_kappa: Array
    by_wall: Array


@dataclass(frozen=True)
class _Rays:
    """Rays in air and in the water, with the symbols of the module's docstring.

    entry : (..., 3) H.
    direction : (..., 3) in air, not normalised.
    along : (...) n.d.
    tangential : (..., 3) T.
    spread, slope : (...) A and dA / d(T.T).
    water : (...) m_w / sqrt(1 - m_w^2 T.T).
    reached : (..., 3) the point that the ray reaches in the water.
    """

    entry: Array
    direction: Array
    along: Array
    tangential: Array
    spread: Array
    slope: Array
    water: Array
    reached: Array


def tangent_basis(normal: Array) -> Array:
    """Return two orthonormal vectors (3, 2) along the window: x and y for a normal along z."""
    x, y, z = normal
    f = 1 / (1 + z)
    return np.array([[1 - f * x * x, -f * x * y], [-f * x * y, 1 - f * y * y], [-x, -y]])


def affine_map(wall: Wall) -> tuple[Array, Array]:
    """Return matrix (2, 3) and offset (2,) in mm from points in water to telecentric coordinates.

    The map is exact for kappa = 0.
    """
    tangential = _tangential_of_axis(wall)
    glass, water = (_sideways(m, 1 - wall.normal[2] ** 2) for m in wall.ratios)
    by_height = (wall.normal + water * tangential)[:2]
    by_thickness = (wall.normal + glass * tangential)[:2]
    matrix = np.eye(2, 3) - np.outer(by_height, wall.normal)
    offset = (wall.near_mm + wall.thickness_mm) * by_height - wall.thickness_mm * by_thickness
    return matrix, offset


def ideal_from_water(points_mm: Array, kappa: float, wall: Wall) -> Array:
    """Return the telecentric coordinates (..., 2) in mm of points (..., 3) in water.

    They are the x and y at which the point's ray in air, prolonged without refraction if need be,
    crosses the plane z = 0 of the camera's frame. Raises GeometryError for points that no ray
    reaches.
    """
    matrix, offset = affine_map(wall)
    ideal = points_mm @ matrix.T + offset
    if kappa == 0:
        return np.asarray(ideal)
    if abs(kappa) * np.max(np.linalg.norm(points_mm, axis=-1), initial=0.0) > _WEAK:
        ideal = _start(points_mm, kappa, wall)
    for _ in range(_STEPS):
        rays = _refract(ideal, points_mm, kappa, wall)
        by_ideal, _ = _ray_jacobians(ideal, rays, kappa, wall)
        miss = (rays.reached - points_mm)[..., :2]
        step = np.linalg.solve(by_ideal[..., :2, :], miss[..., None])[..., 0]
        ideal = ideal - step
        size = np.abs(step).max(initial=0.0)
        if not size > 1e-12 * max(1.0, np.abs(ideal).max(initial=0.0)):
            break
    if not np.all(np.isfinite(ideal)) or size > 1e-9 * max(1.0, np.abs(ideal).max(initial=0.0)):
        raise _unreached()
    return np.asarray(ideal)


def ideal_jacobians(points_mm: Array, kappa: float, wall: Wall) -> IdealPrediction:
    """Return `ideal_from_water` and its derivatives, by the implicit function theorem."""
    ideal = ideal_from_water(points_mm, kappa, wall)
    rays = _refract(ideal, points_mm, kappa, wall)
    by_ideal, by_kappa = _ray_jacobians(ideal, rays, kappa, wall)
    by_point = (wall.normal + rays.water[..., None] * rays.tangential)[..., None] * wall.normal
    by_point = by_point - np.eye(3)
    by_wall = _wall_jacobian(rays, points_mm, wall)
    moved = np.concatenate([by_point, by_kappa[..., None], by_wall], -1)[..., :2, :]
    gain = -np.linalg.solve(by_ideal[..., :2, :], moved)
    return IdealPrediction(ideal, gain[..., :3], gain[..., 3], gain[..., 4:])


def water_from_ideal(ideal_mm: Array, kappa: float, wall: Wall) -> tuple[Array, Array]:
    """Return the rays in water, in the camera's frame, of telecentric coordinates (..., 2).

    Returns the origins (..., 3), where the ray in water, extended backwards in a straight line,
    crosses depth 0, and the unit directions (..., 3). Raises GeometryError for total reflection and
    for rays that never meet the window.
    """
    entry, direction, along = _enter(ideal_mm, kappa, wall)
    tangential = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    tangential = tangential - along[..., None] * wall.normal
    tau = (tangential**2).sum(-1)
    to_glass, to_water = wall.ratios
    glass = _sideways(to_glass, tau)[..., None]
    leaving = entry + wall.thickness_mm * (wall.normal + glass * tangential)
    straight = np.sqrt(1 - to_water**2 * tau)[..., None]
    bent = to_water * tangential + straight * wall.normal
    return np.asarray(leaving - (leaving[..., 2:] / bent[..., 2:]) * bent), bent


def _sideways(ratio: float, tau: Array) -> Array:
    """Return m / sqrt(1 - m^2 T.T) for tau = T.T (...): mm sideways along T per mm along n.

    Raises GeometryError for total reflection.
    """
    inside = 1 - ratio**2 * np.asarray(tau)
    if not np.all(inside > 0):
        raise GeometryError(
            "a ray is totally reflected at the glass wall",
            todo="check the wall's normal and the order of its indices in rig.toml: camera's side, "
            "glass, behind",
        )
    return np.asarray(ratio / np.sqrt(inside))


def _tangential_of_axis(wall: Wall) -> Array:
    return np.asarray(np.array([0.0, 0.0, 1.0]) - wall.normal[2] * wall.normal)


def air_rays(ideal_mm: Array, kappa: float) -> tuple[Array, Array]:
    """Return origins (..., 3) at depth 0 and directions (kappa x, kappa y, 1) of rays in air."""
    shape = (*ideal_mm.shape[:-1], 1)
    origin = np.concatenate([ideal_mm, np.zeros(shape)], -1)
    return origin, np.concatenate([kappa * ideal_mm, np.ones(shape)], -1)


def _enter(ideal: Array, kappa: float, wall: Wall) -> tuple[Array, Array, Array]:
    """Return where rays meet the near face (..., 3), their directions (..., 3), and n.d (...)."""
    origin, direction = air_rays(ideal, kappa)
    normal_part = direction @ wall.normal
    if not np.all(normal_part > 0):
        raise _unreached()
    travel = (wall.near_mm - origin @ wall.normal) / normal_part
    length = np.linalg.norm(direction, axis=-1)
    return origin + travel[..., None] * direction, direction, normal_part / length


def _refract(ideal: Array, points: Array, kappa: float, wall: Wall) -> _Rays:
    """Return the rays, and where they reach the height of the given points (..., 3)."""
    entry, direction, along = _enter(ideal, kappa, wall)
    unit = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    tangential = unit - along[..., None] * wall.normal
    tau = (tangential**2).sum(-1)
    height = points @ wall.normal - wall.near_mm - wall.thickness_mm
    glass, water = (_sideways(m, tau) for m in wall.ratios)
    spread = wall.thickness_mm * glass + height * water
    slope = (wall.thickness_mm * glass**3 + height * water**3) / 2
    reached = entry + (wall.thickness_mm + height)[..., None] * wall.normal
    reached = reached + spread[..., None] * tangential
    return _Rays(entry, direction, along, tangential, spread, slope, water, reached)


def _ray_jacobians(ideal: Array, rays: _Rays, kappa: float, wall: Wall) -> tuple[Array, Array]:
    """Return derivatives of the reached points by coordinates (..., 3, 2) and kappa (..., 3)."""
    normal, length = wall.normal, np.linalg.norm(rays.direction, axis=-1)
    unit = rays.direction / length[..., None]
    along_ray = np.eye(3) - unit[..., None] * normal / rays.along[..., None, None]
    tangential = rays.tangential
    by_unit = rays.spread[..., None, None] * (np.eye(3) - np.outer(normal, normal))
    by_unit = by_unit + (2 * rays.slope)[..., None, None] * (
        tangential[..., :, None] * tangential[..., None, :]
    )
    unit_by_direction = np.eye(3) - unit[..., :, None] * unit[..., None, :]
    by_direction = rays.entry[..., 2, None, None] * along_ray
    by_direction = by_direction + by_unit @ unit_by_direction / length[..., None, None]
    by_ideal = along_ray[..., :2] + kappa * by_direction[..., :2]
    return by_ideal, np.einsum("...ij,...j->...i", by_direction[..., :2], ideal)


def _wall_jacobian(rays: _Rays, points: Array, wall: Wall) -> Array:
    """Return the derivative (..., 3, 3) of (reached point minus point) by tangents and distance."""
    normal, basis = wall.normal, tangent_basis(wall.normal)
    unit = rays.direction / np.linalg.norm(rays.direction, axis=-1, keepdims=True)
    near = wall.distance_mm * basis[2]
    height = points @ basis - near
    travel = (near - rays.entry @ basis) / rays.along[..., None]
    along = unit @ basis
    grown = -2 * rays.slope[..., None] * rays.along[..., None] * along
    grown = grown + rays.water[..., None] * height
    turned = along[..., None, :] * normal[:, None] + rays.along[..., None, None] * basis
    by_normal = (
        unit[..., :, None] * travel[..., None, :]
        + normal[:, None] * height[..., None, :]
        + (points @ normal - wall.near_mm)[..., None, None] * basis
        + rays.tangential[..., :, None] * grown[..., None, :]
        - rays.spread[..., None, None] * turned
    )
    by_near = unit / rays.along[..., None] - normal - rays.water[..., None] * rays.tangential
    return np.concatenate([by_normal, normal[2] * by_near[..., None]], -1)


def _start(points: Array, kappa: float, wall: Wall) -> Array:
    """Return telecentric coordinates (..., 2) in mm from which `ideal_from_water` converges.

    points : (..., 3) in mm, in water, in the camera's frame.
    kappa : residual perspective in 1/mm, not 0.

    Each ray lies in the plane through the perspective centre, the point and the window's normal n.
    Let q be the tangent of the angle between the ray in air and n, t the thickness of the glass, h
    the height of the point above the far face of the window, and r the distance of the point from
    the line along n through the perspective centre (all in mm). Then

        kappa r = D q + kappa (t tan(angle in the glass) + h tan(angle in the water)),

    with D = n_z + kappa wall.near_mm, where n_z is the z component of n. D / kappa is the distance
    of the perspective centre from the near face, along n. The right side increases with q, and it
    is concave (kappa > 0) or convex (kappa < 0), so Newton's method from q = 0 always converges.

    Raises GeometryError for points that no ray of the camera reaches.
    """
    normal = wall.normal
    depth = normal[2] + kappa * wall.near_mm
    height = points @ normal - wall.near_mm - wall.thickness_mm
    away = kappa * (points - (points @ normal)[..., None] * normal) + _tangential_of_axis(wall)
    radius = np.linalg.norm(away, axis=-1)
    weights = ((wall.ratios[0], kappa * wall.thickness_mm), (wall.ratios[1], kappa * height))
    q = np.zeros_like(radius)
    for _ in range(_STEPS):
        value, slope = depth * q - radius, np.full_like(q, depth)
        for ratio, weight in weights:
            inside = 1 + q**2 * (1 - ratio**2)
            value = value + weight * ratio * q / np.sqrt(inside)
            slope = slope + weight * ratio / inside**1.5
        if not np.all(slope > 0):
            raise _unreached()
        step = value / slope
        q = q - step
        if np.abs(step).max(initial=0.0) < 1e-9:
            break
    aside = away / np.where(radius > 0, radius, 1.0)[..., None]
    direction = normal + q[..., None] * aside
    if not np.all(direction[..., 2] > 0):
        raise _unreached()
    return np.asarray(direction[..., :2] / direction[..., 2:] / kappa)


def _unreached() -> GeometryError:
    return GeometryError(
        "a point behind a glass wall is out of the camera's reach: no ray of the camera meets it",
        todo="check the wall's distance_mm and normal in rig.toml, and use points in front of the "
        "camera only",
    )
