"""A dot's grey levels and their derivatives: the luminance model of Lavest, Viala, Dhome (1999).

A pixel's grey level is ``B0 + B1 x + B2 y`` plus the blurred image of an ellipse of grey level
``C + C1 x + C2 y``, with (x, y) the offset from the window's middle in units of the dot's radius
(:mod:`telerig.estimator.dots.fit.blurred_ellipse`). A dot's contrast gradient (C1, C2) can hardly
be told from a shift of its centre, so it never floats freely: it carries a Gaussian prior.

Many dots are computed at once, as arrays with a leading axis of D dots whose P pixels are padded
to the most: one dot's arrays are so small that calls would cost more than sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.dots.fit.blurred_ellipse import (
    coverage_near_edge,
    coverage_on_grid,
    largest_curvature,
    semi_axes,
)
from telerig.estimator.dots.fit.types import Prior, Start, Window
from telerig.estimator.images.noise import NoiseModel

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

_FEW_PIXELS = 1e-9
"""Of a pixel's weight on no grey at all, so that too few pixels tell something."""
EDGE_EXPANSION_LIMIT = 0.25  # centres agree with the exact sum to 1e-5 px, levels to 5e-4


@dataclass(frozen=True)
class Pixels:
    """Pixels of D fits: offsets from their origin pixels, and data, (D, P); ``there`` of any.

    ``grids`` keep rows, columns and mask of each window. Priors are arrays (D,).
    """

    x: Array
    y: Array
    grey: Array
    there: Mask
    counts: Ints
    grids: tuple[tuple[Array, Array, Mask], ...]
    origin: Array
    radius: Array
    noise: NoiseModel
    prior: _Priors

    def of(self, dots: Ints) -> Pixels:
        """Some of the dots."""
        if len(dots) == len(self.x):
            return self
        return Pixels(
            self.x[dots], self.y[dots], self.grey[dots], self.there[dots], self.counts[dots],
            tuple(self.grids[i] for i in dots), self.origin[dots], self.radius[dots], self.noise,
            self.prior.of(dots),
        )  # fmt: skip


@dataclass(frozen=True)
class _Priors:
    """The numbers of `Prior`, each (D,)."""

    slope_per_px: Array
    sigma_per_px: Array
    tied: Mask
    edge_px: Array
    edge_spread_px: Array

    def of(self, dots: Ints) -> _Priors:
        return _Priors(
            self.slope_per_px[dots], self.sigma_per_px[dots], self.tied[dots], self.edge_px[dots],
            self.edge_spread_px[dots],
        )  # fmt: skip


def _priors(priors: Sequence[Prior]) -> _Priors:
    return _Priors(
        np.array([[p.u_per_px, p.v_per_px] for p in priors]),
        np.array([p.sigma_per_px for p in priors]),
        np.array([p.tie_to_background for p in priors]),
        np.array([p.edge_px for p in priors]),
        np.array([p.edge_spread_px for p in priors]),
    )


def gather(
    windows: Sequence[Window], starts: Sequence[Start], noise: NoiseModel, priors: Sequence[Prior]
) -> Pixels:
    """The pixels that each window's mask shows, those of the shorter ones padded."""
    counts = np.array([np.count_nonzero(w.mask) for w in windows])
    x, y, grey = np.zeros((3, len(windows), max(int(counts.max()), 1)))
    origin, radius, grids = np.empty((len(windows), 2)), np.empty(len(windows)), []
    for i, (window, start) in enumerate(zip(windows, starts)):
        before = start.previous
        origin[i] = np.round(start.centre_px) if before is None else before.origin_px
        radius[i] = semi_axes(start.shape_px)[0] if before is None else before.radius_px
        columns = np.arange(window.grey.shape[1]) + window.first_u - origin[i, 0]
        rows = np.arange(window.grey.shape[0]) + window.first_v - origin[i, 1]
        at_row, at_column = np.nonzero(window.mask)
        x[i, : counts[i]], y[i, : counts[i]] = columns[at_column], rows[at_row]
        grey[i, : counts[i]] = window.grey[window.mask]
        grids.append((rows, columns, window.mask))
    there = np.arange(x.shape[1]) < counts[:, None]
    return Pixels(
        x, y, grey, there, counts, tuple(grids), origin, radius, noise, _priors(priors)
    )  # fmt: skip


def _coverage(pixels: Pixels, theta: Array) -> tuple[Array, Array]:
    """(D, P) and its derivatives (D, 6, P) by theta (D, 6)."""
    curved = largest_curvature(theta[:, 2:5]) * theta[:, 5] >= EDGE_EXPANSION_LIMIT
    if not np.all(curved):
        value, gradient = coverage_near_edge(
            pixels.x - theta[:, :1], pixels.y - theta[:, 1:2], theta[:, 2:5], theta[:, 5]
        )
    else:
        value = np.zeros_like(pixels.x)
        gradient = np.zeros((len(theta), 6, pixels.x.shape[1]))
    for i in np.flatnonzero(curved):
        rows, columns, mask = pixels.grids[i]
        exact, slopes = coverage_on_grid(columns, rows, theta[i, :2], theta[i, 2:5], theta[i, 5])
        value[i, : pixels.counts[i]] = exact[mask]
        gradient[i, :, : pixels.counts[i]] = slopes[:, mask]
    return value, gradient


def grey_levels(pixels: Pixels, theta: Array, levels: Array) -> tuple[Array, Array, Array]:
    """Grey levels (D, P), their derivatives (D, 12, P) by theta and levels, and the levels (D, 6).

    Instead of ``levels`` that are NaN, those that fit best.

    The light's slope acts before the blur: the Gaussian of x F_sharp is x F + sigma^2 dF/dx.
    Left out, this shifts a centre by sigma^2 times the relative slope. (How that small term
    itself changes with theta is left out of the derivatives.)
    """
    coverage, gradient = _coverage(pixels, theta)
    radius = pixels.radius[:, None]
    x, y = pixels.x / radius, pixels.y / radius
    spread = theta[:, 5:] ** 2 / radius
    jacobian = np.empty((len(x), 12, x.shape[1]))
    jacobian[:, 6], jacobian[:, 7], jacobian[:, 8] = 1.0, x, y
    jacobian[:, 9] = coverage
    jacobian[:, 10] = coverage * x - spread * gradient[:, 0]
    jacobian[:, 11] = coverage * y - spread * gradient[:, 1]
    unknown = np.isnan(levels[:, 0])
    if np.any(unknown):
        levels = np.where(unknown[:, None], _first_levels(pixels, jacobian), levels)
    grey = (levels[:, None] @ jacobian[:, 6:])[:, 0]
    contrast = levels[:, 3:4] + levels[:, 4:5] * x + levels[:, 5:6] * y
    np.multiply(gradient, contrast[:, None], out=jacobian[:, :6])
    return grey, jacobian, levels


def _first_levels(pixels: Pixels, jacobian: Array) -> Array:
    design = jacobian[:, 6:10] * pixels.there[:, None]
    pull = design @ pixels.grey[..., None]
    information = design @ transposed(design) + _FEW_PIXELS * np.eye(4)
    levels = np.linalg.solve(information, pull)[..., 0]
    return np.concatenate([levels, np.zeros((len(levels), 2))], axis=1)


def transposed(x: Array) -> Array:
    return np.swapaxes(x, -1, -2)


def prior_rows(pixels: Pixels, parameters: Array) -> tuple[Array, Array]:
    """Three whitened prior rows: Jacobian (D, 3, 12) by the parameters, and residual (D, 3)."""
    prior, radius, levels = pixels.prior, pixels.radius, parameters[:, 6:]
    weight = 1.0 / (prior.sigma_per_px * radius * np.maximum(np.abs(levels[:, 3]), 1e-12))
    rows = np.zeros((len(parameters), 3, 12))
    rows[:, 0, 10] = rows[:, 1, 11] = weight
    tie = np.where(prior.tied, levels[:, 3] / np.where(prior.tied, levels[:, 0], 1.0), 0.0)
    rows[:, 0, 7] = rows[:, 1, 8] = -tie * weight
    told = np.where(prior.tied, 0.0, radius * weight)
    rows[:, :2, 9] = -prior.slope_per_px * told[:, None]
    rows[:, 2, 5] = 1.0 / prior.edge_spread_px
    gap = -(rows @ parameters[..., None])[..., 0]
    gap[:, 2] += prior.edge_px / prior.edge_spread_px
    return rows, gap
