"""What every plot needs: its axes, columns of its table, and the direction up."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError

COLOURS = ("#1f5fa8", "#c2570c", "#2e7d32", "#7b3fa0")
"""Of data, and of the components x, y, z."""

MUTED = "#8a8f98"


_MANY_COLOURS = (*COLOURS, "#0a8f8f", "#b8860b", "#ad1457", "#5d4037", "#455a64", "#7cb342")


def colour_of(k: int) -> str:
    """Return the colour of the k-th of many groups; they repeat after ten."""
    return _MANY_COLOURS[k % len(_MANY_COLOURS)]


def axes_of(axes: Any, **settings: Any) -> Any:
    """Return the given axes, or new ones, with settings; ``projection`` "3d" makes them 3-D."""
    if axes is None:
        import matplotlib.pyplot as plt

        _, axes = plt.subplots(subplot_kw={"projection": settings.pop("projection", None)})
    settings.pop("projection", None)
    axes.set(**settings)
    return axes


def columns_of(table: pd.DataFrame, *names: str, made_by: str) -> list[Array]:
    """Return columns of a table as numbers. Raises InputError for a missing one."""
    out = []
    for name in names:
        if name not in getattr(table, "columns", ()):
            what = f"the {type(table).__name__} has no column {name}"
            raise InputError(what, where="telerig.plot", todo=f"give {made_by}")
        out.append(table[name].to_numpy(float))
    return out


def finite(*columns: Array) -> list[Array]:
    """Return the rows in which all columns are finite. Raises InputError for none."""
    good = np.isfinite(np.stack(columns)).all(0)
    if not good.any():
        todo = "see `telerig.bubble_table`: some columns need [fluid] in rig.toml, or outlines"
        raise InputError("there is nothing to draw", where="telerig.plot", todo=todo)
    return [column[good] for column in columns]


def height_and_sides(table: pd.DataFrame, pattern: str, y_up: bool) -> list[tuple[str, Array]]:
    """(name, values) of three components for drawing: both horizontal ones, then the vertical, in
    an order that is right-handed, so that helices keep their sense.

    pattern : of the columns' names, like "{}_mm". y_up : the vertical is the height, -y, which is
    positive upwards; otherwise y, which points down in the frame of a camera that stands upright.
    """
    x, y, z = columns_of(table, *(pattern.format(a) for a in "xyz"), made_by="trajectories")
    if y_up:
        return [("x", x), ("z", z), ("height", -y)]
    return [("z", z), ("x", x), ("y", y)]
