"""Bad input of a smoothed run: every case ends in an error or a warning that names it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import telerig
from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import (
    Calibration,
    calibration_from_cameras,
)
from telerig.estimator.sensors.checks import check_sensors
from telerig.estimator.sensors.findings import SensorError, settled
from telerig.estimator.smoothing.problem.problem import ShakeModel
from telerig.estimator.smoothing.smooth import smooth
from telerig.io.dataset.run import RunData
from telerig.io.results.calibration_words import NO_COVARIANCE
from telerig.io.rig_file.description import StageDescription
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.rig.camera import Camera
from telerig.rig.triangulation import triangulate

FRAMES = 250
ACCELERATIONS = ["ax_m_s2", "ay_m_s2", "az_m_s2"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenario S2, half a second of it, with encoder, arm accelerometers and marks."""
    folder = tmp_path_factory.mktemp("bad") / "data"
    config = run_preset("S2", frames=FRAMES)
    config = replace(config, calibration=replace(config.calibration, views=2))
    telerig.simulate(config, rng=np.random.default_rng(3), out=folder, images=False)
    return folder


@pytest.fixture
def run(dataset: Path, tmp_path: Path) -> Path:
    """A copy of the run to spoil."""
    copy = tmp_path / "data"
    shutil.copytree(dataset, copy)
    return copy / "runs" / "S2"


def calibration() -> Calibration:
    cameras = list(true_cameras(run_preset("S2").calibration).values())
    return calibration_from_cameras(cameras, name="truth")


def tracks(run: RunData) -> pd.DataFrame:
    """Triangulated detections of the only bubble, as tracks.csv has them."""
    pair = calibration().cameras
    assert run.detections is not None
    seen = run.detections.assign(particle="0")
    both = [
        seen[seen["camera"] == c.name].drop_duplicates("frame").set_index("frame") for c in pair
    ]
    frames = both[0].index.intersection(both[1].index)
    uv = [one.loc[frames, ["u_px", "v_px"]].to_numpy(float) for one in both]
    table = pd.DataFrame({"frame": frames, "particle": 0, "t_s": run.t_s[frames]})
    table[["x_mm", "y_mm", "z_mm"]] = triangulate((pair[0], pair[1]), (uv[0], uv[1]), 0.5).points_mm
    for camera, pixels in zip(pair, uv):
        table[[f"{camera.name}_u_px", f"{camera.name}_v_px"]] = pixels
        for name, value in (("uu", 0.25), ("uv", 0.0), ("vv", 0.25)):
            table[f"{camera.name}_s{name}_px2"] = value
    return table


def spoil(file: Path, change: Any) -> None:
    table = pd.read_csv(file)
    changed = change(table)
    (table if changed is None else changed).to_csv(file, index=False)


def refused(run: Path, *words: str) -> str:
    """Loading, checking or smoothing ends in an InputError with what to do and these words."""
    with pytest.raises(InputError) as caught:
        data = telerig.load_run(run)
        smooth(tracks(data), calibration(), stage=data, model=ShakeModel())
    message = str(caught.value)
    assert "\n  -> " in message, message
    for word in words:
        assert word in message, message
    return message


def warned(run: Path, *words: str) -> list[str]:
    found = settled(check_sensors(telerig.load_run(run)), frozenset())
    assert any(all(word in line for word in words) for line in found), found
    return found


def add(column: str, value: float) -> Any:
    def change(table: pd.DataFrame) -> None:
        table[column] += value

    return change


def test_a_good_run_is_told_nothing(dataset: Path) -> None:
    data = telerig.load_run(dataset / "runs" / "S2")
    assert check_sensors(data, tracks=tracks(data), calibration=calibration()) == []


# --- clocks ------------------------------------------------------------------------------------


def test_an_encoder_whose_clock_does_not_overlap(run: Path) -> None:
    spoil(run / "stage.csv", add("t_s", 1000.0))
    message = refused(run, "does not overlap", "stage.csv", "one clock")
    assert "add -1" in message


def test_accelerometers_whose_clock_does_not_overlap_are_aligned_with_the_images(run: Path) -> None:
    spoil(run / "accelerometer.csv", add("t_s", 1000.0))
    data = telerig.load_run(run)
    found = smooth(tracks(data), calibration(), stage=data, model=ShakeModel())
    for sensor in found.summary["accelerometers"].values():
        assert sensor["confirmed"]
        assert sensor["offset_s"] == pytest.approx(1000.0, abs=2e-3)
    assert any("its times have been corrected" in w for w in found.summary["warnings"])


def test_accelerometers_of_another_time_are_refused(run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table[ACCELERATIONS] = table[ACCELERATIONS].to_numpy()[::-1]
        table["t_s"] += 1000.0

    spoil(run / "accelerometer.csv", change)
    assert "add -1" in refused(run, "does not overlap", "accelerometer.csv", "one clock")


def test_times_in_milliseconds(run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table["t_s"] = 1000 * (table["t_s"] + 100)

    spoil(run / "accelerometer.csv", change)
    spoil(run / "frames.csv", add("t_s", 100.0))
    spoil(run / "stage.csv", add("t_s", 100.0))
    refused(run, "look like milliseconds", "divide them by 1000")


@pytest.mark.parametrize("start_s", [0.0, 100.0])
def test_frames_in_milliseconds(start_s: float, run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table["t_s"] = 1000 * (table["t_s"] + start_s)

    spoil(run / "frames.csv", change)
    for file in ("stage.csv", "accelerometer.csv"):
        spoil(run / file, add("t_s", start_s))
    message = refused(run, "the frames' times look like milliseconds", "--accept FRAME_TIMES")
    assert "divide them by 1000" in message


def test_a_record_that_ends_early_is_told(run: Path) -> None:
    spoil(run / "stage.csv", lambda table: table[: len(table) // 2])
    warned(run, "S2/stage.csv", "% of the frames")


@pytest.mark.parametrize("file", ["frames.csv", "stage.csv", "accelerometer.csv"])
@pytest.mark.parametrize("gap", [0.0, -0.01], ids=["duplicated", "backwards"])
def test_times_that_do_not_increase(file: str, gap: float, run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table.loc[20, "t_s"] = table.loc[19, "t_s"] + gap

    spoil(run / file, change)
    refused(run, file, "row 22", "not later than")


# --- the encoder -------------------------------------------------------------------------------


def moment(run: Path, row: int) -> str:
    return f"{pd.read_csv(run / 'stage.csv')['t_s'][row]:.6g} s"


@pytest.mark.parametrize("size", [0.4, -7.0])
def test_an_encoder_that_jumps(size: float, run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table.loc[300:, "position_mm"] += size

    spoil(run / "stage.csv", change)
    message = refused(run, "the reading jumps", moment(run, 300), "subtract")
    assert float(message.split("jumps by ")[1].split(" mm")[0]) == pytest.approx(size, abs=0.05)


def test_a_counter_that_wraps_round(run: Path) -> None:
    """A 16 bit counter of 1 µm steps: 65.536 mm to and fro."""
    wrap = 65.536
    low = pd.read_csv(run / "stage.csv")["position_mm"].iloc[300] - wrap

    def change(table: pd.DataFrame) -> None:
        table["position_mm"] = np.round((table["position_mm"] - low) % wrap, 3)

    spoil(run / "stage.csv", change)
    message = refused(run, "wraps round", "unwrap")
    size = float(message.split("wraps round by ")[1].split(" mm")[0])
    assert size == pytest.approx(-wrap, abs=0.05)


def test_single_wrong_readings(run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table.loc[300:301, "position_mm"] += 3.0

    data = telerig.load_run(run)
    clean = smooth(tracks(data), calibration(), stage=data, model=ShakeModel()).trajectories
    spoil(run / "stage.csv", change)
    warned(run, "2 reading(s)", moment(run, 300), "+2.99", "not used")
    found = smooth(tracks(data), calibration(), stage=telerig.load_run(run), model=ShakeModel())
    _, unknown = found.summary["warnings"]
    assert unknown == NO_COVARIANCE
    np.testing.assert_allclose(found.trajectories["y_mm"], clean["y_mm"], atol=2e-3)


# --- accelerometers ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("factor", "unit"), [(1 / 9.80665, "in g"), (1000.0, "mm/s^2"), (1000 / 9.80665, "mg")]
)
def test_accelerometers_in_another_unit(factor: float, unit: str, run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table[ACCELERATIONS] *= factor

    spoil(run / "accelerometer.csv", change)
    message = refused(run, unit, "multiply", "sensor arm_left", "--accept SENSOR_UNIT")
    said = float(message.split(" by ")[-1].split(". To use")[0])
    assert said == pytest.approx(1 / factor, rel=0.1 if unit == "mg" else 1e-5)


def test_gravity_taken_out(run: Path) -> None:
    spoil(run / "accelerometer.csv", add("ay_m_s2", 9.80665))
    refused(run, "gravity has been subtracted")


def test_gravity_in_no_unit(run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table[ACCELERATIONS] *= 0.5

    spoil(run / "accelerometer.csv", change)
    refused(run, "not gravity in any known unit")


def test_saturated_samples_are_counted(run: Path) -> None:
    table = pd.read_csv(run / "accelerometer.csv")
    left = table["sensor"] == "arm_left"
    low = float(table.loc[left, "ay_m_s2"].quantile(0.1))
    count = int((table.loc[left, "ay_m_s2"] <= low).sum())

    def change(table: pd.DataFrame) -> None:
        table.loc[left, "ay_m_s2"] = table.loc[left, "ay_m_s2"].clip(lower=low)

    spoil(run / "accelerometer.csv", change)
    found = warned(run, f"{count} of {int(left.sum())} samples of ay are clipped", "arm_left")
    assert len(found) == 1


def test_a_dead_axis(run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table["ax_m_s2"] = 0.0

    spoil(run / "accelerometer.csv", change)
    warned(run, "ax never changes")


def test_wrong_mounting_axes(run: Path) -> None:
    """The sensor's x points up, rig.toml says y points down: the axes that fit are told."""

    def change(table: pd.DataFrame) -> None:
        given = table[ACCELERATIONS].to_numpy()
        table[ACCELERATIONS] = given @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])

    spoil(run / "accelerometer.csv", change)
    found = check_sensors(telerig.load_run(run))
    assert len([f for f in found if "away from up" in f.words]) == 2
    refused(run, "arm_left", "deg away from up", "would fit", "--accept SENSOR_AXES")


def test_upside_down(run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table[["ax_m_s2", "ay_m_s2"]] *= -1

    spoil(run / "accelerometer.csv", change)
    refused(run, "178 deg away from up")


@pytest.mark.parametrize(("felt", "sign", "told"), [(0, -1, ""), (2, 1, "-z"), (0, 1, "-x")])
def test_axes_that_gravity_cannot_tell(felt: int, sign: int, told: str, run: Path) -> None:
    """A stage that travels along x: the encoder's acceleration must be felt there, with its sign.

    The run's own travel is along -y, so that minus its reading is the push along x.
    """
    data = telerig.load_run(run)
    assert data.accelerometers is not None and data.rig is not None
    table = data.accelerometers.copy()
    push = table["ay_m_s2"].to_numpy() + 9.81
    still = 0.05 * np.random.default_rng(1).standard_normal((len(table), 3))
    table[ACCELERATIONS] = still - [0.0, 9.81, 0.0]
    table[ACCELERATIONS[felt]] += sign * push
    rig = replace(data.rig, stage=StageDescription((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), 0.001))
    words = settled(check_sensors(replace(data, rig=rig, accelerometers=table)), frozenset())
    assert len(words) == (2 if told else 0), words
    assert all(f"appears along {told} of the sensor" in w for w in words), words


@pytest.mark.parametrize(("turned", "axis"), [("arm_left", "ax"), ("arm_right", "az")])
@pytest.mark.parametrize("marks", [True, False])
def test_of_two_arms_that_contradict_each_other_the_sound_one_is_not_blamed(
    turned: str, axis: str, marks: bool, run: Path
) -> None:
    """The axis that its camera sees from the side."""

    def change(table: pd.DataFrame) -> None:
        table.loc[table["sensor"] == turned, f"{axis}_m_s2"] *= -1

    spoil(run / "accelerometer.csv", change)
    data = telerig.load_run(run)
    seen = data if marks else replace(data, references=None)
    with pytest.raises(SensorError) as caught:
        smooth(tracks(data), calibration(), stage=seen, model=ShakeModel())
    assert caught.value.code == "SENSOR_AXES"
    fix = caught.value.findings[0].fix
    assert fix.get("sensor") == turned or (not fix and turned in str(caught.value))
    assert fix or not marks


# --- names, NaN, short runs, tracks -------------------------------------------------------------


def test_a_sensor_that_rig_toml_does_not_name(run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table["sensor"] = table["sensor"].replace("arm_left", "arm_lfet")

    spoil(run / "accelerometer.csv", change)
    refused(run, "no accelerometer 'arm_lfet'", "did you mean arm_left?")


def test_a_table_with_a_sensor_unknown(run: Path) -> None:
    data = telerig.load_run(run)
    assert data.accelerometers is not None
    table = data.accelerometers.assign(sensor="arm_lefd")
    with pytest.raises(InputError, match="did you mean arm_left"):
        check_sensors(replace(data, accelerometers=table))
    with pytest.raises(InputError, match="arm_lefd"):
        smooth(tracks(data), calibration(), stage=data, accelerometers=table)


@pytest.mark.parametrize(
    ("file", "column"),
    [("frames.csv", "t_s"), ("stage.csv", "position_mm"), ("accelerometer.csv", "ay_m_s2"),
     ("references.csv", "u_px")],
)  # fmt: skip
def test_nan_rows(file: str, column: str, run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table.loc[7, column] = np.nan

    spoil(run / file, change)
    refused(run, f"{file} row 9", column)


def test_nan_in_tables_from_memory(run: Path) -> None:
    data = telerig.load_run(run)
    assert data.accelerometers is not None and data.stage is not None
    table, stage = data.accelerometers.copy(), data.stage.copy()
    table.loc[5, "ay_m_s2"] = np.nan
    stage.loc[5, "position_mm"] = np.nan
    with pytest.raises(InputError, match="not finite"):
        smooth(tracks(data), calibration(), stage=data, accelerometers=table)
    with pytest.raises(InputError, match="not finite"):
        smooth(tracks(data), calibration(), stage=stage, t_s=data.t_s)
    with pytest.raises(InputError, match="not finite"):
        check_sensors(replace(data, accelerometers=table))


def test_a_run_of_two_frames_and_of_one(run: Path) -> None:
    data = telerig.load_run(run)
    table = tracks(data)
    found = smooth(table[table["frame"] < 2], calibration(), stage=data.stage, rig=data.rig,
                   t_s=data.t_s[:2], references=data.references)  # fmt: skip
    assert np.isfinite(found.trajectories[["x_mm", "sx_mm", "vx_mm_s"]].to_numpy()).all()
    with pytest.raises(InputError, match="at least two frames"):
        smooth(table[table["frame"] < 1], calibration(), rig=data.rig, t_s=data.t_s[:1])


def other(change: Any) -> Calibration:
    cameras: list[Camera] = [change(c) for c in calibration().cameras]
    return calibration_from_cameras(cameras, name="other")


def test_tracks_of_another_calibration(run: Path) -> None:
    data = telerig.load_run(run)
    table = tracks(data)
    renamed = other(lambda c: replace(c, name=c.name + "_new"))
    for refuse in (
        lambda: check_sensors(data, tracks=table, calibration=renamed),
        lambda: smooth(table, renamed, stage=data),
    ):
        with pytest.raises(InputError, match="left_new") as caught:
            refuse()
        assert "this calibration" in str(caught.value)
    moved = other(lambda c: c.with_parameters(centre_u_px=c["centre_u_px"] + 30))
    with pytest.raises(InputError, match="another calibration"):
        check_sensors(data, tracks=table, calibration=moved)
    again = other(lambda c: c.with_parameters(centre_v_px=c["centre_v_px"] + 1))
    words = check_sensors(data, tracks=table, calibration=again)
    assert len(words) == 1 and "another calibration" in words[0].words
