"""Read CSV tables strictly, with file, row and column in every error, and write them exactly.

A table has one header line, commas and UTF-8. Rows are counted as an editor shows them: the header
is row 1.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array, Bools
from telerig.errors import InputError, suggestion
from telerig.io.files.atomic import atomic_path
from telerig.io.files.names import ADVICE, fault_of_name
from telerig.io.files.text import LARGEST_NUMBER, read_text
from telerig.io.machine.room import check_room

_EVERY_DIGIT: dict[str, Any] = (
    {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1)
    else {"float_precision": "round_trip"}
)  # fmt: skip
"""An option for `pandas.read_csv`, whose default parser rounds correctly from pandas 3.1 on."""
_EXPORT = "export the table as comma-separated UTF-8 with one header line"
_CONVERT_IT = (
    "; or write it anew with pandas: pd.read_csv(FILE, sep={mark!r}, decimal=',')"
    ".to_csv(FILE, index=False)"
)
_NO_MARKS = bytes(set(range(256)) - set(b",\n"))

MOST_COLUMNS = 1000


@dataclass(frozen=True)
class Column:
    """Describe a column that a table may have; a blank cell is read as NaN or "".

    kind : "number" (float), "sd" (number from 0 on: a standard deviation), "whole" (whole number),
        "text", "name" (text that follows the rule of `telerig.io.files.names`) or "id" (names that
        are read as numbers if all are whole numbers).
    unit : in the notation of UDUNITS, "" for none. what : the meaning in words.
    """

    name: str
    kind: Literal["number", "sd", "whole", "text", "name", "id"] = "number"
    required: bool = True
    blank: bool = False
    unit: str = ""
    what: str = ""


def read_table(
    path: str | PathLike[str],
    columns: Sequence[Column],
    *,
    extra: bool = False,
    empty: bool = False,
) -> pd.DataFrame:
    """Read a CSV table and check its header and its cells.

    columns : the columns that the table may or must have.
    extra : keeps further columns, as numbers if all their cells are numbers; otherwise they are
        refused.
    empty : allows no rows.

    Returns the columns in the file's order. The index is the row in the file (the header is row 1).
    "whole" columns are int64, or float64 where cells may be blank. Raises InputError for a missing
    or unknown column, more than `MOST_COLUMNS`, a cell that is no number up to `LARGEST_NUMBER`, a
    negative standard deviation, a text with control characters, a row with too few or too many
    cells, and an empty table.
    """
    file = Path(path)
    table = _sound_table(file, columns, extra)
    if table is not None and (empty or len(table)):
        return table
    header, content, numbers = _cells(file)
    _check_header(header, columns, extra, file)
    if not numbers and not empty:
        raise InputError(
            "has no rows below its header",
            where=str(file),
            todo="write one row per measurement, or remove the file",
        )
    known = {column.name: column for column in columns}
    values = {}
    for name, cells in zip(header, content):
        column = known.get(name)
        convert = _CONVERT[column.kind] if column else _extra
        values[name] = convert(cells, column or Column(name), Rows(file, numbers))
    return pd.DataFrame(values, index=pd.Index(numbers, name="file_row"))


def no_rows(columns: Sequence[Column]) -> pd.DataFrame:
    """Return the table of these columns that a file must have, without rows."""
    kinds = {one.name: _DTYPES[one.kind, one.blank] for one in columns if one.required}
    return pd.DataFrame({name: pd.Series(dtype=kind) for name, kind in kinds.items()})


def write_table(table: pd.DataFrame, path: str | PathLike[str]) -> None:
    """Write a CSV table, completely or not at all; floats have the same values when read again.

    NaN becomes a blank cell, truth values become 0 and 1, the index is left out.
    """
    flags = {name: int for name, kind in table.dtypes.items() if kind.kind == "b"}
    with atomic_path(path) as temporary:
        table.astype(flags).to_csv(temporary, index=False, encoding="utf-8", lineterminator="\n")


def append_table(table: pd.DataFrame, path: Path) -> None:
    """Append rows to a CSV table as `write_table` writes it, or begin it."""
    flags = {name: int for name, kind in table.dtypes.items() if kind.kind == "b"}
    with path.open("a", encoding="utf-8", newline="") as file:
        begun = file.tell() > 0
        table.astype(flags).to_csv(file, index=False, header=not begun, lineterminator="\n")


@dataclass(frozen=True)
class Rows:
    """Names the rows of a table in errors, by their numbers in the file.

    numbers : (rows,) number of each row in the file; the header is row 1.
    """

    file: Path
    numbers: Any

    def refuse(self, bad: Bools, column: str, what: str | Callable[[int], str], todo: str) -> None:
        """Raise InputError if a row is bad; the message names the first one and lists others.

        bad : (rows,) whether each row is bad.
        column : the column that the message names.
        what : what is wrong, or a function that returns this for the index of a row in the table.
        todo : what the user can do.
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
    """Return the `Rows` of a table that `read_table` returned, or of a part of it."""
    return Rows(file, table.index)


def read_part(
    file: Path, content: bytes, row: int, columns: Sequence[Column]
) -> pd.DataFrame | None:
    """Read a part of a CSV table as `read_table` reads the whole table with ``extra``.

    content : the header and some rows. row : number of the first of these rows in the file.
    Returns None if the text is unusual, so that the whole file has to be read with `read_table`,
    which finds any fault.
    """
    return _sound_table(file, columns, True, content, row)


_TABLE = 1.5
"""Memory of a table that is read, with its text, divided by the size of its file, at least."""
_SMALLER = "take a computer with more memory, or a table of fewer frames"


def _sound_table(
    file: Path, columns: Sequence[Column], extra: bool,
    content: bytes | None = None, row: int = 2,
) -> pd.DataFrame | None:  # fmt: skip
    """Read a CSV table with pandas' fast reader; None for an unusual file, left to `_cells`."""
    try:
        if content is None:
            check_room(str(file), _SMALLER, memory=_TABLE * file.stat().st_size)
            content = file.read_bytes()
        header = content.split(b"\n", 1)[0].decode("utf-8-sig").rstrip("\r").split(",")
    except (OSError, UnicodeDecodeError):
        return None
    if len(header) > MOST_COLUMNS:
        return None
    known = {column.name: column for column in columns}
    if (
        b'"' in content
        or _CONTROL.search(content)
        or not _same_cells(content, len(header))
        or len(set(header)) < len(header)
        or any(column.required and column.name not in header for column in columns)
        or (not extra and not set(header) <= set(known))
    ):
        return None
    kinds = {n: _DTYPES[known[n].kind, known[n].blank] if n in known else str for n in header}
    numeric = [name for name, kind in kinds.items() if kind is not str]
    try:
        with np.errstate(invalid="ignore"):  # a number too large for a whole one; found below
            table: pd.DataFrame = pd.read_csv(
                BytesIO(content), usecols=header, dtype=kinds, keep_default_na=False,
                na_values={name: [""] for name in numeric}, skip_blank_lines=False,
                encoding="utf-8-sig", **_EVERY_DIGIT,
            )  # fmt: skip
    except (ValueError, OverflowError, pd.errors.ParserError):
        return None
    rows = Rows(file, pd.RangeIndex(row, len(table) + row, name="file_row"))
    values: dict[str, Any] = {}
    for name in header:
        cells, column = table[name], known.get(name)
        if column is None:
            values[name] = _extra(cells.tolist(), Column(name), rows)
            continue
        if name not in numeric:
            cells = cells.str.strip()
            bad = (cells == "") & (not column.blank)
            if column.kind in ("name", "id"):
                bad |= cells.isin([one for one in cells.unique() if one and fault_of_name(one)])
        else:
            bad = ~(cells.abs() <= LARGEST_NUMBER) & ~(cells.isna() & column.blank)
            bad |= (cells % 1 > 0) & (column.kind == "whole")
            bad |= (cells < 0) & (column.kind == "sd")
        if bad.any():
            return None
        values[name] = _as_ids(cells) if column.kind == "id" else cells
    return pd.DataFrame(values, index=table.index).set_index(rows.numbers)


def _same_cells(content: bytes, columns: int) -> bool:
    """Return whether every line of a table without quotes has this number of cells."""
    marks = content.translate(None, _NO_MARKS) + (b"" if content.endswith(b"\n") else b"\n")
    return marks == (b"," * (columns - 1) + b"\n") * (len(marks) // columns)


def _cells(file: Path) -> tuple[list[str], Sequence[Sequence[str]], list[int]]:
    """Read a CSV file as text: header, cells of each column, number of each row in the file.

    Raises InputError for an empty file, another separator, and rows of different lengths.
    """
    lines = read_text(file, _EXPORT).split("\n")
    numbers = [i for i, line in enumerate(lines, 1) if line.strip(", \r")]
    if not numbers:
        raise InputError("is empty", where=str(file), todo=_EXPORT)
    first = lines[numbers[0] - 1]
    if first.count(",") >= MOST_COLUMNS:
        what = f"has {first.count(',') + 1} columns; {MOST_COLUMNS} are read at most"
        raise InputError(what, where=f"{file} row {numbers[0]}", todo=_EXPORT)
    for mark, word in ((";", "semicolons"), ("\t", "tabs")):
        if mark in first and "," not in first:
            what = f"the columns are separated by {word}"
            todo = _EXPORT + _CONVERT_IT.format(mark=mark)
            raise InputError(what, where=f"{file} row {numbers[0]}", todo=todo)
    header, *rows = (_split(lines[i - 1], f"{file} row {i}") for i in numbers)
    Rows(file, numbers[1:]).refuse(
        np.array([len(row) != len(header) for row in rows], bool),
        "",
        lambda i: f"has {len(rows[i])} cells, the header has {len(header)}",
        "complete the row; a decimal comma must be a point",
    )
    content = list(zip(*rows)) or [()] * len(header)
    names = [name.strip() or f"Unnamed: {i}" for i, name in enumerate(header)]
    return names, content, numbers[1:]


def _split(line: str, where: str) -> list[str]:
    """Return the cells of a line. Raises InputError for control characters and too long cells."""
    if _CONTROL.search(line.encode("utf-8")):
        raise InputError("has a control character", where=where, todo="remove it")
    try:
        return next(csv.reader([line]), [])
    except csv.Error as error:
        raise InputError(f"cannot be read as cells: {error}", where=where, todo=_EXPORT) from error


def header_of(file: Path, todo: str) -> list[str]:
    """Read the names in the first line of a CSV table; the list is [""] for an empty file.

    todo : the advice in an error. Raises InputError as `read_text` does.
    """
    first, _, _ = read_text(file, todo).partition("\n")
    return [name.strip() for name in first.split(",")]


def _check_header(header: list[str], columns: Sequence[Column], extra: bool, file: Path) -> None:
    """Raise InputError for a repeated, an unknown or a missing column."""
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


def _name(cells: Sequence[str], column: Column, rows: Rows) -> Any:
    found = _text(cells, column, rows)
    faults = [fault_of_name(name) if name else "" for name in found]
    what = "is {!r:.80}; the name {}"
    rows.refuse(
        np.array([bool(fault) for fault in faults], bool),
        column.name,
        lambda i: what.format(found[i], faults[i]),
        ADVICE,
    )
    return found


def _id(cells: Sequence[str], column: Column, rows: Rows) -> Any:
    return _as_ids(pd.Series(_name(cells, column, rows), dtype=object)).to_numpy()


def _as_ids(names: pd.Series[Any]) -> pd.Series[Any]:
    """Return names as int64 if all are whole numbers, as float64 with NaN if some are blank."""
    every = {name: whole_id(name) for name in names.unique() if name}
    if None in every.values():
        return names
    numbers = names.map({"": np.nan} | every)
    return numbers.astype(float if (names == "").any() else np.int64)


def whole_id(name: str) -> int | None:
    """Return the whole number of an id, 3 also for "3.0"; None for a name, such as "007"."""
    return int(float(name)) if _WHOLE_ID.fullmatch(name) else None


def _number(cells: Sequence[str], column: Column, rows: Rows) -> Array:
    values = _floats(cells)
    bad = ~(np.abs(values) <= LARGEST_NUMBER)
    if column.blank and bad.any():
        bad &= np.array([bool(cell.strip()) for cell in cells], bool)
    words = {True: f"not a number up to {LARGEST_NUMBER:g}", False: "not a finite number"}
    rows.refuse(
        bad,
        column.name,
        lambda i: (
            f"is {cells[i]!r:.80}, {words[bool(np.isfinite(values[i]))]}"
            if cells[i]
            else "is blank"
        ),
        "correct the cell, or remove the row if there was no measurement",
    )
    return values


def _sd(cells: Sequence[str], column: Column, rows: Rows) -> Array:
    values = _number(cells, column, rows)
    what = "is {!r:.80}, but a standard deviation is not negative"
    rows.refuse(values < 0, column.name, lambda i: what.format(cells[i]), "correct the cell")
    return values


def _whole(cells: Sequence[str], column: Column, rows: Rows) -> NDArray[Any]:
    values = _number(cells, column, rows)
    broken = (values % 1 != 0) & ~np.isnan(values)
    what = "is {!r:.80}, not a whole number"
    rows.refuse(broken, column.name, lambda i: what.format(cells[i]), "correct the cell")
    return values if column.blank else values.astype(np.int64)


_TEXTS = ("text", "name", "id")
_WHOLE_ID = re.compile(r"(?:0|-?[1-9]\d{0,14})(?:\.0*)?")
"""Not "007", which is a name; "3.0" is what programs make of 3 where other cells are blank."""
_CONTROL = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
_CONVERT: dict[str, Callable[..., Any]] = {
    "number": _number, "sd": _sd, "whole": _whole, "text": _text, "name": _name, "id": _id,
}  # fmt: skip
_DTYPES: dict[tuple[str, bool], Any] = {
    **{(kind, blank): np.float64 for kind in ("number", "sd") for blank in (False, True)},
    ("whole", False): np.int64, ("whole", True): np.float64,
    **{(kind, blank): str for kind in _TEXTS for blank in (False, True)},
}  # fmt: skip


def _extra(cells: Sequence[str], column: Column, rows: Rows) -> NDArray[Any]:
    values = _floats(cells)
    words = np.array([cell.strip().lower() not in ("", "nan") for cell in cells], bool)
    unreadable = words & np.isnan(values)
    return np.array(cells, dtype=object) if np.any(unreadable) else values


def _floats(cells: Sequence[str]) -> Array:
    """Return (cells,) numbers, NaN for a cell that is no number; every digit is kept."""
    return np.array([_float(cell) for cell in cells], float)


def _float(cell: str) -> float:
    try:
        return float(cell) if "_" not in cell else np.nan
    except ValueError:
        return np.nan
