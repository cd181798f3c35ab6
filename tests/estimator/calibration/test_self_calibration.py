"""Self-calibration from tables of dots to a rig, against simulated truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from finding_codes import codes, only

from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.self_calibration import best_start
from telerig.estimator.calibration.solver.problem import problem_from_dots
from telerig.io.results.findings import Code
from telerig.io.simulation.presets import preset
from telerig.rig.camera import Camera

pytestmark = pytest.mark.usefixtures("without_advice")


@pytest.fixture(scope="module")
def paper(scene: Any) -> Any:
    return scene("paper", 1)


# --- what must work ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("preset", "model", "chosen", "limit_um"),
    [
        ("paper", "auto", {"radial"}, 1.0),
        ("near_telecentric", "auto", {"kappa+radial", "kappa+tangential"}, 1.2),
        ("scheimpflug", "auto", {"left=tilt+radial,right=affine+radial"}, 1.2),
        ("symmetric", "radial", {"radial"}, 1.0),
        ("two_sided", "radial", {"radial"}, 1.5),
    ],
)
def test_presets(preset: str, model: str, chosen: set[str], limit_um: float, scene: Any) -> None:
    made = scene(preset, 5)
    calibration = made.calibrate(model)
    assert calibration.verdict["status"] == "GOOD", calibration.report()
    assert calibration.model["name"] in chosen
    assert calibration.statistics["noise_floor_px"] == 0
    assert 0.8 < calibration.statistics["chi2_dof"] < 1.2
    assert calibration.statistics["share_kept"] > 0.99
    assert made.space_rms_um(calibration) < limit_um
    assert calibration.statistics["space_rms_um"] < 1.5 * calibration.statistics["space_sd_um"]
    assert calibration.twin["decided_by"] == "nominal rotation"


def test_unbounded_target(scene: Any) -> None:
    """Every view shows another part of a grid without an edge."""
    made = scene("unbounded", 2, views=5, margin_dots=1, shift_mm=(6.0, 6.0, 6.0))
    calibration = made.calibrate("radial")
    assert calibration.verdict["status"].startswith(("GOOD", "USABLE"))
    assert made.space_rms_um(calibration) < 1.5


def test_dense_target(scene: Any) -> None:
    """400 dots, of which every third row and column is measured."""
    made = scene("dense", 1, views=6)
    made = made.changed(lambda d: d[(d["row"] % 3 == 2) & (d["column"] % 3 == 2)])
    ends = made.target.id_from_row_column([5, 14], [5, 14])
    truth = [made.true_dots_mm[int(e)] for e in ends]
    target = replace(
        made.target,
        scale_dots=(int(ends[0]), int(ends[1])),
        scale_distance_mm=float(np.linalg.norm(truth[0] - truth[1])),
    )
    calibration = replace(made, target=target).calibrate("tangential")
    assert calibration.verdict["status"] == "GOOD", calibration.report()
    assert made.space_rms_um(calibration) < 1.0


@pytest.mark.parametrize(("scale_sigma_mm", "stretch"), [(1e-3, 5e-3), (0.01, 5e-3), (None, 1e-3)])
def test_the_scale_of_a_stretched_print(
    scale_sigma_mm: float | None, stretch: float, scene: Any
) -> None:
    """A printer made all dots lie farther from each other than they should.

    A known distance sets the scale; without one the scale is as good as a dot's place.
    """
    made = scene("dense", 1, views=4)
    pitch_mm = tuple(pitch / (1 + stretch) for pitch in made.target.pitch_mm)
    target = replace(made.target, pitch_mm=pitch_mm, print_sigma_mm=0.02)
    if scale_sigma_mm is None:
        target = replace(target, scale_dots=None, scale_distance_mm=None)
    else:
        target = replace(target, scale_sigma_mm=scale_sigma_mm)
    calibration = replace(made, target=target).calibrate("radial")
    for camera in calibration.cameras:
        truth = made.true_cameras[camera.name]["scale_px_per_mm"]
        error = camera["scale_px_per_mm"] - truth
        assert abs(error) < 3 * calibration.sd(f"{camera.name}.scale_px_per_mm")


def test_a_distance_measured_between_edges_is_no_longer_good(paper: Any) -> None:
    stated = paper.target.scale_distance_mm
    assert "DISTANCE_FAR" not in codes(paper.calibrate("radial"))
    wrong = replace(paper, target=replace(paper.target, scale_distance_mm=stated + 0.3))
    found = wrong.calibrate("radial")
    assert only(found, Code.DISTANCE_FAR).numbers["deviations"] == pytest.approx(10.6, abs=1)
    assert found.verdict["status"] == "USABLE, with warnings"


def test_the_relief_of_many_dots_does_not_make_the_target_smaller(scene: Any) -> None:
    rough = replace(preset("dense").target, print_sigma_mm=0.02, flatness_sigma_mm=0.02)
    made = scene("dense", 2, views=4, target=rough)
    target = replace(made.target, scale_dots=None, scale_distance_mm=None)
    calibration = replace(made, target=target).calibrate("radial")
    size = np.prod(calibration.statistics["target_stretch"]) ** 0.5
    assert size == pytest.approx(1.0, abs=5e-5)


def test_one_camera_with_few_dots(scene: Any) -> None:
    """No part of the image has enough dots to test for a pattern."""
    made = scene("paper", 3, views=1).changed(lambda d: d[d["camera"] == "left"])
    made = replace(made, cameras=made.cameras[:1], nominal_rotvec_deg=None)
    calibration = made.calibrate()
    assert "FEW_VIEWS" in codes(calibration)


def test_unknown_dots_of_another_shape(paper: Any) -> None:
    """The nominal table may be off by more than a millimetre: only its order matters."""
    rng = np.random.default_rng(0)
    ids = np.arange(15)
    wrong = paper.target.nominal_mm(ids)[:, :2] + rng.normal(0, 1.5, (15, 2))
    target = replace(paper.target, layout="points", points_mm=wrong, marks=(), print_sigma_mm=5.0)
    calibration = replace(paper, target=target).calibrate("radial")
    assert paper.space_rms_um(calibration) < 1.0


def one_camera(scene: Any) -> Any:
    mine = scene.dots["camera"] == "left"
    return replace(
        scene, dots=scene.dots[mine], cameras=scene.cameras[:1], nominal_rotvec_deg=None,
        outlier=scene.outlier[mine.to_numpy()],
    )  # fmt: skip


def test_one_camera(scene: Any) -> None:
    """The tilts' signs follow from the dots' relief: with wrong ones the floor is 0.1 px."""
    made = one_camera(scene("paper", 0, outlier_share=0.03))
    calibration = made.calibrate("radial")
    s = calibration.statistics
    assert s["noise_floor_px"] == 0
    assert s["chi2_dof"] < 1.25
    np.testing.assert_array_equal(made.weights(calibration) < 1, made.outlier)
    left = calibration.cameras[0]
    truth = made.true_cameras["left"]
    assert abs(left["scale_px_per_mm"] - truth["scale_px_per_mm"]) < 4 * calibration.sd(
        "left.scale_px_per_mm"
    )
    with pytest.raises(CalibrationError, match="one camera cannot triangulate"):
        calibration.triangulate(np.zeros(2), np.zeros(2))


def test_views_of_one_camera_only(scene: Any) -> None:
    made = scene("paper", 3, single_camera_views=6)
    calibration = made.calibrate("radial")
    assert calibration.statistics["share_kept"] == 1
    assert calibration.statistics["noise_floor_px"] == 0
    assert made.space_rms_um(calibration) < 1.0
    assert calibration.verdict["status"] == "USABLE, with warnings"
    assert sum(len(f.views) for f in calibration.findings if f.code is Code.ONE_CAMERA) == 6


@pytest.mark.parametrize(("preset", "seed"), [("paper", 0), ("near_telecentric", 1)])
def test_outliers(preset: str, seed: int, scene: Any) -> None:
    """5 % of the dots are off by 20 px: all are found, no other is blamed."""
    made = scene(preset, seed, outlier_share=0.05)
    assert made.outlier.sum() > 10
    model = "radial" if preset == "paper" else "kappa+radial"
    calibration = made.calibrate(model)
    np.testing.assert_array_equal(made.weights(calibration) < 1, made.outlier)
    assert calibration.statistics["noise_floor_px"] == 0
    assert made.space_rms_um(calibration) < 1.2
    named = calibration.residuals.loc[calibration.residuals["weight"] < 1, "reason"]
    assert named.str.contains("standard deviations").all()


def test_the_user_says_how_far_off_a_dot_may_be(paper: Any) -> None:
    """One dot 4 standard deviations away stays by default, and is left out at a limit of 3.4."""
    sound = paper.calibrate("radial")
    row = 40
    sigma = np.sqrt(paper.dots["suu_px2"].iloc[row])
    off = sound.residuals["du_px"].iloc[row]
    moved = paper.changed(lambda d: _shifted(d, row, 4.6 * sigma * np.sign(off) - off))
    usual, strict = moved.calibrate("radial"), moved.calibrate("radial", outlier_sd=3.4)
    left = strict.residuals[strict.residuals["weight"] < 1]
    assert (usual.residuals["weight"] == 1).all()
    assert left.index.tolist() == [row]
    assert "limit 3.4" in left["reason"].iloc[0]
    for wrong in (2.0, np.nan, np.inf):
        with pytest.raises(InputError, match="cannot be distinguished"):
            paper.calibrate("radial", outlier_sd=wrong)


def _shifted(dots: pd.DataFrame, row: int, by_px: float) -> pd.DataFrame:
    dots.iloc[row, dots.columns.get_loc("u_px")] += by_px
    return dots


def test_a_fifth_of_outliers_is_found_but_rejected(scene: Any) -> None:
    made = scene("paper", 1, outlier_share=0.2, views=8)
    calibration = made.calibrate("radial")
    np.testing.assert_array_equal(made.weights(calibration) < 1, made.outlier)
    assert calibration.verdict["status"] == "REJECTED"
    assert "FEW_KEPT" in codes(calibration)
    assert made.space_rms_um(calibration) < 1.0


def test_it_is_deterministic(paper: Any) -> None:
    """To the last bit, whatever the order of the rows."""
    once = paper.calibrate("auto")
    again = paper.changed(lambda d: d.sample(frac=1, random_state=1)).calibrate("auto")
    for x, y in zip(once.cameras, again.cameras):
        np.testing.assert_array_equal(x.intrinsics, y.intrinsics)
    np.testing.assert_array_equal(once.joint_covariance, again.joint_covariance)
    assert once.report() == again.report()


def test_the_start_does_not_need_the_nominal_scale(paper: Any) -> None:
    far = [Camera.create(c.name, c.image_size_px, 14.0, rho_mm=c.rho_mm) for c in paper.cameras]
    calibration = replace(paper, cameras=far).calibrate("radial")
    assert paper.space_rms_um(calibration) < 1.0


@pytest.mark.parametrize("dots_free", ["3d", "plane", "nominal"])
def test_what_dots_may_do(dots_free: str, scene: Any) -> None:
    """20 µm off in the plane and out of it: held dots show in the residuals and in space."""
    made = scene("paper", 2)
    calibration = made.calibrate("radial", dots_free=dots_free)
    error = made.space_rms_um(calibration)
    assert (error > 2.0) == (dots_free == "nominal")
    assert (calibration.statistics["noise_floor_px"] > 0.03) == (dots_free != "3d")
    unused = [f for f in calibration.findings or () if f.code.name == "DISTANCE_UNUSED"]
    assert len(unused) == (dots_free == "nominal")
    assert all(f.numbers["stated_mm"] == made.target.scale_distance_mm for f in unused)


# --- the mirror twin --------------------------------------------------------------------------


def test_the_nominal_side_decides(paper: Any) -> None:
    right, wrong = (paper.calibrate("radial", nominal_rotvec_deg=(0, a, 0)) for a in (70.0, -70.0))
    assert right.statistics["cost"] == pytest.approx(wrong.statistics["cost"], rel=1e-9)
    points = np.random.default_rng(0).uniform(-10, 10, (50, 3))
    pixels = [right.project(c, points) for c in (0, 1)]
    mirrored = wrong.triangulate(*pixels).points_mm
    np.testing.assert_allclose(mirrored, points * [1, 1, -1], atol=1e-6)


@pytest.mark.parametrize("rotvec", [(0.0, 0.0, 0.0), (0.0, 180.0, 0.0), (90.0, 0.0, 0.0)])
def test_a_tie_is_an_error(rotvec: Any, scene: Any) -> None:
    few = scene("paper", 1, views=4)
    with pytest.raises(
        CalibrationError, match=r"mirror solutions are \d+ and \d+ degrees.*too similar"
    ):
        few.calibrate("radial", nominal_rotvec_deg=rotvec)


def test_no_nominal_rotation_is_an_error(scene: Any) -> None:
    with pytest.raises(CalibrationError, match="both mirror solutions fit equally well"):
        scene("paper", 1, views=4).calibrate("radial", nominal_rotvec_deg=None)


def test_the_plate_of_a_two_sided_target_decides(scene: Any) -> None:
    made = scene("two_sided", 1, outlier_share=0.03, views=6)
    alone = made.calibrate("radial", nominal_rotvec_deg=None)
    assert alone.twin["decided_by"] == "refraction in the plate"
    assert made.space_rms_um(alone) < 1.5
    with pytest.raises(CalibrationError, match="refraction in the two-sided plate"):
        made.calibrate("radial", nominal_rotvec_deg=(0, -150, 0))


@pytest.mark.parametrize("seed", [3, 5, 6, 9, 109])
def test_a_few_wrong_dots_do_not_decide_which_side_of_the_plate_carries_them(
    seed: int, scene: Any
) -> None:
    """They cost more than the wrong side does, which leaves 0.1-0.3 px in all others."""
    made = scene("two_sided", seed)
    rng = np.random.default_rng(seed)
    bad = (rng.random(len(made.dots)) < 0.03)[:, None]
    u, v = (made.dots[["u_px", "v_px"]] + 60 * bad * rng.standard_normal((len(bad), 2))).T.values
    exact, spoilt = (
        problem_from_dots(dots, made.cameras, made.target)
        for dots in (made.dots, made.dots.assign(u_px=u, v_px=v))
    )
    right, found = (best_start(p, p.nominal_mm)[0] for p in (exact, spoilt))
    np.testing.assert_array_equal(found.plate_shift, right.plate_shift)
    assert np.all(found.weight == 1)


def test_strong_perspective_decides_and_contradicts(scene: Any) -> None:
    """Lenses of 400 mm working distance: farther is smaller, in one of the twins only."""
    made = scene("paper", 2, views=7)
    cameras = []
    for c in made.true_cameras.values():
        cameras.append(c.with_parameters(kappa_per_mm=1 / 400, k1=0.0))
    rows = []
    for name, view in made.true_views.items():
        for camera in cameras:
            ids = np.array(list(made.true_dots_mm))
            points = view.rig_from_target.apply(np.array(list(made.true_dots_mm.values())))
            uv = camera.project(points)
            rows.append(pd.DataFrame({"view": name, "camera": camera.name, "dot": ids,
                                      "u_px": uv[:, 0], "v_px": uv[:, 1]}))  # fmt: skip
    dots = pd.concat(rows, ignore_index=True)
    rng = np.random.default_rng(1)
    dots[["u_px", "v_px"]] += 0.01 * rng.standard_normal((len(dots), 2))
    dots = dots.assign(suu_px2=1e-4, svv_px2=1e-4, suv_px2=0.0)
    lens = made.with_dots(dots)
    calibration = lens.calibrate("auto", nominal_rotvec_deg=None)
    assert calibration.twin["decided_by"] == "perspective"
    assert calibration.twin["other_cost"] == pytest.approx(calibration.twin["cost"], rel=0.05)
    truth = {c.name: c for c in cameras}
    assert replace(lens, true_cameras=truth).space_rms_um(calibration) < 1.5
    with pytest.raises(CalibrationError, match="perspective of the lenses"):
        lens.calibrate("auto", nominal_rotvec_deg=(0, -90, 0))
    telecentric = lens.calibrate("radial")
    assert telecentric.verdict["status"] == "REJECTED"
    assert "MODEL_FAILS" in codes(telecentric)


def test_outliers_leave_no_trace_in_the_dots_eccentricity(scene: Any) -> None:
    """The correction comes from a fit of its own, which must not see them either."""
    made = scene("paper", 3, outlier_share=0.05)
    sound = made.with_dots(made.dots[~made.outlier])
    found, expected = made.calibrate("auto"), sound.calibrate("auto")
    for camera in ("left", "right"):
        for name in ("scale_px_per_mm", "k1"):
            key = f"{camera}.{name}"
            pair = [next(c for c in k.cameras if c.name == camera)[name] for k in (found, expected)]
            assert abs(pair[0] - pair[1]) < 0.2 * expected.sd(key), key


@pytest.mark.parametrize("more_px", [0.0, 0.015])
def test_noise_floor_with_dots_that_are_well_known(scene: Any, more_px: float) -> None:
    """A dot whose prior fixes it takes no degrees of freedom from the images."""
    paper = preset("paper")
    target = replace(
        paper.target, rows=16, columns=16, pitch_mm=(2.0, 2.0), dot_diameter_mm=1.0,
        mark_diameter_mm=1.4, print_sigma_mm=1e-4, flatness_sigma_mm=1e-4, scale_dots=None,
        scale_distance_mm=None,
    )  # fmt: skip
    made = scene("paper", 0, target=target, views=8, cameras=paper.cameras[:1])
    noise = more_px * np.random.default_rng(0).standard_normal((len(made.dots), 2))
    moved = made.dots[["u_px", "v_px"]] + noise
    calibration = made.with_dots(made.dots.assign(**moved)).calibrate("radial")
    assert calibration.statistics["noise_floor_px"] == pytest.approx(more_px, rel=0.05)
    assert calibration.statistics["chi2_dof"] == pytest.approx(1, abs=0.06)
    assert calibration.verdict["status"] == "GOOD" or more_px


def test_one_row_of_the_target_does_not_place_it(paper: Any) -> None:
    """Seen by both cameras, it was taken for a target at 90 degrees and lost its sound dots."""
    views = sorted(paper.dots["view"].unique())
    row = int(paper.dots["row"].median())
    found = paper.changed(lambda d: d[(d["view"] != views[2]) | (d["row"] == row)]).calibrate(
        "radial"
    )
    left = found.residuals[found.residuals["weight"] == 0]
    assert set(left["view"]) == {views[2]} and (left["row"] == row).all()
    assert only(found, Code.UNUSED_VIEWS).views == (views[2],)
    assert len(found.residuals) - len(left) == (paper.dots["view"] != views[2]).sum()


def test_a_row_beside_the_whole_target_in_the_other_camera_counts(paper: Any) -> None:
    views = sorted(paper.dots["view"].unique())
    row = int(paper.dots["row"].median())
    found = paper.changed(
        lambda d: d[(d["view"] != views[2]) | (d["camera"] != "left") | (d["row"] == row)]
    ).calibrate("radial")
    assert (found.residuals["weight"] == 1).all()
    assert paper.space_rms_um(found) < 1.0
