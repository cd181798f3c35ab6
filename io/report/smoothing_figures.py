"""Pictures of the smoothed motion: places and velocities with bands, and what was taken away."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.figures_common import LEFT_OUT, Picture, drawing
from telerig.io.report.smoothing_drawing import (
    NAIVE,
    RTS,
    SMOOTHED,
    above,
    band,
    limits,
    line,
    source_of,
)
from telerig.io.report.smoothing_numbers import column
from telerig.io.report.smoothing_results import AXES, PLACE, SPEED, SmoothingResults
from telerig.io.report.track_numbers import median, rms
from telerig.io.report.track_scene import track_colour
from telerig.io.report.words import number

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

_MOST_BUBBLES = 60
_WINDOW = 1_000
_BANDS = "Bands are ± 2 sd."


def places(results: SmoothingResults, axis: int) -> Picture:
    """One lab coordinate of every bubble, smoothed; up is up."""
    shown = results.bubbles[:_MOST_BUBBLES]
    name, points = AXES[axis], 0
    with drawing(2.6) as (figure, axes):
        for particle in shown:
            table = results.track(particle)
            t, value = table["t_s"].to_numpy(float), column(table, PLACE.format(name))
            band(axes, t, value, column(table, f"s{PLACE.format(name)}"), track_colour(particle))
            line(axes, t, value, track_colour(particle))
            points += len(t)
        axes.set(xlabel="t / s", ylabel=f"{name} / mm, lab")
        caption = "Smoothed, in the lab; a colour per bubble. "
        if results.up[axis] < -0.5:
            axes.invert_yaxis()
            caption = "The axis is turned round, so that up is up. " + caption
        axes.grid(True)
        source = source_of(figure, points)
    sd = median(column(results.trajectories, f"s{PLACE.format(name)}"))
    caption += f"{_BANDS} The sd is {_um(sd)} (median): mostly thinner than the line."
    if len(shown) < len(results.bubbles):
        caption += f" The {len(shown)} longest of {number(len(results.bubbles))} are drawn."
    return Picture(f"{name} against time", source, caption)


def path_in_detail(results: SmoothingResults, axis: int) -> Picture | None:
    """The longest track without its straight line: smoothed, naive and RTS; None without any."""
    table, where = detail(results)
    if table is None:
        return None
    name = AXES[axis]
    t = table["t_s"].to_numpy(float)
    values = [column(table, kind + PLACE.format(name)) for kind in ("", "naive_", "rts_")]
    straight = _straight(t, values[0])
    flat = [value - straight for value in values]
    up = -1.0 if results.up[axis] < -0.5 else 1.0
    with drawing(2.6) as (figure, axes):
        _three(axes, t, [up * value for value in flat], column(table, f"s{PLACE.format(name)}"))
        _unobserved(axes, table)
        shown = (
            f"{name} minus straight line / mm"
            if up > 0
            else f"minus {name}, minus straight line / mm"
        )
        axes.set(xlabel="t / s", ylabel=shown)
        axes.grid(True)
        above(axes)
        source = source_of(figure, 4 * len(t))
    slope = (straight[-1] - straight[0]) / (t[-1] - t[0]) if len(t) > 1 else np.nan
    caption = (
        f"{where} A straight line of {number(float(slope), 3)} mm/s is taken off, to show "
        f"what stands out of it. {_BANDS}{_marks(table)}"
    )
    if up < 0:
        caption += " Turned round, so that up is up."
    return Picture(f"{name}, one bubble", source, caption)


def taken_off(results: SmoothingResults, axis: int) -> Picture | None:
    """Naive and RTS minus smoothed, against the smoothed band."""
    table, where = detail(results)
    if table is None:
        return None
    name = PLACE.format(AXES[axis])
    t, smooth = table["t_s"].to_numpy(float), column(table, name)
    sd = 1e3 * column(table, f"s{name}")
    naive, rts = (1e3 * (column(table, kind + name) - smooth) for kind in ("naive_", "rts_"))
    with drawing(2.6) as (figure, axes):
        _three(axes, t, [np.zeros(len(t)), naive, rts], sd)
        _unobserved(axes, table)
        axes.set(xlabel="t / s", ylabel=f"{AXES[axis]} minus smoothed / µm")
        found = limits(naive, rts, 2 * sd, -2 * sd)
        if found:
            axes.set_ylim(*found)
        axes.grid(True)
        above(axes)
        source = source_of(figure, 4 * len(t))
    ratio = None if not (r := rms(naive)) or not (s := median(sd)) else r / s
    caption = (
        f"What smoothing took off: naive minus smoothed is {number(rms(naive), 3)} µm RMS, RTS "
        f"minus smoothed {number(rms(rts), 3)} µm; the smoothed sd is {number(median(sd), 3)} µm"
        + (f", {number(ratio, 2)} times less than naive's. " if ratio and ratio > 1 else ". ")
        + where
    )
    return Picture(f"{AXES[axis]}: what smoothing took off", source, caption)


def velocities(results: SmoothingResults, axis: int) -> Picture | None:
    """The longest track's velocity: smoothed with its band, naive, RTS."""
    table, where = detail(results)
    if table is None:
        return None
    name = SPEED.format(AXES[axis])
    t = table["t_s"].to_numpy(float)
    smooth, naive, rts = (column(table, kind + name) for kind in ("", "naive_", "rts_"))
    sd = column(table, f"s{name}")
    with drawing(2.6) as (figure, axes):
        _three(axes, t, [smooth, naive, rts], sd)
        _unobserved(axes, table)
        axes.set(xlabel="t / s", ylabel=f"v{AXES[axis]} / mm/s")
        if results.up[axis] < -0.5:
            axes.invert_yaxis()
        axes.grid(True)
        above(axes)
        source = source_of(figure, 4 * len(t))
    caption = (
        f"Naive scatters by {number(rms(naive - smooth), 3)} mm/s RMS about smoothed, whose sd is "
        f"{number(median(sd), 3)} mm/s (median). {_BANDS}{_marks(table)} {where}"
    )
    if results.up[axis] < -0.5:
        caption += " The axis is turned round, so that up is up."
    return Picture(f"Velocity in {AXES[axis]}", source, caption)


def detail(results: SmoothingResults) -> tuple[pd.DataFrame | None, str]:
    """The longest track, its middle where it is very long; and which that is, in words."""
    if not len(results.trajectories):
        return None, ""
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
