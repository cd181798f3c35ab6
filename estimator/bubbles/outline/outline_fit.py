"""Sub-pixel outlines: maximum-likelihood fit of ellipse and harmonics to the pixels at the rim.

The pixels along the rims of all bubbles are gathered first, without glare and dirt. The model of a
pixel is ``outer + (inner - outer) F``, with F the profile of a blurred disc (`rim_profile`) at the
pixel's distance from the outline and the ellipse's curvature there. A straight edge blurred by a
Gaussian is an error function. Where the blur is not small against the radius of curvature the
profile is shifted inwards and skewed; with the osculating circle in place of the outline it is a
function of two numbers only, tabulated here.

The outline is an ellipse with normal displacements of orders 3 to 6 in the eccentric anomaly. In
that parametrisation the centre is orthogonal to the harmonics (b cos phi / h times cos k phi,
integrated along the arc h dphi, is zero), so fitting them costs a whole outline nothing. Where a
part is hidden it does, and the harmonics of the frame's whole outlines serve as prior.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
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
    moved,
    rough_distance,
    spread,
    turned_harmonics,
)
from telerig.statistics import NORMAL_FROM_MEDIAN

_OCTANTS = 8
_UNLIKE_SHARE, _UNLIKE_SIGMA = 0.015, 3.0
_MARGIN_SIGMA = 0.9
_REACH_SIGMA, _REACH_PX = 3.2, 1.2
_THIN_ABOVE_PX = 10.0


@dataclass(frozen=True)
class Pixels:
    """Hold the N pixels at the rims of B bubbles, one bubble after the other.

    owner : (N,) number of the bubble to which the pixel belongs, from 0.
    counts : (B,) number of pixels of each bubble.
    origin : (B, 2) pixel (u, v) near each bubble's centre.
    u, v : (N,) positions of the pixels relative to ``origin`` (px), so that single precision is
        sufficient.
    value : (N,) grey levels divided by the background.
    """

    owner: Index
    counts: Index
    origin: Array
    u: Float32
    v: Float32
    value: Float32

    @property
    def bubbles(self) -> int:
        """Return the number B of bubbles."""
        return int(self.counts.size)

    def parts(self) -> Iterator[slice]:
        """Yield for each bubble the slice of its pixels."""
        edges = np.concatenate([[0], np.cumsum(self.counts)]).tolist()
        return (slice(low, high) for low, high in itertools.pairwise(edges))

    def sums(self, values: Float32) -> Array:
        """Return the sums (B,) of values (N,) over the pixels of each bubble."""
        weights = values.astype(np.float64)
        return np.bincount(self.owner, weights, self.bubbles).astype(np.float64)

    def of(self, kept: Bools) -> tuple[Pixels, Index]:
        """Return the pixels of the bubbles that are kept (B,), and their positions (M,)."""
        places = np.flatnonzero(kept[self.owner])
        counts = self.counts[kept]
        owner = np.repeat(np.arange(counts.size), counts)
        own = (values.take(places) for values in (self.u, self.v, self.value))
        return Pixels(owner, counts, self.origin[kept], *own), places

    def local(self, ellipse: Array) -> Array:
        """Return ellipses (B, 5) with their centres relative to ``origin``."""
        moved = ellipse.copy()
        moved[:, :2] -= self.origin
        return moved

    def hidden(self, ellipse: Array, everyone: Array, reach_px: Array, own: Index) -> Bools:
        """Return (N,) whether each pixel lies inside or near the ellipse of another bubble.

        ellipse : (B, 5) ellipses of the bubbles of these pixels.
        everyone : (A, 5) ellipses of all bubbles in the image.
        reach_px : (A,) distance (px) from each of these up to which a pixel is near it.
        own : (B,) positions of the B bubbles in ``everyone``.
        """
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
    """Find pairs of ellipses that may be near each other.

    ellipse : (B, 5) ellipses; everyone : (A, 5) ellipses with which they are compared.
    reach_px, reach_everyone_px : (B,), (A,) widths (px) of the surroundings of each ellipse.
    own : (B,) positions of the B ellipses in ``everyone``; these pairs are left out.

    Returns pairs (position in ``ellipse``, position in ``everyone``).
    """
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
    """Gather the pixels near the rims of B ellipses.

    ratio : (rows, columns) grey levels divided by the background.
    ellipse : (B, 5) ellipses.
    sigma : (B,) blur of the edges (px); pixels up to about three times this distance are taken.
    slack_px : (B,) additional distance (px).
    thin : whether to take only one pixel in four for ellipses with b above 10 px.
    """
    reach = _REACH_SIGMA * sigma + _REACH_PX + slack_px
    step = np.where(thin & (ellipse[:, 3] > _THIN_ABOVE_PX), 2, 1)
    origin = np.round(ellipse[:, :2])
    local = ellipse.copy()
    local[:, :2] -= origin
    edges = np.stack([-origin, np.array(ratio.shape[::-1]) - 1 - origin])
    extent = np.hypot(local[:, 2] * np.sin(local[:, 4]), local[:, 3] * np.cos(local[:, 4])) + reach
    top = np.maximum(np.ceil((local[:, 1] - extent) / step), np.ceil(edges[0, :, 1] / step))
    bottom = np.minimum(np.floor((local[:, 1] + extent) / step), np.floor(edges[1, :, 1] / step))
    bubble, row = _ranges(top, bottom)
    local, reach, step, edges = local[bubble], reach[bubble], step[bubble], edges[:, bubble, 0]
    left, right = _chord(local, reach, row * step)
    inner_left, inner_right = _chord(local, -reach, row * step)
    first = np.maximum(np.ceil(np.stack([left, inner_right]) / step), np.ceil(edges[0] / step))
    until = np.stack([np.minimum(inner_left, right), right])
    last = np.minimum(np.floor(until / step), np.floor(edges[1] / step))
    first[1] = np.maximum(first[1], last[0] + 1)
    span, column = _ranges(first.T.ravel(), last.T.ravel())
    span //= 2
    owner = bubble[span]
    u, v = (column * step[span]).astype(np.float32), (row * step)[span].astype(np.float32)
    start = (origin[:, 1] * ratio.shape[1] + origin[:, 0]).astype(np.intp)
    place = start[owner] + v.astype(np.intp) * ratio.shape[1] + u.astype(np.intp)
    counts = np.bincount(owner, minlength=len(ellipse))
    return Pixels(owner, counts, origin, u, v, ratio.ravel().take(place))


def _ranges(first: Array, last: Array) -> tuple[Index, Array]:
    """Return the whole numbers from ``first`` to ``last`` (n,) of n ranges, one after the other,
    and before them the number of the range of each."""
    count = np.maximum(last - first + 1, 0).astype(np.intp)
    owner = np.repeat(np.arange(count.size), count)
    begin = np.cumsum(count) - count
    return owner, np.arange(owner.size) - (begin - first)[owner]


def _chord(ellipse: Array, reach_px: Array, v: Array) -> tuple[Array, Array]:
    """Return where rows of pixels enter and leave ellipses whose semi-axes are longer by a reach.

    ellipse : (R, 5); reach_px : (R,), may be negative; v : (R,) rows.

    Returns two arrays (R,) of columns (px); the first is infinite, the second minus infinite,
    where the row misses the ellipse.
    """
    a, b = np.maximum(ellipse[:, 2] + reach_px, 0.0), np.maximum(ellipse[:, 3] + reach_px, 0.0)
    cos, sin = np.cos(ellipse[:, 4]), np.sin(ellipse[:, 4])
    dv = v - ellipse[:, 1]
    height2 = (a * sin) ** 2 + (b * cos) ** 2 + 1e-12
    middle = ellipse[:, 0] + dv * (a * a - b * b) * sin * cos / height2
    square = height2 - dv * dv
    half = a * b * np.sqrt(np.maximum(square, 0.0)) / height2
    missed = (square <= 0.0) | (half <= 0.0)
    return np.where(missed, np.inf, middle - half), np.where(missed, -np.inf, middle + half)


def unlike_rim(
    pixels: Pixels, foot: Foot, distance: Float32, residual: Float32, sigma: Array, contrast: Array
) -> Bools:
    """Find pixels that glare, dirt or a neighbouring bubble has changed.

    pixels, foot : N pixels of B bubbles, and their nearest points on the ellipses.
    distance : (N,) distance from the outline (px), positive outside.
    residual : (N,) measured minus predicted grey level, divided by the noise.
    sigma : (B,) blur of the edges (px).
    contrast : (B,) background level minus the bubble's level, divided by the noise.

    Returns (N,) whether each pixel should be left out. For this, the pixels of each bubble are
    divided into rings of 1 px, inside and outside the outline, and into eight octants. In each
    octant, the pixels are left out from the first ring on that departs from the model: that is
    brighter inside (glare) or darker outside (dirt, neighbour), by more than 1.5 % of the contrast
    and by more than 3 standard deviations of the ring's mean.
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
"""Positions in the vector of the 16 parameters: blur, outer level, inner level, and the first of
the eight harmonics. The first five are the displacements of the ellipse."""
PARAMETERS = FIRST_HARMONIC + 2 * len(HARMONICS)
_RESOLVED_BLURS = 3.0
_BENDING_FROM, _MAX_RETREAT = 0.2, 0.3
_DISTANCE_LIMIT, _DISTANCE_STEP = 5.5, 0.05
_CURVATURE_LIMIT, _CURVATURE_STEP = 1.4, 0.02
_NODES = 96


@dataclass(frozen=True)
class RimState:
    """Hold the outlines of B bubbles during a fit.

    ellipse : (B, 5) ellipses; harmonics : (B, 8) coefficients (px).
    sigma : (B,) standard deviation of the edges' blur, including the pixel (px).
    outer, inner : (B,) grey levels outside and inside the bubble, as shares of the background.
    """

    ellipse: Array
    harmonics: Array
    sigma: Array
    outer: Array
    inner: Array

    def __getitem__(self, index: Index | Bools) -> RimState:
        return RimState(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass(frozen=True)
class Linear:
    """Hold what stays constant while the outlines move a little: the linearisation of the fit.

    foot : nearest points on the ellipses to the N pixels.
    shape : (13, N) derivatives of the outward displacement there by each of the outline's
        parameters (5 of the ellipse, 8 harmonics).
    resolved : (B,) False for bubbles that are too small compared with their blur; their harmonics
        are not fitted.
    bending : (N,) second derivative of the curvature by the arc's length, divided by 8 (1/px^3);
        None if the blur is so small that it does not matter.
    """

    foot: Foot
    shape: Float32
    resolved: Bools
    bending: Float32 | None

    def of(self, kept: Bools, places: Index) -> Linear:
        """Return the linearisation of the bubbles that are kept (B,), with pixels at ``places``."""
        foot = Foot(*(getattr(self.foot, field.name)[..., places] for field in fields(Foot)))
        bending = None if self.bending is None else self.bending[places]
        return Linear(foot, self.shape[:, places], self.resolved[kept], bending)

    def displacements(self, pixels: Pixels, shifts: Array) -> Float32:
        """Return how far (N,) the outline moves outwards at each pixel's foot (px).

        shifts : (B, 13) changes of the outline's parameters since the linearisation (px).
        """
        if not shifts.any():
            return np.zeros(self.shape.shape[1], dtype=np.float32)
        result = np.empty(self.shape.shape[1], dtype=np.float32)
        for part, own in zip(pixels.parts(), shifts.astype(np.float32), strict=True):
            np.matmul(own, self.shape[:, part], out=result[part])
        return result


def linearised(state: RimState, pixels: Pixels) -> Linear:
    """Compute the linearisation at a state: the pixels' feet and the outlines' derivatives.

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
    shape[ELLIPSE_PARAMETERS:] *= spread(gain, pixels.counts)
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


@dataclass(frozen=True)
class Model:
    """Hold what the model predicts for N pixels.

    grey : (N,) grey levels, as shares of the background.
    jacobian : (16, N) their derivatives by the 16 parameters.
    covered : (N,) share of each pixel that the blurred bubble covers, 0 to 1.
    distance : (N,) distance from the outline (px), positive outside.
    """

    grey: Float32
    jacobian: Float32
    covered: Float32
    distance: Float32


def rim_model(state: RimState, pixels: Pixels, linear: Linear, shifts: Array) -> Model:
    """Compute the grey levels that the model predicts for N pixels.

    state, pixels, linear : the outlines' blur and levels, the pixels, and the linearisation.
    shifts : (B, 13) displacements of the outline's parameters since the linearisation (px).

    """
    counts = pixels.counts
    inverse_sigma, contrast, outer = spread(
        np.stack([1.0 / state.sigma, state.inner - state.outer, state.outer]), counts
    )
    from_rim = linear.foot.distance - linear.displacements(pixels, shifts)
    distance = from_rim * inverse_sigma
    if linear.bending is not None:
        limit = spread(_MAX_RETREAT * state.sigma, counts)
        retreat = linear.bending * spread(state.sigma**4, counts)
        distance += np.clip(retreat, -limit, limit) * inverse_sigma
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
    return Model(outer + contrast * profile.value, jacobian, profile.value, from_rim)


def normal_equations(
    jacobian: Float32, residual: Float32, weight: Float32, pixels: Pixels
) -> tuple[Array, Array]:
    """Compute the normal equations of each bubble's fit.

    jacobian : (16, N) derivatives of the grey levels by the bubble's 16 parameters.
    residual : (N,) measured minus predicted grey levels; weight : (N,) inverse variances.

    The sums are in double precision: their rounding errors in single precision exceed the
    information on a bubble of which the image shows little, so that its variances may be negative.

    Returns the information matrices (B, 16, 16) and the right-hand sides (B, 16).
    """
    products = np.empty((pixels.bubbles, PARAMETERS + 1, PARAMETERS + 1))
    root = np.sqrt(weight)
    whitened = np.empty((PARAMETERS + 1, root.size), dtype=np.float32)
    np.multiply(jacobian, root, out=whitened[:PARAMETERS])
    np.multiply(residual, root, out=whitened[PARAMETERS])
    for index, part in enumerate(pixels.parts()):
        own = whitened[:, part].astype(np.float64)
        products[index] = own @ own.T
    return products[:, :PARAMETERS, :PARAMETERS], products[:, :PARAMETERS, PARAMETERS]


@dataclass(frozen=True)
class Profile:
    """Hold the profile of a blurred disc at N places.

    value : (N,) share of the disc's level there, from 0 (far outside) to 1 (deep inside).
    by_distance, by_curvature : (N,) its derivatives. Distance is in units of the blur, curvature in
        units of 1 / blur.
    """

    value: Float32
    by_distance: Float32
    by_curvature: Float32


def blurred_disc(distance: Array, radius: Array) -> Array:
    """Return the share (0 to 1) that a disc covers after a Gaussian blur of standard deviation 1.

    distance : distance of the place from the disc's rim, positive outside, in units of the blur.
    radius : radius of the disc, in units of the blur.

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
    """Look up the profile of a blurred disc in a table.

    distance : (N,) distance from the rim, positive outside, in units of the blur.
    curvature : (N,) curvature of the rim, in units of 1 / blur.

    The table is interpolated bilinearly; the error is at most 1e-4 of the contrast.
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


_LEVEL_SPREAD = 0.3
_FREE, _UNLEARNT, _LEAST, _HELD = 0.25, 0.02, 0.002, 1e-7
"""Prior standard deviations of the harmonics' coefficients, as shares of the radius. The first is
so wide that it does not affect whole outlines. The second holds if there are no whole outlines to
learn from. The third is the least value that is learnt. The last holds harmonics at their start."""

_WIDENED = 1.5
_ENOUGH_WHOLE = 4


def learnt_spread(outlines: Outlines, partial: Bools) -> Array:
    """Return the prior standard deviation of each outline's harmonics.

    outlines : the fitted outlines of B bubbles.
    partial : (B,) whether an outline is partly hidden. Such outlines get a standard deviation that
        is learnt from the frame's whole outlines; the prior of whole outlines has no effect.

    Returns (B,) standard deviations, as shares of the radius.
    """
    whole = outlines.resolved & ~partial
    share = _UNLEARNT
    if np.count_nonzero(whole) >= _ENOUGH_WHOLE:
        radius = np.sqrt(outlines.ellipse[whole, 2] * outlines.ellipse[whole, 3])
        typical = np.median(np.mean((outlines.harmonics[whole] / radius[:, None]) ** 2, axis=1))
        share = max(_WIDENED * float(np.sqrt(typical)), _LEAST)
    return np.where(partial, share, _FREE)


def prior_equations(
    information: Array, pull: Array, state: RimState, shifts: Array, inner: Array, spread: Array
) -> None:
    """Add the prior to the normal equations of B outlines; both are changed in place.

    information, pull : (B, 16, 16) and (B, 16) normal equations.
    state : the outlines; shifts : (B, 13) their displacements since the linearisation (px).
    inner : (B,) expected grey level inside, as a share of the background.
    spread : (B,) prior standard deviation of the harmonics, as a share of the radius.
    """
    level = 1.0 / _LEVEL_SPREAD**2
    information[:, OUTER, OUTER] += level
    information[:, INNER, INNER] += level
    pull[:, OUTER] -= level * (state.outer - 1.0)
    pull[:, INNER] -= level * (state.inner - inner)
    weight = 1.0 / (spread**2 * state.ellipse[:, 2] * state.ellipse[:, 3])
    places = np.arange(FIRST_HARMONIC, information.shape[1])
    information[:, places, places] += weight[:, None]
    gap = np.where((spread <= _HELD)[:, None], 0.0, shifts[:, ELLIPSE_PARAMETERS:])
    pull[:, FIRST_HARMONIC:] -= weight[:, None] * gap


_PIXEL_VARIANCE_PX2 = 1.0 / 12.0
_MIN_SIGMA_PX = 0.3
_OUTLIER_SIGMA = 4.5
_WHOLE = 0.9
_BINS = 32
_STEPS = 3
_FAR_SHIFT_PX, _CONVERGED_PX = 0.25, 0.01
_HIDING_SIGMA = 3.0
_MEAN_SLOPE = 0.35
"""RMS of the unit normal density within one sigma."""


@dataclass(frozen=True)
class Start:
    """Hold the start values of the fits of B outlines.

    ellipse : (B, 5) ellipses; harmonics : (B, 8) coefficients (px).
    blur_px : (B,) standard deviation of the optical blur (px).
    inner : (B,) grey level inside the bubble, as a share of the background.
    sigma_outer, sigma_inner : (B,) standard deviation of a pixel's noise outside and inside the
        bubble, as shares of the background.
    """

    ellipse: Array
    harmonics: Array
    blur_px: Array
    inner: Array
    sigma_outer: Array
    sigma_inner: Array

    def __len__(self) -> int:
        return int(self.ellipse.shape[0])

    def __getitem__(self, index: Index) -> Start:
        return Start(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass(frozen=True)
class Outlines:
    """Hold the fitted outlines of B bubbles.

    ellipse : (B, 5) ellipses.
    harmonics : (B, 8) coefficients (px); they are 0 where ``resolved`` is False.
    resolved : (B,) whether the bubble is large enough, compared with its blur, to fit harmonics.
    sigma_px : (B,) standard deviation of the blur of optics and pixel together (px).
    outer, inner : (B,) grey levels outside and inside, as shares of the background.
    centre_covariance_px2 : (B, 2, 2) covariance of the ellipse's centre (px^2).
    sigma_outline_px : (B,) standard deviation of a harmonic's coefficient (px).
    chi2_dof : (B,) chi-square per degree of freedom.
    coverage : (B,) share of the outline that is visible, 0 to 1.
    misfit_px : (B,) RMS distance between the rim in the image and the outline, beyond the noise
        (px).
    shift_px : (B,) largest displacement since the linearisation (px).
    """

    ellipse: Array
    harmonics: Array
    resolved: Bools
    sigma_px: Array
    outer: Array
    inner: Array
    centre_covariance_px2: Array
    sigma_outline_px: Array
    chi2_dof: Array
    coverage: Array
    misfit_px: Array
    shift_px: Array

    @property
    def blur_px(self) -> Array:
        """Return the blur (B,) of the optics alone (standard deviation, px)."""
        return np.asarray(np.sqrt(np.maximum(self.sigma_px**2 - _PIXEL_VARIANCE_PX2, 0.0)))

    def state(self, index: Index) -> RimState:
        """Return the outlines at the positions ``index`` as the state from which a fit goes on."""
        every = (self.ellipse, self.harmonics, self.sigma_px, self.outer, self.inner)
        return RimState(*(values[index] for values in every))

    def updated(self, index: Index, other: Outlines) -> Outlines:
        """Return a copy with the outlines at the positions ``index`` replaced by ``other``."""
        changed = {}
        for field in fields(self):
            changed[field.name] = getattr(self, field.name).copy()
            changed[field.name][index] = getattr(other, field.name)
        return Outlines(**changed)


def fit_outlines(ratio: Float32, start: Start) -> Outlines:
    """Fit the outlines of B bubbles to an image.

    ratio : (rows, columns) grey levels divided by the background.
    start : start values of the B outlines.

    Pixels inside or near another bubble of ``start`` are left out, and so are glare, dirt and other
    pixels that do not look like a rim. A first fit to some of the pixels yields blur and levels.
    The fit to all pixels is repeated for outlines that moved far or are partly hidden.
    """
    everyone = np.arange(len(start))
    state = RimState(
        start.ellipse,
        start.harmonics,
        np.sqrt(start.blur_px**2 + _PIXEL_VARIANCE_PX2),
        np.ones(len(start)),
        start.inner,
    )
    state = _first_look(ratio, state, start)
    fit = _refined(ratio, state, start, state, everyone, np.full(len(start), _FREE))
    partial = fit.coverage < _WHOLE
    again = np.flatnonzero(partial | (fit.shift_px > _FAR_SHIFT_PX))
    for _ in range(2):
        if again.size == 0:
            break
        prior = learnt_spread(fit, partial)
        near = _refined(
            ratio, fit.state(again), start[again], fit.state(everyone), again, prior[again]
        )
        fit = fit.updated(again, near)
        again = again[near.shift_px > _FAR_SHIFT_PX]
    return fit


def _first_look(ratio: Float32, state: RimState, start: Start) -> RimState:
    """Fit ellipse, blur and levels to some of the pixels in a narrow band at the rim."""
    pixels = rim_pixels(ratio, state.ellipse, state.sigma, _bulge(state), thin=True)
    linear = linearised(state, pixels)
    model = rim_model(state, pixels, linear, _shifts(state))
    depth = np.minimum(2.0 * state.sigma + 0.5, 0.45 * state.ellipse[:, 3])
    lowest, highest = spread(np.stack([-depth, 2.5 * state.sigma + 1.0]), pixels.counts)
    used = (model.distance > lowest) & (model.distance < highest)
    everyone = np.arange(len(start))
    used &= ~pixels.hidden(state.ellipse, state.ellipse, _HIDING_SIGMA * state.sigma, everyone)
    weight = spread(1.0 / start.sigma_outer**2, pixels.counts) * used.astype(np.float32)
    prior = np.full(len(start), _HELD)
    descent = _descend(state, pixels, linear, weight, model, start, prior, steps=2)
    return _moved(descent.state, descent.shifts)


def _bulge(state: RimState) -> Array:
    return np.asarray(np.sum(np.abs(state.harmonics), axis=1))


def _distance(state: RimState, pixels: Pixels, linear: Linear) -> Float32:
    bump = linear.displacements(pixels, _shifts(state))
    return np.asarray(linear.foot.distance - bump, dtype=np.float32)


def _shifts(state: RimState) -> Array:
    return np.concatenate([np.zeros_like(state.ellipse), state.harmonics], axis=1)


@dataclass(frozen=True)
class _Descent:
    """Hold the result of Gauss-Newton steps for B outlines.

    state : the outlines; ``shifts`` are not yet applied to its ellipses.
    shifts : (B, 13) displacements since the linearisation (px).
    covariance : (B, 16, 16) covariance of the parameters.
    residual : (N,) measured minus predicted grey levels, as shares of the background.
    shift_px : (B,) largest of the displacements (px).
    """

    state: RimState
    shifts: Array
    covariance: Array
    residual: Float32
    shift_px: Array


def _refined(
    ratio: Float32,
    state: RimState,
    start: Start,
    everyone: RimState,
    own: Index,
    prior: Array,
) -> Outlines:
    """Fit the outlines of some bubbles with one linearisation.

    state, start : the bubbles to fit; own : their positions in ``everyone``.
    everyone : the outlines of all bubbles in the image.
    prior : (B,) prior standard deviation of the harmonics, as a share of the radius.
    """
    pixels = rim_pixels(ratio, state.ellipse, state.sigma, _bulge(state))
    linear = linearised(state, pixels)
    hidden = pixels.hidden(state.ellipse, everyone.ellipse, _HIDING_SIGMA * everyone.sigma, own)
    model = rim_model(state, pixels, linear, _shifts(state))
    weight = _window(state, pixels, linear, model, start, hidden)
    prior = np.where(linear.resolved, prior, _HELD)
    descent = _descend(state, pixels, linear, weight, model, start, prior, steps=_STEPS)
    return _result(descent, pixels, linear, weight, hidden, start)


def _window(
    state: RimState, pixels: Pixels, linear: Linear, model: Model, start: Start, hidden: Bools
) -> Float32:
    """Return the weights (N,): inverse variances of the pixels, 0 for those that are left out."""
    counts = pixels.counts
    outside, change = start.sigma_outer**2, start.sigma_inner**2 - start.sigma_outer**2
    outside, change, reach = spread(
        np.stack([outside, change, 3.0 * state.sigma + 0.5]), pixels.counts
    )
    inverse = 1.0 / (outside + change * model.covered)
    distance = model.distance
    kept = (np.abs(distance) < reach) & ~hidden
    residual = (pixels.value - model.grey) * np.sqrt(inverse)
    contrast = (state.outer - state.inner) / start.sigma_outer
    kept &= ~unlike_rim(pixels, linear.foot, distance, residual, state.sigma, contrast)
    limit = _OUTLIER_SIGMA * np.maximum(_typical_residual(residual, pixels, kept), 1.0)
    kept &= np.abs(residual) < spread(limit, counts)
    return np.asarray((inverse * kept).astype(np.float32))


def _typical_residual(residual: Float32, pixels: Pixels, kept: Bools) -> Array:
    typical = np.ones(pixels.bubbles)
    for index, part in enumerate(pixels.parts()):
        own = np.abs(residual[part][kept[part]])
        if own.size > 8:
            typical[index] = NORMAL_FROM_MEDIAN * np.partition(own, own.size // 2)[own.size // 2]
    return typical


def _descend(
    state: RimState,
    pixels: Pixels,
    linear: Linear,
    weight: Float32,
    model: Model,
    start: Start,
    prior: Array,
    *,
    steps: int,
) -> _Descent:
    """Do Gauss-Newton steps with the nearest points on the ellipses held fixed.

    model : what the model predicts at ``state``. Only bubbles that have not converged go on.
    """
    first = _shifts(state)
    ended, shifts = RimState(*(values.copy() for values in vars(state).values())), first.copy()
    covariance = np.empty((len(first), PARAMETERS, PARAMETERS))
    residual = np.empty(pixels.u.size, dtype=np.float32)
    active, places = np.arange(len(first)), np.arange(pixels.u.size)
    for index in range(steps):
        state = ended[active]
        if index:
            model = rim_model(state, pixels, linear, shifts[active])
        left = pixels.value - model.grey
        information, pull = normal_equations(model.jacobian, left, weight, pixels)
        prior_equations(
            information, pull, state, shifts[active], start.inner[active], prior[active]
        )
        step, covariance[active] = _solved(information, pull)
        step = _limited(step, state)
        shifts[active] += np.delete(step, (BLUR, OUTER, INNER), axis=1)
        ended.sigma[active] = np.maximum(state.sigma + step[:, BLUR], _MIN_SIGMA_PX)
        ended.outer[active] += step[:, OUTER]
        ended.inner[active] += step[:, INNER]
        going = np.max(np.abs(step[:, :BLUR]), axis=1) >= _CONVERGED_PX
        last = index + 1 == steps or not going.any()
        if last or not going.all():
            for part, own in zip(pixels.parts(), step.astype(np.float32), strict=True):
                left[part] -= own @ model.jacobian[:, part]
            residual[places] = left
        if last:
            break
        if not going.all():
            pixels, kept = pixels.of(going)
            linear, weight = linear.of(going, kept), weight[kept]
            active, places = active[going], places[kept]
    since = np.max(np.abs(shifts - first), axis=1)
    return _Descent(ended, shifts, covariance, residual, since)


def _solved(information: Array, pull: Array) -> tuple[Array, Array]:
    """Solve the normal equations; return the steps (B, 16) and covariances (B, 16, 16)."""
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("bii->bi", information), 1e-12))
    equilibrated = information * scale[:, :, None] * scale[:, None, :]
    diagonal = np.arange(PARAMETERS)
    equilibrated[:, diagonal, diagonal] += 1e-7
    covariance = np.linalg.inv(equilibrated) * scale[:, :, None] * scale[:, None, :]
    step: Array = (covariance @ pull[..., None])[..., 0]
    return step, covariance


def _limited(step: Array, state: RimState) -> Array:
    """Shorten steps (B, 16) so that the linearisation stays valid."""
    reach = np.max(np.abs(step[:, :BLUR]), axis=1)
    share = np.minimum(1.0, np.minimum(1.5, 0.3 * state.ellipse[:, 3]) / (reach + 1e-12))
    share = np.minimum(share, 0.4 * state.sigma / (np.abs(step[:, BLUR]) + 1e-12))
    return np.asarray(step * share[:, None])


def _moved(state: RimState, shifts: Array) -> RimState:
    ellipse, turn = moved(state.ellipse, shifts[:, :BLUR])
    return replace(state, ellipse=ellipse, harmonics=turned_harmonics(shifts[:, BLUR:], turn))


def _coverage(pixels: Pixels, linear: Linear, weight: Float32, sigma: Array) -> Array:
    """Return the share (B,) of each outline at which pixels of the edge were used."""
    close = np.abs(linear.foot.distance) < spread(1.2 * sigma + 0.3, pixels.counts)
    near = np.flatnonzero(close & (weight > 0.0))
    angle = np.arctan2(linear.foot.sin[near], linear.foot.cos[near])
    slot = ((angle + np.pi) * (_BINS / (2.0 * np.pi))).astype(np.intp) % _BINS
    seen = np.bincount(pixels.owner[near] * _BINS + slot, minlength=pixels.bubbles * _BINS)
    return np.asarray(np.mean(seen.reshape(-1, _BINS) > 0, axis=1))


def _misfit(
    state: RimState, pixels: Pixels, linear: Linear, residual: Float32, hidden: Bools, start: Start
) -> Array:
    """Return the RMS distance (B,) between the rim in the image and the outline (px).

    It is the RMS of the grey residuals near the steepest part of the edge, divided by the edge's
    slope. Outliers are included; the variance of the noise is subtracted.
    """
    counts = pixels.counts
    near = np.abs(_distance(state, pixels, linear)) < spread(state.sigma, counts)
    near &= ~hidden
    count = np.maximum(pixels.sums(near.astype(np.float32)), 1.0)
    excess = pixels.sums(near * residual**2) / count - start.sigma_outer**2
    slope = _MEAN_SLOPE * (state.outer - state.inner) / state.sigma
    return np.asarray(np.sqrt(np.maximum(excess, 0.0)) / np.maximum(slope, 1e-9))


def _result(
    descent: _Descent,
    pixels: Pixels,
    linear: Linear,
    weight: Float32,
    hidden: Bools,
    start: Start,
) -> Outlines:
    """Make the public result of the fits.

    Covariances are multiplied by chi2_dof if this exceeds 1 by 3 standard deviations.
    """
    state = _moved(descent.state, descent.shifts)
    fitted = np.where(linear.resolved, PARAMETERS, FIRST_HARMONIC)
    dof = np.maximum(pixels.sums((weight > 0.0).astype(np.float32)) - fitted, 1.0)
    chi2_dof = pixels.sums(weight * descent.residual**2) / dof
    misfit = np.where(chi2_dof > 1.0 + 3.0 * np.sqrt(2.0 / dof), chi2_dof, 1.0)
    covariance = descent.covariance * misfit[:, None, None]
    angle = descent.state.ellipse[:, 4]
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)
    variances = np.einsum("bii->bi", covariance)[:, FIRST_HARMONIC:]
    return Outlines(
        state.ellipse,
        np.where(linear.resolved[:, None], state.harmonics, 0.0),
        linear.resolved,
        state.sigma,
        state.outer,
        state.inner,
        turn @ covariance[:, :2, :2] @ np.swapaxes(turn, 1, 2),
        np.sqrt(np.maximum(np.mean(variances, axis=1), 0.0)),
        chi2_dof,
        _coverage(pixels, linear, weight, state.sigma),
        _misfit(state, pixels, linear, descent.residual, hidden, start),
        descent.shift_px,
    )
