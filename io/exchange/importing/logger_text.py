"""Read a logger's text file: a header that is known or given, and rows of numbers below it."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from telerig.errors import InputError
from telerig.io.exchange.importing.headers import known_columns
from telerig.io.exchange.importing.recording import EXPORT_AGAIN, Recording
from telerig.io.files.csv_table import MOST_COLUMNS
from telerig.io.files.text import read_bytes

_SEPARATORS = ("\t", ";", ",", " ")
"""The last one stands for any number of spaces."""
_COMMENTS = ("#", "%", "//", "*", ";")
_LONGEST_LINE = 100 * MOST_COLUMNS
_HEADER_WITHIN = 200
"""Lines from the top of a file."""
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
_SMALL_WHOLE = re.compile(r"[+-]?\d{1,3}")


def read_logger_text(path: Path, columns: Sequence[str | int] | None = None) -> Recording:
    """Read a logger's text file (UTF-8, UTF-16 with its mark, or Latin-1).

    Cells are separated by tabs, semicolons, commas or spaces. The header is the first line with
    the known names of x, y and z (`known_columns`), or with the names in ``columns``; numbers in
    ``columns`` need no header. Rows begin below it with the first line that has a number, and
    lines that begin with #, %, //, * or ; are left out. Columns without a name have the names
    ``column 0`` and so on. Commas that do not separate cells are decimal.
    Raises InputError for a file without such a header or without rows, for a row with another
    number of cells than the first, and for commas that may separate thousands.
    """
    lines = _text(path).split("\n")
    separator, header, names = _header(lines[:_HEADER_WITHIN], columns, path)
    rows: list[list[str]] = []
    numbers: list[int] = []
    notes: list[str] = []
    for number, cells in _cells(lines, header, separator):
        if not rows and not any(map(is_number, cells)):
            continue
        while rows and len(cells) > len(rows[0]) and not cells[-1]:
            cells.pop()
        if rows and len(cells) != len(rows[0]):
            if number == len(lines):
                notes.append(f"row {number} is left out, because it ends early")
                break
            what = f"has {len(cells)} cells, the rows above have {len(rows[0])}"
            raise InputError(what, where=f"{path} row {number}", todo="correct or remove the row")
        rows.append(cells)
        numbers.append(number)
    if not rows:
        raise InputError(
            "has no rows of numbers below a header", where=str(path), todo=EXPORT_AGAIN
        )
    surplus = rows[0][len(names) :]
    if names and (len(names) > len(rows[0]) or any(surplus)):
        raise InputError(
            f"has {len(names)} names in the header, and {len(rows[0])} cells in the rows below",
            where=f"{path} row {header}",
            todo="name times, x, y and z by their numbers from 0: --columns 0,1,2,3",
        )
    names = [*names, *[""] * (len(rows[0]) - len(names))]
    twice = {name for name, count in Counter(names).items() if count > 1}
    names = [
        f"{name} (column {i})".strip() if name in twice and name else name or f"column {i}"
        for i, name in enumerate(names)
    ]
    columns_of = dict(zip(names, zip(*rows)))
    for name, column in columns_of.items():
        _check_thousands(name, column, numbers, path)
    channels = {name: np.array(column, object) for name, column in columns_of.items()}
    return Recording(str(path), channels, lines=np.array(numbers), notes=tuple(notes))


def _header(
    lines: Sequence[str], columns: Sequence[str | int] | None, path: Path
) -> tuple[str, int, list[str]]:
    """Return the separator, the number of lines down to the header, and the names in it."""
    wanted = [one for one in columns or () if isinstance(one, str)]
    least = max((one + 1 for one in columns or () if isinstance(one, int)), default=0)
    for separator in _SEPARATORS:
        for i, line in enumerate(lines):
            bare = re.sub(r"^(?:#|%|//)\s*", "", line)
            if separator == " ":
                bare = re.sub(r"\s+(?=[\[(])", "", bare)
            names = next(_cells([bare], 0, separator, comments=()), (0, []))[1]
            if len(names) > MOST_COLUMNS:
                what = f"has {len(names)} columns; {MOST_COLUMNS} are read at most"
                raise InputError(what, where=str(path), todo=EXPORT_AGAIN)
            if columns is None:
                found = known_columns(names, {})[1] is not None
            else:
                found = set(wanted) <= set(names) and len(names) >= least
                if found and not wanted:
                    stated = [names[one] for one in columns if isinstance(one, int)]
                    found = all(map(is_number, stated[-3:])) and not stated[0][:1].isalpha()
            if found:
                header = i if columns is not None and not wanted else i + 1
                return separator, header, names if header > i else []
    alike = [line for line in lines if wanted and all(name in line for name in wanted)]
    raise InputError(
        "does not say in a header of known names which columns are x, y and z"
        if columns is None
        else f"has no line with the columns {', '.join(map(str, columns))}",
        where=str(path),
        todo="name time, x, y and z with --columns Time,ch1,ch2,ch3, or by their numbers from 0: "
        "--columns 0,1,2,3"
        + (f". Give whole names, as they stand in the header: {alike[0].strip()}" if alike else ""),
    )


def _cells(
    lines: Sequence[str], first: int, separator: str, comments: tuple[str, ...] = _COMMENTS
) -> Iterator[tuple[int, list[str]]]:
    """Yield the number from 1 and the cells of each line that is neither blank nor a comment."""
    comments = tuple(mark for mark in comments if mark != separator)
    for number, line in enumerate(lines[first:], first + 1):
        if not line.strip(" \t,;") or line.lstrip().startswith(comments):
            continue
        if separator == " ":
            yield number, line.split()
        elif '"' not in line:
            yield number, [cell.strip() for cell in line.split(separator)]
        else:
            try:
                yield number, [c.strip() for c in next(csv.reader([line], delimiter=separator))]
            except csv.Error:
                continue


def is_number(cell: str) -> bool:
    """Return whether a cell is a number, with a decimal point or comma."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return "_" not in cell


def _text(path: Path) -> str:
    """Return the text of a file, in which lines end with a line feed."""
    content = read_bytes(path)
    begin = content[:_LONGEST_LINE]
    if len(begin) == _LONGEST_LINE and not {10, 13} & set(begin):
        raise InputError(
            f"begins with a line of more than {_LONGEST_LINE} characters; {MOST_COLUMNS} columns "
            "are read at most",
            where=str(path),
            todo=EXPORT_AGAIN,
        )
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    for encoding in ("utf-16",) if wide else ("utf-8-sig", "latin-1"):
        try:
            text = content.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text.replace("\r\n", "\n").replace("\r", "\n")
    raise InputError("is not text", where=str(path), todo=EXPORT_AGAIN)


def _check_thousands(name: str, cells: Sequence[str], numbers: Sequence[int], path: Path) -> None:
    """Raise InputError for a column of numbers in which a comma may separate thousands, as in
    "1,002" below "999"."""
    commas = [i for i, cell in enumerate(cells) if "," in cell]
    doubtful = commas and all(_THOUSANDS.fullmatch(cells[i]) for i in commas)
    if doubtful and any(map(_SMALL_WHOLE.fullmatch, cells)):
        cell = cells[commas[0]]
        raise InputError(
            f"the column {name!r} does not tell whether {cell!r} is {cell.replace(',', '')} or "
            f"{cell.replace(',', '.')}",
            where=f"{path} row {numbers[commas[0]]}",
            todo="export the numbers with decimal points and without separators of thousands",
        )
