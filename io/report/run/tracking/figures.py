"""Pictures of a tracked run: places, counts, sizes, marks, and how the two cameras agree."""

from __future__ import annotations

from typing import Any

import numpy as np

from telerig.arrays import Array, Ints
from telerig.io.report.page.figures import (
    KEPT,
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
from telerig.io.report.run.tracking.numbers import learnt_sd_mm, median, per_frame, ray_miss_sd_mm
from telerig.io.report.run.tracking.results import TrackResults
from telerig.io.report.run.tracking.scene import MANY_POINTS, SHADES, draw_tracks, thinned

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


def _means(counts: Ints, edges: Ints) -> Array:
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
        "Standard deviation of the position from the noise of the outlines and the unknown shape "
        "of the bubble, per rig axis; the legend gives the medians. The calibration's share is "
        f"common to all points and is not included. {number(beyond)} points lie beyond the plot."
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


def marks_followed(results: TrackResults, camera: int) -> Picture:
    """Where each mark is in the images of one camera that sees some, frame by frame."""
    name = results.cameras[camera]
    table = results.references[results.references["camera"] == name]
    along = max(("u_px", "v_px"), key=lambda c: float(np.ptp(table[c])))
    every = -(-len(table) // _MOST_POINTS)
    lines = [group.iloc[::every] for _, group in table.groupby("mark", sort=True)]
    with drawing(2.6) as (figure, axes):
        for line in lines:
            _draw_mark(axes, line, along, every, camera_colour(camera))
        size = results.image_size_px(name)
        if size is not None:
            axes.set_ylim(-0.5, size[along == "v_px"] - 0.5)
        if along == "v_px":
            axes.invert_yaxis()
        axes.set(xlabel="frame", ylabel=f"{along[0]} / px")
        axes.grid(True)
        many = sum(map(len, lines)) > MANY_POINTS
        source = png(figure, colours=SHADES) if many else svg(figure)
    return Picture(f"Marks fixed to the tank, {name}", source, _caption(table))


def _draw_mark(axes: Any, line: Any, along: str, every: int, colour: str) -> None:
    """One mark's way, broken where it was not seen."""
    frame, place = line["frame"].to_numpy(float), line[along].to_numpy(float)
    breaks = np.flatnonzero(np.diff(frame) > every + 1) + 1
    axes.plot(
        np.insert(frame, breaks, np.nan), np.insert(place, breaks, np.nan), color=colour,
        linewidth=0.8, marker="." if len(frame) == 1 else None, markersize=2,
    )  # fmt: skip


def _caption(table: Any) -> str:
    in_a_frame = table.groupby("frame").size().to_numpy()
    stays = table.groupby("mark").size().to_numpy()
    words = (
        f"{number(len(stays))} marks, {np.median(in_a_frame):.0f} in a frame and each in "
        f"{np.median(stays):.0f} frames (medians)"
    )
    if "sigma_px" in table and table["sigma_px"].notna().any():
        words += f", measured to {number(median(table['sigma_px']))} px"
    return (
        f"{words}. The lines are as parallel as the stage and the shake move all marks alike; one "
        "that goes its own way is not fixed to the tank."
    )


_MISS_BINS = 48
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
    edges = np.linspace(-spread, spread, _MISS_BINS + 1)
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
    middles, medians, error = _steps(place, miss)
    with drawing(2.9) as (figure, axes):
        axes.axhline(0, color=MUTED, linewidth=0.8)
        axes.plot(place[::step], miss[::step], ".", color=camera_colour(0), alpha=0.5,
                  markersize=2.5 if len(miss) > 1000 else 5, markeredgewidth=0)  # fmt: skip
        axes.errorbar(middles, medians, error, color=MODEL, fmt="o-", markersize=3.5, linewidth=1.2,
                      label="median of a step")  # fmt: skip
        axes.set(xlabel=f"{name} / mm", ylabel="ray miss / µm", ylim=(-reach, 1.2 * reach))
        axes.legend(loc="upper right")
        source = png(figure, colours=SHADES) if len(miss) > 1000 else svg(figure)
    caption = (
        "The red line should lie on zero. A constant offset, a slope or a bow along it is the "
        f"calibration error, not an effect of the bubbles. {_worst_step(medians, error)}"
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


def _worst_step(medians: Array, error: Array) -> str:
    if not len(medians):
        return "There are too few points for it."
    worst = int(np.argmax(np.abs(medians)))
    most, sd = abs(float(medians[worst])), float(error[worst])
    return f"It strays by up to {number(most, 2)} ± {number(sd, 1)} µm."


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
