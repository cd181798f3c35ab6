"""One HTML page that needs no network: a verdict, three figures and sections, by one template."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib import resources
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar
from urllib.parse import quote

from telerig.io.machine.parallel import keep_freed_memory, ordered_map, quick_workers
from telerig.io.report.page.figures import Figure, Picture, drawn, prepare_drawing
from telerig.short_text import flat_rows

if TYPE_CHECKING:
    from jinja2 import Environment

_TEMPLATE = "page.html"
_MOST_ROWS = 150


@dataclass(frozen=True)
class Tile:
    """A key number: its name, the number with its unit, and what to compare it with."""

    name: str
    value: str
    remark: str


@dataclass(frozen=True)
class Tiles:
    """Key numbers side by side."""

    kind: ClassVar[str] = "tiles"
    tiles: tuple[Tile, ...]


@dataclass(frozen=True)
class Row:
    """A table row: the cells as text; ``strong`` is set off, ``faint`` set back.

    link : where the first cell leads; "" for nowhere.
    """

    cells: tuple[str, ...]
    strong: bool = False
    faint: bool = False
    link: str = ""


@dataclass(frozen=True)
class Table:
    """A table; without a ``head`` its rows are names and values.

    numbers : first column that holds numbers, and the first one that does not.
    """

    kind: ClassVar[str] = "table"
    rows: Sequence[Row]
    head: Sequence[str] = ()
    numbers: tuple[int, int] = (1, 99)


@dataclass(frozen=True)
class Text:
    """Sentences: a paragraph each, or with ``points`` a list; ``small`` as a remark."""

    kind: ClassVar[str] = "text"
    sentences: tuple[str, ...]
    points: bool = False
    small: bool = False


@dataclass(frozen=True)
class Choice:
    """Boxes that show and hide the groups (number, name, colour) of a section's inline figures."""

    kind: ClassVar[str] = "choice"
    groups: tuple[tuple[int, str, str], ...]


Block = Tiles | Table | Text | Choice | Figure | Picture


@dataclass(frozen=True)
class Section:
    """A part of a page, which is left out if it has no contents; ``name`` is its anchor.

    open : whether it opens with the page, as the first one always does.
    """

    name: str
    title: str
    contents: Sequence[Block]
    open: bool = False


@dataclass(frozen=True)
class Verdict:
    """``colour`` : good, usable or rejected; ``sentences`` : good or bad; ``warnings`` : bad."""

    headline: str
    colour: str
    sentences: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Page:
    """What a page says.

    kind, title, name : what the page is, for its head, and of what.
    look : the figures that answer the question, beside the verdict.
    terms : those of the glossary that it explains.
    outdated : the results that are older than their inputs, in words.
    """

    kind: str
    title: str
    name: str
    verdict: Verdict
    look: Sequence[Figure | Picture] = ()
    sections: Sequence[Section] = ()
    terms: Sequence[str] = ()
    outdated: Sequence[str] = field(default_factory=tuple)


def render_page(page: Page) -> str:
    """Return a page as text, its figures drawn on several cores; names are escaped."""
    figures = [one for one in (*page.look, *_blocks(page)) if isinstance(one, Figure)]
    pictures = iter(drawn_over_cores([partial(drawn, figure) for figure in figures]))

    def ready(blocks: Iterable[Any]) -> list[Any]:
        found = [next(pictures) if isinstance(one, Figure) else one for one in blocks]
        return [one for one in found if one is not None]

    look = ready(page.look)
    sections = [replace(one, contents=ready(one.contents)) for one in page.sections]
    context = {
        "page": page, "look": look, "css": _package_file("report.css"),
        "sections": [(one, _grouped(one.contents)) for one in sections if one.contents],
    }  # fmt: skip
    return _environment().get_template(_TEMPLATE).render(context)


def _blocks(page: Page) -> Iterator[Block]:
    for section in page.sections:
        yield from section.contents


def _grouped(contents: Sequence[Any]) -> list[tuple[str, list[Any]]]:
    """Return (kind, blocks) with neighbouring pictures together."""
    kinds = groupby(contents, key=lambda one: getattr(one, "kind", "pictures"))
    return [(kind, list(blocks)) for kind, blocks in kinds]


def texts(*sentences: str, points: bool = False, small: bool = False) -> tuple[Text, ...]:
    """Return the sentences that are not empty as a block; none without one."""
    said = tuple(one for one in sentences if one)
    return (Text(said, points, small),) if said else ()


def table(
    head: Sequence[str], rows: Sequence[Row], numbers: tuple[int, int] = (1, 99)
) -> tuple[Table, ...]:
    """Return a table as a block; none without rows."""
    return (Table(rows, head, numbers),) if rows else ()


def pairs(content: Any, file: str) -> tuple[Table, ...]:
    """Return the leaves of a mapping as a table of names and values, cut after 150 rows."""
    rows = [Row(pair) for pair in flat_rows(content)]
    more = len(rows) - _MOST_ROWS
    rows = rows if more <= 0 else [*rows[:_MOST_ROWS], Row(("and", f"{more} more in {file}"))]
    return table((), rows)


def origin(run: Any, absent: Sequence[str]) -> Section:
    """Return the section on versions, inputs and options, and on what the folder lacks."""
    lacks = f"Not in this folder: {'; '.join(absent)}." if absent else ""
    return Section("origin", "Versions, inputs and options",
                   [*pairs(run, "run.json"), *texts(lacks, small=True)])  # fmt: skip


def link_to(target: Path, page_folder: Path) -> str:
    """Return the link to a file from a page in a folder, relative if the disk allows it."""
    try:
        link = os.path.relpath(target.resolve(), Path(page_folder).resolve())
    except ValueError:
        return target.resolve().as_uri()
    return quote(Path(link).as_posix())


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


def drawn_over_cores(drawings: Sequence[Callable[[], Any]]) -> list[Any]:
    """Call all drawings on several cores; return their results in order."""
    keep_freed_memory()
    prepare_drawing()
    return list(ordered_map(_call, drawings, quick_workers(len(drawings))))


def _call(drawing: Callable[[], Any]) -> Any:
    return drawing()


def _package_file(name: str) -> str:
    return (resources.files("telerig.io.report.page") / name).read_text(encoding="utf-8")
