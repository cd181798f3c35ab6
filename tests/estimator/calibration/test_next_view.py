"""The next best view: is what it promises what a calibration with that view has, and is it sane?"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from telerig.estimator.calibration.next_view import (
    Candidates,
    NextView,
    candidates,
    dots_seen,
    first_views,
    hold_words,
    next_view,
)
from telerig.estimator.calibration.solver.covariance import joint_covariance
from telerig.estimator.calibration.solver.problem import cameras_from_state, held_at_nominal
from telerig.estimator.calibration.solver.robust_least_squares import solve
from telerig.factors.calibration import State, pixels
from telerig.io.report.calibration.report import write_calibration_report
from telerig.io.simulation.images.plates import Plate, pixel_from_plate
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.triangulation import aligned_covariance, working_volume


def fitted(scene: Any, model: str = "radial") -> tuple[Any, Any, Any]:
    """Problem, state and covariance of a scene, without the search for a model."""
    from telerig.estimator.calibration.self_calibration import best_start
    from telerig.estimator.calibration.solver.problem import problem_from_dots

    problem = problem_from_dots(scene.dots, scene.cameras, scene.target)
    problem, start = best_start(problem, problem.nominal_mm)
    turn = start.rig_from_camera[1, :3, :3].T
    nominal = rotation_from_rotvec(np.radians(scene.nominal_rotvec_deg))
    if np.trace(turn.T @ nominal) < 2.8:
        from telerig.estimator.calibration.start.mirror_ambiguity import mirrored_state

        start = mirrored_state(start)
    problem = problem.with_model(model)
    solution = solve(problem, held_at_nominal(problem, start))
    return problem, solution.state, joint_covariance(problem, solution)


def space_sd_um(problem: Any, state: State, joint: Any) -> float:
    cameras = cameras_from_state(problem, state)
    points = working_volume(cameras)
    _, covariance = joint.rig_block()
    shared = aligned_covariance((cameras[0], cameras[1]), problem.free, covariance, points)
    return float(1e3 * np.sqrt(np.trace(shared) / points.size))


def with_view(problem: Any, state: State, pose: Any) -> tuple[Any, State]:
    """The problem with one more view whose pixels are those predicted."""
    count, dots = len(problem.views), np.arange(len(problem.dot_ids))
    more = {
        "view": np.full(2 * len(dots), count),
        "camera": np.repeat([0, 1], len(dots)),
        "dot": np.tile(dots, 2),
        "covariance_px2": np.tile(np.median(problem.covariance_px2, 0), (2 * len(dots), 1, 1)),
        "weight": np.ones(2 * len(dots)),
        "uv_px": np.zeros((2 * len(dots), 2)),
        "eccentricity_px": np.zeros((2 * len(dots), 2)),
    }
    shift = np.r_[problem.plate_shift, np.zeros((1, 2))]
    grown = replace(
        problem, views=(*problem.views, "next"), plate_shift=shift,
        **{k: np.concatenate([getattr(problem, k), v]) for k, v in more.items()},
    )  # fmt: skip
    poses = np.r_[state.rig_from_target, pose[None]]
    state = replace(state, rig_from_target=poses)
    uv = grown.uv_px.copy()
    new = grown.view == count
    uv[new] = pixels(state, grown.unweighted(), grown.rho_mm)[new]
    radius = problem.target.diameter_mm(problem.dot_ids)[grown.dot] / 2 * 10.0
    room = np.minimum(uv, np.array(problem.cameras[0].image_size_px) - 1 - uv).min(-1)
    seen = ~new | (room >= radius + 0.03 * 512)
    return replace(grown, uv_px=uv).subset(seen), state


@pytest.mark.parametrize("model", ["none", "kappa+tangential"])
def test_the_promise_is_the_covariance_of_a_fit_with_that_view(scene: Any, model: str) -> None:
    problem, state, joint = fitted(scene("paper", 3, views=6), model)
    advice = next_view(problem, state, joint)
    assert advice is not None
    assert advice.before_um == pytest.approx(space_sd_um(problem, state, joint), rel=1e-9)
    for pose in advice.poses[:2]:
        grown, start = with_view(problem, state, pose.rig_from_target)
        solution = solve(grown, start)
        after = space_sd_um(grown, solution.state, joint_covariance(grown, solution))
        assert pose.after_um == pytest.approx(after, rel=2e-4)
        assert after < advice.before_um


@pytest.mark.slow
def test_the_advice_beats_views_at_random(scene: Any) -> None:
    """Against the 60 random views of six other datasets of the same rig."""
    problem, state, joint = fitted(scene("paper", 3, views=6))
    advice = next_view(problem, state, joint)
    assert advice is not None
    others = scene("paper", 5, views=10).true_views.values()
    gains = []
    for view in others:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = (
            view.rig_from_target.rotation,
            view.rig_from_target.translation_mm,
        )
        grown, start = with_view(problem, state, pose)
        after = space_sd_um(grown, start, joint_covariance(grown, solve(grown, start)))
        gains.append(advice.before_um - after)
    best = advice.before_um - advice.after_um
    assert best > np.max(gains)
    assert best > 1.5 * np.median(gains)


@pytest.mark.parametrize("preset", ["paper", "two_sided", "dense"])
def test_both_cameras_really_see_every_candidate(scene: Any, preset: str) -> None:
    problem, state, _ = fitted(scene(preset, 1, views=6))
    found = candidates(problem, state)
    assert len(found) > 40
    cameras = cameras_from_state(problem, state)
    glass = problem.target.plate_thickness_mm if problem.target.two_sided else 0.0
    plate = Plate(
        state.dots_mm, np.ones(len(state.dots_mm)), np.zeros(1), thickness_mm=glass,
        index=problem.target.plate_index,
    )  # fmt: skip
    every = np.arange(len(state.dots_mm))
    for k in range(0, len(found), 1 + len(found) // 40):
        matrix = found.rig_from_target[k]
        pose = Pose(matrix[:3, :3], matrix[:3, 3])
        visible, uv = (a[0] for a in dots_seen(problem, state, found.some([k]), every))
        for c, camera in enumerate(cameras):
            z = camera.camera_from_rig.rotation @ matrix[:3, 2]
            assert problem.target.two_sided or z[2] > 0.4
            assert abs(z[2]) > np.cos(np.radians(77 if problem.target.two_sided else 65.1))
            assert visible[c].mean() > 0.6
            exact = pixel_from_plate(camera, pose, state.dots_mm, plate)
            assert np.all(
                (exact[visible[c]] > 15) & (exact[visible[c]] < camera.image_size_px[0] - 16)
            )
            assert np.abs(exact - uv[c]).max() < 0.2


def test_small_tilts_are_advised_to_grow(scene: Any) -> None:
    flat = scene("paper", 2, views=8, angle_deg=20.0, tilt_deg=(5.0, 15.0))
    problem, state, joint = fitted(flat)
    advice = next_view(problem, state, joint)
    assert advice is not None and not advice.enough()
    best = advice.poses[0]
    axes = state.rig_from_camera[:, :3, 2]
    tilt = np.degrees(np.arccos(np.abs(axes @ best.rig_from_target[:3, 2])))
    assert tilt.max() > 40
    assert any("so far 15 at most" in r or "so far 14 at most" in r for r in best.reasons)
    assert advice.gain > 0.2


def test_an_empty_corner_is_filled(scene: Any) -> None:
    def without_corner(dots: Any) -> Any:
        gone = (dots["camera"] == "left") & (dots["u_px"] < 256) & (dots["v_px"] < 256)
        return dots[~gone]

    problem, state, joint = fitted(scene("paper", 4, views=12).changed(without_corner))
    advice = next_view(problem, state, joint)
    assert advice is not None
    assert any("the empty upper left" in r and "camera left" in r for r in advice.poses[0].reasons)
    every = np.arange(len(problem.dot_ids))
    pose = advice.poses[0].rig_from_target[None]
    best = _one(pose)
    visible, uv = dots_seen(problem, state, best, every)
    left = uv[0, 0][visible[0, 0]]
    assert np.any((left < 200).all(-1))


def _one(pose: Any) -> Candidates:
    """One pose (4, 4) of a plate whose front two cameras see."""
    two = np.ones((1, 2))
    return Candidates(
        np.reshape(pose, (1, 4, 4)), two, np.zeros(1, int), two > 0, np.array([[0, 1]])
    )


@pytest.mark.parametrize("azimuth_deg", range(5, 360, 25))
def test_words_for_a_second_camera_anywhere_round_the_first(azimuth_deg: float) -> None:
    """Above, below or beside: the edge that goes back is the one that is farther from both."""
    azimuth, angle = np.radians(azimuth_deg), np.radians(60.0)
    second = np.array([np.cos(azimuth) * np.sin(angle), np.sin(azimuth) * np.sin(angle), 0.5])
    cameras = np.tile(np.eye(4), (2, 1, 1))
    cameras[1, :3, 2] = second
    problem: Any = SimpleNamespace(
        cameras=[Camera.create("a", (512, 512), 10.0), Camera.create("b", (512, 512), 10.0)],
        target=SimpleNamespace(two_sided=False, layout="grid"),
        view=np.zeros(1, int), kept=np.ones(1, bool),
    )  # fmt: skip
    z = second + [0, 0, 1]
    across = np.cross([0.0, 0.0, 1.0], second)
    for lean in (-30.0, 30.0):
        axis = np.cross(z / np.linalg.norm(z), across / np.linalg.norm(across))
        normal = rotation_from_rotvec(np.radians(lean) * axis) @ (z / np.linalg.norm(z))
        x = np.cross([0.0, 1.0, 0.0], normal)
        x /= np.linalg.norm(x)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([x, np.cross(normal, x), normal], 1)
        state = State(np.zeros((2, 20)), cameras, pose[None], np.zeros((1, 3)))
        words = hold_words(problem, state, _one(pose))
        assert "turn it" not in words
        edge, back = re.search(r"tilt its (.+) 30 degrees (back|forward)", words).groups()  # type: ignore[union-attr]
        along = [0.0, -1.0] if edge == "top" else [1.0, 0.0]
        walk = pose[:3, :2] @ np.linalg.solve(pose[:2, :2], along)
        assert (walk @ z > 0) == (back == "back")


def test_enough_is_said_with_its_reason() -> None:
    from telerig.io.results.calibration import NextPose

    def advice(views: int, before: float, after: float) -> NextView:
        pose = NextPose(rig_from_target=np.eye(4), after_um=after, words="so", reasons=("why",))
        return NextView(views, before, (pose,))

    assert advice(12, 0.36, 0.35).enough()
    assert advice(12, 0.36, 0.35).words().endswith("from 0.36 to 0.35 µm: these views are enough")
    assert not advice(5, 0.36, 0.35).enough()
    assert not advice(12, 0.36, 0.30).enough()
    assert advice(12, 0.36, 0.30).words().endswith("Next: so (why)")
    assert "0.361 to 0.359" in advice(12, 0.361, 0.359).verdict()
    nowhere = NextView(8, 0.4, ())
    assert not nowhere.enough()
    assert "no further pose was found" in nowhere.words()


def test_one_camera_gets_no_advice(scene: Any) -> None:
    one = scene("paper", 1)
    alone = one.dots[one.dots["camera"] == "left"]
    calibration = replace(one, dots=alone, cameras=one.cameras[:1], nominal_rotvec_deg=None)
    assert calibration.calibrate().diagnostics["next_view"] == {}


def test_first_views_differ_and_keep_to_what_both_cameras_see() -> None:
    words = first_views("left", "right", 90.0)
    assert len(set(words)) == len(words) == 6
    assert "turn it 10 degrees towards camera left" in words[3]
    assert "turn it" not in " ".join(first_views("left", "right", 125.0))


def test_the_report_draws_it(scene: Any, tmp_path: Path) -> None:
    """In words and two pictures; every dot of the plate is inside both."""
    found = scene("paper", 1, views=6).calibrate()
    found.save(tmp_path)
    page = write_calibration_report(tmp_path).read_text()
    advice = found.diagnostics["next_view"]
    assert '<section id="next">' in page and advice["poses"][0]["words"] in page
    for title in ("Next view, camera left", "Next view, camera right", "Where to hold it next"):
        assert page.count(f"<h3>{title}</h3>") == 1
    pose = np.array(advice["poses"][0]["rig_from_target"])
    points = found.target_points_mm @ pose[:3, :3].T + pose[:3, 3]
    for camera in found.cameras:
        assert np.all(np.abs(camera.project(points) - 255.5) < 256)
