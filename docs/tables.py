"""Write the columns of all tables into docs/files.md from their declarations: docs/tables.py

``--check`` writes nothing, and ends with 1 if the page is not up to date.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from telerig.io.tables.declared import TABLES
from telerig.io.tables.table import CAMERA, Table

PAGE = Path(__file__).parent / "files.md"
BEGIN, END = "<!-- made by docs/tables.py -->\n", "<!-- end of tables -->\n"


def markdown(table: Table) -> str:
    """Return one table's columns as Markdown: those of one meaning stand in one row.

    If a table ends in all columns of another one, it links to that.
    """
    lines = [f"### {table.file}\n", f"One row: {table.row}.\n"]
    lines += ["| column | unit | what |", "|---|---|---|"]
    others = [t for t in TABLES if t is not table and table.columns[-len(t.columns) :] == t.columns]
    own = table.columns[: -len(others[0].columns)] if others else table.columns
    for names, unit, what in replace(table, columns=own).rows_of_words():
        shown = ", ".join(f"`{name.replace(CAMERA, '<camera>')}`" for name in names)
        lines.append(f"| {shown} | {unit} | {what.replace('|', '&#124;')} |")
    for other in others[:1]:
        lines.append(f"\nThen the columns of [{other.file}](#{other.file.replace('.', '')}).")
    return "\n".join(lines) + "\n"


def page() -> str:
    """Return docs/files.md as it should be."""
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    after = rest.partition(END)[2]
    return before + BEGIN + "\n" + "\n".join(map(markdown, TABLES)) + "\n" + END + after


if __name__ == "__main__":
    if "--check" in sys.argv:
        sys.exit(page() != PAGE.read_text(encoding="utf-8"))
    PAGE.write_text(page(), encoding="utf-8")
