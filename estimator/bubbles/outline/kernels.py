"""Compiled loops over the pixels at the rims, and over the points of arcs.

They work on one bubble after the other, in double precision: for a bubble of which the image shows
little, the smallest eigenvalue of the equilibrated normal equations is below the rounding error of
sums in single precision. The ellipses and their parameters are those of `ellipse_geometry`, the
model is that of `outline_fit`.

An outline is a row of 16 parameters: centre u, v, semi-axes a, b and angle of its ellipse, blur,
outer and inner level, and the coefficients of its harmonics. A step of the fit has the same order;
of the ellipse, it has the displacements of the centre along both axes, of a, of b, and the shear.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Float32, Ints
from telerig.compiled import compiled
from telerig.estimator.bubbles.outline import ellipse_geometry
from telerig.statistics import NORMAL_FROM_MEDIAN

Pixels = NDArray[np.int32]

ELLIPSE = 5
BLUR, OUTER, INNER, HARMONIC = 5, 6, 7, 8
PARAMETERS = 16
"""Positions in a row of parameters, and their number. The ellipse comes first; the eight harmonics
come last."""

COVARIANCE, SIGMA_OUTLINE, CHI2, COVERAGE, MISFIT, SHIFT = 0, 4, 5, 6, 7, 8
SHOWN = 9
"""Positions in a row of what a fit has shown, and their number; the covariance has four."""

PRIOR_INNER, PRIOR_FLATTENING, PRIOR_SPREAD, PRIOR_HARMONICS = 0, 1, 3, 4
"""Positions in a row of a prior; the flattening has two, the harmonics have four."""

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
_UNLIKE_SHARE, _UNLIKE_FROM = 0.015, 1.3
"""A ring of pixels is unlike a rim beyond this share of the contrast, outside so many blurs."""
_MARGIN_WITHIN, _MARGIN_OUTSIDE = 1.5, 1.2
"""What is nearer to the rim than such a ring by so many blurs is left out, too. Light within a
bubble is blurred like its rim and moves a small outline before it is 1.5 % of the contrast."""
_MOST_RINGS = 1000
_LEAST_FREEDOM = 4.0
"""Sectors of an outline that tell the variance of their errors."""
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
_LEAST_SLOPE, _FARTHEST_PX = 0.02, 1.2
"""Least slope at a region's outline, as a share of its depth, and how far its points are moved."""

_axis_distance = compiled(ellipse_geometry.axis_distance)


@compiled
def products(rows: Array, total: Array) -> None:
    """Write into the lower triangle of ``total`` the products of all pairs of n rows (n, N)."""
    n = rows.shape[0]
    for i in range(n):
        j = 0
        while j <= i:
            if j + _TILE <= n:
                a = b = c = d = 0.0
                for k in range(rows.shape[1]):
                    value = rows[i, k]
                    a += value * rows[j, k]
                    b += value * rows[j + 1, k]
                    c += value * rows[j + 2, k]
                    d += value * rows[j + 3, k]
                total[i, j], total[i, j + 1], total[i, j + 2], total[i, j + 3] = a, b, c, d
            else:
                for m in range(j, i + 1):
                    a = 0.0
                    for k in range(rows.shape[1]):
                        a += rows[i, k] * rows[m, k]
                    total[i, m] = a
            j += _TILE


@compiled
def feet(ellipse: Array, u: Array, v: Array, foot: Array) -> None:
    """Find the nearest points on an ellipse (its feet).

    ellipse : (5,) and more, of which the first five count.
    u, v : (N,) pixels of the points.
    foot : (7, N) and more; receives the cosine and the sine of the foot's eccentric anomaly, the
        distance of the point from the ellipse (px, positive outside), the length (px) of the
        derivative of the ellipse's point by the anomaly, the curvature there (1/px), and the
        outward unit normal along the major and the minor axis.

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
def _basis(foot: Array, square: float, out: Array) -> None:
    """Write into ``out`` (5 or 16, N) the derivatives of the outward displacement at the feet by
    the ellipse's displacements and, in the last eight of 16 rows, by the harmonics.

    square : (blur / radius)^2. Blur damps a wave of order k against a shift (k = 1) by I_k / I_1 of
    Bessel's functions, nearly exp(-(k^2 - 1) square / 2).
    """
    for k in range(foot.shape[1]):
        cos, sin, normal_x, normal_y = foot[0, k], foot[1, k], foot[5, k], foot[6, k]
        out[0, k], out[1, k] = normal_x, normal_y
        out[2, k], out[3, k] = normal_x * cos, normal_y * sin
        out[4, k] = normal_x * sin + normal_y * cos
    for i in range(HARMONIC, out.shape[0], 2):
        order = 3 + (i - HARMONIC) // 2
        damping = np.exp((1.0 - order * order) * square / 2.0)
        for k in range(foot.shape[1]):
            cos, sin = foot[0, k], foot[1, k]
            real, imaginary = cos * cos - sin * sin, 2.0 * cos * sin
            for _ in range(2, order):
                real, imaginary = real * cos - imaginary * sin, real * sin + imaginary * cos
            out[i, k], out[i + 1, k] = damping * real, damping * imaginary


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
    """Return (3, N) positions u, v (px) and values of the pixels near the rim of an ellipse.

    reach_px : greatest distance from the rim. step : take one row and one column in so many.
    """
    rows, columns = image.shape
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    extent = np.sqrt((ellipse[2] * sin) ** 2 + (ellipse[3] * cos) ** 2) + reach_px
    top = int(np.ceil(max(ellipse[1] - extent, 0.0) / step))
    bottom = int(np.floor(min(ellipse[1] + extent, rows - 1.0) / step))
    found, count = np.empty((3, 0)), 0
    for turn in range(2):
        if turn == 1:
            found, count = np.empty((3, count)), 0
        for row in range(top, bottom + 1):
            left, right = _chord(ellipse, reach_px, float(row * step))
            inner_left, inner_right = _chord(ellipse, -reach_px, float(row * step))
            last = -1
            for side in range(2):
                begin, end = left, min(inner_left, right)
                if side == 1:
                    begin, end = max(left, inner_right), right
                first = max(int(np.ceil(min(max(begin, 0.0), columns * 1.0) / step)), last + 1)
                last = int(np.floor(max(min(end, columns - 1.0), -1.0) / step))
                if turn == 0:
                    count += max(last - first + 1, 0)
                    continue
                for column in range(first, last + 1):
                    found[0, count], found[1, count] = column * step, row * step
                    found[2, count] = image[row * step, column * step]
                    count += 1
    return found


@compiled
def _hide(pixels: Array, own: int, rims: Array, hidden: Ints) -> None:
    """Write into ``hidden`` (N,) whether each pixel lies inside or near another bubble (1 or 0).

    own : position of the bubble among all; rims : (A, 6) ellipses of all bubbles and the blur of
    their edges (px).
    """
    for k in range(hidden.size):
        hidden[k] = 0
    own_reach = rims[own, 2] + 2.0 * _WINDOW_SIGMA * rims[own, BLUR]
    for other in range(rims.shape[0]):
        du, dv = rims[own, 0] - rims[other, 0], rims[own, 1] - rims[other, 1]
        reach = _WINDOW_SIGMA * rims[other, BLUR]
        far = own_reach + rims[other, 2] + 2.0 * reach
        if other == own or not du * du + dv * dv < far * far:
            continue
        cos, sin = np.cos(rims[other, 4]), np.sin(rims[other, 4])
        for k in range(hidden.size):
            du, dv = pixels[0, k] - rims[other, 0], pixels[1, k] - rims[other, 1]
            x, y = du * cos + dv * sin, dv * cos - du * sin
            if _axis_distance(rims[other, 2], rims[other, 3], x, y) < reach:
                hidden[k] = 1


@compiled
def _retreat(ellipse: Array, sigma: float, foot: Array) -> None:
    """Write into row 7 of the feet how far the blurred edge retreats because the curvature changes
    (px).

    Across the blur an arc runs at -(K y^2 / 2 + (K'' + 3 K^3) y^4 / 24) from its tangent, a circle
    of the same curvature at K'' = 0; the mean of y^4 is 3 sigma^4, so the blurred edge retreats
    by K'' sigma^4 / 8. K'' is the second derivative of the curvature by the arc's length.
    """
    a, b = ellipse[2], ellipse[3]
    for k in range(foot.shape[1]):
        foot[7, k] = 0.0
    if a * sigma <= _BENDING_FROM * b * b:
        return
    gap, limit = a * a - b * b, _MAX_RETREAT * sigma
    for k in range(foot.shape[1]):
        cos, sin, speed = foot[0, k], foot[1, k], foot[3, k]
        square = speed * speed
        turn, slope = gap * (cos * cos - sin * sin), gap * sin * cos
        bent = -0.375 * a * b * (turn - 6.0 * slope * slope / square)
        bent *= sigma**4 / (square * square * square * speed)
        foot[7, k] = min(max(bent, -limit), limit)


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
def _median(values: Array) -> float:
    """Return the upper median of values, which are put into another order (Hoare's selection)."""
    low, high, middle = 0, values.size - 1, values.size // 2
    while low < high:
        pivot, i, j = values[middle], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < middle:
            low = i
        if i > middle:
            high = j
    return float(values[middle])


@compiled
def _sector(cos: float, sin: float) -> int:
    """Return which sixteenth of an outline a foot is in, in no order; its half is the octant."""
    small, large = min(abs(cos), abs(sin)), max(abs(cos), abs(sin))
    octant = 4 * (cos > 0.0) + 2 * (sin > 0.0) + (abs(cos) > abs(sin))
    return int(2 * octant + (small > _HALF_OCTANT * large))


@compiled
def _leave_out_unlike(
    foot: Array, distance: Array, residual: Array, sigma: float, contrast: float, weight: Array
) -> None:
    """Set the weight of pixels to 0 that glare, dirt or a neighbouring bubble has changed.

    foot : (8, N) of `feet`; distance : (N,) distance from the outline (px), positive outside.
    residual : (N,) measured minus predicted grey level, divided by the noise.
    sigma : blur of the edges (px).
    contrast : background level minus the bubble's level, divided by the noise.

    The pixels are divided into rings of 1 px, inside and outside the outline, and into eight
    octants. In each octant, the pixels are left out from the first ring on that departs from the
    model: that is brighter inside (glare) or darker outside (dirt, neighbour), by more than 1.5 %
    of the contrast and by more than 3 standard deviations of the ring's mean.
    """
    many, rings = distance.size, 2
    part, ring = np.empty(many, np.int64), np.empty(many, np.int64)
    for k in range(many):
        part[k] = 2 * (_sector(foot[0, k], foot[1, k]) // 2) + (distance[k] > 0.0)
        # NaN and what is very far share the last ring.
        away = abs(distance[k])
        ring[k] = int(away) if away < _MOST_RINGS else _MOST_RINGS
        rings = max(rings, ring[k] + 2)
    count, total = np.zeros((2 * _OCTANTS, rings)), np.zeros((2 * _OCTANTS, rings))
    for k in range(many):
        count[part[k], ring[k]] += 1.0
        total[part[k], ring[k]] += residual[k]
    cut = np.empty(2 * _OCTANTS)
    for p in range(2 * _OCTANTS):
        sign, cut[p] = 1.0 - 2.0 * (p % 2), rings
        for r in range(int(np.ceil(_UNLIKE_FROM * sigma)), rings):
            mean = sign * total[p, r] / max(count[p, r], 1.0)
            strong = mean > _UNLIKE_SHARE * contrast
            if strong and mean * np.sqrt(count[p, r]) > _BEYOND_CHANCE and count[p, r] > 1.0:
                cut[p] = r
                break
    for k in range(many):
        margin = _MARGIN_OUTSIDE if distance[k] > 0.0 else _MARGIN_WITHIN
        if abs(distance[k]) > cut[part[k]] - margin * sigma:
            weight[k] = 0.0


@compiled
def _weigh(
    table: Array, values: Array, foot: Array, distance: Array, hidden: Ints, levels: Array,
    noise: Array, weight: Array,
) -> None:  # fmt: skip
    """Write into ``weight`` (N,) the inverse variances of the pixels, 0 for those left out.

    values : (N,) grey levels; levels : blur (px), outer and inner level. noise : outside and
    inside.
    """
    many, sigma, outer, contrast = distance.size, levels[0], levels[1], levels[1] - levels[2]
    outside, change = noise[0] * noise[0], noise[1] * noise[1] - noise[0] * noise[0]
    residual, sizes, seen = np.empty(many), np.empty(many), 0
    for k in range(many):
        covered = profile(table, (distance[k] + foot[7, k]) / sigma, foot[4, k] * sigma)[0]
        weight[k] = 1.0 / (outside + change * covered)
        residual[k] = (values[k] - outer + contrast * covered) * np.sqrt(weight[k])
    _leave_out_unlike(foot, distance, residual, sigma, contrast / noise[0], weight)
    reach = _WINDOW_SIGMA * sigma + _WINDOW_PX
    for k in range(many):
        size = abs(residual[k])
        if abs(distance[k]) < reach and size < np.inf and hidden[k] == 0 and weight[k] > 0.0:
            sizes[seen] = size
            seen += 1
        else:
            weight[k] = 0.0
    limit = _OUTLIER_SIGMA
    if seen > 0:
        limit *= max(NORMAL_FROM_MEDIAN * _median(sizes[:seen]), 1.0)
    for k in range(many):
        if not abs(residual[k]) < limit:
            weight[k] = 0.0


@compiled
def _distances(shape: Array, bare: Array, at: Array, out: Array) -> None:
    """Write into ``out`` (N,) the pixels' distances (px) from the outline at parameters (16,)."""
    for k in range(out.size):
        out[k] = bare[k]
    for i in range(shape.shape[0]):
        if at[i] != 0.0 and not BLUR <= i <= INNER:
            for k in range(out.size):
                out[k] -= at[i] * shape[i, k]


@compiled
def _derivatives(
    table: Array, pixels: Array, shape: Array, distance: Array, at: Array, rows: Array
) -> None:
    """Write into ``rows`` the derivatives of the grey levels by the parameters, and the residuals.

    pixels : (4, N) values, curvatures, retreats (px), roots of the weights. shape : (8 or 16, N)
    derivatives of the displacement. at : (16,) parameters. rows : (9 or 17, N); all are multiplied
    by the roots, the residuals are the last.
    """
    sigma, outer, contrast = at[BLUR], at[OUTER], at[INNER] - at[OUTER]
    last = rows.shape[0] - 1
    drop = np.empty(distance.size)
    for k in range(distance.size):
        away, curvature = (distance[k] + pixels[2, k]) / sigma, pixels[1, k] * sigma
        covered, by_distance, by_curvature = profile(table, away, curvature)
        root = pixels[3, k]
        slope = contrast / sigma * root
        rows[BLUR, k] = slope * (curvature * by_curvature - by_distance * away)
        rows[OUTER, k], rows[INNER, k] = root * (1.0 - covered), root * covered
        rows[last, k] = root * (pixels[0, k] - outer - contrast * covered)
        drop[k] = -slope * by_distance
    for i in range(last):
        if not BLUR <= i <= INNER:
            for k in range(distance.size):
                rows[i, k] = drop[k] * shape[i, k]


@compiled
def _add_prior(total: Array, prior: Array, ellipse: Array, at: Array) -> None:
    """Add the prior of a bubble to its normal equations; their right-hand side is the last row."""
    last, level = total.shape[0] - 1, 1.0 / _LEVEL_SPREAD**2
    total[OUTER, OUTER] += level
    total[INNER, INNER] += level
    total[last, OUTER] -= level * (at[OUTER] - 1.0)
    total[last, INNER] -= level * (at[INNER] - prior[PRIOR_INNER])
    radius = np.sqrt(ellipse[2] * ellipse[3])
    for i in range(HARMONIC, last):
        weight = 1.0 / (prior[PRIOR_HARMONICS + (i - HARMONIC) // 2] * radius) ** 2
        total[i, i] += weight
        total[last, i] -= weight * at[i]
    weight = 1.0 / (prior[PRIOR_SPREAD] * radius) ** 2
    cos, sin = np.cos(2.0 * ellipse[4]), np.sin(2.0 * ellipse[4])
    along = prior[PRIOR_FLATTENING] * cos + prior[PRIOR_FLATTENING + 1] * sin
    across = prior[PRIOR_FLATTENING + 1] * cos - prior[PRIOR_FLATTENING] * sin
    half = (ellipse[2] + at[2] - ellipse[3] - at[3]) / 2.0
    miss = weight * (half - radius * along) / 2.0
    total[2, 2] += weight / 4.0
    total[3, 3] += weight / 4.0
    total[3, 2] -= weight / 4.0
    total[4, 4] += weight
    total[last, 2] -= miss
    total[last, 3] += miss
    total[last, 4] -= weight * (at[4] - radius * across)


@compiled
def _unlike(at: Array, free: int, prior: Array, ellipse: Array) -> float:
    """Return the mean square of a fit's harmonics over what its prior expects: a prior that the
    image contradicts is no stronger than it is right."""
    square, radius2 = 0.0, ellipse[2] * ellipse[3]
    for i in range(HARMONIC, free):
        expected = prior[PRIOR_HARMONICS + (i - HARMONIC) // 2]
        square += at[i] * at[i] / (expected * expected * radius2 * (free - HARMONIC))
    return square


@compiled
def solve(total: Array, covariance: Array, step: Array) -> bool:
    """Solve normal equations of n parameters (lower triangle, right-hand side as last row).

    Writes the inverse into ``covariance`` (n, n) and the solution into the first n of ``step``;
    returns whether there is one. Cholesky's decomposition of the equilibrated matrix.
    """
    many = total.shape[0] - 1
    scale, root = np.empty(many), np.zeros((many, many))
    for i in range(many):
        for j in range(many):
            covariance[i, j] = 0.0
    for i in range(many):
        scale[i] = 1.0 / np.sqrt(max(total[i, i], 1e-12))
        if not abs(total[many, i]) < np.inf:
            return False
        for j in range(i + 1):
            entry = total[i, j] * scale[i] * scale[j]
            if i == j:
                entry += _RIDGE
            for k in range(j):
                entry -= root[i, k] * root[j, k]
            if i == j and not 0.0 < entry < np.inf:
                return False
            root[i, j] = np.sqrt(entry) if i == j else entry / root[j, j]
    for i in range(many):  # the inverse of the root takes its place
        root[i, i] = 1.0 / root[i, i]
        for j in range(i):
            entry = 0.0
            for k in range(j, i):
                entry -= root[i, k] * root[k, j]
            root[i, j] = entry * root[i, i]
    for i in range(many):
        step[i] = 0.0
    for i in range(many):
        for j in range(i + 1):
            entry = 0.0
            for k in range(i, many):
                entry += root[k, i] * root[k, j]
            covariance[i, j] = covariance[j, i] = entry * scale[i] * scale[j]
            step[i] += covariance[i, j] * total[many, j]
            if j < i:
                step[j] += covariance[i, j] * total[many, i]
    return True


@compiled
def _largest(values: Array) -> float:
    """Return the largest absolute value; infinite if one is not finite."""
    largest: float = 0.0
    for i in range(values.size):
        if not abs(values[i]) < np.inf:
            return np.inf
        largest = max(largest, abs(values[i]))
    return largest


@compiled
def _judge(
    table: Array, values: Array, foot: Array, distance: Array, hidden: Ints, weight: Array,
    at: Array, noise: float, shown: Array,
) -> None:  # fmt: skip
    """Write the sum of squared weighted residuals of a fitted outline, its coverage, and its
    misfit (px), which includes outliers, into a row of what the fit has shown."""
    sigma, outer, contrast = at[BLUR], at[OUTER], at[INNER] - at[OUTER]
    seen, many, square = np.zeros(_BINS), 0, 0.0
    for k in range(distance.size):
        near = abs(distance[k]) < sigma and hidden[k] == 0
        if not near and weight[k] == 0.0:
            continue
        covered = profile(table, (distance[k] + foot[7, k]) / sigma, foot[4, k] * sigma)[0]
        residual = values[k] - outer - contrast * covered
        if near:
            many += 1
            square += residual * residual
        if weight[k] > 0.0:
            shown[CHI2] += weight[k] * residual * residual
            if abs(distance[k]) < 1.2 * sigma + 0.3:
                angle = np.arctan2(foot[1, k], foot[0, k]) + np.pi
                seen[int(angle * (_BINS / (2.0 * np.pi))) % _BINS] = 1.0 / _BINS
    for share in seen:
        shown[COVERAGE] += share
    excess = max(square / max(many, 1) - noise * noise, 0.0)
    shown[MISFIT] = np.sqrt(excess) / max(_MEAN_SLOPE * abs(contrast) / sigma, 1e-9)


@compiled
def _clustered(sector: Ints, rows: Array, step: Array, covariance: Array, excess: float) -> float:
    """Return the variance of the centre with errors that pixels of a sector share, over that with
    the independent errors of the weights (the sandwich estimator for clusters, less what the fit
    absorbs; the variance of Student's t for as many sectors), times the excess: what misleads a fit
    moves neighbouring sectors alike, too.

    sector : (M,) of the pixels. rows : (n + 1, M) whitened derivatives and residuals before the
    last step (n,); covariance : (n, n), of the parameters by the weights alone.
    excess : variance of independent errors over that of the weights.
    """
    many = rows.shape[0] - 1
    shared = expected = squares = 0.0
    for axis in range(2):
        shift, own, gain = np.zeros(_SECTORS), np.zeros(_SECTORS), np.zeros((_SECTORS, many))
        for k in range(sector.size):
            pull = 0.0
            for i in range(many):
                pull += covariance[axis, i] * rows[i, k]
            shift[sector[k]] += pull * rows[many, k]
            own[sector[k]] += pull * pull
            for i in range(many):
                gain[sector[k], i] += pull * rows[i, k]
        for s in range(_SECTORS):
            for i in range(many):
                shift[s] -= gain[s, i] * step[i]
                for j in range(many):
                    own[s] -= gain[s, i] * covariance[i, j] * gain[s, j]
            share = own[s] / covariance[axis, axis]
            shared += shift[s] * shift[s] / covariance[axis, axis]
            expected += share
            squares += share * share
    freedom = max(expected * expected / max(squares, 1e-18), _LEAST_FREEDOM)
    student = freedom / (freedom - 2.0)
    return excess * max(1.0, student * shared / max(expected, 1e-9))


@compiled
def _light(
    foot: Array, distance: Array, values: Array, hidden: Ints, sigma: float, noise: float
) -> float:
    """Return the variance along an outline of the level just outside its edge, less its noise;
    0 if that may be chance.

    distance, values, hidden : (N,) distances of the pixels from the outline (px), grey levels, and
    whether another bubble hides them; sigma : blur (px); noise : standard deviation of a pixel.
    """
    count, total = np.zeros(_SECTORS), np.zeros(_SECTORS)
    for k in range(distance.size):
        if distance[k] > 2.2 * sigma and hidden[k] == 0:
            sector = _sector(foot[0, k], foot[1, k])
            count[sector] += 1.0
            total[sector] += values[k]
    level, seen, expected, chance = np.empty(_SECTORS), 0, 0.0, 0.0
    for s in range(_SECTORS):
        if count[s] > 2.0:
            level[seen] = total[s] / count[s]
            expected += noise * noise / count[s]
            chance += 2.0 * (noise * noise / count[s]) ** 2
            seen += 1
    if seen < _SECTORS // 4:
        return 0.0
    middle, variance = _median(level[:seen]), 0.0
    for s in range(seen):
        variance += (level[s] - middle) ** 2 / seen
    expected, chance = expected / seen, np.sqrt(chance) / seen
    return variance - expected if variance > expected + _BEYOND_CHANCE * chance else 0.0


@compiled
def _move(ellipse: Array, step: Array) -> float:
    """Apply displacements to an ellipse, the first five of both; return the angle (rad) by which
    it has turned."""
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
def fitted(
    image: Float32,
    table: Array,
    noise: Array,
    rims: Array,
    own: Ints,
    prior: Array,
    parameters: Array,
    shown: Array,
    steps: int,
    misled_below: float,
) -> None:
    """Fit outlines by Gauss-Newton steps, the nearest points on the ellipses held fixed.

    image : (rows, columns) grey levels divided by the background.
    table : profile of a blurred disc (curvatures, distances), see `profile`.
    noise : (2,) standard deviation of a pixel outside and inside the bubbles.
    rims : (A, 6) ellipses and blurs of all outlines; pixels inside or near another one are left
        out.
    own : (B,) positions of those that are fitted; prior : (B, 8) of them.
    parameters : (B, 16), which the fit replaces; shown : (B, 9) receives what it has shown.
    steps : largest number of steps; none is a first look, at some pixels in a narrow band, that
        finds the ellipse, blur and levels.
    misled_below : coverage of an outline below which its centre's covariance has what misleads its
        fit; so has that of one that fits worse than the noise explains.
    """
    first_look = steps == 0
    at, began, step = np.empty(PARAMETERS), np.empty(PARAMETERS), np.empty(PARAMETERS)
    for b in range(own.size):
        outline, result = parameters[b], shown[b]
        if not _largest(outline[: BLUR + 1]) < np.inf:
            continue
        sigma = outline[BLUR]
        free = PARAMETERS
        if first_look or outline[3] <= RESOLVED_BLURS * sigma:
            free = HARMONIC
        reach = _WINDOW_SIGMA * sigma + _WINDOW_PX + 0.2 * sigma + 0.7
        for i in range(PARAMETERS):
            at[i] = outline[i] if BLUR <= i < free else 0.0
            began[i] = at[i]
            if i >= HARMONIC:
                reach += abs(at[i])
        thin = first_look and outline[3] > _THIN_ABOVE_PX
        pixels = _gathered(image, outline, reach, 2 if thin else 1)
        many = pixels.shape[1]
        foot, shape = np.empty((8, many)), np.empty((free, many))
        feet(outline, pixels[0], pixels[1], foot)
        _basis(foot, sigma * sigma / (outline[2] * outline[3]), shape)
        _retreat(outline, sigma, foot)
        hidden = np.empty(many, np.int64)
        _hide(pixels, own[b], rims, hidden)
        distance, weight = np.empty(many), np.empty(many)
        _distances(shape, foot[2], at, distance)
        if first_look:
            lowest = -min(2.0 * sigma + 0.5, 0.45 * outline[3])
            for k in range(many):
                inside = lowest < distance[k] < 2.5 * sigma + 1.0 and hidden[k] == 0
                weight[k] = 1.0 / (noise[0] * noise[0]) if inside else 0.0
        else:
            _weigh(table, pixels[2], foot, distance, hidden, at[BLUR:HARMONIC], noise, weight)
        used = np.empty(many, np.int64)
        count = 0
        for k in range(many):
            if weight[k] > 0.0:
                used[count] = k
                count += 1
        taken, bent = np.empty((4, count)), np.empty((free, count))
        bare, away = np.empty(count), np.empty(count)
        sector = np.empty(count, np.int64)
        for m in range(count):
            k = used[m]
            taken[0, m], taken[1, m], taken[2, m] = pixels[2, k], foot[4, k], foot[7, k]
            taken[3, m], bare[m] = np.sqrt(weight[k]), foot[2, k]
            sector[m] = _sector(foot[0, k], foot[1, k])
        for i in range(free):
            for m in range(count):
                bent[i, m] = shape[i, used[m]]
        rows, total = np.empty((free + 1, count)), np.empty((free + 1, free + 1))
        covariance = np.zeros((free, free))
        for _ in range(max(steps, _FIRST_STEPS)):
            _distances(bent, bare, at, away)
            _derivatives(table, taken, bent, away, at, rows)
            products(rows, total)
            _add_prior(total, prior[b], outline, at)
            if not (solve(total, covariance, step) and _largest(step[:free]) < np.inf):
                break
            # so short that the linearisation stays valid
            far = _largest(step[:ELLIPSE])
            share = min(1.0, min(1.5, 0.3 * outline[3]) / (far + 1e-12))
            share = min(share, 0.4 * at[BLUR] / (abs(step[BLUR]) + 1e-12))
            for i in range(free):
                step[i] *= share
                at[i] += step[i]
            at[BLUR] = max(at[BLUR], _LEAST_SIGMA_PX)
            if share * far < _CONVERGED_PX:
                break
        for i in range(PARAMETERS):
            if not BLUR <= i <= INNER:
                result[SHIFT] = max(result[SHIFT], abs(at[i] - began[i]))
        if not first_look:
            _distances(shape, foot[2], at, distance)
            _judge(table, pixels[2], foot, distance, hidden, weight, at, noise[0], result)
            dof = max(count - free, 1.0)
            result[CHI2] /= dof
            excess, uneven = 1.0, 0.0
            if result[CHI2] > 1.0 + _BEYOND_CHANCE * np.sqrt(2.0 / dof):
                excess = result[CHI2]
            misled = excess * max(1.0, _unlike(at, free, prior[b], outline))
            if (result[COVERAGE] < misled_below or excess > 1.0) and count > free:
                misled = _clustered(sector, rows, step, covariance, misled)
                uneven = _light(foot, distance, pixels[2], hidden, at[BLUR], noise[0])
                uneven *= (at[BLUR] / max(at[OUTER] - at[INNER], 1e-3)) ** 2 * _UNEVEN_LIGHT
            uu, vv = misled * covariance[0, 0] + uneven, misled * covariance[1, 1] + uneven
            uv = misled * covariance[1, 0]
            cos, sin = np.cos(outline[4]), np.sin(outline[4])
            result[COVARIANCE] = cos * cos * uu - 2.0 * cos * sin * uv + sin * sin * vv
            result[COVARIANCE + 1] = cos * sin * (uu - vv) + (cos * cos - sin * sin) * uv
            result[COVARIANCE + 2] = result[COVARIANCE + 1]
            result[COVARIANCE + 3] = sin * sin * uu + 2.0 * cos * sin * uv + cos * cos * vv
            if free > HARMONIC:
                variance = 0.0
                for i in range(HARMONIC, free):
                    variance += excess * covariance[i, i] / (free - HARMONIC)
                result[SIGMA_OUTLINE] = np.sqrt(max(variance, 0.0))
        turn = _move(outline, at)
        for i in range(BLUR, HARMONIC):
            outline[i] = at[i]
        for i in range(HARMONIC, PARAMETERS, 2):  # after the major axis has turned
            angle = (3 + (i - HARMONIC) // 2) * turn
            cos, sin = np.cos(angle), np.sin(angle)
            outline[i] = at[i] * cos + at[i + 1] * sin
            outline[i + 1] = at[i + 1] * cos - at[i] * sin


@compiled
def move_to_half_depth(
    ratio: Float32, pixels: Pixels, inner: float, points: Array, slope: Array
) -> None:
    """Move the pixels of a dark region's outline along the gradient to half of its depth.

    ratio : (rows, columns) grey levels divided by the background; inner : level of the region.
    pixels : (n, 2) outline. points : (n, 2) receives the places (px), NaN on the image's border;
        slope : (n,) the gradient's size by Sobel's filter (1/px), at least 2 % of the depth.
    """
    rows, columns = ratio.shape
    for k in range(slope.size):
        u, v = pixels[k, 0], pixels[k, 1]
        left, right = max(u - 1, 0), min(u + 1, columns - 1)
        above, below = max(v - 1, 0), min(v + 1, rows - 1)
        falling = ratio[below, right] - ratio[above, left]
        rising = ratio[above, right] - ratio[below, left]
        across = (2.0 * (ratio[v, right] - ratio[v, left]) + falling + rising) / 8.0
        down = (2.0 * (ratio[below, u] - ratio[above, u]) + falling - rising) / 8.0
        slope[k] = max(np.sqrt(across * across + down * down), _LEAST_SLOPE * (1.0 - inner))
        shift = (0.5 * (1.0 + inner) - ratio[v, u]) / slope[k]
        shift = min(max(shift, -_FARTHEST_PX), _FARTHEST_PX) / slope[k]
        points[k, 0], points[k, 1] = u + shift * across, v + shift * down
        if not (0 < u < columns - 1 and 0 < v < rows - 1):
            points[k, 0] = points[k, 1] = np.nan


@compiled
def _circle(u: Array, v: Array, out: Array) -> None:
    """Write into ``out`` (5,) the circle through points whose mean is the origin, by least
    squares."""
    uu = uv = vv = right_u = right_v = rest = 0.0
    for k in range(u.size):
        square = u[k] * u[k] + v[k] * v[k]
        uu += u[k] * u[k]
        uv += u[k] * v[k]
        vv += v[k] * v[k]
        right_u += u[k] * square
        right_v += v[k] * square
        rest += square / u.size
    uu, vv = uu + 1e-9, vv + 1e-9
    per = 0.5 / (uu * vv - uv * uv)
    out[0], out[1] = (vv * right_u - uv * right_v) * per, (uu * right_v - uv * right_u) * per
    out[2] = out[3] = np.sqrt(max(rest + out[0] * out[0] + out[1] * out[1], 0.5))
    out[4] = 0.0


@compiled
def fitted_arcs(points: Array, sizes: Ints, ellipses: Array, rms: Array) -> None:
    """Fit ellipses along arcs, robustly, see `blobs.fit_ellipses`.

    points : (N, 2) the arcs' points (px), one arc after the other; sizes : (B,) their numbers.
    ellipses : (B, 5) receives the ellipses; rms : (B,) the RMS distances of their points (px).
    """
    total, covariance = np.empty((ELLIPSE + 1, ELLIPSE + 1)), np.empty((ELLIPSE, ELLIPSE))
    step, first = np.empty(ELLIPSE), 0
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
        weight = 1.0 / (_ROUND_SHARE * ellipse[2]) ** 2
        foot, rows = np.empty((7, many)), np.empty((ELLIPSE + 1, many))
        feet(ellipse, u, v, foot)
        for _ in range(_ARC_ROUNDS):
            _basis(foot, 0.0, rows[:ELLIPSE])
            for k in range(many):
                far = foot[2, k] / _FAR_PX
                root = 1.0 / (_POINT_SIGMA_PX * np.sqrt(1.0 + far * far))
                for i in range(ELLIPSE):
                    rows[i, k] *= root
                rows[ELLIPSE, k] = foot[2, k] * root
            products(rows, total)
            gap = (ellipse[2] - ellipse[3]) * weight
            total[2, 2] += weight
            total[3, 3] += weight
            total[3, 2] -= weight
            total[4, 4] += 4.0 * weight
            total[ELLIPSE, 2] -= gap
            total[ELLIPSE, 3] += gap
            for i in range(ELLIPSE):
                total[i, i] += 1e-6
            if not solve(total, covariance, step):
                break
            reach = _largest(step[:ELLIPSE])
            if not reach < np.inf:
                break
            for i in range(ELLIPSE):
                step[i] *= min(1.0, 0.4 * ellipse[3] / (reach + 1e-12))
            _move(ellipse, step)
            feet(ellipse, u, v, foot)
            if reach < _CONVERGED_PX:
                break
        square = 0.0
        for k in range(many):
            square += foot[2, k] * foot[2, k]
        rms[arc] = np.sqrt(square / many)
        ellipse[0] += u0
        ellipse[1] += v0
