"""Readings of accelerometers from the files of loggers, for `accelerometer.csv`.

Nothing is guessed: times and axes have known names (``Time (s)``, ``X (g)``, ``ax_m_s2``) or are
given, units are in these names, in the ``unit_string`` of a TDMS channel, or given. The axes stay
those of the sensor; rig.toml says how they lie in the rig.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array, Bools
from telerig.errors import InputError
from telerig.io.exchange.formats import RECORDINGS
from telerig.io.exchange.importing.headers import (
    TIME_UNITS,
    known_columns,
    known_unit,
    unit_in,
)
from telerig.io.exchange.importing.logger_text import is_number
from telerig.io.exchange.importing.recording import EXPORT_AGAIN, Recording
from telerig.io.files.text import LARGEST_NUMBER, need_file
from telerig.rig.units import ACCELERATION_UNITS
from telerig.short_text import counted

AXES = ["ax_m_s2", "ay_m_s2", "az_m_s2"]
_LOST_AT_TURN = 1 / 16
"""Share of a counter's range that may be missing where it starts again; more may be where samples
are missing elsewhere, too."""


@dataclass(frozen=True)
class Layout:
    """State where in a file the readings are, and what they mean; None uses what the file states.

    columns : names, or numbers from 0, of the columns time, x, y, z; three without times.
    time_unit : one of `TIME_UNITS`, or the form of time stamps, as for `datetime.strptime`.
    rate_hz : sampling rate; a fourth column counts the samples then.
    start_s : time in s that is added to all times, to bring the sensor's clock to that of the run.
    unit : unit of the readings, one of `ACCELERATION_UNITS`.
    scale_m_s2 : instead of a unit, the acceleration in m/s^2 of a reading of 1, as one number or
        three (WAV files: of full scale; volts: 9.80665 divided by the sensitivity in V per g).
    group : name of the group in a TDMS file.
    """

    columns: tuple[str | int, ...] | None = None
    time_unit: str | None = None
    rate_hz: float | None = None
    start_s: float = 0.0
    unit: str | None = None
    scale_m_s2: float | tuple[float, float, float] | None = None
    group: str | None = None


@dataclass(frozen=True)
class Imported:
    """Hold the readings of one accelerometer, and sentences on how the file was understood."""

    table: pd.DataFrame
    notes: tuple[str, ...]


def read_accelerations(
    path: str | PathLike[str], sensor: str, layout: Layout | None = None
) -> pd.DataFrame:
    """Read the recording of one accelerometer from a logger's text file, WAV, MAT or TDMS file.

    Returns the columns t_s (s), sensor, ax_m_s2, ay_m_s2, az_m_s2 (m/s^2), in the order of time.
    Raises InputError when a channel, the times or the unit are missing, or a value is not finite.
    """
    return import_accelerations(path, sensor, layout).table


def import_accelerations(
    path: str | PathLike[str], sensor: str, layout: Layout | None = None
) -> Imported:
    """Read a recording as `read_accelerations` does, with sentences on how it was understood."""
    layout = layout or Layout()
    recording = open_recording(Path(path), layout)
    time, names = _columns(recording, layout)
    columns = [_values(recording, name) for name in names]
    if len({len(column) for column in columns}) > 1:
        lengths = ", ".join(f"{name} {len(column)}" for name, column in zip(names, columns))
        raise recording.error(f"its channels differ in length: {lengths}", EXPORT_AGAIN)
    raw = np.stack(columns, -1)
    t_s, said = _times(recording, layout, time, len(raw))
    t_s = t_s + layout.start_s
    if len(raw) != len(t_s) or not len(raw):
        raise recording.error(
            f"has {counted(len(raw), 'reading')} and {len(t_s)} times",
            "give as many times as readings, at least one",
        )
    blank = np.isnan(raw).all(-1) if recording.lines is not None else np.zeros(len(raw), bool)
    kept = np.logical_not(blank)
    scale, unit = _scale(recording, names, layout)
    stated = {unit_in(name) for name in names} - {"", unit}
    channels = f"x, y, z are the channels {', '.join(map(repr, names))} in {unit}"
    notes = [*recording.notes, channels, said]
    if stated:
        notes.append(f"their names state another unit: {', '.join(sorted(stated))}")
    if not kept.all():
        notes.append(f"left out: {counted(int((~kept).sum()), 'row')} without a reading")
    _check_numbers(recording, np.c_[raw, t_s], [*names, "time"], kept)
    _check_order(recording, t_s, kept)
    table = pd.DataFrame({"t_s": t_s[kept], "sensor": sensor})
    table[AXES] = (raw * scale)[kept]
    return Imported(table, tuple(notes))


def _check_numbers(recording: Recording, values: Array, names: Sequence[str], kept: Bools) -> None:
    """Raise InputError for a kept row with a value that is no number."""
    bad = np.argwhere(~(np.abs(values) <= LARGEST_NUMBER) & kept[:, None])
    if not kept.any():
        raise recording.error("has no readings", EXPORT_AGAIN)
    if len(bad):
        row, column = (int(i) for i in bad[0])
        raise recording.error(
            f"reading {row} of {names[column]!r} is no finite number up to {LARGEST_NUMBER:g} "
            f"({len(bad)} such readings)",
            "remove the row, or export the recording again",
            row,
        )


def _check_order(recording: Recording, t_s: Array, kept: Bools) -> None:
    """Raise InputError for a kept row whose time is not later than the one before."""
    rows = np.flatnonzero(kept)
    late = np.flatnonzero(np.diff(t_s[rows]) <= 0)
    if len(late):
        before, row = (int(i) for i in rows[late[0] : late[0] + 2])
        raise recording.error(
            f"time {t_s[row]:.9g} s follows {t_s[before]:.9g} s (reading {row}; {len(late)} such "
            "readings)",
            "times must increase; if they are rounded, give the sampling rate instead: "
            "--rate-hz 1600",
            row,
        )


def _columns(recording: Recording, layout: Layout) -> tuple[str | None, tuple[str, str, str]]:
    """Return the channel of times, None without one, and the channels x, y and z."""
    there = list(recording.channels)
    if layout.columns is None:
        time, axes = known_columns(there, recording.units)
        if axes is None and len(there) == 3:
            axes = (there[0], there[1], there[2])
        if axes is None:
            raise recording.error("does not say which channels are x, y and z", _naming(there))
        return (time if layout.rate_hz is None else None), axes
    names = [_named(there, one) for one in layout.columns]
    missing = [name for name in names if name not in there]
    if missing or len(names) not in (3, 4):
        raise recording.error(
            f"has no channel {', '.join(missing)}" if missing else f"{len(names)} channels named",
            _naming(there),
        )
    x, y, z = names[-3:]
    return (names[0] if len(names) == 4 else None), (x, y, z)


def _naming(there: Sequence[str]) -> str:
    return (
        "name times, x, y and z with --columns Time,ch1,ch2,ch3 (or numbers from 0), three without "
        f"times and --rate-hz. The channels: {', '.join(there)}"
    )


def _named(there: Sequence[str], one: str | int) -> str:
    return there[one] if isinstance(one, int) and 0 <= one < len(there) else str(one)


def _values(recording: Recording, name: str) -> Array:
    values = recording.channels[name]
    if values.ndim != 1:
        raise recording.error(
            f"channel {name!r} is no column of numbers", "name another channel with --columns"
        )
    if values.dtype.kind in "iufb":
        return np.asarray(values, float)
    bad = next((i for i, cell in enumerate(values) if cell and not is_number(cell)), None)
    if bad is not None:
        what = f"reading {bad} of {name!r} is {str(values[bad])!r:.60}, no number"
        todo = "correct or remove the row, or name another channel with --columns"
        raise recording.error(what, todo, bad)
    return np.array([cell.replace(",", ".") or "nan" for cell in values], float)


def _times(recording: Recording, layout: Layout, name: str | None, rows: int) -> tuple[Array, str]:
    """Return the (rows,) times in s, and a sentence that says where they are from."""
    rate = recording.rate_hz if layout.rate_hz is None else layout.rate_hz
    if name is None or layout.rate_hz is not None:
        if rate is None or not rate > 0:
            raise recording.error(
                "contains no times under a known name and states no sampling rate"
                if rate is None
                else f"rate is {rate} Hz",
                "name the channel of times with --columns Time,x,y,z, or give --rate-hz 1600. The "
                f"channels: {', '.join(recording.channels)}",
            )
        count, of = np.arange(rows, dtype=float), "number of the sample"
        if name is not None:
            count, of = _counted(recording, name), f"counter {name!r}"
        return recording.offset_s + count / rate, f"times follow from the {of} at {rate:g} Hz"
    unit = layout.time_unit or known_unit(recording.units.get(name, "")) or unit_in(name)
    if "%" in unit:
        return _stamps(recording, name, unit), f"times are in s since the first stamp of {name!r}"
    if unit not in TIME_UNITS:
        raise recording.error(
            f"--time-unit {unit}: there is no such unit"
            if unit
            else f"does not state the unit of the times in {name!r}",
            f"give one of {', '.join(TIME_UNITS)} with --time-unit, or the form of time stamps, "
            "--time-unit '%Y-%m-%d %H:%M:%S.%f'",
        )
    times = _values(recording, name) * TIME_UNITS[unit]
    return times, f"times are taken from the channel {name!r} in {unit}"


def _counted(recording: Recording, name: str) -> Array:
    """Return how many samples lie before each, from a counter of 8, 16 or 32 bits.

    Raises InputError for one that starts again elsewhere, and for what does not count.
    """
    values = _values(recording, name)
    steps = np.diff(values)
    turn = next((2.0**bits for bits in (8, 16, 32) if np.nanmax(values, initial=0) < 2**bits), 0.0)
    back = np.flatnonzero(steps < 0)
    steps = np.where(steps < 0, steps + turn, steps)
    far = back[steps[back] > max(_LOST_AT_TURN * turn, np.max(np.delete(steps, back), initial=1))]
    if len(far):
        before, after = values[far[0] : far[0] + 2].tolist()
        raise recording.error(
            f"the counter {name!r} goes from {before:.9g} to {after:.9g}, which is not where one "
            "of 8, 16 or 32 bits starts again",
            "cut the file there; or leave the counter out of --columns, if no sample is missing",
            int(far[0]) + 1,
        )
    if not len(values) or not ((steps == np.round(steps)) & (steps >= 1)).all():
        raise recording.error(
            f"channel {name!r} does not count the samples", "leave it out of --columns"
        )
    return np.asarray(np.r_[0.0, np.cumsum(steps)])


def _stamps(recording: Recording, name: str, form: str) -> Array:
    """Return the times in s since the first of stamps in a stated form; NaN for blank ones."""
    cells = pd.Series([str(cell) or None for cell in recording.channels[name]])
    try:
        stamps = pd.to_datetime(cells, format=form)
    except ValueError as error:
        raise recording.error(
            f"channel {name!r} has stamps that are not of the form {form!r}: "
            f"{str(error).partition('. You might')[0]:.200}",
            "correct --time-unit",
        ) from error
    first = stamps.dropna()
    seconds = (stamps - first.iloc[0]).dt.total_seconds() if len(first) else pd.Series(dtype=float)
    return np.asarray(seconds, float)


def _scale(recording: Recording, names: Sequence[str], layout: Layout) -> tuple[Array, str]:
    """Return the m/s^2 of a reading of 1, for all axes or (3,), and the unit in words."""
    if layout.scale_m_s2 is not None:
        if layout.unit is not None:
            raise InputError("both --unit and --scale are given", todo="give one of them")
        values = np.asarray(layout.scale_m_s2, float)
        if values.shape not in ((), (3,)) or not np.isfinite(values).all() or not values.all():
            raise InputError(
                f"--scale is {layout.scale_m_s2!r}",
                todo="give one number or three, none of them zero",
            )
        return values, f"{', '.join(f'{v:g}' for v in np.atleast_1d(values))} m/s^2"
    units = [_unit(recording, name, layout) for name in names]
    unknown = [unit for unit in units if unit not in ACCELERATION_UNITS]
    if unknown:
        raise recording.error(
            f"the unit of its readings is {unknown[0]!r}"
            if unknown[0]
            else "does not state the unit of its readings",
            f"give the unit, for example --unit g (one of {', '.join(ACCELERATION_UNITS)}), or "
            "with --scale the acceleration in m/s^2 of a reading of 1",
        )
    sizes = np.array([ACCELERATION_UNITS[unit] for unit in units])
    return sizes, ", ".join(dict.fromkeys(units))


def _unit(recording: Recording, name: str, layout: Layout) -> str:
    """Return the unit that is given, or that the file states for a channel; "" where none is."""
    stated = layout.unit or recording.units.get(name, "")
    return known_unit(stated) or stated or unit_in(name)


def layout_from(options: dict[str, Any]) -> Layout:
    """Return a `Layout` from the options of a command line. Raises InputError for a bad scale."""
    values = {key: value for key, value in options.items() if value is not None}
    if "columns" in values:
        words = [w.strip() for w in str(values["columns"]).split(",")]
        values["columns"] = tuple(int(w) if w.isdecimal() else w for w in words)
    if "scale_m_s2" in values:
        try:
            numbers = tuple(float(w) for w in str(values["scale_m_s2"]).split(","))
        except ValueError as error:
            raise InputError(
                f"--scale {values['scale_m_s2']} is no number",
                todo="give the acceleration in m/s^2 for a reading of 1: one number "
                "(--scale 98.1), or one for each axis (--scale 98,97.5,99)",
            ) from error
        values["scale_m_s2"] = numbers[0] if len(numbers) == 1 else numbers
    return Layout(**values)


def open_recording(path: Path, layout: Layout) -> Recording:
    """Read a file by its ending, one of `RECORDINGS`. Raises InputError when it cannot be read."""
    ending = path.suffix.lower()
    need_file(path)
    if ending not in RECORDINGS:
        raise InputError(
            f"recordings that end in {ending or 'nothing'} cannot be read",
            where=str(path),
            todo=f"give a file that ends in one of: {', '.join(RECORDINGS)}",
        )
    recording: Recording = RECORDINGS[ending](path, group=layout.group, columns=layout.columns)
    return recording
