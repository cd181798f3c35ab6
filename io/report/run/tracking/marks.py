"""Pictures of the marks fixed to the tank, as they cross the images of a tracked run."""

from __future__ import annotations

from typing import Any

import numpy as np

from telerig.io.report.page.figures import Picture, camera_colour, drawing, png, svg
from telerig.io.report.page.number_format import number
from telerig.io.report.run.tracking.numbers import median
from telerig.io.report.run.tracking.results import TrackResults
from telerig.io.report.run.tracking.scene import MANY_POINTS, SHADES

_MOST_POINTS = 8_000


def marks_followed(results: TrackResults, camera: int) -> Picture:
    """Where each mark is in the images of one camera that sees some, frame by frame."""
    name = results.cameras[camera]
    table = results.references[results.references["camera"] == name]
    along = max(("u_px", "v_px"), key=lambda c: float(np.ptp(table[c])))
    every = -(-len(table) // _MOST_POINTS)
    lines = [group.iloc[::every] for _, group in table.groupby("mark", sort=True)]
    with drawing(2.6) as (figure, axes):
        for line in lines:
            _draw(axes, line, along, every, camera_colour(camera))
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


def _draw(axes: Any, line: Any, along: str, every: int, colour: str) -> None:
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
