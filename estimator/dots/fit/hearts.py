"""Dots with a heart: an inner disc that is brighter or darker than the rest of the dot.

Phase contrast, holes that light shines through, and ink that dries to a ring make such dots. One
disc that is fitted to them lies on the heart, or between the heart and the rim, with more blur than
the lens makes. Such a dot is fitted as two discs at once, itself and its heart, so that its
covariance holds what the heart leaves open. The fit starts at the two steps of grey levels that
explain most about the disc's middle. Where a sample of an image's dots shows hearts, all are fitted
with one, and what the blur hides of a heart follows from what most hearts look like; elsewhere only
those dots are whose size or residuals are unlike the others'.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri, ndtr

from telerig.arrays import Array
from telerig.estimator.dots.fit.blurred_ellipse import matrix_from_shape, semi_axes
from telerig.estimator.dots.fit.luminance import (
    HEART_PARAMETERS,
    DotFit,
    Prior,
    Start,
    Window,
    fit_dot,
)
from telerig.estimator.dots.fit.surroundings import BLUR_SPREAD, usual_heart
from telerig.estimator.dots.thresholds import OTHER_SIZE_SD, RARE, SIZE_SPREAD, SIZES_SPREAD_SD
from telerig.estimator.images.noise import NoiseModel
from telerig.statistics import robust_sd

FEWEST_PIXELS = 25
"""Least number of pixels for another fit; a dot whose first fit left the image has fewer."""
FEWEST_DOTS = 8
"""Fewer dots do not tell what size they have in common."""
_SAMPLE, _CLEAR = 12, 4
"""So many dots tell whether an image shows hearts; the first ones do if none of them has one."""
_SEEN = 2.0 * HEART_PARAMETERS
"""A heart that gains more than this counts as one, where most dots have one."""
_LARGEST = 5.0
"""A dot is at most so many times as large as the disc that was fitted to its heart."""
_QUICK: dict[str, Any] = {"iterations": 10, "tolerance": 0.3, "outlier_rounds": 0}
_FULL: dict[str, Any] = {"edges": True}
"""Arguments of fits of which only chi-square matters, and of those that are results."""
_STEP_PX, _STEPS = 0.5, 40
"""Steps of grey levels are searched every half pixel, but at no more radii than this."""
_BLURS_PX = (0.6, 0.85, 1.2, 1.7, 2.4)
"""Blurs with which they are searched."""
_SMEARED = (0.0, 0.1)
"""Further blur of a heart that is not concentric, relative to its radius."""
_STARTS = 6
_EXTRA, _WIDEST = (-0.8, 5.0), 0.88
"""Extra light of hearts, relative to the dot, and their largest radius. A dot around which the lens
spreads some of its light would be a heart of 10 to 40 times the light of what is around it."""
_EXPLAINED = 0.5
"""Least share of a disc's excess chi-square that a heart explains: 0.7 to 1 where there is one; the
best hearts of real plates without hearts explain 0.1 in the median."""
_TREND_STEPS = (0.1, 0.1, 0.05, 0.05, 0.03, 0.03, 0.03, 0.03)
"""Log radii farther than this from the trend count little, step by step."""

Windows = Callable[[int, Start], Window]


def show_hearts(
    fits: Sequence[DotFit], noise: NoiseModel, priors: Sequence[Prior], window: Windows
) -> bool:
    """Return whether most dots of a sample have a heart; arguments as in `with_hearts`.

    Where dots or ground are clipped, they are flat as if dots had hearts, and none is seen.
    """
    for level in np.median([(fit.background, fit.background + fit.contrast) for fit in fits], 0):
        near = 2.0 * noise.sigma_at(level)
        if not noise.black + near < level < noise.white - near:
            return False
    gain, shown = 0.0, []
    reach = _reach_px(fits)
    for dot in range(0, len(fits), max(1, len(fits) // _SAMPLE)):
        prior = _any_blur(priors[dot])
        pair = _with_heart(dot, fits[dot], reach[dot], noise, prior, window, rough=True)
        if pair is not None:
            gain += _gain(*pair)
            shown.append(_gain(*pair) > _SEEN and _explains(*pair))
        if len(shown) == _CLEAR and not any(shown):
            return False
    return bool(
        shown and np.mean(shown) > 0.5 and gain > chdtri(HEART_PARAMETERS * len(shown), RARE)
    )


def with_hearts(
    fits: Sequence[DotFit],
    noise: NoiseModel,
    priors: Sequence[Prior],
    window: Windows,
    doubtful: Sequence[int],
    *,
    usual: bool,
) -> list[DotFit]:
    """Fit the doubtful ones of an image's dots again, each with a heart, and return all fits.

    priors : of each dot. window : returns a dot's pixels, given its number and the start of a fit.
    usual : whether the image's dots have hearts.
    """
    single, fits, reach = fits, list(fits), _reach_px(fits)

    def again(dot: int, prior: Prior) -> DotFit:
        found = _with_heart(dot, single[dot], reach[dot], noise, prior, window)
        if found is None:
            return single[dot]
        sure = _gain(*found) > chdtri(HEART_PARAMETERS, RARE) and _explains(*found)
        likely = usual and _gain(*found) > _SEEN
        return found[0] if likely or sure else single[dot]

    for dot in doubtful:
        fits[dot] = again(dot, _any_blur(priors[dot]))
    off, sd = excess_of_sizes(fits)
    usual_blurs = np.array([f.sigma_px for f, z in zip(fits, off / sd) if abs(z) < OTHER_SIZE_SD])
    if not usual_blurs.size:
        return fits
    blur = float(np.median(usual_blurs))
    spread = max(BLUR_SPREAD * blur, float(robust_sd(usual_blurs - blur)))
    size, size_sd, light, light_sd = usual_heart(fits)
    for dot in doubtful:
        log_radius = _log_radius(fits[dot]) - off[dot]
        prior = replace(priors[dot], edge_px=blur, edge_spread_px=spread)
        if usual and np.isfinite(size_sd):
            prior = replace(prior, heart_size=size, heart_size_sd=size_sd,
                            heart_light=light, heart_light_sd=light_sd)  # fmt: skip
            fits[dot] = _with_usual_heart(dot, fits[dot], log_radius, noise, prior, window)
        elif _unlike(fits[dot], log_radius, prior) > 1.0:
            fit = again(dot, prior)
            if _unlike(fit, log_radius, prior) < _unlike(fits[dot], log_radius, prior):
                fits[dot] = fit
    return fits


def _with_usual_heart(
    dot: int, fit: DotFit, log_radius: float, noise: NoiseModel, prior: Prior, window: Windows
) -> DotFit:
    """Return the better one of a dot's fit and another one that starts with the size and the heart
    that are usual, and with the dot's light; a disc is only better if it is by more than chance."""
    larger = float(np.exp(log_radius - _log_radius(fit)))
    size, light = fit.heart_look if fit.heart is not None else (0.0, 0.0)
    whole = (1.0 + light * size**2) / (1.0 + prior.heart_light * prior.heart_size**2) / larger**2
    before = replace(fit, levels=fit.levels * np.repeat([1.0, whole], 3))
    heart = np.r_[fit.centre_px, prior.heart_size, prior.heart_light * before.contrast]
    usual = Start(fit.centre_px, fit.shape_px * larger, prior.edge_px, before, heart)
    pixels = window(dot, usual)
    found = [fit_dot(pixels, start, noise, prior, **_FULL) for start in (usual, fit.start)]
    if min(one.pixels for one in found) < FEWEST_PIXELS:
        return fit
    costs = [one.chi2_dof * one.dof + _unlike_heart(one, prior) for one in found]
    chance = float(chdtri(HEART_PARAMETERS, RARE)) if fit.heart is None else 0.0
    return found[0] if costs[0] < costs[1] + chance else found[1]


def _unlike_heart(fit: DotFit, prior: Prior) -> float:
    """Return the square of the standard deviations by which blur and heart differ from usual."""
    size, light = fit.heart_look
    square = ((fit.sigma_px - prior.edge_px) / prior.edge_spread_px) ** 2
    if fit.heart is not None:
        square += ((size - prior.heart_size) / prior.heart_size_sd) ** 2
        square += ((light - prior.heart_light) / prior.heart_light_sd) ** 2
    return square


def _reach_px(fits: Sequence[DotFit]) -> Array:
    """Return how large (N,) each dot may be: not so large that it meets an equal neighbour."""
    radius = np.exp([_log_radius(fit) for fit in fits])
    centres = np.array([fit.centre_px for fit in fits])
    nearest = cKDTree(centres).query(centres, 2)[0][:, 1]
    return np.asarray(np.clip(0.5 * nearest, 1.3 * radius, _LARGEST * radius))


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


def _any_blur(prior: Prior) -> Prior:
    return replace(prior, edge_spread_px=np.inf)


def _with_heart(
    dot: int,
    single: DotFit,
    reach_px: float,
    noise: NoiseModel,
    prior: Prior,
    window: Windows,
    *,
    rough: bool = False,
) -> tuple[DotFit, DotFit] | None:
    """Return the fits of a dot with a heart and of one disc to the same pixels; None if it shows
    too few pixels, or if what was found is no heart.

    rough : whether a few steps from the best start are enough.
    """
    starts = _starts(dot, single, reach_px, prior, window)
    best = None
    for start in starts[: 1 if rough else _STARTS]:
        pixels = window(dot, start)
        fit = fit_dot(pixels, start, noise, prior, **(_QUICK if rough else _FULL))
        if fit.pixels >= FEWEST_PIXELS and (best is None or fit.chi2_dof < best[0].chi2_dof):
            best = fit, pixels
        if best is not None and not best[0].is_misfit and np.isinf(prior.edge_spread_px):
            break
    if best is None:
        return None
    pair, pixels = best
    extra = np.nan if pair.heart is None else pair.heart[3] / pair.contrast
    if not (pair.contrast * single.contrast > 0.0 and _EXTRA[0] < extra < _EXTRA[1]):
        return None
    start = Start(single.centre_px, single.shape_px, single.sigma_px)
    return pair, fit_dot(pixels, start, noise, prior, **_QUICK)


def _starts(
    dot: int, single: DotFit, reach_px: float, prior: Prior, window: Windows
) -> list[Start]:
    """Return starts of a fit with a heart, best first: for each blur those two steps of the grey
    levels about the middle of a disc, as wide and tilted as the disc, that fit its pixels best."""
    radius = float(np.exp(_log_radius(single)))
    whole = replace(single.start, shape_px=single.shape_px * reach_px / (1.3 * radius))
    seen = window(dot, replace(whole, sigma_px=prior.edge_px))
    v, u = np.nonzero(seen.mask)
    offset = np.stack([u + seen.first_u, v + seen.first_v]) - single.centre_px[:, None]
    inverse = np.linalg.inv(matrix_from_shape(single.shape_px))
    away = radius * np.linalg.norm(inverse @ offset, axis=0)
    near = away < reach_px
    if np.count_nonzero(near) < FEWEST_PIXELS:
        return []
    blurs = _BLURS_PX if np.isinf(prior.edge_spread_px) else (prior.edge_px,)
    starts = []
    for inner, outer, sigma, levels in _two_steps(away[near], seen.grey[seen.mask][near], blurs):
        shape = single.shape_px * outer / radius
        before = replace(
            single,
            origin_px=np.round(single.centre_px),
            radius_px=float(semi_axes(shape)[0]),
            levels=np.array([levels[0], 0.0, 0.0, levels[1], 0.0, 0.0]),
        )
        heart = np.r_[single.centre_px, inner / outer, levels[2]]
        starts.append(Start(single.centre_px, shape, sigma, before, heart))
    return starts


def _two_steps(
    away: Array, grey: Array, blurs_px: Sequence[float]
) -> list[tuple[float, float, float, Array]]:
    """Return the radii of the two blurred steps of grey levels that fit pixels best, for several
    blurs, best first.

    away, grey : (P,) distances from the middle and grey levels.

    Returns the radii of heart and dot, the blur's sigma, and levels (3,): background, contrast of
    the dot, and of the heart.
    """
    step_px = max(_STEP_PX, float(away.max()) / _STEPS)
    bins = (away / step_px).astype(int)
    count, total = np.bincount(bins).astype(np.float64), np.bincount(bins, grey)
    middle = step_px * (np.arange(len(count)) + 0.5)
    edges = step_px * np.arange(2, len(count) - 2)
    i, j = np.nonzero(edges[:, None] < _WIDEST * edges)
    found = []
    for sigma in blurs_px if i.size else ():
        for smeared in _SMEARED:
            blurs = sigma * np.ones_like(edges), np.hypot(sigma, smeared * edges)
            steps = [ndtr((edges[:, None] - middle) / blur[:, None]) for blur in blurs]
            rows = np.concatenate([np.ones((1, len(middle))), *steps])
            gram, right = (rows * count) @ rows.T, rows @ total
            which = np.stack([np.zeros_like(i), 1 + j, 1 + len(edges) + i], -1)
            matrix = gram[which[:, :, None], which[:, None, :]] + 1e-6 * np.eye(3)
            levels = np.linalg.solve(matrix, right[which][..., None])[..., 0]
            extra = levels[:, 2] / np.where(levels[:, 1] == 0.0, 1e-12, levels[:, 1])
            heart = (extra > _EXTRA[0]) & (extra < _EXTRA[1])
            gain = np.where(heart, np.sum(levels * right[which], -1), -np.inf)
            k = int(np.argmax(gain))
            found.append((-gain[k], edges[i[k]], edges[j[k]], sigma, levels[k]))
    return [one[1:] for one in sorted(found, key=lambda one: one[0]) if np.isfinite(one[0])]


def _gain(pair: DotFit, single: DotFit) -> float:
    """Return by how much a heart lowers chi-square, relative to what is left for each degree."""
    lower = pair.dof * (single.chi2_dof - pair.chi2_dof) / max(pair.chi2_dof, 1e-9)
    return lower + HEART_PARAMETERS


def _explains(pair: DotFit, single: DotFit) -> bool:
    """Return whether a heart explains the excess chi-square that a disc has, or most of it."""
    left = (pair.chi2_dof - 1.0) / max(single.chi2_dof - 1.0, 1e-9)
    return not pair.is_misfit or left < 1.0 - _EXPLAINED
