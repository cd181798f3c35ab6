"""Grey levels along a bubble's rim and how they change with its outline, blur and levels.

The pixels along the rims of all bubbles are gathered first, without glare and dirt. A straight edge
blurred by a Gaussian is an error function. Where the blur is not small against the radius of
curvature the profile is shifted inwards and skewed; with the osculating circle in place of the
outline it is a function of two numbers only, tabulated here.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from telerig.arrays import Array, Bools, Float32
from telerig.estimator.bubbles.outline.ellipse_geometry import (
    ELLIPSE_PARAMETERS,
    HARMONICS,
    Foot,
    Index,
    ellipse_basis,
    foot_points,
    harmonic_basis,
    rough_distance,
    spread,
)

_OCTANTS = 8
_UNLIKE_SHARE, _UNLIKE_SIGMA = 0.015, 3.0
_MARGIN_SIGMA = 0.9
_REACH_SIGMA, _REACH_PX = 3.2, 1.2
_THIN_ABOVE_PX = 10.0


@dataclass(frozen=True)
class Pixels:
    """Pixels (N,) of B bubbles, one bubble after the other: ``owner``, place and value.

    ``u`` and ``v`` count from ``origin`` (B, 2), a pixel near the bubble's centre, so that single
    precision serves; ``counts`` (B,) says how many are whose.
    """

    owner: Index
    counts: Index
    origin: Array
    u: Float32
    v: Float32
    value: Float32

    @property
    def bubbles(self) -> int:
        """How many bubbles."""
        return int(self.counts.size)

    def parts(self) -> Iterator[slice]:
        """The slice of each bubble."""
        edges = np.concatenate([[0], np.cumsum(self.counts)]).tolist()
        return (slice(low, high) for low, high in itertools.pairwise(edges))

    def sums(self, values: Float32) -> Array:
        """Sum (B,) of values (N,) over each bubble."""
        weights = values.astype(np.float64)
        return np.bincount(self.owner, weights, self.bubbles).astype(np.float64)

    def local(self, ellipse: Array) -> Array:
        """Ellipses (B, 5) with their centres counted from ``origin``."""
        moved = ellipse.copy()
        moved[:, :2] -= self.origin
        return moved

    def hidden(self, ellipse: Array, everyone: Array, reach_px: Array, own: Index) -> Bools:
        """Pixels (N,) within ``reach_px`` (A,) of, or inside, any of the ellipses ``everyone``
        (A, 5) that is not their own, number ``own`` (B,) of these."""
        hidden = np.zeros(self.owner.size, dtype=np.bool_)
        parts = list(self.parts())
        for index, other in close_pairs(ellipse, everyone, reach_px[own], reach_px, own):
            part = parts[index]
            shifted = everyone[other].copy()
            shifted[:2] -= self.origin[index]
            gap = rough_distance(shifted, self.u[part], self.v[part])
            hidden[part] |= gap < reach_px[other]
        return hidden


def close_pairs(
    ellipse: Array, everyone: Array, reach_px: Array, reach_everyone_px: Array, own: Index
) -> list[tuple[int, int]]:
    """Pairs (of B, of A) of ellipses whose surroundings may meet; ``own`` (B,) is left out."""
    size, other_size = ellipse[:, 2] + 2.0 * reach_px, everyone[:, 2] + 2.0 * reach_everyone_px
    gap = np.hypot(
        ellipse[:, None, 0] - everyone[None, :, 0], ellipse[:, None, 1] - everyone[None, :, 1]
    )
    near = gap < size[:, None] + other_size[None, :]
    near[np.arange(own.size), own] = False
    return [(int(i), int(j)) for i, j in np.argwhere(near)]


def rim_pixels(
    ratio: Float32, ellipse: Array, sigma: Array, slack_px: Array, *, thin: bool = False
) -> Pixels:
    """Pixels of ``ratio`` within 3 sigma and ``slack_px`` (B,) of the ellipses (B, 5).

    ``thin``: one in two, one in four round large bubbles.
    """
    reach = _REACH_SIGMA * sigma + _REACH_PX + slack_px
    columns = ratio.shape[1]
    cos, sin = np.cos(ellipse[:, 4]), np.sin(ellipse[:, 4])
    a, b = ellipse[:, 2], ellipse[:, 3]
    half = np.stack([np.hypot(a * cos, b * sin), np.hypot(a * sin, b * cos)], axis=1)
    half += reach[:, None]
    size = ratio.shape[::-1]
    low = np.clip(np.ceil(ellipse[:, :2] - half), 0, size).astype(np.intp)
    high = np.clip(np.floor(ellipse[:, :2] + half) + 1, 0, size).astype(np.intp)
    origin = np.round(ellipse[:, :2])
    step = np.where(thin & (b > _THIN_ABOVE_PX), 2, 1)
    rings = [
        _ring(
            ellipse[k],
            origin[k],
            np.arange(low[k, 0], high[k, 0], step[k]),
            np.arange(low[k, 1], high[k, 1], step[k]),
            float(reach[k]),
        )
        for k in range(len(ellipse))
    ]
    counts = np.array([len(ring[0]) for ring in rings], dtype=np.intp)
    u, v = (np.concatenate([ring[k] for ring in rings]) for k in (0, 1))
    start = (origin[:, 1] * columns + origin[:, 0]).astype(np.intp)
    place = np.repeat(start, counts)
    place += v.astype(np.intp) * columns + u.astype(np.intp)
    owner = np.repeat(np.arange(counts.size), counts)
    return Pixels(owner, counts, origin, u, v, ratio.ravel().take(place))


def _ring(
    ellipse: Array, origin: Array, columns: Index, rows: Index, reach: float
) -> tuple[Float32, Float32]:
    """Places (n,), counted from ``origin``, of the pixels within ``reach`` of one ellipse."""
    local = ellipse.copy()
    local[:2] -= origin
    u = (columns - origin[0]).astype(np.float32)
    v = (rows - origin[1]).astype(np.float32)
    cos, sin = np.cos(local[4]), np.sin(local[4])
    du, dv = (u - np.float32(local[0]))[None, :], (v - np.float32(local[1]))[:, None]
    a, b = local[2], local[3]
    x = du * np.float32(cos / a) + dv * np.float32(sin / a)
    y = dv * np.float32(cos / b) - du * np.float32(sin / b)
    x *= x
    y *= y
    square = x + y
    x *= np.float32(1.0 / a**2)
    y *= np.float32(1.0 / b**2)
    x += y
    # |g - 1| g / |grad| < reach, with square = g^2 and x = |grad|^2 / 4
    level = np.sqrt(square)
    near = np.flatnonzero((np.abs(level - 1.0) * level) < np.float32(reach) * np.sqrt(x))
    row = near // max(u.size, 1)
    return u.take(near - row * u.size), v.take(row)


def unlike_rim(
    pixels: Pixels, foot: Foot, distance: Float32, residual: Float32, sigma: Array, contrast: Array
) -> Bools:
    """Pixels (N,) at and beyond the first ring that departs from the model, in each octant.

    Rings are one pixel wide. Inside, a departure towards bright is glare; outside, one towards
    dark is dirt or a neighbour. ``residual`` is in units of the noise, ``contrast`` (B,) too. A
    ring counts when its mean is off by 1.5 % of the contrast and by 3 sigma of its own error.
    """
    depth = np.abs(distance)
    rings = int(np.max(depth, initial=0.0)) + 2
    octant = (foot.cos > 0) * np.intp(4)
    octant += (foot.sin > 0) * np.intp(2)
    octant += np.abs(foot.cos) > np.abs(foot.sin)
    sector = (pixels.owner * _OCTANTS + octant) * 2 + (distance > 0)
    shape = (pixels.bubbles * _OCTANTS * 2, rings)
    key = sector * rings + depth.astype(np.intp)
    count = np.bincount(key, minlength=shape[0] * rings).reshape(shape)
    total = np.bincount(key, weights=residual, minlength=shape[0] * rings).reshape(shape)
    side = np.tile(np.array([1.0, -1.0]), pixels.bubbles * _OCTANTS)[:, None]
    mean = side * total / np.maximum(count, 1)
    limit = _UNLIKE_SHARE * np.repeat(contrast, _OCTANTS * 2)[:, None]
    first_ring = 1.3 * np.repeat(sigma, _OCTANTS * 2)[:, None]
    off = (mean > limit) & (mean * np.sqrt(count) > _UNLIKE_SIGMA) & (count > 1)
    off &= np.arange(rings) >= first_ring
    cut = np.where(np.any(off, axis=1), np.argmax(off, axis=1), rings).astype(np.float32)
    return np.asarray(depth > cut.take(sector) - spread(_MARGIN_SIGMA * sigma, pixels.counts))


BLUR, OUTER, INNER, FIRST_HARMONIC = 5, 6, 7, 8
"""Places in the parameter vector; before BLUR the five displacements of the ellipse."""
PARAMETERS = FIRST_HARMONIC + 2 * len(HARMONICS)
_RESOLVED_BLURS = 3.0
_BENDING_FROM, _MAX_RETREAT = 0.2, 0.3
_DISTANCE_LIMIT, _DISTANCE_STEP = 5.5, 0.05
_CURVATURE_LIMIT, _CURVATURE_STEP = 1.4, 0.02
_NODES = 96


@dataclass(frozen=True)
class RimState:
    """Outlines of B bubbles: ``ellipse`` (B, 5), ``harmonics`` (B, 8), and the edges' ``sigma``
    [px], ``outer`` and ``inner`` levels (B,)."""

    ellipse: Array
    harmonics: Array
    sigma: Array
    outer: Array
    inner: Array


@dataclass(frozen=True)
class Linear:
    """What stays while outlines move a little: the pixels' feet, and the outward displacement
    ``shape`` (13, N) there by each parameter of the outline. Harmonics of bubbles that are not
    ``resolved`` (B,), too small against their blur, are not to be fitted. ``bending`` (N,) is the
    curvature's second derivative along the arc over 8, where the blur makes it matter."""

    foot: Foot
    shape: Float32
    resolved: Bools
    bending: Float32 | None

    def displacements(self, pixels: Pixels, shifts: Array) -> Float32:
        """Outward displacement (N,) of the outline at each pixel's foot for shifts (B, 13)."""
        result = np.empty(self.shape.shape[1], dtype=np.float32)
        for part, own in zip(pixels.parts(), shifts.astype(np.float32), strict=True):
            np.matmul(own, self.shape[:, part], out=result[part])
        return result


def linearised(state: RimState, pixels: Pixels) -> Linear:
    """Feet and displacements at the state's ellipses.

    Blur damps an outline's wave of order k against a shift (k = 1) by I_k / I_1 of Bessel's
    functions, nearly exp(-(k^2 - 1) sigma^2 / (2 R^2)).
    """
    foot = foot_points(pixels.local(state.ellipse), pixels.counts, pixels.u, pixels.v)
    order = np.repeat(np.array(HARMONICS, dtype=np.float64), 2)
    square = state.sigma**2 / (state.ellipse[:, 2] * state.ellipse[:, 3])
    gain = np.exp(-(order[:, None] ** 2 - 1.0) * square / 2.0)
    shape = np.empty((ELLIPSE_PARAMETERS + order.size, pixels.u.size), dtype=np.float32)
    ellipse_basis(foot, shape[:ELLIPSE_PARAMETERS])
    shape[ELLIPSE_PARAMETERS:] = harmonic_basis(foot.cos, foot.sin)
    for index, part in enumerate(pixels.parts()):
        shape[ELLIPSE_PARAMETERS:, part] *= gain[:, index : index + 1].astype(np.float32)
    sharpest = state.ellipse[:, 2] / state.ellipse[:, 3] ** 2
    bent = bool(np.any(sharpest * state.sigma > _BENDING_FROM))
    resolved = state.ellipse[:, 3] > _RESOLVED_BLURS * state.sigma
    return Linear(foot, shape, resolved, _bending(state, pixels, foot) if bent else None)


def _bending(state: RimState, pixels: Pixels, foot: Foot) -> Float32:
    """Second derivative of the curvature by the arc's length, over 8.

    Across the blur an arc runs at -(K y^2 / 2 + (K'' + 3 K^3) y^4 / 24) from its tangent, a circle
    of the same curvature at K'' = 0; the mean of y^4 is 3 sigma^4, so the blurred edge retreats
    by K'' sigma^4 / 8.
    """
    a, b = state.ellipse[:, 2], state.ellipse[:, 3]
    product, gap = spread(np.stack([a * b, a * a - b * b]), pixels.counts)
    square = foot.speed * foot.speed
    turn = gap * (foot.cos * foot.cos - foot.sin * foot.sin)
    slope = gap * foot.sin * foot.cos
    bending: Float32 = (
        -0.375 * product * (turn - 6.0 * slope * slope / square) / (square**3 * foot.speed)
    )
    return bending


def rim_model(
    state: RimState, pixels: Pixels, linear: Linear, shifts: Array
) -> tuple[Float32, Float32, Float32]:
    """Grey (N,), its Jacobian (16, N) and the share F (N,) of the bubble's own level.

    ``shifts`` (B, 13): displacements of the outline since the linearisation.
    """
    counts = pixels.counts
    inverse_sigma, contrast, outer = spread(
        np.stack([1.0 / state.sigma, state.inner - state.outer, state.outer]), counts
    )
    distance = linear.foot.distance - linear.displacements(pixels, shifts)
    if linear.bending is not None:
        limit = spread(_MAX_RETREAT * state.sigma, counts)
        retreat = linear.bending * spread(state.sigma**4, counts)
        distance += np.clip(retreat, -limit, limit)
    distance *= inverse_sigma
    curvature = linear.foot.curvature / inverse_sigma
    profile = rim_profile(distance, curvature)
    slope = contrast * inverse_sigma
    jacobian = np.empty((PARAMETERS, pixels.u.size), dtype=np.float32)
    np.multiply(curvature, profile.by_curvature, out=jacobian[BLUR])
    jacobian[BLUR] -= profile.by_distance * distance
    jacobian[BLUR] *= slope
    slope *= -profile.by_distance
    np.multiply(linear.shape[:ELLIPSE_PARAMETERS], slope, out=jacobian[:ELLIPSE_PARAMETERS])
    np.multiply(linear.shape[ELLIPSE_PARAMETERS:], slope, out=jacobian[FIRST_HARMONIC:])
    np.subtract(1.0, profile.value, out=jacobian[OUTER])
    jacobian[INNER] = profile.value
    return outer + contrast * profile.value, jacobian, profile.value


def normal_equations(
    jacobian: Float32, residual: Float32, weight: Float32, pixels: Pixels
) -> tuple[Array, Array]:
    """Information (B, 16, 16) and pull (B, 16) of weighted residuals (N,)."""
    information = np.empty((pixels.bubbles, PARAMETERS, PARAMETERS))
    pull = np.empty((pixels.bubbles, PARAMETERS))
    root = np.sqrt(weight)
    whitened, gap = jacobian * root, residual * root
    for index, part in enumerate(pixels.parts()):
        own = whitened[:, part]
        information[index] = own @ own.T
        pull[index] = own @ gap[part]
    return information, pull


@dataclass(frozen=True)
class Profile:
    """Share of the disc's light ``value`` at each place, with derivatives by distance and by
    curvature (both in units of the blur)."""

    value: Float32
    by_distance: Float32
    by_curvature: Float32


def blurred_disc(distance: Array, radius: Array) -> Array:
    """Coverage of a disc after a unit Gaussian blur, ``distance`` outside its rim.

    The chord integral int phi(y) [Phi(c - r) - Phi(-c - r)] dy with c^2 = R^2 - y^2, by
    Gauss-Legendre quadrature. Shapes broadcast.
    """
    from scipy.special import ndtr

    node, weight = np.polynomial.legendre.leggauss(_NODES)
    radius, distance = np.asarray(radius)[..., None], np.asarray(distance)[..., None]
    reach = np.minimum(radius, 7.0)
    angle = np.arcsin(np.minimum(reach / radius, 1.0)) * node
    y = radius * np.sin(angle)
    sagitta = 2.0 * radius * np.sin(angle / 2.0) ** 2
    density = np.exp(-(y**2) / 2.0) / np.sqrt(2.0 * np.pi) * radius * np.cos(angle)
    density = density * np.arcsin(np.minimum(reach / radius, 1.0)) * weight
    near, far = -distance - sagitta, -2.0 * radius - distance + sagitta
    return np.asarray(np.sum(density * (ndtr(near) - ndtr(far)), axis=-1))


@lru_cache(maxsize=1)
def _table() -> tuple[Float32, int]:
    from scipy.special import ndtr

    t = np.arange(-_DISTANCE_LIMIT, _DISTANCE_LIMIT + _DISTANCE_STEP / 2, _DISTANCE_STEP)
    q = np.arange(_CURVATURE_STEP, _CURVATURE_LIMIT + _CURVATURE_STEP / 2, _CURVATURE_STEP)
    rows = [ndtr(-t), *(blurred_disc(t, np.full(1, 1.0 / value)) for value in q)]
    return np.stack(rows).astype(np.float32).ravel(), t.size


def rim_profile(distance: Float32, curvature: Float32) -> Profile:
    """Profile at signed ``distance`` outside a rim of ``curvature``, both (N,) in units of blur.

    Bilinear in the table: good to 1e-4 of the contrast.
    """
    table, columns = _table()
    x = np.clip(distance, -_DISTANCE_LIMIT, _DISTANCE_LIMIT - 1e-3)
    x += _DISTANCE_LIMIT
    x *= 1.0 / _DISTANCE_STEP
    y = np.clip(curvature, 0.0, _CURVATURE_LIMIT - 1e-3)
    y *= 1.0 / _CURVATURE_STEP
    column, row = x.astype(np.intp), y.astype(np.intp)
    x -= column.astype(np.float32)
    y -= row.astype(np.float32)
    row *= columns
    row += column
    low_low, low_slope = table.take(row), table.take(row + 1)
    row += columns
    high_low, high_slope = table.take(row), table.take(row + 1)
    low_slope -= low_low
    high_slope -= high_low
    low_low += x * low_slope
    high_low += x * high_slope
    high_low -= low_low
    high_slope -= low_slope
    high_slope *= y
    low_slope += high_slope
    low_slope *= 1.0 / _DISTANCE_STEP
    low_low += y * high_low
    high_low *= 1.0 / _CURVATURE_STEP
    return Profile(low_low, low_slope, high_low)
