"""What stands beside a simulated run's images: encoder, accelerometers, marks, what moves."""

import tempfile
from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
import tifffile

from telerig.io.dataset.run import load_run
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.io.simulation.run.scene import AXIS_RIG, run_scene
from telerig.io.simulation.run.views import linear_projection
from telerig.io.simulation.simulate import simulate


@pytest.fixture(autouse=True, scope="module")
def _datasets_go_where_pytest_cleans_up(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("datasets")))
        yield


def few_views(name, **changes):
    config = run_preset(name, **changes)
    return replace(config, calibration=replace(config.calibration, views=2))


@cache
def dataset():
    return simulate(few_views("S2", frames=60), rng=np.random.default_rng(7), images=False)


def scene_of(config):
    """The scene that `simulate` draws from seed 7."""
    _, scene_rng, *_ = np.random.default_rng(7).spawn(5)
    return run_scene(config, true_cameras(config.calibration), scene_rng)


def cameras_table(data, name):
    return pd.read_csv(data.path / "truth" / "runs" / name / "cameras.csv")


def test_stage_and_accelerometers_agree_with_the_truth():
    data = dataset()
    cameras = cameras_table(data, "S2")
    folder = data.runs["S2"].path
    stage = pd.read_csv(folder / "stage.csv")
    at_frames = np.interp(cameras["t_s"], stage["t_s"], stage["position_mm"])
    assert np.std(at_frames - cameras["position_mm"]) == pytest.approx(0.001, rel=0.35)
    assert data.rig.stage.axis == (0.0, -1.0, 0.0)
    assert set(data.rig.accelerometers) == {"arm_left", "arm_right"}
    readings = pd.read_csv(folder / "accelerometer.csv")
    run = scene_of(few_views("S2", frames=60))
    for j, camera in enumerate(("left", "right")):
        one = readings[readings["sensor"] == f"arm_{camera}"]
        assert np.allclose(np.diff(one["t_s"]), 1 / 2000)
        path = AXIS_RIG * run.carriage.position_mm[:, None] + run.carriage.shake.offset_mm[j]
        bend = np.diff(path, 2, axis=0) * 2000.0**2 / 1000
        force = one[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy()[1:-1] - bend
        bias = force.mean(0) - 9.81 * AXIS_RIG
        assert np.abs(bias).max() < 1.0
        assert np.abs(force - force.mean(0)).max() < 0.15


def test_reference_marks_are_fixed_to_the_tank():
    data = dataset()
    marks = pd.read_csv(data.runs["S2"].path / "references.csv")
    cameras = cameras_table(data, "S2")
    per_image = marks.groupby(["frame", "camera"]).size()
    assert per_image.min() >= 3 and per_image.max() <= 6
    models = true_cameras(few_views("S2").calibration)
    for mark, rows in marks.groupby("mark"):
        camera = rows["camera"].iloc[0]
        assert str(mark).startswith(camera) and set(rows["camera"]) == {camera}
        at = cameras.set_index("frame").loc[rows["frame"]]
        origin, _ = models[camera].unproject(rows[["u_px", "v_px"]].to_numpy())
        height = origin @ AXIS_RIG + at["position_mm"].to_numpy()
        height -= at[f"{camera}_shake_y_mm"].to_numpy()
        assert height.std() < 0.03


def test_accelerometers_on_the_carriage_and_their_delay():
    config = few_views("S0", frames=20)
    stage = replace(
        config.stage,
        accelerometers=("carriage",),
        accelerometer_delay_s=0.004,
        accelerometer_bias_m_s2=0.0,
        gravity_m_s2=9.781,
        shake_mm=0.0,
        servo_rms_mm=0.0,
    )
    config = replace(config, stage=stage)
    data = simulate(config, rng=np.random.default_rng(7), images=False)
    table = pd.read_csv(data.runs["S0"].path / "accelerometer.csv")
    assert set(table["sensor"]) == {"carriage"} and table["t_s"].iloc[0] == 0.004
    t = table["t_s"].to_numpy() - 0.004
    ramp = np.where(t < 0.1, np.pi / 2 * np.sin(np.pi * t / 0.1), 0.0) / 0.1
    assert data.rig.stage is not None and data.rig.stage.gravity_m_s2 == 9.781
    expected = 9.781 + 0.28 * ramp
    noise = 22.5e-6 * 9.81 * np.sqrt(1000)
    assert (-table["ay_m_s2"] - expected).mean() == pytest.approx(0, abs=0.5 * noise)
    assert (-table["ay_m_s2"] - expected).std() == pytest.approx(noise, rel=0.15)
    assert table["ax_m_s2"].std() == pytest.approx(noise, rel=0.15)


@pytest.mark.parametrize("fixed_to", ["rig", "lab"])
def test_the_screen_rides_along_or_stays_behind(fixed_to):
    """Without noise, the image of a lab-fixed screen moves by scale times the stage's way."""
    config = few_views("rise", frames=3, bubbles=0, frame_rate_hz=200.0)
    image = replace(
        config.image, screen_fixed_to=fixed_to, window_dirt=0, lens_dirt=0, flicker=0.0,
        read_noise=0.0, shot_noise=0.0, bit_depth=16, vignetting=0.0, gradient=0.0, texture=0.1,
    )  # fmt: skip
    stage = replace(config.stage, ramp_s=0.0, shake_mm=0.0)
    config = replace(config, image=image, stage=stage)
    data = simulate(config, rng=np.random.default_rng(7))
    folder = data.runs["rise"].path / "right"
    before, after = (tifffile.imread(folder / f"{k:06d}.tif").astype(float) for k in (0, 2))
    assert np.ptp(before) > 3000
    position = cameras_table(data, "rise")["position_mm"]
    way = (position[2] - position[0]) * AXIS_RIG
    shift = -linear_projection(true_cameras(config.calibration)["right"])[1] @ way
    if fixed_to == "rig":
        assert np.abs(after - before).max() <= 1
        return
    assert shift[1] > 20
    u, v = np.meshgrid(np.arange(60.0, 450.0), np.arange(60.0, 450.0))
    there = bilinear(before, u, v)
    assert np.abs(bilinear(after, u + shift[0], v + shift[1]) - there).max() < 30


def bilinear(image, u, v):
    i, j = np.floor(v).astype(int), np.floor(u).astype(int)
    y, x = v - i, u - j
    top = image[i, j] * (1 - x) + image[i, j + 1] * x
    return top * (1 - y) + (image[i + 1, j] * (1 - x) + image[i + 1, j + 1] * x) * y


def test_a_run_of_one_frame_can_be_read():
    data = simulate(few_views("rise", frames=1), rng=np.random.default_rng(7), images=False)
    run = load_run(data.runs["rise"].path)
    assert run.frame_count == 1 and len(run.stage) > 2
    assert abs(run.position_mm[0] - cameras_table(data, "rise")["position_mm"][0]) < 0.01
