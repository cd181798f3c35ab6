"""Readings of accelerometers from CSV, WAV, TDMS and MAT files, for `accelerometer.csv`.

The unit is never guessed: it is in the column names of the file (``ax_m_s2``), in the
``unit_string`` of a TDMS channel, or given. The axes stay those of the sensor; rig.toml says how
they lie in the rig.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.exchange.formats import RECORDINGS
from telerig.io.files.csv_table import LARGEST_NUMBER, write_table
from telerig.io.files.text import read_text
from telerig.io.machine.parallel import isolated
from telerig.rig.units import STANDARD_GRAVITY_M_S2

UNITS = {"m/s2": 1.0, "m/s^2": 1.0, "m/s²": 1.0, "mm/s2": 1e-3, "g": STANDARD_GRAVITY_M_S2,
         "mg": 1e-3 * STANDARD_GRAVITY_M_S2}  # fmt: skip
_EXPORT_AGAIN = "export the recording again from the program that made it, or give another file"
COLUMNS = ["t_s", "sensor", "ax_m_s2", "ay_m_s2", "az_m_s2"]


@dataclass(frozen=True)
class Layout:
    """Hold where the readings are in a file, and what they mean.

    channels : names (CSV, MAT, TDMS) or numbers from 0 of the channels x, y, z; None looks for
    common names.
    time : name of the channel of times in s; None looks for a common name, or uses the file's rate.
    rate_hz : the sampling rate in Hz, in place of times; None uses what the file has.
    start_s : is added to every time (s), to bring the sensor's clock to that of the run.
    unit : one of `UNITS`; None uses the unit that the file states.
    scale_m_s2 : the acceleration in m/s^2 that 1 in the file means, one number or three (WAV: for
    full scale; volts: 9.80665 / (V per g)). It is given in place of ``unit``.
    group : the group of a TDMS file.
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
    """Read the recording of one accelerometer from a CSV, WAV, MAT or TDMS file.

    sensor : the sensor's name in rig.toml. layout : None looks for common names and units.
    Returns the columns t_s (s), sensor, ax_m_s2, ay_m_s2, az_m_s2 (m/s^2), in the order of time.
    Raises InputError, naming the file and what it holds, when a channel, the times or the unit are
    missing, or when a value is not a finite number.
    """
    layout = layout or Layout()
    recording = open_recording(Path(path), layout.group)
    names = _channels(recording, layout.channels)
    columns = [_values(recording, name) for name in names]
    if len({len(column) for column in columns}) > 1:
        lengths = ", ".join(f"{name} {len(column)}" for name, column in zip(names, columns))
        raise recording.error(f"its channels differ in length: {lengths}", _EXPORT_AGAIN)
    raw = np.stack(columns, -1)
    t_s = _times(recording, layout, len(raw)) + layout.start_s
    if len(raw) != len(t_s) or not len(raw):
        raise recording.error(
            f"has {len(raw)} readings and {len(t_s)} times",
            "give as many times as readings, at least one",
        )
    bad = np.argwhere(~(np.abs(np.c_[raw, t_s]) <= LARGEST_NUMBER))
    if len(bad):
        row, column = bad[0]
        name = [*names, "time"][column]
        raise recording.error(
            f"reading {row} of {name!r} is no finite number up to {LARGEST_NUMBER:g} "
            f"({len(bad)} such)",
            "cut it out, or export the recording again",
        )
    late = np.flatnonzero(np.diff(t_s) <= 0)
    if len(late):
        i = int(late[0])
        raise recording.error(
            f"time {t_s[i + 1]:.9g} s follows {t_s[i]:.9g} s (reading {i + 1})",
            "times must increase; give rate_hz instead if they are rounded",
        )
    readings = raw * _scale(recording, names, layout)
    table = pd.DataFrame({"t_s": t_s, "sensor": sensor})
    table[COLUMNS[2:]] = readings
    return table


def merge_accelerations(table: pd.DataFrame, path: str | PathLike[str]) -> list[str]:
    """Write ``table`` to `accelerometer.csv`, and keep the readings of other sensors in that file.

    Returns the names of the sensors whose earlier readings were replaced.
    Raises InputError when the existing file cannot be read, or the new one cannot be written.
    """
    from telerig.io.dataset.tables import read_accelerometer_csv

    file = Path(path)
    replaced: list[str] = []
    if file.is_file():
        old = read_accelerometer_csv(file, None)
        new = set(table["sensor"])
        replaced = sorted(set(old["sensor"]) & new)
        table = pd.concat([old[~old["sensor"].isin(new)], table], ignore_index=True)
    write_table(table, file)
    return replaced


def _channels(recording: Recording, chosen: Sequence[str | int] | None) -> list[str]:
    there = list(recording.channels)
    if chosen is None:
        for trial in ("a{}_m_s2", "a{}", "acc_{}", "accel_{}", "acc{}", "{}"):
            wanted = [trial.format(axis) for axis in "xyz"]
            found = {name.lower(): name for name in there}
            if all(name in found for name in wanted):
                return [found[name] for name in wanted]
        if len(there) == 3:
            return there
        raise recording.error(
            "does not say which channels are x, y and z", f"name three of them: {', '.join(there)}"
        )
    names = [there[c] if isinstance(c, int) and 0 <= c < len(there) else str(c) for c in chosen]
    missing = [name for name in names if name not in there]
    if missing or len(names) != 3:
        raise recording.error(
            f"has no channel {', '.join(missing)}" if missing else f"{len(names)} channels named",
            f"name three of: {', '.join(there)}",
        )
    return names


def _values(recording: Recording, name: str) -> Array:
    values = recording.channels[name]
    if values.dtype.kind not in "iufb" or values.ndim != 1:
        raise recording.error(f"channel {name!r} is no column of numbers", "name another one")
    return np.asarray(values, float)


def _times(recording: Recording, layout: Layout, rows: int) -> Array:
    if layout.time is not None:
        if layout.time not in recording.channels:
            raise recording.error(
                f"has no channel {layout.time!r} for the times",
                f"there are: {', '.join(recording.channels)}",
            )
        return _values(recording, layout.time)
    rate = layout.rate_hz if layout.rate_hz is not None else recording.rate_hz
    if layout.rate_hz is None:
        common = {"t_s", "time", "time_s", "time (s)", "time [s]", "t", "timestamp_s"}
        for name in recording.channels:
            if name.strip().lower() in common:
                return _values(recording, name)
    if rate is None or not rate > 0:
        raise recording.error(
            "contains neither times nor a sampling rate" if rate is None else f"rate is {rate} Hz",
            "give the name of the channel with times in s, or rate_hz",
        )
    return recording.offset_s + np.arange(rows) / rate


def _scale(recording: Recording, names: Sequence[str], layout: Layout) -> Array:
    if layout.scale_m_s2 is not None:
        if layout.unit is not None:
            raise InputError("both a unit and scale_m_s2 are given", todo="give one of them")
        values = np.asarray(layout.scale_m_s2, float)
        if values.shape not in ((), (3,)) or not np.isfinite(values).all() or not values.all():
            raise InputError(
                f"scale_m_s2 is {layout.scale_m_s2!r}",
                todo="give one number or three, none of them zero",
            )
        return values
    units = [layout.unit or recording.units.get(name) or "" for name in names]
    if all(name.endswith("_m_s2") for name in names) and layout.unit is None:
        units = ["m/s2"] * 3
    unknown = [unit for unit in units if unit not in UNITS]
    if unknown:
        raise recording.error(
            f"the unit of its readings is {unknown[0]!r}"
            if unknown[0]
            else "does not say the unit of its readings",
            f"give unit ({', '.join(UNITS)}), or scale_m_s2, the m/s^2 of a reading of 1",
        )
    return np.array([UNITS[unit] for unit in units])


def layout_from(options: dict[str, Any]) -> Layout:
    """Return a `Layout` from the options of a command line.

    channels is "2,3,4" or "x,y,z"; scale_m_s2 is one number or three, separated by commas.
    Raises InputError for a scale that is not a number.
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


@dataclass(frozen=True)
class Recording:
    """Hold the channels of a sensor's file before they are converted.

    where : the file, for errors. channels : name -> (samples,) raw values.
    units : name -> unit, for the channels that state one.
    rate_hz : sampling rate in Hz; None where the file does not state it.
    offset_s : the time of the first sample in s.
    """

    where: str
    channels: dict[str, NDArray[Any]]
    units: dict[str, str] = field(default_factory=dict)
    rate_hz: float | None = None
    offset_s: float = 0.0

    def error(self, what: str, todo: str) -> InputError:
        """Return the error that names this recording's file."""
        return InputError(what, where=self.where, todo=todo)


def open_recording(path: Path, group: str | None = None) -> Recording:
    """Read a file according to its ending, one of `RECORDINGS`.

    group : the group of a TDMS file that has several; None where there is only one.
    Raises InputError for a file that does not exist or cannot be read.
    """
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


def read_csv(path: Path) -> Recording:
    """The header is the last line before the numbers; lines above it (from a logger) are skipped.

    Cells are separated by commas, semicolons (also with decimal commas) or tabs.
    """
    lines = read_text(path).splitlines()
    first = next((i for i, line in enumerate(lines) if _cells(line) is not None), None)
    if not first:
        raise InputError(
            "has no rows of numbers below a header" if first is None else "has no header line",
            where=str(path),
            todo="write the names of the channels above the numbers",
        )
    mark, _ = _cells(lines[first]) or ("", [])
    header = [name.strip().strip('"') for name in lines[first - 1].split(mark)]
    rows = []
    for i, line in enumerate(lines[first:], first + 1):
        if not line.strip():
            continue
        cells = _cells(line)
        if cells is None or len(cells[1]) != len(header):
            raise InputError(
                f"{line[:60]!r} is not {len(header)} numbers",
                where=f"{path} row {i}",
                todo="correct or remove the row",
            )
        rows.append(cells[1])
    if len(set(header)) != len(header):
        raise InputError(
            "two columns have the same name", where=str(path), todo="rename one of them"
        )
    return Recording(str(path), dict(zip(header, np.array(rows).T)))


def _cells(line: str) -> tuple[str, list[float]] | None:
    """Separator and numbers of a line; None when it holds anything else."""
    mark = next((m for m in (";", "\t", ",") if m in line), ",")
    cells = [cell.strip() for cell in line.split(mark)]
    if mark != ",":
        cells = [cell.replace(",", ".") for cell in cells]
    if not any(cells):
        return None
    try:
        return mark, [float(cell) if cell else np.nan for cell in cells]
    except ValueError:
        return None


@contextmanager
def _reading(path: Path, kind: str) -> Iterator[list[warnings.WarningMessage]]:
    """Turn every error of a library that reads a damaged file into InputError.

    Yields the list to which the library's warnings are added.
    """
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            yield warned
    except InputError:
        raise
    except Exception as error:
        what = f"is no {kind} file that can be read ({error or type(error).__name__})"
        raise InputError(what, where=str(path), todo=_EXPORT_AGAIN) from error


def read_wav(path: Path) -> Recording:
    """Channels and rate of a WAV file; whole numbers are scaled so that ±1 is full scale."""
    from scipy.io import wavfile

    with _reading(path, "WAV") as warned:
        rate, samples = wavfile.read(path)
    if any("EOF" in str(one.message) for one in warned):
        raise InputError("ends too early", where=str(path), todo=_EXPORT_AGAIN)
    values = samples.reshape(len(samples), -1).astype(float)
    if samples.dtype == np.uint8:
        values = (values - 128) / 128
    elif samples.dtype.kind == "i":
        values /= -float(np.iinfo(samples.dtype).min)
    channels = {str(i): column for i, column in enumerate(values.T)}
    return Recording(str(path), channels, rate_hz=float(rate))


def read_mat(path: Path) -> Recording:
    """Vectors by their names; the columns of an (N, k) matrix as name_0, name_1, ..."""
    from scipy.io import loadmat

    with _reading(path, "MAT"):
        try:
            content = isolated(partial(loadmat, squeeze_me=True), path)
        except NotImplementedError as error:
            raise InputError(
                "is a MATLAB 7.3 file, which cannot be read",
                where=str(path),
                todo="in MATLAB, save it with the option -v7",
            ) from error
    channels: dict[str, NDArray[Any]] = {}
    for name, value in content.items():
        array = np.asarray(value)
        if name.startswith("__") or array.dtype.kind not in "iuf":
            continue
        if array.ndim == 1:
            channels[name] = array
        elif array.ndim == 2:
            columns = array if array.shape[0] >= array.shape[1] else array.T
            channels |= {f"{name}_{i}": column for i, column in enumerate(columns.T)}
    return Recording(str(path), channels)


def read_tdms(path: Path, group: str | None = None) -> Recording:
    try:
        nptdms = import_module("nptdms")
    except ModuleNotFoundError as error:
        raise InputError(
            "TDMS files need nptdms", where=str(path), todo="pip install 'telerig[tdms]'"
        ) from error
    nptdms.log.log_manager.set_level(logging.CRITICAL)  # what it finds is in our errors
    with _reading(path, "TDMS"):
        return _of_tdms(nptdms.TdmsFile.read(path), path, group)


def _of_tdms(file: Any, path: Path, group: str | None) -> Recording:
    groups = [g for g in file.groups() if g.channels()]
    chosen = [g for g in groups if group in (None, g.name)]
    if len(chosen) != 1:
        names = ", ".join(g.name for g in groups)
        raise InputError(
            f"has no group {group!r}" if group else f"has {len(groups)} groups",
            where=str(path),
            todo=f"name one of: {names}",
        )
    found = chosen[0].channels()
    units = {c.name: str(c.properties["unit_string"]) for c in found
             if c.properties.get("unit_string")}  # fmt: skip
    steps = {float(c.properties["wf_increment"]) for c in found if "wf_increment" in c.properties}
    starts = {float(c.properties.get("wf_start_offset", 0.0)) for c in found}
    if len(steps) > 1 or len(starts) > 1:
        raise InputError(
            "its channels were sampled at different times",
            where=str(path),
            todo="resample them to one clock before the import",
        )
    step = steps.pop() if steps else 0.0
    channels = {c.name: np.asarray(c[:]) for c in found}
    return Recording(str(path), channels, units, 1 / step if step > 0 else None, starts.pop())
