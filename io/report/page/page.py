"""One HTML page that needs no network: template, style, drawings and 3-D library in one file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

from telerig.io.machine.memory import keep_freed_memory
from telerig.io.machine.parallel import ordered_map, quick_workers
from telerig.io.report.page.figures import prepare_drawing

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


def render_page(template: str, context: Mapping[str, Any], scene: str) -> str:
    """The page as text.

    template : a file of this package; it includes "scene_script.html" where the 3-D library goes.
    context : escaped where it is text. scene : what `scene.scene_text` gives.
    """
    from markupsafe import Markup

    carried = {
        "css": Markup(_package_file("report.css")),
        "scene": Markup(scene),
        "plotly": Markup(plotly_javascript()),
    }
    return _environment().get_template(template).render({**context, **carried})


@cache
def _environment() -> Environment:
    """It keeps the templates that it compiled."""
    from jinja2 import Environment, FunctionLoader

    loader = FunctionLoader(_package_file)
    return Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, loader=loader)


@cache
def plotly_javascript() -> str:
    """The library's own JavaScript, from the installed package. Reading it imports no plotly."""
    file = resources.files("plotly") / "package_data" / "plotly.min.js"
    return file.read_text(encoding="utf-8")


def prepare_page(template: str) -> None:
    """Load what a page of this template needs, so that rendering it takes a third of the time."""
    keep_freed_memory()
    prepare_drawing()
    for name in (template, *_IN_EVERY_PAGE):
        _environment().get_template(name)
    plotly_javascript()


def drawn_over_cores(drawings: Sequence[Callable[[], Any]]) -> list[Any]:
    """What each drawing returns, in order."""
    prepare_drawing()
    return list(ordered_map(_call, drawings, quick_workers(len(drawings))))


def _call(drawing: Callable[[], Any]) -> Any:
    return drawing()


def _package_file(name: str) -> str:
    return (resources.files("telerig.io.report.page") / name).read_text(encoding="utf-8")
