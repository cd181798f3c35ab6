"""Where the dots lay in the images, and how the target was tilted."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.calibration.results import CalibrationResults
from telerig.io.report.page.figures import (
    MUTED,
    Picture,
    camera_colour,
    drawing,
    image_axes,
    image_height_in,
    svg,
)
from telerig.io.report.page.number_format import short_names

Array = NDArray[np.float64]

_CELLS = 6
_MOST_MARKERS = 2000
_MOST_LABELS = 30


def coverage(results: CalibrationResults, index: int) -> Picture:
    """Every kept dot of one camera over the image, and the cells that no dot reached."""
    camera = results.cameras[index]
    table = results.residuals
    mine = table[(table["camera"] == camera.name) & table["kept"]]
    uv = mine[["u_px", "v_px"]].to_numpy()
    size = camera.image_size_px
    edges = [np.linspace(-0.5, n - 0.5, _CELLS + 1) for n in size]
    count, _ = np.histogramdd(uv, bins=edges)
    with drawing(image_height_in(size)) as (figure, axes):
        image_axes(axes, size)
        axes.pcolormesh(
            *edges, np.where(count.T > 0, np.nan, 1.0), cmap="Reds", vmin=0, vmax=5,
            edgecolors="#e3e5e8", linewidth=0.4,
        )  # fmt: skip
        axes.plot(
            *uv.T, ".", color=camera_colour(index), markersize=5, markeredgewidth=0,
            alpha=0.7, rasterized=len(uv) > _MOST_MARKERS,
        )  # fmt: skip
        source = svg(figure)
    empty = int(np.sum(count == 0))
    caption = (
        f"{len(uv)} dots of all views; {empty} of {_CELLS**2} cells (red) were never reached, and "
        "there the distortion is extrapolated."
    )
    return Picture(f"Coverage, camera {camera.name}", source, caption)


def tilt_angles_rad(results: CalibrationResults, index: int) -> tuple[list[str], Array, Array]:
    """Views that a camera saw, tilt of the target against the image, and the tilt's direction.

    The tilt is the angle between the optical axis and the target's normal, 0 to pi/2; the
    direction is that of the normal towards the camera, in the image from +u towards +v.
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
    """Tilt and its direction for every view and camera, as a disc with 90 degrees at its rim."""
    every: list[float] = []
    with drawing(4.0) as (figure, axes):
        _disc(axes)
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
        source = svg(figure)
    span = f"from {min(every):.0f} to {max(every):.0f} degrees" if every else "unknown"
    caption = (
        f"One mark per view: distance from the middle is the tilt ({span}), direction is where the "
        "target leans in the image; marks should go round the disc at 20 to 70 degrees."
    )
    return Picture("Tilts of the target", source, caption)


def _disc(axes: Any) -> None:
    turn = np.linspace(0, 2 * np.pi, 91)
    for degrees in (30, 60, 90):
        axes.plot(degrees * np.cos(turn), degrees * np.sin(turn), color=MUTED, linewidth=0.6)
        axes.text(0, -degrees, f"{degrees}°", color=MUTED, ha="center", va="bottom", fontsize=7.5)
    axes.plot([-90, 90], [0, 0], [0, 0], [-90, 90], color=MUTED, linewidth=0.4)
    axes.text(92, 0, "+u", va="center", color=MUTED)
    axes.text(0, 93, "+v", ha="center", va="top", color=MUTED)
    axes.set(xlim=(-100, 104), ylim=(102, -100))
    axes.set_aspect("equal")
    axes.axis("off")
    box = axes.figure.bbox_inches
    axes.set_position((0.02, 0.02, 0.96, 1 - 0.04 * box.width / box.height))
