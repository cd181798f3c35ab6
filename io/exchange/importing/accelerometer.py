"""Readings of accelerometers from CSV, WAV, TDMS and MAT files as `accelerometer.csv` wants them.

The unit is never guessed: it is in the file's own column names (``ax_m_s2``), in a TDMS channel's
``unit_string``, or given. Axes stay the sensor's own; rig.toml says how they lie in the rig.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.errors import InputError
from telerig.io.exchange.importing.accelerometer_files import Recording, open_recording
from telerig.io.files.csv_table import write_table

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

STANDARD_GRAVITY_M_S2 = 9.80665
UNITS = {"m/s2": 1.0, "m/s^2": 1.0, "m/s²": 1.0, "mm/s2": 1e-3, "g": STANDARD_GRAVITY_M_S2,
         "mg": 1e-3 * STANDARD_GRAVITY_M_S2}  # fmt: skip
COLUMNS = ["t_s", "sensor", "ax_m_s2", "ay_m_s2", "az_m_s2"]


@dataclass(frozen=True)
class Layout:
    """Where the readings are in a file, and what they mean.

    channels : names (CSV, MAT, TDMS) or numbers from 0 of x, y, z; None takes common names.
    time : name of the channel of times in s; None takes a common name, or the file's own rate.
    rate_hz : instead of times. start_s : added to every time, to bring the sensor's clock to the
    run's. unit : one of `UNITS`, or scale_m_s2 : m/s^2 for 1 in the file, one number or three
    (WAV: for full scale; volts: 9.80665 / (V per g)). group : of a TDMS file.
    """

    channels: tuple[str | int, str | int, str | int] | None = None
    time: str | None = None
    rate_hz: float | None = None
    start_s: float = 0.0
    unit: str | None = None
    scale_m_s2: float | tuple[float, float, float] | None = None
    group: str | None = None


def read_accelerations(
    path: str | PathLike[str], sensor: str, layout: Layout | None = None
) -> pd.DataFrame:
    """Columns t_s, sensor, ax_m_s2, ay_m_s2, az_m_s2, in the order of time.

    sensor : its name in rig.toml. Raises InputError, naming the file and what it holds, when a
    channel, the times or the unit are missing, or a value is not a finite number.
    """
    import pandas as pd

    asked = layout or Layout()
    recording = open_recording(Path(path), asked.group)
    names = _channels(recording, asked.channels)
    raw = np.stack([_values(recording, name) for name in names], -1)
    t_s = _times(recording, asked, len(raw)) + asked.start_s
    _check(recording, names, raw, t_s)
    readings = raw * _scale(recording, names, asked)
    table = pd.DataFrame({"t_s": t_s, "sensor": sensor})
    table[COLUMNS[2:]] = readings
    return table


def merge_accelerations(table: pd.DataFrame, path: str | PathLike[str]) -> list[str]:
    """Write ``table`` to `accelerometer.csv`, keeping what the file has of other sensors.

    Returns the names of the sensors whose readings were replaced. Raises InputError when the file
    that is there cannot be read, or the new one not written.
    """
    import pandas as pd

    from telerig.io.dataset.run_tables import read_accelerometer_csv

    file = Path(path)
    replaced: list[str] = []
    if file.is_file():
        old = read_accelerometer_csv(file, None)
        new = set(table["sensor"])
        replaced = sorted(set(old["sensor"]) & new)
        table = pd.concat([old[~old["sensor"].isin(new)], table], ignore_index=True)
    write_table(table, file)
    return replaced


def _channels(recording: Recording, asked: Sequence[str | int] | None) -> list[str]:
    there = list(recording.channels)
    if asked is None:
        for trial in ("a{}_m_s2", "a{}", "acc_{}", "accel_{}", "acc{}", "{}"):
            wanted = [trial.format(axis) for axis in "xyz"]
            found = {name.lower(): name for name in there}
            if all(name in found for name in wanted):
                return [found[name] for name in wanted]
        if len(there) == 3:
            return there
        raise InputError(
            "does not tell which channels are x, y and z",
            where=recording.where,
            todo=f"name three of them: {', '.join(there)}",
        )
    names = [there[c] if isinstance(c, int) and 0 <= c < len(there) else str(c) for c in asked]
    missing = [name for name in names if name not in there]
    if missing or len(names) != 3:
        raise InputError(
            f"has no channel {', '.join(missing)}" if missing else f"{len(names)} channels named",
            where=recording.where,
            todo=f"name three of: {', '.join(there)}",
        )
    return names


def _values(recording: Recording, name: str) -> Array:
    values = recording.channels[name]
    if values.dtype.kind not in "iufb" or values.ndim != 1:
        raise InputError(
            f"channel {name!r} is no column of numbers", where=recording.where, todo="name another"
        )
    return np.asarray(values, float)


def _times(recording: Recording, asked: Layout, rows: int) -> Array:
    if asked.time is not None:
        if asked.time not in recording.channels:
            raise InputError(
                f"has no channel {asked.time!r} for the times",
                where=recording.where,
                todo=f"there are: {', '.join(recording.channels)}",
            )
        return _values(recording, asked.time)
    rate = asked.rate_hz if asked.rate_hz is not None else recording.rate_hz
    if asked.rate_hz is None:
        common = {"t_s", "time", "time_s", "time (s)", "time [s]", "t", "timestamp_s"}
        for name in recording.channels:
            if name.strip().lower() in common:
                return _values(recording, name)
    if rate is None or not rate > 0:
        raise InputError(
            "tells neither times nor a sampling rate" if rate is None else f"rate is {rate} Hz",
            where=recording.where,
            todo="give the name of the channel with times in s, or rate_hz",
        )
    return recording.offset_s + np.arange(rows) / rate


def _scale(recording: Recording, names: Sequence[str], asked: Layout) -> Array:
    if asked.scale_m_s2 is not None:
        if asked.unit is not None:
            raise InputError("both a unit and scale_m_s2 given", todo="give one of them")
        return _finite(asked.scale_m_s2)
    units = [asked.unit or recording.units.get(name) or "" for name in names]
    if all(name.endswith("_m_s2") for name in names) and asked.unit is None:
        units = ["m/s2"] * 3
    unknown = [unit for unit in units if unit not in UNITS]
    if unknown:
        raise InputError(
            f"the unit of its readings is {unknown[0]!r}" if unknown[0]
            else "does not tell the unit of its readings",
            where=recording.where,
            todo=f"give unit ({', '.join(UNITS)}) or scale_m_s2, the m/s^2 for a reading of 1",
        )  # fmt: skip
    return np.array([UNITS[unit] for unit in units])


def _finite(scale: ArrayLike) -> Array:
    values = np.asarray(scale, float)
    if values.shape not in ((), (3,)) or not np.isfinite(values).all() or not values.all():
        raise InputError(f"scale_m_s2 is {scale!r}", todo="give one number or three, none zero")
    return values


def _check(recording: Recording, names: Sequence[str], raw: Array, t_s: Array) -> None:
    if len(raw) != len(t_s) or not len(raw):
        raise InputError(
            f"has {len(raw)} readings and {len(t_s)} times", where=recording.where, todo="check it"
        )
    bad = np.argwhere(~np.isfinite(np.c_[raw, t_s]))
    if len(bad):
        row, column = bad[0]
        name = [*names, "time"][column]
        raise InputError(
            f"reading {row} of {name!r} is no finite number ({len(bad)} such)",
            where=recording.where,
            todo="cut it out, or export the recording again",
        )
    late = np.flatnonzero(np.diff(t_s) <= 0)
    if len(late):
        i = int(late[0])
        raise InputError(
            f"time {t_s[i + 1]:.9g} s follows {t_s[i]:.9g} s (reading {i + 1})",
            where=recording.where,
            todo="times must increase; give rate_hz where they are rounded",
        )


def layout_from(options: dict[str, Any]) -> Layout:
    """A `Layout` from words of a command line: channels "2,3,4" or "x,y,z", scale "9.8" or three.

    Raises InputError for what is no number where one is needed.
    """
    values = {key: value for key, value in options.items() if value is not None}
    if "channels" in values:
        words = [w.strip() for w in str(values["channels"]).split(",")]
        values["channels"] = tuple(int(w) if w.isdecimal() else w for w in words)
    if "scale_m_s2" in values:
        try:
            numbers = tuple(float(w) for w in str(values["scale_m_s2"]).split(","))
        except ValueError as error:
            raise InputError(
                f"scale {values['scale_m_s2']!r} is no number", todo="write 98.1 or 98,97.5,99"
            ) from error
        values["scale_m_s2"] = numbers[0] if len(numbers) == 1 else numbers
    return Layout(**values)
