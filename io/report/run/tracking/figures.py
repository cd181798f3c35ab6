"""Pictures of a tracked run in time: places, counts, sizes, confidence."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.page.figures import (
    KEPT,
    MODEL,
    MUTED,
    Picture,
    camera_colour,
    drawing,
    png,
    svg,
)
from telerig.io.report.page.number_format import number, share
from telerig.io.report.run.tracking.numbers import median, per_frame
from telerig.io.report.run.tracking.results import TrackResults
from telerig.io.report.run.tracking.scene import MANY_POINTS, SHADES, draw_tracks, thinned

Array = NDArray[np.float64]

_MOST_POINTS = 8_000
_MOST_BINS = 400
_BINS = 40


def time_series(results: TrackResults, axis: int) -> Picture:
    """One rig coordinate of every track against time; up is up."""
    table = thinned(results.tracks, _MOST_POINTS)
    name, upwards = "xyz"[axis], float(results.up[axis])
    with drawing(2.6) as (figure, axes):
        place = table[f"{name}_mm"].to_numpy(float)
        draw_tracks(axes, table["t_s"].to_numpy(float), place, table)
        axes.set(xlabel="t / s", ylabel=f"{name} / mm")
        if upwards < -0.5:
            axes.invert_yaxis()
        axes.grid(True)
        source = png(figure, colours=SHADES) if len(table) > MANY_POINTS else svg(figure)
    span = 1e-9 + results.tracks["t_s"].max() - results.tracks["t_s"].min() if len(table) else 0
    caption = f"{number(float(span))} s, a colour per track; a line breaks where a bubble was lost."
    if upwards < -0.5:
        caption = f"The axis is turned round, so that up is up. {caption}"
    if len(table) < len(results.tracks):
        caption += f" {number(len(table))} of {number(len(results.tracks))} points are drawn."
    return Picture(f"{name} against time", source, caption)


def bubbles_in_time(results: TrackResults) -> Picture:
    """Bubbles in each frame, by camera and in space."""
    counts = per_frame(results)
    frames = len(counts["both"])
    width = max(1, -(-frames // _MOST_BINS))
    edges = np.append(np.arange(0, frames, width), frames)
    with drawing(2.6) as (figure, axes):
        for i, camera in enumerate(results.cameras):
            axes.stairs(_means(counts[camera], edges), edges, color=camera_colour(i),
                        linewidth=1.0, label=camera, alpha=0.85)  # fmt: skip
        axes.stairs(_means(counts["both"], edges), edges, color="black", linewidth=1.2,
                    label="in space")  # fmt: skip
        axes.set(xlabel="frame", ylabel="bubbles", xlim=(0, max(frames, 1)))
        top = max((float(c.max()) for c in counts.values() if len(c)), default=1.0)
        axes.set_ylim(0, 1.3 * max(top, 1.0))
        axes.legend(loc="upper left", ncols=3, columnspacing=1.2, handlelength=1.4)
        axes.grid(True)
        source = svg(figure)
    empty = int(np.sum(counts["both"] == 0))
    caption = (
        "The black line should follow the lower of the cameras' lines: what lies above it has no "
        f"partner or track. {number(empty)} of {number(frames)} frames have no bubble in space."
    )
    if width > 1:
        caption += f" Each step is the mean of {width} frames."
    return Picture("Bubbles per frame", source, caption)


def _means(counts: NDArray[np.int64], edges: NDArray[np.int64]) -> Array:
    if not len(counts):
        return np.zeros(len(edges) - 1)
    return np.asarray(np.add.reduceat(counts, edges[:-1]) / np.diff(edges))


def sizes(results: TrackResults) -> Picture:
    """Histogram of the equivalent diameters, all points and one value per track."""
    table = results.tracks[["particle", "d_eq_mm"]]
    values = table["d_eq_mm"].to_numpy(float)
    each = table.groupby("particle")["d_eq_mm"].median().to_numpy(float)
    with drawing(2.6) as (figure, axes):
        edges = _edges(values)
        _bars(axes, values, edges, MUTED, "points", fill=True)
        axes.set(xlabel="equivalent diameter / mm", ylabel="points")
        beside = axes.twinx()
        beside.spines["top"].set_visible(False)
        _bars(beside, each, edges, camera_colour(0), "tracks (median)", fill=False)
        beside.set_ylabel("tracks", color=camera_colour(0))
        beside.spines["right"].set(visible=True, color=camera_colour(0))
        beside.yaxis.get_major_locator().set_params(integer=True)
        box = axes.get_position()
        for each_axes in (axes, beside):
            each_axes.set_position((box.x0, box.y0, box.width - 0.09, box.height))
        _room_above(axes, beside)
        source = svg(figure)
    scatter = _scatter_in_tracks(results)
    caption = (
        "Diameter of the sphere of the bubble's volume. Grey: every point; blue: every track once. "
        f"Within a track it scatters by {number(scatter, 2)} % (1 sd, median of the tracks)."
    )
    return Picture("Sizes", source, caption)


def _scatter_in_tracks(results: TrackResults) -> float | None:
    by_track = results.tracks.groupby("particle")["d_eq_mm"]
    relative = (by_track.std() / by_track.mean())[by_track.count() > 2]
    return median(100 * relative.to_numpy(float))


def _room_above(*several: Any) -> None:
    for axes in several:
        axes.set_ylim(0, 1.15 * max(axes.get_ylim()[1], 1.0))


def predicted_sd(results: TrackResults) -> Picture:
    """Histogram of the predicted standard deviations on the three axes."""
    sd = results.sd_um
    with drawing(2.6) as (figure, axes):
        edges = _edges(sd.ravel(), high=0.99)
        for i, name in enumerate("xyz"):
            label = f"{name}: {number(median(sd[:, i]), 2)} µm"
            _bars(axes, sd[:, i], edges, camera_colour(i), label, fill=False)
        axes.set(xlabel="sd of the position / µm", ylabel="points")
        axes.set_ylim(0, 1.25 * max(axes.get_ylim()[1], 1.0))
        axes.legend(loc="upper left", ncols=3, columnspacing=1.2, handlelength=1.4)
        source = svg(figure)
    beyond = int(np.sum((sd > edges[-1]).any(axis=1)))
    caption = (
        "What the outlines' noise and the doubt about the shape make of the position, per rig "
        "axis; the legend has the medians. The calibration's share is common to all points and "
        f"not counted. {number(beyond)} points lie beyond the plot."
    )
    return Picture("Predicted standard deviation", source, caption)


def confidence(results: TrackResults) -> Picture:
    """Histogram of the probability that the two outlines are of one bubble."""
    values = results.tracks["confidence"].to_numpy(float)
    with drawing(2.6) as (figure, axes):
        edges = np.linspace(0, 1, 41)
        _bars(axes, values, edges, KEPT, "", fill=True)
        axes.axvline(0.9, color=MODEL, linewidth=0.8, linestyle="--")
        axes.set(xlabel="confidence of the pair", ylabel="points", xlim=(0, 1))
        axes.set_yscale("symlog", linthresh=1)
        axes.set_ylim(0, 3 * max(float(axes.get_ylim()[1]), 1.0))
        source = svg(figure)
    low = int(np.sum(values < 0.9))
    caption = (
        "Probability that the two outlines are of one bubble; counts grow by powers of ten. "
        f"{number(low)} of {number(len(values))} points ({share(low, len(values))}) lie below 0.9."
    )
    return Picture("Confidence of the pairs", source, caption)


def _edges(values: Array, high: float = 1.0) -> Array:
    """From 0 or just below the least value, to the quantile ``high`` with some room."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return np.linspace(0, 1, _BINS + 1)
    top, low = float(np.quantile(finite, high)), float(finite.min())
    bottom = 0.0 if low < 0.5 * top else low - 0.1 * (top - low) - 1e-3 * abs(top)
    return np.linspace(bottom, max(top + 0.1 * (top - bottom), bottom + 1e-9), _BINS + 1)


def _bars(axes: Any, values: Array, edges: Array, colour: str, label: str, *, fill: bool) -> None:
    count, _ = np.histogram(values[np.isfinite(values)], edges)
    axes.stairs(count, edges, color=colour, fill=fill, alpha=0.6 if fill else 1, linewidth=1.3,
                label=label)  # fmt: skip
