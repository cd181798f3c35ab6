"""Residuals as fields of arrows, and as histograms against what the noise leads to expect."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from telerig.io.report.calibration.results import CalibrationResults
from telerig.io.report.page.figures import (
    LEFT_OUT,
    Picture,
    camera_colour,
    drawing,
    image_axes,
    image_height_in,
    svg,
)
from telerig.io.report.page.number_format import nice_below, number

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

MOST_ARROWS = 1200
_CELLS = 24
_LONGEST = 0.12
"""Longest arrow of a dot that was left out, in image widths; the others are drawn to scale."""


def residual_field(results: CalibrationResults, index: int) -> Picture:
    """Arrows from the predicted towards the measured place of every dot of one camera."""
    camera = results.cameras[index]
    table = results.residuals[results.residuals["camera"] == camera.name]
    kept, left_out = table[table["kept"]], table[~table["kept"]]
    typical = float(kept["length_px"].quantile(0.9)) if len(kept) else 0.0
    width = camera.image_size_px[0]
    magnified = nice_below(0.05 * width / typical) if typical > 0 else 1.0
    start, arrow, averaged = _arrows(kept, camera.image_size_px)
    above = 0.28
    height = image_height_in(camera.image_size_px, above)
    with drawing(height) as (figure, axes):
        _shrink(axes, above / height)
        image_axes(axes, camera.image_size_px)
        quiver = _draw(axes, start, arrow * magnified, camera_colour(index))
        _draw(axes, *_left_out_arrows(left_out, magnified, _LONGEST * width), LEFT_OUT)
        key_px = nice_below(0.15 * width / magnified)
        axes.quiverkey(
            quiver, 0.02, 1 + 0.5 * above / height, key_px * magnified,
            f"{number(key_px, 1)} px, drawn {magnified:,.0f} times as long",
            labelpos="E", coordinates="axes", labelsep=0.06,
        )  # fmt: skip
        source = svg(figure)
    return Picture(f"Residuals, camera {camera.name}", source, _field_caption(left_out, averaged))


def _field_caption(left_out: pd.DataFrame, averaged: bool) -> str:
    text = "Arrows in all directions are noise; arrows that swirl or point outwards together "
    text += "are distortion that the model misses."
    if averaged:
        text += " There are too many dots for one arrow each: each arrow is the mean of a cell."
    if len(left_out):
        text += f" Red: {len(left_out)} left out, cut to {_LONGEST:.0%} of the image's width."
    return text


def _shrink(axes: Any, share: float) -> None:
    box = axes.get_position()
    axes.set_position((box.x0, box.y0, box.width, box.height - share))


def _draw(axes: Any, start: Array, arrow: Array, colour: str) -> Any:
    return axes.quiver(
        *start.T, *arrow.T, color=colour, angles="xy", scale_units="xy", scale=1,
        width=0.0032, headwidth=4, headlength=4, headaxislength=3.5,
    )  # fmt: skip


def _arrows(table: pd.DataFrame, size_px: tuple[int, int]) -> tuple[Array, Array, bool]:
    """Start and residual of each arrow; means over cells when there are too many dots."""
    start = table[["u_px", "v_px"]].to_numpy()
    arrow = table[["du_px", "dv_px"]].to_numpy()
    if len(table) <= MOST_ARROWS:
        return start, arrow, False
    cell_px = max(size_px) / _CELLS
    place = np.floor((start + 0.5) / cell_px).astype(int) @ [1, 4 * _CELLS]
    cells, member, count = np.unique(place, return_inverse=True, return_counts=True)
    sums = np.zeros((len(cells), 4))
    np.add.at(sums, member, np.c_[start, arrow])
    means = sums / count[:, None]
    return means[:, :2], means[:, 2:], True


def _left_out_arrows(table: pd.DataFrame, magnified: float, longest: float) -> tuple[Array, Array]:
    arrow = magnified * table[["du_px", "dv_px"]].to_numpy()
    length = np.maximum(np.hypot(*arrow.T), 1e-300)[:, None]
    return table[["u_px", "v_px"]].to_numpy(), arrow * np.minimum(1.0, longest / length)


def residual_histogram(results: CalibrationResults) -> Picture:
    """All residual coordinates against the normal distribution that the noise predicts."""
    table = results.residuals
    whitened = "whitened_u" in table
    columns = ["whitened_u", "whitened_v"] if whitened else ["du_px", "dv_px"]
    kept = table.loc[table["kept"], columns].to_numpy().ravel()
    sigma = 1.0 if whitened else float(np.sqrt(np.mean(kept**2))) if len(kept) else 1.0
    sigma = sigma or 1.0
    edges = np.linspace(-5, 5, 41) * sigma
    with drawing(2.9) as (figure, axes):
        for i, name in enumerate(results.camera_names):
            mine = table.loc[table["kept"] & (table["camera"] == name), columns].to_numpy()
            axes.stairs(
                _density(mine.ravel(), edges), edges, color=camera_colour(i), linewidth=1.4,
                label=name, fill=i == 0, alpha=0.45 if i == 0 else 1,
            )  # fmt: skip
        x = np.linspace(edges[0], edges[-1], 120)
        curve = np.exp(-0.5 * (x / sigma) ** 2) / (np.sqrt(2 * np.pi) * sigma)
        label = "unit normal" if whitened else f"normal, sigma {number(sigma)} px"
        axes.plot(x, curve, color="black", label=label)
        axes.set(xlabel="residual / its sigma" if whitened else "residual / px", ylabel="density")
        axes.set(
            xlim=(edges[0], edges[-1]), ylim=(0, 1.45 * max(curve.max(), axes.get_ylim()[1] / 1.3))
        )
        axes.legend(loc="upper left")
        source = svg(figure)
    beyond = int(np.sum(np.abs(kept) > edges[-1]))
    caption = _histogram_caption(whitened, kept, beyond)
    return Picture("Distribution of the residuals", source, caption)


def _histogram_caption(whitened: bool, kept: Array, beyond: int) -> str:
    if whitened:
        spread = f"{np.sqrt(np.mean(kept**2)):.2f}" if len(kept) else "unknown"
        text = (
            "Residuals over their own predicted noise should follow the black curve, a little "
            f"narrower because they were fitted (here {spread}); fat tails are outliers."
        )
    else:
        text = "Steps should follow the curve, a normal distribution of the same RMS; fat tails"
        text += " are outliers."
    return text + (f" {beyond} kept values lie beyond the plot." if beyond else "")


def _density(values: Array, edges: Array) -> Array:
    count, _ = np.histogram(values, edges)
    return np.asarray(count / max(len(values), 1) / np.diff(edges))
