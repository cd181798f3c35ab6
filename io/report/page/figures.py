"""Figures as pictures that an HTML page carries in itself, and long series with bands."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from telerig.arrays import Array
from telerig.short_text import no_formula

CAMERA_COLOURS = ("#1f5fa8", "#c2570c", "#2e7d32", "#7b3fa0")
KEPT, LEFT_OUT, MODEL, MUTED = "#1b7f3b", "#c62828", "#c62828", "#8a8f98"
WIDTH_IN = 4.4
"""Width of every figure: its text is as large as the page's at 420 px, and legible at 360 px."""

LEFT_IN, RIGHT_IN, BOTTOM_IN = 0.7, 0.12, 0.45
"""Margins of a figure; on the left there is room for tick labels of four digits."""

_STYLE = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.linewidth": 0.7,
    "axes.edgecolor": "#555555",
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#e3e5e8",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "legend.columnspacing": 1.2,
    "legend.handlelength": 1.3,
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


@dataclass
class Sheet:
    """A figure that is being drawn; with many ``points`` it is stored as pixels in ``source``."""

    figure: Any
    axes: Any
    points: int = 0
    source: str = ""


_UNNAMED = re.compile("_child[0-9]+$|_nolegend_$|[^_]|$")


@contextmanager
def drawing(
    height_in: float, *, legend: str = "", grid: bool = False, **settings: Any
) -> Iterator[Sheet]:
    """Yield a figure and its axes in the report's style, `WIDTH_IN` wide.

    legend : "above" the axes, or a place by its name in matplotlib; "" for none. settings : as
    ``axes.set`` takes them.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.text import Text

    with rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH_IN, height_in))
        top = 0.3 if legend == "above" else 0.12
        box = (LEFT_IN, BOTTOM_IN, WIDTH_IN - LEFT_IN - RIGHT_IN, height_in - BOTTOM_IN - top)
        axes = figure.add_axes(tuple(np.array(box) / [WIDTH_IN, height_in, WIDTH_IN, height_in]))
        axes.locator_params(nbins=5)
        axes.set(**settings)
        axes.grid(grid)
        sheet = Sheet(figure, axes)
        yield sheet
        for one in axes.get_children():
            if not _UNNAMED.match(str(one.get_label())):  # a legend leaves out what begins with _
                one.set_label(f" {one.get_label()}")
        if legend and axes.get_legend_handles_labels()[1]:
            above = {"loc": "lower left", "bbox_to_anchor": (0, 1), "ncols": 4, "borderpad": 0.2}
            axes.legend(**(above if legend == "above" else {"loc": legend}))
        for text in figure.findobj(Text):
            text.set_text(no_formula(text.get_text()))
        sheet.source = png(figure, _DPI, _SHADES) if sheet.points > _MANY else svg(figure)


def svg(figure: Any) -> str:
    """Return the figure as an SVG data URI with text as text."""
    stream = io.BytesIO()
    figure.savefig(stream, format="svg", metadata={"Date": None}, dpi=150)
    return data_uri("image/svg+xml", stream.getvalue())


def svg_text(source: str) -> str:
    """Return the element of an SVG picture, to stand in a page itself, where scripts reach it."""
    text = base64.b64decode(source.partition(",")[2]).decode("utf-8")
    return text[text.index("<svg") :]


def png(figure: Any, dpi: int = 130, colours: int | None = None) -> str:
    """Return ``figure`` as a data URI of pixels; few ``colours`` make drawings of lines small."""
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
    """Set axes to an image's: u right, v down, pixel (0, 0) the centre of the top left pixel."""
    width, height = image_size_px
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="u / px", ylabel="v / px")
    axes.set_aspect("equal")
    axes.spines[["top", "right"]].set_visible(True)


def image_height_in(image_size_px: tuple[int, int], above_in: float = 0.0) -> float:
    """Return the height of a figure with `image_axes`, with room for a legend above."""
    width, height = image_size_px
    inside = (WIDTH_IN - LEFT_IN - RIGHT_IN) * height / width
    return float(min(7.0, BOTTOM_IN + 0.12 + inside)) + above_in


def camera_colour(index: int) -> str:
    return CAMERA_COLOURS[index % len(CAMERA_COLOURS)]


SMOOTHED, NAIVE, RTS = "#1f5fa8", "#9aa0a8", "#c2570c"
BAND_SDS = 2
_MANY = 1_500
_SHADES = 64
_DPI = 190


@dataclass(frozen=True)
class Curve:
    """A line (N,) of a plot, with a band of ± `BAND_SDS` sd (N,); style : as matplotlib has it."""

    x: Array
    y: Array
    colour: str
    label: str = ""
    sd: Array | None = None
    style: Mapping[str, Any] = field(default_factory=dict)


def draw_curves(sheet: Sheet, curves: Iterable[Curve]) -> None:
    """Draw the curves that have finite values, each band below its line; each label stands once."""
    labels: set[str] = set()
    for curve in curves:
        fresh = curve.label if curve.label not in labels else ""
        if curve.sd is not None and np.isfinite(curve.sd).any():
            far = BAND_SDS * curve.sd
            words = f"± {BAND_SDS} sd" if fresh else ""
            sheet.axes.fill_between(
                curve.x, curve.y - far, curve.y + far, color=curve.colour, alpha=0.25, linewidth=0,
                label=words,
            )  # fmt: skip
            sheet.points += len(curve.x)
        if np.isfinite(curve.y).any():
            style = {"linewidth": 0.9} | dict(curve.style)
            sheet.axes.plot(curve.x, curve.y, color=curve.colour, label=fresh, **style)
            sheet.points += len(curve.x)
            labels.add(curve.label)


def limits(*series: Array, beyond: float = 0.08) -> tuple[float, float] | None:
    """Return limits around all finite values, with a margin; None without values."""
    finite = np.concatenate([s[np.isfinite(s)] for s in series])
    if not len(finite):
        return None
    low, high = float(finite.min()), float(finite.max())
    margin = beyond * (high - low) or 1e-3 * (abs(high) or 1.0)
    return low - margin, high + margin
