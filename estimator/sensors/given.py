"""Reads what a user gives as sensors: arrays and tables of any shape, refused where they are not
what they should be.

The keys of a sensor's record are those of `AccelerometerRecord`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypedDict, get_args, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array, Bools
from telerig.errors import InputError, nearest, suggestion
from telerig.estimator.sensors.findings import Code, Finding
from telerig.rig.units import ACCELERATION_UNITS, STANDARD_GRAVITY_M_S2
from telerig.short_text import counted

if TYPE_CHECKING:
    import pandas as pd

CARRIAGE = "carriage"
"""`mounted_on` of a sensor that sits on the stage itself."""

Clock = Literal["frames", "unknown"]

_PLANE = 0.1
_MOST_UNORDERED = 0.05
UNIT_WITHIN = 1.5
"""A reading at rest may be so many times gravity, or a share of it: bias, and acceleration."""

_SHOWN_TYPE = 60


class AccelerometerRecord(TypedDict, total=False):
    """One accelerometer and its N samples, for `telerig.smooth`.

    t_s : (N,) times of the samples in s, which increase.
    a_m_s2 : (N, 3) readings in m/s^2 along the sensor's own axes x, y, z. They contain gravity: a
        sensor at rest reads +9.81 m/s^2 along the axis that points upwards.
    a, unit : in place of ``a_m_s2``, readings (N, 3) in "m/s^2", "g", "mg", "mm/s^2", "cm/s^2" or
        "ft/s^2". Without a unit it follows from the size of gravity, with a warning.
    mounted_on : name of the camera whose arm carries the sensor, or "carriage" for the stage.
    axes : (3, 3) whose rows are the sensor's x, y, z axes in rig coordinates.
    noise_density_ug_sqrt_hz : of the data sheet, in micro-g per root hertz; otherwise it is
        estimated from the record, with a warning.
    bias_sigma_m_s2 : of the constant error of each axis; 0.2 if missing.
    range_m_s2 : largest reading; samples that reach it are not used. Without it, limits at which
        readings are clipped are looked for.
    clock : "frames" if ``t_s`` is the time of the frames, apart from a small delay; "unknown" (the
        default) for a logger of its own, whose offset has to be found from the images.

    What rig.toml states about a sensor of this name is used where a key is missing; ``t_s`` and the
    readings are always needed.
    """

    t_s: ArrayLike
    a_m_s2: ArrayLike
    a: ArrayLike
    unit: str
    mounted_on: str
    axes: ArrayLike
    noise_density_ug_sqrt_hz: float
    bias_sigma_m_s2: float
    range_m_s2: float
    clock: Clock


KEYS = list(get_type_hints(AccelerometerRecord))
_EXAMPLE = (
    '{"name": {"t_s": t, "a": readings, "unit": "g", "mounted_on": "left", "axes": [[1, 0, 0], '
    "[0, 1, 0], [0, 0, 1]]}}"
)
_DESCRIBED = (
    "mounted_on", "axes", "noise_density_ug_sqrt_hz", "bias_sigma_m_s2", "range_m_s2", "clock"
)  # fmt: skip


@dataclass(frozen=True)
class Sensor:
    """The record of one accelerometer as it was given.

    where : file or argument, and sensor, for messages.
    t_s : (N,) times of the N samples.
    reading_m_s2 : (N, 3).
    unit : unit in which the readings were given.
    mounted_on : a camera's name, or "carriage".
    axes : (3, 3) whose rows are the sensor's axes as unit vectors in rig axes.
    noise_density_ug_sqrt_hz, range_m_s2 : None if they are not stated.
    kept : (N,) whether each sample can be used.
    unused_axes : indices of axes that are not used.
    """

    name: str
    where: str
    t_s: Array
    reading_m_s2: Array
    unit: str
    mounted_on: str
    axes: Array
    noise_density_ug_sqrt_hz: float | None
    bias_sigma_m_s2: float
    range_m_s2: float | None
    clock: Clock
    kept: Bools
    unused_axes: tuple[int, ...] = ()


def given_sensors(
    given: Any, rig: Any, cameras: Sequence[str], *, file: str = ""
) -> tuple[list[Sensor], list[Finding]]:
    """Return the accelerometers of a table or of a mapping, and what was assumed about them.

    given : columns of accelerometer.csv, or an `AccelerometerRecord` by sensor. file : of the
    table, for messages, or "". Raises InputError for everything that is not as described.
    """
    if given is None:
        return [], []
    described = {} if rig is None else dict(rig.accelerometers)
    sources = _split(given, file) if hasattr(given, "columns") else _named(given)
    clock: Clock = "frames" if hasattr(given, "columns") else "unknown"
    sensors, findings = [], []
    for name, source in sources.items():
        where = f"{file}, sensor {name}" if file else f"accelerometer {name}"
        if name not in described and described and "mounted_on" not in source:
            raise InputError(
                f"there is no accelerometer {name!r} in rig.toml",
                where=file or where,
                todo=suggestion(name, list(described)),
            )
        sensor, found = _sensor(name, source, described.get(name), cameras, where, clock)
        sensors.append(sensor)
        findings += found
    return sensors, findings


def _named(given: Any) -> dict[str, Mapping[str, Any]]:
    """Return the records of a mapping by the sensor's name."""
    where = "accelerometers"
    if not isinstance(given, Mapping):
        raise InputError(
            f"is {_kind(given)}, neither a mapping nor a table",
            where=where,
            todo=f"give {_EXAMPLE}, or a table with the columns of accelerometer.csv",
        )
    if "t_s" in given or "a_m_s2" in given:
        raise InputError("the record has no name", where=where, todo=f"give {_EXAMPLE}")
    for name, record in given.items():
        if not isinstance(name, str) or not name:
            raise InputError(f"the name {name!r} is no text", where=where, todo="name the sensor")
        if hasattr(record, "columns") or not isinstance(record, Mapping):
            raise InputError(
                f"is {_kind(record)}, not a mapping",
                where=f"accelerometer {name}",
                todo=f"give its columns: {_EXAMPLE}",
            )
    return dict(given)


def _split(table: pd.DataFrame, file: str) -> dict[str, dict[str, Any]]:
    """Return the records of a table by the sensor's name."""
    where = file or "accelerometers"
    unit = next((u for u, names in _COLUMNS.items() if names[0] in table), "m/s^2")
    columns = _COLUMNS[unit]
    missing = [c for c in ("t_s", "sensor", *columns) if c not in table]
    if missing:
        raise InputError(
            f"the table has no column {', '.join(missing)}",
            where=where,
            todo="its columns are t_s,sensor,ax_m_s2,ay_m_s2,az_m_s2 (or ax_g, ax_mg)",
        )
    for column in ("t_s", *columns):
        numbers(table[column], where, column)
    if table["sensor"].isna().any():
        row = int(np.flatnonzero(table["sensor"].isna())[0])
        raise InputError(f"row {row} names no sensor", where=where, todo="fill column sensor")
    return {
        str(name): {"t_s": rows["t_s"], "a": rows[list(columns)], "unit": unit}
        for name, rows in table.groupby("sensor", sort=False)
    }


_COLUMNS = {
    unit: tuple(f"a{axis}_{end}" for axis in "xyz")
    for unit, end in (("m/s^2", "m_s2"), ("g", "g"), ("mg", "mg"))
}


def _sensor(
    name: str,
    source: Mapping[str, Any],
    described: Any,
    cameras: Sequence[str],
    where: str,
    clock: Clock,
) -> tuple[Sensor, list[Finding]]:
    """Return one sensor, and what was assumed about it. Raises InputError."""
    known_keys(source, KEYS, where)
    of_rig = {} if described is None else {key: getattr(described, key) for key in _DESCRIBED}
    fields = {key: value for key, value in of_rig.items() if value is not None}
    fields |= {key: source[key] for key in _DESCRIBED if source.get(key) is not None}
    missing = [key for key in ("mounted_on", "axes") if key not in fields]
    if missing:
        raise InputError(
            f"the description of the accelerometer lacks {' and '.join(missing)}",
            where=where,
            todo=f"state {' and '.join(missing)} with the readings, or under "
            f"[accelerometers.{name}] in rig.toml",
        )
    t, reading, unit, found = _samples(source, where)
    t, reading, unordered = _in_order(t, reading, where)
    clock = fields.get("clock", clock)
    if clock not in get_args(Clock):
        raise InputError(f"clock is {clock!r}", where=where, todo='give "frames" or "unknown"')
    sensor = Sensor(
        name, where, t, reading, unit,
        _mount(fields["mounted_on"], cameras, where), _axes(fields["axes"], where),
        _positive(fields, "noise_density_ug_sqrt_hz", where),
        _positive(fields, "bias_sigma_m_s2", where) or 0.2,
        _positive(fields, "range_m_s2", where), clock, np.ones(len(t), bool),
    )  # fmt: skip
    return sensor, found + unordered


def _samples(source: Mapping[str, Any], where: str) -> tuple[Array, Array, str, list[Finding]]:
    """Return times (N,), readings (N, 3) in m/s^2, their unit, and what was assumed."""
    given = [key for key in ("a_m_s2", "a") if source.get(key) is not None]
    if len(given) != 1 or source.get("t_s") is None:
        raise InputError(
            "gives both a and a_m_s2" if len(given) == 2 else "has no t_s, or no readings a_m_s2",
            where=where,
            todo="give t_s (N,), and the readings (N, 3) once: a_m_s2, or a with a unit",
        )
    t = times(source["t_s"], where)
    reading = numbers(source[given[0]], where, given[0])
    if reading.shape != (len(t), 3):
        raise InputError(
            f"{given[0]} has the shape {reading.shape}, t_s has {len(t)} times",
            where=where,
            todo="transpose the readings: give rows of x, y, z"
            if reading.shape == (3, len(t))
            else f"give ({len(t)}, 3): a row of x, y, z for each time",
        )
    if len(t) < 2:
        raise InputError(
            f"has {counted(len(t), 'sample')}",
            where=where,
            todo="give at least two, or leave the sensor out",
        )
    finite = np.isfinite(reading).all(1)
    if not finite.all():
        raise InputError(
            f"{np.count_nonzero(~finite)} readings are not finite, the first is sample "
            f"{int(np.flatnonzero(~finite)[0])}",
            where=where,
            todo="leave those samples out",
        )
    unit = source.get("unit")
    found: list[Finding] = []
    if given[0] == "a_m_s2":
        if unit not in (None, "m/s^2"):
            raise InputError(
                f"a_m_s2 is in m/s^2, but unit is {unit!r}",
                where=where,
                todo=f'give the readings as "a" with "unit": {unit!r}',
            )
        unit = "m/s^2"
    if unit is None:
        unit, found = _inferred(reading, where)
    if unit not in ACCELERATION_UNITS:
        todo = _one_of(str(unit), list(ACCELERATION_UNITS))
        raise InputError(f"unit is {unit!r}", where=where, todo=todo)
    return t, reading * ACCELERATION_UNITS[unit], unit, found


def _inferred(reading: Array, where: str) -> tuple[str, list[Finding]]:
    """Return the unit in which gravity has its size, and a warning that says so."""
    size = float(np.linalg.norm(np.median(reading, axis=0)))
    unit = unit_of_gravity(size)
    words = f"no unit is given; the sensor reads {size:.4g} at rest"
    if unit is None:
        return "m/s^2", [
            Finding(
                f"{words}, which is not gravity in any known unit", where,
                f'give "unit": one of {", ".join(ACCELERATION_UNITS)}', Code.SENSOR_UNIT,
            )
        ]  # fmt: skip
    todo = f'give "unit": "{unit}"'
    return unit, [Finding(f"{words}, so it is taken to be in {unit}", where, todo)]


def unit_of_gravity(size: float) -> str | None:
    """Return the unit in which a reading of this size at rest would be gravity; None for no unit.

    The size may be wrong by a factor of 1.5, for example because of a strong acceleration. mg and
    cm/s^2 differ by only 2 %, less than a usual bias; mg is then returned.
    """
    for unit in ("m/s^2", "g", "mm/s^2", "mg", "ft/s^2"):
        ratio = size * ACCELERATION_UNITS[unit] / STANDARD_GRAVITY_M_S2
        if 1 / UNIT_WITHIN < ratio < UNIT_WITHIN:
            return unit
    return None


def _in_order(t: Array, reading: Array, where: str) -> tuple[Array, Array, list[Finding]]:
    """Return samples without a few whose times go back, and a warning; InputError for many."""
    kept = longest_increase(t)
    lost = np.flatnonzero(~kept)
    if not len(lost):
        return t, reading, []
    bad = np.flatnonzero(~(np.diff(t) > 0)) + 1
    if len(lost) > max(_MOST_UNORDERED * len(t), 1):
        repeated = np.count_nonzero(np.diff(t) == 0)
        raise InputError(
            f"times do not increase at sample {int(bad[0])} ({t[bad[0] - 1]:.9g} s, then "
            f"{t[bad[0]]:.9g} s), and in {len(bad)} places",
            where=where,
            todo="its clock is coarser than its rate: give t_s = start + sample / rate"
            if repeated > len(bad) / 2
            else "sort the samples by time and keep one sample for each time",
        )
    words = (
        f"{len(lost)} of {len(t)} samples have a time that is repeated or goes back and are not "
        f"used, the first at {t[lost[0]]:.6g} s (sample {int(lost[0])})"
    )
    return t[kept], reading[kept], [Finding(words, where)]


def longest_increase(t: Array) -> Bools:
    """Return which of N times (N,) form the longest sequence that increases strictly."""
    from bisect import bisect_left

    if np.all(np.diff(t) > 0):
        return np.ones(len(t), bool)
    ends: list[float] = []
    last: list[int] = []
    before = np.full(len(t), -1)
    for i, value in enumerate(t.tolist()):
        at = bisect_left(ends, value)
        before[i] = last[at - 1] if at else -1
        if at == len(ends):
            ends.append(value)
            last.append(i)
        else:
            ends[at], last[at] = value, i
    kept, i = np.zeros(len(t), bool), last[-1]
    while i >= 0:
        kept[i] = True
        i = int(before[i])
    return kept


def _mount(mounted_on: Any, cameras: Sequence[str], where: str) -> str:
    if mounted_on != CARRIAGE and mounted_on not in cameras:
        mounts = [*cameras, CARRIAGE]
        raise InputError(
            f"is mounted on {mounted_on!r}, which is no camera",
            where=where,
            todo=_one_of(str(mounted_on), mounts),
        )
    return str(mounted_on)


def _axes(axes: Any, where: str) -> Array:
    rows = numbers(axes, where, "axes")
    todo = "give the sensor's x, y, z axes as rows in rig coordinates, [[1, 0, 0], ...]"
    if rows.shape != (3, 3):
        raise InputError(f"axes have the shape {rows.shape}, not (3, 3)", where=where, todo=todo)
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    if not np.isfinite(rows).all() or np.any(length == 0):
        raise InputError("axes has a row that is no direction", where=where, todo=todo)
    rows = rows / length
    if abs(np.linalg.det(rows)) < _PLANE:
        raise InputError("the three rows of axes lie (nearly) in one plane", where=where, todo=todo)
    return np.asarray(rows)


def _positive(fields: Mapping[str, Any], key: str, where: str) -> float | None:
    value = fields.get(key)
    if value is None:
        return None
    number = numbers(value, where, key)
    if number.ndim or not np.isfinite(number) or number <= 0:
        raise InputError(
            f"{key} is {value!r}", where=where, todo="give one positive number, without a unit"
        )
    return float(number)


def numbers(values: Any, where: str, key: str) -> Array:
    """Return values as an array of floats, with NaN for masked entries.

    where, key : for messages. Raises InputError for values that are no numbers.
    """
    dtype = getattr(values, "dtype", None)
    if not isinstance(dtype, np.dtype | None) and getattr(dtype, "kind", "") in "iuf":
        # a column of pandas' own types of numbers
        values = values.to_numpy(dtype=float, na_value=np.nan)
    try:
        array = np.ma.asanyarray(values) if np.ma.isMaskedArray(values) else np.asarray(values)
    except ValueError:
        raise InputError(
            f"{key} has rows of different lengths", where=where, todo="give rows of equal length"
        ) from None
    kind = array.dtype.kind
    if kind in "iuf":
        return np.asarray(np.ma.filled(array.astype(float), np.nan), np.float64)
    todo = "give numbers, in the unit that the key names"
    if kind in "mM":
        todo = "give seconds as numbers, like (t - t[0]) / numpy.timedelta64(1, 's')"
    elif kind == "O":
        todo = "give an array of numbers: numpy.asarray(values, float)"
    raise InputError(f"{key} is {_kind(values)}, not numbers", where=where, todo=todo)


def _kind(value: Any) -> str:
    """Return what a value is, in words."""
    if isinstance(value, str | bytes):
        return f"the text {str(value)[:_SHOWN_TYPE]!r}"
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    dtype, shape = getattr(value, "dtype", None), getattr(value, "shape", None)
    name = type(value).__name__
    return name if dtype is None else f"{name} of {dtype}, shape {tuple(shape or ())}"


def times(values: Any, where: str, key: str = "t_s") -> Array:
    """Return times (N,) in s. Raises InputError for other shapes and values that are not finite."""
    t = numbers(values, where, key)
    if t.ndim != 1:
        raise InputError(
            f"{key} has the shape {t.shape}", where=where, todo="give one list of times in s"
        )
    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        raise InputError(
            f"{key} is not finite at row {int(bad[0])}", where=where, todo="leave that row out"
        )
    return t


def known_keys(source: Iterable[Any], known: Sequence[str], where: str) -> None:
    """Raise InputError, with the nearest known key, for a key that is not known."""
    for key in source:
        if key not in known:
            raise InputError(
                f"unknown key {key!r}",
                where=where,
                todo=_one_of(str(key), known),
            )


def _one_of(word: str, known: Sequence[str]) -> str:
    """Return the advice for an unknown word: the most similar known word, and all others."""
    near = nearest(word, list(known))
    every = f"give one of {', '.join(known)}"
    return every if near is None else f"did you mean {near}? {every}"


def table_columns(table: Any, names: Sequence[str], where: str, *, what: str) -> list[Array]:
    """Return columns of numbers of a table, or of a mapping of names to arrays.

    Raises InputError for a missing or unknown column, unequal lengths, and values that are not
    finite.
    """
    todo = f"give {what} with the columns {', '.join(names)}"
    if not (hasattr(table, "columns") or isinstance(table, Mapping)):
        raise InputError(f"is {_kind(table)}, not a table", where=where, todo=todo)
    if isinstance(table, Mapping):
        known_keys(table, names, where)
    for name in names:
        if name not in table:
            raise InputError(f"the table has no column {name}", where=where, todo=todo)
    columns = [times(table[name], where, name) for name in names]
    if len({len(column) for column in columns}) > 1:
        shown = ", ".join(f"{name} {len(c)}" for name, c in zip(names, columns))
        raise InputError(f"columns of unequal length: {shown}", where=where, todo=todo)
    return columns
