"""Recordings of sensors in the formats that loggers write: CSV, WAV, TDMS, MAT."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError


@dataclass(frozen=True)
class Recording:
    """channels : name -> (N,) raw values. units : name -> unit, where the file has one.

    rate_hz, offset_s : of the samples, where the file has them.
    """

    where: str
    channels: dict[str, NDArray[Any]]
    units: dict[str, str] = field(default_factory=dict)
    rate_hz: float | None = None
    offset_s: float = 0.0


def open_recording(path: Path, group: str | None = None) -> Recording:
    """Read a file by its ending: .csv .txt .tsv, .wav, .tdms, .mat.

    group : of a TDMS file with several. Raises InputError for what cannot be read.
    """
    readers = {".csv": _csv, ".txt": _csv, ".tsv": _csv, ".wav": _wav, ".mat": _mat}
    ending = path.suffix.lower()
    if not path.is_file():
        raise InputError("there is no such file", where=str(path), todo="check the path")
    if ending == ".tdms":
        return _tdms(path, group)
    if ending not in readers:
        raise InputError(
            f"recordings that end in {ending or 'nothing'} cannot be read",
            where=str(path),
            todo="give a .csv, .wav, .tdms or .mat file",
        )
    return readers[ending](path)


def _csv(path: Path) -> Recording:
    """The header is the last line before the numbers; lines above it (a logger's) are passed over.

    Commas, semicolons (also with decimal commas) or tabs.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read ({error})", where=str(path), todo="check it") from error
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
        raise InputError("two columns have one name", where=str(path), todo="rename one")
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


def _wav(path: Path) -> Recording:
    """Whole numbers are divided by their full scale, so 1 is full scale in every format."""
    from scipy.io import wavfile

    try:
        rate, samples = wavfile.read(path)
    except (ValueError, OSError) as error:
        raise InputError(
            f"is no WAV file that can be read ({error})", where=str(path), todo="check it"
        ) from error
    values = samples.reshape(len(samples), -1).astype(float)
    if samples.dtype == np.uint8:
        values = (values - 128) / 128
    elif samples.dtype.kind == "i":
        values /= -float(np.iinfo(samples.dtype).min)
    channels = {str(i): column for i, column in enumerate(values.T)}
    return Recording(str(path), channels, rate_hz=float(rate))


def _mat(path: Path) -> Recording:
    """Vectors by their names; the columns of an (N, k) matrix as name_0, name_1, ..."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        content = loadmat(path, squeeze_me=True)
    except NotImplementedError as error:
        raise InputError(
            "is a MATLAB 7.3 file", where=str(path), todo="save it with -v7"
        ) from error
    except (ValueError, OSError, TypeError, MatReadError) as error:
        raise InputError(
            f"is no MAT file that can be read ({error})", where=str(path), todo="check it"
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


def _tdms(path: Path, group: str | None) -> Recording:
    try:
        nptdms = import_module("nptdms")
    except ModuleNotFoundError as error:
        raise InputError(
            "TDMS files need nptdms", where=str(path), todo="pip install nptdms"
        ) from error
    try:
        file = nptdms.TdmsFile.read(path)
    except (ValueError, OSError, KeyError) as error:
        raise InputError(
            f"is no TDMS file that can be read ({error})", where=str(path), todo="check it"
        ) from error
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
