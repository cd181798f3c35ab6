"""The centre of a projected disc against the area centroid of its projected rim."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from discs import polygon_centroid

import telerig
from telerig.estimator.calibration.solver.problem import (
    cameras_from_state,
    eccentricity_px,
    problem_from_dots,
)
from telerig.estimator.calibration.start import known_target
from telerig.io.simulation.presets import preset
from telerig.rig.lens_parameters import INDEX
from telerig.rig.pose import Pose
from telerig.rig.target import Target

pytestmark = pytest.mark.usefixtures("without_advice")


@pytest.mark.parametrize(
    "lens",
    [
        {"kappa_per_mm": 1 / 400},
        {"kappa_per_mm": -1e-4, "k1": 0.02, "p1": 1e-3},
        {"tilt_x": 0.1, "image_convergence_per_mm": 1 / 600},
    ],
    ids=["perspective", "distorted", "tilted"],
)
def test_against_the_rim(lens: dict[str, float], scene: Any) -> None:
    made = scene("paper", 3, views=3)
    problem = problem_from_dots(made.dots, made.cameras, made.target)
    state = known_target.stereo_states(problem, problem.nominal_mm)[0]
    intrinsics = state.intrinsics.copy()
    for name, value in lens.items():
        intrinsics[:, INDEX[name]] = value
    state = replace(state, intrinsics=intrinsics)
    shift = eccentricity_px(problem, state)
    cameras = cameras_from_state(problem, state)
    angle = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    largest = 0.0
    for i in range(0, len(problem.view), 7):
        dot = problem.dot[i]
        radius = problem.target.diameter_mm(problem.dot_ids[dot]) / 2
        pose = state.rig_from_target[problem.view[i]]
        place = Pose(pose[:3, :3], pose[:3, 3])
        camera = cameras[problem.camera[i]]
        rim = camera.project(place.apply(state.dots_mm[dot] + radius * circle))
        centre = camera.project(place.apply(state.dots_mm[dot][None]))[0]
        expected = polygon_centroid(rim) - centre
        np.testing.assert_allclose(shift[i], expected, atol=2e-5)
        largest = max(largest, float(np.linalg.norm(expected)))
    assert largest > 5e-4


def test_an_affine_camera_has_none(scene: Any) -> None:
    made = scene("paper", 3, views=3)
    problem = problem_from_dots(made.dots, made.cameras, made.target)
    state = known_target.stereo_states(problem, problem.nominal_mm)[0]
    np.testing.assert_allclose(eccentricity_px(problem, state), 0, atol=1e-9)


def test_results_hold_the_measured_centres_and_give_the_same_calibration_again(
    tmp_path: Path,
) -> None:
    """Calibrated again, an entocentric lens's dots would be corrected a second time."""
    paper = preset("paper")
    cameras = tuple(
        replace(
            c, parameters={**c.parameters, "kappa_per_mm": 1 / 150},
            nominal_telecentricity_per_mm=1 / 150,
        )
        for c in paper.cameras
    )  # fmt: skip
    data = telerig.simulate(
        replace(paper, cameras=cameras), rng=np.random.default_rng(3), out=tmp_path, images=False
    )
    given = tmp_path / "calibration" / "dots.csv"
    results = tmp_path / "results" / "calibration"
    first = telerig.calibrate(data, model="kappa")
    first.save(results)
    measured, dots, residuals = (
        pd.read_csv(f).sort_values(["view", "camera", "dot"])[["u_px", "v_px"]].to_numpy()
        for f in (given, results / "dots.csv", results / "residuals.csv")
    )
    np.testing.assert_array_equal(dots, measured)
    np.testing.assert_array_equal(residuals, measured)
    given.write_bytes((results / "dots.csv").read_bytes())
    again = telerig.calibrate(telerig.load_dataset(tmp_path), model="kappa")
    for one, other in zip(first.cameras, again.cameras):
        np.testing.assert_array_equal(one.intrinsics, other.intrinsics)
    residuals_are_of_discs(first, data.target)


def residuals_are_of_discs(calibration: telerig.Calibration, target: Target) -> None:
    """Residuals are measured less the centroid of the projected rim, not less the centre."""
    place = {dot: i for i, dot in enumerate(calibration.dot_ids.tolist())}
    angle = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    assert calibration.residuals is not None
    shifts = []
    for row in calibration.residuals.iloc[::17].itertuples():
        dot = calibration.target_points_mm[place[row.dot]]
        rim = dot + target.diameter_mm(np.array([row.dot])) / 2 * circle
        seen = calibration.target_poses[row.view].apply(np.r_[dot[None], rim])
        centre, *edge = calibration.project(row.camera, seen)
        centroid = polygon_centroid(np.array(edge))
        residual = np.array([row.u_px, row.v_px]) - centroid
        np.testing.assert_allclose([row.du_px, row.dv_px], residual, atol=5e-5)
        shifts.append(float(np.linalg.norm(centroid - centre)))
    assert max(shifts) > 0.02
