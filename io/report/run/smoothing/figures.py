"""Pictures of the smoothed motion: places and velocities with bands, and what was taken away."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.page.figures import LEFT_OUT, Picture, drawing
from telerig.io.report.page.number_format import number
from telerig.io.report.page.series_plot import (
    NAIVE,
    RTS,
    SMOOTHED,
    above,
    band,
    limits,
    line,
    room_left,
    source_of,
)
from telerig.io.report.run.smoothing.numbers import column
from telerig.io.report.run.smoothing.results import AXES, PLACE, SPEED, SmoothingResults
from telerig.io.report.run.tracking.numbers import median, rms
from telerig.io.report.run.tracking.scene import track_colour

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

_MOST_BUBBLES = 60
_FEW = 3
_WINDOW = 1_000
_CLOSE = 60
_BANDS = "Bands are ± 2 sd."


def places(results: SmoothingResults, axis: int) -> Picture:
    """One lab coordinate of every bubble; up is up. Naive and RTS beneath where bubbles are few."""
    shown = results.bubbles[:_MOST_BUBBLES]
    name, points, few = PLACE.format(AXES[axis]), 0, len(shown) <= _FEW
    with drawing(2.6) as (figure, axes):
        for i, particle in enumerate(shown):
            table = results.track(particle)
            t, value = table["t_s"].to_numpy(float), column(table, name)
            if few:
                line(axes, t, column(table, f"naive_{name}"), NAIVE, "" if i else "naive")
                line(axes, t, column(table, f"rts_{name}"), RTS, "" if i else "RTS", linewidth=0.6)
            band(axes, t, value, column(table, f"s{name}"), track_colour(particle))
            line(axes, t, value, track_colour(particle), "" if i else "smoothed")
            points += (4 if few else 2) * len(t)
        axes.set(xlabel="t / s", ylabel=f"lab {AXES[axis]} / mm")
        room_left(axes)
        if few:
            above(axes, inverted=results.up[axis] < -0.5)
        elif results.up[axis] < -0.5:
            axes.invert_yaxis()
        axes.grid(True)
        source = source_of(figure, points)
    caption = "The axis is turned round, so that up is up. " if results.up[axis] < -0.5 else ""
    sd = median(column(results.trajectories, f"s{name}"))
    caption += f"A colour per bubble. {_BANDS} The sd is {_um(sd)} (median): look closer below."
    if len(shown) < len(results.bubbles):
        caption += f" The {len(shown)} longest of {number(len(results.bubbles))} are drawn."
    return Picture(f"{AXES[axis]} against time", source, caption)


def closer(results: SmoothingResults, axis: int) -> Picture:
    """Some frames of the longest track's middle without their straight line."""
    table, _ = detail(results)
    first = max(0, (len(table) - _CLOSE) // 2)
    table = table.iloc[first : first + _CLOSE]
    name, t = PLACE.format(AXES[axis]), table["t_s"].to_numpy(float)
    smooth, naive, rts = (column(table, kind + name) for kind in ("", "naive_", "rts_"))
    straight = _straight(t, smooth)
    with drawing(2.6) as (figure, axes):
        dots = {"linestyle": "none", "marker": ".", "markersize": 4}
        line(axes, t, naive - straight, NAIVE, "naive", **dots)
        line(axes, t, rts - straight, RTS, "RTS")
        band(axes, t, smooth - straight, column(table, f"s{name}"), SMOOTHED, "± 2 sd")
        line(axes, t, smooth - straight, SMOOTHED, "smoothed")
        _unobserved(axes, table)
        axes.set(xlabel="t / s", ylabel=f"lab {AXES[axis]}, less a line / mm")
        room_left(axes)
        above(axes, inverted=results.up[axis] < -0.5)
        axes.grid(True)
        source = source_of(figure, 4 * len(t))
    slope = (straight[-1] - straight[0]) / (t[-1] - t[0]) if len(t) > 1 else 0.0
    caption = (
        f"Bubble {results.bubbles[0]}, {number(len(t))} frames of its middle, without a straight "
        f"line of {number(float(slope), 3)} mm/s. {_BANDS}{_marks(table)}"
    )
    return Picture(f"{AXES[axis]}, closer", source, caption)


def taken_off(results: SmoothingResults, axis: int) -> Picture:
    """Naive and RTS minus smoothed, against the smoothed band."""
    table, where = detail(results)
    name = PLACE.format(AXES[axis])
    t, smooth = table["t_s"].to_numpy(float), column(table, name)
    sd = 1e3 * column(table, f"s{name}")
    naive, rts = (1e3 * (column(table, kind + name) - smooth) for kind in ("naive_", "rts_"))
    with drawing(2.6) as (figure, axes):
        _three(axes, t, [np.zeros(len(t)), naive, rts], sd)
        _unobserved(axes, table)
        axes.set(xlabel="t / s", ylabel=f"{AXES[axis]}, less smoothed / µm")
        found = limits(naive, rts, 2 * sd, -2 * sd)
        if found:
            axes.set_ylim(*found)
        axes.grid(True)
        room_left(axes)
        above(axes)
        source = source_of(figure, 4 * len(t))
    off, own = rms(naive), median(sd)
    times = f", {number(off / own, 2)} times the sd of smoothed" if off and own else ""
    caption = (
        f"Naive minus smoothed is {number(off, 3)} µm RMS{times}; RTS minus smoothed is "
        f"{number(rms(rts), 3)} µm. {_BANDS}{_marks(table)} {where}"
    )
    return Picture(f"{AXES[axis]}: what smoothing took off", source, caption)


def velocities(results: SmoothingResults, axis: int) -> Picture:
    """The longest track's velocity: smoothed with its band, naive, RTS."""
    table, where = detail(results)
    name = SPEED.format(AXES[axis])
    t = table["t_s"].to_numpy(float)
    smooth, naive, rts = (column(table, kind + name) for kind in ("", "naive_", "rts_"))
    sd = column(table, f"s{name}")
    with drawing(2.6) as (figure, axes):
        _three(axes, t, [smooth, naive, rts], sd)
        _unobserved(axes, table)
        axes.set(xlabel="t / s", ylabel=f"v{AXES[axis]} / (mm/s)")
        room_left(axes)
        axes.grid(True)
        above(axes, inverted=results.up[axis] < -0.5)
        source = source_of(figure, 4 * len(t))
    caption = (
        f"Naive scatters by {number(rms(naive - smooth), 3)} mm/s RMS about smoothed, whose sd is "
        f"{number(median(sd), 3)} mm/s (median). {_BANDS}{_marks(table)} {where}"
    )
    if results.up[axis] < -0.5:
        caption += " The axis is turned round, so that up is up."
    return Picture(f"Velocity in {AXES[axis]}", source, caption)


def detail(results: SmoothingResults) -> tuple[pd.DataFrame, str]:
    """The longest track, its middle where it is very long; and which that is, in words."""
    particle = results.bubbles[0]
    table = results.track(particle)
    what = f"Bubble {particle}"
    if len(results.bubbles) > 1:
        what += ", the longest track"
    if len(table) <= _WINDOW:
        return table, f"{what}."
    first = (len(table) - _WINDOW) // 2
    return table.iloc[first : first + _WINDOW], f"{what}, {number(_WINDOW)} frames of its middle."


def _three(axes: Any, t: Array, values: list[Array], sd: Array) -> None:
    """Smoothed, naive, RTS in this order, smoothed on top."""
    smooth, naive, rts = values
    line(axes, t, naive, NAIVE, "naive", linewidth=0.7)
    line(axes, t, rts, RTS, "RTS", linewidth=0.9)
    band(axes, t, smooth, sd, SMOOTHED, "± 2 sd")
    line(axes, t, smooth, SMOOTHED, "smoothed", linewidth=1.1)


def _straight(t: Array, values: Array) -> Array:
    there = np.isfinite(values)
    if there.sum() < 2:
        return np.full(len(t), median(values) or 0.0)
    return np.asarray(np.polyval(np.polyfit(t[there] - t[0], values[there], 1), t - t[0]))


def _unobserved(axes: Any, table: pd.DataFrame) -> None:
    missing = column(table, "observed") == 0
    t = table["t_s"].to_numpy(float)[missing]
    axes.plot(t, np.full(len(t), 0.015), "|", color=LEFT_OUT, markersize=5,
              transform=axes.get_xaxis_transform(), zorder=5)  # fmt: skip


def _marks(table: pd.DataFrame) -> str:
    missing = int(np.sum(column(table, "observed") == 0))
    return f" Red ticks: {number(missing)} frames without an image of it." if missing else ""


def _um(sd_mm: float | None) -> str:
    return f"{number(None if sd_mm is None else 1e3 * sd_mm, 3)} µm"
