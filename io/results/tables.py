"""Tables of a results folder, read fast where they are sound."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from telerig.io.files.csv_table import Column, read_table


def optional_columns(file: Path, columns: Sequence[Column]) -> pd.DataFrame:
    """As `read_columns`; an empty table where there is no file."""
    if file.is_file():
        return read_columns(file, columns)
    always = [c.name for c in columns if c.required or c.kind == "text"]
    return _typed(pd.DataFrame({name: [] for name in always}), columns)


def read_columns(file: Path, columns: Sequence[Column]) -> pd.DataFrame:
    """The known columns; fast where the file is sound, else with `read_table`'s exact errors.

    A header without rows is legal: a run may have no tracks.
    """
    table = _quick(file, columns)
    if table is None:
        table = read_table(file, columns, extra=True).reset_index(drop=True)
    for column in columns:
        if column.name not in table and column.kind == "text":
            table[column.name] = ""
    return _typed(table[[c.name for c in columns if c.name in table]], columns)


def _quick(file: Path, columns: Sequence[Column]) -> pd.DataFrame | None:
    """None for anything unusual."""
    try:
        content = file.read_bytes()
        header = content.split(b"\n", 1)[0].decode("utf-8-sig").strip().split(",")
    except (OSError, UnicodeDecodeError):
        return None
    rows = content.count(b"\n") + (not content.endswith(b"\n"))
    ragged = b'"' not in content and content.count(b",") != rows * (len(header) - 1)
    here = {column.name: column for column in columns if column.name in header}
    if ragged or len(set(header)) < len(header) or any(c.required and c.name not in here
                                                       for c in columns):  # fmt: skip
        return None
    texts = [name for name, column in here.items() if column.kind == "text"]
    blanks = {name: [""] for name in here if name not in texts}
    try:
        table = pd.read_csv(
            io.BytesIO(content), usecols=list(here), dtype=dict.fromkeys(texts, str),
            keep_default_na=False, na_values=blanks, encoding="utf-8-sig",
        )  # fmt: skip
    except (ValueError, pd.errors.ParserError):
        return None
    return table if all(_sound(table[name], column) for name, column in here.items()) else None


def _sound(values: pd.Series[Any], column: Column) -> bool:
    if len(values) == 0:
        return True
    if column.kind == "text":
        return column.blank or bool((values.str.strip() != "").all())
    if values.dtype.kind not in "if":
        return False
    numbers = values.to_numpy(float)
    whole = column.kind != "whole" or bool(np.all((numbers % 1 == 0) | np.isnan(numbers)))
    return whole and not np.isinf(numbers).any() and (column.blank or not np.isnan(numbers).any())


def _typed(table: pd.DataFrame, columns: Sequence[Column]) -> pd.DataFrame:
    """Columns of the right kind also where there are no rows."""
    kinds = {"text": "object", "number": "float64", "whole": "int64"}
    wanted = {
        c.name: "float64" if c.blank and c.kind == "whole" else kinds[c.kind] for c in columns
    }
    return table.astype({name: kind for name, kind in wanted.items() if name in table})
