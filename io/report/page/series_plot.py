"""Long series with bands, drawn so that they stay small and lose no excursion."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.page.figures import png, svg

Array = NDArray[np.float64]

SMOOTHED, NAIVE, RTS = "#1f5fa8", "#9aa0a8", "#c2570c"
BAND_SDS = 2
_BINS = 450
_MANY = 1_500
_SHADES = 64
_DPI = 190
_ROOM = 0.035


def thin_line(t_s: Array, values: Array) -> tuple[Array, Array]:
    """Least and greatest value of each of `_BINS` stretches, where there are more points.

    A stretch without a finite value breaks the line.
    """
    if len(t_s) <= 2 * _BINS:
        return t_s, values
    starts = _starts(len(t_s))
    low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    return np.repeat(t_s[starts], 2), np.stack([low, high], 1).ravel()


def thin_band(t_s: Array, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """The widest band of each stretch."""
    if len(t_s) <= 2 * _BINS:
        return t_s, low, high
    starts = _starts(len(t_s))
    return t_s[starts], np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)


def _starts(count: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count, _BINS, endpoint=False).astype(np.int64))


def line(axes: Any, t_s: Array, values: Array, colour: str, label: str = "", **how: Any) -> None:
    """``values`` against time; nothing where none is finite."""
    if np.isfinite(values).any():
        axes.plot(*thin_line(t_s, values), color=colour, label=label, **({"linewidth": 0.9} | how))


def band(axes: Any, t_s: Array, centre: Array, sd: Array, colour: str, label: str = "") -> None:
    """``centre`` ± `BAND_SDS` sd as a surface."""
    if not np.isfinite(sd).any():
        return
    far = BAND_SDS * sd
    axes.fill_between(*thin_band(t_s, centre - far, centre + far), color=colour, alpha=0.25,
                      linewidth=0, label=label)  # fmt: skip


def room_left(axes: Any) -> None:
    """For numbers of four digits beside the axis; times are written out."""
    if axes.get_xscale() == "linear":
        axes.ticklabel_format(axis="x", useOffset=False)
    box = axes.get_position()
    axes.set_position((box.x0 + _ROOM, box.y0, box.width - _ROOM, box.height))


def above(axes: Any, *, inverted: bool = False) -> None:
    """The legend over the lines, with room for it; ``inverted`` turns the axis round as well."""
    low, high = axes.get_ylim()
    room = 0.17 * (high - low)
    axes.set_ylim(*((high, low - room) if inverted else (low, high + room)))
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="upper left", ncols=4, columnspacing=1.0, handlelength=1.2,
                    borderaxespad=0.1)  # fmt: skip


def source_of(figure: Any, points: int) -> str:
    """Shapes for short series, pixels for long ones."""
    return png(figure, dpi=_DPI, colours=_SHADES) if points > _MANY else svg(figure)


def limits(*series: Array, beyond: float = 0.08) -> tuple[float, float] | None:
    """What holds all finite values and a little more; None without any."""
    finite = np.concatenate([s[np.isfinite(s)] for s in series])
    if not len(finite):
        return None
    low, high = float(finite.min()), float(finite.max())
    room = beyond * (high - low) or 1e-3 * (abs(high) or 1.0)
    return low - room, high + room
