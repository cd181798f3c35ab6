"""Accelerations of sensors, encoder and images on one time grid, smoothed by the same kernel.

A position has noise that grows when it is differentiated, a reading has not. For both to be
comparable, positions x and readings a are convolved with a cubic B-spline h of knot spacing w:
h'' * x needs no derivative of the data, because h'' is a second difference of triangles (de Boor,
A Practical Guide to Splines, ch. IX), and h * a is the same acceleration. Constants and straight
lines vanish in h'' * x, and no sample farther away than 2 w matters, so gaps stay gaps.

Between frames the images' positions are a straight line, which convolves what they show with a
triangle. Everything that is compared with them is convolved with the same triangle: at 20 frames a
second a motion of 7 Hz would otherwise seem to be a third smaller in the images.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Bools

_GAP = 2.5
"""Longest distance of two samples that is bridged by a straight line, in median steps."""


@dataclass(frozen=True)
class Grid:
    """A regular grid of n times start_s + k step_s, and the width of a smoothing kernel.

    count : n.
    knots : spacing of the kernel's knots in steps, at least 2.
    pace : spacing of the images' frames in steps.
    """

    start_s: float
    step_s: float
    count: int
    knots: int
    pace: int = 1

    @property
    def t_s(self) -> Array:
        """The times (n,) of the grid."""
        return np.asarray(self.start_s + self.step_s * np.arange(self.count))

    @property
    def width_s(self) -> float:
        """The spacing w of the kernel's knots in s."""
        return self.knots * self.step_s

    def covering(self, t_s: Array) -> Grid:
        """Return the grid with the same steps that covers all times t_s (N,)."""
        first = int(np.ceil((t_s[0] - self.start_s) / self.step_s - 1e-9))
        last = int(np.floor((t_s[-1] - self.start_s) / self.step_s + 1e-9))
        return replace(
            self, start_s=self.start_s + first * self.step_s, count=max(last - first + 1, 0)
        )

    @property
    def triangle(self) -> Array:
        """The triangular kernel (2 knots - 1,) of half-width w; its sum is 1."""
        return _triangle(self.knots)

    def noise_gain(self, step_s: float) -> float:
        """Return the factor (1/s^2) from errors of positions to errors of smoothed accelerations.

        It is the ratio of the standard deviations, for positions with independent errors that are
        measured every ``step_s``.
        """
        second = np.zeros(4 * self.knots - 1)
        for shift, factor in ((0, 1.0), (self.knots, -2.0), (2 * self.knots, 1.0)):
            second[shift : shift + 2 * self.knots - 1] += factor * self.triangle
        independent = max(step_s / self.step_s, 1.0)
        return float(np.sqrt((second**2).sum() * independent)) / self.width_s**2


@dataclass(frozen=True)
class Accelerations:
    """Smoothed accelerations along D directions at the n times of a grid.

    values : (n, D) in mm/s^2, 0 where they are not known.
    known : (n,).
    """

    grid: Grid
    values: Array
    known: Bools

    def at(self, t_s: Array) -> tuple[Array, Bools]:
        """Return the values (m, D) at times t_s (m,), and whether they are known (m,)."""
        place = (t_s - self.grid.start_s) / self.grid.step_s
        low = np.clip(np.floor(place).astype(int), 0, max(self.grid.count - 2, 0))
        share = (place - low)[:, None]
        inside = (place >= -1e-9) & (place <= self.grid.count - 1 + 1e-9)
        known = inside & self.known[low] & self.known[np.minimum(low + 1, self.grid.count - 1)]
        values = (1 - share) * self.values[low] + share * self.values[low + 1]
        return np.where(known[:, None], values, 0.0), known


def _triangle(half: int) -> Array:
    """Return a triangle (2 half - 1,) of ``half`` steps to each side; its sum is 1."""
    rising = np.arange(1, half + 1) / half**2
    return np.concatenate([rising, rising[-2::-1]])


def of_positions(grid: Grid, t_s: ArrayLike, positions_mm: ArrayLike) -> Accelerations:
    """Return the smoothed accelerations of measured positions.

    t_s : (N,) increasing times. positions_mm : (N, D).
    """
    t, x = np.asarray(t_s, float), np.asarray(positions_mm, float)
    there = _bridged(grid.t_s, t)
    centred = x - x.mean(0)
    even = np.stack([np.interp(grid.t_s, t, column) for column in centred.T], -1)
    bridge = _bridge(grid, t)
    reach, second = 2 * grid.knots - 1 + len(bridge) // 2, np.zeros_like(even)
    known = _eroded(there, reach)
    kernel = np.convolve(grid.triangle, bridge)
    smooth = np.stack([np.convolve(column, kernel, "same") for column in even.T], -1)
    k = grid.knots
    second[k:-k] = (smooth[2 * k :] - 2 * smooth[k:-k] + smooth[: -2 * k]) / grid.width_s**2
    return Accelerations(grid, np.where(known[:, None], second, 0.0), known)


def of_readings(
    grid: Grid, t_s: ArrayLike, readings_mm_s2: ArrayLike, covered_s: Array | None = None
) -> Accelerations:
    """Return the smoothed readings of an accelerometer, minus their median over the whole record.

    t_s : (N,) increasing times. readings_mm_s2 : (N, 3).
    covered_s : (M,) times that the result covers, those of masked samples included; t_s by default.
    """
    from scipy.signal import fftconvolve

    t, reading = np.asarray(t_s, float), np.asarray(readings_mm_s2, float)
    own = grid.covering(t if covered_s is None else covered_s)
    even = _averaged(t, reading - np.median(reading, axis=0), own)
    bridge = _bridge(grid, t)
    known = _eroded(_bridged(own.t_s, t), 2 * grid.knots - 1 + len(bridge) // 2)
    spline = np.convolve(np.convolve(grid.triangle, grid.triangle), bridge)
    values = fftconvolve(even, spline[:, None], "same", axes=0) if own.count else even
    return Accelerations(own, np.where(known[:, None], values, 0.0), known)


def _bridge(grid: Grid, t: Array) -> Array:
    """Return the triangle by which samples at t (N,) lack what a line between frames does."""
    own = round(float(np.median(np.diff(t))) / grid.step_s) if len(t) > 1 else grid.pace
    return _triangle(grid.pace) if own < grid.pace else np.ones(1)


def _averaged(t: Array, values: Array, grid: Grid) -> Array:
    """Return the mean (n, D) of a piecewise linear signal over one step about each grid time."""
    area = (values[1:] + values[:-1]) / 2 * np.diff(t)[:, None]
    integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(area, axis=0)])
    half = grid.step_s / 2
    low, high = (np.clip(grid.t_s + side, t[0], t[-1]) for side in (-half, half))
    ends = [np.stack([np.interp(at, t, c) for c in integral.T], -1) for at in (low, high)]
    return np.asarray((ends[1] - ends[0]) / np.maximum(high - low, 1e-12)[:, None])


def _bridged(at: Array, t: Array) -> Bools:
    """Return whether each time (n,) lies between samples (N,) no farther apart than usual."""
    if len(t) < 2:
        return np.zeros(len(at), bool)
    longest = _GAP * max(float(np.median(np.diff(t))), float(at[1] - at[0]) if len(at) > 1 else 0)
    after = np.clip(np.searchsorted(t, at - 1e-9), 1, len(t) - 1)
    inside = (at >= t[0] - 1e-9) & (at <= t[-1] + 1e-9)
    return np.asarray(inside & (t[after] - t[after - 1] <= longest))


def _eroded(there: Bools, reach: int) -> Bools:
    """Return whether all samples within ``reach`` steps are there."""
    padded = np.concatenate([np.zeros(reach), there, np.zeros(reach)])
    total = np.concatenate([[0.0], np.cumsum(padded)])
    return np.asarray(total[2 * reach + 1 :] - total[: -2 * reach - 1] > 2 * reach + 0.5)
