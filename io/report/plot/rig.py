"""Pictures of a calibrated rig: the rig, residuals, coverage, tilts, uncertainty in space."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from telerig.arrays import Array
from telerig.errors import InputError
from telerig.io.files.text import need_file
from telerig.io.report.plot.axes import (
    COLOURS,
    LEFT_OUT,
    MODEL,
    MUTED,
    axes_of,
    camera_colour,
    columns_of,
    finite,
    image_axes,
)
from telerig.io.report.plot.outline import common_plane, plate_corners, rig_outline
from telerig.io.results.calibration import read_uncertainty
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.short_text import nice_below, no_formula, number, short_names

__all__ = [
    "coverage", "residual_histogram", "residuals", "rig", "split_half", "target_in_image", "tilts",
    "uncertainty",
]  # fmt: skip

_RESIDUALS = "results/calibration/residuals.csv"
_LEAST_WEIGHT = 0.5
_LEVELS = 8
_MOST_ARROWS, _ARROW_CELLS = 1200, 24
_LONGEST = 0.12
"""Longest arrow of a dot that was left out, in image widths; the others are drawn to scale."""

_GRID = 6
_MOST_LABELS, _LABEL_DEG = 30, 12.0
"""Labels of views, which are left out where they would cover that of an earlier view."""

_FINER = 8
"""Steps of a map between the points of its grid, between which the variance is smooth."""

_MARGIN = 1 / 12
"""Round the dots of the plate, over its longer side: about half a spacing."""


def rig(
    cameras: Sequence[Camera],
    poses: Mapping[str, Pose],
    points_mm: Array,
    *,
    next_pose: Pose | None = None,
    axes: Any = None,
) -> Any:
    """Draw cameras, their fields and all poses of the target in the plane of the optical axes.

    It is seen along the common perpendicular of the axes. cameras, poses, points_mm : ``cameras``,
    ``target_poses`` and ``target_points_mm`` of a `telerig.Calibration`. next_pose :
    rig_from_target of a view that is recommended. Where the boxes of the cameras stand along their
    axes is drawn, not measured. Returns axes.
    """
    outline, plane = rig_outline(cameras, poses, points_mm), common_plane(cameras).T
    axes = axes_of(
        axes, xlabel=f"across the axis of {no_formula(cameras[0].name)} / mm",
        ylabel="along it / mm",
    )  # fmt: skip
    for plate in outline.plates_mm @ plane:
        axes.plot(*plate[[0, 1, 2, 3, 0]].T, color=MUTED, linewidth=0.7)
    for i, camera in enumerate(outline.cameras):
        colour = camera_colour(i)
        for box, alpha in ((camera.body_mm, 0.75), (camera.field_mm, 0.07)):
            corners = box.reshape(8, 3) @ plane
            low, high = np.split(corners, 2)
            quad = [low[np.argmin(low @ [1, -1])], low[np.argmax(low @ [1, -1])]]
            quad += [high[np.argmax(high @ [1, -1])], high[np.argmin(high @ [1, -1])]]
            axes.fill(*np.transpose(quad), color=colour, alpha=alpha, linewidth=0)
        name = no_formula(camera.name)
        axes.plot(*(camera.axis_mm @ plane).T, color=colour, linewidth=1.2, label=name)
    if next_pose is not None:
        corners = next_pose.apply(plate_corners(points_mm, _MARGIN)) @ plane
        axes.fill(*corners.T, color=MODEL, alpha=0.15, linewidth=0)
        axes.plot(*corners[[0, 1, 2, 3, 0]].T, color=MODEL, linewidth=1.4, label="next")
        axes.plot(*corners[:2].T, color=MODEL, linewidth=3.0, solid_capstyle="butt")
    axes.set_aspect("equal", adjustable="datalim")
    return axes


def target_in_image(
    camera: Camera,
    pose: Pose,
    points_mm: Array,
    *,
    marks: Collection[int] = (),
    index: int = 0,
    table: pd.DataFrame | None = None,
    axes: Any = None,
) -> Any:
    """Draw the target in a pose as a camera sees it; returns axes.

    pose : rig_from_target. points_mm : (N, 3). marks : places in it of larger dots. index : number
    of the camera, for its colour. table : residuals.csv, whose dots are drawn in grey. The edge
    beside row 0, or of smallest y, is red.
    """
    axes = image_axes(axes_of(axes), camera.image_size_px)
    dot = {"markeredgewidth": 0}
    if table is not None:
        seen = table[(table["camera"] == camera.name) & (table["weight"] > _LEAST_WEIGHT)]
        axes.plot(seen["u_px"], seen["v_px"], ".", color=MUTED, alpha=0.45, markersize=3, **dot)
    edge = camera.project(pose.apply(plate_corners(points_mm, _MARGIN)))
    colour = camera_colour(index)
    axes.fill(*edge.T, color=colour, alpha=0.12, linewidth=0)
    axes.plot(*edge[[0, 1, 2, 3, 0]].T, color=colour, linewidth=0.8)
    uv, large = camera.project(pose.apply(points_mm)), np.zeros(len(points_mm), bool)
    large[list(marks)] = True
    for which, size in ((~large, 4.0), (large, 7.0)):
        axes.plot(*uv[which].T, "o", color=colour, markersize=size, **dot)
    axes.plot(*edge[:2].T, color=MODEL, linewidth=2.2, solid_capstyle="butt")
    return axes


def residuals(
    table: pd.DataFrame,
    camera: str,
    image_size_px: tuple[int, int] | None = None,
    *,
    magnified: float | None = None,
    colour: str = COLOURS[0],
    axes: Any = None,
) -> Any:
    """Draw an arrow from the predicted towards the measured place of each dot; returns axes.

    table : residuals.csv of a calibration. camera : its name. image_size_px : (width, height); None
    for what the dots cover. magnified : how many times as long as true the arrows are drawn; None
    for a twentieth of the image at the 90 % quantile.

    Arrows of dots that were left out are red and cut. Of more than 1,200 dots the means over cells
    are drawn. Raises InputError for a camera without dots.
    """
    mine = _of_camera(table, camera)
    u, v, du, dv, weight = columns_of(
        mine, "u_px", "v_px", "du_px", "dv_px", "weight", made_by=_RESIDUALS
    )
    kept = weight > _LEAST_WEIGHT
    start, arrow = np.c_[u, v], np.c_[du, dv]
    finite(u[kept], v[kept])
    typical = float(np.quantile(np.hypot(*arrow[kept].T), 0.9))
    width = float(image_size_px[0] if image_size_px else np.ptp(u) or 1.0)
    if magnified is None:
        magnified = nice_below(0.05 * width / typical) if typical > 0 else 1.0
    axes = image_axes(axes_of(axes), image_size_px)
    shown, mean = _means(start[kept], arrow[kept], max(image_size_px or (width, width)))
    quiver = _quiver(axes, shown, magnified * mean, colour)
    strange = magnified * arrow[~kept]
    length = np.maximum(np.hypot(*strange.T), 1e-300)[:, None]
    _quiver(axes, start[~kept], strange * np.minimum(1.0, _LONGEST * width / length), LEFT_OUT)
    key_px = nice_below(0.15 * width / magnified)
    axes.set_title(" ", fontsize=8)  # room for the key
    axes.quiverkey(
        quiver, 0.02, 1.04, key_px * magnified,
        f"{number(key_px, 1)} px, drawn {magnified:,g} times as long",
        labelpos="E", coordinates="axes", labelsep=0.06,
    )  # fmt: skip
    return axes


def _quiver(axes: Any, start: Array, arrow: Array, colour: str) -> Any:
    return axes.quiver(
        *start.T, *arrow.T, color=colour, angles="xy", scale_units="xy", scale=1,
        width=0.0032, headwidth=4, headlength=4, headaxislength=3.5,
    )  # fmt: skip


def _means(start: Array, arrow: Array, size_px: float) -> tuple[Array, Array]:
    """Return start and residual (N, 2) of each arrow; means over cells if there are too many."""
    if len(start) <= _MOST_ARROWS:
        return start, arrow
    cells = np.floor((start + 0.5) / (size_px / _ARROW_CELLS)).astype(int)
    place = cells @ [1, 4 * _ARROW_CELLS]
    _, member, count = np.unique(place, return_inverse=True, return_counts=True)
    sums = np.zeros((len(count), 4))
    np.add.at(sums, member, np.c_[start, arrow])
    means = sums / count[:, None]
    return means[:, :2], means[:, 2:]


def residual_histogram(table: pd.DataFrame, *, axes: Any = None) -> Any:
    """Draw the distribution of the residuals beside the normal one that is predicted; returns axes.

    table : residuals.csv; with ``whitened_u``, ``whitened_v`` (from `read_calibration_results`),
    residuals over their own noise beside the unit normal, otherwise in px beside that of their RMS.
    """
    whitened = "whitened_u" in table
    names = ("whitened_u", "whitened_v") if whitened else ("du_px", "dv_px")
    *columns, weight = columns_of(table, *names, "weight", made_by=_RESIDUALS)
    kept = weight > _LEAST_WEIGHT
    values = np.stack(columns, 1)
    finite(values[kept].ravel())
    sigma = 1.0 if whitened else float(np.sqrt(np.mean(values[kept] ** 2))) or 1.0
    edges = np.linspace(-5, 5, 41) * sigma
    xlabel = "residual / its sigma" if whitened else "residual / px"
    axes = axes_of(axes, xlabel=xlabel, ylabel="density", xlim=(edges[0], edges[-1]))
    for i, name in enumerate(pd.unique(table["camera"])):
        mine = values[kept & (table["camera"] == name).to_numpy()]
        count, _ = np.histogram(mine, edges)
        axes.stairs(
            count / max(mine.size, 1) / np.diff(edges), edges, color=camera_colour(i),
            linewidth=1.4, label=no_formula(name), fill=i == 0, alpha=0.45 if i == 0 else 1,
        )  # fmt: skip
    x = np.linspace(edges[0], edges[-1], 120)
    curve = np.exp(-0.5 * (x / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
    axes.plot(x, curve, color="black", label="predicted" if whitened else "normal")
    axes.set_ylim(0, None)
    return axes


def coverage(
    table: pd.DataFrame,
    camera: str,
    image_size_px: tuple[int, int] | None = None,
    *,
    colour: str = COLOURS[0],
    axes: Any = None,
) -> Any:
    """Draw where in a camera's images dots or bubbles were measured; returns axes.

    table : residuals.csv, dots.csv or detections.csv. image_size_px : (width, height); None for
    what the points cover. Cells of the image without a dot are red; so are detections that
    belong to no track. Raises InputError for a camera without points.
    """
    mine = _of_camera(table, camera)
    u, v = columns_of(mine, "u_px", "v_px", made_by=_RESIDUALS)
    bubbles = "particle" in mine
    alone = mine["particle"].isna().to_numpy() if bubbles else np.zeros(len(u), bool)
    if "weight" in mine:
        good = mine["weight"].to_numpy(float) > _LEAST_WEIGHT
        u, v, alone = u[good], v[good], alone[good]
    finite(u, v)
    axes = image_axes(axes_of(axes), image_size_px)
    if image_size_px is not None:
        edges = [np.linspace(-0.5, n - 0.5, _GRID + 1) for n in image_size_px]
        count, _ = np.histogramdd(np.c_[u, v], bins=edges)
        axes.pcolormesh(
            *edges, np.where((count.T > 0) | bubbles, np.nan, 1.0), cmap="Reds", vmin=0, vmax=5,
            edgecolors="#e3e5e8", linewidth=0.4,
        )  # fmt: skip
    dots = {"markersize": 4, "alpha": 0.6, "markeredgewidth": 0}
    axes.plot(u[~alone], v[~alone], ".", color=colour, **dots)
    if alone.any():
        axes.plot(u[alone], v[alone], ".", color=LEFT_OUT, **dots)
    return axes


def tilt_angles_rad(camera: Camera, poses: Mapping[str, Pose]) -> tuple[Array, Array]:
    """Return the target's tilt (0 to pi/2) in each view, (V,), and the tilt's direction, (V,).

    The direction is that of the normal towards the camera, in the image from +u towards +v.
    """
    rotations = np.array([pose.rotation for pose in poses.values()]).reshape(-1, 3, 3)
    normal = (camera.camera_from_rig.rotation @ rotations)[:, :, 2]
    normal = -np.where(normal[:, 2:] > 0, normal, -normal)
    tilt = np.arctan2(np.hypot(normal[:, 0], normal[:, 1]), -normal[:, 2])
    return tilt, np.arctan2(normal[:, 1], normal[:, 0])


def tilts(
    cameras: Sequence[Camera], poses: Mapping[str, Pose], table: pd.DataFrame, *, axes: Any = None
) -> Any:
    """Draw the target's tilt and its direction in each view on a disc, 90 degrees at its rim.

    cameras, poses, table : ``cameras``, ``target_poses`` and ``residuals`` of a
    `telerig.Calibration`; only the views that a camera saw are drawn for it. Returns axes.
    """
    axes, turn = axes_of(axes), np.linspace(0, 2 * np.pi, 91)
    for degrees in (30, 60, 90):
        axes.plot(degrees * np.cos(turn), degrees * np.sin(turn), color=MUTED, linewidth=0.6)
        words = {"color": MUTED, "ha": "center", "va": "bottom", "fontsize": 7.5}
        axes.text(0, -degrees, f"{degrees}°", **words)
    for i, camera in enumerate(cameras):
        seen = set(table.loc[table["camera"] == camera.name, "view"])
        views = {name: pose for name, pose in poses.items() if name in seen}
        tilt, direction = tilt_angles_rad(camera, views)
        x, y = np.degrees(tilt) * (np.cos(direction), np.sin(direction))
        label = no_formula(camera.name)
        axes.plot(x, y, "o^sD"[i % 4], color=camera_colour(i), markersize=5, label=label)
        for k, view in enumerate(short_names(list(views)) if len(views) <= _MOST_LABELS else ()):
            if np.hypot(x[:k] - x[k], y[:k] - y[k]).min(initial=np.inf) > _LABEL_DEG:
                text = {"textcoords": "offset points", "fontsize": 7}
                axes.annotate(no_formula(view), (x[k], y[k]), (4, 3), **text)
    axes.set(xlim=(-95, 95), ylim=(95, -95), aspect="equal")
    axes.set_axis_off()
    return axes


def uncertainty(
    source: str | PathLike[str] | Mapping[str, Array],
    share: Literal["calibration", "measurement"] = "calibration",
    *,
    across: Literal["x", "y"] = "x",
    axes: Any = None,
) -> Any:
    """Draw one standard deviation of a point's position over a plane of the rig, in µm.

    It is √(sx² + sy² + sz²). source : uncertainty.npz of a calibration, or its arrays points_mm
    (N, 3), a regular grid, and <share>_mm2 (N, 3, 3). share : the calibration's, or that of the
    pixels. across : the plane is that of this axis and z, nearest to the origin; both optical axes
    are near that of x where the cameras stand side by side, and near that of y where one stands
    above the other. Returns axes. Raises InputError for a file that is not one.
    """
    from scipy.interpolate import RectBivariateSpline

    if isinstance(source, Mapping):
        arrays = source
    else:
        need_file(Path(source))
        arrays = read_uncertainty(Path(source))
    name = f"{share}_mm2"
    if "points_mm" not in arrays or name not in arrays:
        what = f"holds no {name}"
        raise InputError(what, where="telerig.plot.uncertainty", todo="give uncertainty.npz")
    side, z, sd_um = sd_in_plane(arrays, name, "xy".index(across))
    degrees = [min(3, len(nodes) - 1) for nodes in (side, z)]
    variance = RectBivariateSpline(side, z, sd_um**2, kx=degrees[0], ky=degrees[1])
    side, z = (np.linspace(x[0], x[-1], _FINER * (len(x) - 1) + 1) for x in (side, z))
    sd_um = np.sqrt(np.maximum(variance(side, z), 0.0))
    axes = axes_of(axes, xlabel=f"{across} / mm", ylabel="z / mm", aspect="equal")
    drawn = axes.contourf(side, z, sd_um.T, levels=_LEVELS, cmap="viridis")
    axes.figure.colorbar(drawn, ax=axes, label=f"1 sd / µm, share of the {share}")
    return axes


def sd_in_plane(arrays: Mapping[str, Array], name: str, across: int) -> tuple[Array, Array, Array]:
    """Return a grid's coordinates across (S,) and along z (Z,) in mm, and sds (S, Z) in µm.

    name : of covariances (N, 3, 3) in ``arrays``. across : 0 for x, 1 for y.
    """
    points = arrays["points_mm"]
    sd_um = 1e3 * np.sqrt(np.trace(arrays[name], axis1=-2, axis2=-1))
    flat = in_plane(points, across)
    side, z = (np.unique(points[flat, i]) for i in (across, 2))
    return side, z, sd_um[flat].reshape(len(side), len(z))


def in_plane(points_mm: Array, across: int) -> Array:
    """Return which points (N, 3) of a grid lie in the plane of ``across`` and z, (N,)."""
    level = np.abs(points_mm[:, 1 - across])
    return np.asarray(level <= level.min() + 1e-6)


def split_half(
    halves: Mapping[str, Any], *, across: Literal["x", "y"] = "x", axes: Any = None
) -> Any:
    """Draw how calibrations from two halves of the views differ, and what is predicted.

    Arrows show by how much the halves place the same pixels differently, circles have the radius of
    one predicted standard deviation of that. halves : ``diagnostics["halves"]`` of a
    `telerig.Calibration`. across : as for `uncertainty`. Returns axes.
    """
    from matplotlib.patches import Circle

    points, shift, sd = (
        np.array(halves[name], float).reshape(-1, 3) for name in ("points_mm", "shift_um", "sd_um")
    )
    flat, sides = in_plane(points, "xy".index(across)), ["xy".index(across), 2]
    x, z = points[flat][:, sides].T
    spacing = np.ptp(x) / max(len(np.unique(x)) - 1, 1)
    longest = float(np.hypot(*shift[flat][:, sides].T).max())
    factor = 0.7 * spacing / max(longest, float(sd.max()), 1e-9)
    axes = axes_of(axes, xlabel=f"{across} / mm", ylabel="z / mm")
    for a, b, s in zip(x, z, sd[flat]):
        radius = factor * float(np.sqrt(np.mean(s[sides] ** 2)))
        axes.add_patch(Circle((a, b), radius, facecolor=MUTED, alpha=0.25, linewidth=0))
    arrow = factor * shift[flat][:, sides]
    axes.quiver(x, z, *arrow.T, angles="xy", scale_units="xy", scale=1, color=MODEL, width=0.006)
    axes.update_datalim(np.stack([x, z], -1) + arrow)
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="datalim")
    return axes


def _of_camera(table: pd.DataFrame, camera: str) -> pd.DataFrame:
    """Return the rows of a camera. Raises InputError if there are none."""
    if "camera" not in table:
        raise InputError(
            "the table has no column camera", where="telerig.plot", todo=f"give {_RESIDUALS}"
        )
    mine = table[table["camera"] == camera]
    if not len(mine):
        known = ", ".join(sorted(table["camera"].astype(str).unique()))
        raise InputError(
            f"there is no camera {camera!r}", where="telerig.plot", todo=f"it has {known}"
        )
    return mine
