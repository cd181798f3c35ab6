"""What a self-calibration refuses, and what it warns of, each in words that name the place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from finding_codes import codes, only

from telerig.errors import CalibrationError, DetectionError, InputError
from telerig.estimator.calibration.solver.problem import problem_from_dots
from telerig.io.results.findings import Code
from telerig.rig.pose import Pose

pytestmark = pytest.mark.usefixtures("without_advice")


@pytest.fixture(scope="module")
def paper(scene: Any) -> Any:
    return scene("paper", 1)


def test_one_view_is_refused(scene: Any) -> None:
    with pytest.raises(CalibrationError, match=r"1 view(.|\n)*at least 2(.|\n)*at least 6 views"):
        scene("paper", 1, views=1).calibrate("radial")


def test_three_views_of_unknown_dots_are_refused(scene: Any) -> None:
    made = scene("paper", 1, views=3)
    target = replace(made.target, print_sigma_mm=3.0)
    with pytest.raises(CalibrationError, match="positions are unknown needs at least"):
        replace(made, target=target).calibrate("radial")


@pytest.mark.parametrize("model", ["radial", "auto"])
def test_five_views_warn(model: str, scene: Any) -> None:
    made = scene("paper", 1, views=5)
    calibration = made.calibrate(model)
    assert calibration.verdict["status"] == "USABLE, with warnings"
    assert only(calibration, Code.FEW_VIEWS).numbers == {"count": 5}
    assert made.space_rms_um(calibration) < 1.5


def retaken(scene: Any, poses: dict[str, Pose]) -> Any:
    """The scene's cameras and target again, in other poses."""
    ids = np.array(list(scene.true_dots_mm))
    truth = np.array(list(scene.true_dots_mm.values()))
    rng = np.random.default_rng(0)
    rows = []
    for name, pose in poses.items():
        for camera in scene.true_cameras.values():
            uv = camera.project(pose.apply(truth)) + 0.01 * rng.standard_normal((len(ids), 2))
            rows.append(pd.DataFrame({"view": name, "camera": camera.name, "dot": ids,
                                      "u_px": uv[:, 0], "v_px": uv[:, 1]}))  # fmt: skip
    dots = pd.concat(rows, ignore_index=True)
    return scene.with_dots(dots.assign(suu_px2=1e-4, svv_px2=1e-4, suv_px2=0.0))


@pytest.mark.parametrize("unknown", [False, True])
def test_parallel_views_are_refused(unknown: bool, paper: Any) -> None:
    rng = np.random.default_rng(0)
    first = next(iter(paper.true_views.values())).rig_from_target
    poses = {
        f"v{i}": Pose(first.rotation, first.translation_mm + rng.uniform(-4, 4, 3))
        for i in range(8)
    }
    made = retaken(paper, poses)
    if unknown:
        made = replace(made, target=replace(made.target, print_sigma_mm=3.0))
    with pytest.raises(CalibrationError, match="all views are parallel"):
        made.calibrate("radial")


def spoiled(scene: Any, rows: Any, seed: int) -> Any:
    dots = scene.dots.copy()
    rng = np.random.default_rng(seed)
    dots.loc[rows, ["u_px", "v_px"]] = rng.uniform(50, 450, (int(rows.sum()), 2))
    return scene.with_dots(dots)


@pytest.mark.parametrize(("seed", "cameras"), [(0, ["left"]), (1, ["left", "right"])])
def test_a_hopeless_view_is_left_out_and_named(seed: int, cameras: list[str], paper: Any) -> None:
    bad = ((paper.dots["view"] == "view04") & paper.dots["camera"].isin(cameras)).to_numpy()
    made = spoiled(paper, bad, seed)
    calibration = made.calibrate("radial")
    assert paper.space_rms_um(calibration) < 1.0
    assert calibration.statistics["noise_floor_px"] == 0
    assert not np.any(made.weights(calibration)[bad] > 0.5)
    named = only(calibration, Code.ODD_VIEW)
    assert named.views == ("view04",)
    assert set(cameras) <= set(named.cameras)
    if len(cameras) == 2:
        reasons = calibration.residuals.loc[calibration.residuals["view"] == "view04", "reason"]
        assert (reasons != "").all()


def test_a_view_numbered_the_wrong_way_round_is_named(paper: Any) -> None:
    made = paper.changed(
        lambda d: d.assign(dot=np.where(d["view"] == "view05", 14 - d["dot"], d["dot"]))
    )
    calibration = made.calibrate("radial")
    assert calibration.verdict["status"] == "USABLE, with warnings"
    assert only(calibration, Code.ODD_VIEW).views == ("view05",)
    assert paper.space_rms_um(calibration) < 1.0


def test_mirrored_images_are_refused(paper: Any) -> None:
    flipped = paper.changed(
        lambda d: d.assign(u_px=np.where(d["camera"] == "right", 511 - d["u_px"], d["u_px"])),
    )
    with pytest.raises(DetectionError, match="'right' is mirrored"):
        flipped.calibrate("radial")
    every = paper.changed(lambda d: d.assign(u_px=511 - d["u_px"])).calibrate("radial")
    assert "MIRRORED" in codes(every) and "MIRRORED" not in codes(paper.calibrate("radial"))


def test_a_view_with_three_dots_is_noted(paper: Any) -> None:
    made = paper.changed(lambda d: d[(d["view"] != "view03") | (d["dot"] < 3)])
    calibration = made.calibrate("radial")
    assert only(calibration, Code.UNUSED_VIEWS).views == ("view03",)
    assert paper.space_rms_um(calibration) < 1.0


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        (lambda d: d["dot"].isin([0, 4, 14]), "view view00, camera left: 3 dots"),
        (lambda d: d["camera"] == "left", "camera right: 0 dots"),
        (lambda d: d["dot"] != 14, r"\[14\], whose distance"),
    ],
    ids=["three dots", "one camera", "no scale"],
)
def test_dots_that_are_too_few_are_refused(kept: Any, words: str, paper: Any) -> None:
    with pytest.raises(CalibrationError, match=words):
        paper.changed(lambda d: d[kept(d)]).calibrate("radial")


def test_an_impossible_scale_distance_is_refused(paper: Any) -> None:
    made = replace(paper, target=replace(paper.target, scale_distance_mm=62.6))
    with pytest.raises(CalibrationError, match=r"62\.6 mm.*nominal places are 31\.3"):
        made.calibrate("radial")


def test_a_distance_is_not_impossible_that_was_measured_roughly(paper: Any) -> None:
    """A precise plate and a calliper, whose reading is two standard deviations off."""
    nominal = float(np.linalg.norm(np.diff(paper.target.nominal_mm([0, 14]), axis=0)))
    target = replace(
        paper.target, print_sigma_mm=1e-3, scale_sigma_mm=0.02, scale_distance_mm=nominal + 0.04
    )
    problem_from_dots(paper.dots, paper.cameras, target)


def with_value(column: str, value: Any) -> Callable[[pd.DataFrame], pd.DataFrame]:
    def change(dots: pd.DataFrame) -> pd.DataFrame:
        dots[column] = dots[column].astype(object)
        dots.loc[33, column] = value
        return dots

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (with_value("u_px", np.nan), "1 of 360 dots are not finite"),
        (with_value("svv_px2", 0.0), "no positive definite covariance"),
        (with_value("camera", "rihgt"), "camera that the rig does not have"),
        (with_value("dot", 99), "the target does not have"),
        (lambda d: pd.concat([d, d[33:34]]), "1 of 361 dots are given twice"),
    ],
)
def test_unusable_rows_are_refused(change: Any, words: str, paper: Any) -> None:
    row = paper.dots.iloc[33]
    with pytest.raises(InputError, match=words) as error:
        paper.changed(change).calibrate("radial")
    assert f"view {row['view']}" in error.value.where


def test_no_dots_too_many_cameras_and_unknown_choices(paper: Any) -> None:
    with pytest.raises(CalibrationError, match="no dots in any image"):
        paper.changed(lambda d: d[:0]).calibrate("radial")
    more = [replace(paper.cameras[1], name=name) for name in ("third", "fourth", "fifth")]
    with pytest.raises(InputError, match="5 cameras"):
        replace(paper, cameras=[*paper.cameras, *more]).calibrate("radial")
    with pytest.raises(CalibrationError, match="left and right, and cameras third have no view"):
        replace(paper, cameras=[*paper.cameras, more[0]]).calibrate("radial")
    with pytest.raises(InputError, match="nominal rotations are given for top"):
        paper.calibrate("radial", nominal_rotvec_deg={"top": (0, 90, 0)})
    with pytest.raises(CalibrationError, match="unknown model 'best'"):
        paper.calibrate("best")
    with pytest.raises(CalibrationError, match="dots_free is"):
        paper.calibrate("radial", dots_free="2d")
