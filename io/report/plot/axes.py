"""What every plot needs: its axes, colours, columns of its table, curves with bands, directions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError

COLOURS = ("#1f5fa8", "#c2570c", "#2e7d32", "#7b3fa0")
"""Of cameras, and of the components x, y, z."""

KEPT, LEFT_OUT, MODEL, MUTED = "#1b7f3b", "#c62828", "#c62828", "#8a8f98"
SMOOTHED, NAIVE, RTS = "#1f5fa8", "#9aa0a8", "#c2570c"
BAND_SDS = 2

NO_TRACK = "#fabe14"
"""Of what belongs to no track, in images."""

_MANY_COLOURS = (*COLOURS, "#0a8f8f", "#b8860b", "#ad1457", "#5d4037", "#455a64", "#7cb342")


def colour_of(k: int) -> str:
    """Return the colour of the k-th of many groups or tracks; they repeat after ten."""
    return _MANY_COLOURS[k % len(_MANY_COLOURS)]


def rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of a colour like "#1f5fa8"."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def camera_colour(index: int) -> str:
    """Return the colour of a camera, by its number from 0."""
    return COLOURS[index % len(COLOURS)]


def axes_of(axes: Any, **settings: Any) -> Any:
    """Return the given axes, or new ones, with settings; ``projection`` "3d" makes them 3-D."""
    if axes is None:
        import matplotlib.pyplot as plt

        _, axes = plt.subplots(subplot_kw={"projection": settings.pop("projection", None)})
    settings.pop("projection", None)
    axes.set(**settings)
    return axes


def columns_of(table: pd.DataFrame, *names: str, made_by: str) -> list[Array]:
    """Return columns of a table as numbers. Raises InputError for one that is missing or text."""
    out = []
    for name in names:
        if name not in getattr(table, "columns", ()):
            what = f"the {type(table).__name__} has no column {name}"
            raise InputError(what, where="telerig.plot", todo=f"give {made_by}")
        try:
            out.append(table[name].to_numpy(float))
        except ValueError as error:
            what = f"the column {name} of the {type(table).__name__} is not of numbers: {error}"
            raise InputError(what, where="telerig.plot", todo="give numbers") from error
    return out


def column_or_none(table: pd.DataFrame, name: str) -> Array | None:
    """Return a column that has finite values; None without one."""
    values = table[name].to_numpy(float) if name in table else np.zeros(0)
    return values if np.isfinite(values).any() else None


def finite(*columns: Array) -> list[Array]:
    """Return the rows in which all columns are finite. Raises InputError for none."""
    good = np.isfinite(np.stack(columns)).all(0)
    if not good.any():
        raise nothing_to_draw(
            "see `telerig.bubble_table`: some columns need [fluid] in rig.toml, or outlines"
        )
    return [column[good] for column in columns]


def nothing_to_draw(todo: str) -> InputError:
    """Return the error of a figure that would be empty, which a page leaves out."""
    return InputError("there is nothing to draw", where="telerig.plot", todo=todo)


@dataclass(frozen=True)
class Curve:
    """A line (N,) of a plot, with a band of ± `BAND_SDS` sd (N,); style : as matplotlib has it."""

    x: Array
    y: Array
    colour: str
    label: str = ""
    sd: Array | None = None
    style: Mapping[str, Any] = field(default_factory=dict)


def draw_curves(axes: Any, curves: Iterable[Curve]) -> None:
    """Draw the curves that have finite values, each band below its line; each label stands once."""
    labels: set[str] = set()
    for curve in curves:
        fresh = curve.label if curve.label not in labels else ""
        if curve.sd is not None and np.isfinite(curve.sd).any():
            far = BAND_SDS * curve.sd
            axes.fill_between(
                curve.x, curve.y - far, curve.y + far, color=curve.colour, alpha=0.25, linewidth=0,
                label=f"± {BAND_SDS} sd" if fresh else "",
            )  # fmt: skip
        if np.isfinite(curve.y).any():
            style = {"linewidth": 0.9} | dict(curve.style)
            axes.plot(curve.x, curve.y, color=curve.colour, label=fresh, **style)
            labels.add(curve.label)


@dataclass(frozen=True)
class Vertical:
    """The vertical of a rig: axis number and sign, from a name like "-y"."""

    axis: int
    sign: float

    @classmethod
    def of(cls, up: str) -> Vertical:
        """Raises InputError for what is no axis."""
        if up.lstrip("+-") not in ("x", "y", "z") or len(up) > 2:
            todo = 'give one of "x", "-x", "y", "-y", "z", "-z"'
            raise InputError(f"up is {up!r}", where="telerig.plot", todo=todo)
        return cls("xyz".index(up[-1]), -1.0 if up[0] == "-" else 1.0)

    @property
    def order(self) -> tuple[int, int, int]:
        """Both horizontal axes and the vertical one, right-handed, so that helices keep theirs."""
        one, other = (self.axis + 1) % 3, (self.axis + 2) % 3
        return (one, other, self.axis) if self.sign > 0 else (other, one, self.axis)

    def name(self, axis: int) -> str:
        """Return the label of a rig axis (0, 1, 2): "height", or its letter."""
        return "height" if axis == self.axis else "xyz"[axis]

    def sign_of(self, axis: int) -> float:
        """Return the factor of a rig axis (0, 1, 2) that makes the height increase upwards."""
        return self.sign if axis == self.axis else 1.0


def axis_number(axis: str) -> int:
    """Return 0, 1 or 2. Raises InputError for what is no axis of the rig."""
    if axis not in ("x", "y", "z"):
        raise InputError(f"axis is {axis!r}", where="telerig.plot", todo='give "x", "y" or "z"')
    return "xyz".index(axis)


def image_axes(axes: Any, image_size_px: tuple[int, int] | None = None) -> Any:
    """Set axes to an image's: u right, v down, pixel (0, 0) the centre of the top left pixel."""
    axes.set(xlabel="u / px", ylabel="v / px", aspect="equal")
    if image_size_px is not None:
        width, height = image_size_px
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        axes.spines[["top", "right"]].set_visible(True)
    elif not axes.yaxis_inverted():
        axes.invert_yaxis()
    return axes
