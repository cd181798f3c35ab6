"""What gravity shows in an accelerometer's record: a wrong unit, removed gravity, wrong axes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Bools
from telerig.estimator.sensors.findings import Code, Finding
from telerig.estimator.sensors.given import UNIT_WITHIN, Sensor, unit_of_gravity
from telerig.rig.units import ACCELERATION_UNITS, STANDARD_GRAVITY_M_S2

_FLOATING_M_S2 = 0.6
_DOUBLED = (1.8, 2.2)
_SEEN = 0.3
"""Share of gravity along an axis from which on it matters that the axis does not show it."""
_PARTS, _CLEAR_SIGMAS = 8, 4.0
"""A record determines gravity to 4 times the standard error that the means of 8 parts give."""

_TILTED_DEG = 20.0
"""Axes with which gravity points farther away from up are wrong."""


@dataclass(frozen=True)
class Gravity:
    """What a sensor reads at rest.

    at_rest : (3,) mean reading: gravity plus bias, up to the change of velocity over the record. A
        median is not: a pump whose harmonic is strong moves it by several m/s^2.
    off : how far it can be off.
    """

    at_rest: Array
    off: float = 0.0

    @staticmethod
    def of(readings: Array) -> Gravity:
        """Return what readings (N, 3) show."""
        parts = np.array([p.mean(axis=0) for p in np.array_split(readings, _PARTS) if len(p)])
        spread = np.linalg.norm(parts.std(axis=0, ddof=1)) if len(parts) > 1 else np.inf
        off = float(_CLEAR_SIGMAS * spread / np.sqrt(len(parts)))
        return Gravity(np.asarray(readings.mean(axis=0)), off)

    @property
    def size(self) -> float:
        """The size of the mean reading."""
        return float(np.linalg.norm(self.at_rest))

    def tilt_deg(self, axes: Array, up: Array) -> Array:
        """Return how far gravity points away from up (3,), with each of many axes (..., 3, 3)."""
        force = np.swapaxes(axes, -1, -2) @ self.at_rest
        across = np.linalg.norm(np.cross(force, up), axis=-1)
        return np.asarray(np.degrees(np.arctan2(across, force @ up)))

    def allows(self, axes: Array, up: Array) -> Bools:
        """Return whether gravity may point up with each of many axes (..., 3, 3)."""
        open_deg = np.degrees(np.arctan2(self.off, self.size))
        return np.asarray(self.tilt_deg(axes, up) - open_deg < _TILTED_DEG)


def check_accelerometer(sensor: Sensor, up: ArrayLike, gravity_m_s2: float) -> list[Finding]:
    """Return what is wrong with unit, gravity and axes of one sensor.

    up : (3,) unit vector against gravity in rig axes. gravity_m_s2 : of the laboratory. Nothing can
    be said if gravity acts along an axis that never changes and is therefore not used.
    """
    still = [i for i in sensor.unused_axes if np.ptp(sensor.reading_m_s2[:, i]) == 0]
    if np.any(np.abs(sensor.axes[still] @ np.asarray(up, float)) > _SEEN):
        return []
    gravity, upwards = Gravity.of(sensor.reading_m_s2), np.asarray(up, float)
    return _check_size(sensor, gravity, upwards, gravity_m_s2) or _check_axes(
        sensor, gravity, upwards
    )


def _check_size(sensor: Sensor, gravity: Gravity, up: Array, gravity_m_s2: float) -> list[Finding]:
    """Return a finding if the size of the mean reading is not gravity."""
    where, name = sensor.where, sensor.name
    stated = ACCELERATION_UNITS[sensor.unit]
    size, ratio = gravity.size / stated, gravity.size / STANDARD_GRAVITY_M_S2
    off = gravity.off / STANDARD_GRAVITY_M_S2
    if 1 / UNIT_WITHIN - off < ratio < UNIT_WITHIN + off:
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


def _check_axes(sensor: Sensor, gravity: Gravity, up: Array) -> list[Finding]:
    """Return a finding, with axes that would fit, if the sensor's gravity does not point up."""
    if gravity.allows(sensor.axes, up):
        return []
    angle = float(gravity.tilt_deg(sensor.axes, up))
    words = f"with its axes as stated, gravity points {angle:.0f} deg away from up"
    fits = fitting_axes(gravity, sensor.axes, up)
    if fits is None:
        direction = ", ".join(f"{v:.2f}" for v in gravity.at_rest / gravity.size)
        todo = f"no exchange of axes fits: up is ({direction}) in the sensor's axes; correct axes"
        return [Finding(words, sensor.where, todo, Code.SENSOR_AXES, {"sensor": sensor.name})]
    todo, fix = axes_remedy(sensor.name, fits)
    todo += " (or these axes rotated about the vertical)"
    return [Finding(words, sensor.where, todo, Code.SENSOR_AXES, fix)]


def fitting_axes(gravity: Gravity, axes: Array, up: Array) -> Array | None:
    """Return the given axes (3, 3) with rows exchanged or reversed such that gravity points up.

    Of the 24 right-handed exchanges, the one that changes the entries least is returned; None if no
    exchange brings gravity near up (3,). A rotation about the vertical remains undetermined.
    """
    turns = signed_permutations()
    turned = turns[np.linalg.det(turns) > 0] @ axes
    tilt = gravity.tilt_deg(turned, up)
    change = np.abs(turned - axes).sum((1, 2))
    best = np.lexsort((tilt, np.where(tilt < _TILTED_DEG, change, np.inf)))[0]
    return np.asarray(turned[best]) if tilt[best] < _TILTED_DEG else None


def signed_permutations() -> Array:
    """Return all signed permutations of three axes (48, 3, 3), the identity first."""
    out = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return np.array(out)


def axes_remedy(name: str, axes: Array) -> tuple[str, dict[str, Any]]:
    """Return what to do about a sensor's wrong axes, in words and as a fix: others (3, 3)."""
    rows = np.round(axes, 6) + 0.0
    line = ", ".join("[" + ", ".join(f"{v:.4g}" for v in row) + "]" for row in rows)
    words = f"axes = [{line}] in rig.toml [accelerometers.{name}] would fit"
    return words, {"sensor": name, "axes": rows.tolist()}
