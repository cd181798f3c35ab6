"""Three and four cameras calibrated together from tables of dots, each seeing some of the views."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from finding_codes import codes, only
from turned_images import settled, turned
from typer.testing import CliRunner

from telerig.errors import CalibrationError
from telerig.estimator.calibration import self_calibration
from telerig.estimator.calibration.next_view import next_view
from telerig.estimator.calibration.quality.comparison import (
    compare_calibrations,
    difference_from_truth,
)
from telerig.estimator.calibration.result.calibration import load_calibration
from telerig.estimator.calibration.solver import system
from telerig.io.results.calibration import CalibrationFile
from telerig.io.results.findings import Code
from telerig.io.simulation.config import CameraConfig
from telerig.rig.triangulation import working_volume
from telerig.scripts.main import app

PAIRS = (("left", "middle"), ("middle", "right"))
NAMES = ("a", "b", "c", "d")
pytestmark = pytest.mark.usefixtures("without_advice", "undrawn")


def space_ratio(calibration: Any, made: Any) -> float:
    """Errors in space over their stated standard deviation."""
    cameras = tuple(made.true_cameras[c.name] for c in calibration.cameras)
    found = difference_from_truth(calibration, cameras)
    return found.rms_um / found.predicted_um


@pytest.fixture(scope="module")
def fan(scene: Any) -> Any:
    return scene("three", 1, outlier_share=0.03)


@pytest.fixture(scope="module")
def calibrated(fan: Any) -> Any:
    return fan.calibrate("auto")


def test_three_cameras_from_a_table(fan: Any, calibrated: Any) -> None:
    assert calibrated.verdict["status"] == "GOOD", calibrated.verdict
    assert abs(calibrated.statistics["chi2_dof"] - 1) < 0.12
    assert 0.1 < space_ratio(calibrated, fan) < 2.5
    np.testing.assert_array_equal(fan.weights(calibrated) < 0.5, fan.outlier)
    assert "HALVES_AGREE" in codes(calibrated)
    # the depth gauge: along the first axis that of the second camera alone, along its own of each
    middle, right = (c.rig_from_camera for c in calibrated.cameras[1:])
    for pose in (middle, right):
        assert abs(pose.translation_mm @ pose.rotation[:, 2]) < 1e-5
    assert abs(middle.translation_mm[2]) < 1e-5
    assert abs(right.translation_mm[2]) > 0.05


def test_what_the_file_says_of_three_cameras(calibrated: Any, tmp_path: Path) -> None:
    calibrated.save(tmp_path)
    again = load_calibration(tmp_path)
    np.testing.assert_array_equal(again.covariance, calibrated.covariance)
    assert [n for n in again.covariance_names if n.endswith("tz_mm")] == [
        "middle.tz_mm", "right.tz_mm",
    ]  # fmt: skip
    file = CalibrationFile.read(tmp_path / "calibration.json").content()
    assert file["twin"]["nominal_rotvec_deg"] == {"middle": [0, 60, 0], "right": [0, 120, 0]}
    angles = file["statistics"]["from_first"]
    assert angles["middle"]["axes_angle_deg"] == pytest.approx(60, abs=1.5)
    assert angles["right"]["axes_angle_deg"] == pytest.approx(120, abs=1.5)
    assert file["statistics"]["axes_angle_deg"] == angles["middle"]["axes_angle_deg"]
    assert "where the first two optical axes come closest" in file["gauge"]
    assert "camera right" in calibrated.report()
    assert "angle between the axes of left and right 1" in calibrated.report()


def test_a_third_camera_makes_points_better(calibrated: Any) -> None:
    points = working_volume(calibrated.cameras, 3)
    uv = {c.name: c.project(points) for c in calibrated.cameras}
    three = calibrated.triangulate(uv, sigma_px=0.05)
    for pair in itertools.combinations(uv, 2):
        two = calibrated.triangulate({n: uv[n] for n in pair}, sigma_px=0.05)
        gain = two.measurement_covariance_mm2 - three.measurement_covariance_mm2
        assert np.all(np.linalg.eigvalsh(gain) > -1e-12)
        whole = [np.trace(f.covariance_mm2, axis1=-2, axis2=-1) for f in (two, three)]
        assert np.all(whole[1] < whole[0])


def test_the_next_view_may_be_for_any_two_cameras(
    fan: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(self_calibration, "next_view", next_view)
    few = fan.with_dots(fan.dots[fan.dots["view"] < "view07"])
    advice = few.calibrate("radial").diagnostics["next_view"]
    assert advice["poses"] and advice["after_um"] < advice["before_um"]
    assert all("midway between cameras" in p["words"] for p in advice["poses"])


def test_comparison_names_the_camera_that_moved(scene: Any, calibrated: Any) -> None:
    still = scene("three", 2).calibrate("radial")
    assert not compare_calibrations(calibrated, still).moved
    turned_ = scene("three", 2, mount_rotvec_deg=(0.4, -0.7, 0.52)).calibrate("radial")
    found = compare_calibrations(still, turned_)
    assert found.moved and len(found.changes) == 2 * 4 + 3
    assert any(c.quantity == "rotation about x of camera right" for c in found.changes)
    assert "between cameras left and right" in found.words()


def test_a_chain_of_overlaps_is_enough(scene: Any) -> None:
    cameras = tuple(CameraConfig(name, (512, 512)) for name in NAMES)
    made = scene(
        "three", 3, cameras=cameras, angle_deg=35.0, seen_by=(NAMES[:3], NAMES[1:]), views=14
    )
    calibration = made.calibrate("radial")
    assert calibration.verdict["status"] == "GOOD", calibration.verdict
    assert 0.1 < space_ratio(calibration, made) < 2.5


def test_views_of_two_cameras_only_leave_an_offset_open(scene: Any) -> None:
    made = scene("three", 4, seen_by=PAIRS)
    calibration = made.calibrate("radial")
    assert calibration.verdict["status"] == "USABLE, with warnings"
    assert only(calibration, Code.OFFSET).cameras == ("right",)
    assert len(calibration.verdict["reasons"]) == 1
    along = calibration.cameras[1].camera_from_rig.rotation[2]
    # along the middle axis the right camera may be anywhere, and the covariance says so
    names = [f"right.t{axis}_mm" for axis in "xyz"]
    index = [calibration.covariance_names.index(name) for name in names]
    own = calibration.cameras[2].camera_from_rig.rotation @ along
    block = calibration.covariance[np.ix_(index, index)]
    assert own @ block @ own > 1.0


def test_opposite_first_cameras_leave_the_origin_to_the_third(
    scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cameras at 0, 90, 180 degrees have the same origin and depths in the order 0, 180, 90."""
    target = replace(scene("three", 0).target, two_sided=True)
    made = scene(
        "three", 1, target=target, angle_deg=90.0, seen_by=(("left", "middle", "right"),), views=6
    )
    left, middle, right = made.cameras
    points, sd = np.array([[1.0, 2.0, 3.0], [5.0, -4.0, 2.0]]), []
    opposite = [left, right, middle]
    for cameras, many in (
        ([left, middle, right], 5000), (opposite, 5000), (opposite, 0),
    ):  # fmt: skip
        monkeypatch.setattr(system, "MANY_DOTS", many)
        found = replace(made, cameras=cameras).calibrate("radial")
        assert codes(found) == ["NO_STRUCTURE", "HALVES_NOT_COMPARED"]
        assert abs(found.camera("middle").rig_from_camera.translation_mm[2]) < 1e-5
        uv = {c.name: c.project(points) for c in found.cameras}
        covariance = found.triangulate(uv, sigma_px=0.05).covariance_mm2
        sd.append(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
    assert "the optical axes of cameras 'left' and 'middle' come" in found.diagnostics["gauge"]
    np.testing.assert_allclose(sd[1:], [sd[0]] * 2, rtol=1e-3)


def test_two_groups_without_a_common_view_are_named(scene: Any) -> None:
    cameras = tuple(CameraConfig(name, (512, 512)) for name in NAMES)
    made = scene("three", 3, cameras=cameras, angle_deg=35.0, seen_by=(("a", "b"), ("c", "d")))
    with pytest.raises(CalibrationError, match="cameras a and b, and cameras c and d") as caught:
        made.calibrate("radial")
    assert "add views of the target that cameras of both groups see" in str(caught.value)


def test_one_view_in_common_is_too_little(scene: Any) -> None:
    made = scene("three", 3, seen_by=(("left", "middle"),) * 5 + (("middle", "right"),), views=6)
    with pytest.raises(CalibrationError, match="'middle' and 'right' have 1 view in common"):
        made.calibrate("radial")


def test_views_of_three_cameras_settle_the_side_of_each(scene: Any, fan: Any) -> None:
    """Then the nominal rotation of one camera decides for all."""
    one = fan.calibrate("radial", nominal_rotvec_deg={"right": (0, 120, 0)})
    assert space_ratio(one, fan) < 2.5
    few, wrong = scene("three", 1, views=4), {"middle": (0, 60, 0), "right": (0, -120, 0)}
    with pytest.raises(CalibrationError, match="too similar to choose") as caught:
        few.calibrate("radial", nominal_rotvec_deg=wrong)
    assert "middle_from_left_rotvec_deg and right_from_left_rotvec_deg" in str(caught.value)
    with pytest.raises(CalibrationError, match="both mirror solutions fit equally well") as caught:
        few.calibrate("radial", nominal_rotvec_deg=None)
    assert "add middle_from_left_rotvec_deg = [0.0, 90.0, 0.0]" in str(caught.value)


def test_pairs_of_a_flat_target_need_each_cameras_nominal_rotation(scene: Any) -> None:
    made = scene("three", 4, seen_by=PAIRS, print_factor=0.0, views=8)
    calibration = made.calibrate("radial")
    turn = calibration.cameras[2].camera_from_rig.rotation[2]
    assert turn @ made.true_cameras["right"].camera_from_rig.rotation[2] > 0.9999
    with pytest.raises(CalibrationError, match="mirror images of each other in camera") as caught:
        made.calibrate("radial", nominal_rotvec_deg={"middle": (0, 60, 0)})
    assert "right_from_left_rotvec_deg = " in str(caught.value)


def test_a_symmetric_target_in_three_cameras(scene: Any) -> None:
    target = replace(scene("symmetric", 0).target, scale_distance_mm=None)
    right = scene("three", 5, target=target)
    made, turn = turned(right, 5)
    assert set(turn) == {0, 1}
    calibration = made.calibrate("radial")
    assert settled(calibration, made, right.dots["dot"]) != []
    assert "TURNS_KNOWN" in codes(calibration)


def test_unknown_dots_in_three_cameras(scene: Any) -> None:
    made = scene("three", 6, views=18)
    target = replace(made.target, print_sigma_mm=2.0)
    calibration = replace(made, target=target).calibrate("radial")
    assert 0.05 < space_ratio(calibration, made) < 2.5


def test_the_command_for_three_cameras(tmp_path: Path) -> None:
    def asked(*arguments: str) -> Any:
        return CliRunner().invoke(app, list(arguments))

    folder = tmp_path / "three"
    assert asked("simulate", "three", "--no-images", "--out", str(folder)).exit_code == 0
    assert not (folder / "runs").exists(), "a calibration is simulated"
    result = asked("calibrate", str(folder), "--model", "radial", "--quiet")
    assert result.exit_code == 0, result.output
    place = folder / "results" / "calibration"
    page = (place / "report.html").read_text(encoding="utf-8")
    for words in ("middle_from_left as rotation vector", "right_from_left as rotation vector"):
        assert words in page
    with np.load(place / "uncertainty.npz") as found:
        assert np.isfinite(found["calibration_mm2"]).all()
    for to in ("halcon", "opencv"):
        exported = asked("export", str(folder), "--to", to, "--out", str(tmp_path / to))
        assert exported.exit_code == 0, exported.output
