"""The table [target] of `rig.toml`: what its keys mean together, and the Target they make."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Set

import numpy as np

from telerig.io.rig_file.schema import Problem, TargetTable
from telerig.rig.target import Target

FARTHEST = 4095
"""Rows and columns of an unbounded grid lie within this of the origin mark."""

GRID_KEYS = ("rows", "columns", "pitch_mm")


def target_problems(table: TargetTable, faulty: Set[str] = frozenset()) -> list[Problem]:
    """Every fault that shows only when the keys are taken together.

    What depends on a ``faulty`` key, or on one found faulty here, would only repeat that fault
    and is left out.
    """
    layout = _points_problems if table.layout == "points" else _grid_problems
    found: list[Problem] = []
    for check in (layout, _mark_problems, _scale_problems, _plate_problems):
        known = faulty | {problem.key for problem in found}
        found += [p for p in check(table) if not known & {p.key, *p.involved}]
    return found


def target_from_table(table: TargetTable) -> Target:
    """The Target of a table without problems."""
    pitch = table.pitch_mm if table.pitch_mm is not None else 1.0
    x, y = pitch if isinstance(pitch, list) else (pitch, pitch)
    flatness = table.flatness_sigma_mm
    return Target(
        layout=table.layout,
        rows=table.rows or 0,
        columns=table.columns or 0,
        pitch_mm=(x, y),
        points_mm=None if table.points_mm is None else np.array(table.points_mm, float),
        dot_diameter_mm=table.dot_diameter_mm,
        polarity=table.polarity,
        marks=tuple((row, column) for row, column in table.marks),
        mark_style=table.mark_style,
        mark_diameter_mm=table.mark_diameter_mm,
        extent=table.extent,
        print_sigma_mm=table.print_sigma_mm,
        flatness_sigma_mm=table.print_sigma_mm if flatness is None else flatness,
        scale_dots=_scale_ids(table),
        scale_distance_mm=table.scale_distance_mm,
        scale_sigma_mm=table.scale_sigma_mm,
        two_sided=table.two_sided,
        plate_thickness_mm=table.plate_thickness_mm or 0.0,
        plate_index=table.plate_index or 1.5,
    )


def _problem(key: str, what: str, todo: str, *involved: str) -> Problem:
    return Problem("target", key, what, todo, involved)


def _grid_problems(t: TargetTable) -> Iterator[Problem]:
    if t.points_mm is not None:
        yield _problem(
            "points_mm", "has no meaning on a grid", 'remove it, or set layout = "points"', "layout"
        )
    if t.pitch_mm is None:
        yield _problem("pitch_mm", *_missing_pitch(t), "layout", "scale_distance_mm")
    elif t.dot_diameter_mm >= np.min(t.pitch_mm):
        yield _problem(
            "dot_diameter_mm",
            f"is {t.dot_diameter_mm}, not less than the pitch: the dots would touch",
            "correct dot_diameter_mm or pitch_mm",
            "pitch_mm",
        )
    for key in ("rows", "columns"):
        if getattr(t, key) is None and t.extent == "bounded":
            yield _problem(
                key,
                "is missing",
                f'add how many {key} of dots the grid has, or extent = "unbounded"',
                "layout",
                "extent",
            )


def _missing_pitch(t: TargetTable) -> tuple[str, str]:
    if t.scale_distance_mm is None:
        return (
            "is missing, and without it or a known distance nothing sets the scale",
            "add pitch_mm, the distance of neighbouring dots (nominal will do), and if you can "
            "scale_dots with scale_distance_mm, a distance that you measured",
        )
    return "is missing", "add the nominal distance of neighbouring dots, one number or [x, y]"


def _points_problems(t: TargetTable) -> Iterator[Problem]:
    for key in (k for k in GRID_KEYS if getattr(t, k) is not None):
        yield _problem(
            key,
            'has no meaning with layout = "points"',
            "remove it; the dots' places are points_mm",
            "layout",
        )
    if t.extent == "unbounded":
        yield _problem(
            "extent",
            'cannot be "unbounded" with layout = "points"',
            "remove it; only a grid goes on beyond the image",
            "layout",
        )
    if t.points_mm is None:
        yield _problem(
            "points_mm",
            "is missing",
            "add points_mm = [[x, y], ...], the nominal places of the dots",
            "layout",
        )
        return
    counts = Counter((float(x), float(y)) for x, y in t.points_mm)
    for twice in (point for point, count in counts.items() if count > 1):
        yield _problem("points_mm", f"has the point {list(twice)} more than once", "remove one")


def _mark_problems(t: TargetTable) -> Iterator[Problem]:
    involved = ("rows", "columns", "layout", "extent", "points_mm")
    wanted = {
        "points": f"[0, dot] with dot from 0 to {len(t.points_mm or ()) - 1}",
        "bounded": f"rows 0 to {(t.rows or 0) - 1}, columns 0 to {(t.columns or 0) - 1}",
        "unbounded": f"rows and columns within +-{FARTHEST} of the origin mark",
    }["points" if t.layout == "points" else t.extent]
    for row, column in (cell for cell in t.marks if not _inside(t, *cell)):
        yield _problem(
            "marks",
            f"has [{row}, {column}], which is not on the target",
            f"marks are [row, column] from 0: {wanted}",
            *involved,
        )
    counts = Counter((row, column) for row, column in t.marks)
    for twice in (cell for cell, count in counts.items() if count > 1):
        yield _problem("marks", f"has {list(twice)} more than once", "remove one")
    if t.mark_style != "large" or not t.marks:
        return
    related = ("marks", "mark_style", "dot_diameter_mm")
    if t.mark_diameter_mm is None:
        yield _problem(
            "mark_diameter_mm",
            'is missing, and mark_style = "large" needs it',
            "add the diameter of the large dots, or set mark_style",
            *related,
        )
    elif t.mark_diameter_mm <= t.dot_diameter_mm:
        yield _problem(
            "mark_diameter_mm",
            f"is {t.mark_diameter_mm}, not larger than dot_diameter_mm = {t.dot_diameter_mm}",
            "correct one of them, or set mark_style",
            *related,
        )


def _inside(t: TargetTable, row: int, column: int) -> bool:
    """Whether the target has this place, a missing mark included."""
    if t.layout == "points":
        return row == 0 and 0 <= column < len(t.points_mm or ())
    if t.extent == "unbounded":
        return max(abs(row), abs(column)) <= FARTHEST
    return 0 <= row < (t.rows or 0) and 0 <= column < (t.columns or 0)


def _scale_problems(t: TargetTable) -> Iterator[Problem]:
    if (t.scale_dots is None) != (t.scale_distance_mm is None):
        missing = "scale_dots" if t.scale_dots is None else "scale_distance_mm"
        other = "scale_distance_mm" if t.scale_dots is None else "scale_dots"
        yield _problem(
            missing,
            f"is missing, and {other} is given",
            f"give both, or remove {other}: the nominal pitch then sets the scale",
            other,
        )
    if t.scale_dots is None:
        return
    keys = ("rows", "columns", "layout", "extent", "points_mm")
    cells, countable = _scale_cells(t), t.layout == "points" or t.columns is not None
    if cells is None:
        todo = (
            "write [[row, column], [row, column]]"
            if not countable
            else ("write two dot numbers like [0, 14]")
        )
        yield _problem(
            "scale_dots", f"is {t.scale_dots}: the dots cannot be told from it", todo, *keys
        )
        return
    block = (t.rows or 0) * (t.columns or 0)
    for given, cell in zip(t.scale_dots, cells):
        counted_outside = isinstance(given, int) and t.layout == "grid" and not 0 <= given < block
        if counted_outside or not _inside(t, *cell):
            yield _problem(
                "scale_dots", f"has {given}, which is not on the target", _scale_range(t), *keys
            )
        elif t.mark_style == "missing" and list(cell) in t.marks:
            yield _problem(
                "scale_dots",
                f"has {given}, which is a missing mark: no dot is there",
                "choose two dots that are printed",
                *keys,
                "marks",
                "mark_style",
            )
    if cells[0] == cells[1]:
        yield _problem("scale_dots", "names the same dot twice", "name two different dots", *keys)


def _scale_range(t: TargetTable) -> str:
    count = len(t.points_mm or ()) if t.layout == "points" else (t.rows or 0) * (t.columns or 0)
    todo = f"dots are numbered from 0 to {count - 1}" if count else "dots have no numbers here"
    if t.extent == "unbounded":
        todo += "; name dots beyond the block by [[row, column], [row, column]]"
    return todo


def _scale_cells(t: TargetTable) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """(row, column) of both scale dots; None where the numbers cannot be read."""
    cells: list[tuple[int, int]] = []
    for dot in t.scale_dots or ():
        if not isinstance(dot, int):
            if t.layout == "points":
                return None
            cells.append((dot[0], dot[1]))
        elif t.layout == "points":
            cells.append((0, dot))
        elif t.columns is None:
            return None
        else:
            cells.append((dot // t.columns, dot % t.columns))
    return cells[0], cells[1]


def _scale_ids(t: TargetTable) -> tuple[int, int] | None:
    cells = _scale_cells(t) if t.scale_dots is not None else None
    if cells is None:
        return None
    numbering = Target(layout=t.layout, columns=t.columns or 0, extent=t.extent)
    first, second = (int(numbering.id_from_row_column(*cell)) for cell in cells)
    return first, second


def _plate_problems(t: TargetTable) -> Iterator[Problem]:
    for key in ("plate_thickness_mm", "plate_index"):
        if t.two_sided and getattr(t, key) is None:
            yield _problem(
                key,
                "is missing, and two_sided = true needs it: the far side is seen through the plate",
                f"add {key} or remove two_sided",
                "two_sided",
            )
