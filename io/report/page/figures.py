"""Figures as pictures that an HTML page carries in itself."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

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
