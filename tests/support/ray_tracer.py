"""Brute force: where a camera behind plane glass sees a point in water. No code of telerig.

Units: mm, px; indices are dimensionless. Everything is in the camera's frame (x right, y down, z
away from the camera). All arithmetic is scalar, in decimals of 60 digits, so that what is returned
is right to the last bits of a double (and the same on every platform).

Two methods, which meet only in the description of the camera:

- "fermat": the two crossing points move over the faces of the glass until the optical length of the
  path is least. Only the length itself is written down: its slopes are differences.
- "snell": the ray is shot from the point. What Snell's law keeps along the whole ray is n sin(angle
  to the normal), a vector in the wall's plane; it is sought such that the ray is one the camera
  takes.

A camera takes the rays towards its centre of perspective (0, 0, -1 / kappa), for kappa = 0 those
along z. For kappa < 0 (hypercentric) the centre lies behind the scene, and the rays come as if from
it. From a point in air the camera is n times the function `_to_camera` away, up to a constant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Context, Decimal, InvalidOperation, localcontext
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Vector = tuple[Decimal, ...]
Method = Literal["fermat", "snell"]

DISTORTION = ("k1", "k2", "k3", "p1", "p2", "s1", "s2", "s3", "s4")
PARAMETERS = {
    "scale_px_per_mm": None, "aspect": 1.0, "skew": 0.0, "centre_u_px": 0.0, "centre_v_px": 0.0,
    "kappa_per_mm": 0.0, "rho_mm": None, "tilt_x": 0.0, "tilt_y": 0.0,
    "image_convergence_per_mm": 0.0,
} | dict.fromkeys(DISTORTION, 0.0)  # fmt: skip
WALL = ("normal", "distance_mm", "thickness_mm", "indices")

_ARITHMETIC = Context(prec=60)
_SHORT, _LONG = Decimal("1e-25"), Decimal("1e-20")  # steps of the first and second differences
_STILL = Decimal("1e-18")
_DOWN = Decimal(0), Decimal(1), Decimal(0)
_AXIS = Decimal(0), Decimal(0), Decimal(1)
_NO_RAY = "no ray from the point to the camera"


@dataclass(frozen=True)
class Ray:
    """The light's way to the camera.

    points_mm : (M + 1, 3), the point itself and its crossings of the M faces before it, towards the
        camera. indices : (M + 1,), of the medium that the light goes into there, the last of air.
    direction : (3,), unit vector in air, towards the camera.
    """

    points_mm: Array
    indices: Array
    direction: Array


def trace_pixels(
    camera: Mapping[str, Any],
    wall: Mapping[str, Any],
    points_mm: ArrayLike,
    method: Method = "fermat",
) -> Array:
    """(N, 3) points in the camera's frame (mm) -> (N, 2) pixels.

    camera : `PARAMETERS` by their names in telerig.rig.projection (those left out are
        ideal), `rho_mm` where there is distortion, and, instead of centre_u_px and
        centre_v_px, `centre_px` (u, v) if you like. No pose.
    wall : `normal` (3,) of either sign and any length; `distance_mm` from the camera frame's origin
        along its z axis to the face on the camera's side (negative: that face is at z < 0);
        `thickness_mm`; `indices` (camera's side, glass, behind it).

    A point within the glass passes one face, one on the camera's side none.
    ValueError: unknown or missing keys, numbers that are not finite, a point that looks to be at or
    behind the centre of perspective (in water by "fermat" alone), that centre (kappa > 0) not on
    the camera's side of the wall, or no ray.
    """
    with localcontext(_ARITHMETIC):
        lens, glass = _camera(camera), _wall(wall)
        points = np.asarray(points_mm, float).reshape(-1, 3)
        paths = (_path(lens, glass, _decimals(point), method) for point in points)
        return _floats([_pixel(lens, path[-1]) for path in paths]).reshape(-1, 2)


def trace_ray(
    camera: Mapping[str, Any],
    wall: Mapping[str, Any],
    point_mm: ArrayLike,
    method: Method = "fermat",
) -> Ray:
    """The way of the light from one point (3,); arguments as in `trace_pixels`."""
    with localcontext(_ARITHMETIC):
        lens, glass = _camera(camera), _wall(wall)
        point = _decimals(point_mm)
        path = _path(lens, glass, point, method)
        indices = [n for _, n in glass.layers(point)] + [glass.air]
        away = _unit(_away_from_camera(lens, path[-1]))
        return Ray(_floats(path), _floats(indices), -_floats(away))


# ---- the things


@dataclass(frozen=True)
class _Wall:
    """Faces n.x = height from the camera's side on; `across` are two unit vectors in the wall."""

    normal: Vector
    across: tuple[Vector, Vector]
    near: Decimal
    thickness: Decimal
    air: Decimal
    glass: Decimal
    water: Decimal

    def layers(self, point: Vector) -> list[tuple[Decimal, Decimal]]:
        """(thickness, index) of what lies between the point and the air, from the point on."""
        depth = _dot(self.normal, point) - self.near
        if depth <= 0:
            return []
        if depth <= self.thickness:
            return [(depth, self.glass)]
        return [(depth - self.thickness, self.water), (self.thickness, self.glass)]


def _wall(wall: Mapping[str, Any]) -> _Wall:
    if set(wall) != set(WALL):
        raise ValueError(f"a wall has the keys {WALL}, not {tuple(wall)}")
    normal = _unit(_decimals(wall["normal"]))
    if normal[2] < 0:
        normal = tuple(-c for c in normal)
    if normal[2] < Decimal("1e-3"):
        raise ValueError("the camera looks along the wall")
    air, glass, water = _decimals(wall["indices"])
    distance, thickness = _decimals([wall["distance_mm"], wall["thickness_mm"]])
    if thickness <= 0 or min(air, glass, water) <= 0:
        raise ValueError("thickness and indices must be positive")
    first = _unit(_cross(normal, _DOWN))
    across = (first, _cross(normal, first))
    return _Wall(normal, across, normal[2] * distance, thickness, air, glass, water)


def _camera(camera: Mapping[str, Any]) -> dict[str, Decimal]:
    given = dict(camera)
    if "centre_px" in given:
        given["centre_u_px"], given["centre_v_px"] = given.pop("centre_px")
    unknown = set(given) - set(PARAMETERS)
    if unknown:
        raise ValueError(f"unknown parameters of a camera: {sorted(unknown)}")
    if any(given.get(name, 0) for name in DISTORTION) and "rho_mm" not in given:
        raise ValueError("distortion needs rho_mm")
    values = {k: v for k, v in PARAMETERS.items() if v is not None} | {"rho_mm": 1.0} | given
    if "scale_px_per_mm" not in values:
        raise ValueError("scale_px_per_mm is missing")
    return dict(zip(values, _decimals(list(values.values()))))


# ---- the camera


def _pixel(camera: Mapping[str, Decimal], point: Vector) -> Vector:
    """Pixel of a point in air: perspective, distortion, tilted sensor, affine map."""
    depth = 1 + camera["kappa_per_mm"] * point[2]
    if depth <= 0:
        raise ValueError("a point at or behind the centre of perspective")
    rho = camera["rho_mm"]
    x, y = _distorted(camera, point[0] / depth / rho, point[1] / depth / rho)
    x, y = _on_tilted_sensor(camera, x * rho, y * rho)
    scale = camera["scale_px_per_mm"]
    u = scale * x + scale * camera["skew"] * y + camera["centre_u_px"]
    return u, scale * camera["aspect"] * y + camera["centre_v_px"]


def _distorted(c: Mapping[str, Decimal], x: Decimal, y: Decimal) -> Vector:
    """OpenCV's documentation of its camera model, term by term."""
    r2 = x**2 + y**2
    radial = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3
    tangential = (
        2 * c["p1"] * x * y + c["p2"] * (r2 + 2 * x**2),
        c["p1"] * (r2 + 2 * y**2) + 2 * c["p2"] * x * y,
    )
    prism = c["s1"] * r2 + c["s2"] * r2**2, c["s3"] * r2 + c["s4"] * r2**2
    return x * radial + tangential[0] + prism[0], y * radial + tangential[1] + prism[1]


def _on_tilted_sensor(camera: Mapping[str, Decimal], x: Decimal, y: Decimal) -> Vector:
    """Where the line through (x, y, 0) meets the plane z = q.x, in that plane's own coordinates.

    The line comes from (0, 0, -1 / w), for w = 0 along z. The plane's axes are those of z = 0
    turned about their common line, so lengths along the slope q are longer than they look.
    """
    q = camera["tilt_x"], camera["tilt_y"]
    away = 1 - camera["image_convergence_per_mm"] * _dot(q, (x, y))
    if away <= 0:
        raise ValueError("outside what the tilted sensor sees")
    x, y = x / away, y / away
    slope = _length(q)
    if not slope:
        return x, y
    up = q[0] / slope, q[1] / slope
    level = -up[1], up[0]
    climbed = _length((_dot(up, (x, y)), _dot(q, (x, y)))).copy_sign(_dot(up, (x, y)))
    aside = _dot(level, (x, y))
    return climbed * up[0] + aside * level[0], climbed * up[1] + aside * level[1]


def _to_camera(camera: Mapping[str, Decimal], b: Vector) -> Decimal:
    """Length from b to the wavefront of the camera's rays that passes through its origin (mm).

    The distance to the centre of perspective less 1 / kappa, free of cancellation: z for kappa = 0.
    """
    kappa = camera["kappa_per_mm"]
    depth = 1 + kappa * b[2]
    if depth <= 0:
        raise InvalidOperation
    across = b[0] ** 2 + b[1] ** 2
    return (kappa * across + 2 * b[2] + kappa * b[2] ** 2) / (
        (kappa**2 * across + depth**2).sqrt() + 1
    )


def _away_from_camera(camera: Mapping[str, Decimal], b: Vector) -> Vector:
    kappa = camera["kappa_per_mm"]
    return kappa * b[0], kappa * b[1], 1 + kappa * b[2]


# ---- the path


def _path(
    camera: Mapping[str, Decimal], wall: _Wall, point: Vector, method: Method
) -> list[Vector]:
    """The point and its crossings, in the light's order; the last of them is in air."""
    kappa = camera["kappa_per_mm"]
    layers = wall.layers(point)
    if not layers:
        return [point]
    if kappa > 0 and -wall.normal[2] >= kappa * wall.near:
        raise ValueError("the centre of perspective is not on the camera's side of the wall")
    try:
        return _METHODS[method](camera, wall, point, layers)
    except (InvalidOperation, np.linalg.LinAlgError) as error:
        raise ValueError(_NO_RAY) from error


def _fermat(
    camera: Mapping[str, Decimal],
    wall: _Wall,
    point: Vector,
    layers: Sequence[tuple[Decimal, Decimal]],
) -> list[Vector]:
    """Unknown: two shifts (mm, within the wall) at each face, from where the axis leads there."""
    feet, foot = [], point
    for thickness, _ in layers:
        foot = _moved(foot, _AXIS, -thickness / wall.normal[2])
        feet.append(foot)

    def crossings(shifts: Vector) -> list[Vector]:
        pairs = zip(shifts[::2], shifts[1::2])
        return [
            _moved(_moved(f, wall.across[0], s), wall.across[1], t)
            for f, (s, t) in zip(feet, pairs)
        ]

    def optical_length(shifts: Vector) -> Decimal:
        path = [point, *crossings(shifts)]
        legs = sum(
            n * _length(_moved(b, a, Decimal(-1))) for a, b, (_, n) in zip(path, path[1:], layers)
        )
        return legs + wall.air * _to_camera(camera, path[-1])

    def slopes(shifts: Vector) -> Vector:
        up, down = (
            [optical_length(_nudged(shifts, i, h)) for i in range(len(shifts))]
            for h in (_SHORT, -_SHORT)
        )
        return tuple((a - b) / (2 * _SHORT) for a, b in zip(up, down))

    found = _root(slopes, (Decimal(0),) * (2 * len(layers)))
    curvature = _matrix(slopes, found, slopes(found))
    if np.linalg.eigvalsh((curvature + curvature.T) / 2)[0] <= 0:
        raise ValueError("no shortest path: it looks to be behind the centre of perspective")
    return [point, *crossings(found)]


def _snell(
    camera: Mapping[str, Decimal],
    wall: _Wall,
    point: Vector,
    layers: Sequence[tuple[Decimal, Decimal]],
) -> list[Vector]:
    """Unknown: n sin(angle), the part of the ray within the wall, the same in all media."""

    def cosine(n: Decimal, sines: Vector) -> Decimal:
        return (n**2 - _dot(sines, sines)).sqrt()

    def shot(sines: Vector) -> list[Vector]:
        path = [point]
        for thickness, n in layers:
            ahead = thickness / cosine(n, sines)
            path.append(_moved(path[-1], within(n, sines), ahead))
        return path

    def within(n: Decimal, sines: Vector) -> Vector:
        ray = tuple(-cosine(n, sines) * c for c in wall.normal)
        return _moved(_moved(ray, wall.across[0], sines[0]), wall.across[1], sines[1])

    def miss(sines: Vector) -> Vector:
        ray, wanted = within(wall.air, sines), _away_from_camera(camera, shot(sines)[-1])
        return ray[0] * wanted[2] - ray[2] * wanted[0], ray[1] * wanted[2] - ray[2] * wanted[1]

    slow = min([wall.air, *(n for _, n in layers)])
    start = tuple(-slow * _dot(_AXIS, axis) for axis in wall.across)
    return shot(_root(miss, start))


_METHODS = {"fermat": _fermat, "snell": _snell}


# ---- numbers


def _root(f: Callable[[Vector], Vector], start: Vector) -> Vector:
    """Newton's method; its matrix of differences is solved in doubles, which only slows it."""
    at, value = start, f(start)
    for _ in range(60):
        step = _decimals(np.linalg.solve(_matrix(f, at, value), _floats(value)))
        if _length(step) < _STILL:
            return _moved(at, step, Decimal(-1))
        at, value = _shortened(f, at, step, _length(value))
    raise ValueError(_NO_RAY)


def _shortened(
    f: Callable[[Vector], Vector], at: Vector, step: Vector, bound: Decimal
) -> tuple[Vector, Vector]:
    """The first of at - step, at - step / 2, ... where f exists and |f| < bound; and f there."""
    for halvings in range(60):
        trial = _moved(at, step, -1 / Decimal(2**halvings))
        try:
            value = f(trial)
        except InvalidOperation:
            continue
        if _length(value) < bound:
            return trial, value
    raise ValueError(_NO_RAY)


def _matrix(f: Callable[[Vector], Vector], at: Vector, value: Vector) -> Array:
    """Derivatives of f by forward differences: column i by the i-th variable."""
    return _floats(
        [
            tuple((a - b) / _LONG for a, b in zip(f(_nudged(at, i, _LONG)), value))
            for i in range(len(at))
        ]
    ).T


def _nudged(at: Vector, which: int, by: Decimal) -> Vector:
    return (*at[:which], at[which] + by, *at[which + 1 :])


def _decimals(values: ArrayLike) -> Vector:
    numbers = np.asarray(values, float)
    if not np.all(np.isfinite(numbers)):
        raise ValueError(f"finite numbers are needed, not {values!r}")
    return tuple(Decimal(v) for v in numbers.tolist())


def _floats(values: Sequence[Decimal] | Sequence[Vector]) -> Array:
    return np.array(values, object).astype(float)


def _dot(a: Vector, b: Vector) -> Decimal:
    return sum((x * y for x, y in zip(a, b)), Decimal(0))


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _length(a: Vector) -> Decimal:
    return _dot(a, a).sqrt()


def _unit(a: Vector) -> Vector:
    length = _length(a)
    if not length:
        raise ValueError("a direction of length zero")
    return tuple(x / length for x in a)


def _moved(a: Vector, direction: Vector, by: Decimal) -> Vector:
    return tuple(x + by * d for x, d in zip(a, direction))
