"""Compiled loop: how much of each pixel's blurred footprint an ellipse covers."""

from __future__ import annotations

from math import ceil, cos, erf, exp, pi, sin, sqrt

import numpy as np

from telerig.arrays import Array
from telerig.compiled import compiled

_FOURTH = -1.0 / 120.0 / 24.0
_ROOT_2PI = sqrt(2.0 * pi)
_NODE_SPACING_SIGMA = 1.1
_LEAST_NODES = 24
_REACH_SIGMA = 7.0
"""Beyond so many standard deviations the point spread is below 1e-10 of its peak."""


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
