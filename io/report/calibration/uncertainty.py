"""How far a calibration can be trusted: uncertainty in space, and two halves of the views."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.calibration.results import CalibrationResults
from telerig.io.report.page.figures import MODEL, MUTED, Picture, drawing, svg
from telerig.io.report.page.number_format import number

Array = NDArray[np.float64]

_LEVELS = 8


def trust_pictures(results: CalibrationResults) -> list[Picture]:
    """What the folder has of these; a single camera has none."""
    found = []
    if results.uncertainty:
        found.append(_map(results.uncertainty, "calibration_mm2", _CALIBRATION))
        found.append(_map(results.uncertainty, "measurement_mm2", _MEASUREMENT))
    halves = (results.content.get("diagnostics") or {}).get("halves") or {}
    if "points_mm" in halves:
        found.append(_halves(halves))
    return found


_CALIBRATION = (
    "Uncertainty: the calibration's share",
    "One standard deviation in um (all three axes together) of where a point lies in the rig's "
    "frame, in the plane of the optical axes. It is the same for all points of a run that lie near "
    "each other: differences of near points do not have it.",
)
_MEASUREMENT = (
    "Uncertainty: the pixels' share",
    "One standard deviation in um of a point whose pixels scatter like this calibration's dots "
    "({sigma} px), drawn anew for every point; in proportion for other pixels.",
)


def _map(arrays: Mapping[str, Array], name: str, words: tuple[str, str]) -> Picture:
    points = arrays["points_mm"]
    sd_um = 1e3 * np.sqrt(np.trace(arrays[name], axis1=-2, axis2=-1))
    level = np.abs(points[:, 1])
    flat = level <= level.min() + 1e-6
    x, z = (np.unique(points[flat, i]) for i in (0, 2))
    grid = sd_um[flat].reshape(len(x), len(z))
    with drawing(3.6) as (figure, axes):
        if np.ptp(grid) > 1e-3 * grid.max():
            filled = axes.contourf(x, z, grid.T, levels=_LEVELS, cmap="viridis")
            figure.colorbar(filled, ax=axes, label="um")
        else:
            axes.text(0.5, 0.5, f"{number(grid.mean(), 3)} um everywhere", ha="center",
                      va="center", transform=axes.transAxes)  # fmt: skip
        axes.set(xlabel="x / mm", ylabel="z / mm", xlim=(x[0], x[-1]), ylim=(z[0], z[-1]))
        axes.set_aspect("equal")
        source = svg(figure)
    caption = words[1].format(sigma=number(float(arrays["sigma_px"]), 3))
    caption += f" {number(grid.min(), 3)} to {number(grid.max(), 3)} um."
    return Picture(words[0], source, caption)


def _halves(halves: Mapping[str, Any]) -> Picture:
    """Arrows where the halves differ, circles of what the covariances allow."""
    from matplotlib.patches import Circle

    points, shift, sd = (
        np.array(halves[name], float).reshape(-1, 3) for name in ("points_mm", "shift_um", "sd_um")
    )
    level = np.abs(points[:, 1])
    flat = level <= level.min() + 1e-6
    x, z = points[flat][:, [0, 2]].T
    spacing = np.ptp(x) / max(len(np.unique(x)) - 1, 1)
    longest = float(np.hypot(*shift[flat][:, [0, 2]].T).max())
    factor = 0.7 * spacing / max(longest, float(sd.max()), 1e-9)
    with drawing(3.9) as (figure, axes):
        for a, b, s in zip(x, z, sd[flat]):
            radius = factor * float(np.sqrt(np.mean(s[[0, 2]] ** 2)))
            axes.add_patch(Circle((a, b), radius, facecolor=MUTED, alpha=0.25, linewidth=0))
        axes.quiver(x, z, *(factor * shift[flat][:, [0, 2]]).T, angles="xy", scale_units="xy",
                    scale=1, color=MODEL, width=0.006)  # fmt: skip
        axes.set(xlabel="x / mm", ylabel="z / mm")
        axes.set_aspect("equal", adjustable="datalim")
        source = svg(figure)
    caption = (
        f"Arrows: how far {halves['views'][0]} views and the other {halves['views'][1]} put the "
        f"same pixels apart (longest {number(longest, 2)} um); grey: one standard deviation of "
        "that difference. They form a pattern by nature (a turn, a scale); arrows much longer than "
        "the circles' radius in most places mean that the covariance cannot be believed."
    )
    return Picture("Two halves of the views", source, caption)
