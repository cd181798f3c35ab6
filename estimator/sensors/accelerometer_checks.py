"""Checks an accelerometer's record for a wrong unit, removed gravity, clipping and wrong axes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.rig.units import STANDARD_GRAVITY_M_S2

_UNITS = (
    ("g", 1.0),
    ("mm/s^2", 1000 * STANDARD_GRAVITY_M_S2),
    ("mg or cm/s^2", 1000.0),
    ("ft/s^2", STANDARD_GRAVITY_M_S2 / 0.3048),
)
"""The units that are recognised, with the value of gravity in each. They differ so much that an
error of the reading at rest by a factor of 1.5 does no harm; a strong acceleration at the start of
a short record can cause such an error. mg and cm/s^2 are named together, because they differ by
only 2 %, less than the effect of a usual bias."""

_WITHIN = 1.5
_FLOATING_M_S2 = 0.6
_CLIPPED_LEAST = 5
_CLIPPED_EXCESS = 3
_TILTED_DEG = 20.0
_FITS_DEG = 15.0
_CLEAR = 0.6
_SMOOTHED_S = 0.03


def check_accelerometer(t_s: ArrayLike, reading_m_s2: ArrayLike, *, where: str) -> list[str]:
    """Return warnings about the readings of one sensor.

    t_s : (N,) times.
    reading_m_s2 : (N, 3).
    where : file and sensor, for the messages.

    Raises InputError for a wrong unit, for readings without gravity and for values that are not
    finite.
    """
    t, reading = np.asarray(t_s, float), np.asarray(reading_m_s2, float).reshape(-1, 3)
    finite = np.isfinite(t) & np.isfinite(reading).all(1)
    if not finite.all():
        row = int(np.flatnonzero(~finite)[0])
        raise InputError(f"sample {row} is not finite", where=where, todo="leave it out")
    _check_gravity(float(np.linalg.norm(gravity_of(reading))), where)
    words = [
        f"{where}: {found.count} of {len(t)} samples of a{'xyz'[found.axis]} are clipped at "
        f"{found.value:.4g} m/s^2, the first at {t[found.first]:.6g} s. The sensor's range is too "
        "small: leave those rows out, or choose a wider range"
        for found in clippings(reading)
    ]
    dead = np.flatnonzero(np.ptp(reading, axis=0) == 0)
    return words + [
        f"{where}: a{'xyz'[axis]} never changes: the sensor is stuck, or not connected"
        for axis in dead
    ]


def gravity_of(reading: ArrayLike) -> Array:
    """Return the median reading (3,) of N readings (N, 3), which is gravity plus bias.

    Shake and clipping hardly change the median.
    """
    return np.asarray(np.median(np.asarray(reading, float), axis=0))


def _check_gravity(size: float, where: str) -> None:
    """Raise InputError if the size of the median reading is not gravity in m/s^2."""
    for unit, expected in _UNITS:
        if expected / _WITHIN < size < expected * _WITHIN:
            factor = STANDARD_GRAVITY_M_S2 / expected
            raise InputError(
                f"the sensor reads {size:.4g} at rest, where m/s^2 would be 9.81: it is in {unit}",
                where=where,
                todo=f"multiply ax_m_s2, ay_m_s2, az_m_s2 by {factor:.6g}",
            )
    if size < _FLOATING_M_S2:
        raise InputError(
            f"the sensor reads {size:.2g} m/s^2 at rest: gravity has been taken out",
            where=where,
            todo="give the specific force as the sensor measures it, 9.81 m/s^2 upwards at rest",
        )
    if not 1 / _WITHIN < size / STANDARD_GRAVITY_M_S2 < _WITHIN:
        raise InputError(
            f"the sensor reads {size:.4g} at rest, which is not gravity in any known unit",
            where=where,
            todo="check the sensor's scale: it should read 9.81 m/s^2 upwards at rest",
        )


@dataclass(frozen=True)
class Clipping:
    """Describes one axis of a sensor that is clipped at a limit of its range.

    axis : 0, 1 or 2.
    value : the limit (m/s^2).
    count, first : number of clipped samples, and index of the first one.
    """

    axis: int
    value: float
    count: int
    first: int


def clippings(reading: ArrayLike) -> list[Clipping]:
    """Return the limits at which samples (N, 3) are clipped.

    The smallest or largest value of an axis counts as a limit if it occurs at least 5 times, and at
    least 3 times as often as the next value.
    """
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


def check_axes(reading_m_s2: ArrayLike, axes: ArrayLike, up: ArrayLike, *, where: str) -> list[str]:
    """Return a warning if gravity does not point up with the stated mounting, and axes that would
    fit.

    reading_m_s2 : (N, 3).
    axes : (3, 3) whose rows are the sensor's axes in rig coordinates.
    up : (3,) upward direction in rig axes.
    """
    gravity = gravity_of(reading_m_s2)
    angle = _tilt_deg(gravity, axes, up)
    if angle < _TILTED_DEG:
        return []
    words = f"{where}: with its axes in rig.toml, gravity points {angle:.0f} deg away from up; "
    fits = fitting_axes(gravity, axes, up)
    if fits is None:
        direction = ", ".join(f"{v:.2f}" for v in gravity / np.linalg.norm(gravity))
        return [f"{words}no exchange of axes fits: up is ({direction}) in the sensor's axes"]
    rows = ", ".join("[" + ", ".join(f"{v:.4g}" for v in row + 0.0) + "]" for row in fits)
    return [f"{words}axes = [{rows}] would fit (or these axes rotated about the vertical)"]


def fitting_axes(gravity: ArrayLike, axes: ArrayLike, up: ArrayLike) -> Array | None:
    """Return the given axes with rows exchanged or reversed such that gravity points up.

    Of the 24 right-handed exchanges, the one that changes the entries least is returned, as (3, 3).
    None is returned if no exchange brings gravity within 15 degrees of up. A rotation about the
    vertical remains undetermined.
    """
    from scipy.spatial.transform import Rotation

    given = np.asarray(axes, float)
    turned = [np.rint(turn) @ given for turn in Rotation.create_group("O").as_matrix()]
    fits = [a for a in turned if _tilt_deg(gravity, a, up) <= _FITS_DEG]
    return min(
        fits,
        key=lambda a: (float(np.abs(a - given).sum()), _tilt_deg(gravity, a, up)),
        default=None,
    )


def _tilt_deg(gravity: ArrayLike, axes: ArrayLike, up: ArrayLike) -> float:
    """Return the angle between the measured gravity, rotated into the rig by ``axes``, and up."""
    force, upwards = np.asarray(axes, float).T @ np.asarray(gravity, float), np.asarray(up, float)
    across = np.linalg.norm(np.cross(force, upwards))
    return float(np.degrees(np.arctan2(across, force @ upwards)))


def check_motion(
    t_s: Array, reading: Array, stage: Array, along: Array, *, where: str
) -> list[str]:
    """Return a warning if the carriage's acceleration appears on another axis of the sensor than
    stated.

    t_s, reading : (N,) times and (N, 3) readings.
    stage : (E, 2) times (s) and positions (mm) of the encoder.
    along : (3,) travel axis in the sensor's axes.
    """
    found = motion_correlation(t_s, reading, stage[:, 0], stage[:, 1]) if len(t_s) > 1 else None
    if found is None:
        return []
    stated, best = float(found @ along), int(np.argmax(np.abs(found)))
    clear = abs(found[best]) > _CLEAR and stated < abs(found[best]) / 2
    if not (stated < -_CLEAR or clear):
        return []
    sign = "-" if found[best] < 0 else "+"
    return [
        f"{where}: the carriage's acceleration is felt along {sign}{'xyz'[best]} of the sensor "
        f"(correlation {abs(found[best]):.2f}), not where its axes in rig.toml put the travel "
        f"direction (correlation {stated:.2f}): check axes"
    ]


def motion_correlation(
    t_s: ArrayLike, reading: ArrayLike, stage_t_s: ArrayLike, position_mm: ArrayLike
) -> Array | None:
    """Return the correlation (3,) of each sensor axis with the carriage's acceleration.

    Both are smoothed over 30 ms. None is returned if the records overlap by less than 0.3 s, or if
    the carriage does not accelerate.

    t_s, reading : (N,) times and (N, 3) readings of the accelerometer.
    stage_t_s, position_mm : (E,) times and positions of the encoder.
    """
    from scipy.signal import savgol_coeffs

    t, stage_t = np.asarray(t_s, float), np.asarray(stage_t_s, float)
    low, high = max(t[0], stage_t[0]), min(t[-1], stage_t[-1])
    step = _SMOOTHED_S / 6
    if high - low < 10 * _SMOOTHED_S:
        return None
    grid = np.arange(low, high, step)
    place = _averaged(stage_t, np.asarray(position_mm, float), grid, step)
    sensed = np.stack([_averaged(t, a, grid, step) for a in np.asarray(reading, float).T], -1)
    acceleration = np.convolve(place, savgol_coeffs(13, 3, deriv=2, delta=step), "valid")
    window = np.hanning(15)[1:-1] / np.hanning(15)[1:-1].sum()
    smooth = np.stack([np.convolve(a, window, "valid") for a in sensed.T], -1)
    acceleration, smooth = acceleration - acceleration.mean(), smooth - smooth.mean(0)
    size = np.sqrt((acceleration**2).sum() * (smooth**2).sum(0))
    if not np.all(size > 0):
        return None
    return np.asarray(smooth.T @ acceleration / size)


def _averaged(t: Array, values: Array, grid: Array, step: float) -> Array:
    """Return the mean of a piecewise linear signal over one grid step about each grid time."""
    integral = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(t))])
    ends = [np.interp(grid + s * step / 2, t, integral) for s in (-1, 1)]
    width = np.clip(grid + step / 2, t[0], t[-1]) - np.clip(grid - step / 2, t[0], t[-1])
    return np.asarray((ends[1] - ends[0]) / width)
