"""Accelerations of sensors, encoder and images on one time grid, smoothed by the same kernel.

A position has noise that grows when it is differentiated, a reading has not. For both to be
comparable, positions a frame apart become second differences, which are the acceleration averaged
by a triangle of a frame's length to each side; these are averaged over frames with the weights of a
cubic B-spline (de Boor, A Practical Guide to Splines, ch. IX). Readings are convolved with what
this kernel is in continuous time: the B-spline, taken at the frames, times the triangle. Constants
and straight lines vanish in the second differences, and no sample farther away than the kernel
reaches matters, so gaps stay gaps.

At the times of frames both are the same acceleration whatever its frequency. Between them they are
not: positions at 20 Hz show a vibration at 19 Hz as one at 1 Hz, and so do readings that are
compared with them at frames only.
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
    def at_frame(self) -> Bools:
        """Whether each time (n,) is that of a frame, of a grid that begins at one."""
        return np.asarray(np.arange(self.count) % self.pace == 0)

    @property
    def weights(self) -> Array:
        """The weights of steps about a time: a cubic B-spline at frames, 0 between; sum 1."""
        half = _triangle(self.knots)
        spline = np.convolve(half, half)
        middle = len(spline) // 2
        comb = np.where((np.arange(len(spline)) - middle) % self.pace == 0, spline, 0.0)
        return np.asarray(comb / comb.sum())

    @property
    def noise_gain(self) -> float:
        """Return the factor (1/s^2) from errors of positions to errors of smoothed accelerations:
        the ratio of the standard deviations, if positions have independent errors in each frame."""
        taps = np.convolve(self.weights, _second_difference(self.pace))
        return float(np.sqrt((taps**2).sum())) / (self.pace * self.step_s) ** 2


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
    kernel = np.convolve(grid.weights, _second_difference(grid.pace))
    known = _eroded(there, len(kernel) // 2)
    second = _convolved(even, kernel) / (grid.pace * grid.step_s) ** 2
    return Accelerations(grid, np.where(known[:, None], second, 0.0), known)


def of_readings(
    grid: Grid, t_s: ArrayLike, readings_mm_s2: ArrayLike, covered_s: Array | None = None
) -> Accelerations:
    """Return the smoothed readings of an accelerometer, minus their median over the whole record.

    t_s : (N,) increasing times. readings_mm_s2 : (N, 3).
    covered_s : (M,) times that the result covers, those of masked samples included; t_s by default.
    """
    t, reading = np.asarray(t_s, float), np.asarray(readings_mm_s2, float)
    own = grid.covering(t if covered_s is None else covered_s)
    even = _averaged(t, reading - np.median(reading, axis=0), own)
    kernel = np.convolve(grid.weights, _triangle(grid.pace))
    known = _eroded(_bridged(own.t_s, t), len(kernel) // 2)
    values = _convolved(even, kernel)
    return Accelerations(own, np.where(known[:, None], values, 0.0), known)


def _convolved(columns: Array, kernel: Array) -> Array:
    """Return columns (n, D) convolved with a kernel of odd length."""
    from scipy.signal import fftconvolve

    if not columns.size:
        return columns
    return np.asarray(fftconvolve(columns, kernel[:, None], "same", axes=0))


def _second_difference(steps: int) -> Array:
    """Return the kernel (2 steps + 1,) of a second difference at a spacing of so many steps."""
    kernel = np.zeros(2 * steps + 1)
    kernel[[0, steps, -1]] = 1.0, -2.0, 1.0
    return kernel


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
