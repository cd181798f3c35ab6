"""Travel axis and encoder scale from views of a static target, against truth and Monte Carlo."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from discs import polygon_centroid
from finding_codes import codes, only

from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.calibration.stage_axis import StageAxis, stage_axis_of
from telerig.io.results.findings import Code
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.target import Target

pytestmark = pytest.mark.usefixtures("without_advice")

AXIS = np.array([0.03, -0.999, 0.02]) / np.linalg.norm([0.03, -0.999, 0.02])
READINGS = np.linspace(-15.0, 15.0, 11)
SIGMA_PX = 0.02
TARGET = Pose(rotation_from_rotvec([0.2, -0.75, 0.1]), np.array([1.0, -2.0, 3.0]))
POINTS = Target(rows=3, columns=5, pitch_mm=(7.0, 7.0), dot_diameter_mm=1e-3)
PLACES = np.array([[7.0 * c - 14, 7.0 * r - 7, 0.0] for r in range(3) for c in range(5)])


def calibration_of(**lens: float) -> Calibration:
    angle = np.deg2rad(80.0)
    turn = rotation_from_rotvec([0.0, angle, 0.0])
    size = (900, 900)
    pair = (
        Camera.create("left", size, 10.0, **lens),
        Camera.create("right", size, 10.2, camera_from_rig=Pose(turn, np.zeros(3)), **lens),
    )
    return Calibration(
        pair, np.arange(15), PLACES, {}, np.zeros((6, 6)), ("",) * 6, ((), ()), "test"
    )


CALIBRATION = calibration_of()


def views(
    rng: np.random.Generator,
    *,
    calibration: Calibration = CALIBRATION,
    scale: float = 0.01,
    sigma_px: float = SIGMA_PX,
    reading_sigma_mm: float = 0.001,
    wander_mm: float = 0.0,
    places: Any = PLACES,
) -> tuple[pd.DataFrame, dict[str, float]]:
    """Dots at each stop: travel = reading / (1 + scale), errors of the carriage added."""
    parts, positions = [], {}
    for v, stop in enumerate(READINGS):
        travel = stop / (1 + scale)
        wander = wander_mm * rng.standard_normal(3)
        place = travel * AXIS + wander - AXIS * (AXIS @ wander)
        positions[f"v{v}"] = stop + reading_sigma_mm * rng.standard_normal()
        points = TARGET.apply(places) - place
        for camera in calibration.cameras:
            uv = camera.project(points) + sigma_px * rng.standard_normal((len(points), 2))
            parts.append(
                pd.DataFrame({"view": f"v{v}", "camera": camera.name, "dot": np.arange(15),
                              "u_px": uv[:, 0], "v_px": uv[:, 1], "sigma_px": sigma_px or 0.02})
            )  # fmt: skip
    return pd.concat(parts, ignore_index=True), positions


def tangent_error(found: StageAxis) -> Any:
    """(3,) axis in the found tangent basis, and scale: truth 1 %."""
    return np.array([*(found.basis.T @ AXIS), 0.01 - found.scale])


@pytest.mark.parametrize("lens", [{}, {"kappa_per_mm": 1e-3, "k1": -3e-3}])
def test_exact_without_noise(lens: dict[str, float]) -> None:
    calibration = calibration_of(**lens)
    table, positions = views(
        np.random.default_rng(1), calibration=calibration, sigma_px=0.0, reading_sigma_mm=0.0
    )
    found = stage_axis_of(calibration, POINTS, table, positions)
    np.testing.assert_allclose(found.axis_rig, AXIS, atol=1e-10)
    assert found.scale == pytest.approx(0.01, abs=1e-10)
    np.testing.assert_allclose(found.rig_from_target.rotation, TARGET.rotation, atol=1e-9)
    np.testing.assert_allclose(found.rig_from_target.translation_mm, [1, -2, 3], atol=1e-8)
    np.testing.assert_allclose(found.basis.T @ np.c_[found.basis, AXIS], np.eye(2, 3), atol=1e-9)


@pytest.mark.parametrize(
    "turned", ["right", "left right", "left right of v3", "right of v0", "nothing"]
)
def test_a_target_without_marks_has_the_numbers_of_the_calibration(turned: str) -> None:
    """Every image of it is numbered after either of two turns."""
    rng = np.random.default_rng(6)
    printed = PLACES + [0.02, 0.02, 0.0] * rng.standard_normal(PLACES.shape)
    calibration = replace(CALIBRATION, target_points_mm=printed)
    table, positions = views(rng, places=printed)
    right = stage_axis_of(calibration, POINTS, table, positions)
    assert abs(right.scale - 0.01) < 4 * right.scale_sd < 2e-4
    cameras, _, view = turned.partition(" of ")
    mine = table["camera"].isin(cameras.split()) & (table["view"].eq(view) | (view == ""))
    table.loc[mine, "dot"] = 14 - table.loc[mine, "dot"]
    found = stage_axis_of(calibration, POINTS, table, positions)
    assert found.scale == pytest.approx(right.scale, abs=1e-9)
    np.testing.assert_allclose(found.joint_covariance, right.joint_covariance, rtol=1e-6)
    assert "STAGE_OUTLIERS" not in codes(found)


@pytest.mark.parametrize("draws", [16, pytest.param(100, marks=pytest.mark.slow)])
def test_covariance_equals_the_monte_carlo_spread(draws: int) -> None:
    """Squared errors over the stated covariance are chi-square with 3 degrees of freedom."""
    rng = np.random.default_rng(5)
    found = [stage_axis_of(CALIBRATION, POINTS, *views(rng)) for _ in range(draws)]
    for one in found:
        assert one.scale == pytest.approx(0.01, abs=4 * one.scale_sd)
        assert one.scale_sd < 5e-5
        assert 0.6 < one.chi2_dof < 1.5
    errors = np.array([tangent_error(f) for f in found])
    scores = [e @ np.linalg.solve(f.joint_covariance, e) for e, f in zip(errors, found)]
    assert np.mean(scores) == pytest.approx(3.0, abs=4 * np.sqrt(6 / draws))
    assert np.std(errors[:, 2]) == pytest.approx(found[0].scale_sd, rel=2.5 / draws**0.5)
    assert found[0].scale_sd == pytest.approx(np.sqrt(found[0].joint_covariance[2, 2]))


def test_the_calibrations_uncertainty_is_carried_in() -> None:
    """Scales known to 1e-3 of both cameras, alike, make the travel and so the scale uncertain."""
    unsure = replace(
        CALIBRATION,
        free=(("scale_px_per_mm",), ("scale_px_per_mm",)),
        covariance=np.zeros((8, 8)),
    )
    both = np.array([10.0, 10.2]) * 1e-3
    unsure.covariance[:2, :2] = np.outer(both, both)
    table, positions = views(np.random.default_rng(2))
    sure = stage_axis_of(CALIBRATION, POINTS, table, positions)
    found = stage_axis_of(unsure, POINTS, table, positions)
    assert np.sqrt(found.scale_sd**2 - sure.scale_sd**2) == pytest.approx(1.01e-3, rel=0.02)
    assert found.scale == sure.scale


def test_outliers_and_a_wrong_reading() -> None:
    table, positions = views(np.random.default_rng(3))
    clean = stage_axis_of(CALIBRATION, POINTS, table, positions)
    rng = np.random.default_rng(4)
    hit = rng.choice(len(table), 10, replace=False)
    table.loc[hit, "u_px"] += 15.0
    positions["v5"] += 0.5
    found = stage_axis_of(CALIBRATION, POINTS, table, positions)
    assert found.scale == pytest.approx(0.01, abs=1.5e-4)
    assert abs(found.scale - clean.scale) < 4 * clean.scale_sd
    wrong = only(found, Code.WRONG_READING)
    assert wrong.views == ("v5",) and 0.49 < wrong.numbers["error_mm"] < 0.50
    assert only(found, Code.STAGE_OUTLIERS).numbers == {"count": 10, "dots": 330}


@pytest.mark.parametrize("draws", [10, pytest.param(40, marks=pytest.mark.slow)])
def test_a_stage_that_wanders_says_so(draws: int) -> None:
    """5 µm across and 5 µm in the reading, 1 µm stated: the covariance grows to cover it."""
    rng = np.random.default_rng(6)
    scores, told = [], 0
    for _ in range(draws):
        table, positions = views(rng, reading_sigma_mm=0.005, wander_mm=0.005)
        found = stage_axis_of(CALIBRATION, POINTS, table, positions)
        error = tangent_error(found)
        scores.append(error @ np.linalg.solve(found.joint_covariance, error))
        told += "CARRIAGE_WANDERS" in codes(found)
    assert told > 0.8 * draws
    assert np.median(scores) < 5.0


def test_dots_are_discs() -> None:
    """The centre of a disc's image is not the image of its centre where a lens is distorted."""
    calibration = calibration_of(kappa_per_mm=2e-3, k1=-0.02)
    angle = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    rim = 2.5 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    rows = []
    for v, stop in enumerate(READINGS):
        for camera in calibration.cameras:
            for dot, place in enumerate(PLACES):
                edge = camera.project(TARGET.apply(place + rim) - stop / 1.01 * AXIS)
                rows.append((f"v{v}", camera.name, dot, *polygon_centroid(edge)))
    table = pd.DataFrame(rows, columns=["view", "camera", "dot", "u_px", "v_px"])
    positions = {f"v{v}": stop for v, stop in enumerate(READINGS)}
    found, as_points = (
        stage_axis_of(calibration, target, table, positions)
        for target in (replace(POINTS, dot_diameter_mm=5.0), POINTS)
    )
    assert abs(found.scale - 0.01) < 1e-7
    assert abs(as_points.scale - 0.01) > 1e-5
    np.testing.assert_allclose(found.axis_rig, AXIS, atol=1e-7)


def test_what_cannot_be_used() -> None:
    table, positions = views(np.random.default_rng(1))
    with pytest.raises(InputError, match="view 'v3' has no position"):
        stage_axis_of(CALIBRATION, POINTS, table, {k: v for k, v in positions.items() if k != "v3"})
    with pytest.raises(InputError, match="did you mean left"):
        stage_axis_of(CALIBRATION, POINTS, table.replace({"camera": {"left": "lefd"}}), positions)
    with pytest.raises(CalibrationError, match="one camera"):
        stage_axis_of(CALIBRATION, POINTS, table[table["camera"] == "left"], positions)
    with pytest.raises(CalibrationError, match="not enough to measure the travel"):
        stage_axis_of(CALIBRATION, POINTS, table[table["view"] == "v3"], positions)
    twice = pd.DataFrame({"view": ["v1", "v1"], "position_mm": [0.0, 1.0]})
    with pytest.raises(InputError, match="two positions"):
        stage_axis_of(CALIBRATION, POINTS, table, twice)
    with pytest.raises(InputError, match="not a finite number"):
        stage_axis_of(CALIBRATION, POINTS, table, positions | {"v2": np.nan})
    extra = pd.concat([table, table.iloc[:4].assign(dot=77)])
    found = stage_axis_of(CALIBRATION, POINTS, extra, positions)
    assert only(found, Code.UNKNOWN_DOTS).numbers == {"count": 4}
