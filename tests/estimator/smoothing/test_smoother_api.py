"""`telerig.smooth` on runs drawn here: tables, files, outliers, gaps, delays, bad input."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest

from telerig.errors import CalibrationError, InputError
from telerig.estimator.calibration.result.calibration import Calibration
from telerig.estimator.sensors.findings import SensorError
from telerig.estimator.smoothing.graph.solve import Covariances, SampleRejection, _check_variances
from telerig.estimator.smoothing.problem.problem import CarriageModel, RigMode, ShakeModel
from telerig.estimator.smoothing.smooth import smooth
from telerig.factors.bubble_motion import BubbleModel, Zigzag
from telerig.factors.state_space import (
    Component,
    discretise,
    distinct_steps,
    driven_mode,
    oscillator,
    ou_velocity,
)
from telerig.io.results.calibration_words import NO_COVARIANCE
from telerig.io.rig_file.description import StageDescription
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.triangulation import triangulate

UP = np.array([0.0, -1.0, 0.0])
RATE_HZ, FRAMES, SIGMA_PX = 500.0, 300, 0.5
RIG = SimpleNamespace(stage=StageDescription((0, -1, 0), (0, -1, 0), 0.001, 0.0), accelerometers={})
UNSAID = SimpleNamespace(stage=StageDescription((0, -1, 0), (0, -1, 0), 0.001), accelerometers={})
TRUE = ShakeModel(
    bubble=BubbleModel(
        zigzags=(Zigzag(6.0, 0.03, (2.0, 0.0, 2.0)), Zigzag(12.0, 0.03, (0.0, 0.177, 0.0)))
    ),
    modes=(
        RigMode(20.0, 0.03, (0.06, 0.122, 0.06)),
        RigMode(32.0, 0.03, (0.035, 0.07, 0.035), camera=0),
        RigMode(32.0, 0.03, (0.035, 0.07, 0.035), camera=1),
    ),
    encoder_sigma_mm=0.001,
)


def path(component: Component, t: Any, rng: np.random.Generator) -> Any:
    lengths, index = distinct_steps(np.diff(t))
    steps = discretise([component], lengths)[0]
    roots = np.linalg.inv(steps.whitener[0])
    values, vectors = np.linalg.eigh(component.start_covariance)
    x = vectors @ (np.sqrt(values.clip(0)) * rng.normal(size=component.size))
    out = [x]
    for i in index:
        x = steps.transition[0, i] @ x + roots[i] @ rng.normal(size=component.size)
        out.append(x)
    return np.array(out)


@dataclass
class Run:
    calibration: Calibration
    tracks: pd.DataFrame
    stage: pd.DataFrame
    references: pd.DataFrame
    accelerometers: dict[str, dict[str, Any]]
    truth_mm: Any
    shake_mm: Any


def cameras() -> tuple[Camera, Camera]:
    turn = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    return (
        Camera.create("left", (1024, 1024), 10.0),
        Camera.create("right", (1024, 1024), 10.0, camera_from_rig=Pose(turn, np.zeros(3))),
    )


def oblique() -> tuple[Camera, Camera]:
    """At 40 degrees, with residual perspective and distortion."""
    a = np.deg2rad(40.0)
    turn = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    lens = {"kappa_per_mm": 2e-4, "k1": -2e-3}
    return (
        Camera.create("left", (1024, 1024), 10.0, **lens),
        Camera.create("right", (1024, 1024), 10.0, camera_from_rig=Pose(turn, np.zeros(3)), **lens),
    )


def simulated(
    seed: int,
    *,
    delay_s: float = 0.0,
    encoder_scale: float = 0.0,
    pair: tuple[Camera, Camera] | None = None,
    gravity_m_s2: float = 9.80665,
) -> Run:
    """Scenario S2 of the design over 0.6 s: 20 Hz shake, 0.5 px, one bubble."""
    rng = np.random.default_rng(seed)
    grid = np.arange(round((FRAMES / RATE_HZ + 0.1) * 2000)) / 2000 - 0.05
    at = np.round((np.arange(FRAMES) / RATE_HZ + 0.05) * 2000).astype(int)
    t = grid[at]
    offset, felt = np.zeros((2, len(grid), 3)), np.zeros((2, len(grid), 3))
    for mode in TRUE.modes:
        for axis, rms in enumerate(mode.rms_mm):
            part = driven_mode(rms, mode.frequency_hz, mode.damping)
            x = path(part, grid, rng)
            for j in (0, 1) if mode.camera < 0 else (mode.camera,):
                offset[j, :, axis] += x @ part.position
                felt[j, :, axis] += x @ part.acceleration
    servo = driven_mode(0.1, 15.0, 0.3)
    x = path(servo, grid, rng)
    position, push = 280 * grid + x @ servo.position, x @ servo.acceleration
    lab = 280 * t[:, None] * UP + rng.uniform(-5, 5, 3)
    for axis in range(3):
        lab[:, axis] += path(ou_velocity(10.0, 0.3, start_sigma_mm=1e-6), t, rng)[:, 0]
    for z in TRUE.bubble.zigzags:
        for axis, rms in enumerate(z.rms_mm):
            if rms:
                lab[:, axis] += path(oscillator(rms, z.frequency_hz, z.damping), t, rng)[:, 0]
    pair = pair or cameras()
    seen = [lab - UP * position[at, None] - offset[j, at] for j in range(2)]
    uv = [c.project(p) + SIGMA_PX * rng.normal(size=(FRAMES, 2)) for c, p in zip(pair, seen)]
    marks = marks_seen(pair, position[at], offset[:, at], rng)
    sigma = 22.5 * 9.80665e-6 * np.sqrt(1000)
    sensors = {
        f"arm_{c.name}": {
            "t_s": grid + delay_s, "mounted_on": c.name, "axes": np.eye(3),
            "noise_density_ug_sqrt_hz": 22.5,
            "a_m_s2": (UP * push[:, None] + felt[j]) / 1000 + gravity_m_s2 * UP
            + 0.2 * rng.normal(size=3) + sigma * rng.normal(size=(len(grid), 3)),
        }
        for j, c in enumerate(pair)
    }  # fmt: skip
    read = (1 + encoder_scale) * position[::2] + 0.001 * rng.normal(size=len(grid[::2]))
    calibration = Calibration(
        pair, np.zeros(0, np.int64), np.zeros((0, 3)), {}, np.zeros((0, 0)), (), ((), ())
    )
    return Run(
        calibration, tracks_of(pair, uv, t), pd.DataFrame({"t_s": grid[::2], "position_mm": read}),
        marks, sensors, lab, offset[:, at],
    )  # fmt: skip


def marks_seen(pair: Any, position: Any, offset: Any, rng: np.random.Generator) -> pd.DataFrame:
    """Four marks in each camera at unknown heights, other ones every 150 frames."""
    marks = []
    for j, camera in enumerate(pair):
        for block in range(0, FRAMES, 150):
            frames = np.arange(block, block + 150)
            for m in range(4):
                place = UP * (position[frames].mean() + rng.uniform(-5, 5))
                place = place + np.array([rng.uniform(-20, 20), 0, rng.uniform(-20, 20)])
                rig = place - UP * position[frames, None] - offset[j, frames]
                pixels = camera.project(rig) + 0.1 * rng.normal(size=(150, 2))
                name = f"{camera.name}-{block}-{m}"
                marks.append(
                    pd.DataFrame({"frame": frames, "camera": camera.name, "mark": name,
                                  "u_px": pixels[:, 0], "v_px": pixels[:, 1], "sigma_px": 0.1})
                )  # fmt: skip
    return pd.concat(marks)


def tracks_of(pair: Any, uv: Any, t: Any) -> pd.DataFrame:
    points = triangulate(pair, tuple(uv), SIGMA_PX)
    table = pd.DataFrame({"frame": np.arange(len(t)), "particle": 4, "t_s": t})
    table[["x_mm", "y_mm", "z_mm"]] = points.points_mm
    for name, (i, j) in {"xx": (0, 0), "xy": (0, 1), "xz": (0, 2), "yy": (1, 1), "yz": (1, 2),
                         "zz": (2, 2)}.items():  # fmt: skip
        table[f"s{name}_mm2"] = points.covariance_mm2[:, i, j]
    for camera, pixels in zip(pair, uv):
        table[[f"{camera.name}_u_px", f"{camera.name}_v_px"]] = pixels
        for name, value in (("uu", SIGMA_PX**2), ("uv", 0.0), ("vv", SIGMA_PX**2)):
            table[f"{camera.name}_s{name}_px2"] = value
    table["d_eq_mm"] = 4.2
    return table


def rms_um(table: pd.DataFrame, truth: Any, prefix: str = "") -> float:
    """Vertical error in the middle 80 % of the run."""
    error = (table[f"{prefix}y_mm"].to_numpy() - truth[:, 1])[30:-30]
    return float(1e3 * np.sqrt(np.nanmean(error**2)))


@pytest.fixture(scope="module")
def run() -> Run:
    return simulated(1)


def test_references_beat_naive_and_rts_with_defaults(run: Run, tmp_path: Path) -> None:
    found = smooth(run.tracks, run.calibration, stage=run.stage, references=run.references, rig=RIG)
    table = found.trajectories
    assert list(table["frame"]) == list(range(FRAMES))
    assert set(table["particle"]) == {4}
    assert rms_um(table, run.truth_mm) < 20
    assert rms_um(table, run.truth_mm, "naive_") > 4 * rms_um(table, run.truth_mm)
    assert rms_um(table, run.truth_mm, "rts_") > 2 * rms_um(table, run.truth_mm)
    normal = (table["y_mm"] - run.truth_mm[:, 1]) / table["sy_mm"]
    assert 0.3 < float((normal**2).mean()) < 2.5
    shake = found.shake
    error = shake["left_y_mm"].to_numpy() - run.shake_mm[0, :, 1]
    assert np.sqrt(np.mean((error / shake["sleft_y_mm"]) ** 2)) < 2.5
    assert float(shake["sleft_z_mm"].min()) > 0.05  # its own depth: nothing but the prior
    found.save(tmp_path)
    content = json.loads((tmp_path / "smoothing.json").read_text())
    assert content["residuals"]["references"]["outliers"] <= 5
    saved = pd.read_csv(tmp_path / "trajectories.csv")
    np.testing.assert_allclose(saved["x_mm"], table["x_mm"], atol=1e-5)
    with h5py.File(tmp_path / "results.h5") as file:
        rows = file["states/bubble_position_rows"][:]
        np.testing.assert_allclose(
            file["states/bubbles"][:] @ rows.T, table[["x_mm", "y_mm", "z_mm"]], atol=1e-9
        )
        assert file.attrs["inflation"] == pytest.approx((1.0, 1.0, 1.0)), "nothing disagrees"
    assert len(pd.read_csv(tmp_path / "shake.csv")) == FRAMES


def test_arm_accelerometers_with_a_late_clock(run: Run) -> None:
    """A delay of 1 ms that nobody told of is found, and costs little."""
    late = simulated(1, delay_s=1e-3)
    found = smooth(
        late.tracks, late.calibration, stage=late.stage, accelerometers=late.accelerometers, rig=RIG
    )
    sensor = found.summary["accelerometers"]["arm_left"]
    assert sensor["delay_s"] == pytest.approx(1e-3, abs=3.5e-4)
    assert rms_um(found.trajectories, late.truth_mm) < 30


def test_the_laboratorys_gravity_is_no_bias(run: Run) -> None:
    """A run in a laboratory of 9.781 m/s^2 has the biases of the same run at 9.80665 m/s^2."""

    def vertical_biases_mm_s2(one: Run, rig: Any) -> Any:
        found = smooth(
            one.tracks, one.calibration, stage=one.stage, accelerometers=one.accelerometers, rig=rig
        )
        return np.array([s["bias_y_mm_s2"] for s in found.summary["accelerometers"].values()])

    usual = vertical_biases_mm_s2(run, RIG)
    there = simulated(1, gravity_m_s2=9.781)
    stated = SimpleNamespace(stage=replace(RIG.stage, gravity_m_s2=9.781), accelerometers={})
    assert vertical_biases_mm_s2(there, stated) == pytest.approx(usual, abs=1e-6)
    missing = vertical_biases_mm_s2(there, RIG) - usual
    assert missing == pytest.approx([25.65, 25.65], abs=0.5), "then it is taken for a bias"


def with_sensors(run: Run, change: Any) -> Any:
    sensors = {name: dict(record) for name, record in run.accelerometers.items()}
    change(sensors["arm_left"])
    return smooth(run.tracks, run.calibration, stage=run.stage, accelerometers=sensors, rig=RIG)


def test_a_spoilt_sample_and_another_unit_move_nothing(run: Run) -> None:
    """One sample of 1,400 is off by 100 m/s^2; or the readings are in g, and this is said."""

    def spoil(record: dict[str, Any]) -> None:
        record["a_m_s2"] = record["a_m_s2"].copy()
        record["a_m_s2"][700] += 100.0

    def in_g(record: dict[str, Any]) -> None:
        record |= {"a": record.pop("a_m_s2") / 9.80665, "unit": "g"}

    clean = with_sensors(run, lambda record: None)
    assert clean.summary["warnings"] == [NO_COVARIANCE]
    assert clean.summary["accelerometers"]["arm_left"]["masked_samples"] == 0
    spoilt = with_sensors(run, spoil)
    assert spoilt.summary["accelerometers"]["arm_left"]["masked_samples"] == 1
    spikes, unknown = spoilt.summary["warnings"]
    assert "1 of 1400 samples are spikes" in spikes and unknown == NO_COVARIANCE
    place = ["x_mm", "y_mm", "z_mm"]
    np.testing.assert_allclose(spoilt.trajectories[place], clean.trajectories[place], atol=1e-3)
    other = with_sensors(run, in_g)
    assert other.summary["warnings"] == [NO_COVARIANCE]
    np.testing.assert_allclose(other.trajectories[place], clean.trajectories[place], atol=1e-6)


def test_an_axis_that_never_changes_does_not_hold_the_shake_still(run: Run) -> None:
    def dead(record: dict[str, Any]) -> None:
        record["a_m_s2"] = record["a_m_s2"] * [0.0, 1.0, 1.0]

    found = with_sensors(run, dead)
    assert "ax never changes" in found.summary["warnings"][0]
    table = found.trajectories
    error = (table["x_mm"] - run.truth_mm[:, 0]) / table["sx_mm"]
    assert float((error[30:-30] ** 2).mean()) < 2.0
    assert table["sx_mm"].median() > 2 * table["sy_mm"].median()


def test_sensors_that_cannot_be_used_are_left_out_in_words(run: Run) -> None:
    def elsewhere(record: dict[str, Any]) -> None:
        record["a_m_s2"] = np.asarray(record["a_m_s2"])[::-1]

    def wrong_unit(record: dict[str, Any]) -> None:
        record |= {"a": record.pop("a_m_s2"), "unit": "g"}

    sensors = {name: {**record, "clock": "frames"} for name, record in run.accelerometers.items()}
    sensors["arm_left"] = {**run.accelerometers["arm_left"]}
    elsewhere(sensors["arm_left"])
    found = smooth(run.tracks, run.calibration, stage=run.stage, accelerometers=sensors, rig=RIG)
    assert list(found.summary["accelerometers"]) == ["arm_right"]
    assert any("arm_left" in w and "not used" in w for w in found.summary["warnings"])
    with pytest.raises(SensorError) as caught:
        with_sensors(run, wrong_unit)
    assert caught.value.code == "SENSOR_UNIT"
    assert caught.value.findings[0].fix == {"sensor": "arm_left", "unit": "m/s^2"}


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
    for least, refused in ((-1e-12, False), (-1e-3, True)):
        bubbles = good.copy()
        bubbles[2, 1, 1] = least
        found = Covariances(
            good, bubbles, good, np.arange(4), good, good, none, none, good, good
        )  # fmt: skip
        expected: Any = pytest.raises(CalibrationError, match="a bubble has a negative")
        with expected if refused else nullcontext():
            _check_variances(found)


@pytest.mark.parametrize("sharp", [True, False])
def test_a_sensor_that_is_touched_for_ten_milliseconds_is_said(sharp: bool) -> None:
    """A shift with sharp ends is found in the record, one that comes and goes after the fit."""
    spoilt = simulated(1)
    table = spoilt.accelerometers["arm_left"]
    phase = np.clip((np.asarray(table["t_s"]) - 0.3) / 0.01, 0, 1)
    push = (phase > 0) & (phase < 1) if sharp else np.sin(np.pi * phase) ** 2
    sensors = dict(spoilt.accelerometers)
    reading = np.array(table["a_m_s2"])
    reading += 3.0 * push[:, None]
    sensors["arm_left"] = {**table, "a_m_s2": reading}
    found = smooth(
        spoilt.tracks, spoilt.calibration, stage=spoilt.stage, accelerometers=sensors, rig=RIG
    )
    if not sharp:
        assert found.verdict["verdict"] == "CONTRADICTED"
        return
    assert rms_um(found.trajectories, spoilt.truth_mm) < 80
    said = [w for w in found.summary["warnings"] if "are offset" in w]
    assert len(said) == 1, found.summary["warnings"]


def test_outliers_cost_little(run: Run) -> None:
    """5 % of the pixels 20 px off; the true hyper-parameters are given."""
    rng = np.random.default_rng(3)
    spoilt = run.tracks.copy()
    for camera in ("left", "right"):
        hit = rng.random(FRAMES) < 0.05
        angle = rng.uniform(0, 2 * np.pi, FRAMES)
        spoilt[f"{camera}_u_px"] += 20 * hit * np.cos(angle)
        spoilt[f"{camera}_v_px"] += 20 * hit * np.sin(angle)
    pixels = [spoilt[[f"{c}_u_px", f"{c}_v_px"]].to_numpy() for c in ("left", "right")]
    points = triangulate(cameras(), (pixels[0], pixels[1]), SIGMA_PX).points_mm
    spoilt[["x_mm", "y_mm", "z_mm"]] = points
    options = {"stage": run.stage, "references": run.references, "rig": RIG, "model": TRUE}
    clean = smooth(run.tracks, run.calibration, **options)
    robust = smooth(spoilt, run.calibration, **options)
    assert rms_um(robust.trajectories, run.truth_mm) < 1.15 * rms_um(
        clean.trajectories, run.truth_mm
    )
    outliers = robust.summary["residuals"]["bubbles"]["outliers"]
    assert 0.8 * 0.05 * 2 * FRAMES < outliers < 1.4 * 0.05 * 2 * FRAMES


def test_encoder_scale_is_found_with_references() -> None:
    from dataclasses import replace

    off = simulated(2, encoder_scale=0.01)
    model = replace(TRUE, encoder_scale_sigma=0.02)
    found = smooth(
        off.tracks,
        off.calibration,
        stage=off.stage,
        references=off.references,
        rig=RIG,
        model=model,
    )
    scale = found.summary["encoder"]
    assert scale["scale"] == pytest.approx(0.01, abs=max(4 * scale["sscale"], 1e-4))
    assert scale["sscale"] < 2e-4


def test_encoder_scale_far_from_what_is_assumed_is_found_by_default() -> None:
    """The assumed 0.1 % is no obstacle to marks that show 1 %."""
    off = simulated(2, encoder_scale=0.01)
    found = smooth(
        off.tracks, off.calibration, stage=off.stage, references=off.references, rig=UNSAID
    )
    scale = found.summary["encoder"]
    assert scale["scale_from"] == "run"
    assert scale["scale"] == pytest.approx(0.01, abs=4 * scale["sscale"])
    assert scale["sscale"] < 3e-4
    assert found.model.encoder_scale_sigma > 0.01


def test_gap_and_single_camera_detections(run: Run) -> None:
    """Frames without the bubble are bridged; one camera alone still helps."""
    table = run.tracks[(run.tracks["frame"] < 140) | (run.tracks["frame"] >= 150)]
    lone = run.tracks[(run.tracks["frame"] >= 140) & (run.tracks["frame"] < 150)]
    detections = pd.DataFrame({"frame": lone["frame"], "camera": "left", "particle": 4.0})
    for column in ("u_px", "v_px", "suu_px2", "suv_px2", "svv_px2"):
        detections[column] = lone[f"left_{column}"].to_numpy()
    options = {"stage": run.stage, "references": run.references, "rig": RIG, "model": TRUE}
    both = SimpleNamespace(table=table, detections=detections)
    with_lone = smooth(both, run.calibration, **options).trajectories
    without = smooth(table, run.calibration, **options).trajectories
    assert len(with_lone) == len(without) == FRAMES
    assert list(without["observed"][138:152]) == [1, 1] + 10 * [0] + [1, 1]
    assert with_lone["observed"].all()
    middle = 145
    assert with_lone["sy_mm"][middle] < without["sy_mm"][middle]
    assert with_lone["sx_mm"][middle] < 0.9 * without["sx_mm"][middle]
    assert np.isnan(without["naive_x_mm"][middle])


def test_oblique_cameras_with_perspective() -> None:
    """Axes coupled, projection curved: several passes, and errors as large as stated."""
    here = simulated(4, pair=oblique())
    found = smooth(
        here.tracks, here.calibration, stage=here.stage, references=here.references, rig=RIG
    )
    assert found.solution.passes > 1
    table = found.trajectories
    assert rms_um(table, here.truth_mm) < 30
    error = table[["x_mm", "y_mm", "z_mm"]].to_numpy() - here.truth_mm
    sigma = table[["sx_mm", "sy_mm", "sz_mm"]].to_numpy()
    assert 0.2 < float(((error / sigma) ** 2).mean()) < 3.0


def test_the_calibrations_uncertainty_is_carried_in(run: Run) -> None:
    """An image centre known to 0.3 px moves all points by 0.03 mm at 10 px/mm, and is said so."""
    from dataclasses import replace

    unsure = replace(
        run.calibration,
        covariance=np.diag([0.3**2, 1e-12]),
        covariance_names=("left.centre_u_px", "left.centre_v_px"),
        free=(("centre_u_px", "centre_v_px"), ()),
    )
    unsure = replace(unsure, covariance=np.pad(unsure.covariance, ((0, 6), (0, 6))))
    options = {"stage": run.stage, "references": run.references, "rig": RIG, "model": TRUE}
    sure_x = smooth(run.tracks, run.calibration, **options).trajectories["sx_mm"]
    unsure_x = smooth(run.tracks, unsure, **options).trajectories["sx_mm"]
    np.testing.assert_allclose(np.sqrt(unsure_x**2 - sure_x**2), 0.03, rtol=0.02)


def test_two_frames_and_a_bubble_seen_once(run: Run) -> None:
    seen: list[tuple[str, float]] = []
    two = run.tracks.iloc[:2]
    once = run.tracks.iloc[[1]].assign(particle=9)
    found = smooth(
        pd.concat([two, once]), run.calibration, stage=run.stage, rig=RIG, model=TRUE,
        progress=lambda what, share, _: seen.append((what, share)),
    )  # fmt: skip
    table = found.trajectories
    assert list(table["particle"]) == [4, 4, 9]
    assert np.isfinite(table[["x_mm", "vx_mm_s", "sx_mm"]].to_numpy()).all()
    assert seen[0] == ("checking tracks and sensors", 0.0)
    assert seen[-1][1] == 1.0
    assert all(0 <= share <= 1 for _, share in seen)
    assert list(found.summary["seconds"]) == [
        "checks", "learning", "smoothing", "accelerations", "verdict", "tables",
    ]  # fmt: skip


def test_too_short_a_run_to_learn_from_is_not_said_to_be_still(run: Run) -> None:
    """In 0.1 s a shake of 20 Hz shows two periods at most; the encoder alone cannot clear it."""
    frames = int(0.1 * RATE_HZ)
    few = run.tracks[run.tracks["frame"] < frames]
    found = smooth(few, run.calibration, stage=run.stage, rig=RIG)
    assert found.model.name == "default"
    assert found.verdict["verdict"] == "UNRESOLVED"
    assert "SHAKE_BELOW_NOISE" not in found.verdict["flags"]


def test_offsets_without_tracks(run: Run) -> None:
    """Accelerometers and encoder alone, true modes: the left arm's shake at the asked times."""
    from dataclasses import replace

    model = replace(TRUE, carriage=CarriageModel("force", 1500.0))
    t = np.arange(FRAMES) / RATE_HZ
    found = smooth(
        None, run.calibration, stage=run.stage, accelerometers=run.accelerometers, rig=RIG,
        model=model, t_s=t,
    )  # fmt: skip
    assert len(found.trajectories) == 0
    left = found.shake["left_y_mm"].to_numpy()
    assert np.corrcoef(left, run.shake_mm[0, :, 1])[0, 1] > 0.98


def test_bad_input(run: Run) -> None:
    good = {"stage": run.stage, "rig": RIG}
    with pytest.raises(InputError, match="no column left_u_px"):
        smooth(run.tracks.drop(columns="left_u_px"), run.calibration, **good)
    broken = run.tracks.copy()
    broken.loc[5, "right_v_px"] = np.nan
    with pytest.raises(InputError, match="row 7"):
        smooth(broken, run.calibration, **good)
    with pytest.raises(InputError, match="does not overlap"):
        smooth(run.tracks, run.calibration, stage=run.stage.assign(t_s=run.stage["t_s"] + 99))
    with pytest.raises(InputError, match="do not increase"):
        smooth(run.tracks, run.calibration, stage=run.stage.iloc[::-1])
    nameless = pd.DataFrame(
        {"t_s": [0.0, 0.1], "sensor": "x", "ax_m_s2": 0.0, "ay_m_s2": 0.0, "az_m_s2": 0.0}
    )
    with pytest.raises(InputError, match="lacks mounted_on"):
        smooth(run.tracks, run.calibration, accelerometers=nameless, **good)
    for wrong, words in (
        ({"stage": run.stage.to_numpy()}, "not a table"),
        ({"stage": {"t_s": [0.0], "positon": [0.0]}}, "did you mean position_mm"),
        ({"references": "references.csv"}, "not a table"),
        ({"references": run.references.assign(u_px=np.nan)}, "u_px is not finite at row 0"),
        ({"references": run.references.assign(sigma_px=0.0)}, "sigma_px is not positive"),
        ({"t_s": np.arange(FRAMES)[:, None]}, "t_s has the shape"),
        ({"t_s": np.arange(FRAMES)[::-1]}, "frames: times do not increase"),
        ({"rig": "rig.toml"}, "rig is str"),
    ):
        with pytest.raises(InputError, match=words):
            smooth(run.tracks, run.calibration, **{**good, **wrong})
    for change, words in (
        ({"x_mm": "far"}, "x_mm is Series of .*, not numbers"),
        ({"frame": run.tracks["frame"] + 0.5}, "frame is 0.5 in row 2"),
        ({"frame": run.tracks["frame"] - 1}, "frame is -1 in row 2"),
        ({"t_s": np.nan}, "t_s is not finite at row 0"),
        ({"particle": 0.5}, "particle is 0.5 in row 2"),
    ):
        with pytest.raises(InputError, match=words):
            smooth(run.tracks.assign(**change), run.calibration, **good)
    with pytest.raises(InputError, match="no rows"):
        smooth(run.tracks.iloc[:0], run.calibration, **good)
    for model in (3, lambda problem: "auto"):
        with pytest.raises(InputError, match="model"):
            smooth(run.tracks, run.calibration, model=model, **good)
    with pytest.raises(InputError, match="load_tracks"):
        smooth("tracks.csv", run.calibration, **good)
    with pytest.raises(InputError, match="load_calibration"):
        smooth(run.tracks, "calibration.json", **good)
    with pytest.raises(InputError, match="model is 'best'"):
        smooth(run.tracks, run.calibration, model="best", **good)
    with pytest.raises(InputError, match="the times of the frames are unknown"):
        smooth(None, run.calibration, **good)
    with pytest.raises(InputError, match="no camera 'top'"):
        smooth(run.tracks, run.calibration, references=run.references.assign(camera="top"), **good)


def test_it_is_reached_without_libraries_that_only_its_work_needs() -> None:
    code = "import sys, telerig; telerig.smooth; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    later = {"cv2", "filterpy", "gtsam", "h5py", "matplotlib", "pydantic", "scipy", "skimage"}
    assert not later & set(done.stdout.split())
