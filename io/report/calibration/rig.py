"""The rig from above, for paper and for browsers that cannot draw in 3-D."""

from __future__ import annotations

from typing import Any

import numpy as np

from telerig.io.report.calibration.results import CalibrationResults
from telerig.io.report.calibration.rig_outline import common_plane, rig_outline
from telerig.io.report.page.figures import MUTED, Picture, camera_colour, drawing, svg


def rig_plan(results: CalibrationResults) -> Picture:
    """Cameras, fields and targets, projected along the common perpendicular of the axes."""
    with drawing(4.2) as (figure, axes):
        draw_plan(axes, results)
        axes.legend(loc="upper right")
        source = svg(figure)
    caption = (
        "The plane of the optical axes, seen along their common perpendicular: the targets (grey) "
        "should fill where the fields overlap. Where the boxes stand along their axes is drawn, "
        "not measured."
    )
    return Picture("The rig in plan", source, caption)


def draw_plan(axes: Any, results: CalibrationResults) -> None:
    """Cameras, fields and all targets so far, in `common_plane`."""
    outline = rig_outline(results)
    plane = common_plane(results).T
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
        axes.plot(*(camera.axis_mm @ plane).T, color=colour, linewidth=1.2, label=camera.name)
    axes.set(xlabel="across the first axis / mm", ylabel="along the first axis / mm")
    axes.set_aspect("equal", adjustable="datalim")
