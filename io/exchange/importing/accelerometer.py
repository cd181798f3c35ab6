"""Readings of accelerometers from the files of loggers, for `accelerometer.csv`.

The unit is never guessed: it is in the names of the channels (``X (g)``, ``ax_m_s2``), in a line of
units, in the ``unit_string`` of a TDMS channel, or given. The axes stay those of the sensor;
rig.toml says how they lie in the rig.
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
from telerig.io.exchange.importing.binary_recordings import EXPORT_AGAIN
from telerig.io.exchange.importing.headers import (
    TIME_UNITS,
    axes_in,
    is_counter,
    is_date,
    is_time,
    known_unit,
    time_unit_in,
    unit_in,
)
from telerig.io.exchange.importing.recording import Recording
from telerig.io.exchange.importing.stamps import seconds_of
from telerig.io.files.csv_table import LARGEST_NUMBER
from telerig.rig.units import ACCELERATION_UNITS

AXES = ["ax_m_s2", "ay_m_s2", "az_m_s2"]
_PLAUSIBLE_HZ = (50.0, 2e5)
"""Sampling rates from which the unit of times is inferred, where nothing states it. Times in ms
would be taken for seconds only from a rate of 50 kHz on."""
_SAME_RATE = 0.05
_SEEN_CELLS = 200


@dataclass(frozen=True)
class Layout:
    """State where in a file the readings are, and what they mean; None uses what the file states.

    channels : names, or numbers from 0, of the channels x, y, z.
    time : name or number of the channel that holds the times.
    time_unit : one of `TIME_UNITS`.
    rate_hz : sampling rate, for a file without times.
    start_s : time in s that is added to all times, to bring the sensor's clock to that of the run.
    unit : unit of the readings, one of `ACCELERATION_UNITS`.
    scale_m_s2 : instead of a unit, the acceleration in m/s^2 of a reading of 1, as one number or
        three (WAV files: of full scale; volts: 9.80665 divided by the sensitivity in V per g).
    group : name of the group in a TDMS file.
    """

    channels: tuple[str | int, str | int, str | int] | None = None
    time: str | int | None = None
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
    recording = open_recording(Path(path), layout.group)
    names = _channels(recording, layout)
    columns = [_values(recording, name) for name in names]
    if len({len(column) for column in columns}) > 1:
        lengths = ", ".join(f"{name} {len(column)}" for name, column in zip(names, columns))
        raise recording.error(f"its channels differ in length: {lengths}", EXPORT_AGAIN)
    raw = np.stack(columns, -1)
    t_s, said = _times(recording, layout, len(raw))
    t_s = t_s + layout.start_s
    if len(raw) != len(t_s) or not len(raw):
        raise recording.error(
            f"has {len(raw)} readings and {len(t_s)} times",
            "give as many times as readings, at least one",
        )
    blank = np.isnan(raw).all(-1) if recording.lines is not None else np.zeros(len(raw), bool)
    kept = np.logical_not(blank)
    scale, unit = _scale(recording, names, layout)
    channels = f"x, y, z are the channels {', '.join(map(repr, names))} in {unit}"
    notes = [*recording.notes, channels, *said]
    if not kept.all():
        notes.append(f"{int((~kept).sum())} rows are left out, because they have no reading")
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


def _channels(recording: Recording, layout: Layout) -> list[str]:
    there = list(recording.channels)
    listed = ", ".join(there)
    if layout.channels is None:
        found = axes_in(name for name in there if not _is_text(recording, name))
        if len(found) == 1:
            return list(found[0])
        if not found and len(there) == 3:
            return there
        raise recording.error(
            f"has {len(found)} sets of channels x, y and z"
            if found
            else "does not say which channels are x, y and z",
            f"name three of them with --channels {','.join(found[0]) if found else 'x,y,z'}"
            f" (by names, or by numbers from 0): {listed}",
        )
    names = [_named(there, one) for one in layout.channels]
    missing = [name for name in names if name not in there]
    if missing or len(names) != 3:
        raise recording.error(
            f"has no channel {', '.join(missing)}" if missing else f"{len(names)} channels named",
            f"name three with --channels x,y,z: {listed}",
        )
    return names


def _named(there: Sequence[str], one: str | int) -> str:
    return there[one] if isinstance(one, int) and 0 <= one < len(there) else str(one)


def _is_text(recording: Recording, name: str) -> bool:
    """Return whether a channel has text in half of its cells or more, so far as they are seen."""
    values = recording.channels[name]
    some = [str(cell) for cell in values[:: max(1, len(values) // _SEEN_CELLS)]]
    return values.dtype.kind not in "iufb" and 2 * sum(map(_is_number, some)) <= len(some)


def _is_blank(recording: Recording, name: str) -> bool:
    values = recording.channels[name]
    return values.dtype.kind == "f" and bool(np.isnan(values).all())


def _values(recording: Recording, name: str) -> Array:
    values = recording.channels[name]
    if values.ndim != 1 or _is_text(recording, name):
        raise recording.error(
            f"channel {name!r} is no column of numbers", "name another channel with --channels"
        )
    if values.dtype.kind not in "iufb":
        cells = [str(cell).replace(",", ".") or "nan" for cell in values]
        bad = next((i for i, cell in enumerate(cells) if not _is_number(cell)), None)
        if bad is not None:
            what = f"reading {bad} of {name!r} is {str(values[bad])!r:.60}, no number"
            raise recording.error(what, "correct or remove the row", bad)
        return np.array(cells, float)
    return np.asarray(values, float)


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", ".") or "nan")
    except ValueError:
        return False
    return "_" not in cell


def _times(recording: Recording, layout: Layout, rows: int) -> tuple[Array, list[str]]:
    """Return the (rows,) times in s, and sentences that say where they are from."""
    there = list(recording.channels)
    if layout.time is not None:
        name = _named(there, layout.time)
        if name not in there:
            raise recording.error(
                f"has no channel {name!r} for the times",
                f"name one of these channels with --time: {', '.join(there)}",
            )
        return _times_in(recording, layout, name)
    if layout.rate_hz is None:
        named = [name for name in there if is_time(name) and not _is_blank(recording, name)] or [
            name
            for name in there
            if _is_text(recording, name) and _stamps(recording, name) is not None
        ]
        if named:
            best = min(named, key=lambda name: _time_order(recording, name))
            return _times_in(recording, layout, best)
    rate = layout.rate_hz if layout.rate_hz is not None else recording.rate_hz
    if rate is None or not rate > 0:
        raise recording.error(
            "contains neither times nor a sampling rate that can be read without doubt"
            if rate is None
            else f"rate is {rate} Hz",
            "name the channel of times with --time, or give the sampling rate with --rate-hz 1600",
        )
    counted = _counted(recording, rows)
    if counted is None:
        said = [f"times follow from the number of the sample at {rate:g} Hz"]
        return recording.offset_s + np.arange(rows) / rate, said
    name, count = counted
    said = [f"times follow from the counter {name!r} at {rate:g} Hz"]
    lost = int(count[-1] - count[0]) + 1 - rows
    said += [f"the counter {name!r} shows that {lost} samples are missing"] if lost else []
    return recording.offset_s + count / rate, said


def _time_order(recording: Recording, name: str) -> int:
    """Return the rank of a channel of times: numbers with a unit, numbers, text."""
    if _is_text(recording, name):
        return 2
    return 0 if time_unit_in(name, recording.units) else 1


def _times_in(recording: Recording, layout: Layout, name: str) -> tuple[Array, list[str]]:
    """Return the times in s that a channel holds, and a sentence about them."""
    if _is_text(recording, name):
        t_s = _stamps(recording, name)
        if t_s is None:
            raise recording.error(
                f"channel {name!r} holds no times that can be read",
                "name another channel with --time, or give the sampling rate with --rate-hz 1600",
            )
        first = str(recording.channels[name][0])
        return t_s, [f"times are in s since the first time stamp of {name!r}, {first}"]
    values = _values(recording, name)
    unit = layout.time_unit or time_unit_in(name, recording.units)
    unit = unit or _unit_of_times(recording, values, name)
    if unit not in TIME_UNITS:
        todo = f"use --time-unit with one of: {', '.join(TIME_UNITS)}"
        raise InputError(f"--time-unit {unit}: there is no such unit", todo=todo)
    t_s = values * TIME_UNITS[unit]
    said = [f"times are taken from the channel {name!r} in {unit}"]
    step = _step(t_s)
    stated = recording.rate_hz
    if stated and step > 0 and abs(1 / step / stated - 1) > _SAME_RATE:
        said.append(
            f"the times give a sampling rate of {1 / step:.6g} Hz, but the file states "
            f"{stated:g} Hz; the times are used"
        )
    return t_s, said


def _stamps(recording: Recording, name: str) -> Array | None:
    """Return the times in s of a channel of stamps, to which a channel of dates may belong.

    They are NaN where the channel is blank; None is returned if other cells are no time stamps.
    """
    cells = [str(cell).strip() for cell in recording.channels[name]]
    filled = [i for i, cell in enumerate(cells) if cell]
    found = None if is_date(name) else seconds_of([cells[i] for i in filled])
    dates = next((n for n in recording.channels if is_date(n) and n != name), None)
    if dates is not None and _is_text(recording, dates):
        days = recording.channels[dates]
        joined = seconds_of([f"{days[i]} {cells[i]}" for i in filled])
        found = found if joined is None else joined
    if found is None:
        return None
    t_s = np.full(len(cells), np.nan)
    t_s[filled] = found
    return t_s


def _step(times: Array) -> float:
    """Return the median difference between times in a row, 0 if there are fewer than two."""
    steps = np.diff(times[np.isfinite(times)])
    return float(np.median(steps)) if len(steps) else 0.0


def _unit_of_times(recording: Recording, values: Array, name: str) -> str:
    """Return the unit of times that state none: by the stated rate, from 1970, or seconds."""
    step = _step(values)
    if step > 0:
        rates = {unit: 1 / (step * TIME_UNITS[unit]) for unit in TIME_UNITS}
        stated = recording.rate_hz
        agreeing = [u for u, r in rates.items() if stated and abs(r / stated - 1) < _SAME_RATE]
        possible = [u for u, r in rates.items() if _PLAUSIBLE_HZ[0] <= r <= _PLAUSIBLE_HZ[1]]
        since_1970 = [u for u in possible if 1e8 < values[0] * TIME_UNITS[u] < 1e10]
        for found in (agreeing, since_1970, [u for u in possible if u == "s"]):
            if found:
                return found[0]
    raise recording.error(
        f"does not state the unit of the times in {name!r}, which increase by {step:g}",
        f"give the unit with --time-unit {'ms' if step >= 1 else 's'} ({', '.join(TIME_UNITS)})",
    )


def _counted(recording: Recording, rows: int) -> tuple[str, Array] | None:
    """Return a channel that counts the samples, from 0 and without the turns of the counter."""
    for name in recording.channels:
        if not is_counter(name) or _is_text(recording, name):
            continue
        values = _values(recording, name)
        if len(values) != rows or rows < 2 or not np.isfinite(values).all():
            continue
        step = np.diff(values)
        for turn in (0, 2**8, 2**16, 2**32):
            steps = step % turn if turn else step
            whole = (steps == np.round(steps)) & (steps >= 1)
            if whole.all() and np.median(steps) == 1 and (not turn or np.max(values) < turn):
                return name, np.r_[0.0, np.cumsum(steps)]
    return None


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
    if "channels" in values:
        words = [w.strip() for w in str(values["channels"]).split(",")]
        values["channels"] = tuple(int(w) if w.isdecimal() else w for w in words)
    if str(values.get("time", "")).isdecimal():
        values["time"] = int(values["time"])
    if "scale_m_s2" in values:
        try:
            numbers = tuple(float(w) for w in str(values["scale_m_s2"]).split(","))
        except ValueError as error:
            raise InputError(
                f"--scale {values['scale_m_s2']} is no number", todo="write 98.1 or 98,97.5,99"
            ) from error
        values["scale_m_s2"] = numbers[0] if len(numbers) == 1 else numbers
    return Layout(**values)


def open_recording(path: Path, group: str | None = None) -> Recording:
    """Read a file by its ending, one of `RECORDINGS`. Raises InputError when it cannot be read."""
    ending = path.suffix.lower()
    if not path.is_file():
        raise InputError("there is no such file", where=str(path), todo="check the path")
    if ending not in RECORDINGS:
        raise InputError(
            f"recordings that end in {ending or 'nothing'} cannot be read",
            where=str(path),
            todo=f"give a file that ends in one of: {', '.join(RECORDINGS)}",
        )
    recording: Recording = RECORDINGS[ending](path, group=group)
    return recording
