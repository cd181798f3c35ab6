"""How to hold the target next: as each camera would see it, and in plan."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.io.report.calibration.results import CalibrationResults
from telerig.io.report.calibration.rig import common_plane, draw_plan, plate_corners
from telerig.io.report.page.figures import (
    MODEL,
    MUTED,
    WIDTH_IN,
    Picture,
    camera_colour,
    drawing,
    image_axes,
)

_MOST_MARKERS = 2000
_GAP = 0.06
"""Between the two images, as a share of the width."""


_MARGIN = 1 / 12
"""Round the dots of the plate, over its longer side: about half a spacing."""


def next_pictures(results: CalibrationResults) -> list[Picture]:
    """Two pictures of the best pose; none in folders of before, or when no pose was found."""
    advice = results.file.diagnostics.next_view
    if not advice.get("poses") or len(results.cameras) != 2:
        return []
    pose = np.array(advice["poses"][0]["rig_from_target"], float).reshape(4, 4)
    return [_images(results, pose, advice), _plan(results, pose)]


def _moved(pose: Array, points_mm: Array) -> Array:
    return np.asarray(points_mm @ pose[:3, :3].T + pose[:3, 3])


def _images(results: CalibrationResults, pose: Array, advice: Mapping[str, Any]) -> Picture:
    corners = _moved(pose, plate_corners(results.points_mm, _MARGIN))
    dots = _moved(pose, results.points_mm)
    marked = np.isin(results.dot_ids, advice.get("marks") or [])
    share = (1 - 3 * _GAP) / 2
    ratio = max(c.image_size_px[1] / c.image_size_px[0] for c in results.cameras)
    height_in = WIDTH_IN * share * ratio + 0.45
    table = results.residuals
    with drawing(height_in) as sheet:
        both = (sheet.axes, sheet.figure.add_axes((0, 0, 1, 1)))
        for i, (camera, axes) in enumerate(zip(results.cameras, both)):
            axes.set_position((_GAP + i * (share + _GAP), 0.03, share, 1 - 0.45 / height_in))
            image_axes(axes, camera.image_size_px)
            axes.set(xlabel="", ylabel="", xticks=[], yticks=[])
            axes.set_title(f"camera {camera.name} sees", fontsize=8.5)
            uv = table.loc[(table["camera"] == camera.name) & table["kept"], ["u_px", "v_px"]]
            dot = {"markeredgewidth": 0, "rasterized": len(uv) > _MOST_MARKERS}
            axes.plot(*uv.to_numpy().T, ".", color=MUTED, alpha=0.45, markersize=3, **dot)
            outline = camera.project(corners)
            axes.fill(*outline.T, color=camera_colour(i), alpha=0.12, linewidth=0)
            axes.plot(*outline[[0, 1, 2, 3, 0]].T, color=camera_colour(i), linewidth=0.8)
            seen = camera.project(dots)
            for which, size in ((~marked, 4.0), (marked, 7.0)):
                axes.plot(*seen[which].T, "o", color=camera_colour(i), markersize=size, **dot)
            axes.plot(*outline[:2].T, color=MODEL, linewidth=2.2, solid_capstyle="butt")
    caption = (
        "The target as both cameras would see it (large: marks; red: the edge beside row 0, or of "
        "smallest y); grey: where dots were so far. Some degrees and millimetres more or less do "
        "not matter."
    )
    return Picture("How to hold it next", sheet.source, caption)


def _plan(results: CalibrationResults, pose: Array) -> Picture:
    corners = _moved(pose, plate_corners(results.points_mm, _MARGIN)) @ common_plane(results).T
    with drawing(4.2, legend="upper right") as sheet:
        draw_plan(sheet.axes, results)
        sheet.axes.fill(*corners.T, color=MODEL, alpha=0.15, linewidth=0)
        sheet.axes.plot(*corners[[0, 1, 2, 3, 0]].T, color=MODEL, linewidth=1.4, label="next")
        sheet.axes.plot(*corners[:2].T, color=MODEL, linewidth=3.0, solid_capstyle="butt")
    caption = (
        "The same in plan, seen along the common perpendicular of the optical axes, left and right "
        f"as camera {results.cameras[0].name} sees them; grey: the views so far."
    )
    return Picture("Where to hold it next", sheet.source, caption)
