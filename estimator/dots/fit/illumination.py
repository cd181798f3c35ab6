"""Priors for each dot from the other dots of the image: the illumination, and the common blur."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.dots.fit.types import DotFit, Prior

Array = NDArray[np.float64]

PRIOR_GRADIENT_PER_PX = 4e-4
_PRIOR_SCATTER, _PRIOR_SCATTER_DOTS = 0.01, 4.0
_HUBER = 2.0
_FLOOR_PER_PX = 5e-6
_ENOUGH_DOTS = 6
_BLUR_SPREAD = 0.1


def contrast_gradients(fits: list[DotFit], image_shape: tuple[int, ...]) -> list[Prior]:
    """The relative contrast gradient expected at each fitted dot.

    A quadratic in position is fitted robustly to log |contrast|. A prior on its coefficients (light
    changes by about exp(0.4) over 1000 px) replaces thresholds on the number of dots. Below 6 dots
    a bright background tells more than the other dots do: see `background_tie`.
    """
    if len(fits) < _ENOUGH_DOTS:
        return [background_tie(fit) for fit in fits]
    centres = np.array([fit.centre_px for fit in fits])
    contrast = np.array([abs(fit.contrast) for fit in fits])
    value = np.log(np.maximum(contrast, 1e-12))
    own = np.array([fit.contrast_sigma for fit in fits]) / np.maximum(contrast, 1e-12)
    reach = 0.5 * max(image_shape)
    position = (centres - np.mean(centres, axis=0)) / reach
    coefficients, covariance = _quadratic(position, value, own, PRIOR_GRADIENT_PER_PX * reach)
    return [_prior_at(p, coefficients, covariance, reach) for p in position]


def with_common_blur(priors: list[Prior], fits: list[DotFit]) -> list[Prior]:
    """The priors with the median edge sigma, to 10 % or to its spread over the image.

    It matters for dots no larger than the blur, whose size, contrast and blur have similar effects.
    """
    if len(fits) < _ENOUGH_DOTS:
        return priors
    sigmas = np.array([fit.sigma_px for fit in fits])
    usual = float(np.median(sigmas))
    spread = max(_BLUR_SPREAD * usual, 1.4826 * float(np.median(np.abs(sigmas - usual))))
    return [replace(prior, edge_px=usual, edge_spread_px=spread) for prior in priors]


def background_tie(fit: DotFit) -> Prior:
    """Prior for a single dot: the background's relative gradient if the background is bright."""
    if fit.levels[0] > 0.5 * abs(fit.levels[3]):
        return Prior(sigma_per_px=1e-4, tie_to_background=True)
    return Prior(sigma_per_px=PRIOR_GRADIENT_PER_PX)


def _quadratic(position: Array, value: Array, own: Array, slope: float) -> tuple[Array, Array]:
    """Coefficients (6,) and covariance (6, 6) by reweighted least squares with a prior."""
    x, y = position.T
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    prior = np.diag([1e-6, *[1.0 / slope**2] * 5])
    scatter, weight = 0.05, np.ones(len(value))
    for _ in range(8):
        precision = weight / (own**2 + scatter**2)
        information = design.T @ (precision[:, None] * design) + prior
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        coefficients = covariance @ (design.T @ (precision * value))
        residual = value - design @ coefficients
        excess = float(np.sum(np.maximum(weight * (residual**2 - own**2), 0.0)))
        spare = max(float(np.sum(weight)) - 6.0, 0.0)
        known = _PRIOR_SCATTER_DOTS * _PRIOR_SCATTER**2
        scatter = float(np.sqrt((excess + known) / (spare + _PRIOR_SCATTER_DOTS)))
        far = np.abs(residual) / np.sqrt(own**2 + scatter**2)
        weight = np.minimum(1.0, (_HUBER / np.maximum(far, 1e-12)) ** 2)
    return coefficients, covariance


def _prior_at(position: Array, coefficients: Array, covariance: Array, reach: float) -> Prior:
    x, y = position
    rows = np.array([[0.0, 1.0, 0.0, 2.0 * x, y, 0.0], [0.0, 0.0, 1.0, 0.0, x, 2.0 * y]]) / reach
    gradient = rows @ coefficients
    variance = 0.5 * float(np.trace(rows @ covariance @ rows.T))
    return Prior(
        float(gradient[0]), float(gradient[1]), float(np.hypot(np.sqrt(variance), _FLOOR_PER_PX))
    )
