"""Write trajectories as NetCDF by the CF conventions: a contiguous ragged array of trajectories.

CF-1.8, section 9.3.3 and appendix H.4.3. The file is NetCDF-3 with 64-bit offsets, which SciPy
writes without a further dependency and every NetCDF program reads. It has no compression, and whole
numbers of 32 bits only.
"""

from __future__ import annotations

import io
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.io.exchange.export.run_results import RunResults, facts, numbered, unit_of
from telerig.io.files.atomic import atomic_path

_LARGEST = np.iinfo(np.int32).max
_NAMES = {"t_s": "time", "x_mm": "x", "y_mm": "y", "z_mm": "z"}
_WORDS = {
    "t_s": "time of mid-exposure",
    "x_mm": "position along x, right in the first camera's image",
    "y_mm": "position along y, down in the first camera's image",
    "z_mm": "position along z, away from the first camera",
    "frame": "index of the frame, from 0",
    "observed": "1 where the bubble was detected in the frame",
}


def write_netcdf(results: RunResults, path: str | PathLike[str]) -> None:
    """Write a run's trajectories to a NetCDF-3 file.

    Its dimensions are ``trajectory`` and ``obs`` (the rows); ``rowSize`` gives each trajectory's
    number of rows. Variables have the names of the table's columns, except time, x, y, z. Text is
    stored as characters of fixed width.
    Raises InputError for whole numbers beyond 32 bits, and when the file cannot be written.
    """
    from scipy.io import netcdf_file

    points = results.points
    numbers, names = numbered(points)
    starts = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
    memory = io.BytesIO()
    with netcdf_file(memory, "w", version=2) as handle:
        file: Any = handle
        file.Conventions, file.featureType = "CF-1.8", "trajectory"
        file.title = f"Bubble trajectories of run {results.name}"
        for key, value in facts(results).items():
            setattr(file, key, value)
        file.createDimension("trajectory", len(starts))
        file.createDimension("obs", len(points))
        identity = {"cf_role": "trajectory_id", "long_name": "particle"}
        _put(file, "trajectory", ("trajectory",), numbers[starts], identity)
        if names:
            _put(file, "particle_name", ("trajectory",), np.array(names, object), {})
        sizes = np.diff(np.append(starts, len(points)))
        counted = {"long_name": "rows of this trajectory", "sample_dimension": "obs"}
        _put(file, "rowSize", ("trajectory",), sizes, counted)
        for column in points.columns:
            if column != "particle":
                values = points[column].to_numpy()
                _put(file, _NAMES.get(column, column), ("obs",), values, _attributes(column))
        file.flush()
        content = memory.getvalue()
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def _attributes(column: str) -> dict[str, Any]:
    if column == "t_s":
        return {
            "standard_name": "time",
            "long_name": _WORDS[column],
            "units": "seconds since 1970-01-01 00:00:00",
            "calendar": "standard",
            "comment": "the recording's own clock: differences count, the date is a placeholder",
        }
    out = {"units": unit_of(column), "long_name": _WORDS.get(column, column.replace("_", " "))}
    return out if column in _NAMES else out | {"coordinates": "time x y z"}


def _put(
    file: Any, name: str, dimensions: tuple[str, ...], values: NDArray[Any], notes: dict[str, Any]
) -> None:
    if values.dtype == object:
        raw = np.array([str(v).encode("utf-8") for v in values])
        width = max(1, raw.dtype.itemsize)
        file.createDimension(f"{name}_width", width)
        characters = raw.astype(f"S{width}").view("S1").reshape(len(raw), width)
        variable = file.createVariable(name, "c", (*dimensions, f"{name}_width"))
        variable[:] = characters
        notes = {k: v for k, v in notes.items() if k != "units"} | {"_Encoding": "utf-8"}
    elif values.dtype.kind in "iub":
        if values.size and np.abs(values.astype(np.int64)).max() > _LARGEST:
            raise InputError(
                f"{name} holds whole numbers beyond 32 bits, which NetCDF-3 cannot store",
                todo="export to HDF5",
            )
        variable = file.createVariable(name, "i4", dimensions)
        variable[:] = values.astype(np.int32)
    else:
        variable = file.createVariable(name, "f8", dimensions)
        variable[:] = values.astype(float)
        notes = notes if name in ("time", "x", "y", "z") else notes | {"_FillValue": np.nan}
    for key, value in notes.items():
        setattr(variable, key, value)
