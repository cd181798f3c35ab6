"""Two rays of a bubble that miss each other: where they come closest, and the point between."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from telerig.arrays import Array
from telerig.io.report.page.figures import (
    LEFT_OUT,
    MUTED,
    WIDTH_IN,
    Picture,
    camera_colour,
    drawing,
)
from telerig.io.results.folders.tracking import TrackResults, outline_pixels, paired_rows
from telerig.rig.camera import Camera
from telerig.rig.triangulation import midpoint
from telerig.short_text import nice_below

_LOOK_DOWN_DEG, _LOOK_DOWN_CLOSE_DEG = 25.0, 11.0
_HEIGHT_IN = 2.5
_ZOOM = 1.6
_LEAST_MISS_MM = 1e-7


@dataclass(frozen=True)
class RayPair:
    """Two rays and where they come closest, in the rig frame.

    directions : (2, 3), of unit length.
    closest_mm : (2, 3), the point of each ray that is nearest to the other.
    middle_mm : (3,), half way.
    miss_mm : signed, from the first ray to the second along first direction x second direction.
    """

    directions: Array
    closest_mm: Array
    middle_mm: Array
    miss_mm: float


def ray_pair(
    origin_a_mm: ArrayLike, direction_a: ArrayLike, origin_b_mm: ArrayLike, direction_b: ArrayLike
) -> RayPair:
    """The closest points of two rays, each (3,). Raises GeometryError when they are parallel."""
    origins = np.array([origin_a_mm, origin_b_mm], float)
    directions = np.array([direction_a, direction_b], float)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    middle, miss = midpoint(origins[0], directions[0], origins[1], directions[1])
    across = np.cross(*directions)
    half = 0.5 * float(miss) * across / np.linalg.norm(across)
    return RayPair(directions, np.array([middle - half, middle + half]), middle,
                   float(miss))  # fmt: skip


def rays_of_row(results: TrackResults, cameras: tuple[Camera, ...], row: int) -> RayPair:
    """Return the rays of the outlines' centres in a row of tracks.csv, of the first two cameras
    that see it."""
    rays = [cameras[c].unproject(outline_pixels(results, np.array([row]))[0, c])
            for c in _seen_by(results, row)]  # fmt: skip
    return ray_pair(*rays[0], *rays[1])


def _seen_by(results: TrackResults, row: int) -> list[int]:
    """Return the first two cameras that see the bubble of a row."""
    seen = np.isfinite(outline_pixels(results, np.array([row]))[0]).all(-1)
    return [int(c) for c in np.flatnonzero(seen)[:2]]


def typical_row(results: TrackResults) -> int | None:
    """Return the row with the median ray miss; None if no bubble was seen twice."""
    rows = paired_rows(results)
    if not len(rows):
        return None
    miss = np.abs(results.tracks["ray_miss_mm"].to_numpy(float)[rows])
    return int(rows[np.argsort(miss, kind="stable")[len(rows) // 2]])


def two_rays(
    results: TrackResults, cameras: tuple[Camera, ...], row: int | None = None
) -> Picture | None:
    """The drawing of two rays (default: typical ones): the bubble with them, and a close-up.

    None where tracks.csv has no pair.
    """
    row = typical_row(results) if row is None else row
    if row is None:
        return None
    pair = rays_of_row(results, cameras, row)
    here = results.tracks.iloc[row]
    diameter = float(here["d_eq_mm"]) if np.isfinite(here["d_eq_mm"]) else 1.0
    names = [cameras[c].name for c in _seen_by(results, row)]
    with drawing(_HEIGHT_IN) as sheet:
        whole, close = sheet.axes, sheet.figure.add_axes((0, 0, 1, 1))
        _draw_whole(whole, pair, diameter, names, results.up)
        _draw_close(close, pair, names, results.up)
        width = 0.48
        height = width * WIDTH_IN / _HEIGHT_IN
        whole.set_position((0.005, 0.01, width, height))
        close.set_position((0.995 - width, 0.01, width, height))
        whole.set_title(f"bubble of {diameter:.3g} mm", fontsize=8.5)
        close.set_title("close-up, where they pass", fontsize=8.5)
    caption = (
        f"Bubble {int(here['particle'])} in frame {int(here['frame'])}, one with the run's "
        f"median ray miss: the rays of the two outlines' centres pass each other at "
        f"{1e3 * abs(pair.miss_mm):.3g} µm. Coloured dots are the points of each ray closest to "
        "the other, the cross half way between them is the triangulated point before shape and "
        "noise are weighed in. Arrows point away from the cameras."
    )
    return Picture("Two rays of one bubble", sheet.source, caption)


def _view(pair: RayPair, up: Array, look_down_deg: float) -> Array:
    """(2, 3) rows right and up on paper: between the two rays, looking down on them.

    The rays' common perpendicular appears upright, the way the rig's up points.
    """
    normal = np.cross(*pair.directions)
    normal /= np.linalg.norm(normal)
    normal = normal if normal @ up >= 0 else -normal
    away = pair.directions.sum(0)
    away /= np.linalg.norm(away)
    right = np.cross(away, normal)
    tilt = np.deg2rad(look_down_deg)
    return np.array([right, np.cos(tilt) * normal + np.sin(tilt) * away])


def _draw_rays(axes: Any, pair: RayPair, view: Array, reach_mm: float, names: list[str]) -> None:
    for i, (point, direction) in enumerate(zip(pair.closest_mm, pair.directions)):
        ends = (np.array([point - reach_mm * direction, point + reach_mm * direction])
                - pair.middle_mm) @ view.T  # fmt: skip
        colour = camera_colour(i)
        axes.annotate(
            "", ends[1], ends[0],
            arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.3, "shrinkA": 0,
                        "shrinkB": 0},
        )  # fmt: skip
        side = "right" if ends[0, 0] > ends[1, 0] else "left"
        upper = float(((point - pair.middle_mm) @ view.T)[1]) > 0.02 * reach_mm
        axes.annotate(names[i], ends[0], xytext=(0, 5 if upper else -5), color=colour, ha=side,
                      textcoords="offset points", va="bottom" if upper else "top")  # fmt: skip


def _draw_whole(axes: Any, pair: RayPair, diameter: float, names: list[str], up: Array) -> None:
    from matplotlib.patches import Circle

    view, reach = _view(pair, up, _LOOK_DOWN_DEG), 1.15 * diameter
    axes.add_patch(Circle((0, 0), diameter / 2, facecolor="#eef1f5", edgecolor=MUTED, lw=0.9))
    _draw_rays(axes, pair, view, reach, names)
    _length_bar(axes, diameter, 1.25 * diameter, "mm", 1.0)
    _bare(axes, 1.25 * diameter)


def _draw_close(axes: Any, pair: RayPair, names: list[str], up: Array) -> None:
    view = _view(pair, up, _LOOK_DOWN_CLOSE_DEG)
    miss = max(abs(pair.miss_mm), _LEAST_MISS_MM)
    _draw_rays(axes, pair, view, _ZOOM * miss, names)
    ends = (pair.closest_mm - pair.middle_mm) @ view.T
    axes.plot(*ends.T, color=LEFT_OUT, lw=1.2, ls=(0, (3, 2)))
    for i, end in enumerate(ends):
        axes.plot(*end, "o", ms=5, color=camera_colour(i))
    axes.plot(0, 0, "x", ms=7, mew=1.6, color="black")
    axes.annotate(f"{1e3 * abs(pair.miss_mm):.3g} µm", (0, 0), xytext=(9, 0), color=LEFT_OUT,
                  textcoords="offset points", va="center")  # fmt: skip
    reach = 1.25 * _ZOOM * miss
    _length_bar(axes, miss, reach, "µm", 1e3)
    _bare(axes, reach)


def _length_bar(axes: Any, about_mm: float, reach_mm: float, unit: str, per_mm: float) -> None:
    length = nice_below(about_mm * per_mm) / per_mm
    y = -0.9 * reach_mm
    axes.plot([-length / 2, length / 2], [y, y], color="black", lw=1.6, solid_capstyle="butt")
    axes.annotate(f"{length * per_mm:.3g} {unit}", (0, y), xytext=(0, 3), ha="center",
                  textcoords="offset points")  # fmt: skip


def _bare(axes: Any, reach_mm: float) -> None:
    axes.set(xlim=(-reach_mm, reach_mm), ylim=(-reach_mm, reach_mm), xticks=[], yticks=[])
    axes.set_aspect("equal")
    axes.spines[:].set_visible(True)
    axes.spines[:].set_color("#c4c9d1")
