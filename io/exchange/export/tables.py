"""Write trajectories as HDF5, as MATLAB files and as tables for trackpy."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
import pandas as pd

from telerig.errors import InputError
from telerig.io.exchange.export.opencv import undistorted_matrix
from telerig.io.exchange.export.run_results import (
    RunResults,
    column_of_that_name,
    facts,
    identifier,
    numbered,
    unit_of,
)
from telerig.io.files.atomic import atomic_path
from telerig.io.files.csv_table import write_table
from telerig.io.files.hdf5 import hdf5_file
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import PARAMETERS


def write_hdf5(
    results: RunResults, path: str | PathLike[str], cameras: Sequence[Camera] = ()
) -> None:
    """Write an HDF5 file with the groups ``trajectories``, ``shake`` (if any) and ``cameras``.

    Each column of a table is a dataset with the attribute ``units``; cameras are in attributes.
    """
    import h5py

    with hdf5_file(path) as file:
        file.attrs.update(facts(results))
        for name, table in (("trajectories", results.points), ("shake", results.shake)):
            if table is None:
                continue
            group = file.create_group(name)
            group.attrs["columns"] = list(table.columns)
            for column in table.columns:
                values = table[column].to_numpy()
                kind = h5py.string_dtype() if values.dtype == object else values.dtype
                data = group.create_dataset(column, data=values, dtype=kind, compression="gzip")
                data.attrs["units"] = unit_of(column)
        for camera in cameras:
            group = file.create_group(f"cameras/{camera.name}")
            for key, value in _camera(camera).items():
                group.attrs[key] = value


def write_mat(
    results: RunResults, path: str | PathLike[str], cameras: Sequence[Camera] = ()
) -> None:
    """Write a MATLAB 5 file with the structs ``info``, ``trajectories``, ``shake`` and ``cameras``.

    Each column of a table is a field, named by `identifier`; text columns become cells. Raises
    InputError when two names become equal.
    """
    from scipy.io import savemat

    content: dict[str, Any] = {"info": facts(results), "trajectories": _fields(results.points)}
    if results.shake is not None:
        content["shake"] = _fields(results.shake)
    if cameras:
        content["cameras"] = _unique({c.name: _camera(c) for c in cameras})
    with atomic_path(path) as temporary:
        savemat(
            str(temporary), content, appendmat=False, long_field_names=True, do_compression=True,
            oned_as="column",
        )  # fmt: skip


def _fields(table: pd.DataFrame) -> dict[str, Any]:
    return _unique({str(column): table[column].to_numpy() for column in table.columns})


def _unique(content: dict[str, Any]) -> dict[str, Any]:
    out = {identifier(name): value for name, value in content.items()}
    if len(out) != len(content):
        raise InputError(
            f"some of these names would be the same in MATLAB: {', '.join(content)}",
            todo="export to HDF5, which MATLAB reads with h5read",
        )
    return out


def _camera(camera: Camera) -> dict[str, Any]:
    wall = {} if camera.wall is None else camera.wall.as_dict()
    return {
        "image_size_px": np.array(camera.image_size_px),
        "parameter_names": ", ".join(PARAMETERS),
        "parameters": camera.intrinsics,
        "rho_mm": camera.rho_mm,
        "rotation_camera_from_rig": camera.camera_from_rig.rotation,
        "translation_camera_from_rig_mm": camera.camera_from_rig.translation_mm,
        "undistorted_matrix": undistorted_matrix(camera),
        "pixel_origin": "centre of the top-left pixel is (0, 0)",
        **{f"wall_{name}": np.array(value) for name, value in wall.items()},
    }


def trackpy_table(results: RunResults) -> pd.DataFrame:
    """Return the trajectories with the columns frame, particle, x, y, z (mm), then all others.

    Named particles are numbered; the column ``particle_name`` keeps their names. Raises InputError
    for a further column of one of these names.
    """
    points = results.points
    numbers, names = numbered(points)
    table = points[["frame"]].assign(particle=numbers)
    for axis in "xyz":
        table[axis] = points[f"{axis}_mm"]
    if names:
        table["particle_name"] = points["particle"]
    others = [c for c in points if c not in ("frame", "particle", "x_mm", "y_mm", "z_mm")]
    for name in set(others) & set(table):
        raise column_of_that_name(str(name), results)
    return table.join(points[others]).sort_values(["frame", "particle"]).reset_index(drop=True)


def write_trackpy(results: RunResults, path: str | PathLike[str]) -> None:
    """Write `trackpy_table` as a CSV file. Raises InputError when it cannot be written."""
    write_table(trackpy_table(results), path)
