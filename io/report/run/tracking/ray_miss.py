"""Pictures of a tracked run that tell whether the two cameras agree, and where they looked."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.page.figures import (
    LEFT_OUT,
    MODEL,
    MUTED,
    Picture,
    camera_colour,
    drawing,
    image_axes,
    image_height_in,
    png,
    svg,
)
from telerig.io.report.page.number_format import number, share
from telerig.io.report.run.tracking.numbers import learnt_sd_mm, median, ray_miss_sd_mm
from telerig.io.report.run.tracking.results import TrackResults
from telerig.io.report.run.tracking.scene import SHADES

Array = NDArray[np.float64]

_BINS = 48
_MOST_MARKS = 4_000
_STEPS = 12
_LEAST_IN_STEP = 8
_CELLS = 16


def ray_miss_histogram(results: TrackResults) -> Picture:
    """Signed ray miss against the distribution that each pair's own noise predicts."""
    miss = 1e3 * results.tracks["ray_miss_mm"].to_numpy(float)
    sd, learnt = _predicted_um(results), 1e3 * (learnt_sd_mm(results) or 0.0)
    known = miss[np.isfinite(miss)]
    spread = _reach(known, sd)
    edges = np.linspace(-spread, spread, _BINS + 1)
    with drawing(2.9) as (figure, axes):
        count, _ = np.histogram(known, edges)
        share_of = count / max(len(known), 1) / np.diff(edges)
        axes.stairs(share_of, edges, color=camera_colour(0), fill=True, alpha=0.5, label="measured")
        top = float(share_of.max(initial=0.0))
        if sd is not None:
            curve = _mixture(edges, sd)
            axes.plot(*curve, color="black", linewidth=1.2, label="noise of the outlines")
            top = max(top, min(2 * top, float(curve[1].max())))
            if learnt > float(np.median(sd)):
                curve = _mixture(edges, np.hypot(sd, learnt))
                axes.plot(*curve, color=MODEL, linewidth=1.2, label="with shake and scatter")
                top = max(top, float(curve[1].max()))
        axes.axvline(0, color=MUTED, linewidth=0.8)
        axes.set(xlabel="ray miss / µm", ylabel="density", xlim=(-spread, spread), yticks=[])
        axes.set_ylim(0, 1.3 * max(top, 1e-9))
        axes.legend(loc="upper left")
        source = svg(figure)
    beyond = int(np.sum(np.abs(known) > spread))
    caption = (
        f"Mean {number(float(np.mean(known)) if len(known) else None, 2)} µm, RMS "
        f"{number(float(np.sqrt(np.mean(known**2))) if len(known) else None, 2)} µm. "
    )
    if sd is None:
        caption += "There are too few points to say what the outlines' noise predicts."
    else:
        caption += (
            f"The outlines' noise predicts the black curve (sd {number(median(sd), 2)} µm): a "
            "shift against it is a biased calibration, more width is shake, shape or wrong pairs."
        )
    caption += f" {number(beyond)} points lie beyond the plot." if beyond else ""
    return Picture("Ray miss", source, caption)


def _predicted_um(results: TrackResults) -> Array | None:
    sd = ray_miss_sd_mm(results)
    if sd is None or not np.isfinite(sd).any():
        return None
    return 1e3 * sd[np.isfinite(sd)]


def _reach(known: Array, sd: Array | None) -> float:
    """Half the width of the plot: all but the wildest hundredth, at least four predicted sd."""
    wide = 1.3 * float(np.quantile(np.abs(known), 0.99)) if len(known) else 1.0
    return max(wide, 4 * float(np.median(sd)) if sd is not None else 0.0, 1e-6)


def _mixture(edges: Array, sd: Array) -> tuple[Array, Array]:
    """Mean density of normal distributions of these widths."""
    x = np.linspace(edges[0], edges[-1], 161)
    some = np.quantile(sd, np.linspace(0.005, 0.995, 100))
    density = np.exp(-0.5 * (x[:, None] / some) ** 2) / (np.sqrt(2 * np.pi) * some)
    return x, density.mean(axis=1)


def ray_miss_in_space(results: TrackResults, direction: Array, name: str) -> Picture:
    """Ray miss against the place along a direction, with the median of each step.

    direction : (3,) unit vector in the rig frame; name : what the coordinate is called.
    """
    place = results.points_mm @ direction
    miss = 1e3 * results.tracks["ray_miss_mm"].to_numpy(float)
    good = np.isfinite(place) & np.isfinite(miss)
    place, miss = place[good], miss[good]
    step = len(miss) // _MOST_MARKS + 1
    reach = _reach(miss, _predicted_um(results))
    middles, medians, doubt = _steps(place, miss)
    with drawing(2.9) as (figure, axes):
        axes.axhline(0, color=MUTED, linewidth=0.8)
        axes.plot(place[::step], miss[::step], ".", color=camera_colour(0), alpha=0.5,
                  markersize=2.5 if len(miss) > 1000 else 5, markeredgewidth=0)  # fmt: skip
        axes.errorbar(middles, medians, doubt, color=MODEL, fmt="o-", markersize=3.5, linewidth=1.2,
                      label="median of a step")  # fmt: skip
        axes.set(xlabel=f"{name} / mm", ylabel="ray miss / µm", ylim=(-reach, 1.2 * reach))
        axes.legend(loc="upper right")
        source = png(figure, colours=SHADES) if len(miss) > 1000 else svg(figure)
    caption = (
        "The red line should lie on zero. A constant offset, a slope or a bow along it is the "
        f"calibration's fault, not the bubbles'. {_worst_step(medians, doubt)}"
    )
    return Picture(f"Ray miss against {name}", source, caption)


def _steps(place: Array, miss: Array) -> tuple[Array, Array, Array]:
    """Middle, median and its standard error of up to `_STEPS` steps of equal number."""
    groups = int(min(_STEPS, len(place) // _LEAST_IN_STEP))
    parts = np.array_split(np.argsort(place), groups) if groups else []
    middles = np.array([np.median(place[p]) for p in parts])
    medians = np.array([np.median(miss[p]) for p in parts])
    error = [1.2533 * 1.4826 * np.median(np.abs(miss[p] - np.median(miss[p]))) / np.sqrt(len(p))
             for p in parts]  # fmt: skip
    return middles, medians, np.array(error)


def _worst_step(medians: Array, doubt: Array) -> str:
    if not len(medians):
        return "There are too few points for it."
    worst = int(np.argmax(np.abs(medians)))
    most, error = abs(float(medians[worst])), float(doubt[worst])
    return f"It strays by up to {number(most, 2)} ± {number(error, 1)} µm."


def seen_where(results: TrackResults, index: int) -> Picture:
    """Where in one camera's image bubbles were, and those of them that are in no track."""
    camera = results.cameras[index]
    table = results.detections[results.detections["camera"] == camera]
    uv = table[["u_px", "v_px"]].to_numpy(float)
    alone = uv[table["particle"].isna().to_numpy(bool)]
    size, stated = _image_size(results, camera, uv)
    cells = [max(2, round(_CELLS * n / max(size))) for n in size]
    edges = [np.linspace(-0.5, n - 0.5, k + 1) for n, k in zip(size, cells)]
    count, _ = np.histogramdd(uv, bins=edges)
    below = 0.75
    height = image_height_in(size) + below
    with drawing(height) as (figure, axes):
        box, room = axes.get_position(), below / height
        axes.set_position((box.x0, box.y0 + room, box.width, box.height - room))
        bar = figure.add_axes((box.x0, 0.42 / height, box.width, 0.1 / height))
        image_axes(axes, size)
        mesh = axes.pcolormesh(*edges, np.where(count.T > 0, count.T, np.nan), cmap="Blues",
                               vmin=0, vmax=max(float(count.max()), 1.0))  # fmt: skip
        step = len(alone) // _MOST_MARKS + 1
        axes.plot(*alone[::step].T, ".", color=LEFT_OUT, markersize=4, markeredgewidth=0,
                  alpha=0.7)  # fmt: skip
        figure.colorbar(mesh, cax=bar, orientation="horizontal",
                        label="bubbles in a cell, all frames")  # fmt: skip
        source = png(figure, colours=SHADES) if len(alone) > 500 else svg(figure)
    empty = int(np.sum(count == 0))
    caption = _where_caption(len(uv), len(alone), empty, count.size, stated)
    return Picture(f"Bubbles in the image, camera {camera}", source, caption)


def _where_caption(found: int, alone: int, empty: int, cells: int, stated: bool) -> str:
    if not found:
        return "No bubble was found in this camera, or detections.csv is not in this folder."
    caption = (
        f"{number(found)} bubbles; red: {number(alone)} ({share(alone, found)}) in no track, which "
        f"should not gather anywhere but at the border. {empty} of {cells} cells are empty."
    )
    return caption if stated else caption + " The image may be larger: its size is not known here."


def _image_size(results: TrackResults, camera: str, uv: Array) -> tuple[tuple[int, int], bool]:
    stated = results.image_size_px(camera)
    if stated is not None:
        return stated, True
    if not len(uv):
        return (100, 100), False
    width, height = np.ceil(uv.max(axis=0)).astype(int) + 1
    return (int(width), int(height)), False


def shared_pictures(results: TrackResults) -> list[Any]:
    """Height first, because a wrong angle or scale between the cameras shows there."""
    across = [i for i in range(3) if abs(results.up[i]) < 0.5]
    return [(results.up, "height"), *((np.eye(3)[i], "xyz"[i]) for i in across)]
