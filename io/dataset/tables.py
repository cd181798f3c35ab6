"""The tables of a dataset, checked against its rig."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from telerig.errors import InputError, suggestion
from telerig.io.files.csv_table import Column, read_table, rows_of
from telerig.io.rig_file.description import RigDescription
from telerig.io.rig_file.target import FARTHEST
from telerig.rig.target import Target

AnySource = TypeVar("AnySource", bound=str)

DEFAULT_SIGMA_PX = 0.02
"""Standard deviation of a dot's centre where the table does not state it."""

OUTSIDE_PX = 3.0
"""A centre may lie this far outside the image: rounding, half-seen dots, an earlier crop."""

COVARIANCE = ["suu_px2", "suv_px2", "svv_px2"]
DOTS_COLUMNS = ["view", "camera", "dot", "row", "column", "u_px", "v_px", *COVARIANCE]


def choose_source(
    has: Mapping[AnySource, bool], source: str | None, folder: Path
) -> AnySource | None:
    """The source of measurements to use: the one asked for, else the only one; None: not there.

    has : whether the folder has images or a table, by the words that ``source`` may be.
    Raises InputError for another word, and for two sources of which none was asked for.
    """
    first, second = has
    if source is not None and source not in has:
        todo = f'give "{first}" or "{second}" (--from)'
        raise InputError(f"source is {source!r}", where=str(folder), todo=todo)
    found = [s for s in has if has[s] and source in (None, s)]
    if len(found) > 1:
        raise InputError(
            f"holds both {first} and {second}.csv, and nothing says which to use",
            where=str(folder),
            todo=f"choose with --from {first} or --from {second}",
        )
    return found[0] if found else None


def read_dots_csv(path: str | PathLike[str], rig: RigDescription) -> pd.DataFrame:
    """The dots of `calibration/dots.csv`, or of `results/calibration/dots.csv`.

    Columns `DOTS_COLUMNS` (and chi2_dof if the file has it): view and camera text; dot the id of
    `rig.target`, also on an unbounded grid, where the file's own dot is opaque and row, column
    count; covariance from suu_px2, suv_px2, svv_px2, else sigma_px, else `DEFAULT_SIGMA_PX`;
    ``attrs["sigma_known"]`` says whether the file stated it. Rows keep the file's order.
    Raises InputError, with the row (header = 1) and the column, for anything that cannot be.
    """
    file = Path(path)
    table = read_table(file, _columns(rig.target))
    check_cameras(table, list(rig.cameras), file)
    check_pixels(table, {name: c.image_size_px for name, c in rig.cameras.items()}, file)
    if rig.target.bounded:
        _check_dots(table, rig.target, file)
    else:
        # The ids of `Target` in place of the file's opaque ones, from row and column.
        todo = f"rows and columns count from the origin mark, within +-{FARTHEST}"
        for column in ("row", "column"):
            far = table[column].abs().to_numpy() > FARTHEST
            rows_of(table, file).refuse(far, column, "is too far from the origin mark", todo)
        table["dot"] = rig.target.id_from_row_column(table["row"], table["column"])
    _check_repeats(table, rig.target, file)
    known = fill_covariance(table, file, DEFAULT_SIGMA_PX, of="the dot's centre")
    columns = DOTS_COLUMNS + [name for name in ("chi2_dof",) if name in table]
    dots = table[columns].reset_index(drop=True)
    dots.attrs["sigma_known"] = known
    return dots


def _columns(target: Target) -> list[Column]:
    unbounded = not target.bounded
    return [
        Column("view", "text"),
        Column("camera", "text"),
        Column("dot", "text" if unbounded else "whole", blank=unbounded),
        Column("u_px"),
        Column("v_px"),
        Column("sigma_px", required=False),
        Column("row", "whole", required=unbounded),
        Column("column", "whole", required=unbounded),
        *(Column(name, required=False) for name in COVARIANCE),
        Column("chi2_dof", required=False, blank=True),
    ]


def check_cameras(table: pd.DataFrame, names: list[str], file: Path) -> None:
    """Raise InputError for the first row whose camera is not one of ``names``."""
    check_names(table, "camera", "camera", names, file)


def check_names(table: pd.DataFrame, column: str, thing: str, names: list[str], file: Path) -> None:
    """Raise InputError for the first row whose cell in ``column`` is not one of ``names``."""
    unknown = ~table[column].isin(names).to_numpy()
    name = str(table[column][unknown].iloc[0]) if unknown.any() else ""
    todo = suggestion(name, names) if names else f"add a table [{thing}s.{name}]"
    what = f"there is no {thing} {name!r} in rig.toml"
    rows_of(table, file).refuse(unknown, column, what, todo)


def check_pixels(table: pd.DataFrame, sizes_px: Mapping[str, tuple[int, int]], file: Path) -> None:
    """Raise InputError for the first row whose pixel lies outside its camera's image."""
    sizes = np.array([sizes_px[name] for name in table["camera"]], float).reshape(-1, 2)
    for column, size in zip(("u_px", "v_px"), sizes.T):
        _check_inside(table, column, size, file)


def _check_inside(table: pd.DataFrame, column: str, size: Any, file: Path) -> None:
    value = table[column].to_numpy()
    rows_of(table, file).refuse(
        (value < -0.5 - OUTSIDE_PX) | (value > size - 0.5 + OUTSIDE_PX),
        column,
        lambda i: f"is {value[i]:g}, outside the image of {size[i]:.0f} px",
        "correct the cell, or image_size_px = [width, height] in rig.toml",
    )


def _check_dots(table: pd.DataFrame, target: Target, file: Path) -> None:
    """Check the ids; check row and column against them, or fill them in."""
    dot, ids = table["dot"].to_numpy(), target.ids()
    numbers = f"its {len(ids)} dots are numbered from {ids.min()} to {ids.max()}"
    rows_of(table, file).refuse(
        ~target.known_id(dot),
        "dot",
        lambda i: f"is {dot[i]}, which the target of rig.toml does not have",
        numbers + (", missing marks left out" if target.mark_style == "missing" else ""),
    )
    for column, expected in zip(("row", "column"), target.row_column_from_id(dot)):
        if column in table:
            _check_place(table, column, expected, file)
        table[column] = expected


def _check_place(table: pd.DataFrame, column: str, expected: Any, file: Path) -> None:
    given, dot = table[column].to_numpy(), table["dot"].to_numpy()
    rows_of(table, file).refuse(
        given != expected,
        column,
        lambda i: f"is {given[i]}, but dot {dot[i]} lies in {column} {expected[i]}",
        "dot = row * columns + column, from 0; correct one of them, or rig.toml",
    )


def _check_repeats(table: pd.DataFrame, target: Target, file: Path) -> None:
    keys = ["view", "camera", "dot"]
    again = table.duplicated(keys).to_numpy()
    if not again.any():
        return
    this = table[again].iloc[0]
    earlier = table.index[(table[keys] == this[keys]).all(axis=1)][0]
    place = f"at row {this['row']}, column {this['column']}"
    dot = f"dot {this['dot']}" if target.bounded else f"the dot {place}"
    what = f"{dot} of view {this['view']!r}, camera {this['camera']!r} is in row {earlier} already"
    rows_of(table, file).refuse(again, "dot", what, "keep one of the two rows")


def fill_covariance(table: pd.DataFrame, file: Path, default_sigma_px: float, *, of: str) -> bool:
    """Set the covariance columns from what the file has; whether it stated the noise.

    of : what the standard deviation belongs to, for errors. Raises InputError for what is no
    covariance.
    """
    given = [name for name in COVARIANCE if name in table]
    if 0 < len(given) < 3:
        missing = ", ".join(name for name in COVARIANCE if name not in table)
        raise InputError(
            f"has {', '.join(given)} without {missing}",
            where=f"{file} row 1",
            todo="give all three columns, or sigma_px alone",
        )
    if given:
        uu, uv, vv = (table[name].to_numpy() for name in COVARIANCE)
        rows_of(table, file).refuse(
            (uu <= 0) | (vv <= 0) | (uu * vv <= uv**2),
            "suu_px2",
            lambda i: f"[[{uu[i]:g}, {uv[i]:g}], [{uv[i]:g}, {vv[i]:g}]] is no covariance",
            "variances must be positive and suu svv > suv^2",
        )
        return True
    known = "sigma_px" in table
    sigma = table["sigma_px"].to_numpy() if known else np.full(len(table), default_sigma_px)
    rows_of(table, file).refuse(
        sigma <= 0,
        "sigma_px",
        lambda i: f"is {sigma[i]:g}, not positive",
        f"give the standard deviation of {of}, or leave the column out",
    )
    table["suu_px2"], table["suv_px2"], table["svv_px2"] = sigma**2, 0.0 * sigma, sigma**2
    return known
