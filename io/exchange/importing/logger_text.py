"""Read the text files that loggers write: lines about the logger, a header, columns of numbers.

The layout is found from the rows themselves: the separator and the number of columns are those of
most rows, the table begins with the first row that is like them, and the header is above it.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.io.exchange.importing.headers import TIME_UNITS, is_unit, known_unit
from telerig.io.exchange.importing.recording import Recording
from telerig.io.exchange.importing.stamps import is_stamp
from telerig.io.files.csv_table import MOST_COLUMNS
from telerig.io.files.text import read_bytes

_SEPARATORS = (";", "\t", ",", " ")
"""The last one stands for any number of spaces."""
_COMMENTS = ("#", "%", "//", "*", ";")
_LONGEST_LINE = 100 * MOST_COLUMNS
_SAMPLED_ROWS = 60
_HEADER_WITHIN = 4
"""Lines with words above the table among which the header must be: units and rules are others."""
_HEADER_LABELS = {"header", "headers", "columns", "fields"}
_EXPORT = "export the recording as text with one row per sample below a header"
_END_OF_HEADER = "***End_of_Header***"
"""A line of LabVIEW's below the header of the file and below that of each segment."""
_RATE = re.compile(
    r"(?:(?<!over)(?<!over[ _-])sampl\w{0,12}?[ _-]*(?:rate|freq[^\W_]*)|data[ _-]?rate|"
    r"update[ _-]?rate|scan[ _-]?rate|acquisition[ _-]?rate|abtast\w{0,12}?(?:rate|frequenz)|\bodr|"
    r"(?P<explicit>\bfs|(?:sampled|sampling|recorded|logged|acquired|measured) at|"
    r"date format \S+ at))(?![^\W_])",
    re.IGNORECASE,
)
"""Words before a sampling rate; after some, such as "fs", which is also a full scale, the unit must
be explicit."""
_INTERVAL = re.compile(
    r"(?:sampl\w{0,12}?[ _-]*(?:interval|period)|delta[ _-]?[xt]|time[ _-]?step)(?![^\W_])",
    re.IGNORECASE,
)
_VALUE = re.compile(
    r"(?P<before>[^\d\n,;-]{0,30}[\s,;:=\"']*)"
    r"(?:(?P<doubtful>[1-9]\d{0,2}(?:[ ,'\u00a0\u202f]\d{3})+(?!\d))|"
    r"(?P<number>\d+(?:[.,]\d+)?(?:e[+-]?\d+)?)(?![\d/:%-]|[.,]\d))"
    r"(?P<gap>[\s,;\"'(\[]*)(?P<unit>(?:samples? per )?[^\W\d][^\s,;\"')\]]*)?",
    re.IGNORECASE,
)
_RATE_UNIT = re.compile(
    r"([kKM]?)(?i:hz|hertz|sps|s(?:a|mp|amples?)?/s(?:ec|econd)?|samples? per s(?:ec|econd)?)"
)
_SAME_RATE = 1e-6
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")
_SMALL_WHOLE = re.compile(r"[+-]?\d{1,3}")


@dataclass(frozen=True)
class _Shape:
    """Hold separator and number of cells of most rows, and which columns are numbers or stamps."""

    separator: str
    columns: int
    measured: tuple[bool, ...]

    def is_row(self, line: str) -> bool:
        """Return whether a line is a row of the table: every measured cell is blank or is one."""
        cells = self.cells(line)
        if len(cells) != self.columns:
            return False
        kinds = [not cell or _measured(cell) for cell in cells]
        return any(cells) and all(k for k, m in zip(kinds, self.measured) if m)

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line without blank ones beyond the last column."""
        cells = _split(line, self.separator)
        while len(cells) > self.columns and not cells[-1]:
            cells.pop()
        return cells


def read_logger_text(path: Path) -> Recording:
    """Read a logger's text file (UTF-8, UTF-16 or Latin-1).

    Cells are separated by commas, semicolons, tabs or spaces; numbers may have decimal commas, in
    quotes where commas separate. A line of units below the header, and a sampling rate above it,
    are used. Without a header the channels are named by their numbers from 0.
    Raises InputError for a file without rows of numbers, for a row with another number of cells
    than most, and for commas that may separate thousands.
    """
    text = _text(path)
    lines = text.split("\n")
    shape = _shape(lines, path)
    ends = [i + 1 for i, line in enumerate(lines) if _END_OF_HEADER in line]
    begin = ends[:2][-1] if ends else 0
    first = next((i for i in range(begin, len(lines)) if shape.is_row(lines[i])), len(lines))
    rows, numbers, notes = _rows(lines, first, shape, path)
    names, units = _header(lines[:first], shape)
    channels, decimals, commas = {}, set(), {}
    for i, name in enumerate(names):
        cells = [row[i] for row in rows]
        channel, decimal = _column(cells)
        decimals |= decimal
        if "," in decimal:
            commas[name or f"column {i}"] = cells
        if name or any(cells):
            channels[name or f"column {i}"] = channel
    _check_thousands(commas, numbers, path)
    if len(decimals) > 1:
        raise InputError(
            "has numbers with decimal commas and numbers with decimal points",
            where=str(path),
            todo="export it with one of them",
        )
    rate, said = _stated_rate(lines[:first])
    return Recording(
        str(path), channels, {n: u for n, u in zip(names, units) if u}, rate,
        lines=np.array(numbers), notes=(*notes, *said),
    )  # fmt: skip


def _text(path: Path) -> str:
    """Return the text of a file, in which lines end with a line feed."""
    content = read_bytes(path)
    begin = content[:_LONGEST_LINE]
    if len(begin) == _LONGEST_LINE and not {10, 13} & set(begin):
        raise InputError(
            f"begins with a line of more than {_LONGEST_LINE} characters; {MOST_COLUMNS} columns "
            "are read at most",
            where=str(path),
            todo=_EXPORT,
        )
    marks = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16-le",
             codecs.BOM_UTF16_BE: "utf-16-be"}  # fmt: skip
    mark = next((m for m in marks if content.startswith(m)), b"")
    head = content[:200]
    encodings = [marks[mark]] if mark else ["utf-8", "latin-1"]
    if not mark and len(head) > 8 and min(head[::2].count(0), head[1::2].count(0)) == 0:
        zeros = (head[::2].count(0), head[1::2].count(0))
        if max(zeros) > len(head) / 4:
            encodings = ["utf-16-be" if zeros[0] else "utf-16-le"]
    for encoding in encodings:
        try:
            text = content[len(mark) :].decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text.replace("\r\n", "\n").replace("\r", "\n")
    raise InputError("is not text", where=str(path), todo=_EXPORT)


def _shape(lines: Sequence[str], path: Path) -> _Shape:
    """Find separator, number of columns and their kinds from rows of the second half."""
    filled = [line for line in lines if line.strip(" \t,;") and not _is_comment(line)]
    half = filled[len(filled) // 2 :] if len(filled) > 4 else filled
    some = half[:: max(1, len(half) // _SAMPLED_ROWS)]
    best, most = None, 0
    for separator in _SEPARATORS:
        split = [_split(line, separator) for line in some]
        if not split:
            break
        columns = Counter(map(len, split)).most_common(1)[0][0]
        rows = [cells for cells in split if len(cells) == columns]
        kinds = [[_measured(cell) for cell in cells] for cells in rows]
        count = sum(map(sum, kinds))
        if count > most:
            blank = np.array([[not cell for cell in cells] for cells in rows])
            share = np.array(kinds).sum(0) / np.maximum(1, (~blank).sum(0))
            best, most = _Shape(separator, columns, tuple((share >= 0.5).tolist())), count
    if best is None or not (any(best.measured) and any(map(best.is_row, lines))):
        raise InputError("has no rows of numbers below a header", where=str(path), todo=_EXPORT)
    if best.columns > MOST_COLUMNS:
        what = f"has {best.columns} columns; {MOST_COLUMNS} are read at most"
        raise InputError(what, where=str(path), todo=_EXPORT)
    return best


def _rows(
    lines: Sequence[str], first: int, shape: _Shape, path: Path
) -> tuple[list[list[str]], list[int], list[str]]:
    """Return the cells of the table's rows, the line of each from 1, and notes."""
    rows, numbers, notes = [], [], []
    last = len(lines) - 1
    for i, line in enumerate(lines[first:], first):
        if not line.strip():
            continue
        cells = shape.cells(line)
        if len(cells) == shape.columns:
            rows.append(cells)
            numbers.append(i + 1)
        elif _is_comment(line):
            continue
        elif i == last and len(cells) <= shape.columns and rows:
            notes.append(f"row {i + 1} is left out: the file ends in the middle of it")
        else:
            raise InputError(
                f"{line[:60]!r} has {len(cells)} cells, most rows have {shape.columns}",
                where=f"{path} row {i + 1}",
                todo="correct or remove the row",
            )
    while rows and not any(rows[-1]):
        rows.pop()
        numbers.pop()
    return rows, numbers, notes


def _header(above: Sequence[str], shape: _Shape) -> tuple[list[str], list[str]]:
    """Return the names and the units of the columns from the lines above the table."""
    units = [""] * shape.columns
    filled = [line for line in reversed(above) if re.search(r"\w|\([^)]*\)|\[[^\]]*\]", line)]
    for line in filled[:_HEADER_WITHIN]:
        cells = _header_cells(line, shape)
        if cells is None:
            continue
        if not any(units) and all(map(is_unit, cells)) and any(map(known_unit, cells)):
            units = [cell.strip("[]() ") if not known_unit(cell) else known_unit(cell)
                     for cell in cells]  # fmt: skip
        elif not all(not cell or _measured(cell) for cell in cells):
            return _distinct(cells), units
    return [str(i) for i in range(shape.columns)], units


def _header_cells(line: str, shape: _Shape) -> list[str] | None:
    """Return as many cells as the table has columns; None for a line that has not so many."""
    text = re.sub(r"^\s*(?://|[#%*;])+ ?(?=\S|\t)", "", line)
    for separator in dict.fromkeys((shape.separator, *_SEPARATORS)):
        cells = _split(text, separator)
        if len(cells) == shape.columns + 1 and cells[0].lower().rstrip(":") in _HEADER_LABELS:
            cells = cells[1:]
        blank_last = separator == shape.separator != " " and not shape.measured[-1]
        if len(cells) == shape.columns - 1 > 1 and blank_last:
            return [*cells, ""]
        longer = len(cells) > shape.columns and separator == shape.separator != " "
        if len(cells) == shape.columns or (longer and shape.columns > 1):
            return cells[: shape.columns]
    for pattern in (r"\s{2,}", r"\s+(?![\[(])"):
        cells = re.split(pattern, text.strip())
        if len(cells) == shape.columns:
            return cells
    return None


def _distinct(names: Sequence[str]) -> list[str]:
    """Return the names; those that stand twice get the numbers of their columns."""
    twice = {name for name, count in Counter(names).items() if count > 1 and name}
    return [f"{name} (column {i})" if name in twice else name for i, name in enumerate(names)]


def _column(cells: Sequence[str]) -> tuple[NDArray[Any], set[str]]:
    """Return a column as numbers, or as text, and which decimal marks its numbers have."""
    try:
        if any("_" in cell for cell in cells):
            raise ValueError
        values = np.array([cell.replace(",", ".") or "nan" for cell in cells], float)
    except ValueError:
        return np.array(cells, object), set()
    return values, {mark for mark in ".," if any(mark in cell for cell in cells)}


def _check_thousands(
    columns: Mapping[str, Sequence[str]], numbers: Sequence[int], path: Path
) -> None:
    """Raise InputError for a column in which a comma may separate thousands, as in "1,002".

    The comma is decimal where others in the column cannot separate thousands. Where none can be
    told, it is decimal if commas of other columns are, and no number up to 999 stands beside it.

    columns : cells of the columns of numbers with commas. numbers : the row of each cell.
    """
    decimal = {
        name: any("," in cell and not _THOUSANDS.fullmatch(cell) for cell in cells)
        for name, cells in columns.items()
    }
    for name, cells in columns.items():
        if decimal[name] or (any(decimal.values()) and not any(map(_SMALL_WHOLE.fullmatch, cells))):
            continue
        i, cell = next((i, cell) for i, cell in enumerate(cells) if "," in cell)
        raise InputError(
            f"the column {name!r} does not tell whether {cell!r} is {cell.replace(',', '')} or "
            f"{cell.replace(',', '.')}",
            where=f"{path} row {numbers[i]}",
            todo="export the numbers with decimal points and without separators of thousands",
        )


def _stated_rate(above: Sequence[str]) -> tuple[float | None, list[str]]:
    """Return the sampling rate in Hz that the lines above the table state, and a note about it."""
    found: dict[float, int] = {}
    for i, line in enumerate(above, 1):
        for match in _RATE.finditer(line):
            rate = _quantity(line[match.end() :], _rate_unit, match["explicit"] is not None)
            found.setdefault(rate, i)
        for match in _INTERVAL.finditer(line):
            step = _quantity(line[match.end() :], _time_unit)
            found.setdefault(1 / step if step > 0 else 0.0, i)
    rates = {rate: i for rate, i in found.items() if 0 < rate < np.inf}
    if not rates or max(rates) > (1 + _SAME_RATE) * min(rates):
        return None, []
    rate, number = next(iter(rates.items()))
    return rate, [f"line {number} states a sampling rate of {rate:g} Hz"]


def _quantity(text: str, unit: Callable[[str], float], explicit: bool = False) -> float:
    """Return the value, in Hz or s, that a text begins with, or 0 if it can be doubted.

    unit : returns the size of a unit, and 0 for another word. A word behind the number must be a
        unit, and 1,600 and 10 240 may be thousands. Without a unit the value is in Hz or s, unless
        the unit must be ``explicit``.
    """
    match = _VALUE.match(text)
    if match is None or match["doubtful"]:
        return 0.0
    stated = [unit(word) for word in re.findall(r"[^\W\d_]+(?:/[^\W\d_]+)?", match["before"])]
    behind = unit((match["unit"] or "").rstrip(".:"))
    other_word = bool(match["unit"]) and not behind and not re.search('[,;\t"]', match["gap"])
    size = behind or next(filter(None, stated), 0.0)
    if not size and (explicit or other_word):
        return 0.0
    return float(match["number"].replace(",", ".")) * (size or 1.0)


def _rate_unit(word: str) -> float:
    match = _RATE_UNIT.fullmatch(word)
    return {"": 1.0, "k": 1e3, "K": 1e3, "M": 1e6}[match[1]] if match else 0.0


def _time_unit(word: str) -> float:
    return TIME_UNITS.get(known_unit(word), 0.0)


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS)


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    if '"' not in line:
        return [cell.strip() for cell in line.split(separator)]
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error:
        return []


def _measured(cell: str) -> bool:
    """Return whether a cell is a number or a stamp of a clock."""
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return is_stamp(cell)
    return "_" not in cell
