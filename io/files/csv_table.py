"""CSV tables: read strictly, with the file's row and column in every error; written exactly.

One header line, comma, UTF-8. Rows are counted as an editor shows them: the header is row 1.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array, Bools
from telerig.errors import InputError, suggestion
from telerig.io.files.atomic import atomic_path

_EXPORT = "export the table as comma-separated UTF-8 with one header line"


@dataclass(frozen=True)
class Column:
    """A column that a table may have.

    blank : empty cells are legal and read as NaN (number, whole) or "" (text).
    """

    name: str
    kind: Literal["number", "whole", "text"] = "number"
    required: bool = True
    blank: bool = False


def read_table(
    path: str | PathLike[str], columns: Sequence[Column], *, extra: bool = False
) -> pd.DataFrame:
    """The table with the columns that the file has, in the file's order.

    The index is the row in the file (header = 1), for errors that later checks raise. "whole"
    columns are int64, or float64 where cells may be blank. With ``extra``, columns that are not
    in ``columns`` are kept as well, as numbers if all their cells are. Raises InputError for a
    missing or unknown column, a cell that is not a finite number, a ragged row, an empty table.
    """
    file = Path(path)
    header, content, numbers = _cells(file)
    _check_header(header, columns, extra, file)
    if not numbers:
        raise InputError(
            "has no rows below its header",
            where=str(file),
            todo="write one row per measurement, or remove the file",
        )
    known = {column.name: column for column in columns}
    values = {}
    for name, cells in zip(header, content):
        column = known.get(name)
        convert = _extra if column is None else _CONVERT[column.kind]
        values[name] = convert(cells, column or Column(name), Rows(file, numbers))
    return pd.DataFrame(values, index=pd.Index(numbers, name="file_row"))


def write_table(table: pd.DataFrame, path: str | PathLike[str]) -> None:
    """Write a CSV whose floats read back bit for bit; NaN is a blank cell, truth values 0 and 1.

    The index is left out. Written beside and renamed. Raises InputError when it cannot be.
    """
    flags = {name: int for name, kind in table.dtypes.items() if kind.kind == "b"}
    with atomic_path(path) as temporary:
        table.astype(flags).to_csv(temporary, index=False, encoding="utf-8", lineterminator="\n")


@dataclass(frozen=True)
class Rows:
    """Rows of a file, for errors. numbers : each row's number in the file, the header being 1."""

    file: Path
    numbers: Any

    def refuse(self, bad: Bools, column: str, what: str | Callable[[int], str], todo: str) -> None:
        """Raise InputError for the first of the ``bad`` rows, naming the others; or do nothing.

        what : what is wrong, or a function that says it for the position of a row in the table.
        """
        positions = np.flatnonzero(bad)
        if not positions.size:
            return
        first, *others = (self.numbers[int(i)] for i in positions)
        text = what if isinstance(what, str) else what(int(positions[0]))
        if others:
            listed = ", ".join(map(str, others[:5])) + (", ..." if len(others) > 5 else "")
            text += f" (and {len(others)} more: row {listed})"
        where = f"{self.file} row {first}" + (f", column {column}" if column else "")
        raise InputError(text, where=where, todo=todo)


def rows_of(table: pd.DataFrame, file: Path) -> Rows:
    """The rows of a table that `read_table` gave, or of a part of it."""
    return Rows(file, table.index)


def _cells(file: Path) -> tuple[list[str], list[Sequence[str]], list[int]]:
    """Header, the cells column by column, and each row's number; blank lines are passed over."""
    text = _decoded(file)
    lines = text.split("\n")
    numbers = [i for i, line in enumerate(lines, 1) if line.strip(", \r")]
    if not numbers:
        raise InputError("is empty", where=str(file), todo=_EXPORT)
    lines = [lines[i - 1] for i in numbers]
    for mark, word in ((";", "semicolons"), ("\t", "tabs")):
        if mark in lines[0] and "," not in lines[0]:
            what = f"the columns are separated by {word}"
            raise InputError(what, where=f"{file} row {numbers[0]}", todo=_EXPORT)
    if '"' in text:
        rows = [next(csv.reader([line]), []) for line in lines]
        counts = [len(row) for row in rows]
        flat = [cell for row in rows for cell in row]
    else:
        counts = [line.count(",") + 1 for line in lines]
        flat = ",".join(lines).split(",")
    width = counts[0]
    Rows(file, numbers).refuse(
        np.array(counts) != width,
        "",
        lambda i: f"has {counts[i]} cells, the header has {width}",
        "complete the row; a decimal comma must be a point",
    )
    header = [name.strip() for name in flat[:width]]
    return header, [flat[width + k :: width] for k in range(width)], numbers[1:]


def _decoded(file: Path) -> str:
    try:
        return file.read_bytes().decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror}",
            where=str(file),
            todo="check the path and its permissions",
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(
            f"is not UTF-8 text: {error.reason} at byte {error.start}",
            where=str(file),
            todo=_EXPORT,
        ) from error


def _check_header(header: list[str], columns: Sequence[Column], extra: bool, file: Path) -> None:
    where, known = f"{file} row 1", [column.name for column in columns]
    for name in header:
        if header.count(name) > 1:
            raise InputError(f"the column {name!r} stands twice", where=where, todo="remove one")
    faults = []
    if not extra:
        unknown = {name: suggestion(name, known) for name in header if name not in known}
        faults += [f"unknown column {name!r}: {todo}" for name, todo in unknown.items()]
    missing = [c.name for c in columns if c.required and c.name not in header]
    if missing:
        faults.append(f"missing column{'s' if len(missing) > 1 else ''}: {', '.join(missing)}")
    if faults:
        raise InputError(
            "; ".join(faults), where=where, todo=f"the header may have: {','.join(known)}"
        )


def _text(cells: Sequence[str], column: Column, rows: Rows) -> Any:
    blank = np.array([not cell.strip() for cell in cells], bool)
    rows.refuse(blank & (not column.blank), column.name, "is blank", "fill in the cell")
    return np.array([cell.strip() for cell in cells], dtype=object)


def _number(cells: Sequence[str], column: Column, rows: Rows) -> Array:
    values = _floats(cells)
    bad = ~np.isfinite(values)
    if column.blank and bad.any():
        bad &= np.array([bool(cell.strip()) for cell in cells], bool)
    rows.refuse(
        bad,
        column.name,
        lambda i: f"is {cells[i]!r}, not a finite number" if cells[i] else "is blank",
        "correct the cell, or remove the row if there was no measurement",
    )
    return values


def _whole(cells: Sequence[str], column: Column, rows: Rows) -> NDArray[Any]:
    values = _number(cells, column, rows)
    broken = (values % 1 != 0) & ~np.isnan(values)
    what = "is {!r}, not a whole number"
    rows.refuse(broken, column.name, lambda i: what.format(cells[i]), "correct the cell")
    return values if column.blank else values.astype(np.int64)


_CONVERT: dict[str, Callable[..., Any]] = {"number": _number, "whole": _whole, "text": _text}


def _extra(cells: Sequence[str], column: Column, rows: Rows) -> NDArray[Any]:
    values = _floats(cells)
    unreadable = [cell.strip().lower() not in ("", "nan") for cell in cells] & np.isnan(values)
    return np.array(cells, dtype=object) if np.any(unreadable) else values


def _floats(cells: Sequence[str]) -> Array:
    """NaN for what is no number; Python's own conversion keeps every digit."""
    try:
        if "_" not in "".join(cells):
            return np.array(cells, dtype=object).astype(np.float64)
    except ValueError:
        pass
    return np.array([_float(cell) for cell in cells])


def _float(cell: str) -> float:
    try:
        return float(cell) if "_" not in cell else np.nan
    except ValueError:
        return np.nan
