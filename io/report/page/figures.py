"""Figures of `telerig.plot` as pictures that an HTML page carries in itself."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from telerig.errors import InputError
from telerig.short_text import no_formula

WIDTH_IN = 4.4
"""Width of every figure: its text is as large as the page's at 420 px, and legible at 360 px."""

_MANY, _SHADES, _DPI = 4_000, 64, 190
_STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "telerig",  # names in the picture are not random: the same page each time
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.linewidth": 0.7,
    "axes.edgecolor": "#555555",
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e3e5e8",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "legend.columnspacing": 1.2,
    "legend.handlelength": 1.3,
}
_UNNAMED = re.compile("_child[0-9]+$|_nolegend_$|[^_]|$")


@dataclass(frozen=True)
class Figure:
    """A figure of a page, drawn when the page is made.

    draw : a function of `telerig.plot` with all arguments but ``axes``; a figure for which it
        raises InputError is left out.
    caption : what to look for.
    space : the axes are 3-D. grid : lines behind the data. inline : the page holds the elements of
        the SVG, which its scripts reach; not of a figure of many points, which is an image.
    """

    title: str
    draw: Callable[..., Any]
    caption: str = ""
    height_in: float = 2.6
    space: bool = False
    grid: bool = True
    inline: bool = False


@dataclass(frozen=True)
class Picture:
    """A figure ready for the page: ``source`` is a data URI; ``svg`` its text, "" for an image."""

    title: str
    source: str
    caption: str
    svg: str = ""


def prepare_drawing() -> None:
    """Import what every figure needs, so that processes started afterwards share it."""
    import matplotlib.backends.backend_agg
    import matplotlib.backends.backend_svg
    import matplotlib.figure  # noqa: F401


def drawn(figure: Figure) -> Picture | None:
    """Return a figure as a picture; None where there is nothing to draw."""
    from matplotlib import rc_context
    from matplotlib.text import Text

    with rc_context(_STYLE):
        sheet, axes = _sheet(figure)
        try:
            figure.draw(axes=axes)
        except InputError:
            return None
        if not figure.space:
            axes.grid(figure.grid)
            _add_legend(sheet, axes)
        for text in sheet.findobj(Text):
            text.set_text(no_formula(text.get_text()))
        many = _points(axes) > _MANY
        source = png(sheet, _DPI, _SHADES) if many else svg(sheet)
    text = svg_text(source) if figure.inline and not many else ""
    return Picture(figure.title, source, figure.caption, text)


def _sheet(figure: Figure) -> tuple[Any, Any]:
    from matplotlib.figure import Figure as Sheet

    size = WIDTH_IN, figure.height_in
    if figure.space:
        from mpl_toolkits.mplot3d import Axes3D

        sheet = Sheet(figsize=size)
        axes = Axes3D(sheet, rect=(0.02, 0.1, 0.9, 0.9))
        sheet.add_axes(axes)
        return sheet, axes
    sheet = Sheet(figsize=size, layout="constrained")
    axes = sheet.add_subplot()
    axes.locator_params(nbins=6)
    return sheet, axes


def _add_legend(sheet: Any, axes: Any) -> None:
    """Put a legend above the axes; beside groups that the page names, the laws alone."""
    for one in axes.get_children():
        if not _UNNAMED.match(str(one.get_label())):  # a legend leaves out what begins with _
            one.set_label(f" {one.get_label()}")
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) > 1:
        columns = 4 if max(map(len, labels)) < 16 else 2
        sheet.legend(handles, labels, loc="outside upper left", ncols=columns, borderpad=0.2)


def _points(axes: Any) -> int:
    """Return the number of points in the lines and collections of axes."""
    lines = sum(len(line.get_xdata(orig=False)) for line in axes.get_lines())
    return lines + sum(
        max(len(one.get_offsets()), sum(len(path.vertices) for path in one.get_paths()))
        for one in axes.collections
    )


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
    """Return bytes as a data URI; kind : their MIME type, like "image/png"."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def image_height_in(image_size_px: tuple[int, int]) -> float:
    """Return the height of a figure of an image, with room for labels and a legend."""
    width, height = image_size_px
    return float(min(7.0, 0.75 + (WIDTH_IN - 0.8) * height / width))
