"""The bubbles' section of a smoothed run's report: sizes, velocities, drag, shape in time."""

from __future__ import annotations

from functools import partial

import numpy as np

from telerig.io.report import plot
from telerig.io.report.page.figures import Figure
from telerig.io.report.page.page import Row, Tile
from telerig.io.results.folders.smoothing import SmoothingResults, column
from telerig.short_text import number, with_sd
from telerig.statistics import median

MOST_ROWS = 40
LEAST_MANY = 10
"""Fewer bubbles are no swarm: they say next to nothing of a distribution or of a volume."""
_NO_LIQUID = (
    "For Reynolds, Weber and Eötvös numbers, drag and published laws, describe the liquid under "
    "[fluid] in rig.toml and smooth again."
)


def bubble_figures(results: SmoothingResults) -> list[Figure]:
    """Return sizes, speed, drag and shape of the bubbles; figures without data are left out."""
    summary, fluid = results.bubble_summary, results.file.fluid or None
    known = int(np.isfinite(column(summary, "d_eq_mm")).sum())
    size = Figure(
        "Sizes of the bubbles", partial(plot.sizes, summary),
        f"Every bubble once, also those that the border cuts. Dashed: the means of these {known} "
        "bubbles, which are not corrected for the border.",
    )  # fmt: skip
    laws = (
        " Lines: published laws for the rise velocity of single bubbles; one that zigzags moves "
        "faster along its path than it rises."
    )
    speed = Figure(
        "Speed against size", partial(plot.speed, summary, fluid),
        "Mean speed along the path, relative to the liquid, against the diameter of the sphere of "
        f"equal volume.{laws if fluid else ''}", 3.8,
    )  # fmt: skip
    return [
        *([size] if known >= LEAST_MANY else []),
        *([speed] if known > 1 or fluid else []),
        Figure("Drag against Reynolds number", partial(plot.drag, summary, fluid),
               "Drag coefficient from the balance of buoyancy, added mass and acceleration; lines: "
               "published laws for bubbles of these sizes that rise steadily.", 3.8),
        Figure("Aspect ratio in time", partial(plot.aspect_over_time, results.bubble_frames),
               f"Equatorial over polar semi-axis of a spheroid. {_shape(results)}"),
    ]  # fmt: skip


def _shape(results: SmoothingResults) -> str:
    """Return sentences on how well the spheroid describes the outlines."""
    from scipy.special import chdtri

    known = results.file.bodies
    chi2 = median(column(results.bubble_frames, "spheroid_chi2"))
    if chi2 is None:
        return "Their outlines are too few to test the spheroid."
    words = ""
    if known.get("bodies"):
        apart = number(200 * known.get("triaxial", 0.0), 2)
        words = f"The two equatorial semi-axes differ by {apart} % (1 sd). "
    free = {views: 3 * views - 4 for views in range(2, len(results.cameras) + 1)}
    expected = ", ".join(
        f"{number(float(chdtri(dof, 0.5)), 2)} of {views} outlines (degrees of freedom: {dof})"
        for views, dof in free.items()
    )
    return (
        f"{words}The fit of a spheroid to the outlines of all cameras has a chi-square of "
        f"{number(chi2, 2)} (median); if there were only noise: {expected}. What is beyond it "
        "widens the standard deviations of sizes and shapes."
    )


def swarm_tiles(results: SmoothingResults) -> list[Tile]:
    """Return numbers per volume of liquid, corrected for bubbles cut by the border."""
    swarm = results.file.swarm

    def value(name: str, factor: float = 1.0) -> str:
        return with_sd(factor * swarm[name], factor * swarm[f"s_{name}"])

    if "void_fraction" not in swarm or (results.file.bubbles or 0) < LEAST_MANY:
        return []
    frames = number(results.file.frames)
    where = f"{number(1e-3 * swarm['volume_mm3'], 3)} cm³, mean of {frames} frames"
    return [
        Tile("Void fraction", f"{value('void_fraction', 100)} %", f"gas per volume; {where}"),
        Tile("Number density", value("number_per_cm3"), "bubbles per cm³"),
        Tile("Sauter mean", f"{value('d32_mm')} mm",
               f"volume over surface; mean diameter {value('d10_mm')} mm"),
        Tile("Gas flux", f"{value('gas_flux_mm_s')} mm/s", "volume of gas upwards per area"),
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
    if swarm_tiles(results):
        words += (
            " What is given per volume is corrected for bubbles that the border of an image cuts; "
            "its standard deviation is that of a random number of independent bubbles."
        )
    if not results.file.fluid:
        words += " " + _NO_LIQUID
    return words
