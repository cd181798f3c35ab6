"""Declarations of tables: the page about files, the tables that commands write, ids of bubbles."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from places import ROOT

from telerig.errors import InputError
from telerig.io.files.csv_table import Column, read_table
from telerig.io.tables import calibration, run, smoothing
from telerig.io.tables.declared import TABLES
from telerig.io.tables.table import Table

CAMERAS = ("left", "right")
WRITTEN = [
    ("calibration/dots.csv", calibration.DOTS),
    ("results/calibration/dots.csv", calibration.DOTS),
    ("results/calibration/residuals.csv", calibration.RESIDUALS),
    ("runs/rise/stage.csv", run.STAGE),
    ("runs/rise/detections.csv", run.DETECTIONS),
    ("results/rise/detections.csv", run.DETECTIONS),
    ("results/rise/tracks.csv", run.TRACKS),
    ("results/rise/events.csv", run.EVENTS),
    ("results/rise/trajectories.csv", smoothing.TRAJECTORIES),
    ("results/rise/shake.csv", smoothing.SHAKE),
    ("results/rise/bubbles.csv", smoothing.BUBBLES),
    ("results/rise/bubble_summary.csv", smoothing.SUMMARY),
]


def test_the_page_about_files_is_up_to_date() -> None:
    script = ROOT / "docs/tables.py"
    assert subprocess.run([sys.executable, str(script), "--check"], check=False).returncode == 0


@pytest.mark.parametrize(("file", "table"), WRITTEN, ids=[file for file, _ in WRITTEN])
def test_every_column_that_is_written_is_declared(tank: Path, file: str, table: Table) -> None:
    header = (tank / file).read_text(encoding="utf-8").partition("\n")[0].split(",")
    required = {column.name for column in table.of(CAMERAS) if column.required}
    given = "runs/" in file or file.startswith("calibration/")
    assert set(header) <= set(table.names(CAMERAS))
    assert given or required <= set(header)
    assert all(one.what and (one.unit or "_" not in one.name[2:]) for one in table.columns
               if one.name.endswith(("_mm", "_px", "_s", "_mm2", "_px2")))  # fmt: skip


@pytest.mark.parametrize(
    ("cells", "kind", "values"),
    [
        (["3", "0", "-2"], np.int64, [3, 0, -2]),
        (["3.0", "", "12."], np.float64, [3.0, np.nan, 12.0]),
        (["", "", ""], np.float64, [np.nan] * 3),
        (["3", "007", ""], object, ["3", "007", ""]),
        (["3", "3.5", "1e3"], object, ["3", "3.5", "1e3"]),
    ],
)
@pytest.mark.parametrize("quoted", [False, True], ids=["fast", "as text"])
def test_ids_are_numbers_where_all_are_whole(
    tmp_path: Path, cells: list[str], kind: type, values: list[object], quoted: bool
) -> None:
    """A quoted cell is left to the slow reader, which has to understand the same."""
    file = tmp_path / "ids.csv"
    rows = [f'"{cell}",1' if quoted else f"{cell},1" for cell in cells]
    file.write_text("\n".join(["particle,x", *rows, ""]))
    found = read_table(file, [Column("particle", "id", blank=True), Column("x")])["particle"]
    assert found.dtype == kind or (kind is object and pd.api.types.is_string_dtype(found.dtype))
    np.testing.assert_array_equal(found.to_numpy(), np.array(values, kind))


def test_a_column_of_any_camera_has_its_unit() -> None:
    for name, unit in (("side_u_px", "px"), ("a b_suv_px2", "px2"), ("vx_mm_s", "mm s-1")):
        table = run.TRACKS if "px" in name else smoothing.TRAJECTORIES
        found = table.column(name)
        assert found is not None and found.unit == unit
    assert run.TRACKS.column("temperature_k") is None


@pytest.mark.parametrize("table", TABLES, ids=[table.file for table in TABLES])
def test_a_negative_standard_deviation_is_refused(tmp_path: Path, table: Table) -> None:
    file, columns = tmp_path / "table.csv", table.of(CAMERAS)
    names = [one.name for one in columns]
    cells = {one.name: "0" if one.kind in ("number", "sd", "whole") else "a" for one in columns}
    for one in columns:
        if "standard deviation" in one.what or one.what.startswith("part of s"):
            row = ",".join((cells | {one.name: "-0.5"}).values())
            file.write_text(",".join(names) + f"\n{','.join(cells.values())}\n{row}\n")
            with pytest.raises(InputError, match=rf"{file} row 3, column {one.name}.*negative"):
                table.read(file, CAMERAS)
