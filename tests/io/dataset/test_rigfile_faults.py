"""rig.toml: what each fault is told as."""

from __future__ import annotations

from pathlib import Path

import pytest
from rig_text import FULL, changed, error_of

from telerig.errors import InputError
from telerig.io.rig_file.rig_file import read_rig_toml

BAD = [
    # old, new, then what the error must contain: where, what, what to do
    ("pitch_mm", "pich_mm", "[target] pich_mm", "unknown key", "did you mean pitch_mm?"),
    ("[stage]", "[stagge]", "stagge", "unknown table", "did you mean stage?"),
    ("schema = 1\n", "schema = 1\nnam = 1\n", "nam", "unknown key", "did you mean name?"),
    ("kind = ", "rows = 3\nkind = ", "[references] rows", "unknown key", "belongs under [target]"),
    ("kind = ", "position_sigma_mm = 0.01\nkind = ", "[references] position_sigma_mm",
     "unknown key", "belongs under [stage]"),
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
    ("[walls.left]", "[walls]", "[walls]", "holds normal, indices, thickness_mm", "[walls.<name>]"),
    ("[walls.left]", "[walls.lef]", "[walls.lef]", "no camera 'lef'", "did you mean left?"),
    ("[0.0, 0.3, -0.4]", "[0.0, 1.0, 0.0]", "[walls.left] normal", "along the wall", "z points"),
    ("telecentricity_per_mm = 0.0", "telecentricity_per_mm = 0.005", "[walls.left] distance_mm",
     "telecentricity_per_mm is not 0", "add distance_mm"),
    ("[1.0, 1.52, 1.333]", "[0.5, 1.52, 1.333]", "[walls.left] indices", "item [0] is 0.5", "1 or"),
    ("schema = 1", "", "rig.toml schema", "is missing", "schema = 1"),
    ("schema = 1", "schema = 2", "rig.toml schema", "up to version 1", "install a newer telerig"),
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


def _more_cameras(*names: str) -> str:
    tables = (f"[cameras.{n}]\nimage_size_px = [1, 1]\nscale_px_per_mm = 1.0\n" for n in names)
    return "".join(tables) + "[stereo]"


def test_more_than_four_cameras_are_refused() -> None:
    message = error_of(changed("[stereo]", _more_cameras("top", "below", "back")))
    assert "has 5 cameras (left, right, top, below, back)" in message and "4 at most" in message


def test_a_third_camera_under_a_wrong_key() -> None:
    text = changed("[stereo]", _more_cameras("top"))
    message = error_of(text.replace("[target]", "top_from_right_rotvec_deg = [0, 1, 2]\n[target]"))
    assert "top_from_right_rotvec_deg" in message
    assert "did you mean top_from_left_rotvec_deg" in message
    message = error_of(text.replace("[target]", "angle = [0, 1, 2]\n[target]"))
    assert "known: right_from_left_rotvec_deg, top_from_left_rotvec_deg" in message
    message = error_of(text.replace("[target]", "top_from_left_rotvec_deg = [0, 1]\n[target]"))
    assert "top_from_left_rotvec_deg" in message and "three numbers in degrees" in message


@pytest.mark.parametrize(
    ("cameras", "words"),
    [
        ('["left", "rihgt"]', "did you mean right"),
        ('["left", "left"]', "names 'left' twice"),
        ('["left"]', "the names of cameras"),
    ],
)
def test_the_cameras_of_tracking(cameras: str, words: str) -> None:
    message = error_of(changed("[stage]", f"[tracking]\ncameras = {cameras}\n[stage]"))
    assert "[tracking] cameras" in message and words in message


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
