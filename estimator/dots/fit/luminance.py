"""A dot's grey levels and their derivatives: the luminance model of Lavest, Viala, Dhome (1999).

A pixel's grey level is ``B0 + B1 x + B2 y`` plus the blurred image of an ellipse of grey level
``C + C1 x + C2 y``, with (x, y) the offset from the window's middle in units of the dot's radius
(:mod:`telerig.estimator.dots.fit.blurred_ellipse`). A dot's contrast gradient (C1, C2) is nearly
indistinguishable from a shift of its centre, so it is never free: it has a Gaussian prior.

Many dots are computed at once, as arrays with a leading axis of D dots whose pixels are padded to
the largest number P: one dot's arrays are so small that the calls would take most of the time.

theta (D, 6) holds centre (2), shape (3) and sigma; levels (D, 6) holds B0, B1, B2, C, C1, C2; the
parameters (D, 12) are both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields, replace

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
"""Weight of grey level 0 against one pixel, so that too few pixels still have a solution."""
EDGE_EXPANSION_LIMIT = 0.25
"""Curvature times sigma up to which centres agree with the exact sum to 1e-5 px, levels to 5e-4."""
_PRIOR = np.dtype([(f.name, type(f.default)) for f in fields(Prior)])


@dataclass(frozen=True)
class Pixels:
    """Pixels of D fits, padded to P: offsets x, y from the origin pixel, and grey levels, (D, P).

    there : (D, P) False for padding. counts : (D,) pixels that are there.
    grids : rows, columns and mask of each window. origin : (D, 2). radius : (D,) px.
    prior : (D,) structured array with the fields of `Prior`.
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
    prior: NDArray[np.void]

    def of(self, dots: Ints) -> Pixels:
        """The pixels of some of the dots."""
        if len(dots) == len(self.x):
            return self
        names = ("x", "y", "grey", "there", "counts", "origin", "radius", "prior")
        arrays = {name: getattr(self, name)[dots] for name in names}
        return replace(self, grids=tuple(self.grids[i] for i in dots), **arrays)


def gather(
    windows: Sequence[Window], starts: Sequence[Start], noise: NoiseModel, priors: Sequence[Prior]
) -> Pixels:
    """The pixels that each window's mask shows, padded to the largest number."""
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
    prior = np.array([astuple(p) for p in priors], _PRIOR)
    return Pixels(x, y, grey, there, counts, tuple(grids), origin, radius, noise, prior)


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

    Levels that are NaN are replaced by those that fit best.

    The contrast gradient acts before the blur: the Gaussian of x F_sharp is x F + sigma^2 dF/dx.
    Without that term a centre would shift by sigma^2 times the relative gradient. The derivatives
    of this small term by theta are neglected.
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
    information = design @ design.mT + _FEW_PIXELS * np.eye(4)
    levels = np.linalg.solve(information, pull)[..., 0]
    return np.concatenate([levels, np.zeros((len(levels), 2))], axis=1)


def prior_rows(pixels: Pixels, parameters: Array) -> tuple[Array, Array]:
    """Three whitened prior rows: Jacobian (D, 3, 12) by the parameters, and residual (D, 3)."""
    prior, radius, levels = pixels.prior, pixels.radius, parameters[:, 6:]
    tied = prior["tie_to_background"]
    weight = 1.0 / (prior["sigma_per_px"] * radius * np.maximum(np.abs(levels[:, 3]), 1e-12))
    rows = np.zeros((len(parameters), 3, 12))
    rows[:, 0, 10] = rows[:, 1, 11] = weight
    tie = np.where(tied, levels[:, 3] / np.where(tied, levels[:, 0], 1.0), 0.0)
    rows[:, 0, 7] = rows[:, 1, 8] = -tie * weight
    slope_weight = np.where(tied, 0.0, radius * weight)
    rows[:, 0, 9] = -prior["u_per_px"] * slope_weight
    rows[:, 1, 9] = -prior["v_per_px"] * slope_weight
    rows[:, 2, 5] = 1.0 / prior["edge_spread_px"]
    gap = -(rows @ parameters[..., None])[..., 0]
    gap[:, 2] += prior["edge_px"] / prior["edge_spread_px"]
    return rows, gap
