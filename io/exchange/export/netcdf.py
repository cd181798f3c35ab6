"""Write trajectories as NetCDF by the CF conventions: a contiguous ragged array of trajectories.

CF-1.8, section 9.3.3 and appendix H.4.3. The file is NetCDF-3 with 64-bit offsets, which SciPy
writes without a further dependency and every NetCDF program reads. It has no compression, and whole
numbers of 32 bits only. `to_xarray` gives the same content in memory.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.exchange.export.run_results import (
    RunResults,
    column_of_that_name,
    facts,
    numbered,
    unit_of,
)
from telerig.io.files.atomic import atomic_path
from telerig.io.tables.run import TRACKS
from telerig.io.tables.smoothing import TRAJECTORIES
from telerig.short_text import xarray_dataset

if TYPE_CHECKING:
    import xarray

_LARGEST = np.iinfo(np.int32).max
_NAMES = {"t_s": "time", "x_mm": "x", "y_mm": "y", "z_mm": "z"}
_DIRECTIONS = {
    "x_mm": "along x, right in the first camera's image",
    "y_mm": "along y, down in the first camera's image",
    "z_mm": "along z, away from the first camera",
}


@dataclass(frozen=True)
class Variable:
    """Hold a variable: the names of its dimensions, its values, and its attributes."""

    dimensions: tuple[str, ...]
    values: NDArray[Any]
    attributes: dict[str, Any]


def variables(results: RunResults) -> dict[str, Variable]:
    """Return the variables of a run, by name.

    Their dimensions are ``trajectory`` and ``obs`` (the rows); ``rowSize`` gives each trajectory's
    number of rows. Variables have the names of the table's columns, except time, x, y, z. Raises
    InputError for a further column of one of these names.
    """
    points = results.points
    numbers, names = numbered(points)
    starts = np.flatnonzero(np.r_[True, np.diff(numbers) != 0][: len(numbers)])
    sizes = np.diff(np.append(starts, len(points)))
    identity = {"cf_role": "trajectory_id", "long_name": "particle"}
    out = {"trajectory": Variable(("trajectory",), numbers[starts], identity)}
    if names:
        out["particle_name"] = Variable(("trajectory",), np.array(names, object), {})
    counted = {"long_name": "rows of this trajectory", "sample_dimension": "obs"}
    out["rowSize"] = Variable(("trajectory",), sizes, counted)
    for column in points.columns:
        if column == "particle":
            continue
        name = _NAMES.get(column, column)
        if name in out:
            raise column_of_that_name(name, results)
        out[name] = Variable(("obs",), points[column].to_numpy(), _attributes(column))
    return out


def _global_attributes(results: RunResults) -> dict[str, str]:
    return {
        "Conventions": "CF-1.8",
        "featureType": "trajectory",
        "title": f"Bubble trajectories of run {results.name}",
        **facts(results),
    }


def write_netcdf(results: RunResults, path: str | PathLike[str]) -> None:
    """Write a run's trajectories, the `variables`, to a NetCDF-3 file.

    Text is stored as characters of fixed width.
    Raises InputError for whole numbers beyond 32 bits, and when the file cannot be written.
    """
    from scipy.io import netcdf_file

    memory, content = io.BytesIO(), variables(results)
    with netcdf_file(memory, "w", version=2) as handle:
        file: Any = handle
        _describe(file, _global_attributes(results))
        file.createDimension("trajectory", len(content["trajectory"].values))
        file.createDimension("obs", len(results.points))
        for name, one in content.items():
            _put(file, name, one.dimensions, one.values, dict(one.attributes))
        file.flush()
        data = memory.getvalue()
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def to_xarray(results: RunResults, covariance_mm2: Array | None = None) -> xarray.Dataset:
    """Return a run's trajectories, the `variables`, as an `xarray.Dataset`.

    covariance_mm2 : (N, 3, 3) covariances of the N positions; None takes the columns sxx_mm2,
        sxy_mm2, ... of the table, if it has them, which are then left out. They become the variable
        ``covariance`` (obs, axis, axis_of).
    The particle of each row is the coordinate ``particle``; the rows are sorted by particle and
    frame.
    Raises InputError if xarray is not installed.
    """
    points = results.points.reset_index(drop=True)
    order = points.sort_values(["particle", "frame"], kind="stable").index
    points = points.loc[order].reset_index(drop=True)
    columns = [f"s{'xyz'[min(i, j)]}{'xyz'[max(i, j)]}_mm2" for i in range(3) for j in range(3)]
    covariance = covariance_mm2
    if covariance is not None:
        covariance = covariance[order]
    elif set(columns) <= set(points):
        covariance = points[columns].to_numpy(float).reshape(-1, 3, 3)
        points = points.drop(columns=list(dict.fromkeys(columns)))
    content = variables(replace(results, points=points))
    if covariance is not None:
        words = {"units": "mm2", "long_name": "covariance of the position"}
        content["covariance"] = Variable(("obs", "axis", "axis_of"), covariance, words)
    data = xarray_dataset(
        {name: (one.dimensions, one.values, one.attributes) for name, one in content.items()},
        {} if covariance is None else {"axis": list("xyz"), "axis_of": list("xyz")},
        _global_attributes(results),
    )
    particle = ("obs", points["particle"].to_numpy(), {"long_name": "particle"})
    return data.assign_coords(particle=particle).set_coords(["time", "x", "y", "z", "frame"])


def _attributes(column: str) -> dict[str, Any]:
    known = TRAJECTORIES.column(column) or TRACKS.column(column)
    words = known.what if known and known.what else column.replace("_", " ")
    if column in _DIRECTIONS:
        words += f", {_DIRECTIONS[column]}"
    if column == "t_s":
        return {
            "standard_name": "time",
            "long_name": f"{words}, which has no date",
            "units": "s",  # "seconds" would become time differences in xarray, "since" dates
            "axis": "T",
        }
    out = {"units": unit_of(column), "long_name": words}
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
    _describe(variable, notes)


def _describe(thing: Any, attributes: dict[str, Any]) -> None:
    """Give a file or a variable its attributes; texts as UTF-8, since SciPy writes only ASCII."""
    for key, value in attributes.items():
        setattr(thing, key, value.encode("utf-8") if isinstance(value, str) else value)
