"""rig.toml: what is read, what is written, and what each fault is told as."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path

import numpy as np
import pytest

from telerig.errors import InputError
from telerig.io.rig_description import (
    AccelerometerDescription,
    CameraDescription,
    ReferencesDescription,
    RigDescription,
    StageDescription,
    WallDescription,
)
from telerig.io.rigfile import description_from_toml, read_rig_toml, write_rig_toml
from telerig.rig.target import Target

FULL = """
schema = 1
name = "tank 2"
[cameras.left]
image_size_px = [640, 512]
scale_px_per_mm = 10.0
telecentricity_per_mm = 0.0
[cameras.right]
image_size_px = [512, 512]
scale_px_per_mm = 11
[stereo]
right_from_left_rotvec_deg = [0.0, 90.0, 0.0]
[target]
layout = "grid"
rows = 3
columns = 5
pitch_mm = 7.0
dot_diameter_mm = 2.4
polarity = "white_on_black"
marks = [[1, 2], [1, 3], [0, 2]]
mark_style = "large"
mark_diameter_mm = 3.6
extent = "bounded"
print_sigma_mm = 0.03
scale_dots = [0, 14]
scale_distance_mm = 31.305
scale_sigma_mm = 0.001
[stage]
axis_left = [0.0, -2.0, 0.0]
position_sigma_mm = 0.005
[accelerometers.arm_left]
mounted_on = "left"
axes = [[1,0,0],[0,1,0],[0,0,3]]
noise_density_ug_sqrt_hz = 22.5
bias_sigma_m_s2 = 0.2
[references]
kind = "dots"
polarity = "black_on_white"
dot_diameter_mm = 1.0
[walls.left]
normal = [0.0, 0.3, -0.4]
indices = [1.0, 1.52, 1.333]
thickness_mm = 10.0
"""


def parse(text: str) -> RigDescription:
    return description_from_toml(text, where="rig.toml")


def changed(old: str, new: str) -> str:
    assert FULL.count(old) >= 1, old
    return FULL.replace(old, new, 1)


def error_of(text: str) -> str:
    with pytest.raises(InputError) as caught:
        parse(text)
    return str(caught.value)


def test_every_table_of_the_file_is_read() -> None:
    rig = parse(FULL)
    assert rig.name == "tank 2"
    assert (rig.first, rig.second) == ("left", "right")
    assert rig.cameras["left"] == CameraDescription("left", (640, 512), 10.0, 0.0)
    assert rig.cameras["right"] == CameraDescription("right", (512, 512), 11.0, None)
    assert rig.second_from_first_rotvec_deg == (0.0, 90.0, 0.0)
    assert rig.target == Target(
        rows=3,
        columns=5,
        pitch_mm=(7.0, 7.0),
        dot_diameter_mm=2.4,
        marks=((1, 2), (1, 3), (0, 2)),
        mark_diameter_mm=3.6,
        print_sigma_mm=0.03,
        flatness_sigma_mm=0.03,
        scale_dots=(0, 14),
        scale_distance_mm=31.305,
    )
    assert rig.references == ReferencesDescription("dots", "black_on_white", 1.0)


def test_directions_come_out_as_unit_vectors() -> None:
    rig = parse(FULL)
    assert rig.stage == StageDescription((0.0, -1.0, 0.0), (0.0, -1.0, 0.0), 0.005)
    axes = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    sensor = AccelerometerDescription("arm_left", "left", axes, 22.5, 0.2)
    assert rig.accelerometers == {"arm_left": sensor}
    assert rig.walls["left"].normal == pytest.approx((0.0, -0.6, 0.8))


def test_up_is_the_travel_axis_unless_given() -> None:
    text = changed("position_sigma", "up_left = [0.0, -3.0, 4.0]\nposition_sigma")
    stage = parse(text).stage
    assert stage is not None
    assert stage.up == pytest.approx((0.0, -0.6, 0.8))


def test_defaults_of_the_target() -> None:
    text = FULL[: FULL.index("[stereo]")] + (
        "[target]\nrows = 4\ncolumns = 6\npitch_mm = [2.0, 3.0]\ndot_diameter_mm = 1.0\n"
    )
    target = parse(text).target
    assert (target.print_sigma_mm, target.flatness_sigma_mm) == (0.02, 0.02)
    assert target.pitch_mm == (2.0, 3.0)
    assert target.scale_dots is None, "then the nominal pitch sets the scale"
    assert (target.polarity, target.mark_style, target.extent) == (
        "white_on_black", "large", "bounded",
    )  # fmt: skip


def test_one_camera_is_legal() -> None:
    start, rest = FULL.split("[cameras.right]")
    rig = parse(start + rest[rest.index("[target]") :])
    assert (rig.first, rig.second, rig.second_from_first_rotvec_deg) == ("left", None, None)


def test_cameras_by_name_or_index() -> None:
    rig = parse(FULL)
    assert [rig.camera_name(c) for c in (0, 1, "right")] == ["left", "right", "right"]
    for wrong in (2, -1, "rihgt"):
        with pytest.raises(InputError, match="no camera"):
            rig.camera_name(wrong)
    with pytest.raises(InputError, match="did you mean right"):
        rig.camera_name("rihgt")


UNBOUNDED = changed('extent = "bounded"', 'extent = "unbounded"')


def test_scale_dots_of_an_unbounded_grid_count_in_the_block_or_are_cells() -> None:
    by_number = parse(UNBOUNDED.replace("[0, 14]", "[1, 13]")).target
    by_cell = parse(UNBOUNDED.replace("[0, 14]", "[[0, 1], [2, 3]]")).target
    assert by_number.scale_dots == by_cell.scale_dots
    assert by_number.scale_dots is not None
    rows, columns = by_number.row_column_from_id(np.array(by_number.scale_dots))
    assert (rows.tolist(), columns.tolist()) == ([0, 2], [1, 3])
    beyond = parse(UNBOUNDED.replace("[0, 14]", "[[-2, -1], [7, 9]]")).target
    assert beyond.nominal_mm(np.array(beyond.scale_dots)).tolist() == [[-7, -14, 0], [63, 49, 0]]


def test_an_unbounded_grid_needs_no_rows_and_columns() -> None:
    text = UNBOUNDED.replace("rows = 3\ncolumns = 5\n", "")
    assert "scale_dots" in error_of(text)
    assert parse(text.replace("[0, 14]", "[[0, 0], [0, 4]]")).target.rows == 0


def test_scale_dots_of_a_bounded_grid_may_be_cells() -> None:
    assert parse(changed("[0, 14]", "[[0, 0], [2, 4]]")).target.scale_dots == (0, 14)


def test_points_layout() -> None:
    start = FULL[: FULL.index("[stereo]")]
    target = '[target]\nlayout = "points"\ndot_diameter_mm = 1.0\n'
    points = "points_mm = [[0, 0], [3.5, 0], [0, 4]]\nmarks = [[0, 2]]\nmark_diameter_mm = 2\n"
    rig = parse(start + target + points)
    assert rig.target.nominal_mm([1, 2]).tolist() == [[3.5, 0, 0], [0, 4, 0]]
    assert rig.target.is_mark([0, 1, 2]).tolist() == [False, False, True]
    for extra, key in (("rows = 2", "rows"), ("pitch_mm = 2.0", "pitch_mm")):
        message = error_of(start + target + points + extra)
        assert f"[target] {key}" in message and "no meaning" in message
    assert "points_mm" in error_of(start + target)
    twice = error_of(start + target + points.replace("[0, 4]", "[0, 0]"))
    assert "[0.0, 0.0] more than once" in twice


BAD = [
    # old, new, then what the error must contain: where, what, what to do
    ("pitch_mm", "pich_mm", "[target] pich_mm", "unknown key", "did you mean pitch_mm?"),
    ("[stage]", "[stagge]", "stagge", "unknown table", "did you mean stage?"),
    ("schema = 1\n", "schema = 1\nnam = 1\n", "nam", "unknown key", "did you mean name?"),
    ("kind = ", "rows = 3\nkind = ", "[references] rows", "unknown key", "belongs under [target]"),
    ("[cameras.left]\n", '[cameras.left]\nname = "x"\n', "[cameras.left] name", "unknown key",
     "top of the file"),
    ("dot_diameter_mm = 2.4\n", "", "[target] dot_diameter_mm", "is missing", "a positive number"),
    ("scale_px_per_mm = 10.0", "scale_px_per_mm = -10.0", "[cameras.left] scale_px_per_mm",
     "is -10.0", "must be a positive number"),
    ("[640, 512]", "[640, 512, 1]", "[cameras.left] image_size_px", "is [640, 512, 1]",
     "[width, height]"),
    ("[640, 512]", "[640.5, 512]", "[cameras.left] image_size_px", "item [0] is 640.5", "whole"),
    ("rows = 3", 'rows = "3"', "[target] rows", "is '3'", "must be a whole number"),
    ("rows = 3", "rows = true", "[target] rows", "is true", "must be a whole number"),
    ("rows = 3", "rows = 0", "[target] rows", "is 0", "must be a whole number from 1"),
    ("pitch_mm = 7.0", "pitch_mm = nan", "[target] pitch_mm", "is nan", "positive number or [x"),
    ("pitch_mm = 7.0", "pitch_mm = inf", "[target] pitch_mm", "is inf", "positive number or [x"),
    ("pitch_mm = 7.0", "pitch_mm = [7.0]", "[target] pitch_mm", "is [7.0]", "positive number or"),
    ("polarity = \"white_on_black\"", 'polarity = "white on black"', "[target] polarity",
     "is 'white on black'", "did you mean white_on_black?"),
    ('mark_style = "large"', 'mark_style = "donut"', "[target] mark_style", "is 'donut'",
     '"large", "ring" or "missing"'),
    ('extent = "bounded"', 'extent = "endless"', "[target] extent", "is 'endless'", "unbounded"),
    ('layout = "grid"', 'layout = "gird"', "[target] layout", "is 'gird'", "did you mean grid?"),
    ('kind = "dots"', 'kind = "lines"', "[references] kind", "is 'lines'", 'must be "dots"'),
    ("pitch_mm = 7.0\n", "", "[target] pitch_mm", "is missing", "nominal distance"),
    ("mark_diameter_mm = 3.6\n", "", "[target] mark_diameter_mm", "is missing", "add the diameter"),
    ("= 3.6", "= 2.4", "[target] mark_diameter_mm", "not larger than dot_diameter_mm", "correct"),
    ("diameter_mm = 2.4", "diameter_mm = 7.5", "[target] dot_diameter_mm", "would touch", "pitch"),
    ("[0, 2]]", "[3, 2]]", "[target] marks", "[3, 2], which is not on the target", "rows 0 to 2"),
    ("[0, 2]]", "[-1, 2]]", "[target] marks", "[-1, 2], which is not", "columns 0 to 4"),
    ("[0, 2]]", "[1, 3]]", "[target] marks", "has [1, 3] more than once", "remove one"),
    ("[0, 14]", "[0, 15]", "[target] scale_dots", "has 15, which is not on", "from 0 to 14"),
    ("[0, 14]", "[3, 3]", "[target] scale_dots", "the same dot twice", "two different dots"),
    ("[0, 14]", "[[0, 0], [0, 5]]", "[target] scale_dots", "has [0, 5]", "numbered from 0 to 14"),
    ("scale_distance_mm = 31.305\n", "", "[target] scale_distance_mm", "is missing", "give both"),
    ("scale_dots = [0, 14]\n", "", "[target] scale_dots", "is missing", "remove scale_distance_mm"),
    ("31.305", "-31.305", "[target] scale_distance_mm", "is -31.305", "positive"),
    ("rows = 3\n", "", "[target] rows", "is missing", "how many rows"),
    ("scale_dots", "two_sided = true\nscale_dots", "[target] plate_thickness_mm", "two_sided",
     "add plate_thickness_mm"),
    ("[stereo]\nright_from_left", "[stereo]\nleft_from_right", "[stereo] left_from_right",
     "unknown key", "did you mean right_from_left_rotvec_deg?"),
    ("axis_left", "axis_right", "[stage] axis_right", "unknown key", "did you mean axis_left?"),
    ("axis_left = [0.0, -2.0, 0.0]\n", "", "[stage] axis_left", "is missing", "a direction"),
    ("[0.0, -2.0, 0.0]", "[0.0, 0.0, 0.0]", "[stage] axis_left", "length zero", "direction"),
    ('mounted_on = "left"', 'mounted_on = "lft"', "[accelerometers.arm_left] mounted_on",
     "neither a camera nor", "did you mean left?"),
    ("[0,0,3]", "[1,1,0]", "[accelerometers.arm_left] axes", "in one plane", "three directions"),
    ("[walls.left]", "[walls.lef]", "[walls.lef]", "no camera 'lef'", "did you mean left?"),
    ("[0.0, 0.3, -0.4]", "[0.0, 1.0, 0.0]", "[walls.left] normal", "along the wall", "z points"),
    ("telecentricity_per_mm = 0.0", "telecentricity_per_mm = 0.005", "[walls.left] distance_mm",
     "telecentricity_per_mm is not 0", "add distance_mm"),
    ("[1.0, 1.52, 1.333]", "[0.5, 1.52, 1.333]", "[walls.left] indices", "item [0] is 0.5", "1 or"),
    ("schema = 1", "", "rig.toml schema", "is missing", "schema = 1"),
    ("schema = 1", "schema = 2", "rig.toml schema", "newer than the 1", "install a newer telerig"),
    ("schema = 1", 'schema = "1"', "rig.toml schema", "is '1'", "write schema = 1"),
    ('name = "tank 2"', "name = tank", "rig.toml", "not valid TOML", "line 3"),
    ('name = "tank 2"', "name = 2", "name", "is 2", "must be text"),
    ("[references]\nkind", "[reference]\nkind", "reference", "unknown table", "references?"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "where", "what", "todo"), BAD)
def test_a_fault_is_told_with_place_and_remedy(
    old: str, new: str, where: str, what: str, todo: str
) -> None:
    message = error_of(changed(old, new))
    assert message.startswith("rig.toml")
    for part in (where, what, todo):
        assert part in message


@pytest.mark.parametrize(("old", "new", "where", "what", "todo"), BAD)
def test_one_fault_is_one_problem(old: str, new: str, where: str, what: str, todo: str) -> None:
    listed = error_of(changed(old, new)).count("\n    -> ")
    both_plate_keys_missing = 2
    assert listed == (both_plate_keys_missing if "two_sided" in new else 0), "0: not a list"


def test_nothing_sets_the_scale() -> None:
    text = FULL.replace("pitch_mm = 7.0\n", "").replace("scale_dots = [0, 14]\n", "")
    message = error_of(text.replace("scale_distance_mm = 31.305\n", ""))
    assert "[target] pitch_mm" in message
    assert "nothing sets the scale" in message
    assert "scale_distance_mm" in message


def test_all_faults_are_listed_in_one_error() -> None:
    faults = {
        "pitch_mm": "pich_mm",
        "axis_left": "axis_lef",
        "[0, 2]]": "[9, 2]]",
        "[0, 14]": "[0, 15]",
        "scale_px_per_mm = 10.0": "scale_px_per_mm = 0",
        "[walls.left]": "[walls.x]",
        "31.305": '"a"',
    }
    text = FULL
    for old, new in faults.items():
        text = text.replace(old, new, 1)
    message = error_of(text)
    assert "rig.toml: 7 problems" in message
    for place in ("[target] pich_mm", "[stage] axis_lef", "[target] marks", "[walls.x]",
                  "[cameras.left] scale_px_per_mm", "[target] scale_distance_mm",
                  "[target] scale_dots"):  # fmt: skip
        assert f"\n  {place}: " in message


def test_scale_dot_on_a_missing_mark() -> None:
    text = changed('"large"', '"missing"').replace("[0, 14]", "[7, 14]")
    assert "has 7, which is a missing mark" in error_of(text)


def test_more_than_two_cameras_are_refused_for_now() -> None:
    third = "[cameras.top]\nimage_size_px = [1, 1]\nscale_px_per_mm = 1.0\n[stereo]"
    message = error_of(changed("[stereo]", third))
    assert "has 3 cameras (left, right, top)" in message and "for now" in message


@pytest.mark.parametrize("name", ['"a/b"', '"a,b"', '"my camera"', "carriage"])
def test_camera_names_must_serve_as_folders(name: str) -> None:
    message = error_of(changed("[cameras.right]", f"[cameras.{name}]"))
    assert "cameras." in message and ("folder" in message or "mounted_on" in message)


def test_camera_names_that_differ_in_case_only() -> None:
    text = changed("[cameras.right]", "[cameras.Left]").replace("right_from", "Left_from")
    assert "upper and lower case" in error_of(text)


def test_stereo_of_a_single_camera() -> None:
    start, rest = FULL.split("[cameras.right]")
    message = error_of(start + rest[rest.index("[stereo]") :])
    assert "[stereo]" in message and "left is the only camera" in message


@pytest.mark.parametrize("table", ["cameras", "target"])
def test_missing_tables(table: str) -> None:
    start, end = {"cameras": ("[target]", "[stage]"), "target": ("[cameras", "[target]")}[table]
    text = "schema = 1\n" + FULL[FULL.index(start) : FULL.index(end)]
    message = error_of(text)
    assert f"[{table}]" in message and "is missing" in message and "telerig init" in message


@pytest.mark.parametrize("line", ["cameras = 3", "target = 3", "walls = 1", "cameras = []"])
def test_a_value_where_tables_belong(line: str) -> None:
    text = f"schema = 1\n{line}\n"
    assert line.split()[0] in error_of(text)


def test_a_missing_file_suggests_init(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="telerig init"):
        read_rig_toml(tmp_path / "rig.toml")


def test_files_that_are_no_text(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_bytes(b"schema = 1\nname = '\xff\xfe'\n")
    with pytest.raises(InputError, match="not UTF-8") as caught:
        read_rig_toml(file)
    assert str(file) in str(caught.value)
    with pytest.raises(InputError, match="cannot be read"):
        read_rig_toml(tmp_path)


def test_a_byte_order_mark_is_no_fault_and_the_folder_names_the_rig(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_bytes(b"\xef\xbb\xbf" + changed('name = "tank 2"\n', "").encode())
    assert read_rig_toml(file).name == tmp_path.name


def as_plain(rig: RigDescription) -> dict[str, object]:
    content = dataclasses.asdict(rig)
    points = content["target"].pop("points_mm")
    content["target"]["points_mm"] = None if points is None else points.tolist()
    return content


FULL_RIG = parse(FULL)
ROUND_TRIPS = {
    "every table": FULL_RIG,
    "unbounded": parse(UNBOUNDED.replace("[0, 14]", "[[-2, 0], [7, 9]]")),
    "mono": RigDescription(
        "mono \"quoted\" \\ back\tslash ü",
        {"top-1": CameraDescription("top-1", (3, 4), 1 / 3, 1e-7)},
        Target(layout="points", points_mm=np.array([[0.1, 0.2], [1 / 3, -2e-9]])),
    ),
    "two-sided": dataclasses.replace(
        FULL_RIG,
        target=Target(rows=2, columns=3, pitch_mm=(2.0, 3.0), mark_style="ring",
                      marks=((0, 0),), two_sided=True, plate_thickness_mm=2.0, plate_index=1.49,
                      print_sigma_mm=0.01, flatness_sigma_mm=0.5),
        walls={"right": WallDescription("right", (0.0, 0.6, 0.8), (1.0, 1.5, 1.33), 5.0, 80.0)},
        stage=StageDescription((0.6, 0.0, 0.8), (0.0, 1.0, 0.0), 0.001),
    ),
    "accented camera": dataclasses.replace(
        FULL_RIG,
        cameras={"große": CameraDescription("große", (9, 9), 1.0), "b": FULL_RIG.cameras["right"]}
        | {"b": CameraDescription("b", (9, 9), 1.0)},
        walls={}, accelerometers={},
    ),
}  # fmt: skip


@pytest.mark.parametrize("rig", ROUND_TRIPS.values(), ids=ROUND_TRIPS.keys())
def test_what_is_written_reads_back_equal(rig: RigDescription, tmp_path: Path) -> None:
    file = tmp_path / "new" / "rig.toml"
    write_rig_toml(rig, file)
    assert as_plain(read_rig_toml(file)) == as_plain(rig)
    assert sorted(p.name for p in file.parent.iterdir()) == ["rig.toml"]


def test_the_written_file_has_the_documented_keys(tmp_path: Path) -> None:
    write_rig_toml(FULL_RIG, tmp_path / "rig.toml")
    written = tomllib.loads((tmp_path / "rig.toml").read_text(encoding="utf-8"))
    documented = tomllib.loads(FULL)
    assert list(written) == list(documented)
    for table in ("stereo", "references"):
        assert written[table] == documented[table]
    assert set(documented["target"]) - set(written["target"]) == set()
    assert written["target"]["scale_dots"] == [0, 14]
    assert written["stage"]["axis_left"] == [0.0, -1.0, 0.0]


def test_a_description_that_no_file_may_hold_is_not_written(tmp_path: Path) -> None:
    bad = dataclasses.replace(FULL_RIG, target=Target(rows=0, columns=3))
    with pytest.raises(InputError, match="rows"):
        write_rig_toml(bad, tmp_path / "rig.toml")
    assert list(tmp_path.iterdir()) == []
