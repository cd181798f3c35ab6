"""The bubbles' section of a smoothed run's report: sizes, velocities, drag, shape in time."""

from __future__ import annotations

from typing import Any

import numpy as np

from telerig.io.report import plot
from telerig.io.report.page.figures import Curve, Picture, draw_curves, drawing
from telerig.io.report.page.page import Figure, Row
from telerig.io.report.run.tracking.scene import track_colour
from telerig.io.results.folders.smoothing import SmoothingResults, column
from telerig.short_text import number, with_sd
from telerig.statistics import median

MOST_ROWS = 40
LEAST_MANY = 10
"""Fewer bubbles are no swarm: they say next to nothing of a distribution or of a volume."""
_MOST_LINES = 12
_NO_LIQUID = (
    "For Reynolds, Weber and Eötvös numbers, drag and published laws, describe the liquid under "
    "[fluid] in rig.toml and smooth again."
)


def size_picture(results: SmoothingResults) -> Picture | None:
    """Draw the distribution of the diameters by number and by volume."""
    d = column(results.bubble_summary, "d_eq_mm")
    if np.isfinite(d).sum() < LEAST_MANY:
        return None
    with drawing(2.6, legend="above") as sheet:
        plot.sizes(results.bubble_summary, axes=sheet.axes)
    caption = (
        "Every bubble once, also those that the border cuts; blue by number, orange by volume. "
        f"Dashed: the means of these {np.isfinite(d).sum()} bubbles, which are not corrected for "
        "the border."
    )
    return Picture("Sizes of the bubbles", sheet.source, caption)


def velocity_picture(results: SmoothingResults) -> Picture | None:
    """Draw mean speed against diameter, beside published laws."""
    d = column(results.bubble_summary, "d_eq_mm")
    if not (np.isfinite(d) & np.isfinite(column(results.bubble_summary, "slip_mm_s"))).any():
        return None
    fluid = results.file.fluid or None
    with drawing(3.4) as sheet:
        plot.velocity(results.bubble_summary, fluid, axes=sheet.axes)
        _legend_below(sheet)
    caption = (
        "Mean speed along the path, relative to the liquid, against the diameter of the sphere of "
        "equal volume. "
        + (
            "Lines: published laws for the rise velocity of single bubbles; one that zigzags moves "
            "faster along its path than it rises." if fluid else _NO_LIQUID
        )
    )  # fmt: skip
    return Picture("Speed against size", sheet.source, caption)


def drag_picture(results: SmoothingResults) -> Picture | None:
    """Draw the drag coefficient against the Reynolds number."""
    if not np.isfinite(column(results.bubble_summary, "drag")).any():
        return None
    with drawing(3.4) as sheet:
        plot.drag(results.bubble_summary, results.file.fluid or None, axes=sheet.axes)
        sheet.axes.locator_params(axis="x", nbins=5, prune="upper")
        _legend_below(sheet)
    caption = (
        "Drag coefficient from the balance of buoyancy, added mass and acceleration; lines: "
        "published laws for bubbles of these sizes that rise steadily."
    )
    return Picture("Drag against Reynolds number", sheet.source, caption)


def aspect_picture(results: SmoothingResults) -> Picture | None:
    """Draw the aspect ratio of the longest tracks against time."""
    frames, curves = results.bubble_frames, []
    for particle in results.bubbles[:_MOST_LINES]:
        mine = frames[frames["particle"] == particle]
        aspect = column(mine, "aspect")
        if np.isfinite(aspect).sum() > 1:
            t, sd = mine["t_s"].to_numpy(float), column(mine, "s_aspect")
            curves.append(Curve(t, aspect, track_colour(particle), sd=sd))
    if not curves:
        return None
    with drawing(2.6, grid=True, xlabel="t / s", ylabel="aspect ratio") as sheet:
        draw_curves(sheet, curves)
    text = f"Equatorial over polar semi-axis of a spheroid; bands are ± 2 sd. {_shape(results)}"
    return Picture("Aspect ratio in time", sheet.source, text)


def _shape(results: SmoothingResults) -> str:
    """Return a sentence on how well the spheroid describes the outlines."""
    known = results.file.bodies
    if not known.get("pairs"):
        return "Their outlines are too few to test the spheroid."
    chi2 = median(column(results.bubble_frames, "spheroid_chi2"))
    return (
        f"The two equatorial semi-axes differ by {number(200 * known.get('triaxial', 0.0), 2)} % "
        "(1 sd). The fit of a spheroid to both outlines has a chi-square with 2 degrees of freedom "
        f"of {number(chi2, 2)} (median; 1.4 if there were only noise)."
    )


BUBBLE_PICTURES = (size_picture, velocity_picture, drag_picture, aspect_picture)


def _legend_below(sheet: Any) -> None:
    """Put a legend of two columns below the axes, which are made smaller."""
    handles, labels = sheet.axes.get_legend_handles_labels()
    rows = -(-len(labels) // 2)
    height = sheet.figure.get_figheight()
    margin = (0.18 * rows + 0.1) / height
    box = sheet.axes.get_position()
    sheet.axes.set_position((box.x0, box.y0 + margin, box.width, box.height - margin))
    sheet.figure.legend(handles, labels, loc="lower left", bbox_to_anchor=(0.08, 0.0), ncols=2,
                        fontsize=7.5)  # fmt: skip


def swarm_figures(results: SmoothingResults) -> list[Figure]:
    """Return numbers per volume of liquid, corrected for bubbles cut by the border."""
    swarm = results.file.swarm

    def value(name: str, factor: float = 1.0) -> str:
        return with_sd(factor * swarm[name], factor * swarm[f"s_{name}"])

    if "void_fraction" not in swarm or (results.file.bubbles or 0) < LEAST_MANY:
        return []
    frames = number(results.file.frames)
    where = f"{number(1e-3 * swarm['volume_mm3'], 3)} cm³, mean of {frames} frames"
    return [
        Figure("Void fraction", f"{value('void_fraction', 100)} %", f"gas per volume; {where}"),
        Figure("Number density", value("number_per_cm3"), "bubbles per cm³"),
        Figure("Sauter mean", f"{value('d32_mm')} mm",
               f"volume over surface; mean diameter {value('d10_mm')} mm"),
        Figure("Gas flux", f"{value('gas_flux_mm_s')} mm/s", "volume of gas upwards per area"),
    ]  # fmt: skip


HEADS = [
    "bubble", "frames", "d, mm", "aspect", "rise, mm/s", "zigzag, Hz", "zigzag, mm", "Re", "drag",
]  # fmt: skip
_COLUMNS = (
    "d_eq_mm", "aspect", "rise_mm_s", "zigzag_hz", "zigzag_mm", "reynolds", "drag",
)  # fmt: skip


def summary_rows(results: SmoothingResults) -> tuple[list[str], list[Row]]:
    """Return heads and rows of the longest tracks' means, without empty columns."""
    table = results.bubble_summary.sort_values("frames", ascending=False).head(MOST_ROWS)
    used = [name for name in _COLUMNS if np.isfinite(column(table, name)).any()]
    heads = HEADS[:2] + [HEADS[2 + _COLUMNS.index(name)] for name in used]
    rows = []
    for row in table.to_dict("records"):
        cells = [number(row["particle"]), number(row["frames"])]
        for name in used:
            sd = row.get("sd_eq_mm" if name == "d_eq_mm" else f"s_{name}", np.nan)
            value = row[name]
            known = float(sd) if np.isfinite(sd) else None
            cells.append(with_sd(float(value), known) if np.isfinite(value) else "-")
        rows.append(Row(tuple(cells)))
    return heads, rows


def bubble_words(results: SmoothingResults) -> str:
    """Return sentences on what the table contains and what is missing."""
    words = (
        "Value ± one standard deviation, over the bubble's frames. All of this, frame by frame, is "
        "in bubbles.csv, and per bubble in bubble_summary.csv."
    )
    more = len(results.bubble_summary) - MOST_ROWS
    if more > 0:
        words += f" The {MOST_ROWS} longest of {len(results.bubble_summary)} tracks are listed."
    if swarm_figures(results):
        words += (
            " What is given per volume is corrected for bubbles that the border of an image cuts; "
            "its standard deviation is that of a random number of independent bubbles."
        )
    if not results.file.fluid:
        words += " " + _NO_LIQUID
    return words
