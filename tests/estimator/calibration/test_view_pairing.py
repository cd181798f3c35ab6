"""Wrong data that would fit well, or fail for another stated reason: copies, pairs, exchange."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from finding_codes import codes

from telerig.errors import CalibrationError
from telerig.estimator.calibration.quality import checks
from telerig.estimator.calibration.solver.problem import problem_from_dots
from telerig.estimator.calibration.thresholds import UNPAIRED
from telerig.io.results.findings import objections

pytestmark = pytest.mark.usefixtures("without_advice")


@pytest.fixture(scope="module")
def paper(scene: Any) -> Any:
    return scene("paper", 3)


def offset(dots: pd.DataFrame, camera: str, first: int, by: int) -> pd.DataFrame:
    """From a view on, the camera's images have the name of the view that is ``by`` later."""
    views = sorted(dots["view"].unique())
    index = dots["view"].map(views.index).to_numpy()
    moved = ((dots["camera"] == camera) & (index >= first)).to_numpy()
    index = index + np.where(moved, by, 0)
    inside = (index >= 0) & (index < len(views))
    out = dots[inside].assign(view=[views[i] for i in index[inside]])
    return out.drop_duplicates(["view", "camera", "dot"], keep="last", ignore_index=True)


@pytest.mark.parametrize(
    ("first", "by", "views"), [(0, -1, 6), pytest.param(2, 2, 8, marks=pytest.mark.slow)]
)
def test_images_under_the_names_of_other_views_are_refused(
    first: int, by: int, views: int, paper: Any
) -> None:
    few = paper.changed(lambda dots: dots[dots["view"] < f"view{views:02}"])
    made = few.changed(lambda dots: offset(dots, "right", first, by))
    with pytest.raises(CalibrationError) as caught:
        made.calibrate("radial")
    text = str(caught.value)
    assert "images of camera 'right' do not belong to the views whose names they have" in text
    assert f"those {abs(by)} {'later' if by > 0 else 'earlier'} fit" in text
    assert "same file name" in text


@pytest.mark.parametrize("by", [1, -1, 2, -2])
@pytest.mark.parametrize("camera", ["left", "right"])
def test_only_images_of_one_moment_have_one_epipolar_geometry(
    camera: str, by: int, paper: Any
) -> None:
    """A hundredth of bad dots does not hide it, and makes right pairs no wrong ones."""
    rng = np.random.default_rng(0)
    bad = rng.random(len(paper.dots)) < 0.01
    dots = paper.dots.assign(u_px=paper.dots["u_px"] + 100 * bad * rng.standard_normal(len(bad)))
    for table in (paper.dots, dots):
        checks.refuse_wrong_pairs(problem_from_dots(table, paper.cameras, paper.target))
        shifted = problem_from_dots(offset(table, camera, 0, by), paper.cameras, paper.target)
        with pytest.raises(CalibrationError, match="do not belong to the views"):
            checks.refuse_wrong_pairs(shifted)
    right = problem_from_dots(paper.dots, paper.cameras, paper.target)
    assert checks.epipolar_misfits(right, (0, 1), 0)[0].max() < 1e-7
    wrong = checks.epipolar_misfits(right, (0, 1), by)[0]
    assert wrong.min() > 5 * UNPAIRED, "of the nine tenths that fit best"


@pytest.mark.parametrize("first", [0, 4, 8])
def test_view_10_comes_after_view_9(first: int, paper: Any) -> None:
    """The order of the views tells from which one on an image was lost."""
    lost = offset(paper.dots, "right", first, -1)
    plain = lost.assign(view=[f"IMG_{int(name[4:])}" for name in lost["view"]])
    problem = problem_from_dots(plain, paper.cameras, paper.target)
    assert problem.views == tuple(f"IMG_{k}" for k in range(12))
    with pytest.raises(CalibrationError, match=f"from view 'IMG_{first}' on(.|\n)*1 earlier fit"):
        checks.refuse_wrong_pairs(problem)


@pytest.mark.parametrize("share", [0.01, 0.05])
def test_bad_dots_make_right_pairs_no_wrong_ones(share: float, scene: Any) -> None:
    """Where two views are left at an end, those of other moments may fit well by chance."""
    for seed in range(10):
        made = scene("paper", seed)
        for draw in range(15):
            rng = np.random.default_rng([seed, draw])
            bad = (rng.random(len(made.dots)) < share)[:, None]
            error = 100 * bad * rng.standard_normal((len(bad), 2))
            u, v = made.dots["u_px"] + error[:, 0], made.dots["v_px"] + error[:, 1]
            dots = made.dots.assign(u_px=u, v_px=v)
            checks.refuse_wrong_pairs(problem_from_dots(dots, made.cameras, made.target))


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_dots_that_one_camera_did_not_see_make_right_pairs_no_wrong_ones(
    share: float, paper: Any
) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        table = paper.dots[rng.random(len(paper.dots)) > share]
        problem = problem_from_dots(table, paper.cameras, paper.target)
        assert checks.epipolar_misfits(problem, (0, 1), 0)[0].max() < 1e-7
        checks.refuse_wrong_pairs(problem)
        shifted = problem_from_dots(offset(table, "right", 0, 1), paper.cameras, paper.target)
        with pytest.raises(CalibrationError, match="do not belong to the views"):
            checks.refuse_wrong_pairs(shifted)


@pytest.mark.parametrize("camera", ["left", "middle", "right"])
@pytest.mark.parametrize("by", [1, -2])
def test_wrong_images_of_one_of_three_cameras_are_named(camera: str, by: int, scene: Any) -> None:
    """The images of the third may share more views with the first than those that belong to it."""
    three = scene("three", 0)
    checks.refuse_wrong_pairs(problem_from_dots(three.dots, three.cameras, three.target))
    wrong = problem_from_dots(offset(three.dots, camera, 0, by), three.cameras, three.target)
    with pytest.raises(CalibrationError, match=f"images of camera '{camera}' do not belong"):
        checks.refuse_wrong_pairs(wrong)


def test_a_target_that_is_not_tilted_shows_nothing_of_the_pairs(paper: Any) -> None:
    """Moved without a turn, a flat target fits all pairs: the refusal is that of parallel views."""
    views = sorted(paper.dots["view"].unique())
    first = paper.dots[paper.dots["view"] == views[0]]
    rng = np.random.default_rng(0)
    step = rng.uniform(-20, 20, (len(views), 2))
    dots = pd.concat([
        first.assign(view=v, u_px=first["u_px"] + du + 0.01 * rng.standard_normal(len(first)),
                     v_px=first["v_px"] + dv + 0.01 * rng.standard_normal(len(first)))
        for v, (du, dv) in zip(views, step)
    ])  # fmt: skip
    made = paper.changed(lambda _: offset(dots.reset_index(drop=True), "right", 0, 1))
    with pytest.raises(CalibrationError, match=r"parallel|tilt"):
        made.calibrate("radial")


def test_views_that_no_two_cameras_share_hide_no_other_error(paper: Any) -> None:
    """Windows of three such views have no solution, whatever the offset of the images."""
    first = sorted(paper.dots["view"].unique())[:3]
    made = paper.changed(
        lambda dots: dots[(dots["camera"] != "right") | ~dots["view"].isin(first)].reset_index(
            drop=True
        )
    )
    made = replace(made, nominal_rotvec_deg=None)
    with pytest.raises(CalibrationError, match="mirror"):
        made.calibrate("radial")


def copied(dots: pd.DataFrame, camera: str | None, noise_px: float) -> pd.DataFrame:
    """The first view of a camera, or of all, once more as the last view."""
    views = sorted(dots["view"].unique())
    again = dots[(dots["view"] == views[0]) & (dots["camera"].eq(camera) | (camera is None))]
    again = again.assign(view="copy")
    rng = np.random.default_rng(0)
    for column in ("u_px", "v_px"):
        again[column] += noise_px * rng.standard_normal(len(again))
    others = dots[(dots["view"] == views[1]) & (dots["camera"] != camera) & (camera is not None)]
    return pd.concat([dots, again, others.assign(view="copy")], ignore_index=True)


@pytest.mark.parametrize("camera", [None, "left"])
@pytest.mark.parametrize("noise_px", [0.0, 1e-4])
def test_a_copied_image_is_refused(camera: str | None, noise_px: float, paper: Any) -> None:
    made = paper.changed(lambda dots: copied(dots, camera, noise_px))
    with pytest.raises(CalibrationError, match=r"camera 'left' view .* copies of one image"):
        made.calibrate("radial")


def test_one_image_in_both_cameras_is_refused(paper: Any) -> None:
    def same(dots: pd.DataFrame) -> pd.DataFrame:
        left = dots[dots["camera"] == "left"]
        return pd.concat([left, left.assign(camera="right")], ignore_index=True)

    with pytest.raises(CalibrationError, match="copies of one image"):
        paper.changed(same).calibrate("radial")


def test_two_photographs_of_a_target_at_rest_are_no_copies(paper: Any) -> None:
    sigma = float(np.sqrt(paper.dots["suu_px2"].median() * 2))
    made = paper.changed(lambda dots: copied(dots, None, sigma))
    found = made.calibrate("radial")
    assert not objections(found.findings)


def exchanged(dots: pd.DataFrame) -> pd.DataFrame:
    return dots.assign(camera=dots["camera"].map({"left": "right", "right": "left"}))


@pytest.mark.parametrize("swapped", [False, True])
def test_exchanged_cameras_are_seen_where_their_nominal_scales_differ(
    swapped: bool, paper: Any
) -> None:
    """Two telecentric cameras that are exchanged fit as well: only their scales differ."""
    left = paper.cameras[0].with_parameters(scale_px_per_mm=10.6)
    made = replace(paper, cameras=(left, *paper.cameras[1:]))
    factor = {"left": 1.06, "right": 1.0}

    def scaled(dots: pd.DataFrame) -> pd.DataFrame:
        times = dots["camera"].map(factor)
        return dots.assign(u_px=dots["u_px"] * times, v_px=dots["v_px"] * times)

    made = made.changed(scaled)
    made = made.changed(exchanged) if swapped else made
    calibration = made.calibrate("radial")
    assert ("EXCHANGED" in codes(calibration)) == swapped
    assert "folders of the cameras were exchanged" in str(calibration.twin)


@pytest.mark.parametrize(("stated", "far"), [(1.2, []), (10.0, ["SCALE_FAR"] * 2)])
def test_a_target_in_another_unit_contradicts_the_stated_scales(
    stated: float, far: list[str], paper: Any
) -> None:
    """Images fit a target in cm as well; only the nominal scales are left to contradict it."""
    cameras = [
        camera.with_parameters(scale_px_per_mm=stated * camera["scale_px_per_mm"])
        for camera in paper.cameras
    ]
    calibration = replace(paper, cameras=cameras).calibrate("radial")
    assert [code for code in codes(calibration) if code == "SCALE_FAR"] == far
