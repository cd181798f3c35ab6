"""How far the rough edge of printed dots moves their centres, from the harmonics of the edge.

In the dot's own circle (its ellipse divided by its semi-axes) an edge at the radius
1 + sum_k a_k cos(k phi) + b_k sin(k phi) has its centre at (a_1, b_1), so the variance of a_1 is
that of the centre. a_0 to b_2 are parameters of the luminance model and not seen in one dot; but
those of k = 2 show in how the shapes of neighbouring dots differ, and those of k = 3 to 5 in the
residuals at the edge. ln of their power is continued to k = 1 as a parabola in k, which is exact
for a Gaussian correlation along the edge, and 9 % low where power is (1 + k^2)^-1.5.
"""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array
from telerig.estimator.dots.fit.blurred_ellipse import matrix_from_shape, semi_axes
from telerig.estimator.dots.fit.kernels import edge_equations

HARMONICS = (3, 4, 5)
NO_EDGE = np.zeros(2 * len(HARMONICS)), np.full(2 * len(HARMONICS), np.inf)
"""Harmonics of an edge of which nothing is known, with their variances."""
FEWEST_DOTS = 8
"""Fewer dots do not tell how their edges are."""
SIGNIFICANT_SD = 4.0
"""The median power at the edges counts as roughness if it is so far above that of noise."""
DOTS_PER_TERM = 4
"""The shapes' trend has terms up to the third degree (perspective and distortion), if so many dots
are there for each of them; else fewer."""
CURVATURE_SD = 0.5
"""Prior standard deviation of the second difference of ln power by k: it is -0.64 for a Gaussian
correlation along 0.8 rad of the edge, 0.24 where power is (1 + k^2)^-1.5."""
SLOPE_SD = 10.0
PARABOLA_SD = 0.05
"""By so much ln power differs from a parabola, relative to its noise."""
LEAST_SHARE = 0.1
"""A harmonic is used if its power without the noise is at least so much of the whole."""
CLIPPED = 4.0
"""The power of one dot counts as at most so many times the mean: some edges have a nick."""


def edge_harmonics(
    jacobian: Array,
    weight: Array,
    residual: Array,
    information: Array,
    shape_px: Array,
    offset_px: Array,
) -> tuple[Array, Array]:
    """Return the harmonics of one dot's edge in its residuals, relative to its semi-axes.

    jacobian : (N, P) derivatives of the grey levels by the parameters of the fit, at its minimum.
    weight, residual : (P,). information : (N, N) of the fit.
    shape_px : (3,). offset_px : (2, P) pixels less the centre.

    Returns the coefficients (2 K,) cos 3 phi, sin 3 phi, cos 4 phi ... and their variances (2 K,),
    infinite where too few pixels are seen.
    """
    if np.count_nonzero(weight) <= len(information):
        return NO_EDGE
    count = 2 * len(HARMONICS)
    own, mixed, right = (
        np.zeros((count, count)),
        np.zeros((count, len(information))),
        np.zeros(count),
    )
    edge_equations(HARMONICS[0], shape_px, offset_px, jacobian, weight, residual, own, mixed, right)
    own -= mixed @ np.linalg.solve(information, mixed.T)
    try:
        covariance = np.linalg.inv(own)
    except np.linalg.LinAlgError:
        return NO_EDGE
    return covariance @ right, np.diag(covariance).copy()


def centre_shift(
    edge: Array, variance: Array, centre_px: Array, shape_px: Array, sigma_px: Array
) -> float:
    """Return the standard deviation by which their edges move the centres of an image's dots.

    It is relative to the semi-axes, and 0 if the edges are not significantly rough or if there are
    fewer than `FEWEST_DOTS` dots.

    edge, variance : (N, 2 K) as `edge_harmonics` returns them; finite.
    centre_px, shape_px, sigma_px : (N, 2), (N, 3), (N,) of the N dots.
    """
    if len(edge) < FEWEST_DOTS:
        return 0.0
    power = np.median(np.mean(edge**2 / variance, -1))
    if power < 1.0 + SIGNIFICANT_SD * np.sqrt(2.0 / edge.size):
        return 0.0
    # Blur along the edge takes part of the higher harmonics away.
    blur = sigma_px / np.prod(semi_axes(shape_px), 0) ** 0.5
    shown = np.exp(-0.5 * np.square(np.multiply.outer(blur, HARMONICS)))
    third = edge.reshape(len(edge), -1, 2) / shown[..., None]
    noise = np.median(variance.reshape(third.shape).mean(-1) / shown**2, 0)
    harmonics = np.concatenate([_second_harmonic(centre_px, shape_px)[:, None], third], 1)
    whole = _mean_power(np.mean(harmonics**2, -1))
    excess = whole - np.concatenate([noise[:1], noise])
    good = excess > LEAST_SHARE * whole
    if not good[0]:
        return 0.0
    steps = 1.0 + np.flatnonzero(good)
    sigma = np.hypot(whole[good] / excess[good] / np.sqrt(len(edge)), PARABOLA_SD)
    parabola = np.stack([np.ones_like(steps), steps, 0.5 * steps * (steps - 1.0)], -1)
    rows = np.concatenate(
        [parabola / sigma[:, None], np.diag([0.0, 1.0 / SLOPE_SD, 1.0 / CURVATURE_SD])]
    )
    right = np.concatenate([np.log(excess[good]) / sigma, np.zeros(3)])
    return float(np.exp(0.5 * np.linalg.lstsq(rows, right, rcond=None)[0][0]))


def _mean_power(power: Array) -> Array:
    """Return the means over dots of power (N, K), which is distributed exponentially but for some
    dots."""
    most = CLIPPED * np.median(power, 0) / np.log(2.0)
    return np.asarray(np.minimum(power, most).mean(0) / (1.0 - np.exp(-CLIPPED)))


def _second_harmonic(centre_px: Array, shape_px: Array) -> Array:
    """Return (N, 2) how the shapes of N dots differ from a trend across the image."""
    x, y = (centre_px - centre_px.mean(0)).T / np.ptp(centre_px, 0).max()
    terms = [x**i * y**j for k in range(4) for i in range(k + 1) for j in [k - i]]
    count = max(n for n in (3, 6, 10) if n == 3 or n * DOTS_PER_TERM <= len(x))
    design = np.stack(terms[:count], -1)
    kept = np.ones(len(design), bool)
    for _ in range(3):
        trend = design @ np.linalg.lstsq(design[kept], shape_px[kept], rcond=None)[0]
        off = np.linalg.norm(shape_px - trend, axis=-1)
        kept = off <= 4.0 * np.median(off)
    change = np.linalg.solve(matrix_from_shape(trend), matrix_from_shape(shape_px))
    parts = [change[:, 0, 0] - change[:, 1, 1], change[:, 0, 1] + change[:, 1, 0]]
    return np.asarray(0.5 * np.stack(parts, -1) * np.sqrt(len(x) / (len(x) - count)))
