"""Tracks of bubbles as one 3-D scene, and as plans for paper."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.io.report.page.figures import Picture, Sheet, drawing
from telerig.io.report.page.page import Trace, lines, scene_text
from telerig.io.results.folders.tracking import TrackResults

TRACK_COLOURS = (
    "#1f5fa8", "#c2570c", "#2e7d32", "#7b3fa0", "#a8324a", "#0f8a8a", "#8a6d00", "#5b4a42",
    "#d05fa0", "#4f6bd8",
)  # fmt: skip
MOST_POINTS = 8_000

_NAMED = len(TRACK_COLOURS)
_EYE = 1.5
_WIDENING, _WIDEST, _FLATTEST = (1, 2, 5, 10, 20), 0.5, 0.02


def track_colour(particle: int) -> str:
    """Return a track's colour, the same in all pictures of a report."""
    return TRACK_COLOURS[particle % len(TRACK_COLOURS)]


def thinned(tracks: pd.DataFrame, most: int) -> pd.DataFrame:
    """Return about ``most`` rows sorted by bubble and frame, with the ends of all tracks.

    Of more tracks than ``most`` / 4 the longest stay. ``new`` marks rows before which a line
    must not be drawn: a track's first, and the first after a gap longer than the thinning.
    """
    table: pd.DataFrame = tracks.loc[
        np.isfinite(tracks[["x_mm", "y_mm", "z_mm"]].to_numpy()).all(1)
    ]
    length = table["particle"].value_counts()
    if len(length) > most // 4:
        table = table[table["particle"].isin(length.index[: most // 4])]
    table = table.sort_values(by=["particle", "frame"])
    particle, frame = table["particle"].to_numpy(), table["frame"].to_numpy()
    first = np.append(True, particle[1:] != particle[:-1])[: len(table)]
    step = max(1, int(np.ceil(len(table) / most)))
    gap = np.append(False, np.diff(frame) > step)[: len(table)]
    within = np.arange(len(table)) - np.maximum.accumulate(
        np.where(first, np.arange(len(table)), 0)
    )
    keep = (within % step == 0) | first | np.append(first[1:], True)[: len(table)]
    run = np.cumsum(first | gap)
    kept: pd.DataFrame = table.assign(run=run).loc[keep]
    new = np.append(True, np.diff(kept["run"]) != 0)[: len(kept)]
    return kept.assign(new=new)


def track_scene_json(results: TrackResults) -> str:
    """Traces and layout for ``Plotly.newPlot``, safe inside a script element."""
    table = thinned(results.tracks, MOST_POINTS)
    group = (table["particle"] % _NAMED).to_numpy()
    few = table["particle"].nunique() <= _NAMED and table["particle"].max() < _NAMED
    traces = [
        _group(table[group == k], TRACK_COLOURS[k], named=bool(few)) for k in np.unique(group)
    ]
    up = [float(part) + 0.0 for part in results.up]
    sides = _sides_mm(table) * _drawn_wider(results.up, scene_widening(results))
    ratio = None
    if scene_widening(results) > 1:
        ratio = (sides / np.prod(sides) ** (1 / 3)).round(4).tolist()
    return scene_text(traces, up, _EYE * _slenderness(sides), ratio)


def scene_widening(results: TrackResults) -> int:
    """Return the factor by which slender paths are drawn wider than true."""
    sides = _sides_mm(thinned(results.tracks, MOST_POINTS))
    upright = int(np.argmax(np.abs(results.up)))
    across = float(np.delete(sides, upright).max())
    return max(f for f in _WIDENING if f == 1 or f * across <= _WIDEST * sides[upright])


def _drawn_wider(up: Array, times: int) -> Array:
    """Return the factors (3,) by axis."""
    return np.where(np.arange(3) == int(np.argmax(np.abs(up))), 1.0, float(times))


def _sides_mm(table: pd.DataFrame) -> Array:
    """Return the sides (3,) of the points' box, none of them 0."""
    if not len(table):
        return np.ones(3)
    sides = np.ptp(table[["x_mm", "y_mm", "z_mm"]].to_numpy(float), axis=0) + 1e-9
    return np.asarray(np.maximum(sides, _FLATTEST * sides.max()))


def _slenderness(sides: Array) -> float:
    """Diagonal of a box over that of a cube of its volume; the eye steps back for it."""
    return float(np.linalg.norm(sides) / np.sqrt(3) / np.prod(sides) ** (1 / 3))


def _group(table: pd.DataFrame, colour: str, *, named: bool) -> Trace:
    """Return the tracks of one colour as lines that break between tracks and at gaps."""
    points = table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    starts = np.flatnonzero(table["new"].to_numpy())[1:]
    words = [f"bubble {p}<br>frame {f}" for p, f in zip(table["particle"], table["frame"])]
    broken = np.insert(points, starts, np.nan, axis=0)
    text = np.insert(np.array(words, dtype=object), starts, "").tolist()
    style: dict[str, Any] = {
        "text": text, "hovertemplate": "%{text}<br>%{x}, %{y}, %{z} mm<extra></extra>",
        "name": f"bubble {table['particle'].iloc[0]}", "showlegend": named,
    }  # fmt: skip
    if len(points) == len(starts) + 1:
        style |= {"mode": "markers", "marker": {"size": 3, "color": colour}}
    return lines(broken, colour, 4) | style


def track_plans(results: TrackResults) -> list[Picture]:
    """Draw height against both other directions, for paper and browsers without 3-D."""
    axis = int(np.argmax(np.abs(results.up)))
    return [_plan(results, across) for across in range(3) if across != axis]


def _plan(results: TrackResults, across: int) -> Picture:
    table = thinned(results.tracks, MOST_POINTS)
    points = table[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    with drawing(4.2, xlabel=f"{'xyz'[across]} / mm", ylabel="height / mm") as sheet:
        draw_tracks(sheet, points[:, across], points @ results.up, table)
        sheet.axes.set_aspect("equal", adjustable="datalim")
    caption = "Every track has its colour; the scene in a browser can be turned."
    return Picture(f"Tracks, height against {'xyz'[across]}", sheet.source, caption)


def draw_tracks(sheet: Sheet, x: Array, y: Array, table: pd.DataFrame) -> None:
    """Draw lines in the tracks' colours, broken at gaps, with a dot at the start.

    table : from `thinned`, row by row what x and y are of.
    """
    from matplotlib.collections import LineCollection

    starts = np.flatnonzero(table["new"].to_numpy())
    particles = table["particle"].to_numpy()
    pieces = np.split(np.c_[x, y], starts[1:]) if len(table) else []
    colours = [track_colour(int(particles[s])) for s in starts]
    sheet.axes.add_collection(LineCollection(pieces, colors=colours, linewidths=1.0))
    if len(table):
        sheet.axes.scatter(x[starts], y[starts], s=5, c=colours, linewidths=0)
    sheet.axes.autoscale_view()
    sheet.points += len(table)
