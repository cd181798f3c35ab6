"""Compiled loops over the pixels at the rims, and over the points of arcs.

They work on one bubble after the other, in double precision: for a bubble of which the image shows
little, the smallest eigenvalue of the equilibrated normal equations is below the rounding error of
sums in single precision. The ellipses and their parameters are those of `ellipse_geometry`, the
model is that of `outline_fit`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Float32, Ints
from telerig.compiled import compiled
from telerig.estimator.bubbles.outline import ellipse_geometry
from telerig.statistics import NORMAL_FROM_MEDIAN

ELLIPSE = 5
"""Displacements of an ellipse: centre along both axes, a, b, and the shear between the axes."""

BLUR, OUTER, INNER, FIRST_HARMONIC = 5, 6, 7, 8
"""Positions in the vector of the 16 parameters: blur, outer level, inner level, and the first of
the eight harmonics. The first five are the displacements of the ellipse."""
PARAMETERS = 16
OUTLINE = ELLIPSE + PARAMETERS - FIRST_HARMONIC
"""Parameters of an outline: those of its ellipse and its harmonics."""

DISTANCE_LIMIT, DISTANCE_STEP = 5.5, 0.05
CURVATURE_LIMIT, CURVATURE_STEP = 1.4, 0.02
"""Range and step of the profile's table, in units of the blur; its error is below 1e-3."""

RESOLVED_BLURS = 3.0
"""An outline has harmonics if its minor semi-axis is so many times the blur."""
PIXEL_VARIANCE_PX2 = 1.0 / 12.0

_LEAST_SIGMA_PX = 0.3
"""Half of a pixel's width: no image has a sharper edge."""
_OCTANTS, _SECTORS = 8, 16
_HALF_OCTANT = np.tan(np.pi / 8.0)
_UNLIKE_SHARE, _UNLIKE_FROM, _MARGIN_SIGMA = 0.015, 1.3, 0.9
"""A ring of pixels is unlike a rim beyond this share of the contrast, outside so many blurs; what
lies so much nearer is left out, too."""
_BEYOND_CHANCE = 3.0
"""Standard deviations beyond which a mean is no chance."""
_THIN_ABOVE_PX = 10.0
"""Semi-axis above which the first look takes every second row and column."""
_BENDING_FROM, _MAX_RETREAT = 0.2, 0.3
"""Blur times a over b squared below which the change of curvature has no effect, and the retreat,
in blurs, up to which the series holds."""
_WINDOW_SIGMA, _WINDOW_PX = 3.0, 0.5
"""The window of the fit: what lies within three blurs and half a pixel shows the edge."""
_OUTLIER_SIGMA = 4.5
_FIRST_STEPS = 2
_LEVEL_SPREAD = 0.3
"""Prior standard deviation of both grey levels: the screen's is 1."""
_CONVERGED_PX = 0.01
_TILE = 4
"""Rows whose products are summed at once, so that each value is read once for four of them."""
_BINS = 32
_FOOT_ROUNDS = 2
_OFF_CENTRE = 1e-9
"""The centre of a circle is nearest to no point of it: that much beside it, in units of a."""
_RIDGE = 1e-7
"""Added to the equilibrated normal equations, so that they can always be solved."""
_MEAN_SLOPE = 0.35
"""RMS of the unit normal density within one sigma."""
_UNEVEN_LIGHT = np.pi / 4.0
"""Light that is uneven by a share of the contrast moves a rim by sqrt(pi / 2) times that and the
blur, and the centre by half of the variance (found on rendered swarms)."""

_POINT_SIGMA_PX, _FAR_PX = 0.2, 0.6
"""Scatter of an arc's points, and the distance at which the weight of one is halved."""
_ROUND_SHARE, _ARC_ROUNDS = 0.12, 8
"""Prior standard deviation of a - b as a share of the radius: arcs of half an ellipse are usual."""


class Outlines(NamedTuple):
    """Hold the outlines of B bubbles.

    ellipse : (B, 5) ellipses.
    harmonics : (B, 8) coefficients (px); 0 where they are not resolved.
    sigma_px : (B,) standard deviation of the blur of optics and pixel together (px).
    outer, inner : (B,) grey levels outside and inside, as shares of the background.

    What a fit has shown of them:
    covariance_px2 : (B, 2, 2) covariance of the ellipse's centre (px^2).
    sigma_outline_px : (B,) standard deviation of a harmonic's coefficient (px), NaN if the bubble
        is too small for its blur to have harmonics.
    chi2_dof : (B,) chi-square per degree of freedom.
    coverage : (B,) share of the outline that is visible, 0 to 1.
    misfit_px : (B,) RMS distance between the rim in the image and the outline, beyond the noise.
    shift_px : (B,) largest displacement since the linearisation (px).
    """

    ellipse: Array
    harmonics: Array
    sigma_px: Array
    outer: Array
    inner: Array
    covariance_px2: Array
    sigma_outline_px: Array
    chi2_dof: Array
    coverage: Array
    misfit_px: Array
    shift_px: Array


class Prior(NamedTuple):
    """Hold what is known of B outlines before the fit.

    inner : (B,) mean of the grey level inside.
    harmonics : (B, 4) standard deviation of the coefficients of each order, as a share of the
        radius.
    flattening : (B, 2) mean of (a - b) / (a + b) times cosine and sine of twice the angle.
    flattening_spread : (B,) standard deviation of both; infinite for none.
    """

    inner: Array
    harmonics: Array
    flattening: Array
    flattening_spread: Array


rough_distance = compiled(ellipse_geometry.rough_distance)
harmonic_basis = compiled(ellipse_geometry.harmonic_basis)


@compiled
def products(rows: Array, used: int, total: Array) -> None:
    """Write into the lower triangle of ``total`` (n, n) the products of all pairs of n rows.

    rows : (n, N); the products are summed over the first ``used`` columns.
    """
    n = rows.shape[0]
    for i in range(n):
        j = 0
        while j <= i:
            if j + _TILE <= n:
                a = b = c = d = 0.0
                for k in range(used):
                    value = rows[i, k]
                    a += value * rows[j, k]
                    b += value * rows[j + 1, k]
                    c += value * rows[j + 2, k]
                    d += value * rows[j + 3, k]
                total[i, j], total[i, j + 1], total[i, j + 2], total[i, j + 3] = a, b, c, d
            else:
                for m in range(j, i + 1):
                    a = 0.0
                    for k in range(used):
                        a += rows[i, k] * rows[m, k]
                    total[i, m] = a
            j += _TILE


@compiled
def feet(ellipse: Array, u: Array, v: Array, foot: Array) -> None:
    """Find the nearest points on an ellipse (its feet).

    ellipse : (5,)
    u, v : (N,) pixels of the points.
    foot : (7, N) receives the cosine and the sine of the foot's eccentric anomaly, the distance of
        the point from the ellipse (px, positive outside), the length (px) of the derivative of the
        ellipse's point by the anomaly, the curvature there (1/px), and the outward unit normal
        along the major and the minor axis.

    Iteration by the evolute's centre of curvature: no trigonometry, two rounds are exact to
    1e-4 px near the outline of an ellipse of axis ratio 2.
    """
    a, b = ellipse[2], ellipse[3]
    turn_cos, turn_sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    u0, v0 = ellipse[0], ellipse[1]
    per_a, per_b = 1.0 / a, 1.0 / b
    gap = a * a - b * b
    focal_a, focal_b = gap * per_a * per_a, gap * per_b * per_b
    for k in range(u.size):
        x = (u[k] - u0) * turn_cos + (v[k] - v0) * turn_sin
        y = (v[k] - v0) * turn_cos - (u[k] - u0) * turn_sin
        x_unit, y_unit = x * per_a + _OFF_CENTRE, y * per_b
        scale = 1.0 / np.sqrt(x_unit * x_unit + y_unit * y_unit + 1e-30)
        cos, sin = x_unit * scale, y_unit * scale
        for _ in range(_FOOT_ROUNDS):
            # In units of a along x and of b along y.
            evolute_x, evolute_y = focal_a * cos * cos * cos, -focal_b * sin * sin * sin
            ahead_x, ahead_y = (cos - evolute_x) * a, (sin - evolute_y) * b
            away_x, away_y = x_unit - evolute_x, y_unit - evolute_y
            far = (away_x * a) * (away_x * a) + (away_y * b) * (away_y * b) + 1e-30
            scale = np.sqrt((ahead_x * ahead_x + ahead_y * ahead_y) / far)
            cos, sin = away_x * scale + evolute_x, away_y * scale + evolute_y
            scale = 1.0 / np.sqrt(cos * cos + sin * sin + 1e-30)
            cos, sin = cos * scale, sin * scale
        speed = np.sqrt(b * cos * b * cos + a * sin * a * sin)
        per_speed = 1.0 / speed
        normal_x, normal_y = b * cos * per_speed, a * sin * per_speed
        foot[0, k], foot[1, k] = cos, sin
        foot[2, k] = (x - a * cos) * normal_x + (y - b * sin) * normal_y
        foot[3, k] = speed
        foot[4, k] = a * b * per_speed * per_speed * per_speed
        foot[5, k], foot[6, k] = normal_x, normal_y


@compiled
def ellipse_basis(foot: Array, out: Array) -> None:
    """Write into ``out`` (5, N) the derivatives of the outward displacement at the feet by the
    centre along the major and along the minor axis, by a, by b, and by the shear."""
    for k in range(foot.shape[1]):
        cos, sin, normal_x, normal_y = foot[0, k], foot[1, k], foot[5, k], foot[6, k]
        out[0, k], out[1, k] = normal_x, normal_y
        out[2, k], out[3, k] = normal_x * cos, normal_y * sin
        out[4, k] = normal_x * sin + normal_y * cos


@compiled
def _damped(basis: Array, square: float) -> None:
    """Damp cosine and sine (8, N) of the orders 3 to 6 by the blur; square : sigma^2 / R^2.

    Blur damps a wave of order k against a shift (k = 1) by I_k / I_1 of Bessel's functions, nearly
    exp(-(k^2 - 1) sigma^2 / (2 R^2)).
    """
    for order in range(4):
        basis[2 * order : 2 * order + 2] *= np.exp((1.0 - (order + 3.0) ** 2) * square / 2.0)


@compiled
def _chord(ellipse: Array, reach_px: float, v: float) -> tuple[float, float]:
    """Columns where a row of pixels enters and leaves an ellipse whose semi-axes are longer by a
    reach; infinite and minus infinite if the row misses it."""
    a, b = max(ellipse[2] + reach_px, 0.0), max(ellipse[3] + reach_px, 0.0)
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    dv = v - ellipse[1]
    height2 = (a * sin) * (a * sin) + (b * cos) * (b * cos) + 1e-12
    square = height2 - dv * dv
    if square <= 0.0 or a * b <= 0.0:
        return np.inf, -np.inf
    middle = ellipse[0] + dv * (a * a - b * b) * sin * cos / height2
    half = a * b * np.sqrt(square) / height2
    return middle - half, middle + half


@compiled
def _gathered(image: Float32, ellipse: Array, reach_px: float, step: int) -> Array:
    """Return (3, N) positions u, v (px) and values of the pixels near the rim of an ellipse (5,).

    reach_px : greatest distance from the rim. step : take one row and one column in so many.
    """
    rows, columns = image.shape
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    extent = np.sqrt((ellipse[2] * sin) ** 2 + (ellipse[3] * cos) ** 2) + reach_px
    top = int(np.ceil(max(ellipse[1] - extent, 0.0) / step))
    bottom = int(np.floor(min(ellipse[1] + extent, rows - 1.0) / step))
    spans = np.empty((max(bottom - top + 1, 0), 4), dtype=np.int64)
    count = 0
    for row in range(top, bottom + 1):
        left, right = _chord(ellipse, reach_px, float(row * step))
        inner_left, inner_right = _chord(ellipse, -reach_px, float(row * step))
        span = spans[row - top]
        span[0] = np.ceil(max(min(left, columns * 1.0), 0.0) / step)
        span[1] = np.floor(min(max(min(inner_left, right), -1.0), columns - 1.0) / step)
        span[2] = np.ceil(max(min(max(left, inner_right), columns * 1.0), 0.0) / step)
        span[2] = max(span[2], span[1] + 1)
        span[3] = np.floor(min(max(right, -1.0), columns - 1.0) / step)
        count += max(span[1] - span[0] + 1, 0) + max(span[3] - span[2] + 1, 0)
    found = np.empty((3, count))
    k = 0
    for row in range(top, bottom + 1):
        for side in range(2):
            for column in range(spans[row - top, 2 * side], spans[row - top, 2 * side + 1] + 1):
                found[0, k], found[1, k] = column * step, row * step
                found[2, k] = image[row * step, column * step]
                k += 1
    return found


@compiled
def _hidden(pixels: Array, own: int, ellipse: Array, sigma: Array) -> Bools:
    """Return (N,) whether each pixel lies inside or near the ellipse of another bubble.

    own : position of the bubble among all; ellipse : (A, 5) ellipses of all bubbles; sigma : (A,)
    blur of their edges (px).
    """
    hidden = np.zeros(pixels.shape[1], dtype=np.bool_)
    reach = _WINDOW_SIGMA * sigma
    size = ellipse[:, 2] + 2.0 * reach
    for other in range(ellipse.shape[0]):
        du, dv = ellipse[own, 0] - ellipse[other, 0], ellipse[own, 1] - ellipse[other, 1]
        if other != own and np.sqrt(du * du + dv * dv) < size[own] + size[other]:
            hidden |= rough_distance(ellipse[other], pixels[0], pixels[1]) < reach[other]
    return hidden


@compiled
def _retreat(ellipse: Array, sigma: float, foot: Array) -> Array:
    """Return how far (N,) the blurred edge retreats because the curvature changes (px).

    Across the blur an arc runs at -(K y^2 / 2 + (K'' + 3 K^3) y^4 / 24) from its tangent, a circle
    of the same curvature at K'' = 0; the mean of y^4 is 3 sigma^4, so the blurred edge retreats
    by K'' sigma^4 / 8. K'' is the second derivative of the curvature by the arc's length.
    """
    a, b = ellipse[2], ellipse[3]
    out = np.zeros(foot.shape[1])
    if a * sigma <= _BENDING_FROM * b * b:
        return out
    gap, limit = a * a - b * b, _MAX_RETREAT * sigma
    for k in range(out.size):
        cos, sin, speed = foot[0, k], foot[1, k], foot[3, k]
        square = speed * speed
        turn, slope = gap * (cos * cos - sin * sin), gap * sin * cos
        bent = -0.375 * a * b * (turn - 6.0 * slope * slope / square)
        bent *= sigma**4 / (square * square * square * speed)
        out[k] = min(max(bent, -limit), limit)
    return out


@compiled
def profile(table: Array, distance: float, curvature: float) -> tuple[float, float, float]:
    """Share of the disc's level, and its derivatives by distance and by curvature.

    table : (curvatures, distances), interpolated bilinearly; the error is at most 1e-3 of the
        contrast.
    """
    # The comparisons also keep NaN inside the table.
    x = distance if distance > -DISTANCE_LIMIT else -DISTANCE_LIMIT
    y = curvature if curvature > 0.0 else 0.0
    x = (min(x, DISTANCE_LIMIT - 1e-3) + DISTANCE_LIMIT) / DISTANCE_STEP
    y = min(y, CURVATURE_LIMIT - 1e-3) / CURVATURE_STEP
    column, row = int(x), int(y)
    x -= column
    y -= row
    low, high = table[row, column], table[row + 1, column]
    low_slope, high_slope = table[row, column + 1] - low, table[row + 1, column + 1] - high
    low += x * low_slope
    change = high + x * high_slope - low
    slope = low_slope + y * (high_slope - low_slope)
    return low + y * change, slope / DISTANCE_STEP, change / CURVATURE_STEP


@compiled
def _ring(distance: float) -> int:
    """Return the number of a ring of 1 px; NaN and what is very far share the last one."""
    return int(abs(distance)) if abs(distance) < 1000 else 1000


@compiled
def _unlike_rim(
    foot: Array, distance: Array, residual: Array, sigma: float, contrast: float
) -> Bools:
    """Find pixels that glare, dirt or a neighbouring bubble has changed.

    foot : (7, N) of `feet`; distance : (N,) distance from the outline (px), positive outside.
    residual : (N,) measured minus predicted grey level, divided by the noise.
    sigma : blur of the edges (px).
    contrast : background level minus the bubble's level, divided by the noise.

    Returns (N,) whether each pixel should be left out. For this, the pixels are divided into rings
    of 1 px, inside and outside the outline, and into eight octants. In each octant, the pixels are
    left out from the first ring on that departs from the model: that is brighter inside (glare) or
    darker outside (dirt, neighbour), by more than 1.5 % of the contrast and by more than 3 standard
    deviations of the ring's mean.
    """
    rings = 2
    for k in range(distance.size):
        rings = max(rings, _ring(distance[k]) + 2)
    count, total = np.zeros((2 * _OCTANTS, rings)), np.zeros((2 * _OCTANTS, rings))
    sector = np.empty(distance.size, dtype=np.int64)
    for k in range(distance.size):
        cos, sin = foot[0, k], foot[1, k]
        octant = 4 * (cos > 0.0) + 2 * (sin > 0.0) + (abs(cos) > abs(sin))
        sector[k] = 2 * octant + (distance[k] > 0.0)
        ring = _ring(distance[k])
        count[sector[k], ring] += 1.0
        total[sector[k], ring] += residual[k]
    cut = np.full(2 * _OCTANTS, rings * 1.0)
    for part in range(2 * _OCTANTS):
        sign = 1.0 - 2.0 * (part % 2)
        for ring in range(int(np.ceil(_UNLIKE_FROM * sigma)), rings):
            many = count[part, ring]
            mean = sign * total[part, ring] / max(many, 1.0)
            strong = mean > _UNLIKE_SHARE * contrast and mean * np.sqrt(many) > _BEYOND_CHANCE
            if strong and many > 1.0:
                cut[part] = ring
                break
    unlike = np.empty(distance.size, dtype=np.bool_)
    for k in range(distance.size):
        unlike[k] = abs(distance[k]) > cut[sector[k]] - _MARGIN_SIGMA * sigma
    return unlike


@compiled
def _window(
    table: Array,
    pixels: Array,
    foot: Array,
    distance: Array,
    retreat: Array,
    hidden: Bools,
    levels: Array,
    noise: Array,
) -> Array:
    """Return the weights (N,): inverse variances of the pixels, 0 for those that are left out.

    levels : blur (px), outer and inner level. noise : outside and inside.
    """
    sigma, outer, contrast = levels[0], levels[1], levels[1] - levels[2]
    outside, change = noise[0] ** 2, noise[1] ** 2 - noise[0] ** 2
    inverse, residual = np.empty(distance.size), np.empty(distance.size)
    for k in range(distance.size):
        covered = profile(table, (distance[k] + retreat[k]) / sigma, foot[4, k] * sigma)[0]
        inverse[k] = 1.0 / (outside + change * covered)
        left = pixels[2, k] - outer + contrast * covered
        residual[k] = left * np.sqrt(inverse[k])
    unlike = _unlike_rim(foot, distance, residual, sigma, contrast / noise[0])
    reach = _WINDOW_SIGMA * sigma + _WINDOW_PX
    sizes, many = np.empty(distance.size), 0
    for k in range(distance.size):
        near = abs(distance[k]) < reach and abs(residual[k]) < np.inf
        if near and not (hidden[k] or unlike[k]):
            sizes[many] = abs(residual[k])
            many += 1
        else:
            inverse[k] = 0.0
    typical = NORMAL_FROM_MEDIAN * np.median(sizes[:many]) if many > 0 else 1.0
    limit = _OUTLIER_SIGMA * max(typical, 1.0)
    for k in range(distance.size):
        if not abs(residual[k]) < limit:
            inverse[k] = 0.0
    return inverse


@compiled
def _distances(shape: Array, foot: Array, shifts: Array, out: Array) -> None:
    """Write into ``out`` (N,) the pixels' distances from the outline after shifts (13,) (px)."""
    out[:] = foot[2]
    for i in range(shape.shape[0]):
        if shifts[i] != 0.0:
            for k in range(out.size):
                out[k] -= shifts[i] * shape[i, k]


@compiled
def _derivatives(
    table: Array, pixels: Array, shape: Array, distance: Array, levels: Array, rows: Array
) -> None:
    """Write into ``rows`` the derivatives of the grey levels by the parameters, and the residuals.

    pixels : (5, N) values, curvatures, retreats (px), weights and their roots. shape : (5 or 13, N)
    derivatives of the displacement. levels : blur (px), outer and inner level. rows : (9 or 17, N);
    all are multiplied by the roots, the residuals are the last.
    """
    sigma, outer, contrast = levels[0], levels[1], levels[2] - levels[1]
    last = rows.shape[0] - 1
    drop = np.empty(distance.size)
    for k in range(distance.size):
        away, curvature, root = (
            (distance[k] + pixels[2, k]) / sigma,
            pixels[1, k] * sigma,
            pixels[4, k],
        )
        covered, by_distance, by_curvature = profile(table, away, curvature)
        slope = contrast / sigma * root
        rows[BLUR, k] = slope * (curvature * by_curvature - by_distance * away)
        rows[OUTER, k], rows[INNER, k] = root * (1.0 - covered), root * covered
        rows[last, k] = root * (pixels[0, k] - outer - contrast * covered)
        drop[k] = -slope * by_distance
    for i in range(shape.shape[0]):
        row = i if i < ELLIPSE else i + FIRST_HARMONIC - ELLIPSE
        for k in range(distance.size):
            rows[row, k] = drop[k] * shape[i, k]


@compiled
def _with_prior(
    total: Array, prior: Prior, b: int, ellipse: Array, levels: Array, shifts: Array
) -> None:
    """Add the prior of a bubble to its normal equations; their right-hand side is the last row."""
    last, level = total.shape[0] - 1, 1.0 / _LEVEL_SPREAD**2
    total[OUTER, OUTER] += level
    total[INNER, INNER] += level
    total[last, OUTER] -= level * (levels[1] - 1.0)
    total[last, INNER] -= level * (levels[2] - prior.inner[b])
    radius = np.sqrt(ellipse[2] * ellipse[3])
    for i in range(FIRST_HARMONIC, last):
        weight = 1.0 / (prior.harmonics[b, (i - FIRST_HARMONIC) // 2] * radius) ** 2
        total[i, i] += weight
        total[last, i] -= weight * shifts[i + ELLIPSE - FIRST_HARMONIC]
    weight = 1.0 / (prior.flattening_spread[b] * radius) ** 2
    cos, sin = np.cos(2.0 * ellipse[4]), np.sin(2.0 * ellipse[4])
    along = prior.flattening[b, 0] * cos + prior.flattening[b, 1] * sin
    across = prior.flattening[b, 1] * cos - prior.flattening[b, 0] * sin
    half = (ellipse[2] + shifts[2] - ellipse[3] - shifts[3]) / 2.0
    miss = weight * (half - radius * along) / 2.0
    total[2, 2] += weight / 4.0
    total[3, 3] += weight / 4.0
    total[3, 2] -= weight / 4.0
    total[4, 4] += weight
    total[last, 2] -= miss
    total[last, 3] += miss
    total[last, 4] -= weight * (shifts[4] - radius * across)


@compiled
def _solved(total: Array, covariance: Array) -> Array:
    """Solve normal equations (lower triangle, right-hand side as last row).

    Returns the solution (n,), NaN if there is none; writes the inverse into ``covariance``.
    """
    many = total.shape[0] - 1
    whole = np.empty((many, many))
    scale = np.empty(many)
    for i in range(many):
        scale[i] = 1.0 / np.sqrt(max(total[i, i], 1e-12))
        for j in range(i + 1):
            whole[i, j] = whole[j, i] = total[i, j] * scale[i] * scale[j]
        whole[i, i] += _RIDGE
    if not (_reach(whole.ravel()) < np.inf and _reach(total[many, :many]) < np.inf):
        covariance[:] = 0.0
        return np.full(many, np.nan)
    inverse = np.linalg.inv(whole)
    for i in range(many):
        for j in range(many):
            covariance[i, j] = scale[i] * inverse[i, j] * scale[j]
    return covariance @ total[many, :many]


@compiled
def _reach(values: Array) -> float:
    """Return the largest absolute value; NaN if one of them is not finite."""
    reach: float = 0.0
    for value in values:
        if not abs(value) < np.inf:
            return np.nan
        if abs(value) > reach:
            reach = abs(value)
    return reach


@compiled
def _limited(step: Array, minor_px: float, sigma: float) -> float:
    """Shorten a step so that the linearisation stays valid; return its reach (px)."""
    reach = _reach(step[:BLUR])
    share = min(1.0, min(1.5, 0.3 * minor_px) / (reach + 1e-12))
    share = min(share, 0.4 * sigma / (abs(step[BLUR]) + 1e-12))
    for i in range(step.size):
        step[i] *= share
    return float(share * reach)


@compiled
def _judged(
    table: Array,
    pixels: Array,
    foot: Array,
    distance: Array,
    retreat: Array,
    hidden: Bools,
    weight: Array,
    levels: Array,
    noise: Array,
) -> tuple[float, float, float]:
    """Return the sum of squared weighted residuals of a fitted outline, its coverage, and its
    misfit (px), which includes outliers."""
    sigma, outer, contrast = levels[0], levels[1], levels[2] - levels[1]
    seen, chi2, many, square = np.zeros(_BINS), 0.0, 0, 0.0
    for k in range(distance.size):
        near = abs(distance[k]) < sigma and not hidden[k]
        if not near and weight[k] == 0.0:
            continue
        covered = profile(table, (distance[k] + retreat[k]) / sigma, foot[4, k] * sigma)[0]
        residual = pixels[2, k] - outer - contrast * covered
        if near:
            many += 1
            square += residual * residual
        if weight[k] > 0.0:
            chi2 += weight[k] * residual * residual
            if abs(distance[k]) < 1.2 * sigma + 0.3:
                angle = np.arctan2(foot[1, k], foot[0, k]) + np.pi
                seen[int(angle * (_BINS / (2.0 * np.pi))) % _BINS] = 1.0
    excess = max(square / max(many, 1) - noise[0] ** 2, 0.0)
    slope = max(_MEAN_SLOPE * abs(contrast) / sigma, 1e-9)
    return chi2, float(np.mean(seen)), float(np.sqrt(excess)) / slope


@compiled
def _sectors(foot: Array) -> Ints:
    """Return which sixteenth of the outline (N,) the feet are in, in no order."""
    out = np.empty(foot.shape[1], dtype=np.int64)
    for k in range(out.size):
        cos, sin = abs(foot[0, k]), abs(foot[1, k])
        octant = 4 * (foot[0, k] > 0.0) + 2 * (foot[1, k] > 0.0) + (cos > sin)
        out[k] = 2 * octant + (min(cos, sin) > _HALF_OCTANT * max(cos, sin))
    return out


@compiled
def _clustered(first: Ints, rows: Array, step: Array, covariance: Array) -> float:
    """Return the variance of the centre with errors that pixels of a sector share, over that with
    independent errors (the sandwich estimator for clusters, less what the fit absorbs); 1 if that
    may be chance.

    first : (17,) where the pixels of the sectors begin. rows : (n + 1, M) whitened derivatives and
    residuals before the last step (n,); covariance : (n, n), of the parameters.
    """
    many = rows.shape[0] - 1
    shared = expected = chance = 0.0
    pull, gain = np.empty(rows.shape[1]), np.empty(many)
    for axis in range(2):
        pull[:] = 0.0
        for i in range(many):
            for k in range(pull.size):
                pull[k] += covariance[axis, i] * rows[i, k]
        for sector in range(_SECTORS):
            low, high = first[sector], first[sector + 1]
            shift = own = 0.0
            for k in range(low, high):
                shift += pull[k] * rows[many, k]
                own += pull[k] * pull[k]
            for i in range(many):
                gain[i] = 0.0
                for k in range(low, high):
                    gain[i] += pull[k] * rows[i, k]
            shift -= np.sum(gain * step)
            own -= np.sum(gain * (covariance @ gain))
            shared += shift * shift / covariance[axis, axis]
            expected += own / covariance[axis, axis]
            chance += 2.0 * (own / covariance[axis, axis]) ** 2
    if shared < expected + _BEYOND_CHANCE * np.sqrt(chance):
        return 1.0
    return float(shared / max(expected, 1e-9))


@compiled
def _light(
    sector: Ints, distance: Array, values: Array, hidden: Bools, sigma: float, noise: float
) -> float:
    """Return the variance along an outline of the level just outside its edge, less its noise;
    0 if that may be chance.

    distance, values, hidden : (N,) distances of the pixels from the outline (px), grey levels, and
    whether another bubble hides them; sigma : blur (px); noise : standard deviation of a pixel.
    """
    count, level = np.zeros(_SECTORS), np.zeros(_SECTORS)
    for k in range(distance.size):
        if distance[k] > 2.2 * sigma and not hidden[k]:
            count[sector[k]] += 1.0
            level[sector[k]] += values[k]
    seen = count > 2
    if np.sum(seen) < _SECTORS // 4:
        return 0.0
    count, level = count[seen], level[seen] / count[seen]
    variance, own = float(np.mean((level - np.median(level)) ** 2)), noise * noise / count
    expected, chance = float(np.mean(own)), np.sqrt(2.0 * np.sum(own**2)) / count.size
    return variance - expected if variance > expected + _BEYOND_CHANCE * chance else 0.0


@compiled
def _move(ellipse: Array, step: Array) -> float:
    """Apply displacements (5,) to an ellipse; return the angle (rad) by which it has turned."""
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    ellipse[0] += cos * step[0] - sin * step[1]
    ellipse[1] += sin * step[0] + cos * step[1]
    a, b = ellipse[2] + step[2], ellipse[3] + step[3]
    half_gap = (a - b) / 2.0
    apart = np.sqrt(half_gap * half_gap + step[4] * step[4])
    ellipse[3] = max((a + b) / 2.0 - apart, 0.3)
    ellipse[2] = max((a + b) / 2.0 + apart, ellipse[3])
    turn: float = 0.5 * np.arctan2(step[4], half_gap)
    ellipse[4] += turn
    return turn


@compiled
def _turned(harmonics: Array, turn: float) -> None:
    """Turn the coefficients (8,) of the harmonics after the major axis has turned (rad)."""
    for order in range(4):
        cos, sin = np.cos((order + 3) * turn), np.sin((order + 3) * turn)
        c, s = harmonics[2 * order], harmonics[2 * order + 1]
        harmonics[2 * order], harmonics[2 * order + 1] = c * cos + s * sin, s * cos - c * sin


@compiled
def _misled(
    sector: Ints, distance: Array, pixels: Array, hidden: Bools, levels: Array, noise: Array,
    first: Ints, rows: Array, step: Array, covariance: Array, out: Array,
) -> None:  # fmt: skip
    """Add to a centre's covariance ``out`` (2, 2) what pixels that err together, beyond chance, and
    uneven light make of it."""
    out *= _clustered(first, rows, step, covariance)
    light = _light(sector, distance, pixels[2], hidden, levels[0], noise[0])
    light *= (levels[0] / max(levels[1] - levels[2], 1e-3)) ** 2
    out[0, 0] += _UNEVEN_LIGHT * light
    out[1, 1] += _UNEVEN_LIGHT * light


@compiled
def _copied(outlines: Outlines, own: Ints) -> Outlines:
    many = own.size
    return Outlines(
        outlines.ellipse[own], outlines.harmonics[own], outlines.sigma_px[own],
        outlines.outer[own], outlines.inner[own], np.zeros((many, 2, 2)), np.full(many, np.nan),
        np.zeros(many), np.zeros(many), np.zeros(many), np.zeros(many),
    )  # fmt: skip


@compiled
def fitted(
    image: Float32,
    table: Array,
    noise: Array,
    outlines: Outlines,
    own: Ints,
    prior: Prior,
    steps: int,
    misled_below: float,
) -> Outlines:
    """Fit outlines by Gauss-Newton steps, the nearest points on the ellipses held fixed.

    image : (rows, columns) grey levels divided by the background.
    table : profile of a blurred disc (curvatures, distances), see `profile`.
    noise : (2,) standard deviation of a pixel outside and inside the bubbles.
    outlines : all outlines of the image; pixels inside or near another one are left out.
    own : (B,) those that are fitted; prior : of all.
    steps : largest number of steps; none is a first look, at some pixels in a narrow band, that
        finds the ellipse, blur and levels.
    misled_below : coverage of an outline below which its centre's covariance has what misleads its
        fit (`_misled`).
    """
    fit = _copied(outlines, own)
    for b in range(own.size):
        ellipse, harmonics, sigma = fit.ellipse[b], fit.harmonics[b], fit.sigma_px[b]
        if not (_reach(ellipse) < np.inf and abs(sigma) < np.inf):
            continue
        first_look = steps == 0
        held = first_look or ellipse[3] <= RESOLVED_BLURS * sigma
        levels = np.array([sigma, fit.outer[b], fit.inner[b]])
        shifts = np.zeros(OUTLINE)
        reach = _WINDOW_SIGMA * sigma + _WINDOW_PX + 0.2 * sigma + 0.7
        if not held:
            shifts[ELLIPSE:] = harmonics
            reach += np.sum(np.abs(harmonics))
        thin = first_look and ellipse[3] > _THIN_ABOVE_PX
        pixels = _gathered(image, ellipse, reach, 2 if thin else 1)
        many = pixels.shape[1]
        foot, shape = np.empty((7, many)), np.empty((ELLIPSE if held else OUTLINE, many))
        feet(ellipse, pixels[0], pixels[1], foot)
        ellipse_basis(foot, shape[:ELLIPSE])
        if not held:
            shape[ELLIPSE:] = harmonic_basis(foot[0], foot[1])
            _damped(shape[ELLIPSE:], sigma * sigma / (ellipse[2] * ellipse[3]))
        retreat = _retreat(ellipse, sigma, foot)
        hidden = _hidden(pixels, own[b], outlines.ellipse, outlines.sigma_px)
        distance = np.empty(many)
        _distances(shape, foot, shifts, distance)
        if first_look:
            lowest = -min(2.0 * sigma + 0.5, 0.45 * ellipse[3])
            inside = (lowest < distance) & (distance < 2.5 * sigma + 1.0) & ~hidden
            weight = np.where(inside, 1.0 / noise[0] ** 2, 0.0)
        else:
            weight = _window(table, pixels, foot, distance, retreat, hidden, levels, noise)
        sector, used = _sectors(foot), np.empty(many, dtype=np.int64)
        first = np.zeros(_SECTORS + 1, dtype=np.int64)
        for part in range(_SECTORS):
            count = first[part]
            for k in range(many):
                if sector[k] == part and weight[k] > 0.0:
                    used[count] = k
                    count += 1
            first[part + 1] = count
        used = used[: first[_SECTORS]]
        taken, bent = np.empty((5, used.size)), np.empty((shape.shape[0], used.size))
        start = np.empty((3, used.size))
        for k in range(used.size):
            taken[0, k], taken[1, k] = pixels[2, used[k]], foot[4, used[k]]
            taken[2, k], taken[3, k] = retreat[used[k]], weight[used[k]]
            taken[4, k], start[2, k] = np.sqrt(weight[used[k]]), foot[2, used[k]]
        for i in range(shape.shape[0]):
            for k in range(used.size):
                bent[i, k] = shape[i, used[k]]
        free = FIRST_HARMONIC if held else PARAMETERS
        rows, total = np.empty((free + 1, used.size)), np.empty((free + 1, free + 1))
        covariance, away, began = np.zeros((free, free)), np.empty(used.size), shifts.copy()
        step = np.zeros(free)
        for _ in range(max(steps, _FIRST_STEPS)):
            _distances(bent, start, shifts, away)
            _derivatives(table, taken, bent, away, levels, rows)
            products(rows, used.size, total)
            _with_prior(total, prior, own[b], ellipse, levels, shifts)
            step = _solved(total, covariance)
            if not _reach(step) < np.inf:
                break
            reach = _limited(step, ellipse[3], levels[0])
            for i in range(shape.shape[0]):
                shifts[i] += step[i if i < ELLIPSE else i + FIRST_HARMONIC - ELLIPSE]
            levels[0] = max(levels[0] + step[BLUR], _LEAST_SIGMA_PX)
            levels[1] += step[OUTER]
            levels[2] += step[INNER]
            if reach < _CONVERGED_PX:
                break
        fit.sigma_px[b], fit.outer[b], fit.inner[b] = levels
        fit.shift_px[b] = np.max(np.abs(shifts - began))
        if not first_look:
            _distances(shape, foot, shifts, distance)
            chi2, fit.coverage[b], fit.misfit_px[b] = _judged(
                table, pixels, foot, distance, retreat, hidden, weight, levels, noise
            )
            dof = max(used.size - free, 1.0)
            fit.chi2_dof[b] = chi2 / dof
            if chi2 / dof > 1.0 + _BEYOND_CHANCE * np.sqrt(2.0 / dof):
                covariance *= chi2 / dof
            centre = fit.covariance_px2[b]
            centre[:] = covariance[:2, :2]
            if fit.coverage[b] < misled_below and used.size > free:
                _misled(
                    sector, distance, pixels, hidden, levels, noise,
                    first, rows, step, covariance, centre,
                )  # fmt: skip
            cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
            turn = np.array([[cos, -sin], [sin, cos]])
            centre[:] = turn @ np.ascontiguousarray(centre) @ turn.T
            if not held:
                variances = np.diag(covariance)[FIRST_HARMONIC:]
                fit.sigma_outline_px[b] = np.sqrt(max(float(np.mean(variances)), 0.0))
        harmonics[:] = shifts[ELLIPSE:]
        _turned(harmonics, _move(ellipse, shifts[:ELLIPSE]))
    return fit


@compiled
def _circle(u: Array, v: Array, out: Array) -> None:
    """Write into ``out`` (5,) the circle through points around the origin, by least squares."""
    total, right = np.zeros((3, 3)), np.zeros(3)
    for k in range(u.size):
        square = u[k] * u[k] + v[k] * v[k]
        total[0, 0] += u[k] * u[k]
        total[1, 0] += u[k] * v[k]
        total[1, 1] += v[k] * v[k]
        right[0] += u[k] * square
        right[1] += v[k] * square
        right[2] += square
    total[0, 1] = total[1, 0]
    # The sums of u and of v are 0: the origin is the points' mean.
    total[0, 0] += 1e-9
    total[1, 1] += 1e-9
    total[2, 2] = u.size + 1e-9
    u0, v0, rest = np.linalg.solve(total, right)
    radius = np.sqrt(max(rest + (u0 * u0 + v0 * v0) / 4.0, 0.5))
    out[0], out[1], out[2], out[3], out[4] = u0 / 2.0, v0 / 2.0, radius, radius, 0.0


@compiled
def _roundness(total: Array, ellipse: Array, spread_px: float) -> None:
    """Add the prior to the normal equations of an arc; their right-hand side is the last row.

    spread_px : standard deviation of a - b and of twice the shear.
    """
    weight = 1.0 / (spread_px * spread_px)
    gap = (ellipse[2] - ellipse[3]) * weight
    total[2, 2] += weight
    total[3, 3] += weight
    total[3, 2] -= weight
    total[4, 4] += 4.0 * weight
    total[ELLIPSE, 2] -= gap
    total[ELLIPSE, 3] += gap
    for i in range(ELLIPSE):
        total[i, i] += 1e-6


@compiled
def fitted_arcs(points: Array, sizes: Ints) -> tuple[Array, Array]:
    """Fit ellipses along arcs, robustly, see `blobs.fit_ellipses`.

    points : (N, 2) the arcs' points (px), one arc after the other; sizes : (B,) their numbers.

    Returns the ellipses (B, 5) and the RMS distances (B,) of their points (px).
    """
    ellipses, rms = np.empty((sizes.size, ELLIPSE)), np.empty(sizes.size)
    total, covariance = np.empty((ELLIPSE + 1, ELLIPSE + 1)), np.empty((ELLIPSE, ELLIPSE))
    first = 0
    for arc in range(sizes.size):
        many, ellipse = sizes[arc], ellipses[arc]
        u, v = np.empty(many), np.empty(many)
        u0 = v0 = 0.0
        for k in range(many):
            u0 += points[first + k, 0] / many
            v0 += points[first + k, 1] / many
        for k in range(many):
            u[k], v[k] = points[first + k, 0] - u0, points[first + k, 1] - v0
        first += many
        _circle(u, v, ellipse)
        radius = ellipse[2]
        foot, rows = np.empty((7, many)), np.empty((ELLIPSE + 1, many))
        for turn in range(_ARC_ROUNDS + 1):
            feet(ellipse, u, v, foot)
            if turn == _ARC_ROUNDS:
                break
            ellipse_basis(foot, rows[:ELLIPSE])
            for k in range(many):
                far = foot[2, k] / _FAR_PX
                root = 1.0 / (_POINT_SIGMA_PX * np.sqrt(1.0 + far * far))
                for i in range(ELLIPSE):
                    rows[i, k] *= root
                rows[ELLIPSE, k] = foot[2, k] * root
            products(rows, many, total)
            _roundness(total, ellipse, _ROUND_SHARE * radius)
            step = _solved(total, covariance)
            reach = _reach(step)
            _move(ellipse, step * min(1.0, 0.4 * ellipse[3] / (reach + 1e-12)))
            if not reach >= _CONVERGED_PX:
                feet(ellipse, u, v, foot)
                break
        square = 0.0
        for k in range(many):
            square += foot[2, k] * foot[2, k]
        rms[arc] = np.sqrt(square / many)
        ellipse[0] += u0
        ellipse[1] += v0
    return ellipses, rms


@compiled
def disc_counts(ellipse: Array, low: Ints, mask: NDArray[np.uint8]) -> tuple[int, int]:
    """Return the number of pixels inside an ellipse (5,), and of those marked in a mask.

    low : (2,) pixel (u, v) of the mask's first element; mask : (rows, columns).
    """
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    inside = marked = 0
    for row in range(mask.shape[0]):
        dv = row + low[1] - ellipse[1]
        for column in range(mask.shape[1]):
            du = column + low[0] - ellipse[0]
            x, y = (du * cos + dv * sin) / ellipse[2], (dv * cos - du * sin) / ellipse[3]
            if x * x + y * y < 1.0:
                inside += 1
                marked += mask[row, column] > 0
    return inside, marked
