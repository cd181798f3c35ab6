"""Figures as pictures that an HTML page carries in itself, and long series with bands."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from telerig.arrays import Array

CAMERA_COLOURS = ("#1f5fa8", "#c2570c", "#2e7d32", "#7b3fa0")
KEPT, LEFT_OUT, MODEL, MUTED = "#1b7f3b", "#c62828", "#c62828", "#8a8f98"
WIDTH_IN = 4.4
"""Width of every figure: its text is as large as the page's at 420 px, and legible at 360 px."""

_STYLE = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.linewidth": 0.7,
    "axes.edgecolor": "#555555",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e3e5e8",
    "legend.frameon": False,
    "legend.fontsize": 8,
}


@dataclass(frozen=True)
class Picture:
    """A figure ready for the page: ``source`` is a data URI, ``caption`` says what to look for."""

    title: str
    source: str
    caption: str


def prepare_drawing() -> None:
    """Import what every figure needs, so that processes started afterwards share it."""
    import matplotlib.backends.backend_agg
    import matplotlib.backends.backend_svg
    import matplotlib.figure  # noqa: F401


@contextmanager
def drawing(height_in: float) -> Iterator[tuple[Any, Any]]:
    """A figure and its axes in the report's style, `WIDTH_IN` wide."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH_IN, height_in))
        left, right, bottom, top = 0.58, 0.12, 0.45, 0.12
        box = (
            left / WIDTH_IN,
            bottom / height_in,
            1 - (left + right) / WIDTH_IN,
            1 - (bottom + top) / height_in,
        )
        axes = figure.add_axes(box)
        axes.locator_params(nbins=5)
        yield figure, axes


def svg(figure: Any) -> str:
    """``figure`` as a data URI; the text stays text."""
    stream = io.BytesIO()
    figure.savefig(stream, format="svg", metadata={"Date": None}, dpi=150)
    return data_uri("image/svg+xml", stream.getvalue())


def png(figure: Any, dpi: int = 130, colours: int | None = None) -> str:
    """``figure`` as a data URI of pixels, for what would be thousands of shapes.

    colours : so many shades are enough, which makes a drawing of lines a third as large.
    """
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi, metadata={"Software": None})
    if colours is not None:
        from PIL import Image

        whole, stream = Image.open(stream).convert("RGB"), io.BytesIO()
        whole.quantize(colours, method=Image.Quantize.FASTOCTREE).save(stream, "png", optimize=True)
    return data_uri("image/png", stream.getvalue())


def data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def image_axes(axes: Any, image_size_px: tuple[int, int]) -> None:
    """Axes that are an image: u right, v down, pixel (0, 0) the centre of the top left pixel."""
    width, height = image_size_px
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="u / px", ylabel="v / px")
    axes.set_aspect("equal")
    axes.spines[["top", "right"]].set_visible(True)


def image_height_in(image_size_px: tuple[int, int], above_in: float = 0.0) -> float:
    """Height of a figure that holds `image_axes`, with room ``above_in`` for a legend."""
    width, height = image_size_px
    return float(min(7.0, 0.57 + (WIDTH_IN - 0.7) * height / width)) + above_in


def camera_colour(index: int) -> str:
    return CAMERA_COLOURS[index % len(CAMERA_COLOURS)]


SMOOTHED, NAIVE, RTS = "#1f5fa8", "#9aa0a8", "#c2570c"
BAND_SDS = 2
_MANY = 1_500
_SHADES = 64
_DPI = 190
_ROOM = 0.035


def line(axes: Any, t_s: Array, values: Array, colour: str, label: str = "", **how: Any) -> None:
    """``values`` against time; nothing where none is finite."""
    if np.isfinite(values).any():
        axes.plot(t_s, values, color=colour, label=label, **({"linewidth": 0.9} | how))


def band(axes: Any, t_s: Array, centre: Array, sd: Array, colour: str, label: str = "") -> None:
    """``centre`` ± `BAND_SDS` sd as a surface."""
    if not np.isfinite(sd).any():
        return
    far = BAND_SDS * sd
    axes.fill_between(t_s, centre - far, centre + far, color=colour, alpha=0.25,
                      linewidth=0, label=label)  # fmt: skip


def room_left(axes: Any) -> None:
    """Move the left edge of the axes so that tick labels of four digits fit beside them.

    Ticks of a linear x axis (times) are written without a common offset.
    """
    if axes.get_xscale() == "linear":
        axes.ticklabel_format(axis="x", useOffset=False)
    box = axes.get_position()
    axes.set_position((box.x0 + _ROOM, box.y0, box.width - _ROOM, box.height))


def above(axes: Any, *, inverted: bool = False) -> None:
    """The legend over the lines, with room for it; ``inverted`` turns the axis round as well."""
    low, high = axes.get_ylim()
    room = 0.17 * (high - low)
    axes.set_ylim(*((high, low - room) if inverted else (low, high + room)))
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="upper left", ncols=4, columnspacing=1.0, handlelength=1.2,
                    borderaxespad=0.1)  # fmt: skip


def source_of(figure: Any, points: int) -> str:
    """Shapes for short series, pixels for long ones."""
    return png(figure, dpi=_DPI, colours=_SHADES) if points > _MANY else svg(figure)


def limits(*series: Array, beyond: float = 0.08) -> tuple[float, float] | None:
    """What holds all finite values and a little more; None without any."""
    finite = np.concatenate([s[np.isfinite(s)] for s in series])
    if not len(finite):
        return None
    low, high = float(finite.min()), float(finite.max())
    room = beyond * (high - low) or 1e-3 * (abs(high) or 1.0)
    return low - room, high + room
