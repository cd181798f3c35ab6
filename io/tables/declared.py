"""All tables that are declared: docs/files.md and the fuzz targets are made from them."""

from __future__ import annotations

from telerig.io.tables import calibration, run, smoothing
from telerig.io.tables.table import Table

TABLES: tuple[Table, ...] = tuple(
    table
    for module in (calibration, run, smoothing)
    for table in vars(module).values()
    if isinstance(table, Table)
)
"""In the order in which their modules declare them."""
