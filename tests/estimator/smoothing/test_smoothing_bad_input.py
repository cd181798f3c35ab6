"""Bad input of a smoothed run: every case ends in an error or a warning that names it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
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
from telerig.estimator.smoothing.smooth import problem_of, smooth, with_sensors_aligned
from telerig.io.dataset.run import RunData
from telerig.io.rig_file.description import StageDescription
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.rig.camera import Camera
from telerig.rig.triangulation import triangulate

pytestmark = pytest.mark.usefixtures("known_low_passes")

FRAMES = 250
ACCELERATIONS = ["ax_m_s2", "ay_m_s2", "az_m_s2"]
Change = Callable[[pd.DataFrame], pd.DataFrame | None]


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


def spoil(file: Path, change: Change) -> None:
    table = pd.read_csv(file)
    changed = change(table)
    (table if changed is None else changed).to_csv(file, index=False)


def refused(run: Path) -> InputError:
    """Loading, checking or smoothing ends in an InputError with what to do."""
    with pytest.raises(InputError) as caught:
        data = telerig.load_run(run)
        smooth(tracks(data), calibration(), stage=data, model=ShakeModel())
    assert caught.value.todo
    return caught.value


def warned(run: Path) -> list[str]:
    return settled(check_sensors(telerig.load_run(run)), frozenset())


def add(column: str, value: float) -> Change:
    return lambda table: table.assign(**{column: table[column] + value})


def scaled(factor: float) -> Change:
    return lambda table: table.assign(**{a: factor * table[a] for a in ACCELERATIONS})


def turned(*rows: list[float]) -> Change:
    """Readings of a sensor that is mounted otherwise."""

    def change(table: pd.DataFrame) -> None:
        table[ACCELERATIONS] = table[ACCELERATIONS].to_numpy() @ np.array(rows).T

    return change


def test_a_good_run_is_told_nothing(dataset: Path) -> None:
    data = telerig.load_run(dataset / "runs" / "S2")
    assert check_sensors(data, tracks=tracks(data), calibration=calibration()) == []


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("stage.csv", add("t_s", 1000.0), ["does not overlap", "stage.csv", "add -1"]),
        (
            "accelerometer.csv",
            lambda t: t.assign(sensor=t["sensor"].replace("arm_left", "arm_lfet")),
            ["no accelerometer 'arm_lfet'", "did you mean arm_left?"],
        ),
    ],
)
def test_tables_that_cannot_be_used(file: str, change: Change, words: list[str], run: Path) -> None:
    spoil(run / file, change)
    message = str(refused(run))
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (scaled(1 / 9.80665), "SENSOR_UNIT"),
        (add("ay_m_s2", 9.80665), "SENSOR_GRAVITY"),
        (scaled(0.5), "SENSOR_SCALE"),
        # x points up, rig.toml says y points down
        (turned([0, 1, 0], [-1, 0, 0], [0, 0, 1]), "SENSOR_AXES"),
        (turned([-1, 0, 0], [0, -1, 0], [0, 0, 1]), "SENSOR_AXES"),
    ],
    ids=["in g", "without gravity", "halved", "turned", "upside down"],
)
def test_accelerometers_that_gravity_contradicts(change: Change, code: str, run: Path) -> None:
    spoil(run / "accelerometer.csv", change)
    error = refused(run)
    assert isinstance(error, SensorError) and error.code == code
    assert f"--accept {code}" in str(error)


# --- clocks ------------------------------------------------------------------------------------


@pytest.mark.parametrize("backwards", [False, True])
def test_a_clock_that_does_not_overlap_is_aligned_if_the_images_show_the_motion(
    backwards: bool, run: Path
) -> None:
    def change(table: pd.DataFrame) -> None:
        table["t_s"] += 1000.0
        if backwards:
            table[ACCELERATIONS] = table[ACCELERATIONS].to_numpy()[::-1]

    spoil(run / "accelerometer.csv", change)
    if backwards:
        message = str(refused(run))
        assert "does not overlap" in message and "add -1" in message
        return
    data = telerig.load_run(run)
    problem, _, _, known = problem_of(tracks(data), calibration(), stage=data)
    problem, found = with_sensors_aligned(problem, known)
    assert len(problem.accelerometers) == 2
    for sensor in problem.accelerometers:
        assert sensor.confirmed and sensor.offset_s == pytest.approx(1000.0, abs=2e-3)
    assert any("its times have been corrected" in f.warning for f in found)


def test_times_in_milliseconds(run: Path) -> None:
    spoil(run / "accelerometer.csv", lambda t: t.assign(t_s=1000 * (t["t_s"] + 100)))
    spoil(run / "frames.csv", add("t_s", 100.0))
    spoil(run / "stage.csv", add("t_s", 100.0))
    message = str(refused(run))
    assert "look like milliseconds" in message and "divide them by 1000" in message


@pytest.mark.parametrize("start_s", [0.0, 100.0])
def test_frames_in_milliseconds(start_s: float, run: Path) -> None:
    spoil(run / "frames.csv", lambda t: t.assign(t_s=1000 * (t["t_s"] + start_s)))
    for file in ("stage.csv", "accelerometer.csv"):
        spoil(run / file, add("t_s", start_s))
    error = refused(run)
    assert isinstance(error, SensorError) and error.code == "FRAME_TIMES"
    assert "divide them by 1000" in str(error)


def test_a_record_that_ends_early_is_told(run: Path) -> None:
    spoil(run / "stage.csv", lambda table: table[: len(table) // 2])
    (warning,) = warned(run)
    assert "S2/stage.csv" in warning and "% of the frames" in warning


# --- the encoder -------------------------------------------------------------------------------


def jumps_in(error: InputError) -> Any:
    """Times and lengths of the jumps that the error's correction takes out."""
    assert isinstance(error, SensorError) and error.code == "ENCODER_JUMP"
    return error.findings[0].fix["encoder_jumps"]


@pytest.mark.parametrize("size", [0.4, -7.0])
def test_an_encoder_that_jumps(size: float, run: Path) -> None:
    def change(table: pd.DataFrame) -> None:
        table.loc[300:, "position_mm"] += size

    spoil(run / "stage.csv", change)
    (jump,) = jumps_in(refused(run))
    assert jump == pytest.approx((pd.read_csv(run / "stage.csv")["t_s"][300], size), abs=0.05)


def test_a_counter_that_wraps_round(run: Path) -> None:
    """A 16 bit counter of 1 µm steps: 65.536 mm to and fro."""
    wrap = 65.536
    low = pd.read_csv(run / "stage.csv")["position_mm"].iloc[300] - wrap

    def change(table: pd.DataFrame) -> None:
        table["position_mm"] = np.round((table["position_mm"] - low) % wrap, 3)

    spoil(run / "stage.csv", change)
    error = refused(run)
    assert "unwrap" in str(error)
    assert jumps_in(error)[0][1] == pytest.approx(-wrap, abs=0.05)


def test_single_wrong_readings_are_not_used(run: Path) -> None:
    clean = telerig.load_run(run).stage
    assert clean is not None

    def change(table: pd.DataFrame) -> None:
        table.loc[300:301, "position_mm"] += 3.0

    spoil(run / "stage.csv", change)
    (warning,) = warned(run)
    assert "2 reading(s)" in warning and "not used" in warning
    data = telerig.load_run(run)
    problem, _, _, findings = problem_of(tracks(data), calibration(), stage=data)
    assert [f.warning for f in findings] == [warning] and problem.stage is not None
    kept = np.delete(clean["position_mm"].to_numpy(), [300, 301])
    np.testing.assert_allclose(problem.stage.position_mm, kept, atol=1e-9)


# --- mounting, names, short runs, tracks --------------------------------------------------------


@pytest.mark.parametrize(
    ("felt", "sign", "told"), [(0, -1, ""), (2, 1, "[-1, 0, 0]]"), (0, 1, "[[-1, 0, 0], [0, 1, 0]")]
)
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
    assert all(told in w and "that the encoder shows" in w for w in words), words


def test_one_frame_is_too_few(run: Path) -> None:
    data = telerig.load_run(run)
    table = tracks(data)
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
