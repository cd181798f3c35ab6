"""Pictures of a calibration: residuals and coverage of the images, tilts, uncertainty in space."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.io.report import plot
from telerig.io.report.calibration.rig import common_plane
from telerig.io.report.page.figures import (
    LEFT_OUT,
    MODEL,
    MUTED,
    WIDTH_IN,
    Picture,
    camera_colour,
    drawing,
    image_axes,
    image_height_in,
)
from telerig.io.report.plot.rig import in_plane, sd_in_plane
from telerig.io.results.folders.calibration import CalibrationResults
from telerig.short_text import nice_below, number, short_names

MOST_ARROWS = 1200
_ARROW_CELLS = 24
_LONGEST = 0.12
"""Longest arrow of a dot that was left out, in image widths; the others are drawn to scale."""


def residual_field(results: CalibrationResults, index: int) -> Picture:
    """Draw arrows from the predicted towards the measured place of every dot of one camera."""
    camera = results.cameras[index]
    table = results.residuals[results.residuals["camera"] == camera.name]
    kept, left_out = table[table["kept"]], table[~table["kept"]]
    typical = float(kept["length_px"].quantile(0.9)) if len(kept) else 0.0
    width = camera.image_size_px[0]
    magnified = nice_below(0.05 * width / typical) if typical > 0 else 1.0
    start, arrow, averaged = _arrows(kept, camera.image_size_px)
    above = 0.28
    height = image_height_in(camera.image_size_px, above)
    with drawing(height) as sheet:
        box = sheet.axes.get_position()
        sheet.axes.set_position((box.x0, box.y0, box.width, box.height - above / height))
        image_axes(sheet.axes, camera.image_size_px)
        quiver = _quiver(sheet.axes, start, arrow * magnified, camera_colour(index))
        strange = magnified * left_out[["du_px", "dv_px"]].to_numpy()
        length = np.maximum(np.hypot(*strange.T), 1e-300)[:, None]
        strange = strange * np.minimum(1.0, _LONGEST * width / length)
        _quiver(sheet.axes, left_out[["u_px", "v_px"]].to_numpy(), strange, LEFT_OUT)
        key_px = nice_below(0.15 * width / magnified)
        sheet.axes.quiverkey(
            quiver, 0.02, 1 + 0.5 * above / height, key_px * magnified,
            f"{number(key_px, 1)} px, drawn {magnified:,g} times as long",
            labelpos="E", coordinates="axes", labelsep=0.06,
        )  # fmt: skip
    caption = (
        "Arrows in all directions are noise; arrows that swirl or point outwards together "
        "are distortion that the model misses."
    )
    if averaged:
        caption += " There are too many dots for one arrow each: each arrow is the mean of a cell."
    if len(left_out):
        caption += f" Red: {len(left_out)} left out, cut to {_LONGEST:.0%} of the image's width."
    return Picture(f"Residuals, camera {camera.name}", sheet.source, caption)


def _quiver(axes: Any, start: Array, arrow: Array, colour: str) -> Any:
    return axes.quiver(
        *start.T, *arrow.T, color=colour, angles="xy", scale_units="xy", scale=1,
        width=0.0032, headwidth=4, headlength=4, headaxislength=3.5,
    )  # fmt: skip


def _arrows(table: pd.DataFrame, size_px: tuple[int, int]) -> tuple[Array, Array, bool]:
    """Return start and residual of each arrow; means over cells if there are too many dots."""
    start = table[["u_px", "v_px"]].to_numpy()
    arrow = table[["du_px", "dv_px"]].to_numpy()
    if len(table) <= MOST_ARROWS:
        return start, arrow, False
    cell_px = max(size_px) / _ARROW_CELLS
    place = np.floor((start + 0.5) / cell_px).astype(int) @ [1, 4 * _ARROW_CELLS]
    cells, member, count = np.unique(place, return_inverse=True, return_counts=True)
    sums = np.zeros((len(cells), 4))
    np.add.at(sums, member, np.c_[start, arrow])
    means = sums / count[:, None]
    return means[:, :2], means[:, 2:], True


def residual_histogram(results: CalibrationResults) -> Picture:
    """Draw all residual coordinates against the normal distribution that the noise predicts."""
    table = results.residuals
    whitened = "whitened_u" in table
    columns = ["whitened_u", "whitened_v"] if whitened else ["du_px", "dv_px"]
    kept = table.loc[table["kept"], columns].to_numpy().ravel()
    rms = float(np.sqrt(np.mean(kept**2))) if len(kept) else float("nan")
    sigma = 1.0 if whitened or not rms > 0 else rms
    edges = np.linspace(-5, 5, 41) * sigma
    xlabel = "residual / its sigma" if whitened else "residual / px"
    with drawing(2.9, legend="above", xlabel=xlabel, ylabel="density") as sheet:
        for i, name in enumerate(results.camera_names):
            mine = table.loc[table["kept"] & (table["camera"] == name), columns].to_numpy()
            count, _ = np.histogram(mine, edges)
            sheet.axes.stairs(
                count / max(mine.size, 1) / np.diff(edges), edges, color=camera_colour(i),
                linewidth=1.4, label=name, fill=i == 0, alpha=0.45 if i == 0 else 1,
            )  # fmt: skip
        x = np.linspace(edges[0], edges[-1], 120)
        curve = np.exp(-0.5 * (x / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
        label = "unit normal" if whitened else f"normal, sigma {number(sigma)} px"
        sheet.axes.plot(x, curve, color="black", label=label)
        sheet.axes.set(xlim=(edges[0], edges[-1]), ylim=(0, None))
    if whitened:
        caption = (
            "Residuals over their own predicted noise should follow the black curve, a little "
            f"narrower because they were fitted (here {number(rms)}); fat tails are outliers."
        )
    else:
        caption = (
            "Steps should follow the curve, a normal distribution of the same RMS; fat tails are "
            "outliers."
        )
    beyond = int(np.sum(np.abs(kept) > edges[-1]))
    caption += f" {beyond} kept values lie beyond the plot." if beyond else ""
    return Picture("Distribution of the residuals", sheet.source, caption)


_GRID = 6
_MOST_MARKERS = 2000
_MOST_LABELS = 30


def coverage(results: CalibrationResults, index: int) -> Picture:
    """Draw every kept dot of one camera over the image, and the cells that no dot reached."""
    camera = results.cameras[index]
    table = results.residuals
    mine = table[(table["camera"] == camera.name) & table["kept"]]
    uv = mine[["u_px", "v_px"]].to_numpy()
    size = camera.image_size_px
    edges = [np.linspace(-0.5, n - 0.5, _GRID + 1) for n in size]
    count, _ = np.histogramdd(uv, bins=edges)
    with drawing(image_height_in(size)) as sheet:
        image_axes(sheet.axes, size)
        sheet.axes.pcolormesh(
            *edges, np.where(count.T > 0, np.nan, 1.0), cmap="Reds", vmin=0, vmax=5,
            edgecolors="#e3e5e8", linewidth=0.4,
        )  # fmt: skip
        sheet.axes.plot(
            *uv.T, ".", color=camera_colour(index), markersize=5, markeredgewidth=0,
            alpha=0.7, rasterized=len(uv) > _MOST_MARKERS,
        )  # fmt: skip
    caption = (
        f"{len(uv)} dots of all views; {int(np.sum(count == 0))} of {_GRID**2} cells (red) were "
        "never reached, and there the distortion is extrapolated."
    )
    return Picture(f"Coverage, camera {camera.name}", sheet.source, caption)


def tilt_angles_rad(results: CalibrationResults, index: int) -> tuple[list[str], Array, Array]:
    """Return the views that a camera saw, the target's tilt (0 to pi/2) and the tilt's direction.

    The direction is that of the normal towards the camera, in the image from +u towards +v.
    """
    camera = results.cameras[index]
    seen = set(results.residuals.loc[results.residuals["camera"] == camera.name, "view"])
    views = [view for view in results.views if view in seen]
    rotations = np.array([results.views[view].rotation for view in views]).reshape(-1, 3, 3)
    normal = (camera.camera_from_rig.rotation @ rotations)[:, :, 2]
    normal = -np.where(normal[:, 2:] > 0, normal, -normal)
    tilt = np.arctan2(np.hypot(normal[:, 0], normal[:, 1]), -normal[:, 2])
    return views, tilt, np.arctan2(normal[:, 1], normal[:, 0])


def tilts(results: CalibrationResults) -> Picture:
    """Draw tilt and its direction for every view and camera on a disc, 90 degrees at its rim."""
    every: list[float] = []
    turn = np.linspace(0, 2 * np.pi, 91)
    with drawing(4.0) as sheet:
        axes, thin = sheet.axes, {"color": MUTED, "linewidth": 0.4}
        for degrees in (30, 60, 90):
            axes.plot(degrees * np.cos(turn), degrees * np.sin(turn), color=MUTED, linewidth=0.6)
            words = {"color": MUTED, "ha": "center", "va": "bottom", "fontsize": 7.5}
            axes.text(0, -degrees, f"{degrees}°", **words)
        axes.plot([-90, 90], [0, 0], [0, 0], [-90, 90], **thin)
        axes.text(92, 0, "+u", va="center", color=MUTED)
        axes.text(0, 93, "+v", ha="center", va="top", color=MUTED)
        axes.set(xlim=(-100, 104), ylim=(102, -100), aspect="equal")
        axes.axis("off")
        axes.set_position((0.02, 0.02, 0.96, 1 - 0.04 * WIDTH_IN / 4.0))
        for i, camera in enumerate(results.cameras):
            views, tilt, direction = tilt_angles_rad(results, i)
            radius = np.degrees(tilt)
            every.extend(radius)
            x, y = radius * np.cos(direction), radius * np.sin(direction)
            axes.plot(x, y, "o^sD"[i % 4], color=camera_colour(i), markersize=5, label=camera.name)
            if len(views) <= _MOST_LABELS:
                for view, a, b in zip(short_names(views), x, y):
                    axes.annotate(view, (a, b), (4, 3), textcoords="offset points", fontsize=7)
        axes.legend(loc="upper left", bbox_to_anchor=(-0.1, 1.04))
    span = f"from {min(every):.0f} to {max(every):.0f} degrees" if every else "unknown"
    caption = (
        f"One mark per view: distance from the middle is the tilt ({span}), direction is where the "
        "target leans in the image; marks should go round the disc at 20 to 60 degrees."
    )
    return Picture("Tilts of the target", sheet.source, caption)


Share = Literal["calibration", "measurement"]
_SIDES: tuple[Literal["x", "y"], ...] = ("x", "y")


def trust_pictures(results: CalibrationResults) -> list[Picture]:
    """Return the pictures of which the folder has data; a single camera has none."""
    found = []
    if results.uncertainty:
        maps = [_map(results, of, *words) for of, words in _SHARES.items()]
        found += [picture for picture in maps if picture is not None]
    halves = results.file.diagnostics.halves
    if "points_mm" in halves:
        found.append(_split_half(halves, _across(results)))
    return found


_SHARES: dict[Share, tuple[str, str]] = {
    "calibration": (
        "Uncertainty: the calibration's share",
        "Standard deviation in µm of a point's position in the rig frame due to the calibration "
        "alone, √(sx² + sy² + sz²), for points in the plane of the rig frame nearest to both "
        "optical axes. Points of a run that lie near each other share this error: it cancels in "
        "their differences.",
    ),
    "measurement": (
        "Uncertainty: the pixels' share",
        "Standard deviation in µm of a point triangulated from both cameras, √(sx² + sy² + sz²), "
        "if its pixel noise is that of this calibration's dots ({sigma} px). These errors are "
        "independent from point to point, and proportional to the pixel noise.",
    ),
}


def _across(results: CalibrationResults) -> int:
    """Return which rig axis, x (0) or y (1), is nearer to the plane of the optical axes."""
    return int(np.argmax(np.abs(common_plane(results)[0, :2])))


def _is_flat(grid: Array) -> bool:
    return bool(np.ptp(grid) <= 1e-3 * grid.max())


def _map(results: CalibrationResults, of: Share, title: str, caption: str) -> Picture | None:
    """Draw a map; None for a uniform one, which `same_everywhere` states in words."""
    across = _across(results)
    grid = sd_in_plane(results.uncertainty, f"{of}_mm2", across)[2]
    if _is_flat(grid):
        return None
    with drawing(3.6) as sheet:
        plot.uncertainty(results.uncertainty, of, across=_SIDES[across], axes=sheet.axes)
    caption = caption.format(sigma=number(float(results.uncertainty["sigma_px"]), 3))
    caption += f" {number(grid.min(), 3)} to {number(grid.max(), 3)} µm."
    return Picture(title, sheet.source, caption)


def same_everywhere(results: CalibrationResults) -> str:
    """Return a sentence on a pixels' share that is uniform; "" if it has a picture."""
    arrays = results.uncertainty
    grid = sd_in_plane(arrays, "measurement_mm2", _across(results))[2] if arrays else np.zeros(0)
    if not grid.size or not _is_flat(grid):
        return ""
    sigma = number(float(arrays["sigma_px"]), 3)
    return (
        f"the pixels' share of a point's uncertainty is {number(float(grid.mean()), 3)} µm "
        f"everywhere (1 sd, all axes together), for the noise of this calibration's dots ({sigma} "
        "px)"
    )


def _split_half(halves: Mapping[str, Any], across: int) -> Picture:
    """Draw how the halves of the views differ as arrows, and what is predicted as circles."""
    from matplotlib.patches import Circle

    points, shift, sd = (
        np.array(halves[name], float).reshape(-1, 3) for name in ("points_mm", "shift_um", "sd_um")
    )
    flat, sides = in_plane(points, across), [across, 2]
    x, z = points[flat][:, sides].T
    spacing = np.ptp(x) / max(len(np.unique(x)) - 1, 1)
    longest = float(np.hypot(*shift[flat][:, sides].T).max())
    factor = 0.7 * spacing / max(longest, float(sd.max()), 1e-9)
    with drawing(3.9, xlabel=f"{'xy'[across]} / mm", ylabel="z / mm") as sheet:
        for a, b, s in zip(x, z, sd[flat]):
            radius = factor * float(np.sqrt(np.mean(s[sides] ** 2)))
            sheet.axes.add_patch(Circle((a, b), radius, facecolor=MUTED, alpha=0.25, linewidth=0))
        arrow = factor * shift[flat][:, sides]
        sheet.axes.quiver(x, z, *arrow.T, angles="xy", scale_units="xy", scale=1, color=MODEL,
                          width=0.006)  # fmt: skip
        sheet.axes.update_datalim(np.stack([x, z], -1) + arrow)
        sheet.axes.autoscale_view()
        sheet.axes.set_aspect("equal", adjustable="datalim")
    caption = (
        f"Split-half check. Arrows show by how much a calibration from {halves['views'][0]} views "
        f"and one from the other {halves['views'][1]} place the same pixels differently (longest "
        f"{number(longest, 2)} µm). Grey circles have the radius of one predicted standard "
        "deviation of that difference. Neighbouring arrows are alike, because the difference is "
        "mostly a rotation and a scale. If most arrows are much longer than the radius, the "
        "covariance is too small."
    )
    return Picture("Split-half check", sheet.source, caption)
