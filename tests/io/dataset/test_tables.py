"""Tables: strict reading with the place of each fault, exact writing, the dots table."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from telerig.errors import InputError
from telerig.io.dataset.tables import read_dots_csv
from telerig.io.files.csv_table import Column, read_table, write_table
from telerig.io.rig_file.description import CameraDescription, RigDescription
from telerig.rig.target import Target

CAMERAS = {
    "left": CameraDescription("left", (640, 480), 10.0),
    "right": CameraDescription("right", (512, 512), 10.0),
}
GRID = Target(rows=3, columns=5, pitch_mm=(7.0, 7.0))
BOUNDED = RigDescription("r", CAMERAS, GRID)
UNBOUNDED = RigDescription("r", CAMERAS, Target(rows=3, columns=5, extent="unbounded"))
MISSING = RigDescription(
    "r", CAMERAS, Target(rows=3, columns=5, marks=((0, 1),), mark_style="missing")
)

DOTS = "view,camera,dot,u_px,v_px\n007,left,0,1.5,2.25\n007,right,14,511.5,-0.5\n8,left,7,3,4\n"


def dots_of(text: str, tmp_path: Path, rig: RigDescription = BOUNDED) -> pd.DataFrame:
    file = tmp_path / "dots.csv"
    file.write_bytes(text.encode())
    return read_dots_csv(file, rig)


def error_of(text: str, tmp_path: Path, rig: RigDescription = BOUNDED) -> str:
    with pytest.raises(InputError) as caught:
        dots_of(text, tmp_path, rig)
    message = str(caught.value)
    assert message.startswith(str(tmp_path / "dots.csv")), "says which file"
    assert "\n  -> " in message, "says what to do"
    return message


def test_dots_are_read_in_the_order_of_the_file(tmp_path: Path) -> None:
    dots = dots_of(DOTS, tmp_path)
    assert list(dots.columns) == [
        "view", "camera", "dot", "row", "column", "u_px", "v_px", "suu_px2", "suv_px2", "svv_px2",
    ]  # fmt: skip
    assert dots["view"].tolist() == ["007", "007", "8"], "names stay text"
    assert dots["camera"].tolist() == ["left", "right", "left"]
    assert dots["dot"].tolist() == [0, 14, 7] and dots["dot"].dtype == np.int64
    assert dots["row"].tolist() == [0, 2, 1]
    assert dots["column"].tolist() == [0, 4, 2]
    assert dots["u_px"].tolist() == [1.5, 511.5, 3.0]
    assert dots["v_px"].tolist() == [2.25, -0.5, 4.0]
    assert dots.index.tolist() == [0, 1, 2]


def test_the_noise_of_the_centres(tmp_path: Path) -> None:
    silent = dots_of(DOTS, tmp_path)
    assert silent.attrs["sigma_known"] is False
    assert silent["suu_px2"].tolist() == silent["svv_px2"].tolist() == [0.02**2] * 3
    assert silent["suv_px2"].tolist() == [0.0] * 3
    head = "view,camera,dot,u_px,v_px"
    stated = dots_of(f"{head},sigma_px\na,left,0,1,2,0.5\n", tmp_path)
    assert stated.attrs["sigma_known"] is True
    assert stated["suu_px2"].tolist() == stated["svv_px2"].tolist() == [0.25]
    full = dots_of(f"{head},sigma_px,suu_px2,suv_px2,svv_px2\na,left,0,1,2,9,4,-1,2\n", tmp_path)
    assert full.attrs["sigma_known"] is True
    assert full.loc[0, ["suu_px2", "suv_px2", "svv_px2"]].tolist() == [4.0, -1.0, 2.0]


def test_on_an_unbounded_grid_row_and_column_name_the_dot(tmp_path: Path) -> None:
    text = (
        "view,camera,dot,u_px,v_px,row,column\n"
        "a,left,whatever,1,2,-2,3\na,left,,1,2,0,0\na,right,whatever,1,2,-2,3\n"
    )
    dots = dots_of(text, tmp_path, UNBOUNDED)
    assert dots["row"].tolist() == [-2, 0, -2] and dots["column"].tolist() == [3, 0, 3]
    assert (
        dots["dot"].tolist() == UNBOUNDED.target.id_from_row_column([-2, 0, -2], [3, 0, 3]).tolist()
    )
    rows, columns = UNBOUNDED.target.row_column_from_id(dots["dot"])
    assert rows.tolist() == [-2, 0, -2] and columns.tolist() == [3, 0, 3]


def test_unbounded_faults(tmp_path: Path) -> None:
    message = error_of(DOTS, tmp_path, UNBOUNDED)
    assert "row 1" in message and "missing columns: row, column" in message
    head = "view,camera,dot,u_px,v_px,row,column\n"
    message = error_of(head + "a,left,1,1,2,0,0\na,left,2,1,2,0,5000\n", tmp_path, UNBOUNDED)
    assert "row 3, column column: is too far from the origin mark" in message
    message = error_of(head + "a,left,1,1,2,0,1\na,left,2,1,2,0,1\n", tmp_path, UNBOUNDED)
    assert "row 3" in message and "the dot at row 0, column 1" in message
    assert "is in row 2 already" in message


ROW = "8,left,7,3,4\n"
FAULTS = [
    # the last row is replaced by, then where, what and what to do
    (ROW + "8,left,3,abc,4\n", "row 5, column u_px", "is 'abc', not a finite number", "correct"),
    (ROW + "8,left,3,nan,4\n", "row 5, column u_px", "is 'nan', not a finite number", "correct"),
    (ROW + "8,left,3,3,inf\n", "row 5, column v_px", "is 'inf', not a finite number", "correct"),
    (ROW + "8,left,3,1_0,4\n", "row 5, column u_px", "is '1_0', not a finite", "correct"),
    (ROW + "8,left,3,,4\n", "row 5, column u_px", "is blank", "no measurement"),
    (ROW + ",left,3,3,4\n", "row 5, column view", "is blank", "fill in"),
    ("8,left,7,3\n" + ROW, "row 4", "has 4 cells, the header has 5", "complete the row"),
    ("8,left,7,3,4,5\n", "row 4", "has 6 cells, the header has 5", "decimal comma"),
    ("8,left,15,3,4\n", "row 4, column dot", "is 15, which the target", "numbered from 0 to 14"),
    ("8,left,-1,3,4\n", "row 4, column dot", "is -1, which the target", "numbered from 0 to 14"),
    ("8,left,1.5,3,4\n", "row 4, column dot", "is '1.5', not a whole number", "correct"),
    ("8,lefft,7,3,4\n", "row 4, column camera", "no camera 'lefft'", "did you mean left?"),
    ("007,left,0,3,4\n", "row 4, column dot", "dot 0 of view '007', camera 'left' is in row 2",
     "keep one"),
    ("8,left,7,-3.6,4\n", "row 4, column u_px", "is -3.6, outside the image of 640 px", "size_px"),
    ("8,left,7,642.6,4\n", "row 4, column u_px", "is 642.6, outside the image of 640", "size_px"),
    ("8,left,7,4,482.6\n", "row 4, column v_px", "is 482.6, outside the image of 480", "size_px"),
    ("8,right,7,514.6,4\n", "row 4, column u_px", "outside the image of 512", "image_size"),
]  # fmt: skip


@pytest.mark.parametrize(("row", "where", "what", "todo"), FAULTS)
def test_a_fault_is_told_with_its_row_and_column(
    row: str, where: str, what: str, todo: str, tmp_path: Path
) -> None:
    message = error_of(DOTS.replace(ROW, row), tmp_path)
    assert f"{where}: " in message
    assert what in message
    assert todo in message.split("\n  -> ")[1]


def test_pixels_just_outside_the_image_are_legal(tmp_path: Path) -> None:
    row = "8,left,7,642.4,-3.4\n"
    assert dots_of(DOTS.replace(ROW, row), tmp_path)["u_px"].tolist()[-1] == 642.4


def test_rows_are_numbered_as_in_the_file(tmp_path: Path) -> None:
    text = DOTS.replace("\n", "\r\n").replace(ROW[:-1], "\r\n,,,,\r\n8,left,99,3,4")
    assert "row 6, column dot" in error_of(text, tmp_path)
    quoted = DOTS.replace("007,left,0", '"a, ""b""",left,0').replace(ROW, "8,left,99,3,4")
    assert "row 4, column dot" in error_of(quoted, tmp_path)
    views = dots_of(quoted.replace("99", "9"), tmp_path)["view"].tolist()
    assert views == ['a, "b"', "007", "8"]


def test_further_bad_rows_are_counted(tmp_path: Path) -> None:
    text = DOTS + "".join(f"9,left,{i},x,1\n" for i in range(8))
    assert "'x', not a finite number (and 7 more: row 6, 7, 8, 9, 10, ...)" in error_of(
        text, tmp_path
    )


HEADERS = [
    ("view,camera,dot,u_px,v_pix", "unknown column 'v_pix': did you mean v_px?", "view,camera,dot"),
    ("view,camera,dot,u_px,v_pix", "missing column: v_px", "view,camera,dot"),
    ("view,camera,dot,u_px,u_px", "the column 'u_px' stands twice", "remove one"),
    ("view;camera;dot;u_px;v_px", "separated by semicolons", "pd.read_csv(FILE, sep=';'"),
    ("view\tcamera\tdot\tu_px\tv_px", "separated by tabs", "comma-separated"),
]


@pytest.mark.parametrize(("header", "what", "todo"), HEADERS)
def test_faulty_headers(header: str, what: str, todo: str, tmp_path: Path) -> None:
    separator = next(mark for mark in ";\t," if mark in header)
    _, *rows = DOTS.split("\n")
    if separator == ";":
        rows = [row.replace(",", ";").replace(".", ",") for row in rows]
    text = "\n".join([header, *rows])
    message = error_of(text, tmp_path)
    assert "row 1" in message and what in message and todo in message


def test_empty_tables(tmp_path: Path) -> None:
    assert "is empty" in error_of("", tmp_path)
    assert "is empty" in error_of("\n\n", tmp_path)
    message = error_of(DOTS.split("\n")[0] + "\n\n", tmp_path)
    assert "no rows below its header" in message and "one row per measurement" in message


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_dots_csv(tmp_path / "none.csv", BOUNDED)
    (tmp_path / "dots.csv").write_bytes(DOTS.encode("utf-16"))
    with pytest.raises(InputError, match="not UTF-8") as caught:
        read_dots_csv(tmp_path / "dots.csv", BOUNDED)
    assert "export the table" in str(caught.value)


def test_row_and_column_must_agree_with_the_dot(tmp_path: Path) -> None:
    head = "view,camera,dot,u_px,v_px,row,column\n"
    good = dots_of(head + "a,left,7,1,2,1,2\n", tmp_path)
    assert (good.loc[0, "row"], good.loc[0, "column"]) == (1, 2)
    message = error_of(head + "a,left,7,1,2,1,2\na,left,8,1,2,1,2\n", tmp_path)
    assert "row 3, column column: is 2, but dot 8 lies in column 3" in message
    assert "dot = row * columns + column" in message
    assert "column row: is 2, but dot 7 lies in row 1" in error_of(
        head + "a,left,7,1,2,2,2\n", tmp_path
    )


def test_a_missing_mark_is_no_dot(tmp_path: Path) -> None:
    message = error_of(DOTS.replace("left,0", "left,1"), tmp_path, MISSING)
    assert "row 2, column dot: is 1" in message and "missing marks left out" in message


SIGMAS = [
    ("sigma_px", "0.0", "column sigma_px: is 0, not positive"),
    ("sigma_px", "-0.1", "column sigma_px: is '-0.1', but a standard deviation is not negative"),
    ("sigma_px", "", "column sigma_px: is blank"),
    ("suu_px2,suv_px2,svv_px2", "1,2,1", "is no covariance"),
    ("suu_px2,suv_px2,svv_px2", "0,0,1", "is no covariance"),
    ("suu_px2,svv_px2", "1,1", "without suv_px2"),
]


@pytest.mark.parametrize(("columns", "cells", "what"), SIGMAS)
def test_faulty_noise(columns: str, cells: str, what: str, tmp_path: Path) -> None:
    text = f"view,camera,dot,u_px,v_px,{columns}\na,left,0,1,2,{cells}\n"
    assert what in error_of(text, tmp_path)


def test_a_byte_order_mark_and_spaces_are_no_fault(tmp_path: Path) -> None:
    text = "\ufeffview , camera, dot, u_px, v_px\n a , left , 3 , 1.5 , 2\n"
    assert dots_of(text, tmp_path).loc[0, ["view", "camera", "dot"]].tolist() == ["a", "left", 3]


COLUMNS = [Column("frame", "whole"), Column("particle", "whole", required=False, blank=True),
           Column("u_px"), Column("name", "text", required=False, blank=True)]  # fmt: skip


def test_blank_cells_where_they_are_legal(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("frame,particle,u_px,name\n0,,1.5,\n1,4,2.5,x\n")
    table = read_table(tmp_path / "t.csv", COLUMNS)
    np.testing.assert_array_equal(table["particle"], [np.nan, 4.0])
    assert table["name"].tolist() == ["", "x"]
    assert table["frame"].dtype == np.int64
    assert table.index.tolist() == [2, 3], "rows of the file"


def test_extra_columns_are_kept_on_request(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("frame,u_px,area,note\n0,1,2.5,good\n1,1,,\n")
    with pytest.raises(InputError, match="unknown column 'area'"):
        read_table(tmp_path / "t.csv", COLUMNS)
    table = read_table(tmp_path / "t.csv", COLUMNS, extra=True)
    np.testing.assert_array_equal(table["area"], [2.5, np.nan])
    assert table["note"].tolist() == ["good", ""]


def test_floats_are_written_with_every_digit(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    values = np.concatenate([rng.normal(size=500) * 10.0 ** rng.integers(-300, 300, 500),
                             [0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -0.0]])  # fmt: skip
    table = pd.DataFrame({"x": values, "flag": values > 0, "name": 'ä,"b"'})
    write_table(table, tmp_path / "t.csv")
    with (tmp_path / "t.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["x"]) for row in rows] == values.tolist()
    assert {row["flag"] for row in rows} == {"0", "1"}
    assert {row["name"] for row in rows} == {'ä,"b"'}
    stated = [Column("flag", "whole"), Column("name", "text")]  # numbers of others are not bounded
    back = read_table(tmp_path / "t.csv", stated, extra=True)
    np.testing.assert_array_equal(back["x"].to_numpy(), values)
    assert back["name"].iloc[0] == 'ä,"b"'
