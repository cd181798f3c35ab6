"""Checks an accelerometer's record for a wrong unit, removed gravity and wrong axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.estimator.sensors.accelerations import Grid, of_positions, of_readings
from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.sensors.given import Sensor, unit_of_gravity
from telerig.rig.units import ACCELERATION_UNITS, STANDARD_GRAVITY_M_S2

_FLOATING_M_S2 = 0.6
_DOUBLED = (1.8, 2.2)
_SEEN = 0.3
"""Share of gravity along an axis from which on it matters that the axis does not show it."""
_FIT = 1.5
_PARTS, _CLEAR_SIGMAS = 8, 4.0
"""A record determines gravity to 4 times the standard error that the means of 8 parts give."""

_TILTED_DEG = 20.0
_FITS_DEG = 15.0
_CLEAR, _CHANCE_SIGMAS, _INDEPENDENT_S = 0.6, 3.5, 0.025
"""A correlation counts if it is above 0.6 and above 3.5 times that of independent signals, whose
values 25 ms apart are independent."""

_STEP_S, _KNOTS, _LEAST_OVERLAP_S = 0.005, 5, 0.3


def check_accelerometer(sensor: Sensor, up: ArrayLike, gravity_m_s2: float) -> list[Finding]:
    """Return what is wrong with unit, gravity and axes of one sensor.

    up : (3,) unit vector against gravity in rig axes. gravity_m_s2 : of the laboratory. Nothing can
    be said if gravity acts along an axis that never changes and is therefore not used.
    """
    still = [i for i in sensor.unused_axes if np.ptp(sensor.reading_m_s2[:, i]) == 0]
    if np.any(np.abs(sensor.axes[still] @ np.asarray(up, float)) > _SEEN):
        return []
    return _check_gravity(sensor, np.asarray(up, float), gravity_m_s2) or check_axes(sensor, up)


def gravity_of(reading: ArrayLike) -> tuple[Array, float]:
    """Return the mean (3,) of readings (N, 3), and how far off it can be.

    The mean is gravity plus bias, up to the change of velocity over the record. A median is not: a
    pump whose harmonic is strong moves it by several m/s^2.
    """
    readings = np.asarray(reading, float)
    parts = np.array([p.mean(axis=0) for p in np.array_split(readings, _PARTS) if len(p)])
    spread = np.linalg.norm(parts.std(axis=0, ddof=1)) if len(parts) > 1 else np.inf
    return readings.mean(axis=0), float(_CLEAR_SIGMAS * spread / np.sqrt(len(parts)))


def _check_gravity(sensor: Sensor, up: Array, gravity_m_s2: float) -> list[Finding]:
    """Return a finding if the size of the mean reading is not gravity."""
    where, name = sensor.where, sensor.name
    stated = ACCELERATION_UNITS[sensor.unit]
    gravity, off = gravity_of(sensor.reading_m_s2)
    size = float(np.linalg.norm(gravity)) / stated
    ratio, off = size * stated / STANDARD_GRAVITY_M_S2, off / STANDARD_GRAVITY_M_S2
    if 1 / _FIT - off < ratio < _FIT + off:
        return []
    at_rest = f"{STANDARD_GRAVITY_M_S2 / stated:.3g}"
    unit = unit_of_gravity(size)
    if unit is not None:
        factor = ACCELERATION_UNITS[unit] / stated
        either = "mg or cm/s^2" if unit == "mg" else unit
        return [
            Finding(
                f"the sensor reads {size:.4g} at rest; in {sensor.unit} it would be {at_rest}. The "
                f"readings are in {either}",
                where,
                f'give "unit": "{unit}", or multiply its readings (ax_m_s2, ay_m_s2, az_m_s2) by '
                f"{factor:.6g}",
                Code.SENSOR_UNIT, {"sensor": name, "unit": unit},
            )
        ]  # fmt: skip
    upwards = gravity_m_s2 * sensor.axes @ up
    shown = ", ".join(f"{v:.3f}" for v in upwards + 0.0)
    if ratio * STANDARD_GRAVITY_M_S2 < _FLOATING_M_S2:
        return [
            Finding(
                f"the sensor reads {size * stated:.2g} m/s^2 at rest: gravity has been subtracted",
                where,
                "give the specific force as the sensor measures it, 9.81 m/s^2 upwards at rest; "
                f"with its axes in rig.toml, add ({shown}) m/s^2 to its readings",
                Code.SENSOR_GRAVITY, {"sensor": name, "add_m_s2": upwards.tolist()},
            )
        ]  # fmt: skip
    doubled = _DOUBLED[0] < ratio < _DOUBLED[1]
    what = "gravity is contained twice" if doubled else "which is not gravity in any known unit"
    return [
        Finding(
            f"the sensor reads {size:.4g} {sensor.unit} at rest: {what}",
            where,
            f"subtract ({shown}) m/s^2 from its readings"
            if doubled
            else "check the sensor's scale: it should read 9.81 m/s^2 upwards at rest",
            Code.SENSOR_GRAVITY if doubled else Code.SENSOR_SCALE,
            {"sensor": name, "add_m_s2": (-upwards).tolist()} if doubled else {},
        )
    ]


def check_axes(sensor: Sensor, up: ArrayLike) -> list[Finding]:
    """Return a finding if the sensor's gravity does not point along ``up``.

    The finding contains axes that would fit. up : (3,) unit vector against gravity in rig axes.
    """
    (gravity, off), axes = gravity_of(sensor.reading_m_s2), sensor.axes
    angle = _tilt_deg(gravity, axes, up)
    if angle - np.degrees(np.arctan2(off, np.linalg.norm(gravity))) < _TILTED_DEG:
        return []
    words = f"with its axes as stated, gravity points {angle:.0f} deg away from up"
    fits = fitting_axes(gravity, axes, up)
    if fits is None:
        direction = ", ".join(f"{v:.2f}" for v in gravity / np.linalg.norm(gravity))
        todo = f"no exchange of axes fits: up is ({direction}) in the sensor's axes; correct axes"
        return [Finding(words, sensor.where, todo, Code.SENSOR_AXES, {"sensor": sensor.name})]
    rows = ", ".join("[" + ", ".join(f"{v:.4g}" for v in row + 0.0) + "]" for row in fits)
    return [
        Finding(
            words, sensor.where,
            f"axes = [{rows}] in rig.toml [accelerometers.{sensor.name}] would fit (or these axes "
            "rotated about the vertical)",
            Code.SENSOR_AXES, {"sensor": sensor.name, "axes": (fits + 0.0).tolist()},
        )
    ]  # fmt: skip


def fitting_axes(gravity: ArrayLike, axes: ArrayLike, up: ArrayLike) -> Array | None:
    """Return the given axes (3, 3) with rows exchanged or reversed such that gravity points up.

    Of the 24 right-handed exchanges, the one that changes the entries least is returned; None if no
    exchange brings gravity within 15 degrees of up. A rotation about the vertical remains
    undetermined.

    gravity : (3,) reading at rest.
    axes : (3, 3) stated axes.
    up : (3,) as in `check_axes`.
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


def check_motion(sensor: Sensor, stage: Array, along: Array) -> list[Finding]:
    """Return a warning if the carriage's acceleration appears on another axis than stated.

    stage : (E, 2) times (s) and positions (mm). along : (3,) travel axis in the sensor's axes.
    """
    found = motion_correlation(sensor.t_s, sensor.reading_m_s2, stage[:, 0], stage[:, 1])
    if found is None:
        return []
    stated, best = float(found @ along), int(np.argmax(np.abs(found)))
    length = min(sensor.t_s[-1], stage[-1, 0]) - max(sensor.t_s[0], stage[0, 0])
    bound = max(_CLEAR, _CHANCE_SIGMAS * np.sqrt(_INDEPENDENT_S / length))
    clear = abs(found[best]) > bound and stated < abs(found[best]) / 2
    if not (stated < -bound or clear):
        return []
    sign = "-" if found[best] < 0 else "+"
    return [
        Finding(
            f"the carriage's acceleration appears along {sign}{'xyz'[best]} of the sensor "
            f"(correlation {abs(found[best]):.2f}) and not along the direction of travel that "
            f"follows from its stated axes (correlation {stated:.2f})",
            sensor.where,
            f"check axes in rig.toml [accelerometers.{sensor.name}]",
        )
    ]


def motion_correlation(
    t_s: ArrayLike, reading: ArrayLike, stage_t_s: ArrayLike, position_mm: ArrayLike
) -> Array | None:
    """Return the correlation (3,) of each sensor axis with the carriage's acceleration, or None.

    t_s, reading : (N,), (N, 3) of the sensor. stage_t_s, position_mm : (E,) of the encoder. Returns
    None if the records overlap by less than 0.3 s, or if the carriage does not accelerate.
    """
    t, stage_t = np.asarray(t_s, float), np.asarray(stage_t_s, float)
    low, high = max(t[0], stage_t[0]), min(t[-1], stage_t[-1])
    if high - low < _LEAST_OVERLAP_S:
        return None
    grid = Grid(float(low), _STEP_S, int((high - low) / _STEP_S) + 1, _KNOTS)
    carriage = of_positions(grid, stage_t, np.asarray(position_mm, float)[:, None])
    sensed, there = of_readings(grid, t, reading).at(grid.t_s)
    known = there & carriage.known
    if not known.any():
        return None
    acceleration, sensed = carriage.values[known, 0], sensed[known]
    acceleration, sensed = acceleration - acceleration.mean(), sensed - sensed.mean(0)
    size = np.sqrt((acceleration**2).sum() * (sensed**2).sum(0))
    return np.asarray(sensed.T @ acceleration / size) if np.all(size > 0) else None
