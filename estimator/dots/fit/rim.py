"""How far noise and rough printed edges move the centres of dots, from harmonics of their edges.

In the dot's own circle (its ellipse divided by its semi-axes) an edge at the radius
1 + sum_k a_k cos(k phi) + b_k sin(k phi) has its centre at (a_1, b_1), so the variance of a_1 is
that of the centre. a_0 to b_2 are parameters of the luminance model and not seen in one dot; but
those of k = 2 show in how the shapes of neighbouring dots differ, and those of k = 3 to 5 in the
residuals at the edge. ln of their power is continued to k = 1 as a parabola in k, which is exact
for a Gaussian correlation along the edge, and 9 % low where power is (1 + k^2)^-1.5.

Noise is in all harmonics alike, in units of their variance, and roughness is gone from the short
ones, because the lens blurs them: those tell what noise is at the edge, whatever the fit leaves
elsewhere. The noise of a compression is not that of flat areas, and light around a dot or a curved
response of the camera raise chi-square but move no centre.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from telerig.arrays import Array
from telerig.estimator.dots.fit.blurred_ellipse import matrix_from_shape, semi_axes
from telerig.estimator.dots.fit.kernels import edge_equations

HARMONICS, NOISE_HARMONICS = (3, 4, 5), 3
"""The harmonics that show roughness, and how many higher ones show the noise at the edge."""
NOISE_WAVE, LEAST_BLUR_PX = 2.0, 0.8
"""The harmonics of the noise are those near R / sigma times `NOISE_WAVE`: the blur sigma takes
98 % of their power in an edge away. Half of the wave is more than a pixel long."""
_ROWS = 2 * (len(HARMONICS) + NOISE_HARMONICS)
NO_EDGE = np.zeros(_ROWS), np.full(_ROWS, np.inf)
"""Harmonics of an edge of which nothing is known, with their variances."""
FEWEST_DOTS = 8
"""Fewer dots do not tell how their edges are."""
SIGNIFICANT_SD = 4.0
"""Power is more than that of noise, and noise is not as expected, if it is so far off."""
DOTS_PER_TERM = 4
"""The shapes' trend has terms up to the third degree (perspective and distortion), if so many dots
are there for each of them; else fewer."""
CURVATURE, CURVATURE_SD = -0.2, 0.45
"""Prior of the second difference of ln power by k: it is -0.64 for a Gaussian correlation along
0.8 rad of the edge, 0.24 where power is (1 + k^2)^-1.5."""
SLOPE_SD = 10.0
PARABOLA_SD = 0.05
"""By so much ln power differs from a parabola, relative to its noise."""
LEAST_SHARE = 0.1
"""A harmonic is used if its power without the noise is at least so much of the whole."""
CLIPPED = 4.0
"""The power of one dot counts as at most so many times the mean: some edges have a nick."""


class EdgeErrors(NamedTuple):
    """What moves the centres of an image's dots.

    rough : standard deviation of what their rough edges do, relative to the semi-axes.
    noise : the variance of the noise at their edges, relative to what the fits took it for.
    """

    rough: float
    noise: float


def edge_harmonics(
    jacobian: Array,
    weight: Array,
    residual: Array,
    information: Array,
    theta: Array,
    offset_px: Array,
) -> tuple[Array, Array]:
    """Return the harmonics of one dot's edge in its residuals, relative to its semi-axes.

    jacobian : (N, P) derivatives of the grey levels by the parameters of the fit, at its minimum.
    weight, residual : (P,). information : (N, N) of the fit.
    theta : (6,) centre, shape and blur. offset_px : (2, P) pixels less the centre.

    Returns the coefficients (2 K,) cos 3 phi, sin 3 phi, cos 4 phi ... and their variances (2 K,),
    infinite where too few pixels are seen. The last `NOISE_HARMONICS` are those of the noise.
    """
    if np.count_nonzero(weight) <= len(information):
        return NO_EDGE
    own, mixed, right = (
        np.zeros((_ROWS, _ROWS)),
        np.zeros((_ROWS, len(information))),
        np.zeros(_ROWS),
    )
    radius = float(np.prod(semi_axes(theta[2:5]))) ** 0.5
    middle = round(NOISE_WAVE * radius / max(float(theta[5]), LEAST_BLUR_PX))
    first = max(middle - NOISE_HARMONICS // 2, HARMONICS[-1] + 1)
    orders = np.array([*HARMONICS, *range(first, first + NOISE_HARMONICS)])
    edge_equations(orders, theta[2:5], offset_px, jacobian, weight, residual, own, mixed, right)
    own -= mixed @ np.linalg.solve(information, mixed.T)
    try:
        covariance = np.linalg.inv(own)
    except np.linalg.LinAlgError:
        return NO_EDGE
    variance = np.diag(covariance).copy()
    return (covariance @ right, variance) if variance.min() > 0.0 else NO_EDGE


def edge_errors(
    edge: Array, variance: Array, centre_px: Array, shape_px: Array, sigma_px: Array
) -> EdgeErrors | None:
    """Return what the edges of an image's dots and the noise there do to their centres.

    The harmonics' power in units of their variance is that of the noise, as long as the lower
    harmonics do not have significantly more than the higher ones: then the edges are rough, and the
    noise is what the higher ones have. Fewer than `FEWEST_DOTS` dots tell nothing (None).

    edge, variance : (N, 2 K) as `edge_harmonics` returns them; finite.
    centre_px, shape_px, sigma_px : (N, 2), (N, 3), (N,) of the N dots.
    """
    if len(edge) < FEWEST_DOTS:
        return None
    count = len(HARMONICS)
    power = _mean_power(np.mean((edge**2 / variance).reshape(len(edge), -1, 2), -1))
    low, high = float(power[:count].mean()), float(power[count:].mean())
    by_chance = SIGNIFICANT_SD / np.sqrt(count * len(edge))
    rough = low > high * (1.0 + np.sqrt(2.0) * by_chance)
    noise = high if rough else low
    noise = noise if abs(noise - 1.0) > by_chance else 1.0
    if not rough:
        return EdgeErrors(0.0, noise)
    # Blur along the edge takes part of the higher harmonics away.
    blur = sigma_px / np.prod(semi_axes(shape_px), 0) ** 0.5
    shown = np.exp(-0.5 * np.square(np.multiply.outer(blur, HARMONICS)))
    third = edge[:, : 2 * count].reshape(len(edge), -1, 2) / shown[..., None]
    own = variance[:, : 2 * count].reshape(third.shape).mean(-1) / shown**2
    own = noise * np.median(own, 0)
    harmonics = np.concatenate([_second_harmonic(centre_px, shape_px)[:, None], third], 1)
    whole = _mean_power(np.mean(harmonics**2, -1))
    excess = whole - np.concatenate([own[:1], own])
    good = excess > LEAST_SHARE * whole
    if not good[0]:
        return EdgeErrors(0.0, noise)
    steps = 1.0 + np.flatnonzero(good)
    sigma = np.hypot(whole[good] / excess[good] / np.sqrt(len(edge)), PARABOLA_SD)
    parabola = np.stack([np.ones_like(steps), steps, 0.5 * steps * (steps - 1.0)], -1)
    rows = np.concatenate(
        [parabola / sigma[:, None], np.diag([0.0, 1.0 / SLOPE_SD, 1.0 / CURVATURE_SD])]
    )
    prior = np.array([0.0, 0.0, CURVATURE / CURVATURE_SD])
    right = np.concatenate([np.log(excess[good]) / sigma, prior])
    rough_sd = float(np.exp(0.5 * np.linalg.lstsq(rows, right, rcond=None)[0][0]))
    return EdgeErrors(rough_sd, noise)


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
