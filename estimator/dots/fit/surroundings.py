"""What the rest of the image means for the fit of one dot.

Its window holds the pixels without holes, neighbours and their blur. Its priors come from the other
dots: the illumination, the blur that all dots have in common, and what hearts look like.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Float32
from telerig.estimator.dots.fit.blurred_ellipse import (
    approximate_distance_px,
    coverage_on_grid,
    extent_px,
    semi_axes,
)
from telerig.estimator.dots.fit.candidates import Candidate, fill
from telerig.estimator.dots.fit.luminance import DotFit, Prior, Start, Window
from telerig.statistics import robust_sd

CLEAR_SIGMA = 3.5
_MAX_MARGIN_PX = 12.0
_THIN_ABOVE_PIXELS, _COARSE_ABOVE_PIXELS = 3000, 800


def dot_window(
    grey: Float32,
    labels: NDArray[np.int32],
    blob: Candidate,
    start: Start,
    *,
    coarse: bool = False,
    known: Sequence[int] = (),
    whole: bool = False,
) -> Window:
    """Return the part of an image to which one dot is fitted: its edge, inside, and background.

    grey : (rows, columns) grey levels.
    labels : see `Candidates`.
    blob : the dot.
    start : its approximate ellipse.
    coarse : whether only one pixel in four is used everywhere, for a fast first fit.
    known : labels of neighbouring blobs whose light is subtracted before the fit. Pixels that are
        blurred together with these blobs stay in the mask; without them a third of the precision
        would be lost.
    whole : whether the inside of a large dot is used, too.

    Pixels that are nearer to another blob, or near a hole, are left out. Of a large dot only the
    surroundings of the edge are used, and beyond the edge's blur one pixel in four.
    """
    a, b = semi_axes(start.shape_px)
    reach = 4.0 * start.sigma_px + 2.0
    outer = min(max(1.3 * sqrt(a * b), reach), max(reach, _MAX_MARGIN_PX))
    half = extent_px(start.shape_px) + outer
    low = np.maximum(np.floor(start.centre_px - half).astype(int), 0)
    high = np.minimum(np.ceil(start.centre_px + half).astype(int) + 1, grey.shape[::-1])
    crop = np.s_[low[1] : high[1], low[0] : high[0]]
    du = np.arange(low[0], high[0]) - start.centre_px[0]
    dv = np.arange(low[1], high[1]) - start.centre_px[1]
    distance = approximate_distance_px(
        start.shape_px, np.tile(du, len(dv)), np.repeat(dv, len(du))
    ).reshape(len(dv), len(du))
    mask: Bools = distance < outer
    if not whole:
        mask &= distance > -max(8.0, reach)
    clear = CLEAR_SIGMA * start.sigma_px
    around = (low, high, int(np.ceil(max(clear, outer))) + 1)
    gap = _distance_to_others(labels, (blob.label,), *around)
    if gap is not None:
        free = (gap > clear) | (distance < gap)
        if known:
            unknown = _distance_to_others(labels, (blob.label, *known), *around)
            alone = True if unknown is None else (unknown > clear) | (distance < unknown)
            free |= (distance < clear) & alone
        mask &= free
    if blob.holes:
        holes = np.zeros(mask.shape, np.uint8)
        for hole in blob.holes:
            fill(holes, 1, hole - low.astype(np.int32))
        mask &= _distance_to(holes > 0) > clear + 0.5
    if np.count_nonzero(mask) > (_COARSE_ABOVE_PIXELS if coarse else _THIN_ABOVE_PIXELS):
        thin = np.abs(distance) > (0.0 if coarse else CLEAR_SIGMA * start.sigma_px)
        thin[::2, ::2] = False
        mask &= ~thin
    return Window(grey[crop].astype(np.float64), int(low[0]), int(low[1]), mask)


def _distance_to(marked: Bools) -> Array:
    distance: Array = cv2.distanceTransform((~marked).astype(np.uint8), cv2.DIST_L2, 5) - 0.5
    return distance


def _distance_to_others(
    labels: NDArray[np.int32],
    own: Sequence[int],
    low: NDArray[np.int_],
    high: NDArray[np.int_],
    reach: int,
) -> Array | None:
    """Return the distance to blobs with labels not in ``own``, in a crop; None if none is near."""
    first = np.maximum(low - reach, 0)
    wide = labels[first[1] : high[1] + reach, first[0] : high[0] + reach]
    others = wide != 0
    for label in own:
        others &= wide != label
    if not np.any(others):
        return None
    inner = low - first
    size = high - low
    distance = _distance_to(others)
    return distance[inner[1] : inner[1] + size[1], inner[0] : inner[0] + size[0]]


def close_neighbours(fits: list[DotFit]) -> list[list[int]]:
    """Return for each dot the indices in ``fits`` of the other dots whose blur overlaps its own."""
    from scipy.spatial import cKDTree

    if not fits:
        return []
    centres = np.array([fit.centre_px for fit in fits])
    sizes = np.array([float(np.max(extent_px(fit.shape_px))) + 4 * fit.sigma_px for fit in fits])
    tree = cKDTree(centres)
    near = tree.query_ball_point(centres, sizes + sizes.max())
    return [
        [j for j in near[i] if j != i and _blur_meets(fits[i], fits[j])] for i in range(len(fits))
    ]


def _blur_meets(first: DotFit, second: DotFit) -> bool:
    du, dv = second.centre_px - first.centre_px
    way = float(np.hypot(du, dv)) + 1e-9
    radii = [way / _radius_of(fit.shape_px, du, dv) for fit in (first, second)]
    gap = way - radii[0] - radii[1]
    return gap < 2.0 * CLEAR_SIGMA * max(first.sigma_px, second.sigma_px)


def _radius_of(shape: Array, du: float, dv: float) -> float:
    m11, m12, m22 = shape
    determinant = m11 * m22 - m12 * m12
    return float(np.hypot(m22 * du - m12 * dv, m11 * dv - m12 * du) / determinant)


def without_neighbours(window: Window, neighbours: list[DotFit]) -> Window:
    """Return the window with the neighbours' fitted light subtracted."""
    if not neighbours:
        return window
    rows, columns = window.grey.shape
    u, v = window.first_u + np.arange(columns), window.first_v + np.arange(rows)
    grey = window.grey.copy()
    for fit in neighbours:
        coverage, _ = coverage_on_grid(
            u.astype(np.float64), v.astype(np.float64), fit.centre_px, fit.shape_px, fit.sigma_px
        )
        grey -= fit.contrast * coverage
    return Window(grey, window.first_u, window.first_v, window.mask)


PRIOR_GRADIENT_PER_PX = 4e-4
_PRIOR_SCATTER, _PRIOR_SCATTER_DOTS = 0.01, 4.0
_FAR_SDS = 2.0
_FLOOR_PER_PX = 5e-6
BLUR_SPREAD = 0.1
"""Least relative standard deviation of the dots' blur."""
HEART_SPREAD = 0.02
"""Least standard deviation of the relative size and light of their hearts."""


def priors_from(fits: list[DotFit], image_shape: tuple[int, ...]) -> list[Prior]:
    """Return a prior for each fitted dot: the contrast gradient, and the blur and hearts of all.

    A cubic surface is fitted robustly to log |contrast| over the image, with a prior (the light
    changes by about a factor exp(0.4) over 1000 px). The dots' median edge blur is a prior of each
    dot's, for dots that are no larger than the blur.

    image_shape : (rows, columns).
    """
    if not fits:
        return []
    centres = np.array([fit.centre_px for fit in fits])
    contrast = np.array([abs(fit.contrast) for fit in fits])
    value = np.log(np.maximum(contrast, 1e-12))
    own = np.array([fit.contrast_sigma for fit in fits]) / np.maximum(contrast, 1e-12)
    reach = 0.5 * max(image_shape)
    position = (centres - np.mean(centres, axis=0)) / reach
    coefficients, covariance = _cubic(position, value, own, PRIOR_GRADIENT_PER_PX * reach)
    sigmas = np.array([fit.sigma_px for fit in fits])
    usual = float(np.median(sigmas))
    spread = max(BLUR_SPREAD * usual, float(robust_sd(sigmas - usual)))
    gradients = (_gradient_at(p, coefficients, covariance, reach) for p in position)
    heart = usual_heart(fits)
    return [Prior(*gradient, usual, spread, *heart) for gradient in gradients]


def usual_heart(fits: Sequence[DotFit]) -> tuple[float, float, float, float]:
    """Return size and light of the hearts of an image's dots, relative to the dots, each with its
    scatter, as `Prior` has them; without knowledge where fewer than half of the dots have one."""
    looks = np.array([fit.heart_look for fit in fits if fit.heart is not None])
    if 2 * len(looks) <= len(fits):
        return 0.5, np.inf, 0.0, np.inf
    middle = np.median(looks, 0)
    spread = [max(HEART_SPREAD, float(robust_sd(off))) for off in (looks - middle).T]
    return float(middle[0]), spread[0], float(middle[1]), spread[1]


_POWERS = np.array([(i, j) for i in range(4) for j in range(4 - i)])
"""(10, 2) exponents of x and y in a cubic polynomial; the first is the constant."""


def _cubic(position: Array, value: Array, own: Array, slope: float) -> tuple[Array, Array]:
    """Return coefficients (10,) and their covariance by reweighted least squares with a prior."""
    design = np.prod(position[:, None] ** _POWERS, axis=-1)
    prior = np.diag([1e-6, *[1.0 / slope**2] * (len(_POWERS) - 1)])
    scatter, weight = 0.05, np.ones(len(value))
    for _ in range(8):
        precision = weight / (own**2 + scatter**2)
        information = design.T @ (precision[:, None] * design) + prior
        covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        coefficients = covariance @ (design.T @ (precision * value))
        residual = value - design @ coefficients
        excess = float(np.sum(np.maximum(weight * (residual**2 - own**2), 0.0)))
        spare = max(float(np.sum(weight)) - len(_POWERS), 0.0)
        known = _PRIOR_SCATTER_DOTS * _PRIOR_SCATTER**2
        scatter = float(np.sqrt((excess + known) / (spare + _PRIOR_SCATTER_DOTS)))
        far = np.abs(residual) / np.sqrt(own**2 + scatter**2)
        weight = np.minimum(1.0, (_FAR_SDS / np.maximum(far, 1e-12)) ** 2)
    return coefficients, covariance


def _gradient_at(
    position: Array, coefficients: Array, covariance: Array, reach: float
) -> tuple[float, float, float]:
    """Return the surface's gradient along u and v, per px, and the standard deviation of both."""
    lower = np.maximum(_POWERS - np.eye(2, dtype=int)[:, None], 0)  # (2, 10, 2)
    rows = _POWERS.T * np.prod(position**lower, axis=-1) / reach
    gradient = rows @ coefficients
    variance = 0.5 * float(np.trace(rows @ covariance @ rows.T))
    sigma = float(np.hypot(np.sqrt(variance), _FLOOR_PER_PX))
    return float(gradient[0]), float(gradient[1]), sigma
