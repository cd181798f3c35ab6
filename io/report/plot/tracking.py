"""Pictures of a tracked run: how the cameras agree, bubbles in each frame, marks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from telerig.arrays import Array, Ints
from telerig.io.report.plot.axes import (
    COLOURS,
    MODEL,
    MUTED,
    axes_of,
    camera_colour,
    columns_of,
    finite,
    nothing_to_draw,
)
from telerig.short_text import no_formula
from telerig.statistics import robust_sd

__all__ = ["bubbles_in_frames", "marks", "ray_miss", "ray_miss_along"]

_MISS_BINS, _MOST_BINS = 48, 400
_MOST_MARKS = 4_000
_STEPS, _LEAST_IN_STEP = 12, 8
_TRACKS = "Tracks.table or tracks.csv"


def ray_miss(
    tracks: pd.DataFrame,
    predicted_mm: Array | None = None,
    more_mm: float = 0.0,
    *,
    axes: Any = None,
) -> Any:
    """Draw the distribution of the ray miss beside what the outlines' noise predicts; returns axes.

    tracks : tracks.csv. predicted_mm : (N,) its standard deviations; None for none. more_mm : what
    shake and shapes add to them (1 sd). Raises InputError for a table without a ray miss.
    """
    miss = 1e3 * finite(*columns_of(tracks, "ray_miss_mm", made_by=_TRACKS))[0]
    sd = np.zeros(0) if predicted_mm is None else 1e3 * predicted_mm[np.isfinite(predicted_mm)]
    signed = bool((miss < 0).any())
    spread = _reach(miss, sd)
    edges = np.linspace(-spread if signed else 0.0, spread, _MISS_BINS + 1)
    axes = axes_of(axes, xlim=(edges[0], spread), yticks=[], xlabel="ray miss / µm")
    count, _ = np.histogram(miss, edges)
    share = count / max(len(miss), 1) / np.diff(edges)
    axes.stairs(share, edges, color=COLOURS[0], fill=True, alpha=0.5, label="measured")
    top = float(share.max(initial=0.0))
    if len(sd) and signed:
        curve = _mixture(edges, sd)
        axes.plot(*curve, color="black", linewidth=1.2, label="noise of the outlines")
        top = max(top, min(2 * top, float(curve[1].max())))
        if 1e3 * more_mm > float(np.median(sd)):
            curve = _mixture(edges, np.hypot(sd, 1e3 * more_mm))
            axes.plot(*curve, color=MODEL, linewidth=1.2, label="with shake")
            top = max(top, float(curve[1].max()))
    axes.axvline(0, color=MUTED, linewidth=0.8)
    axes.set_ylim(0, 1.05 * max(top, 1e-9))
    return axes


def ray_miss_along(
    place_mm: Array, miss_mm: Array, *, name: str = "height", axes: Any = None
) -> Any:
    """Draw the ray miss against a coordinate, with the median of each step; returns axes.

    place_mm, miss_mm : (N,). The red line should lie on zero. Raises InputError for no points.
    """
    place, miss = finite(place_mm, 1e3 * miss_mm)
    axes = axes_of(axes, xlabel=f"{name} / mm", ylabel="ray miss / µm")
    reach = _reach(miss, np.zeros(0))
    axes.set_ylim(-reach, reach)
    thin = len(miss) // _MOST_MARKS + 1
    dots = {"alpha": 0.5, "markersize": 2.5 if len(miss) > 1000 else 5, "markeredgewidth": 0}
    axes.axhline(0, color=MUTED, linewidth=0.8)
    axes.plot(place[::thin], miss[::thin], ".", color=COLOURS[0], **dots)
    steps = miss_steps(place, miss)
    if len(steps):
        line = {"fmt": "o-", "markersize": 3.5, "linewidth": 1.2, "label": "median of a step"}
        axes.errorbar(*steps.T, color=MODEL, **line)
    return axes


def miss_steps(place: Array, miss: Array) -> Array:
    """Return middle, median and its standard error (S, 3) of up to 12 steps of equal number."""
    groups = int(min(_STEPS, len(place) // _LEAST_IN_STEP))
    rows = []
    for step in np.array_split(np.argsort(place), groups) if groups else []:
        middle = float(np.median(miss[step]))
        error = 1.2533 * float(robust_sd(miss[step] - middle) / np.sqrt(len(step)))
        rows.append((float(np.median(place[step])), middle, error))
    return np.array(rows).reshape(-1, 3)


def bubbles_in_frames(counts: Mapping[str, Ints], *, axes: Any = None) -> Any:
    """Draw how many bubbles each frame shows; returns axes.

    counts : by camera, and "both" for those with a place in space, (F,); means of many frames are
    drawn for long runs.
    """
    frames = len(next(iter(counts.values()), ()))
    if not frames:
        raise nothing_to_draw("the run has no frames")
    edges = np.append(np.arange(0, frames, max(1, -(-frames // _MOST_BINS))), frames)
    axes = axes_of(axes, xlabel="frame", ylabel="bubbles", xlim=(0, frames))
    for i, (name, found) in enumerate(counts.items()):
        mean = np.add.reduceat(found, edges[:-1]) / np.diff(edges)
        in_space = name == "both"
        colour, label = ("black", "in space") if in_space else (camera_colour(i), no_formula(name))
        axes.stairs(mean, edges, color=colour, label=label, linewidth=1.2 if in_space else 1.0)
    axes.set_ylim(0, None)
    return axes


def marks(
    references: pd.DataFrame,
    camera: str,
    image_size_px: tuple[int, int] | None = None,
    *,
    colour: str = COLOURS[0],
    axes: Any = None,
) -> Any:
    """Draw where the marks fixed to the tank are in a camera's images, frame by frame.

    Returns axes. references : references.csv. image_size_px : (width, height), for the limits.
    Raises InputError for a camera without marks.
    """
    columns_of(references, "frame", "u_px", "v_px", made_by="references.csv")
    table = references[references["camera"] == camera]
    if not len(table):
        raise nothing_to_draw(f"no mark was followed in the images of {camera}")
    along = max(("u_px", "v_px"), key=lambda c: float(np.ptp(table[c])))
    axes = axes_of(axes, xlabel="frame", ylabel=f"{along[0]} / px")
    every = -(-len(table) // _MOST_MARKS)
    for _, group in table.groupby("mark", sort=True):
        way = group.iloc[::every]
        frame, place = way["frame"].to_numpy(float), way[along].to_numpy(float)
        breaks = np.flatnonzero(np.diff(frame) > every + 1) + 1
        gaps = (np.insert(values, breaks, np.nan) for values in (frame, place))
        alone = "." if len(frame) == 1 else None
        axes.plot(*gaps, color=colour, linewidth=0.8, marker=alone, markersize=2)
    if image_size_px is not None:
        axes.set_ylim(-0.5, image_size_px[along == "v_px"] - 0.5)
    if along == "v_px":
        axes.invert_yaxis()
    return axes


def _reach(miss: Array, sd: Array) -> float:
    """Return half the width of a plot: 99 % of the values, at least four predicted sd."""
    wide = 1.3 * float(np.quantile(np.abs(miss), 0.99)) if len(miss) else 1.0
    return max(wide, 4 * float(np.median(sd)) if len(sd) else 0.0, 1e-6)


def _mixture(edges: Array, sd: Array) -> tuple[Array, Array]:
    """Return the mean density of normal distributions with these widths."""
    x = np.linspace(edges[0], edges[-1], 161)
    some = np.quantile(sd, np.linspace(0.005, 0.995, 100))
    density = np.exp(-0.5 * (x[:, None] / some) ** 2) / (np.sqrt(2 * np.pi) * some)
    return x, density.mean(axis=1)
