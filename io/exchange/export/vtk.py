"""Write a run for ParaView and other programs of VTK: bubbles frame by frame, and their paths.

The files are VTK's XML formats for polygonal data (.vtp) and for a series in time (.pvd), with
numbers in base64; VTK itself is not needed to write them.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.exchange.export.run_results import RunResults, facts, numbered
from telerig.io.files.atomic import atomic_folder
from telerig.io.results.bodies import ellipsoids_of

SERIES, PATHS = "bubbles.pvd", "paths.vtp"
_FRAMES = "frames"
_VECTORS = {"velocity_mm_s": "v{}_mm_s", "acceleration_mm_s2": "a{}_mm_s2", "sd_mm": "s{}_mm"}
_TYPES = {"f": "Float64", "i": "Int64", "u": "UInt8"}
_POINT = ["x_mm", "y_mm", "z_mm"]


def write_vtk(results: RunResults, out: str | PathLike[str]) -> None:
    """Write `bubbles.pvd`, `frames/*.vtp` and `paths.vtp` into the folder ``out``.

    Each frame has one point per bubble, in mm, with its particle, further numbers, the vectors
    velocity, acceleration and standard deviation as far as they are known, and the tensor
    ``diameters_mm``. Its eigenvalues are the diameters of the bubble and its eigenvectors their
    directions: VTK's tensor glyph of a sphere with the radius 0.5 is the bubble. It is an ellipsoid
    where the bubble's shape is known, else a sphere of equal volume. The paths are one
    line per bubble. Files of an earlier export with other frames are removed.

    Raises InputError for a folder ``out`` that holds other files, and when it cannot be written.
    """
    points, folder = results.points, Path(out)
    _check_ours(folder)
    frames, t_s = _times(results)
    numbers, _ = numbered(points)
    arrays = _point_arrays(points, numbers, _diameters(results))
    names = [f"{_FRAMES}/bubbles_{frame:06}.vtp" for frame in frames]
    comment = "\n".join(f"{key}: {value}" for key, value in facts(results).items())
    order = np.argsort(points["frame"].to_numpy(), kind="stable")
    bounds = np.searchsorted(points["frame"].to_numpy()[order], [*frames, frames[-1] + 1])
    xyz = points[_POINT].to_numpy(float)
    with atomic_folder(folder) as place:
        (place / _FRAMES).mkdir()
        for name, first, last in zip(names, bounds, bounds[1:]):
            rows = order[first:last]
            mine = {key: values[rows] for key, values in arrays.items()}
            (place / name).write_text(
                _vtp(xyz[rows], mine, "Verts", np.ones(len(rows), np.int64)), "utf-8"
            )
        sizes = np.diff(np.flatnonzero(np.r_[True, np.diff(numbers) != 0, True]))
        along = {"particle": numbers, "t_s": points["t_s"].to_numpy(float)}
        (place / PATHS).write_text(_vtp(xyz, along, "Lines", sizes), "utf-8")
        (place / SERIES).write_text(_pvd(names, t_s, comment), encoding="utf-8")
    for old in (folder / _FRAMES).glob("bubbles_*.vtp"):
        if f"{_FRAMES}/{old.name}" not in names:
            old.unlink()


def _check_ours(folder: Path) -> None:
    """Raise InputError for a folder with files but without those of an earlier export."""
    if folder.is_dir() and any(folder.iterdir()) and not (folder / SERIES).is_file():
        raise InputError(
            "is a folder with other files", where=str(folder), todo="give --out a new folder"
        )


def _times(results: RunResults) -> tuple[list[int], Array]:
    """Return all frames from the first to the last with a bubble, and their times in s."""
    seen = results.points.drop_duplicates("frame").sort_values("frame")
    frames = np.arange(seen["frame"].iloc[0], seen["frame"].iloc[-1] + 1)
    table = seen if results.shake is None else results.shake
    return frames.tolist(), np.interp(frames, table["frame"], table["t_s"])


def _diameters(results: RunResults) -> Array | None:
    """Return the tensors (N, 3, 3) in mm; None where the run does not tell the bubbles' sizes."""
    points = results.points if results.smoothing is None else results.smoothing.shaped
    if "d_eq_mm" not in points:
        return None
    quadrics, _ = ellipsoids_of(points)
    known = np.isfinite(quadrics).all((1, 2))
    out = np.zeros_like(quadrics)
    squares, axes = np.linalg.eigh(quadrics[known])
    out[known] = 2 * (axes * np.sqrt(squares.clip(0))[:, None]) @ np.swapaxes(axes, 1, 2)
    return out


def _point_arrays(
    points: pd.DataFrame, numbers: NDArray[np.int64], diameters: Array | None
) -> dict[str, NDArray[np.generic]]:
    """Return the arrays of all points: particle, scalars, vectors (N, 3) and tensors (N, 9)."""
    out: dict[str, NDArray[np.generic]] = {"particle": numbers}
    parts = set(_POINT)
    for name, pattern in _VECTORS.items():
        columns = [pattern.format(axis) for axis in "xyz"]
        if set(columns) <= set(points):
            out[name] = points[columns].to_numpy(float)
            parts |= set(columns)
    for column in points.columns:
        kind = points[column].dtype.kind
        if column not in {*parts, "particle"} and kind in "fib":
            out[str(column)] = points[column].to_numpy(float if kind == "f" else np.int64)
    if diameters is not None:
        out["diameters_mm"] = diameters.reshape(-1, 9)
    return out


def _vtp(
    points_mm: Array,
    arrays: Mapping[str, NDArray[np.generic]],
    cells: str,
    sizes: NDArray[np.int64],
) -> str:
    """Return a .vtp file: points, arrays of the points, and cells of consecutive points.

    cells : "Verts" or "Lines".  sizes : (C,) number of points of each cell.
    """
    known = [name for name in ("velocity_mm_s",) if name in arrays]
    active = 'Scalars="particle"' + "".join(f' Vectors="{name}"' for name in known)
    active += ' Tensors="diameters_mm"' if "diameters_mm" in arrays else ""
    count = np.arange(len(points_mm), dtype=np.int64)
    return "\n".join([
        '<?xml version="1.0"?>',
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        "<PolyData>",
        f'<Piece NumberOfPoints="{len(points_mm)}" NumberOf{cells}="{len(sizes)}">',
        "<Points>", _array("Points", points_mm), "</Points>",
        f"<PointData {active}>",
        *(_array(name, values) for name, values in arrays.items()),
        "</PointData>",
        f"<{cells}>", _array("connectivity", count), _array("offsets", np.cumsum(sizes)),
        f"</{cells}>",
        "</Piece>", "</PolyData>", "</VTKFile>", "",
    ])  # fmt: skip


def _array(name: str, values: NDArray[np.generic]) -> str:
    """Return a DataArray element: the number of bytes (8 bytes) and the bytes, in base64."""
    data = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()
    code = base64.b64encode(len(data).to_bytes(8, "little") + data).decode()
    width = f' NumberOfComponents="{values.shape[1]}"' if values.ndim == 2 else ""
    kind = _TYPES[values.dtype.kind]
    return (
        f'<DataArray type="{kind}" Name={quoteattr(name)}{width} format="binary">{code}</DataArray>'
    )


def _pvd(names: Sequence[str], t_s: Array, comment: str) -> str:
    """Return the .pvd file of a series: the time of each file, with paths relative to it."""
    lines = (f'<DataSet timestep="{t:.15g}" part="0" file="{n}"/>' for n, t in zip(names, t_s))
    return "\n".join([
        '<?xml version="1.0"?>',
        "<!-- " + re.sub("-(?=-)", "- ", comment) + " -->",
        '<VTKFile type="Collection" version="1.0" byte_order="LittleEndian">',
        "<Collection>", *lines, "</Collection>", "</VTKFile>", "",
    ])  # fmt: skip
