"""Compiled loops that fit spheroids to outlines: moments, their outlines, and Gauss-Newton steps.

A body has a frame F (3, 3), whose columns are two equatorial axes and the pole, and the values log
size, log aspect ratio and t. Its moments F M F^T are symmetric; in its frame they have the elements
xx, yy, xy (of the equator) and zz (of the pole).
"""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array
from telerig.compiled import compiled
from telerig.estimator.bubbles.outline.kernels import solve


@compiled
def _elements(value: Array) -> tuple[float, float, float, float]:
    """Return the elements xx, yy, xy, zz of the moments in the body's frame; value : (4,)."""
    size, aspect = value[0], value[1]
    t = np.hypot(value[2], value[3]) + 1e-300
    even, odd = np.cosh(2 * t), np.sinh(2 * t) / t
    plane = np.exp(2 * (size + aspect / 3))
    return (
        plane * (even + odd * value[2]), plane * (even - odd * value[2]), plane * odd * value[3],
        np.exp(2 * (size - 2 * aspect / 3)),
    )  # fmt: skip


@compiled
def moments(frame: Array, value: Array) -> Array:
    """Return the moments (B, 3, 3) of bodies; frame, value : (B, 3, 3), (B, 4)."""
    out = np.empty((len(frame), 3, 3))
    for m in range(len(frame)):
        f = frame[m]
        xx, yy, xy, zz = _elements(value[m])
        for i in range(3):
            for j in range(3):
                crossed = f[i, 0] * f[j, 1] + f[i, 1] * f[j, 0]
                out[m, i, j] = xx * f[i, 0] * f[j, 0] + yy * f[i, 1] * f[j, 1] + xy * crossed
                out[m, i, j] += zz * f[i, 2] * f[j, 2]
    return out


@compiled
def _outline(measure: Array, frame: Array, value: Array, g: Array, slope: Array) -> None:
    """Write g (G,) of the outlines of one body and the derivatives (G, 6), for small t.

    measure : (G, 9).
    """
    xx, yy, xy, zz = _elements(value)
    own = np.empty((3, 3))
    for r in range(len(measure)):
        for a in range(3):
            for b in range(3):
                total = 0.0
                for i in range(3):
                    for j in range(3):
                        total += frame[i, a] * measure[r, 3 * i + j] * frame[j, b]
                own[a, b] = total
        by_xy, by_xz, by_yz = own[0, 1] + own[1, 0], own[0, 2] + own[2, 0], own[1, 2] + own[2, 1]
        equator = own[0, 0] * xx + own[1, 1] * yy + by_xy * xy
        g[r] = equator + own[2, 2] * zz
        slope[r, 0] = 2 * g[r]
        slope[r, 1] = 2 / 3 * equator - 4 / 3 * own[2, 2] * zz
        # the pole moves towards an equatorial axis, and that axis away from it
        slope[r, 2] = by_xz * (zz - xx) - by_yz * xy
        slope[r, 3] = by_yz * (zz - yy) - by_xz * xy
        slope[r, 4] = 2 * (own[0, 0] * xx - own[1, 1] * yy)
        slope[r, 5] = 2 * xy * (own[0, 0] + own[1, 1]) + by_xy * (xx + yy)


@compiled
def outlines(measure: Array, frame: Array, value: Array) -> tuple[Array, Array]:
    """Return g (B, G) of the outlines of bodies, and the derivatives (B, G, 6) by `PARAMETERS`.

    measure : (B, G, 9) as in `Views`. frame, value : (B, 3, 3), (B, 4).
    """
    g = np.empty(measure.shape[:2])
    slope = np.empty((*g.shape, 6))
    for m in range(len(measure)):
        _outline(measure[m], frame[m], value[m], g[m], slope[m])
    return g, slope


@compiled
def _lean(frame: Array, first: float, second: float) -> None:
    """Turn a frame by the smallest angle that moves its pole by so much along both other axes."""
    pole, axis = np.empty(3), np.empty(3)
    square = along = left = 0.0
    for i in range(3):
        pole[i] = frame[i, 0] * first + frame[i, 1] * second + frame[i, 2]
        square += pole[i] ** 2
    for i in range(3):
        pole[i] /= np.sqrt(square)
        along += frame[i, 0] * pole[i]
    for i in range(3):
        axis[i] = frame[i, 0] - along * pole[i]
        left += axis[i] ** 2
    for i in range(3):
        axis[i] /= np.sqrt(left)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        frame[i, 0], frame[i, 2] = axis[i], pole[i]
        frame[i, 1] = pole[j] * axis[k] - pole[k] * axis[j]


@compiled
def fit(
    measure: Array,
    weight: Array,
    prior: Array,
    wanted: Array,
    frame: Array,
    value: Array,
    steps: int,
    small: float,
) -> Array:
    """Maximise the posterior of bodies by Gauss-Newton steps; ``frame`` and ``value`` are improved.

    measure, weight : (B, G, 9), (B, G, G) as in `Views`. wanted : (G,) g of the measured outlines.
    prior : (6,) precisions of the `PARAMETERS`, the first and the third pair without a mean.
    steps, small : most steps of a body, and the step that ends them.

    Returns the covariances (B, 6, 6).
    """
    many, size = measure.shape[:2]
    covariance = np.zeros((many, 6, 6))
    g, slope, weighted = np.empty(size), np.empty((size, 6)), np.empty((6, size))
    normal, step = np.empty((7, 6)), np.empty(6)
    place = (0, 1, -1, -1, 2, 3)
    for m in range(many):
        for _ in range(steps):
            _outline(measure[m], frame[m], value[m], g, slope)
            for p in range(6):
                for r in range(size):
                    total = 0.0
                    for q in range(size):
                        total += slope[q, p] * weight[m, q, r]
                    weighted[p, r] = total
                for q in range(p + 1):
                    total = prior[p] if p == q else 0.0
                    for r in range(size):
                        total += weighted[p, r] * slope[r, q]
                    normal[p, q] = total
                normal[6, p] = -prior[p] * value[m, place[p]] if place[p] > 0 else 0.0
                for r in range(size):
                    normal[6, p] += weighted[p, r] * (wanted[r] - g[r])
            if not solve(normal, covariance[m], step):
                break
            largest = 0.0
            for p in range(6):
                step[p] = min(max(step[p], -0.5), 0.5)
                largest = max(largest, abs(step[p]))
                if place[p] >= 0:
                    value[m, place[p]] += step[p]
            _lean(frame[m], step[2], step[3])
            if largest <= small:
                break
    return covariance
