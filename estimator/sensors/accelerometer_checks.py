"""Faults of an accelerometer's record: unit, gravity left out, clipping, mounting axes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

GRAVITY_M_S2 = 9.80665
_UNITS = (
    ("g", 1.0),
    ("mm/s^2", 1000 * GRAVITY_M_S2),
    ("mg, or in cm/s^2", 1000.0),
    ("ft/s^2", GRAVITY_M_S2 / 0.3048),
)
_WITHIN = 1.5
_FLOATING_M_S2 = 0.6
_CLIPPED_LEAST = 5
_CLIPPED_EXCESS = 3
_FITS_DEG = 15.0
_CLEAR = 0.6
_SMOOTHED_S = 0.03


@dataclass(frozen=True)
class Clipping:
    """One axis (0, 1, 2) that rests on one value: count samples, the first at index ``first``."""

    axis: int
    value: float
    count: int
    first: int


def gravity_of(reading: ArrayLike) -> Array:
    """(3,) median reading of (N, 3): gravity and bias, which shake and clipping do not move."""
    return np.asarray(np.median(np.asarray(reading, float), axis=0))


def unit_of(gravity: ArrayLike) -> tuple[str, float] | None:
    """(unit, factor to m/s^2) when gravity's size shows another unit than m/s^2; else None.

    gravity : (3,) as the sensor gives it. The units lie so far apart that a factor of 1.5 either
    way, as a hard start within a short record may make it, does no harm; mg and cm/s^2 differ by
    2 %, less than a bias does, and are named together.
    """
    size = float(np.linalg.norm(gravity))
    for unit, expected in _UNITS:
        if expected / _WITHIN < size < expected * _WITHIN:
            return unit, GRAVITY_M_S2 / expected
    return None


def without_gravity(gravity: ArrayLike) -> bool:
    """Whether the readings have gravity taken out, as "linear acceleration" of phones has."""
    return float(np.linalg.norm(gravity)) < _FLOATING_M_S2


def plausible_gravity(gravity: ArrayLike) -> bool:
    """Whether the size is that of gravity in m/s^2, within the factor of 1.5 of `unit_of`."""
    size = float(np.linalg.norm(gravity)) / GRAVITY_M_S2
    return 1 / _WITHIN < size < _WITHIN


def clippings(reading: ArrayLike) -> list[Clipping]:
    """Ends of the range on which (N, 3) samples pile up: 5 or more, 3 times the next value's."""
    samples = np.asarray(reading, float)
    out = []
    for axis in range(3):
        values, counts = np.unique(samples[:, axis], return_counts=True)
        if len(values) < 3:
            continue
        for end, next_one in ((0, 1), (-1, -2)):
            count = int(counts[end])
            if count >= max(_CLIPPED_LEAST, _CLIPPED_EXCESS * int(counts[next_one])):
                first = int(np.flatnonzero(samples[:, axis] == values[end])[0])
                out.append(Clipping(axis, float(values[end]), count, first))
    return out


def dead_axes(reading: ArrayLike) -> list[int]:
    """Axes of (N, 3) readings that never change."""
    return [int(a) for a in np.flatnonzero(np.ptp(np.asarray(reading, float), axis=0) == 0)]


def tilt_deg(gravity: ArrayLike, axes: ArrayLike, up: ArrayLike) -> float:
    """Angle between the gravity that is read, turned by ``axes``, and up."""
    force = np.asarray(axes, float).T @ np.asarray(gravity, float)
    return _angle_deg(force, np.asarray(up, float))


def fitting_axes(gravity: ArrayLike, axes: ArrayLike, up: ArrayLike) -> Array | None:
    """(3, 3) the given axes with rows swapped or turned round so that gravity points up.

    Of the permutations with signs that keep the handedness, the one that changes fewest entries;
    None when no one brings gravity within 15 degrees of up. Rotations about the vertical stay open.
    """
    given, best = np.asarray(axes, float), None
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turned = np.array(signs)[:, None] * given[list(order)]
            if np.linalg.det(turned) * np.linalg.det(given) < 0:
                continue
            if tilt_deg(gravity, turned, up) > _FITS_DEG:
                continue
            change = (float(np.abs(turned - given).sum()), tilt_deg(gravity, turned, up))
            if best is None or change < best[0]:
                best = (change, turned)
    return None if best is None else best[1]


def motion_correlation(
    t_s: ArrayLike, reading: ArrayLike, stage_t_s: ArrayLike, position_mm: ArrayLike
) -> Array | None:
    """(3,) correlation of each sensor axis with the carriage's acceleration, smoothed over 30 ms.

    t_s (N,), reading (N, 3); stage_t_s, position_mm (E,). None where the records overlap by less
    than 0.3 s or the encoder does not accelerate.
    """
    from scipy.signal import savgol_coeffs

    t, stage_t = np.asarray(t_s, float), np.asarray(stage_t_s, float)
    low, high = max(t[0], stage_t[0]), min(t[-1], stage_t[-1])
    step = _SMOOTHED_S / 6
    if high - low < 10 * _SMOOTHED_S:
        return None
    grid = np.arange(low, high, step)
    place = _averaged(stage_t, np.asarray(position_mm, float), grid, step)
    felt = np.stack([_averaged(t, a, grid, step) for a in np.asarray(reading, float).T], -1)
    bend = np.convolve(place, savgol_coeffs(13, 3, deriv=2, delta=step), "valid")
    mean = np.hanning(15)[1:-1] / np.hanning(15)[1:-1].sum()
    smooth = np.stack([np.convolve(a, mean, "valid") for a in felt.T], -1)
    bend, smooth = bend - bend.mean(), smooth - smooth.mean(0)
    size = np.sqrt((bend**2).sum() * (smooth**2).sum(0))
    if not np.all(size > 0):
        return None
    return np.asarray(smooth.T @ bend / size)


def motion_contradicts(correlation: ArrayLike, along: ArrayLike) -> bool:
    """Whether another direction of the sensor than the stated one follows the carriage.

    correlation : (3,) of `motion_correlation`.  along : (3,) the travel axis in sensor axes.
    """
    found, stated = np.asarray(correlation, float), np.asarray(along, float)
    on_axis, best = float(found @ stated), float(np.abs(found).max())
    return on_axis < -_CLEAR or (best > _CLEAR and on_axis < best / 2)


def _averaged(t: Array, values: Array, grid: Array, step: float) -> Array:
    """Means over one grid step about each grid time, by the integral of straight lines."""
    integral = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(t))])
    ends = [np.interp(grid + s * step / 2, t, integral) for s in (-1, 1)]
    width = np.clip(grid + step / 2, t[0], t[-1]) - np.clip(grid - step / 2, t[0], t[-1])
    return np.asarray((ends[1] - ends[0]) / width)


def _angle_deg(a: Array, b: Array) -> float:
    across = np.linalg.norm(np.cross(a, b))
    return float(np.degrees(np.arctan2(across, a @ b)))
