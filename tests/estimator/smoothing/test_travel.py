"""How well the stage's travel is known, carried into a smoothed run."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from shake_learning_data import ARM_HZ, CAMERAS, COMMON_HZ, UP, run

from telerig.estimator.sensors.findings import Code
from telerig.estimator.smoothing.graph.solve import Options, Solution, solve
from telerig.estimator.smoothing.graph.stage_travel import (
    considered_variance,
    offset_sigma,
    scale_sigma,
    scale_warnings,
    total_scale,
    travel_of,
)
from telerig.estimator.smoothing.problem.problem import (
    CARRIAGE,
    Accelerometer,
    BroadBand,
    Bubble,
    CarriageModel,
    Mark,
    Observations,
    RigMode,
    ShakeModel,
    SmoothingProblem,
    Stage,
    Travel,
)
from telerig.estimator.smoothing.result import shake, trajectories
from telerig.estimator.smoothing.sensor_alignment.stuck_encoder import stuck
from telerig.estimator.smoothing.smooth import problem_of
from telerig.estimator.smoothing.verdict.modes import shake_modes
from telerig.estimator.smoothing.verdict.whiteness import accelerometer_spectra
from telerig.io.rig_file.description import StageDescription

Array = NDArray[np.float64]

BASIS = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
SPEED = 100.0
STILL = ShakeModel(encoder_sigma_mm=0.002)


def travel(scale_sd: float, tilt_sd: float = 0.0, axis: Array = UP) -> Travel:
    return Travel(axis, BASIS, 0.0, np.diag([tilt_sd, tilt_sd, scale_sd]) ** 2, "stage_axis")


def problem(scale: float = 0.0, *, marks: bool = False, axis: Array = UP) -> SmoothingProblem:
    """One bubble that rises at the stage's speed; the encoder reads (1 + scale) too much."""
    rng = np.random.default_rng(4)
    t = np.arange(120) / 200
    lab = np.array([1.0, 2.0, -1.0]) + SPEED * t[:, None] * UP
    places = np.array([[0.0, -20.0, 0.0], [5.0, -30.0, 5.0]]) if marks else np.zeros((0, 3))
    fixed = np.broadcast_to(places[:, None], (len(places), len(t), 3))

    def seen(points: Array, sigma: float) -> Observations:
        item, frame = np.indices(points.shape[:2]).reshape(2, -1)
        rig = (points - SPEED * t[:, None] * UP).reshape(-1, 3)
        uv = np.concatenate([c.project(rig) for c in CAMERAS])
        uv = uv + sigma * rng.normal(size=uv.shape)
        camera = np.repeat([0, 1], len(item))
        covariance = np.tile(sigma**2 * np.eye(2), (len(uv), 1, 1))
        return Observations(np.tile(item, 2), np.tile(frame, 2), camera, uv, covariance)

    reading = (1 + scale) * SPEED * t + 0.002 * rng.normal(size=len(t))
    return SmoothingProblem(
        CAMERAS, t, axis, UP, (Bubble(7, 0, len(t) - 1, lab[0], lab),), seen(lab[None], 0.2),
        Stage(t, reading),
        marks=tuple(Mark(f"m{k}", p + 0.1) for k, p in enumerate(places)),
        references=seen(fixed, 0.1) if marks else Observations.none(),
    )  # fmt: skip


def stopped(*, marks: bool = False, bubbles: bool = True, hangs: bool = False) -> SmoothingProblem:
    """The stage comes to rest with 1 m/s^2 before an encoder of 5 um counts; or this one hangs."""
    known = problem(marks=marks)
    t, late = known.t_s, np.clip(known.t_s - 0.2, 0, None)
    brake = np.minimum(late, SPEED / 1000)
    position = SPEED * t - SPEED * late + SPEED * brake - 500 * brake**2
    moves = (SPEED * t if hangs else position) - SPEED * t  # beyond what `problem` has

    def seen(obs: Observations) -> Observations:
        rows = np.array([c.camera_from_rig.rotation[:2] @ UP for c in known.cameras])
        scale = known.cameras[0]["scale_px_per_mm"]
        shift = scale * moves[obs.frame, None] * rows[obs.camera]
        return replace(obs, uv_px=obs.uv_px - shift)

    return replace(
        known, stage=Stage(t, np.round(position / 0.005) * 0.005),
        observations=seen(known.observations) if bubbles else Observations.none(),
        references=seen(known.references),
    )  # fmt: skip


def place(solution: Solution) -> Array:
    return np.asarray(solution.state.bubbles @ solution.graph.bubble.position.T)


def test_what_is_left_open_is_how_far_the_answer_moves() -> None:
    """By brute force: readings scaled by an sd, and an axis tilted by one."""
    known = problem()
    solution = solve(replace(known, travel=travel(1e-3)), STILL)
    assert known.stage is not None
    scaled = replace(known, stage=replace(known.stage, position_mm=known.stage.position_mm / 1.001))
    moved = place(solve(scaled, STILL)) - place(solution)
    variance, speed = considered_variance(solution)
    np.testing.assert_allclose(np.sqrt(variance[:, 1]), np.abs(moved[:, 1]), atol=2e-4)
    assert np.sqrt(variance[-1, 1]) == pytest.approx(1e-3 * SPEED * known.t_s[-1], rel=0.01)
    np.testing.assert_allclose(np.sqrt(speed[5:-5, 1]), 1e-3 * SPEED, rtol=0.05)
    assert not variance[:, [0, 2]].any()

    tilt = 2e-3
    tilted = solve(replace(known, axis=UP + tilt * BASIS[:, 0]), STILL)
    variance, _ = considered_variance(solve(replace(known, travel=travel(0.0, tilt)), STILL))
    moved = np.abs(place(tilted) - place(solution))
    np.testing.assert_allclose(np.sqrt(variance[:, 0]), moved[:, 0], atol=2e-4)


def test_standard_deviations_hold_it() -> None:
    sure, unsure = (
        solve(replace(problem(), travel=one), STILL) for one in (None, travel(1e-3, 1e-3))
    )
    a, b = trajectories(sure, None), trajectories(unsure, None)
    np.testing.assert_array_equal(a["y_mm"], b["y_mm"])
    for axis in "xyz":
        growth = np.sqrt(b[f"s{axis}_mm"] ** 2 - a[f"s{axis}_mm"] ** 2)
        np.testing.assert_allclose(growth, 1e-3 * SPEED * a["t_s"], atol=5e-5)
    last = shake(unsure)["sposition_mm"].iloc[-1]
    assert last == pytest.approx(1e-3 * SPEED * problem().t_s[-1], rel=0.02)


@pytest.mark.parametrize("late_s", [1e-9, 3e-7, 1e-5])
def test_times_that_are_stated_to_other_digits_are_those_of_the_frames(late_s: float) -> None:
    known, model = problem(), replace(STILL, carriage=CarriageModel("force"))
    assert known.stage is not None
    late = replace(known, stage=replace(known.stage, t_s=known.stage.t_s + late_s))
    found, exact = solve(late, model), solve(known, model)
    assert len(found.graph.nodes.t_s) == len(exact.graph.nodes.t_s) == len(known.t_s)
    np.testing.assert_allclose(place(found), place(exact), atol=2 * SPEED * late_s + 1e-6)
    for one in (found, exact):
        assert one.covariances is not None
    sds = (trajectories(one, None)["sy_mm"] for one in (found, exact))
    np.testing.assert_allclose(*sds, rtol=1e-3)


def test_readings_that_arrived_together_count_once_in_time() -> None:
    known = problem()
    assert known.stage is not None
    t, x = known.stage.t_s, known.stage.position_mm
    twice = Stage(np.insert(t, 60, t[59] + 1e-6), np.insert(x, 60, x[59]))
    model = replace(STILL, carriage=CarriageModel("force"))
    steps = np.diff(solve(replace(known, stage=twice), model).graph.nodes.t_s)
    np.testing.assert_allclose(steps, 0.005, atol=1e-9)
    one = Stage(t[:1] - 1.0, x[:1])
    nodes = solve(replace(known, stage=one), model).graph.nodes
    np.testing.assert_allclose(nodes.t_s, np.r_[-1.0, t], atol=1e-9)
    assert not nodes.encoder_late_s.any()


@pytest.mark.parametrize(("marks", "bubbles"), [(False, True), (True, True), (True, False)])
def test_a_stage_that_comes_to_rest_is_no_encoder_that_is_stuck(marks: bool, bubbles: bool) -> None:
    assert stuck(stopped(marks=marks, bubbles=bubbles)) == []
    (found,) = stuck(stopped(marks=marks, bubbles=bubbles, hangs=True))
    assert found.code is Code.ENCODER_STUCK


def test_where_the_encoder_was_not_read_the_carriage_is_anywhere() -> None:
    """It stops in the middle of a run: the stage travels on, by 30 mm, and the bubble as before."""
    known = problem()
    assert known.stage is not None
    half = Stage(known.stage.t_s[:60], known.stage.position_mm[:60])
    table = trajectories(solve(replace(known, stage=half), STILL), None)
    off = table["y_mm"] - known.bubbles[0].guess_mm[:, 1]
    assert np.all(np.abs(off) < 3 * table["sy_mm"])
    assert table["sy_mm"].iloc[-1] > 3 * table["sy_mm"].iloc[:50].max()
    np.testing.assert_allclose(off.iloc[:50], 0.0, atol=0.05)


def test_marks_tell_the_scale_and_the_carriage_is_where_it_was() -> None:
    model = replace(STILL, encoder_scale_sigma=0.01)
    off = replace(problem(0.01, marks=True), travel=travel(0.01))
    solution = solve(off, model)
    assert total_scale(solution) == pytest.approx(0.01, abs=3e-4)
    truth = SPEED * off.t_s
    np.testing.assert_allclose(shake(solution)["position_mm"], truth, atol=0.03)
    assert not considered_variance(solution)[0].any()


def test_without_marks_the_prior_rules_a_free_scale() -> None:
    """A carriage with dynamics, and sensors: nothing there speaks of the scale."""
    free = replace(
        STILL,
        encoder_scale_sigma=0.01,
        carriage=CarriageModel("force", acceleration_rms_mm_s2=1.0, servo=(0.1, 15.0, 0.3)),
    )
    solution = solve(problem(0.01), free)
    assert solution.covariances is not None
    scale, sd = solution.state.encoder[0], np.sqrt(solution.covariances.encoder[0, 0])
    assert abs(scale) < 1.5 * sd
    assert sd == pytest.approx(0.01, rel=0.1)


def test_calibrated_stage_goes_before_rig_toml() -> None:
    axis = np.array([0.01, -1.0, 0.0]) / np.linalg.norm([0.01, -1.0, 0.0])
    stage = {
        "axis": axis.tolist(), "basis": BASIS.tolist(), "encoder_scale": 0.02,
        "joint_covariance": (1e-10 * np.eye(3)).tolist(),
    }  # fmt: skip
    described = StageDescription((0, -1, 0), (0, -1, 0), 0.001, 0.004)
    calibration: Any = SimpleNamespace(cameras=CAMERAS, stage=stage, covariance=np.zeros((0, 0)))
    table = pd.DataFrame({"t_s": [0.0, 1.0], "position_mm": [0.0, 102.0]})
    rig = SimpleNamespace(stage=described, accelerometers={})
    found, *_ = problem_of(None, calibration, stage=table, rig=rig, t_s=[0.0, 0.5, 1.0])
    np.testing.assert_allclose(found.axis, axis)
    assert found.stage is not None and found.stage.position_mm[-1] == pytest.approx(100)
    stated = travel_of({}, described)
    assert (stated.source, stated.covariance[2, 2]) == ("rig.toml", pytest.approx(1.6e-5))
    assert travel_of({}, None).source == "assumed"


def test_accelerometer_spectra_before_and_after() -> None:
    """A 20 Hz vibration goes into the model; what is left is the sensor's noise."""
    rng = np.random.default_rng(6)
    t = np.arange(1200) / 1000
    push = 3000 * np.sin(2 * np.pi * 20 * t)[:, None] * UP
    sigma = 300.0
    reading = push + 9806.65 * UP + sigma * rng.normal(size=(len(t), 3))
    sensor = Accelerometer("carriage", CARRIAGE, t - 0.2, reading, np.eye(3), sigma)
    model = replace(STILL, modes=(RigMode(20.0, 0.05, (0.1, 0.2, 0.1), CARRIAGE),))
    solution = solve(replace(problem(), accelerometers=(sensor,)), model, Options(robust=False))
    found = accelerometer_spectra(solution)["carriage"]
    frequency, before, after = (np.array(found[k]) for k in ("frequency_hz", "reading", "residual"))
    assert frequency[before.argmax()] == pytest.approx(20, abs=1.5)
    assert after.max() < 0.1 * before.max()
    assert found["noise"] == pytest.approx(3 * 2 * (sigma / 1000) ** 2 / 1000, rel=0.01)
    assert np.median(after[frequency > 300]) == pytest.approx(found["noise"], rel=0.4)


def test_arms_that_shake_alone_and_together() -> None:
    """Labels of lines read from estimated offsets: who moves, and nothing twice."""
    bands = ShakeModel(broad_bands=tuple(BroadBand((0.2,) * 3, j) for j in range(2)))
    for seed in (21,):
        given, _, _ = run(np.random.default_rng(seed), seconds=3.0, rate_hz=100.0, marks=3)
        rows = shake_modes(solve(given, bands))
        for row in rows:
            lines = {"common": COMMON_HZ, "arm left": ARM_HZ, "arm right": ARM_HZ}
            assert row.frequency_hz == pytest.approx(lines[row.where], abs=1.5)
        assert sorted(r.where for r in rows) == ["arm left", "arm right", "common"]


def test_an_encoder_that_marks_contradict_may_be_right() -> None:
    """1 % is ten times what is assumed: either the encoder is off, or the magnifications."""
    off = problem(0.01, marks=True)
    model = replace(STILL, encoder_scale_sigma=0.02)
    solution = solve(replace(off, travel=replace(travel(1e-3), source="assumed")), model)
    variance, _ = considered_variance(solution)
    assert np.sqrt(variance[-1, 1]) == pytest.approx(0.01 * SPEED * off.t_s[-1], rel=0.05)
    assert np.sqrt(variance[-1, [0, 2]]) == pytest.approx([0.01, 0.01], rel=0.1)  # 1 mm off-centre
    assert scale_sigma(solution) == pytest.approx(0.01, rel=0.05)
    assert len(scale_warnings(solution)) == 1
    stated = solve(replace(off, travel=travel(1e-3)), model)
    assert not considered_variance(stated)[0].any() and not scale_warnings(stated)


def test_an_unknown_delay_of_the_encoder_is_an_offset_of_all_places_and_of_no_motion() -> None:
    known = problem()
    assert known.stage is not None
    exact, late = (
        solve(replace(known, stage=replace(known.stage, delay_sigma_s=s)), STILL) for s in (0, 5e-3)
    )
    assert not offset_sigma(exact).any()
    np.testing.assert_allclose(offset_sigma(late), [0, 5e-3 * SPEED, 0], rtol=0.02)
    a, b = trajectories(exact, None), trajectories(late, None)
    np.testing.assert_array_equal(a["sy_mm"], b["sy_mm"])


def test_a_camera_that_moves_on_in_a_run_leaves_an_offset_of_its_axes() -> None:
    """Marks show that it did, and not which of both places is that of the calibration."""
    known = problem(marks=True)

    def bumped(seen: Observations) -> Observations:
        late = (seen.camera == 1) & (seen.frame >= len(known.t_s) // 2)
        return replace(seen, uv_px=seen.uv_px + np.where(late, 3.0, 0.0)[:, None] * [1.0, 0.0])

    bands = tuple(BroadBand((0.3,) * 3, camera, 1.0, 60.0, 1.0) for camera in (0, 1))
    model = replace(STILL, broad_bands=bands)
    moved = replace(
        known, observations=bumped(known.observations), references=bumped(known.references)
    )
    sound, found = (offset_sigma(solve(one, model)) for one in (known, moved))
    scale = known.cameras[1]["scale_px_per_mm"]
    assert sound[2] < 0.02
    assert found[2] == pytest.approx(1.5 / scale, rel=0.2)
    assert found[0] < 0.02
