"""`telerig.smooth` on tables of simulated runs: outliers, gaps, sensors, scales, bad input."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
from shake_runs import Run, run_of, true_model_of

from telerig.errors import CalibrationError, InputError
from telerig.estimator.sensors.checks import Encoder
from telerig.estimator.smoothing.graph.outliers import SampleRejection
from telerig.estimator.smoothing.graph.solve import (
    Covariances,
    Options,
    _check_variances,
    solve,
)
from telerig.estimator.smoothing.problem.problem import CarriageModel
from telerig.estimator.smoothing.problem.sensor_records import stage_of
from telerig.estimator.smoothing.problem.tracks import read_tracks
from telerig.estimator.smoothing.result import Smoothing
from telerig.estimator.smoothing.smooth import smooth
from telerig.estimator.smoothing.verdict.evidence import shake_of
from telerig.io.results.calibration_words import NO_COVARIANCE

pytestmark = pytest.mark.usefixtures("known_low_passes")

FRAMES, AROUND_S = 200, 0.05
PLACE = ["x_mm", "y_mm", "z_mm"]


def s2(**changes: Any) -> Run:
    """Scenario S2 over 0.4 s: 20 Hz shake, 0.5 px."""
    return run_of("S2", 1, FRAMES, around_s=AROUND_S, **changes)


def smoothed(run: Run, information: str, *, given: bool = False, **changes: Any) -> Smoothing:
    """given : whether the hyper-parameters are the true ones and none is learned."""
    model = {"model": true_model_of(run, information)} if given else {}
    return smooth(**run.inputs(information) | model | changes)


def rms_um(table: pd.DataFrame, run: Run, prefix: str = "") -> float:
    """Vertical error in the middle 80 % of the run."""
    error = (table[f"{prefix}y_mm"].to_numpy() - run.position_mm[0, :, 1])[20:-20]
    return float(1e3 * np.sqrt(np.nanmean(error**2)))


def with_left_arm(run: Run, change: Any) -> pd.DataFrame:
    """The accelerometers' table with the readings (N, 3) of the left arm changed."""
    table = run.inputs("arms")["accelerometers"].copy()
    mine, columns = table["sensor"] == "arm_left", ["ax_m_s2", "ay_m_s2", "az_m_s2"]
    table.loc[mine, columns] = change(table.loc[mine, columns].to_numpy())
    return table


@pytest.fixture(scope="module")
def marked() -> Smoothing:
    """With marks and the true hyper-parameters."""
    return smoothed(s2(), "references", given=True)


def test_references_beat_naive_and_rts_with_defaults(tmp_path: Path) -> None:
    run = s2()
    found = smoothed(run, "references")
    table = found.trajectories
    assert list(table["frame"]) == list(range(FRAMES))
    assert set(table["particle"]) == {0}
    assert rms_um(table, run) < 20
    assert rms_um(table, run, "naive_") > 4 * rms_um(table, run)
    assert rms_um(table, run, "rts_") > 2 * rms_um(table, run)
    normal = (table["y_mm"] - run.position_mm[0, :, 1]) / table["sy_mm"]
    assert 0.3 < float((normal**2).mean()) < 2.5
    shake = found.shake
    error = shake["left_y_mm"].to_numpy() - run.offset_mm[0, :, 1]
    assert np.sqrt(np.mean((error / shake["sleft_y_mm"]) ** 2)) < 2.5
    assert float(shake["sleft_z_mm"].min()) > 0.05  # its own depth: nothing but the prior
    found.save(tmp_path)
    content = json.loads((tmp_path / "smoothing.json").read_text())
    assert content["residuals"]["references"]["outliers"] <= 5
    assert "rig_change" not in content
    saved = pd.read_csv(tmp_path / "trajectories.csv")
    np.testing.assert_allclose(saved["x_mm"], table["x_mm"], atol=1e-5)
    with h5py.File(tmp_path / "results.h5") as file:
        rows = file["states/bubble_position_rows"][:]
        np.testing.assert_allclose(file["states/bubbles"][:] @ rows.T, table[PLACE], atol=1e-9)
        assert file.attrs["inflation"] == pytest.approx((1.0, 1.0, 1.0)), "nothing disagrees"
    assert len(pd.read_csv(tmp_path / "shake.csv")) == FRAMES


def test_encoder_whose_times_are_not_exact_contradicts_nothing() -> None:
    """At 280 mm/s, 0.1 ms are 28 µm, and 1 µm is stated."""
    run = s2()
    table = run.inputs("references")["stage"]
    shift = np.random.default_rng(3).normal(0, 1e-4, len(table))
    found = smoothed(run, "references", stage=table.assign(t_s=table["t_s"] + shift))
    assert found.verdict["verdict"] == "RESOLVED", found.verdict["words"]
    assert rms_um(found.trajectories, run) < 20
    assert any("position_sigma_mm" in words for words in found.summary["warnings"])


def test_arm_accelerometers_with_a_late_clock() -> None:
    """A delay of 1 ms that nobody told of is found, and costs little."""
    late = s2(delay_s=1e-3)
    found = smoothed(late, "arms")
    assert found.summary["accelerometers"]["arm_left"]["delay_s"] == pytest.approx(1e-3, abs=3.5e-4)
    assert rms_um(found.trajectories, late) < 30


@pytest.fixture(scope="module")
def sensed() -> Smoothing:
    """With accelerometers and the true hyper-parameters."""
    return smoothed(s2(), "arms", given=True)


@pytest.mark.slow
def test_the_laboratorys_gravity_is_no_bias(sensed: Smoothing) -> None:
    """A run in a laboratory of 9.781 m/s^2 has the biases of the same run at 9.80665 m/s^2."""
    run = s2()
    table = run.inputs("arms")["accelerometers"]
    rig = run.inputs("arms")["rig"]
    there = smoothed(
        run, "arms", given=True,
        accelerometers=table.assign(ay_m_s2=table["ay_m_s2"] + 9.80665 - 9.781),
        rig=SimpleNamespace(**vars(rig) | {"stage": replace(rig.stage, gravity_m_s2=9.781)}),
    )  # fmt: skip
    for name, sensor in sensed.summary["accelerometers"].items():
        bias = there.summary["accelerometers"][name]["bias_y_mm_s2"]
        assert bias == pytest.approx(sensor["bias_y_mm_s2"], abs=1e-6)


def test_the_verdicts_shake_is_that_of_the_table() -> None:
    """Also where frames are later than the samples at which the shake is estimated."""
    run, frames = s2(), 60
    inputs = run.inputs("arms")
    late, tracks = inputs["accelerometers"].eval("t_s = t_s - 2e-4"), inputs["tracks"]
    found = smoothed(
        run, "arms", given=True, accelerometers=late, t_s=run.t_s[:frames],
        tracks=tracks[tracks["frame"] < frames],
    )  # fmt: skip
    assert found.solution is not None and found.solution.graph.nodes.frame_late_s.any()
    judged, inner = shake_of(found.solution), found.shake.iloc[frames // 10 : -frames // 10]
    assert judged is not None
    expected = (inner["left_y_mm"] ** 2 + inner["sleft_y_mm"] ** 2).sum()
    assert judged.square[0][1] == pytest.approx(expected, rel=1e-9)


def test_a_spoilt_sample_moves_nothing(sensed: Smoothing) -> None:
    """One sample of 1,000 is off by 100 m/s^2."""

    def spoil(reading: Any) -> Any:
        return reading + 100.0 * (np.arange(len(reading)) == 500)[:, None]

    assert sensed.summary["warnings"] == [NO_COVARIANCE]
    assert sensed.summary["accelerometers"]["arm_left"]["masked_samples"] == 0
    run = s2()
    spoilt = smoothed(run, "arms", given=True, accelerometers=with_left_arm(run, spoil))
    assert spoilt.summary["accelerometers"]["arm_left"]["masked_samples"] == 1
    assert ["samples are spikes" in w for w in spoilt.summary["warnings"]] == [True, False]
    np.testing.assert_allclose(spoilt.trajectories[PLACE], sensed.trajectories[PLACE], atol=1e-3)


def test_an_axis_that_never_changes_does_not_hold_the_shake_still() -> None:
    run = s2()
    dead = with_left_arm(run, lambda reading: reading * [0.0, 1.0, 1.0])
    found = smoothed(run, "arms", given=True, accelerometers=dead)
    assert "ax never changes" in found.summary["warnings"][0]
    table = found.trajectories
    error = (table["x_mm"] - run.position_mm[0, :, 0]) / table["sx_mm"]
    assert float((error[20:-20] ** 2).mean()) < 2.0
    assert table["sx_mm"].median() > 2 * table["sy_mm"].median()


def test_samples_that_the_images_contradict_lose_their_weight() -> None:
    """Of residuals that scatter by 0.02 of the stated noise, as they do where the fit follows each
    sample: a wrong sample, whose neighbours are off, too, goes alone, and comes back if it fits.
    """
    rng = np.random.default_rng(3)
    sound = 0.02 * rng.standard_normal((2000, 3))
    rejection = SampleRejection(True, (np.arange(2000.0),))
    assert rejection.update((None,), (sound,)) == ((None,), False)
    spoilt = sound.copy()
    spoilt[998:1003, 1] += [0.3, -0.5, 1.0, -0.5, 0.3]
    (weight,), changed = rejection.update((None,), (spoilt,))
    assert changed and weight is not None
    assert np.flatnonzero(weight == 0).tolist() == [1000]
    innovation = sound.copy()
    innovation[1000, 1] = 2000.0
    (again,), changed = rejection.update((weight,), (innovation,))
    assert again is weight and not changed
    innovation[1000, 1] = 100.0
    (again,), changed = rejection.update((weight,), (innovation,))
    assert changed and again is not None and np.all(again == 1)
    many = sound.copy()
    many[::16, 0] += 1.0
    (weight,), changed = SampleRejection(True, (np.arange(2000.0),)).update((None,), (many,))
    assert weight is None and not changed


def test_samples_in_a_row_that_two_sensors_contradict_are_used_by_neither() -> None:
    """Of what the fit rejects in one sensor, the other one may be the cause."""
    rng = np.random.default_rng(4)
    t_s = np.arange(2000) / 2000
    first, second = 0.02 * rng.standard_normal((2, 2000, 3))
    first[[1000, 1020, 1040], 0] += 1.0
    rejection = SampleRejection(True, (t_s, t_s))
    weights, changed = rejection.update((None, None), (first, second))
    assert changed
    for weight in weights:
        assert weight is not None
        assert np.flatnonzero(weight == 0).tolist() == list(range(992, 1049))
    alone = 0.02 * rng.standard_normal((2000, 3))
    alone[[300, 1000], 0] += 1.0
    weights, _ = SampleRejection(True, (t_s, t_s)).update((None, None), (alone, second))
    assert weights[1] is None and weights[0] is not None
    assert np.flatnonzero(weights[0] == 0).tolist() == [300, 1000]


def test_a_negative_variance_is_refused_and_rounding_is_not() -> None:
    good, none = np.tile(np.eye(3), (4, 1, 1)), np.zeros((0, 0))
    for least, refused in ((-1e-12, False), (-1e-3, True), (np.nan, True)):
        bubbles = good.copy()
        bubbles[2, 1, 1] = least
        found = Covariances(good, bubbles, good, good, none, none, good, good)
        expected: Any = pytest.raises(CalibrationError, match="a bubble has a negative")
        with expected if refused else nullcontext():
            _check_variances(found)


def test_a_sensor_that_is_touched_for_ten_milliseconds_contradicts_the_images() -> None:
    """A push that comes and goes is found after the fit."""
    run = run_of("S2", 1, 100, around_s=AROUND_S)
    phase = np.clip((run.accelerometers["t_s"].unique() - 0.1) / 0.01, 0, 1)
    push = 3.0 * np.sin(np.pi * phase)[:, None] ** 2
    touched = with_left_arm(run, lambda reading: reading + push)
    found = smoothed(run, "arms", given=True, accelerometers=touched)
    assert found.verdict["verdict"] == "CONTRADICTED"
    assert [c["against"] for c in found.verdict["contradictions"]] == [["arm_left"]]


def test_outliers_cost_little(marked: Smoothing) -> None:
    """5 % of the pixels 20 px off; the true hyper-parameters are given."""
    rng, run = np.random.default_rng(3), s2()
    spoilt = run.inputs("references")["tracks"]
    for camera in ("left", "right"):
        hit = rng.random(FRAMES) < 0.05
        angle = rng.uniform(0, 2 * np.pi, FRAMES)
        spoilt[f"{camera}_u_px"] += 20 * hit * np.cos(angle)
        spoilt[f"{camera}_v_px"] += 20 * hit * np.sin(angle)
    pixels = [spoilt[[f"{c}_u_px", f"{c}_v_px"]].to_numpy() for c in ("left", "right")]
    spoilt[PLACE] = run.calibration.triangulate(*pixels, sigma_px=0.5).points_mm
    robust = smoothed(run, "references", given=True, tracks=spoilt)
    assert rms_um(robust.trajectories, run) < 1.15 * rms_um(marked.trajectories, run)
    outliers = robust.summary["residuals"]["bubbles"]["outliers"]
    assert 0.8 * 0.05 * 2 * FRAMES < outliers < 1.4 * 0.05 * 2 * FRAMES


def test_encoder_scale_far_from_what_is_assumed_is_found_by_default() -> None:
    """The assumed 0.1 % is no obstacle to marks that show 1 %, which the lenses may be off, too."""
    run = run_of("S2", 1, 300, around_s=AROUND_S, encoder_scale=0.01, scale_sigma=None)
    found = smoothed(run, "references")
    scale = found.summary["encoder"]
    assert scale["scale_from"] == "run"
    assert scale["scale"] == pytest.approx(0.01, abs=1e-3)
    assert scale["sscale"] == pytest.approx(scale["scale"], rel=0.01)
    assert any("magnifications" in words for words in found.summary["warnings"])
    assert found.model.encoder_scale_sigma > 0.01


def test_gap_and_single_camera_detections() -> None:
    """Frames without the bubble are bridged; one camera alone still helps."""
    run = s2()
    whole = run.inputs("references")["tracks"]
    gap = whole["frame"].between(90, 99)
    table, lone = whole[~gap], whole[gap]
    detections = pd.DataFrame({"frame": lone["frame"], "camera": "left", "particle": 0.0})
    for column in ("u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"):
        detections[column] = lone[f"left_{column}"].to_numpy()
    with_lone, without = (
        smoothed(run, "references", given=True, tracks=tracks).trajectories
        for tracks in (SimpleNamespace(table=table, detections=detections), table)
    )
    assert len(with_lone) == len(without) == FRAMES
    assert list(without["observed"][88:102]) == [1, 1] + 10 * [0] + [1, 1]
    assert with_lone["observed"].all()
    middle = 95
    assert with_lone["sy_mm"][middle] < without["sy_mm"][middle]
    assert with_lone["sx_mm"][middle] < 0.9 * without["sx_mm"][middle]
    assert np.isnan(without["naive_x_mm"][middle])


def test_oblique_cameras_with_perspective() -> None:
    """Axes coupled, projection curved: errors as stated; several passes without a start."""
    run = s2(angle_deg=40.0, kappa_per_mm=2e-4)
    found = smoothed(run, "references", given=True)
    assert solve(found.solution.graph.problem, found.model, Options()).passes > 1
    table = found.trajectories
    assert rms_um(table, run) < 30
    error = table[PLACE].to_numpy() - run.position_mm[0]
    sigma = table[["sx_mm", "sy_mm", "sz_mm"]].to_numpy()
    assert 0.2 < float(((error / sigma) ** 2).mean()) < 3.0


def test_the_calibrations_uncertainty_is_carried_in(marked: Smoothing) -> None:
    """An image centre known to 0.3 px moves all points by 0.03 mm at 10 px/mm, and is said so."""
    run = s2()
    unsure = replace(
        run.calibration,
        covariance=np.diag([0.3**2, 1e-12, *np.zeros(6)]),
        covariance_names=("left.centre_u_px", "left.centre_v_px"),
        free=(("centre_u_px", "centre_v_px"), ()),
    )
    unsure_x = smoothed(run, "references", given=True, calibration=unsure).trajectories["sx_mm"]
    sure_x = marked.trajectories["sx_mm"]
    np.testing.assert_allclose(np.sqrt(unsure_x**2 - sure_x**2), 0.03, rtol=0.02)


def test_a_covariance_that_one_camera_states_in_part_is_not_mixed_with_another() -> None:
    run = s2()
    tracks = run.inputs("one")["tracks"]
    lone = {"frame": [1], "camera": "left", "particle": 0.0, "u_px": 5.0, "v_px": 6.0}
    lone |= {"suu_px2": np.nan, "suv_px2": 0.3, "svv_px2": 0.04}
    both = SimpleNamespace(table=tracks[tracks["frame"] != 1], detections=pd.DataFrame(lone))
    seen = read_tracks(both, run.calibration.cameras, run.t_s).observations
    (found,) = seen.covariance_px2[seen.frame == 1]
    np.testing.assert_allclose(found, np.eye(2), atol=2e-4)


def test_frames_lie_between_two_readings_of_a_slow_encoder() -> None:
    t_s, encoder = np.array([0.1, 0.2]), Encoder(np.array([-1.0, -0.3, 0.6, 2.0]), np.arange(4.0))
    found = stage_of(encoder, t_s)
    assert found is not None and found.t_s.tolist() == [-0.3, 0.6]


def test_two_frames_and_a_bubble_seen_once() -> None:
    seen: list[tuple[str, float]] = []
    run = s2()
    tracks = run.inputs("one")["tracks"]
    found = smoothed(
        run, "one", given=True,
        tracks=pd.concat([tracks.iloc[:2], tracks.iloc[[1]].assign(particle=9)]), t_s=run.t_s[:2],
        progress=lambda what, share, _: seen.append((what, share)),
    )  # fmt: skip
    table = found.trajectories
    assert list(table["particle"]) == [0, 0, 9]
    assert np.isfinite(table[["x_mm", "vx_mm_s", "sx_mm"]].to_numpy()).all()
    assert seen[0] == ("checking tracks and sensors", 0.0)
    assert seen[-1][1] == 1.0
    assert all(0 <= share <= 1 for _, share in seen)
    assert list(found.summary["seconds"]) == [
        "checks", "learning", "smoothing", "verdict", "tables",
    ]  # fmt: skip


def test_what_a_given_model_states_of_its_learned_values_widens_the_result() -> None:
    run, told = s2(), {"modes.0.rms_mm": 0.5}
    model = true_model_of(run, "one")
    sure, unsure = (
        smoothed(run, "one", model=m).trajectories["sy_mm"].median()
        for m in (model, replace(model, learned=told))
    )
    assert unsure > 1.02 * sure


def test_too_short_a_run_to_learn_from_is_not_said_to_be_still() -> None:
    """In 0.1 s a shake of 20 Hz shows two periods at most; the encoder alone cannot clear it."""
    run = s2()
    tracks = run.inputs("one")["tracks"]
    found = smoothed(run, "one", tracks=tracks[tracks["frame"] < 50], t_s=run.t_s[:50])
    assert found.model.name == "default"
    assert found.verdict["verdict"] == "UNRESOLVED"
    assert "SHAKE_BELOW_NOISE" not in found.verdict["flags"]


def test_offsets_without_tracks() -> None:
    """Accelerometers and encoder alone, true modes: the left arm's shake at the asked times."""
    run = s2()
    model = replace(true_model_of(run, "arms"), carriage=CarriageModel("force", 1500.0))
    found = smoothed(run, "arms", tracks=None, model=model)
    assert len(found.trajectories) == 0
    left = found.shake["left_y_mm"].to_numpy()
    assert np.corrcoef(left, run.offset_mm[0, :, 1])[0, 1] > 0.98


def test_a_clock_that_nothing_shows_is_not_taken_for_that_of_the_frames() -> None:
    """Without images nothing shows a logger's offset: 30 ms hide the shake altogether."""
    run = s2()
    arm = run.inputs("arms")["accelerometers"].query("sensor == 'arm_left'")
    readings = arm[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy()
    found = smoothed(
        run,
        "one",
        tracks=None,
        accelerometers={"arm_left": {"t_s": arm["t_s"], "a_m_s2": readings}},
    )
    assert not found.summary["accelerometers"]
    assert any("clock is unknown" in words for words in found.summary["warnings"])


def test_bad_input() -> None:
    run = s2()
    tracks, rig = (run.inputs("one")[name] for name in ("tracks", "rig"))
    good = {"stage": run.stage, "rig": rig}
    with pytest.raises(InputError, match="no column left_u_px"):
        smooth(tracks.drop(columns="left_u_px"), run.calibration, **good)
    broken = tracks.copy()
    broken.loc[5, "right_v_px"] = np.nan
    with pytest.raises(InputError, match="row 7"):
        smooth(broken, run.calibration, **good)
    with pytest.raises(InputError, match="do not increase"):
        smooth(tracks, run.calibration, stage=run.stage.iloc[::-1])
    for wrong, words in (
        ({"stage": run.stage.to_numpy()}, "not a table"),
        ({"stage": {"t_s": [0.0], "positon": [0.0]}}, "did you mean position_mm"),
        ({"references": "references.csv"}, "not a table"),
        ({"references": run.references.assign(u_px=np.nan)}, "u_px is not finite at row 0"),
        ({"references": run.references.assign(sigma_px=0.0)}, "sigma_px is 0 at row 0"),
        ({"references": run.references.assign(frame=0.5)}, "frame is 0.5 at row 0"),
        ({"t_s": np.arange(FRAMES)[:, None]}, "t_s has the shape"),
        ({"t_s": np.arange(FRAMES)[::-1]}, "frames: times do not increase"),
        ({"rig": "rig.toml"}, "rig is str"),
    ):
        with pytest.raises(InputError, match=words):
            smooth(tracks, run.calibration, **{**good, **wrong})
    for change, words in (
        ({"x_mm": "far"}, "x_mm is Series of .*, not numbers"),
        ({"frame": tracks["frame"] + 0.5}, "frame is 0.5 in row 2"),
        ({"frame": tracks["frame"] - 1}, "frame is -1 in row 2"),
        ({"t_s": np.nan}, "t_s is not finite at row 0"),
        ({"particle": 0.5}, "particle is 0.5 in row 2"),
        ({"right_svv_px2": -1.0}, "of camera right are .*, -1, which is no covariance"),
        ({"left_suv_px2": 9.0}, "of camera left are .*, 9, .*, which is no covariance"),
    ):
        with pytest.raises(InputError, match=words):
            smooth(tracks.assign(**change), run.calibration, **good)
    with pytest.raises(InputError, match="two cameras or more"):
        read_tracks(tracks, run.calibration.cameras[:1], run.t_s)
    with pytest.raises(InputError, match="stage: has 0 readings"):
        smooth(tracks, run.calibration, stage=run.stage.iloc[:0])
    with pytest.raises(InputError, match="carriage has no acceleration"):
        smooth(
            **run.inputs("arms"),
            model=replace(true_model_of(run, "arms"), carriage=CarriageModel()),
        )
    with pytest.raises(InputError, match="no rows"):
        smooth(tracks.iloc[:0], run.calibration, **good)
    for model in (3, lambda problem: "auto"):
        with pytest.raises(InputError, match="model"):
            smooth(tracks, run.calibration, model=model, **good)
    with pytest.raises(InputError, match="load_tracks"):
        smooth("tracks.csv", run.calibration, **good)
    with pytest.raises(InputError, match="load_calibration"):
        smooth(tracks, "calibration.json", **good)
    with pytest.raises(InputError, match="model is 'best'"):
        smooth(tracks, run.calibration, model="best", **good)
    with pytest.raises(InputError, match="the times of the frames are unknown"):
        smooth(None, run.calibration, **good)
    with pytest.raises(InputError, match="no camera 'top'"):
        smooth(tracks, run.calibration, references=run.references.assign(camera="top"), **good)


def test_it_is_reached_without_libraries_that_only_its_work_needs() -> None:
    code = "import sys, telerig; telerig.smooth; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    later = {"cv2", "filterpy", "gtsam", "h5py", "matplotlib", "pydantic", "scipy", "skimage"}
    assert not later & set(done.stdout.split())


def test_bubbles_that_are_seen_once_are_saved(tmp_path: Path) -> None:
    """They have no velocity, so nothing lies along their paths."""
    run = s2()
    inputs = run.inputs("images")
    inputs["tracks"] = inputs["tracks"].iloc[[10]]
    found = smooth(**inputs, model="default")
    assert found.summary["along_path"] == {"velocity": 1.0, "acceleration": 1.0}
    found.save(tmp_path / "out")
    assert len(pd.read_csv(tmp_path / "out" / "bubbles.csv")) == 1
