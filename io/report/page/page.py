"""One HTML page that needs no network: template, style, drawings and 3-D scene in one file."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from telerig.arrays import Array
from telerig.io.machine.parallel import keep_freed_memory, ordered_map, quick_workers
from telerig.io.report.page.figures import MUTED, Picture, prepare_drawing

if TYPE_CHECKING:
    from jinja2 import Environment


_IN_EVERY_PAGE = ("layout.html", "macros.html", "scene_script.html")


@dataclass(frozen=True)
class Figure:
    """A key number: its name, the number with its unit, and what to compare it with."""

    name: str
    value: str
    remark: str


@dataclass(frozen=True)
class Row:
    """A table row: the cells as text; ``strong`` is set off, ``faint`` set back."""

    cells: tuple[str, ...]
    strong: bool = False
    faint: bool = False


@dataclass(frozen=True)
class Section:
    """A part of a page: heading, a sentence, key numbers, a table and pictures, where given.

    numbers : first column of the table that holds numbers, and the first one that does not.
    """

    title: str = ""
    lead: str = ""
    tiles: tuple[Figure, ...] = ()
    head: tuple[str, ...] = ()
    rows: tuple[Row, ...] = ()
    numbers: tuple[int, int] = (1, 99)
    pictures: tuple[Picture, ...] = ()


def render_sections(
    kind: str, title: str, name: str, verdict: Mapping[str, Any], contents: Sequence[Section],
    terms: Sequence[str],
) -> str:  # fmt: skip
    """Return a page that is a verdict and sections.

    kind, title, name : what the page is, for its head, and of what. verdict : colour, headline,
    sentences and warnings. terms : those of the glossary that it explains.
    """
    context = {"kind": kind, "title": title, "name": name, "stale": (), "verdict": verdict,
               "contents": contents, "terms": terms}  # fmt: skip
    return render_page("template_sections.html", context, "")


def link_to(target: Path, page_folder: Path) -> str:
    """Return the link to a file from a page in a folder, relative if the disk allows it."""
    try:
        link = os.path.relpath(target.resolve(), Path(page_folder).resolve())
    except ValueError:
        return target.resolve().as_uri()
    return quote(Path(link).as_posix())


def render_page(template: str, context: Mapping[str, Any], scene: str) -> str:
    """Return the page as text; ``context`` is escaped, ``scene`` is what `scene_text` gives."""
    carried = {
        "css": _package_file("report.css"),
        "scene": scene,
        "plotly": plotly_javascript(),
    }
    return _environment().get_template(template).render({**context, **carried})


@cache
def _environment() -> Environment:
    """Return the Jinja environment, which keeps compiled templates."""
    from jinja2 import Environment, FunctionLoader

    loader = FunctionLoader(_package_file)
    out = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, loader=loader)
    out.globals["glossary"] = glossary
    return out


@cache
def glossary() -> dict[str, str]:
    """Return the definitions of docs/glossary.md by term, without markup."""
    text = re.sub("[*`]", "", _package_file("glossary.md").replace("**", "\0"))
    return {
        term: " ".join(words.split())
        for term, words in re.findall("^\0(.+)\0: ((?:.+\n)+)", text, re.MULTILINE)
    }


@cache
def plotly_javascript() -> str:
    """Return plotly.js with the traces in space alone, a file of this package."""
    return _package_file("plotly-gl3d.min.js")


def prepare_page(template: str) -> None:
    """Load what a page of this template needs, so that rendering it takes a third of the time."""
    keep_freed_memory()
    prepare_drawing()
    for name in (template, *_IN_EVERY_PAGE):
        _environment().get_template(name)
    plotly_javascript()


def drawn_over_cores(drawings: Sequence[Callable[[], Any]]) -> list[Any]:
    """Call all drawings on several cores; return their results in order."""
    prepare_drawing()
    return list(ordered_map(_call, drawings, quick_workers(len(drawings))))


def _call(drawing: Callable[[], Any]) -> Any:
    return drawing()


def _package_file(name: str) -> str:
    return (resources.files("telerig.io.report.page") / name).read_text(encoding="utf-8")


Trace = dict[str, Any]

_FEW_TICKS = 6


def scene_text(
    traces: list[Trace],
    up: Sequence[float] = (0.0, -1.0, 0.0),
    distance: float = 1.0,
    ratio: Sequence[float] | None = None,
) -> str:
    """Return traces with a layout for them, safe inside a script element.

    up : (3,) unit vector on the screen.
    distance : of the eye.
    ratio : of the box' sides, None: true proportions.
    """
    axes = {f"{a}axis": {"title": {"text": f"{a} / mm"}, "showspikes": False} for a in "xyz"}
    lower = [-min(0.3 * (distance - 1), 0.12) * float(part) for part in up]
    view = {
        "up": dict(zip("xyz", up)),
        "center": dict(zip("xyz", lower)),
        "eye": dict(zip("xyz", _eye(up, distance))),
    }
    layout: dict[str, Any] = {
        "scene": axes | {"aspectmode": "data", "camera": view},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"orientation": "h", "x": 0, "y": 0, "yanchor": "top"},
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": MUTED, "activecolor": "#333333"},
        "paper_bgcolor": "rgba(0,0,0,0)",
    }
    if ratio is not None:
        layout["scene"] |= {"aspectmode": "manual", "aspectratio": dict(zip("xyz", ratio))}
        for name in ("xaxis", "yaxis", "zaxis"):
            layout["scene"][name] |= {"nticks": _FEW_TICKS}
    return script_data({"data": traces, "layout": layout})


def script_data(content: Any) -> str:
    """Return data as JSON that is safe inside a script element of a page."""
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")


def xyz(kind: str, points_mm: Array) -> Trace:
    """Return a plotly trace of points (N, 3), rounded to µm; NaN interrupts a line."""
    columns = [[None if np.isnan(c) else round(float(c), 3) for c in axis] for axis in points_mm.T]
    return {"type": kind, **dict(zip("xyz", columns))}


def lines(points_mm: Array, colour: str, width: float) -> Trace:
    return xyz("scatter3d", points_mm) | {
        "mode": "lines", "line": {"color": colour, "width": width}, "connectgaps": False,
    }  # fmt: skip


def _eye(up: Sequence[float], distance: float) -> list[float]:
    """Return the position of the eye, above and beside the scene."""
    axis = int(np.argmax(np.abs(up)))
    eye = 0.8 * np.array(up, float)
    eye[[i for i in range(3) if i != axis]] += (0.85, -1.0)
    return [float(part) for part in distance * eye]
