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
HELD = 1e-7
"""Prior standard deviation, as a share of the radius, of harmonics that are not fitted."""

MIN_SIGMA_PX = 0.3
_SECTORS, _CLEAR_SIGMA, _FEW_CLEAR = 16, 2.2, 2
_OCTANTS, _LAST_RING = 8, 1000
_UNLIKE_SHARE, _UNLIKE_SIGMA, _UNLIKE_FROM, _MARGIN_SIGMA = 0.015, 3.0, 1.3, 0.9
_REACH_SIGMA, _REACH_PX = 3.2, 1.2
_THIN_ABOVE_PX = 10.0
_BENDING_FROM, _MAX_RETREAT = 0.2, 0.3
_WINDOW_SIGMA, _WINDOW_PX = 3.0, 0.5
_HIDING_SIGMA = 3.0
_OUTLIER_SIGMA, _FEW = 4.5, 8
_LEVEL_SPREAD = 0.3
_CONVERGED_PX = 0.01
_BINS = 32
_FOOT_ROUNDS = 2
_OFF_CENTRE = 1e-9
"""The centre of a circle is nearest to no point of it: that much beside it, in units of a."""

_POINT_SIGMA_PX, _FAR_PX = 0.2, 0.6
_ROUND_SHARE, _ARC_ROUNDS, _ARC_CONVERGED_PX = 0.12, 8, 0.01
_TILE = 4


class Rims(NamedTuple):
    """Hold the outlines of B bubbles, and what is known of them before the fit.

    ellipse : (B, 5) ellipses
    harmonics : (B, 8) coefficients (px).
    sigma : (B,) standard deviation of the edges' blur, including the pixel (px).
    outer, inner : (B,) grey levels outside and inside the bubble, as shares of the background.
    expected_inner : (B,) prior mean of the grey level inside.
    noise_outer, noise_inner : (B,) standard deviation of a pixel's noise outside and inside.
    spread : (B,) prior standard deviation of the harmonics, as a share of the radius; at most
        ``HELD`` if they are not to be fitted.
    flattening : (B, 2) prior mean of (a - b) / (a + b) times cosine and sine of twice the angle.
    flattening_spread : (B,) its prior standard deviation; infinite for none.
    """

    ellipse: Array
    harmonics: Array
    sigma: Array
    outer: Array
    inner: Array
    expected_inner: Array
    noise_outer: Array
    noise_inner: Array
    spread: Array
    flattening: Array
    flattening_spread: Array


class Fits(NamedTuple):
    """Hold the result of Gauss-Newton steps for B outlines.

    shifts : (B, 13) displacements since the linearisation (px), those of the harmonics included.
    sigma, outer, inner : (B,) blur (px) and grey levels.
    covariance : (B, 16, 16) covariance of the parameters.
    moved_px : (B,) largest of the displacements (px).
    used : (B,) number of pixels
    chi2 : (B,) sum of their squared residuals over their variances.
    coverage : (B,) share of the outline at which pixels of the edge were used.
    near, near_square : (B,) number of the pixels within one sigma of the outline that no other
        bubble hides, outliers included, and the sum of their squared residuals.
    clustered : (B,) factor by which the errors of the pixels, which sectors of the outline have in
        common, make the centre's variance larger than that of independent errors.
    light : (B,) variance along the outline of the grey level just outside the edge, beyond its
        noise, over the square of the contrast.
    """

    shifts: Array
    sigma: Array
    outer: Array
    inner: Array
    covariance: Array
    moved_px: Array
    used: Ints
    chi2: Array
    coverage: Array
    near: Ints
    near_square: Array
    clustered: Array
    light: Array


@compiled
def _cholesky(matrix: Array) -> None:
    """Replace a positive definite matrix (n, n) by its Cholesky factor, in the lower triangle."""
    for j in range(matrix.shape[0]):
        for i in range(j, matrix.shape[0]):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[j, j] = np.sqrt(max(total, 1e-300))
            else:
                matrix[i, j] = total / matrix[j, j]


@compiled
def _substituted(root: Array, right: Array) -> None:
    """Replace the right-hand side (n,) by the solution; root : factor of `_cholesky`."""
    n = root.shape[0]
    for i in range(n):
        for k in range(i):
            right[i] -= root[i, k] * right[k]
        right[i] /= root[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= root[k, i] * right[k]
        right[i] /= root[i, i]


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
def _harmonics(foot: Array, square: float, out: Array) -> None:
    """Write into ``out`` (8, N) cosine and sine of the orders 3 to 6 at the feet, damped.

    Blur damps a wave of order k against a shift (k = 1) by I_k / I_1 of Bessel's functions, nearly
    exp(-(k^2 - 1) sigma^2 / (2 R^2)). square : sigma^2 / R^2.
    """
    gain = np.empty(4)
    for order in range(4):
        gain[order] = np.exp((1.0 - (order + 3.0) * (order + 3.0)) * square / 2.0)
    for k in range(foot.shape[1]):
        cos, sin = foot[0, k], foot[1, k]
        real, imaginary = cos * cos - sin * sin, 2.0 * sin * cos
        for order in range(4):
            real, imaginary = real * cos - imaginary * sin, real * sin + imaginary * cos
            out[2 * order, k], out[2 * order + 1, k] = gain[order] * real, gain[order] * imaginary


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
def _hidden(pixels: Array, own: int, ellipse: Array, everyone: Array, sigma: Array) -> Bools:
    """Return (N,) whether each pixel lies inside or near the ellipse of another bubble.

    own : position of the bubble among all; ellipse : (5,) its ellipse.
    everyone : (A, 5) ellipses of all bubbles; sigma : (A,) blur of their edges (px).
    """
    hidden = np.zeros(pixels.shape[1], dtype=np.bool_)
    size = ellipse[2] + 2.0 * _HIDING_SIGMA * sigma[own]
    for other in range(everyone.shape[0]):
        du, dv = ellipse[0] - everyone[other, 0], ellipse[1] - everyone[other, 1]
        reach = _HIDING_SIGMA * sigma[other]
        far = size + everyone[other, 2] + 2.0 * reach
        if other == own or du * du + dv * dv >= far * far:
            continue
        cos, sin = np.cos(everyone[other, 4]), np.sin(everyone[other, 4])
        per_a, per_b = 1.0 / everyone[other, 2], 1.0 / everyone[other, 3]
        for k in range(hidden.size):
            du, dv = pixels[0, k] - everyone[other, 0], pixels[1, k] - everyone[other, 1]
            x, y = (du * cos + dv * sin) * per_a, (dv * cos - du * sin) * per_b
            level = np.sqrt(x * x + y * y) + 1e-12
            slope = np.sqrt((x * per_a) ** 2 + (y * per_b) ** 2) + 1e-12
            hidden[k] |= (level - 1.0) * level < reach * slope
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
def _profile(table: Array, distance: float, curvature: float) -> tuple[float, float, float]:
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
def profiles(table: Array, distance: Array, curvature: Array) -> Array:
    """Return (3, N): the profile of a blurred disc at N places, its derivative with respect to the
    distance from the outline, and that with respect to the curvature; see `_profile`."""
    out = np.empty((3, distance.size))
    for k in range(distance.size):
        out[0, k], out[1, k], out[2, k] = _profile(table, distance[k], curvature[k])
    return out


@compiled
def _ring(distance: float) -> int:
    """Return the number of a ring of 1 px; NaN and what is very far share the last one."""
    return int(abs(distance)) if abs(distance) < _LAST_RING else _LAST_RING


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
            strong = mean > _UNLIKE_SHARE * contrast and mean * np.sqrt(many) > _UNLIKE_SIGMA
            if strong and many > 1.0:
                cut[part] = ring
                break
    unlike = np.empty(distance.size, dtype=np.bool_)
    for k in range(distance.size):
        unlike[k] = abs(distance[k]) > cut[sector[k]] - _MARGIN_SIGMA * sigma
    return unlike


@compiled
def _middle(values: Array, many: int) -> float:
    """Return the median of the first ``many`` values; changes their order (Hoare's selection)."""
    low, high, place = 0, many - 1, many // 2
    while low < high:
        pivot, i, j = values[place], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < place:
            low = i
        if place < i:
            high = j
    return float(values[place])


@compiled
def _window(
    table: Array,
    pixels: Array,
    foot: Array,
    distance: Array,
    retreat: Array,
    hidden: Bools,
    rims: Rims,
    b: int,
) -> Array:
    """Return the weights (N,): inverse variances of the pixels, 0 for those that are left out."""
    outside, sigma = rims.noise_outer[b] ** 2, rims.sigma[b]
    change = rims.noise_inner[b] ** 2 - outside
    contrast = rims.outer[b] - rims.inner[b]
    inverse, residual = np.empty(distance.size), np.empty(distance.size)
    for k in range(distance.size):
        covered = _profile(table, (distance[k] + retreat[k]) / sigma, foot[4, k] * sigma)[0]
        inverse[k] = 1.0 / (outside + change * covered)
        left = pixels[2, k] - rims.outer[b] + contrast * covered
        residual[k] = left * np.sqrt(inverse[k])
    unlike = _unlike_rim(foot, distance, residual, sigma, contrast / rims.noise_outer[b])
    reach = _WINDOW_SIGMA * sigma + _WINDOW_PX
    sizes, many = np.empty(distance.size), 0
    for k in range(distance.size):
        near = abs(distance[k]) < reach and abs(residual[k]) < np.inf
        if near and not (hidden[k] or unlike[k]):
            sizes[many] = abs(residual[k])
            many += 1
        else:
            inverse[k] = 0.0
    typical = NORMAL_FROM_MEDIAN * _middle(sizes, many) if many > _FEW else 1.0
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
        covered, by_distance, by_curvature = _profile(table, away, curvature)
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
def _with_prior(total: Array, rims: Rims, b: int, levels: Array, shifts: Array) -> None:
    """Add the prior of a bubble to its normal equations; their right-hand side is the last row."""
    last, level = total.shape[0] - 1, 1.0 / _LEVEL_SPREAD**2
    total[OUTER, OUTER] += level
    total[INNER, INNER] += level
    total[last, OUTER] -= level * (levels[1] - 1.0)
    total[last, INNER] -= level * (levels[2] - rims.expected_inner[b])
    if last > FIRST_HARMONIC:
        weight = 1.0 / (rims.spread[b] ** 2 * rims.ellipse[b, 2] * rims.ellipse[b, 3])
        for i in range(FIRST_HARMONIC, last):
            total[i, i] += weight
            total[last, i] -= weight * shifts[i + ELLIPSE - FIRST_HARMONIC]
    radius = np.sqrt(rims.ellipse[b, 2] * rims.ellipse[b, 3])
    weight = 1.0 / (rims.flattening_spread[b] * radius) ** 2
    cos, sin = np.cos(2.0 * rims.ellipse[b, 4]), np.sin(2.0 * rims.ellipse[b, 4])
    along = rims.flattening[b, 0] * cos + rims.flattening[b, 1] * sin
    across = rims.flattening[b, 1] * cos - rims.flattening[b, 0] * sin
    half = (rims.ellipse[b, 2] + shifts[2] - rims.ellipse[b, 3] - shifts[3]) / 2.0
    miss = weight * (half - radius * along) / 2.0
    total[2, 2] += weight / 4.0
    total[3, 3] += weight / 4.0
    total[3, 2] -= weight / 4.0
    total[4, 4] += weight
    total[last, 2] -= miss
    total[last, 3] += miss
    total[last, 4] -= weight * (shifts[4] - radius * across)


@compiled
def _solved(total: Array, step: Array, covariance: Array) -> None:
    """Solve normal equations (lower triangle, right-hand side as last row) for step and
    covariance."""
    many = step.size
    scale, root = np.empty(many), np.empty((many, many))
    for i in range(many):
        scale[i] = 1.0 / np.sqrt(max(total[i, i], 1e-12))
        for j in range(i + 1):
            root[i, j] = total[i, j] * scale[i] * scale[j]
        root[i, i] += 1e-7
        step[i] = scale[i] * total[many, i]
    _cholesky(root)
    _substituted(root, step)
    right = np.empty(many)
    for i in range(many):
        step[i] *= scale[i]
        for j in range(many):
            right[j] = scale[i] if i == j else 0.0
        _substituted(root, right)
        for j in range(many):
            covariance[i, j] = scale[j] * right[j]


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
    b: int,
    fits: Fits,
) -> None:
    """Write into ``fits`` how well a fitted outline agrees with its pixels."""
    sigma, outer, contrast = levels[0], levels[1], levels[2] - levels[1]
    seen = np.zeros(_BINS)
    for k in range(distance.size):
        near = abs(distance[k]) < sigma and not hidden[k]
        if not near and weight[k] == 0.0:
            continue
        away = (distance[k] + retreat[k]) / sigma
        covered = _profile(table, away, foot[4, k] * sigma)[0]
        square = (pixels[2, k] - outer - contrast * covered) ** 2
        if near:
            fits.near[b] += 1
            fits.near_square[b] += square
        if weight[k] > 0.0:
            fits.used[b] += 1
            fits.chi2[b] += weight[k] * square
            if abs(distance[k]) < 1.2 * sigma + 0.3:
                angle = np.arctan2(foot[1, k], foot[0, k]) + np.pi
                seen[int(angle * (_BINS / (2.0 * np.pi))) % _BINS] = 1.0
    for k in range(_BINS):
        fits.coverage[b] += seen[k] / _BINS


@compiled
def _sector(cos: float, sin: float) -> int:
    return int((np.arctan2(sin, cos) / (2.0 * np.pi) + 0.5) * _SECTORS) % _SECTORS


@compiled
def _clustered(foot: Array, used: Ints, rows: Array, covariance: Array) -> float:
    """Return the variance of the centre with errors that pixels of a sector share, over that with
    independent errors (the sandwich estimator for clusters, less what the fit absorbs).

    foot : (7, N) of `feet`; used : (M,) the pixels of the fit. rows : (n + 1, M) whitened
    derivatives and residuals; covariance : (n, n) or larger, of the parameters.
    """
    many = rows.shape[0] - 1
    shared = expected = 0.0
    for axis in range(2):
        shift, own = np.zeros(_SECTORS), np.zeros(_SECTORS)
        gain = np.zeros((_SECTORS, many))
        for k in range(used.size):
            pull = 0.0
            for i in range(many):
                pull += covariance[axis, i] * rows[i, k]
            sector = _sector(foot[0, used[k]], foot[1, used[k]])
            shift[sector] += pull * rows[many, k]
            own[sector] += pull * pull
            for i in range(many):
                gain[sector, i] += pull * rows[i, k]
        for sector in range(_SECTORS):
            for i in range(many):
                for j in range(many):
                    own[sector] -= gain[sector, i] * covariance[i, j] * gain[sector, j]
        shared += np.sum(shift**2) / covariance[axis, axis]
        expected += np.sum(own) / covariance[axis, axis]
    return float(shared / max(expected, 1e-9))


@compiled
def _light(
    foot: Array, distance: Array, values: Array, hidden: Bools, sigma: float, noise: float
) -> float:
    """Return the variance along an outline of the level (1) just outside its edge, less its noise.

    distance, values, hidden : (N,) distances of the pixels from the outline (px), grey levels, and
    whether another bubble hides them; sigma : blur (px); noise : standard deviation of a pixel.
    """
    count, level = np.zeros(_SECTORS), np.zeros(_SECTORS)
    for k in range(distance.size):
        if distance[k] > _CLEAR_SIGMA * sigma and not hidden[k]:
            sector = _sector(foot[0, k], foot[1, k])
            count[sector] += 1.0
            level[sector] += values[k]
    seen = count > _FEW_CLEAR
    if np.sum(seen) < _SECTORS // 4:
        return 0.0
    count, level = count[seen], level[seen] / count[seen]
    # Twice the noise: the median has some, too, and the rest is to be no chance.
    chance = 2.0 * noise * noise * float(np.mean(1.0 / count))
    return max(float(np.mean((level - np.median(level)) ** 2)) - chance, 0.0)


@compiled
def _no_fits(many: int) -> Fits:
    return Fits(
        np.zeros((many, OUTLINE)),
        np.zeros(many),
        np.zeros(many),
        np.zeros(many),
        np.zeros((many, PARAMETERS, PARAMETERS)),
        np.zeros(many),
        np.zeros(many, dtype=np.int64),
        np.zeros(many),
        np.zeros(many),
        np.zeros(many, dtype=np.int64),
        np.zeros(many),
        np.zeros(many),
        np.zeros(many),
    )


STEPS = 3


@compiled
def fitted(
    image: Float32,
    table: Array,
    rims: Rims,
    own: Ints,
    everyone: Array,
    everyone_sigma: Array,
    steps: int,
    crowded: bool,
) -> Fits:
    """Fit B outlines by Gauss-Newton steps, the nearest points on the ellipses held fixed.

    image : (rows, columns) grey levels divided by the background.
    table : profile of a blurred disc, see `profiles`.
    rims : the outlines at the start
    own : (B,) their positions among all bubbles of the image.
    everyone, everyone_sigma : (A, 5) ellipses and (A,) blurs of all bubbles. Pixels inside or near
        another bubble are left out.
    steps : largest number of steps. With ``STEPS`` all pixels at the rim are used, except glare,
        dirt and outliers; with less, some in a narrow band.
    crowded : whether to measure what neighbours and shadows do, `Fits.clustered` and `Fits.light`.
    """
    fits = _no_fits(rims.sigma.size)
    for b in range(rims.sigma.size):
        ellipse, sigma, first_look = rims.ellipse[b], rims.sigma[b], steps < STEPS
        fits.sigma[b], fits.outer[b], fits.inner[b] = sigma, rims.outer[b], rims.inner[b]
        if not (_reach(ellipse) < np.inf and abs(sigma) < np.inf):
            continue
        held = rims.spread[b] <= HELD
        shifts, levels = fits.shifts[b], np.empty(3)
        levels[0], levels[1], levels[2] = sigma, rims.outer[b], rims.inner[b]
        reach = _REACH_SIGMA * sigma + _REACH_PX
        if not held:
            for i in range(OUTLINE - ELLIPSE):
                shifts[ELLIPSE + i] = rims.harmonics[b, i]
                reach += abs(rims.harmonics[b, i])
        thin = first_look and ellipse[3] > _THIN_ABOVE_PX
        pixels = _gathered(image, ellipse, reach, 2 if thin else 1)
        many = pixels.shape[1]
        foot, shape = np.empty((7, many)), np.empty((ELLIPSE if held else OUTLINE, many))
        feet(ellipse, pixels[0], pixels[1], foot)
        ellipse_basis(foot, shape[:ELLIPSE])
        if not held:
            square = sigma * sigma / (ellipse[2] * ellipse[3])
            _harmonics(foot, square, shape[ELLIPSE:])
        retreat = _retreat(ellipse, sigma, foot)
        hidden = _hidden(pixels, own[b], ellipse, everyone, everyone_sigma)
        distance = np.empty(many)
        _distances(shape, foot, shifts, distance)
        if first_look:
            lowest = -min(2.0 * sigma + 0.5, 0.45 * ellipse[3])
            weight = np.empty(many)
            for k in range(many):
                inside = lowest < distance[k] < 2.5 * sigma + 1.0 and not hidden[k]
                weight[k] = 1.0 / rims.noise_outer[b] ** 2 if inside else 0.0
        else:
            weight = _window(table, pixels, foot, distance, retreat, hidden, rims, b)
        used = np.empty(many, dtype=np.int64)
        count = 0
        for k in range(many):
            if weight[k] > 0.0:
                used[count] = k
                count += 1
        used = used[:count]
        taken, bent = np.empty((5, used.size)), np.empty((shape.shape[0], used.size))
        start = np.empty((3, used.size))
        for k in range(used.size):
            taken[0, k], taken[1, k] = pixels[2, used[k]], foot[4, used[k]]
            taken[2, k], taken[3, k] = retreat[used[k]], weight[used[k]]
            taken[4, k], start[2, k] = np.sqrt(weight[used[k]]), foot[2, used[k]]
        for i in range(shape.shape[0]):
            for k in range(used.size):
                bent[i, k] = shape[i, used[k]]
        fitted_ones = FIRST_HARMONIC if held else PARAMETERS
        rows = np.empty((fitted_ones + 1, used.size))
        total, step = np.empty((fitted_ones + 1, fitted_ones + 1)), np.empty(fitted_ones)
        covariance, away = fits.covariance[b], np.empty(used.size)
        began = shifts.copy()
        for _ in range(steps):
            _distances(bent, start, shifts, away)
            _derivatives(table, taken, bent, away, levels, rows)
            products(rows, used.size, total)
            _with_prior(total, rims, b, levels, shifts)
            _solved(total, step, covariance)
            if not _reach(step) < np.inf:
                covariance[:] = 0.0
                break
            reach = _limited(step, ellipse[3], levels[0])
            for i in range(shape.shape[0]):
                shifts[i] += step[i if i < ELLIPSE else i + FIRST_HARMONIC - ELLIPSE]
            levels[0] = max(levels[0] + step[BLUR], MIN_SIGMA_PX)
            levels[1] += step[OUTER]
            levels[2] += step[INNER]
            if reach < _CONVERGED_PX:
                break
        fits.sigma[b], fits.outer[b], fits.inner[b] = levels[0], levels[1], levels[2]
        for i in range(OUTLINE):
            fits.moved_px[b] = max(fits.moved_px[b], abs(shifts[i] - began[i]))
        if not first_look:
            _distances(shape, foot, shifts, distance)
            _judged(table, pixels, foot, distance, retreat, hidden, weight, levels, b, fits)
            if not crowded:
                continue
            _distances(bent, start, shifts, away)
            _derivatives(table, taken, bent, away, levels, rows)
            fits.clustered[b] = _clustered(foot, used, rows, covariance)
            light = _light(foot, distance, pixels[2], hidden, levels[0], rims.noise_outer[b])
            fits.light[b] = light / max(levels[1] - levels[2], 1e-3) ** 2
    return fits


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
    # The sums of u and of v are 0: the origin is the points' mean.
    total[0, 0] += 1e-9
    total[1, 1] += 1e-9
    total[2, 2] = u.size + 1e-9
    _cholesky(total)
    _substituted(total, right)
    radius = np.sqrt(max(right[2] + (right[0] * right[0] + right[1] * right[1]) / 4.0, 0.5))
    out[0], out[1], out[2], out[3], out[4] = right[0] / 2.0, right[1] / 2.0, radius, radius, 0.0


@compiled
def _move(ellipse: Array, step: Array) -> None:
    """Apply displacements (5,) to an ellipse, see `ellipse_geometry.moved`."""
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    ellipse[0] += cos * step[0] - sin * step[1]
    ellipse[1] += sin * step[0] + cos * step[1]
    a, b = ellipse[2] + step[2], ellipse[3] + step[3]
    half_gap = (a - b) / 2.0
    apart = np.sqrt(half_gap * half_gap + step[4] * step[4])
    ellipse[3] = max((a + b) / 2.0 - apart, 0.3)
    ellipse[2] = max((a + b) / 2.0 + apart, ellipse[3])
    ellipse[4] += 0.5 * np.arctan2(step[4], half_gap)


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
    total, step = np.empty((ELLIPSE + 1, ELLIPSE + 1)), np.empty(ELLIPSE)
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
            _cholesky(total[:ELLIPSE, :ELLIPSE])
            for i in range(ELLIPSE):
                step[i] = total[ELLIPSE, i]
            _substituted(total[:ELLIPSE, :ELLIPSE], step)
            reach = _reach(step)
            share = min(1.0, 0.4 * ellipse[3] / (reach + 1e-12))
            for i in range(ELLIPSE):
                step[i] *= share
            _move(ellipse, step)
            if not reach >= _ARC_CONVERGED_PX:
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
