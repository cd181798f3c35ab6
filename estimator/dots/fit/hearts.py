"""Dots with a heart: an inner disc that is brighter or darker than the rest of the dot.

Phase contrast, holes that light shines through, and ink that dries to a ring make such dots. One
disc that is fitted to them lies on the heart, or between the heart and the rim, with more blur than
the lens makes. It shows in its size, as the dots of a plate are equal. Such a dot is fitted as two
discs, itself and its heart, each without the light of the other until the dot does not move: first
from its own size with any blur, and then, where the plate shows another size, from that size with
the blur of the dots that have it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from telerig.arrays import Array
from telerig.estimator.dots.fit.blurred_ellipse import approximate_distance_px, semi_axes
from telerig.estimator.dots.fit.luminance import (
    PARAMETERS,
    DotFit,
    Prior,
    Start,
    Window,
    fit_dot,
)
from telerig.estimator.dots.fit.surroundings import BLUR_SPREAD, without_neighbours
from telerig.estimator.dots.thresholds import OTHER_SIZE_SD, RARE, SIZE_SPREAD, SIZES_SPREAD_SD
from telerig.estimator.images.noise import NoiseModel
from telerig.statistics import robust_sd

FEWEST_PIXELS = 25
"""Least number of pixels for another fit; a dot whose first fit left the image has fewer."""
FEWEST_DOTS = 8
"""Fewer dots do not tell what size they have in common."""
_ROUNDS = 12
_ROUGH = 0.3
"""Tolerance of the fits whose result is only a start."""
_HEART_SHARE = 0.5
"""Size at which a heart's fit starts, relative to the dot."""
_HEART_REACH = 2.0
"""Pixels that are nearer to the heart's start than so many standard deviations of the blur are left
out of the dot's first fit."""
_TREND_STEPS = (0.1, 0.1, 0.05, 0.05, 0.03, 0.03, 0.03, 0.03)
"""Log radii farther than this from the trend count little, step by step."""


def with_hearts(
    fits: Sequence[DotFit],
    noise: NoiseModel,
    priors: Sequence[Prior],
    window: Callable[[int, Start], Window],
    doubtful: Sequence[int],
) -> list[DotFit]:
    """Fit the doubtful ones of an image's dots again, each with a heart, and return all fits.

    priors : of each dot. window : returns a dot's pixels, given its number and the start of a fit.
    """
    single, fits = fits, list(fits)

    def again(dot: int, log_radius: float, prior: Prior) -> DotFit:
        fit = single[dot]
        scale = float(np.exp(log_radius - _log_radius(fit)))
        start = Start(fit.centre_px, fit.shape_px * scale, prior.edge_px)
        pair = _with_heart(window(dot, start), start, noise, prior)
        return pair if pair is not None and _explains_more(pair, fit) else fit

    for dot in doubtful:
        any_blur = replace(priors[dot], edge_spread_px=np.inf)
        fits[dot] = again(dot, _log_radius(single[dot]), any_blur)
    for _ in range(2):
        off, sd = excess_of_sizes(fits)
        usual = np.array([fit.sigma_px for fit, z in zip(fits, off / sd) if abs(z) < OTHER_SIZE_SD])
        if not usual.size:
            break
        blur = float(np.median(usual))
        spread = max(BLUR_SPREAD * blur, float(robust_sd(usual - blur)))
        for dot in doubtful:
            log_radius = _log_radius(fits[dot]) - off[dot]
            prior = replace(priors[dot], edge_px=blur, edge_spread_px=spread)
            if _unlike(fits[dot], log_radius, prior) > 1.0:
                fit = again(dot, log_radius, prior)
                if _unlike(fit, log_radius, prior) < _unlike(fits[dot], log_radius, prior):
                    fits[dot] = fit
    return fits


def too_small_sd(fits: Sequence[DotFit]) -> Array:
    """Return how many standard deviations (N,) the fits are smaller than a plate's dots there."""
    if len(fits) < FEWEST_DOTS:
        return np.zeros(len(fits))
    off, sd = excess_of_sizes(fits)
    return np.asarray(np.maximum(-off / sd, 0.0) / max(SIZES_SPREAD_SD, float(robust_sd(off / sd))))


def of_other_size(fits: Sequence[DotFit]) -> list[int]:
    """Return which fitted dots are smaller than most; all, if the sizes scatter as no plate's."""
    if len(fits) < FEWEST_DOTS:
        return []
    off, sd = excess_of_sizes(fits)
    if float(robust_sd(off / sd)) > SIZES_SPREAD_SD:
        return [*range(len(fits))]
    return [int(dot) for dot in np.flatnonzero(off < -OTHER_SIZE_SD * sd)]


def excess_of_sizes(fits: Sequence[DotFit]) -> tuple[Array, float]:
    """Return by how much the log radii of fitted dots exceed (N,) their trend across the image,
    which is that of most dots, and by what standard deviation those of true dots do."""
    centres = np.array([fit.centre_px for fit in fits])
    size = np.array([_log_radius(fit) for fit in fits])
    own = float(np.median([fit.log_radius_sd for fit in fits]))
    x, y = (centres - centres.mean(0)).T / max(float(np.ptp(centres, 0).max()), 1.0)
    terms = [np.ones_like(x), x, y, x * x, x * y, y * y]
    design = np.stack(terms if len(x) >= 4 * len(terms) else terms[:1], -1)
    off = size - _mode(size)
    for step in _TREND_STEPS:
        rows = design / (1.0 + np.square(off / step)[:, None]) ** 2
        off = size - design @ np.linalg.lstsq(rows.T @ design, rows.T @ size, rcond=None)[0]
    return off, float(np.hypot(SIZE_SPREAD, own))


def _mode(values: Array) -> float:
    """Return where values (N,) are densest (half-sample mode; Robertson, Cryer, 1974)."""
    values = np.sort(values)
    while len(values) > 3:
        half = (len(values) + 1) // 2
        first = int(np.argmin(values[half - 1 :] - values[: len(values) - half + 1]))
        values = values[first : first + half]
    return float(values.mean())


def _unlike(fit: DotFit, log_radius: float, prior: Prior) -> float:
    """Return by how many standard deviations size and blur together differ from what is usual."""
    size = (_log_radius(fit) - log_radius) / SIZE_SPREAD
    return float(np.hypot(size, (fit.sigma_px - prior.edge_px) / prior.edge_spread_px))


def _log_radius(fit: DotFit) -> float:
    return 0.5 * float(np.log(np.prod(semi_axes(fit.shape_px))))


def _with_heart(window: Window, start: Start, noise: NoiseModel, prior: Prior) -> DotFit | None:
    """Return the fit of a dot that has a heart; None if it shows too few pixels, or if what was
    found is no heart inside a dot."""
    heart = replace(start, shape_px=_HEART_SHARE * start.shape_px)
    rows, columns = window.grey.shape
    u, v = np.meshgrid(np.arange(columns) + window.first_u, np.arange(rows) + window.first_v)
    offset = np.stack([u.ravel(), v.ravel()]) - start.centre_px[:, None]
    away = approximate_distance_px(heart.shape_px, *offset).reshape(rows, columns)
    rim = window.mask & (away > _HEART_REACH * prior.edge_px)
    if np.count_nonzero(rim) < FEWEST_PIXELS:
        return None
    own = replace(prior, edge_spread_px=np.inf)
    dot = fit_dot(
        replace(window, mask=rim), start, noise, prior, tolerance=_ROUGH, outlier_rounds=0
    )
    for _ in range(_ROUNDS):
        lit = without_neighbours(window, [dot])
        inner = fit_dot(lit, heart, noise, own, tolerance=_ROUGH, outlier_rounds=0)
        heart, before = inner.start, dot
        dot = fit_dot(without_neighbours(window, [inner]), dot.start, noise, prior, edges=True)
        if not dot.has_moved_from(before):
            break
    way = float(np.linalg.norm(inner.centre_px - dot.centre_px))
    inside = way + np.exp(_log_radius(inner)) < np.exp(_log_radius(dot))
    return dot if inside else None


def _explains_more(pair: DotFit, single: DotFit) -> bool:
    """Return whether chi-square falls by more than by chance for the heart's parameters."""
    gain = single.dof * (single.chi2_dof / pair.chi2_dof - 1.0)
    return bool(pair.contrast * single.contrast > 0.0 and gain > chdtri(PARAMETERS, RARE))
