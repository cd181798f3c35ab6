"""rig.toml: what is read and what is written."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from rig_text import FULL, UNBOUNDED, changed, error_of, parse

from telerig.errors import InputError
from telerig.io.rig_file.description import (
    AccelerometerDescription,
    CameraDescription,
    ReferencesDescription,
    RigDescription,
    StageDescription,
    WallDescription,
)
from telerig.io.rig_file.rig_file import read_rig_toml, write_rig_toml
from telerig.rig.target import Target


def test_every_table_of_the_file_is_read() -> None:
    rig = parse(FULL)
    assert rig.name == "tank 2"
    assert (rig.first, rig.others) == ("left", ("right",))
    assert rig.cameras["left"] == CameraDescription("left", (640, 512), 10.0, 0.0)
    assert rig.cameras["right"] == CameraDescription("right", (512, 512), 11.0, None)
    assert rig.rotvec_from_first_deg == {"right": (0.0, 90.0, 0.0)}
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


def test_gravity_is_the_standard_one_unless_given() -> None:
    stage = parse(FULL).stage
    assert stage is not None and stage.gravity_m_s2 == 9.80665
    stage = parse(changed("position_sigma", "gravity_m_s2 = 9.781\nposition_sigma")).stage
    assert stage is not None and stage.gravity_m_s2 == 9.781
    for wrong in ("981.0", "9.95", "1.0"):
        message = error_of(changed("position_sigma", f"gravity_m_s2 = {wrong}\nposition_sigma"))
        assert "[stage] gravity_m_s2" in message and "from 9.7 to 9.9" in message


def test_range_and_clock_of_an_accelerometer(tmp_path: Path) -> None:
    plain = parse(FULL).accelerometers["arm_left"]
    assert (plain.range_m_s2, plain.clock) == (None, None)
    line = 'range_m_s2 = 156.9\nclock = "unknown"\nbias_sigma_m_s2'
    rig = parse(changed("bias_sigma_m_s2", line))
    sensor = rig.accelerometers["arm_left"]
    assert (sensor.range_m_s2, sensor.clock) == (156.9, "unknown")
    write_rig_toml(rig, tmp_path / "rig.toml")
    assert read_rig_toml(tmp_path / "rig.toml").accelerometers == rig.accelerometers
    for wrong, key in (('clock = "utc"', "clock"), ("range_m_s2 = -1.0", "range_m_s2")):
        message = error_of(changed("bias_sigma_m_s2", f"{wrong}\nbias_sigma_m_s2"))
        assert f"[accelerometers.arm_left] {key}" in message


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


def test_three_cameras_and_those_that_are_tracked(tmp_path: Path) -> None:
    third = "[cameras.top]\nimage_size_px = [8, 8]\nscale_px_per_mm = 1.0\n[stereo]\n"
    text = changed("[stereo]", third + "top_from_left_rotvec_deg = [-90.0, 0.0, 0.0]")
    rig = parse(text)
    assert rig.others == ("right", "top")
    assert rig.rotvec_from_first_deg == {"right": (0, 90, 0), "top": (-90, 0, 0)}
    assert rig.tracking is None and rig.tracking_cameras == ("left", "right", "top")
    three = parse(text + '[tracking]\ncameras = ["top", "right", "left"]\n')
    assert three.tracking == ("left", "right", "top")
    rig = parse(text + '[tracking]\ncameras = ["top", "left"]\n')
    assert rig.tracking_cameras == ("left", "top")
    write_rig_toml(rig, tmp_path / "rig.toml")
    assert read_rig_toml(tmp_path / "rig.toml") == rig


def test_one_camera_is_legal() -> None:
    start, rest = FULL.split("[cameras.right]")
    rig = parse(start + rest[rest.index("[target]") :])
    assert (rig.first, rig.others, rig.rotvec_from_first_deg) == ("left", (), {})


def test_cameras_by_name_or_index() -> None:
    rig = parse(FULL)
    assert [rig.camera_name(c) for c in (0, 1, "right")] == ["left", "right", "right"]
    for wrong in (2, -1, "rihgt"):
        with pytest.raises(InputError, match="no camera"):
            rig.camera_name(wrong)
    with pytest.raises(InputError, match="did you mean right"):
        rig.camera_name("rihgt")


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
        stage=StageDescription((0.6, 0.0, 0.8), (0.0, 1.0, 0.0), 0.001, gravity_m_s2=9.781),
    ),
    "accented camera": dataclasses.replace(
        FULL_RIG,
        cameras={"große": CameraDescription("große", (9, 9), 1.0), "b": FULL_RIG.cameras["right"]}
        | {"b": CameraDescription("b", (9, 9), 1.0)},
        walls={}, accelerometers={}, rotvec_from_first_deg={"b": (0.0, 90.0, 0.0)},
    ),
}  # fmt: skip


@pytest.mark.parametrize("rig", ROUND_TRIPS.values(), ids=ROUND_TRIPS.keys())
def test_what_is_written_reads_back_equal(rig: RigDescription, tmp_path: Path) -> None:
    file = tmp_path / "new" / "rig.toml"
    write_rig_toml(rig, file)
    assert as_plain(read_rig_toml(file)) == as_plain(rig)
    assert sorted(p.name for p in file.parent.iterdir()) == ["rig.toml"]


def test_a_description_that_no_file_may_hold_is_not_written(tmp_path: Path) -> None:
    bad = dataclasses.replace(FULL_RIG, target=Target(rows=0, columns=3))
    with pytest.raises(InputError, match="rows"):
        write_rig_toml(bad, tmp_path / "rig.toml")
    assert list(tmp_path.iterdir()) == []
