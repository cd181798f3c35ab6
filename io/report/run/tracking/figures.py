"""Pictures of a tracked run: places, counts, sizes, marks, and how the two cameras agree."""

from __future__ import annotations

from typing import Any

import numpy as np

from telerig.arrays import Array
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
)
from telerig.io.report.run.tracking.scene import draw_tracks, thinned
from telerig.io.results.folders.tracking import (
    TrackResults,
    learnt_sd_mm,
    per_frame,
    ray_miss_sd_mm,
)
from telerig.short_text import number, share
from telerig.statistics import median, rms, robust_sd

_MOST_POINTS = 8_000
_MOST_BINS = 400
_BINS = 40


def time_series(results: TrackResults, axis: int) -> Picture:
    """Draw one rig coordinate of every track against time, reversed if it points down."""
    table = thinned(results.tracks, _MOST_POINTS)
    name, upwards = "xyz"[axis], float(results.up[axis])
    with drawing(2.6, grid=True, xlabel="t / s", ylabel=f"rig {name} / mm") as sheet:
        place = table[f"{name}_mm"].to_numpy(float)
        draw_tracks(sheet, table["t_s"].to_numpy(float), place, table)
        if upwards < -0.5:
            sheet.axes.invert_yaxis()
    span = results.tracks["t_s"].max() - results.tracks["t_s"].min() if len(table) else 0
    caption = f"{number(float(span))} s, a colour per track; a line breaks where a bubble was lost."
    if upwards < -0.5:
        caption = f"The axis is turned round, so that up is up. {caption}"
    if len(table) < len(results.tracks):
        caption += f" {number(len(table))} of {number(len(results.tracks))} points are drawn."
    return Picture(f"{name} against time", sheet.source, caption)


def bubbles_in_time(results: TrackResults) -> Picture:
    """Bubbles in each frame, by camera and in space."""
    counts = per_frame(results)
    frames = len(counts["both"])
    width = max(1, -(-frames // _MOST_BINS))
    edges = np.append(np.arange(0, frames, width), frames)
    means = {
        name: np.add.reduceat(c, edges[:-1]) / np.diff(edges)
        if len(c)
        else np.zeros(len(edges) - 1)
        for name, c in counts.items()
    }
    settings: dict[str, Any] = {"xlabel": "frame", "ylabel": "bubbles", "xlim": (0, max(frames, 1))}
    with drawing(2.6, legend="above", grid=True, **settings) as sheet:
        for i, camera in enumerate(results.cameras):
            how = {"color": camera_colour(i), "linewidth": 1.0, "alpha": 0.85}
            sheet.axes.stairs(means[camera], edges, label=camera, **how)
        line = {"color": "black", "linewidth": 1.2, "label": "in space"}
        sheet.axes.stairs(means["both"], edges, **line)
        sheet.axes.set_ylim(0, None)
    empty = int(np.sum(counts["both"] == 0))
    caption = (
        "The black line should follow the second highest of the cameras' lines: what lies above it "
        "has no partner or track. "
        f"{number(empty)} of {number(frames)} frames have no bubble in space."
    )
    if width > 1:
        caption += f" Each step is the mean of {width} frames."
    return Picture("Bubbles per frame", sheet.source, caption)


def sizes(results: TrackResults) -> Picture:
    """Draw the histogram of the equivalent diameters, of all points and of the tracks."""
    by_track = results.tracks.groupby("particle")["d_eq_mm"]
    values = results.tracks["d_eq_mm"].to_numpy(float)
    with drawing(2.6, xlabel="equivalent diameter / mm", ylabel="points") as sheet:
        edges = _edges(values)
        _bars(sheet.axes, values, edges, MUTED, "points", fill=True)
        beside, colour = sheet.axes.twinx(), camera_colour(0)
        _bars(beside, by_track.median().to_numpy(float), edges, colour, "tracks", fill=False)
        beside.set_ylabel("tracks", color=colour)
        beside.spines["right"].set(visible=True, color=colour)
        beside.yaxis.get_major_locator().set_params(integer=True)
        box = sheet.axes.get_position()
        for axes in (sheet.axes, beside):
            axes.set_position((box.x0, box.y0, box.width - 0.09, box.height))
            axes.set_ylim(0, 1.15 * max(axes.get_ylim()[1], 1.0))
    relative = (by_track.std() / by_track.mean())[by_track.count() > 2]
    scatter = median(100 * relative.to_numpy(float))
    caption = (
        "Diameter of the sphere of the bubble's volume. Grey: every point; blue: every track once. "
        f"Within a track it scatters by {number(scatter, 2)} % (1 sd, median of the tracks)."
    )
    return Picture("Sizes", sheet.source, caption)


def predicted_sd(results: TrackResults) -> Picture:
    """Draw the histogram of the predicted standard deviations along the three axes."""
    sd = results.sd_um
    edges = _edges(sd.ravel(), high=0.99)
    settings: dict[str, Any] = {"xlabel": "sd of the position / µm", "ylabel": "points"}
    with drawing(2.6, legend="above", **settings) as sheet:
        for i, name in enumerate("xyz"):
            label = f"{name}: {number(median(sd[:, i]), 2)} µm"
            _bars(sheet.axes, sd[:, i], edges, camera_colour(i), label, fill=False)
    beyond = int(np.sum((sd > edges[-1]).any(axis=1)))
    caption = (
        "Standard deviation of the position from the noise of the outlines and the unknown shape "
        "of the bubble, per rig axis; the legend gives the medians. The calibration's share is "
        f"common to all points and is not included. {number(beyond)} points lie beyond the plot."
    )
    return Picture("Predicted standard deviation", sheet.source, caption)


def confidence(results: TrackResults) -> Picture:
    """Draw the histogram of the probability that two outlines belong to one bubble."""
    values = results.tracks["confidence"].to_numpy(float)
    settings: dict[str, Any] = {
        "xlabel": "confidence",
        "ylabel": "points",
        "xlim": (0, 1),
    }
    with drawing(2.6, **settings) as sheet:
        _bars(sheet.axes, values, np.linspace(0, 1, 41), KEPT, "", fill=True)
        sheet.axes.axvline(0.9, color=MODEL, linewidth=0.8, linestyle="--")
        sheet.axes.set_yscale("symlog", linthresh=1)
        sheet.axes.set_ylim(0, 3 * max(float(sheet.axes.get_ylim()[1]), 1.0))
    low = int(np.sum(values < 0.9))
    caption = (
        "Probability that these outlines and no others belong to the bubble, on a logarithmic "
        "axis of counts. "
        f"{number(low)} of {number(len(values))} points ({share(low, len(values))}) lie below 0.9."
    )
    return Picture("Confidence", sheet.source, caption)


def _edges(values: Array, high: float = 1.0) -> Array:
    """Return bin edges from 0 or the least value to the quantile ``high``, with a margin."""
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
    """Draw the positions of all marks in one camera's images against the frame."""
    name = results.cameras[camera]
    table = results.references[results.references["camera"] == name]
    along = max(("u_px", "v_px"), key=lambda c: float(np.ptp(table[c])))
    every = -(-len(table) // _MOST_POINTS)
    with drawing(2.6, grid=True, xlabel="frame", ylabel=f"{along[0]} / px") as sheet:
        for _, group in table.groupby("mark", sort=True):
            way = group.iloc[::every]
            frame, place = way["frame"].to_numpy(float), way[along].to_numpy(float)
            breaks = np.flatnonzero(np.diff(frame) > every + 1) + 1
            gaps = (np.insert(values, breaks, np.nan) for values in (frame, place))
            alone = "." if len(frame) == 1 else None
            sheet.axes.plot(*gaps, color=camera_colour(camera), linewidth=0.8, marker=alone,
                            markersize=2)  # fmt: skip
            sheet.points += len(frame)
        size = results.image_size_px(name)
        if size is not None:
            sheet.axes.set_ylim(-0.5, size[along == "v_px"] - 0.5)
        if along == "v_px":
            sheet.axes.invert_yaxis()
    in_a_frame, stays = (table.groupby(key).size().to_numpy() for key in ("frame", "mark"))
    words = (
        f"{number(len(stays))} marks, {np.median(in_a_frame):.0f} in a frame and each in "
        f"{np.median(stays):.0f} frames (medians)"
    )
    if "sigma_px" in table and table["sigma_px"].notna().any():
        words += f", measured to {number(median(table['sigma_px'].to_numpy(float)))} px"
    caption = (
        f"{words}. The lines are as parallel as the stage and the shake move all marks alike; one "
        "that goes its own way is not fixed to the tank."
    )
    return Picture(f"Marks fixed to the tank, {name}", sheet.source, caption)


_MISS_BINS = 48
_MOST_MARKS = 4_000
_STEPS = 12
_LEAST_IN_STEP = 8
_CELLS = 16


def ray_miss_histogram(results: TrackResults) -> Picture:
    """Draw the histogram of the ray miss beside the one that the noise predicts."""
    miss = 1e3 * results.tracks["ray_miss_mm"].to_numpy(float)
    sd, learnt = _predicted_um(results), 1e3 * (learnt_sd_mm(results) or 0.0)
    known = miss[np.isfinite(miss)]
    spread, signed = _reach(known, sd), len(results.cameras) == 2
    known = known if signed else np.abs(known)
    edges = np.linspace(-spread if signed else 0.0, spread, _MISS_BINS + 1)
    settings: dict[str, Any] = {"xlim": (edges[0], spread), "yticks": []}
    settings |= {"xlabel": "ray miss / µm", "ylabel": "density"}
    with drawing(2.9, legend="above", **settings) as sheet:
        axes = sheet.axes
        count, _ = np.histogram(known, edges)
        share_of = count / max(len(known), 1) / np.diff(edges)
        axes.stairs(share_of, edges, color=camera_colour(0), fill=True, alpha=0.5, label="measured")
        top = float(share_of.max(initial=0.0))
        if sd is not None and signed:
            curve = _mixture(edges, sd)
            axes.plot(*curve, color="black", linewidth=1.2, label="noise of the outlines")
            top = max(top, min(2 * top, float(curve[1].max())))
            if learnt > float(np.median(sd)):
                curve = _mixture(edges, np.hypot(sd, learnt))
                axes.plot(*curve, color=MODEL, linewidth=1.2, label="with shake")
                top = max(top, float(curve[1].max()))
        axes.axvline(0, color=MUTED, linewidth=0.8)
        axes.set_ylim(0, 1.05 * max(top, 1e-9))
    mean = float(np.mean(known)) if len(known) else None
    caption = f"Mean {number(mean, 2)} µm, RMS {number(rms(known), 2)} µm. "
    if sd is None:
        caption += "There are too few points to say what the outlines' noise predicts."
    elif not signed:
        predicted = number(rms(sd), 2)
        caption += (
            f"The outlines' noise predicts {predicted} µm RMS; more is shake, shape or wrong "
            "groups. It is the RMS distance of the point from the rays of the cameras that see it."
        )
    else:
        caption += (
            f"The outlines' noise predicts the black curve (sd {number(median(sd), 2)} µm): a "
            "shift against it is a biased calibration, more width is shake, shape or wrong pairs."
        )
    beyond = int(np.sum(np.abs(known) > spread))
    caption += f" {number(beyond)} points lie beyond the plot." if beyond else ""
    return Picture("Ray miss", sheet.source, caption)


def _predicted_um(results: TrackResults) -> Array | None:
    sd = ray_miss_sd_mm(results)
    if sd is None or not np.isfinite(sd).any():
        return None
    return 1e3 * sd[np.isfinite(sd)]


def _reach(known: Array, sd: Array | None) -> float:
    """Return half the width of a plot: 99 % of the values, at least four predicted sd."""
    wide = 1.3 * float(np.quantile(np.abs(known), 0.99)) if len(known) else 1.0
    return max(wide, 4 * float(np.median(sd)) if sd is not None else 0.0, 1e-6)


def _mixture(edges: Array, sd: Array) -> tuple[Array, Array]:
    """Return the mean density of normal distributions with these widths."""
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
    thin = len(miss) // _MOST_MARKS + 1
    reach = _reach(miss, _predicted_um(results))
    # Each of up to `_STEPS` steps of equal number has a middle, a median and its standard error.
    groups = int(min(_STEPS, len(place) // _LEAST_IN_STEP))
    steps = np.array_split(np.argsort(place), groups) if groups else []
    middles, medians = ([float(np.median(values[s])) for s in steps] for values in (place, miss))
    error = [1.2533 * float(robust_sd(miss[s] - m) / np.sqrt(len(s)))
             for s, m in zip(steps, medians)]  # fmt: skip
    settings: dict[str, Any] = {
        "xlabel": f"{name} / mm",
        "ylabel": "ray miss / µm",
        "ylim": (-reach, reach),
    }
    with drawing(2.9, legend="above" if steps else "", **settings) as sheet:
        sheet.points = len(miss[::thin])
        sheet.axes.axhline(0, color=MUTED, linewidth=0.8)
        dots = {"alpha": 0.5, "markersize": 2.5 if len(miss) > 1000 else 5, "markeredgewidth": 0}
        sheet.axes.plot(place[::thin], miss[::thin], ".", color=camera_colour(0), **dots)
        if steps:
            line = {"fmt": "o-", "markersize": 3.5, "linewidth": 1.2, "label": "median of a step"}
            sheet.axes.errorbar(middles, medians, error, color=MODEL, **line)
    words = "There are too few points for it."
    if steps:
        most = int(np.argmax(np.abs(medians)))
        strays = number(abs(medians[most]), 2)
        words = f"It strays by up to {strays} ± {number(float(error[most]), 1)} µm."
    caption = (
        "The red line should lie on zero. A constant offset, a slope or a bow along it is the "
        f"calibration error, not an effect of the bubbles. {words}"
    )
    return Picture(f"Ray miss against {name}", sheet.source, caption)


def seen_where(results: TrackResults, index: int) -> Picture:
    """Draw how often each part of a camera's image saw bubbles, and mark detections in no track.

    index : number of the camera, from 0.
    """
    camera = results.cameras[index]
    table = results.detections[results.detections["camera"] == camera]
    uv = table[["u_px", "v_px"]].to_numpy(float)
    alone = uv[table["particle"].isna().to_numpy(bool)]
    size = stated = results.image_size_px(camera)
    if size is None:
        width, height = np.ceil(uv.max(axis=0)).astype(int) + 1 if len(uv) else (100, 100)
        size = int(width), int(height)
    cells = [max(2, round(_CELLS * n / max(size))) for n in size]
    edges = [np.linspace(-0.5, n - 0.5, k + 1) for n, k in zip(size, cells)]
    count, _ = np.histogramdd(uv, bins=edges)
    below = 0.75
    height_in = image_height_in(size) + below
    with drawing(height_in) as sheet:
        box, margin = sheet.axes.get_position(), below / height_in
        sheet.axes.set_position((box.x0, box.y0 + margin, box.width, box.height - margin))
        bar = sheet.figure.add_axes((box.x0, 0.42 / height_in, box.width, 0.1 / height_in))
        image_axes(sheet.axes, size)
        mesh = sheet.axes.pcolormesh(*edges, np.where(count.T > 0, count.T, np.nan), cmap="Blues",
                                     vmin=0, vmax=max(float(count.max()), 1.0))  # fmt: skip
        some = alone[:: len(alone) // _MOST_MARKS + 1]
        sheet.points = len(some)
        sheet.axes.plot(*some.T, ".", color=LEFT_OUT, markersize=4, markeredgewidth=0, alpha=0.7)
        label = "bubbles in a cell, all frames"
        sheet.figure.colorbar(mesh, cax=bar, orientation="horizontal", label=label)
    caption = "No bubble was found in this camera, or detections.csv is not in this folder."
    if len(uv):
        caption = (
            f"{number(len(uv))} bubbles; red: {number(len(alone))} ({share(len(alone), len(uv))}) "
            "in no track, which should not gather anywhere but at the border. "
            f"{int(np.sum(count == 0))} of {count.size} cells are empty."
        )
        if stated is None:
            caption += " The image may be larger: its size is not known here."
    return Picture(f"Bubbles in the image, camera {camera}", sheet.source, caption)


def shared_pictures(results: TrackResults) -> list[Any]:
    """Return (direction, name) of the coordinates against which the ray miss is drawn.

    The height is the first: an error of the angle between the cameras or of a scale shows there.
    """
    across = [i for i in range(3) if abs(results.up[i]) < 0.5]
    if len(results.cameras) > 2:  # their ray miss has no sign
        return []
    return [(results.up, "height"), *((np.eye(3)[i], "xyz"[i]) for i in across)]
