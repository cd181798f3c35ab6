"""Compiled loops: how much of each pixel's blurred footprint an ellipse covers, and the fit of a
dot."""

from __future__ import annotations

from math import ceil, cos, erf, exp, pi, sin, sqrt

import numpy as np

from telerig.arrays import Array, Ints
from telerig.compiled import compiled

_FOURTH = -1.0 / 120.0 / 24.0
_ROOT_2PI = sqrt(2.0 * pi)
_NODE_SPACING_SIGMA = 1.1
_LEAST_NODES = 24
_REACH_SIGMA = 7.0
"""Beyond so many standard deviations the point spread is below 1e-10 of its peak."""
_NO_INFORMATION = 1e-6
"""A pixel that tells an edge's place to a thousand radii tells nothing."""
_MIN_SIGMA_PX, _MIN_SEMI_AXIS_PX = 0.3, 0.6


@compiled
def coverages(first: Array, theta: Array, value: Array, gradient: Array) -> None:
    """Compute coverages and their derivatives; see `blurred_ellipse.coverage_on_grid`.

    first : (D, 2) u and v of each grid's first pixel. theta : (D, 6) centre, shape and sigma.
    value, gradient : (D, V, U) and (D, 6, V, U), which must be 0 and are filled.

    Each node of the contour adds the product of a row and a column function, which differ from 0
    only near the node. Where the column function is the integral of the point spread, all pixels
    farther to the left have its full value: it is added to the last of them, and carried on at the
    end.
    """
    height, width = value.shape[1], value.shape[2]
    across, along = np.empty((3, width)), np.empty((2, height))
    full = np.empty((2, height, width))
    for n in range(len(theta)):
        centre_u, centre_v, m11, m12, m22, sigma = theta[n]
        longest = 0.5 * (m11 + m22) + sqrt(0.25 * (m11 - m22) ** 2 + m12 * m12)
        nodes = max(_LEAST_NODES, ceil(2.0 * pi * longest / sigma / _NODE_SPACING_SIGMA))
        k, peak = _FOURTH / sigma**4, 1.0 / (_ROOT_2PI * sigma)
        full[:] = 0.0
        for node in range(nodes):
            c, s = cos(2.0 * pi * node / nodes), sin(2.0 * pi * node / nodes)
            normal_u = (m22 * c - m12 * s) * (2.0 * pi / nodes)
            normal_v = (m11 * s - m12 * c) * (2.0 * pi / nodes)
            x, y = centre_u + m11 * c + m12 * s - first[n, 0], centre_v + m12 * c + m22 * s
            y -= first[n, 1]
            reach = _REACH_SIGMA * sigma
            left, right = max(ceil(x - reach), 0), min(int(x + reach) + 1, width)
            low, high = max(ceil(y - reach), 0), min(int(y + reach) + 1, height)
            for u in range(left, right):
                z = (x - u) / sigma
                z2 = z * z
                g = exp(-0.5 * z2) * peak
                across[0, u] = 0.5 + 0.5 * erf(z * sqrt(0.5)) - k * sigma * z * (z2 - 3.0) * g
                across[1, u] = g * (1.0 + k * (z2 * (z2 - 6.0) + 3.0))
                across[2, u] = -g * z * (1.0 + k * (z2 * (z2 - 10.0) + 15.0))
            for v in range(low, high):
                z = (y - v) / sigma
                z2 = z * z
                g = exp(-0.5 * z2) * peak
                along[0, v] = g * (1.0 + k * (z2 * (z2 - 6.0) + 3.0))
                bent = z2 * (z2 * (z2 - 15.0) + 45.0) - 15.0
                along[1, v] = g / sigma * (z2 - 1.0 + k * bent)
            by_m12 = normal_u * s + normal_v * c
            for v in range(low, high):
                d, bent = along[0, v], normal_u * along[1, v]
                flux = normal_u * d
                for u in range(left, right):
                    inside, density = across[0, u], d * across[1, u]
                    value[n, v, u] += flux * inside
                    gradient[n, 0, v, u] += normal_u * density
                    gradient[n, 1, v, u] += normal_v * density
                    gradient[n, 2, v, u] += normal_u * c * density
                    gradient[n, 3, v, u] += by_m12 * density
                    gradient[n, 4, v, u] += normal_v * s * density
                    gradient[n, 5, v, u] += flux * across[2, u] + bent * inside
                last = min(left, width) - 1
                if last >= 0:
                    full[0, v, last] += flux
                    full[1, v, last] += bent
        for v in range(height):
            inside, by_sigma = 0.0, 0.0
            for u in range(width - 1, -1, -1):
                inside += full[0, v, u]
                by_sigma += full[1, v, u]
                value[n, v, u] += inside
                gradient[n, 5, v, u] += by_sigma


@compiled
def ellipse_distances(shape: Array, x: Array, y: Array, out: Array) -> None:
    """Fill in the distances (P,) of pixels from an ellipse; see `approximate_distance_px`."""
    m11, m12, m22 = shape[0], shape[1], shape[2]
    determinant, deepest = m11 * m22 - m12 * m12, -0.5 * (m11 + m22)
    for p in range(len(out)):
        a = (m22 * x[p] - m12 * y[p]) / determinant
        b = (m11 * y[p] - m12 * x[p]) / determinant
        radius = sqrt(a * a + b * b) + 1e-12
        across, along = m22 * a - m12 * b, m11 * b - m12 * a
        slope = sqrt(across * across + along * along) / (determinant * radius) + 1e-12
        out[p] = max((radius - 1.0) / slope, deepest)


@compiled
def predict(
    at: Ints, first: Array, radius: float, parameters: Array, value: Array, gradient: Array,
    grey: Array, jacobian: Array,
) -> None:  # fmt: skip
    """Compute the grey levels of the luminance model and their derivatives; see `luminance`.

    at : (P, 2) row and column of each pixel in the window. first : (1, 2) u and v of the window's
    first pixel, from its middle. parameters : (12,) theta and the levels, or (16,) with a heart.
    value, gradient : (1, V, U), (1, 6, V, U) work space. grey, jacobian : (P,), (12 or 16, P),
    filled.
    """
    theta = np.empty((1, 6))
    for i in range(6):
        theta[0, i] = parameters[i]
    value[:] = 0.0
    gradient[:] = 0.0
    coverages(first, theta, value, gradient)
    spread = theta[0, 5] ** 2 / radius
    for p in range(len(at)):
        v, u = at[p, 0], at[p, 1]
        x, y = (first[0, 0] + u) / radius, (first[0, 1] + v) / radius
        covered = value[0, v, u]
        contrast = parameters[9] + parameters[10] * x + parameters[11] * y
        for i in range(6):
            jacobian[i, p] = gradient[0, i, v, u] * contrast
        jacobian[6, p], jacobian[7, p], jacobian[8, p] = 1.0, x, y
        jacobian[9, p] = covered
        jacobian[10, p] = covered * x - spread * gradient[0, 0, v, u]
        jacobian[11, p] = covered * y - spread * gradient[0, 1, v, u]
        grey[p] = 0.0
        for i in range(6, 12):
            grey[p] += parameters[i] * jacobian[i, p]
    if len(parameters) == 12:
        return
    scale, extra = parameters[14], parameters[15]
    for i in range(5):
        theta[0, i] = parameters[12 + i] if i < 2 else scale * parameters[i]
    value[:] = 0.0
    gradient[:] = 0.0
    coverages(first, theta, value, gradient)
    for p in range(len(at)):
        v, u = at[p, 0], at[p, 1]
        jacobian[14, p] = 0.0
        for i in range(6):
            slope = extra * gradient[0, i, v, u]
            if i < 2:
                jacobian[12 + i, p] = slope
            elif i < 5:
                jacobian[14, p] += parameters[i] * slope
                jacobian[i, p] += scale * slope
            else:
                jacobian[5, p] += slope
        jacobian[15, p] = value[0, v, u]
        grey[p] += extra * value[0, v, u]


@compiled
def prior_rows(prior: Array, radius: float, parameters: Array, rows: Array, gap: Array) -> float:
    """Fill in the whitened equations of the priors on two contrast gradients, the edge's blur, and
    the size and light of a heart.

    prior : (9,) the fields of `luminance.Prior`. rows : (5, N), which must be 0. gap : (5,) prior
    minus present value. Returns the sum of its squares.
    """
    weight = 1.0 / (prior[2] * radius * max(abs(parameters[9]), 1e-12))
    for k in range(2):
        rows[k, 10 + k] = weight
        rows[k, 9] = -prior[k] * radius * weight
    rows[2, 5] = 1.0 / prior[4]
    if len(parameters) > 12:
        rows[3, 14] = 1.0 / prior[6]
        rows[4, 15] = 1.0 / (prior[8] * max(abs(parameters[9]), 1e-12))
        rows[4, 9] = -prior[7] * rows[4, 15]
    total = 0.0
    for k in range(len(rows)):
        gap[k] = 0.0
        if k == 2:
            gap[k] = prior[3] * rows[2, 5]
        elif k == 3 and len(parameters) > 12:
            gap[k] = prior[5] * rows[3, 14]
        for i in range(len(parameters)):
            gap[k] -= rows[k, i] * parameters[i]
        total += gap[k] ** 2
    return total


@compiled
def normal_equations(
    prior: Array, radius: float, parameters: Array, residual: Array, weight: Array,
    jacobian: Array, information: Array, pull: Array,
) -> float:  # fmt: skip
    """Fill in information (N, N) and gradient (N,) of a fit, and return its chi-square."""
    count = len(parameters)
    rows, gap, weighted = np.zeros((5, count)), np.zeros(5), np.empty(len(residual))
    chi2 = prior_rows(prior, radius, parameters, rows, gap)
    for p in range(len(residual)):
        chi2 += weight[p] * residual[p] ** 2
    for i in range(count):
        total = 0.0
        for p in range(len(residual)):
            weighted[p] = weight[p] * jacobian[i, p]
            total += weighted[p] * residual[p]
        for k in range(len(rows)):
            total += rows[k, i] * gap[k]
        pull[i] = total
        for j in range(i + 1):
            total = 0.0
            for p in range(len(residual)):
                total += weighted[p] * jacobian[j, p]
            for k in range(len(rows)):
                total += rows[k, i] * rows[k, j]
            information[i, j] = information[j, i] = total
    return chi2


@compiled
def damped_step(information: Array, pull: Array, damping: float, step: Array) -> None:
    """Solve the normal equations, scaled to a unit diagonal and damped, by Cholesky factors."""
    count = len(pull)
    root, scale = np.zeros((count, count)), np.empty(count)
    for i in range(count):
        scale[i] = sqrt(max(information[i, i], 1e-300))
    for i in range(count):
        for j in range(i + 1):
            total = information[i, j] / (scale[i] * scale[j])
            if i == j:
                total += damping
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = sqrt(max(total, 1e-14)) if i == j else total / root[j, j]
    for i in range(count):
        total = pull[i] / scale[i]
        for k in range(i):
            total -= root[i, k] * step[k]
        step[i] = total / root[i, i]
    for i in range(count - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, count):
            total -= root[k, i] * step[k]
        step[i] = total / root[i, i]
    for i in range(count):
        step[i] /= scale[i]


@compiled
def covariance_of(information: Array, which: Ints, out: Array) -> None:
    """Fill in the covariance (k, k) of some of the N parameters, the k ones in ``which``."""
    count = len(information)
    pull, step = np.empty(count), np.empty(count)
    for k in range(len(which)):
        for i in range(count):
            pull[i] = 1.0 if i == which[k] else 0.0
        damped_step(information, pull, 0.0, step)
        for j in range(len(which)):
            out[j, k] = step[which[j]]


@compiled
def residual_sums(
    line: Array, clip: Array, model: Array, residual: Array, weight: Array, distance: Array,
    covered: Array, reach: float, inside: float, sums: Array,
) -> None:  # fmt: skip
    """Add up what the residuals of a fit show.

    line : (3,) alpha, beta and floor of the noise. clip : (2,) grey levels of clipping.
    model, residual, weight, distance, covered : (P,) of each pixel: predicted grey level, residual,
    inverse variance, distance from the edge, and how much of it the dot covers.
    reach : an edge's pixels are nearer than this. inside : least ``covered`` of an inner pixel.
    sums : (6,), filled: number of the pixels used, which are neither outliers nor clipped, and
    their chi-square; number of those at the edge and the sum of their squares; number of the inner
    ones and their chi-square.
    """
    for k in range(6):
        sums[k] = 0.0
    for p in range(len(model)):
        near = 2.0 * sqrt(max(line[0] + line[1] * model[p], line[2]))
        grey = model[p] + residual[p]
        clipped = min(grey, model[p] - near) <= clip[0] or max(grey, model[p] + near) >= clip[1]
        if weight[p] <= 0.0 or clipped:
            continue
        square = residual[p] ** 2
        sums[0] += 1.0
        sums[1] += weight[p] * square
        if abs(distance[p]) < reach:
            sums[2] += 1.0
            sums[3] += square
        if covered[p] > inside:
            sums[4] += 1.0
            sums[5] += weight[p] * square


@compiled
def is_admissible(parameters: Array, radius: float) -> bool:
    """Return whether a fit is near its start, none may run away over the image, and whether its
    heart is inside the dot."""
    m11, m12, m22, sigma = parameters[2], parameters[3], parameters[4], parameters[5]
    mean, half = 0.5 * (m11 + m22), sqrt(0.25 * (m11 - m22) ** 2 + m12 * m12)
    near = max(abs(parameters[0]), abs(parameters[1])) < radius + 2.0
    if len(parameters) > 12:
        way = sqrt((parameters[12] - parameters[0]) ** 2 + (parameters[13] - parameters[1]) ** 2)
        least = parameters[14] * (mean - half)
        near &= least > _MIN_SEMI_AXIS_PX and way + least < mean - half
    size = mean + half < 2.0 * radius + 3.0 and mean - half > _MIN_SEMI_AXIS_PX
    return bool(near and size and _MIN_SIGMA_PX <= sigma <= 1.5 * (mean + half) + 1.0)


@compiled
def descend(
    at: Ints, first: Array, radius: float, prior: Array, grey: Array, weight: Array,
    value: Array, gradient: Array, parameters: Array, residual: Array, jacobian: Array,
    iterations: int, tolerance: float,
) -> bool:  # fmt: skip
    """Take Levenberg-Marquardt steps at fixed weights; return whether the fit has converged.

    It has when a step would lower chi-square by less than ``tolerance``, relative to chi-square
    per pixel above 1; that step is taken without another evaluation. ``parameters``, ``residual``
    and ``jacobian`` are those of the start, and are replaced by those of the end.
    """
    count = len(parameters)
    information, pull = np.empty((count, count)), np.empty(count)
    step, moved = np.empty(count), np.empty(count)
    model, slopes = np.empty(len(residual)), np.empty((count, len(residual)))
    damping, gap = 1e-4, np.zeros(5)
    for _ in range(iterations):
        chi2 = normal_equations(
            prior, radius, parameters, residual, weight, jacobian, information, pull
        )
        damped_step(information, pull, damping, step)
        gain = 0.0
        for i in range(count):
            moved[i] = parameters[i] + step[i]
            gain += step[i] * pull[i]
        better = False
        if is_admissible(moved, radius):
            small = gain < tolerance * max(1.0, chi2 / max(len(residual), 1))
            if small and damping <= 1e-3:
                for i in range(count):
                    parameters[i] = moved[i]
                    for p in range(len(residual)):
                        residual[p] -= step[i] * jacobian[i, p]
                return True
            predict(at, first, radius, moved, value, gradient, model, slopes)
            trial = prior_rows(prior, radius, moved, np.zeros((5, count)), gap)
            for p in range(len(residual)):
                trial += weight[p] * (grey[p] - model[p]) ** 2
            better = trial <= chi2 * (1.0 + 1e-12)
        if better:
            for i in range(count):
                parameters[i] = moved[i]
                for p in range(len(residual)):
                    jacobian[i, p] = slopes[i, p]
            for p in range(len(residual)):
                residual[p] = grey[p] - model[p]
            damping = max(damping / 10.0, 1e-9)
        else:
            damping = max(damping, 1e-4) * 10.0
            if damping > 1e8:
                return False
    return False


@compiled
def edge_equations(
    orders: Ints, shape: Array, offset: Array, jacobian: Array, weight: Array, residual: Array,
    own: Array, mixed: Array, right: Array,
) -> None:  # fmt: skip
    """Add up the normal equations of a dot's edge; see `rim.edge_harmonics`.

    orders : (K,) the harmonics, in ascending order. shape : (3,). offset : (2, P). jacobian,
    weight, residual : those of the fit. own, mixed, right : (2 K, 2 K), (2 K, N), (2 K,), which
    must be 0 and are filled: the harmonics' information, the one they share with the parameters,
    and the gradient.
    """
    m11, m12, m22 = shape[0], shape[1], shape[2]
    row = np.empty(len(right))
    for p in range(len(weight)):
        x = m22 * offset[0, p] - m12 * offset[1, p]
        y = m11 * offset[1, p] - m12 * offset[0, p]
        length = sqrt(x * x + y * y)
        if length == 0.0:
            continue
        x, y = x / length, y / length
        out = jacobian[0, p] * (m11 * x + m12 * y) + jacobian[1, p] * (m12 * x + m22 * y)
        if weight[p] * out * out < _NO_INFORMATION:
            continue
        c, s, order = 1.0, 0.0, 0
        for k in range(len(orders)):
            while order < orders[k]:
                c, s, order = c * x - s * y, s * x + c * y, order + 1
            row[2 * k], row[2 * k + 1] = out * c, out * s
        for i in range(len(right)):
            weighted = weight[p] * row[i]
            right[i] += weighted * residual[p]
            for j in range(i + 1):
                own[i, j] += weighted * row[j]
            for j in range(len(jacobian)):
                mixed[i, j] += weighted * jacobian[j, p]
    for i in range(len(right)):
        for j in range(i):
            own[j, i] = own[i, j]
