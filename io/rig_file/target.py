"""The table [target] of `rig.toml`: what its keys mean together, and the Target they make."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Set
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from telerig.io.rig_file.description import Count, Index, Positive, Table
from telerig.io.rig_file.tables import Problem
from telerig.rig.target import Extent, Layout, MarkStyle, Polarity, Target

FARTHEST = 4095
"""Rows and columns of an unbounded grid lie within this of the origin mark."""

Cell = tuple[int, int]
Pitch = Annotated[
    Positive | tuple[Positive, Positive],
    Field(description="a positive number or [x, y] of them"),
]
Points = Annotated[
    tuple[tuple[float, float], ...], Field(min_length=1, description="a list of [x, y]")
]


@dataclass(frozen=True)
class TargetTable(Table):
    """The keys of the table [target] as the file states them; None for keys that are missing."""

    dot_diameter_mm: Positive
    layout: Layout = "grid"
    rows: Count | None = None
    columns: Count | None = None
    pitch_mm: Pitch | None = None
    points_mm: Points | None = None
    polarity: Polarity = "white_on_black"
    marks: Annotated[
        tuple[Cell, ...], Field(description="a list of [row, column] in whole numbers")
    ] = ()
    mark_style: MarkStyle = "large"
    mark_diameter_mm: Positive | None = None
    extent: Extent = "bounded"
    print_sigma_mm: Positive = 0.02
    flatness_sigma_mm: Positive | None = None
    scale_dots: Annotated[
        Cell | tuple[Cell, Cell] | None, Field(description="two dot numbers or two [row, column]")
    ] = None
    scale_distance_mm: Positive | None = None
    scale_sigma_mm: Positive = 0.001
    two_sided: bool = False
    plate_thickness_mm: Positive | None = None
    plate_index: Index | None = None

    def target(self) -> Target:
        """Return the target that a table without problems describes.

        Missing keys get the default values of `Target`.
        """
        stated = {name: value for name, value in vars(self).items() if value is not None}
        stated.setdefault("flatness_sigma_mm", self.print_sigma_mm)
        if self.pitch_mm is not None and not isinstance(self.pitch_mm, tuple):
            stated["pitch_mm"] = (self.pitch_mm, self.pitch_mm)
        if self.points_mm is not None:
            stated["points_mm"] = np.array(self.points_mm, float)
        return Target(**stated | {"scale_dots": _scale_ids(self)})


def target_problems(table: TargetTable, faulty: Set[str] = frozenset()) -> list[Problem]:
    """Return every fault of a table [target] that concerns several keys together.

    faulty : keys that are known to be faulty. A fault that depends on one of these, or on a key
    that is found faulty here, is left out, because it would only repeat that fault.
    """
    layout = _points_problems if table.layout == "points" else _grid_problems
    found: list[Problem] = []
    for check in (layout, _mark_problems, _scale_problems, _plate_problems):
        known = faulty | {problem.key for problem in found}
        found += [p for p in check(table) if not known & {p.key, *p.involved}]
    return found


def _problem(key: str, what: str, todo: str, *involved: str) -> Problem:
    return Problem("target", key, what, todo, involved)


def _grid_problems(t: TargetTable) -> Iterator[Problem]:
    if t.points_mm is not None:
        todo = 'remove it, or set layout = "points"'
        yield _problem("points_mm", "has no meaning on a grid", todo, "layout")
    if t.pitch_mm is None:
        yield _problem("pitch_mm", *_missing_pitch(t), "layout", "scale_distance_mm")
    elif t.dot_diameter_mm >= np.min(t.pitch_mm):
        what = f"is {t.dot_diameter_mm}, not less than the pitch: the dots would touch"
        yield _problem("dot_diameter_mm", what, "correct dot_diameter_mm or pitch_mm", "pitch_mm")
    for key in ("rows", "columns"):
        if getattr(t, key) is None and t.extent == "bounded":
            todo = f'add how many {key} of dots the grid has, or extent = "unbounded"'
            yield _problem(key, "is missing", todo, "layout", "extent")


def _missing_pitch(t: TargetTable) -> tuple[str, str]:
    if t.scale_distance_mm is None:
        return (
            "is missing, and without it or a known distance nothing sets the scale",
            "add pitch_mm, the distance of neighbouring dots (nominal will do), and if you can "
            "scale_dots with scale_distance_mm, a distance that you measured",
        )
    return "is missing", "add the nominal distance of neighbouring dots, one number or [x, y]"


def _points_problems(t: TargetTable) -> Iterator[Problem]:
    given = 'with layout = "points"'
    for key in (k for k in ("rows", "columns", "pitch_mm") if getattr(t, k) is not None):
        todo = "remove it; the dots' places are points_mm"
        yield _problem(key, f"has no meaning {given}", todo, "layout")
    if t.extent == "unbounded":
        todo = "remove it; only a grid goes on beyond the image"
        yield _problem("extent", f'cannot be "unbounded" {given}', todo, "layout")
    if t.points_mm is None:
        todo = "add points_mm = [[x, y], ...], the nominal places of the dots"
        yield _problem("points_mm", "is missing", todo, "layout")
        return
    for twice in (point for point, count in Counter(t.points_mm).items() if count > 1):
        yield _problem("points_mm", f"has the point {list(twice)} more than once", "remove one")


def _mark_problems(t: TargetTable) -> Iterator[Problem]:
    involved = ("rows", "columns", "layout", "extent", "points_mm")
    wanted = {
        "points": f"[0, dot] with dot from 0 to {len(t.points_mm or ()) - 1}",
        "bounded": f"rows 0 to {(t.rows or 0) - 1}, columns 0 to {(t.columns or 0) - 1}",
        "unbounded": f"rows and columns within +-{FARTHEST} of the origin mark",
    }["points" if t.layout == "points" else t.extent]
    for row, column in (cell for cell in t.marks if not _inside(t, *cell)):
        what = f"has [{row}, {column}], which is not on the target"
        yield _problem("marks", what, f"marks are [row, column] from 0: {wanted}", *involved)
    for twice in (cell for cell, count in Counter(t.marks).items() if count > 1):
        yield _problem("marks", f"has {list(twice)} more than once", "remove one")
    if t.mark_style != "large" or not t.marks:
        return
    related = ("marks", "mark_style", "dot_diameter_mm")
    if t.mark_diameter_mm is None:
        what = 'is missing, and mark_style = "large" needs it'
        todo = "add the diameter of the large dots, or set mark_style"
        yield _problem("mark_diameter_mm", what, todo, *related)
    elif t.mark_diameter_mm <= t.dot_diameter_mm:
        what = f"is {t.mark_diameter_mm}, not larger than dot_diameter_mm = {t.dot_diameter_mm}"
        todo = "correct one of them, or set mark_style"
        yield _problem("mark_diameter_mm", what, todo, *related)


def _inside(t: TargetTable, row: int, column: int) -> bool:
    """Whether the target has this place, a missing mark included."""
    if t.layout == "points":
        return row == 0 and 0 <= column < len(t.points_mm or ())
    if t.extent == "unbounded":
        return max(abs(row), abs(column)) <= FARTHEST
    return 0 <= row < (t.rows or 0) and 0 <= column < (t.columns or 0)


def _scale_problems(t: TargetTable) -> Iterator[Problem]:
    if (t.scale_dots is None) != (t.scale_distance_mm is None):
        pair = ("scale_dots", "scale_distance_mm")
        missing, other = pair if t.scale_dots is None else pair[::-1]
        todo = f"give both, or remove {other}: the nominal pitch then sets the scale"
        yield _problem(missing, f"is missing, and {other} is given", todo, other)
    if t.scale_dots is None:
        return
    keys = ("rows", "columns", "layout", "extent", "points_mm")
    cells = _scale_cells(t)
    if cells is None:
        numbered = t.layout == "points" or t.columns is not None
        todo = f"write two {'dot numbers like [0, 14]' if numbered else '[row, column]'}"
        what = f"is {_as_written(t.scale_dots)}, which does not say which dots are meant"
        yield _problem("scale_dots", what, todo, *keys)
        return
    block = (t.rows or 0) * (t.columns or 0)
    for given, cell in zip(t.scale_dots, cells):
        what = f"has {_as_written(given)}, which is"
        counted_outside = isinstance(given, int) and t.layout == "grid" and not 0 <= given < block
        if counted_outside or not _inside(t, *cell):
            yield _problem("scale_dots", f"{what} not on the target", _scale_range(t), *keys)
        elif t.mark_style == "missing" and cell in t.marks:
            todo = "choose two dots that are printed"
            involved = (*keys, "marks", "mark_style")
            yield _problem("scale_dots", f"{what} a missing mark: no dot is there", todo, *involved)
    if cells[0] == cells[1]:
        yield _problem("scale_dots", "names the same dot twice", "name two different dots", *keys)


def _as_written(value: Any) -> str:
    """Return a TOML list in place of Python's tuple."""
    return str(value).replace("(", "[").replace(")", "]")


def _scale_range(t: TargetTable) -> str:
    count = len(t.points_mm or ()) if t.layout == "points" else (t.rows or 0) * (t.columns or 0)
    todo = f"dots are numbered from 0 to {count - 1}" if count else "dots have no numbers here"
    if t.extent == "unbounded":
        todo += "; name dots beyond the block by [[row, column], [row, column]]"
    return todo


def _scale_cells(t: TargetTable) -> list[Cell] | None:
    """Return (row, column) of both scale dots; None where the numbers cannot be read."""
    cells: list[Cell] = []
    for dot in t.scale_dots or ():
        if isinstance(dot, int) and t.layout == "points":
            cells.append((0, dot))
        elif isinstance(dot, int) and t.columns is not None:
            cells.append((dot // t.columns, dot % t.columns))
        elif not isinstance(dot, int) and t.layout == "grid":
            cells.append(dot)
    return cells if len(cells) == 2 else None


def _scale_ids(t: TargetTable) -> tuple[int, int] | None:
    cells = _scale_cells(t)
    if cells is None:
        return None
    numbering = Target(layout=t.layout, columns=t.columns or 0, extent=t.extent)
    first, second = (int(numbering.id_from_row_column(*cell)) for cell in cells)
    return first, second


def _plate_problems(t: TargetTable) -> Iterator[Problem]:
    what = (
        "is missing. two_sided = true needs it, because the dots on the far face are seen by "
        "refraction through the plate"
    )
    for key in ("plate_thickness_mm", "plate_index"):
        if t.two_sided and getattr(t, key) is None:
            yield _problem(key, what, f"add {key} or remove two_sided", "two_sided")
