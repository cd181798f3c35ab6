"""telerig validate: marks stand still in a sound rig, and do not where something is off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose
from typer.testing import CliRunner

import telerig
from telerig.errors import InputError
from telerig.estimator.calibration.result.calibration import Calibration, calibration_from_cameras
from telerig.estimator.sensors.findings import SensorError
from telerig.estimator.smoothing.validate import (
    bubble_motion,
    longest,
    moved,
    seen_marks,
    track_of,
    validate,
)
from telerig.io.dataset.run import RunData, load_run
from telerig.io.report.validation import render
from telerig.io.results.manifest import read_manifest
from telerig.io.results.smoothing import Verdict
from telerig.io.results.validation import Rest, Stillness, ValidationFile, WithheldMark, overall
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.rig.pose import Pose
from telerig.scripts.main import app

UP = np.array([0.0, -1.0, 0.0])

pytestmark = pytest.mark.usefixtures("known_low_passes")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shaking rig with arm accelerometers, and marks that one camera each sees."""
    folder = tmp_path_factory.mktemp("validate") / "data"
    config = run_preset("S1", frames=120)
    telerig.simulate(config, rng=np.random.default_rng(3), out=folder, images=False)
    calibration_from_cameras(list(true_cameras(config.calibration).values())).save(
        folder / "results" / "calibration"
    )
    return folder


@pytest.fixture(scope="module")
def run(data: Path) -> RunData:
    return load_run(data / "runs" / "S1", source="detections")


@pytest.fixture(scope="module")
def calibration(data: Path) -> Calibration:
    return telerig.load_calibration(data / "results" / "calibration" / "calibration.json")


def turned(calibration: Calibration, degrees: float) -> Calibration:
    """The calibration with the second camera turned about its own axis."""
    first, second = calibration.cameras
    turn = Pose.from_rotvec([0.0, 0.0, np.deg2rad(degrees)])
    moved = replace(second, camera_from_rig=turn @ second.camera_from_rig)
    return replace(calibration, cameras=(first, moved))


def test_the_command_proves_a_sound_rig(data: Path) -> None:
    command = ["validate", str(data / "runs" / "S1"), "--marks", "1"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert "PASSED with the other marks" in result.output
    assert "PASSED with encoder and accelerometers only" in result.output
    folder = data / "results" / "S1"
    found = ValidationFile.read(folder / "validation.json")
    assert [mark.beside for mark in found.marks] == [Rest.MARKS, Rest.SENSORS]
    for mark in found.marks:
        assert 3 * mark.error_um < mark.unsmoothed_um
        assert mark.error_um < 2 * mark.sd_um
    assert set(read_manifest(folder).sections["validate"].files) == {
        "validation.json", "validation.html",
    }  # fmt: skip
    page = (folder / "validation.html").read_text(encoding="utf-8")
    assert "PASSED" in page and f"{found.marks[0].error_um:.3g}" in page
    (folder / "validation.html").unlink()
    again = CliRunner().invoke(app, ["report", str(folder)])
    assert again.exit_code == 0, again.output
    assert (folder / "validation.html").is_file()


def test_a_turned_camera_fails(run: RunData, calibration: Calibration) -> None:
    alone = replace(run, references=None)
    marks = longest(seen_marks(run, calibration), 2)
    right = next(mark for mark in marks if mark.cameras == (1,))
    rows = run.references
    assert rows is not None
    one = replace(alone, references=rows[rows["mark"] == right.mark])
    found = validate(one, turned(calibration, 1.0), marks=1)
    assert found.verdict is Stillness.FAILED
    assert found.marks[0].error_um > 2 * found.marks[0].sd_um
    assert "does not stand still" in render(found)


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [0.06, -0.06])
def test_a_wrong_clock_fails_is_refused_or_mended(
    run: RunData, calibration: Calibration, late_s: float
) -> None:
    assert run.accelerometers is not None
    table = run.accelerometers.assign(t_s=run.accelerometers["t_s"] + late_s)
    try:
        found = validate(replace(run, accelerometers=table), calibration, marks=1)
    except SensorError as error:
        assert "arm" in str(error)
        return
    sound = validate(run, calibration, marks=1)
    mended = all(m.error_um < 1.2 * s.error_um for m, s in zip(found.marks, sound.marks))
    assert mended or found.verdict is Stillness.FAILED


def test_a_moved_mark_moves_as_it_was_told(run: RunData, calibration: Calibration) -> None:
    motion = bubble_motion(run.t_s, UP, np.random.default_rng(1))
    steps = np.diff(motion.position_mm, axis=0) / np.diff(run.t_s)[:, None]
    mean = (motion.velocity_mm_s[1:] + motion.velocity_mm_s[:-1]) / 2
    assert_allclose(steps, mean, atol=0.2)
    for mark in longest(seen_marks(run, calibration), 2):
        camera = calibration.cameras[mark.cameras[0]]
        there = moved(mark, motion, calibration.cameras)
        across = camera.camera_from_rig.rotation[:2]
        by = (camera.unproject(there.uv_px)[0] - camera.unproject(mark.uv_px)[0]) @ across.T
        assert_allclose(by, motion.position_mm[mark.frame] @ across.T, atol=1e-6)


def test_a_mark_of_both_cameras_is_a_bubble_of_both(run: RunData, calibration: Calibration) -> None:
    frames = np.arange(40)
    point = np.array([1.0, 2.0, 3.0]) + np.outer(frames, [0.0, 0.5, 0.0])
    rows = [
        pd.DataFrame({"frame": frames, "camera": camera.name, "mark": "wire", "sigma_px": 0.1,
                      "u_px": camera.project(point)[:, 0], "v_px": camera.project(point)[:, 1]})
        for camera in calibration.cameras
    ]  # fmt: skip
    rows[1] = rows[1].iloc[3:]
    (mark,) = seen_marks(replace(run, references=pd.concat(rows)), calibration)
    assert mark.cameras == (0, 1)
    track = track_of(mark, calibration, run.t_s).table
    assert track["frame"].tolist() == list(range(3, 40))
    assert_allclose(track[["x_mm", "y_mm", "z_mm"]], point[3:], atol=1e-6)


def test_marks_of_three_cameras(run: RunData) -> None:
    """One that the third camera alone sees, and one that all see, but not in the same frames."""
    cameras = list(true_cameras(run_preset("swarm_three").calibration).values())
    three = calibration_from_cameras(cameras)
    frames = np.arange(40)
    point = np.array([1.0, 2.0, 3.0]) + np.outer(frames, [0.0, 0.5, 0.0])
    seen = {"wire": (slice(0, 40), slice(5, 40), slice(10, 36)), "dot": (None, None, slice(0, 40))}
    rows = [
        pd.DataFrame({"frame": frames, "camera": camera.name, "mark": name, "sigma_px": 0.1,
                      "u_px": camera.project(point)[:, 0], "v_px": camera.project(point)[:, 1]})[of]
        for name, every in seen.items()
        for camera, of in zip(cameras, every, strict=True) if of is not None
    ]  # fmt: skip
    marks = {m.mark: m for m in seen_marks(replace(run, references=pd.concat(rows)), three)}
    assert {name: mark.cameras for name, mark in marks.items()} == {"wire": (0, 1, 2), "dot": (2,)}
    assert len(longest(list(marks.values()), 6)) == 2
    wire, dot = (track_of(marks[name], three, run.t_s).table for name in ("wire", "dot"))
    assert wire["frame"].tolist() == list(range(5, 40))
    assert_allclose(wire[["x_mm", "y_mm", "z_mm"]], point[5:], atol=1e-6)
    last = cameras[2].name
    assert wire[f"{last}_u_px"].notna().to_numpy().tolist() == [10 <= f < 36 for f in range(5, 40)]
    assert wire[f"{last}_suv_px2"].isna().equals(wire[f"{last}_u_px"].isna())
    assert dot["frame"].tolist() == [0, 39]
    assert_allclose(dot[[f"{last}_u_px", f"{last}_v_px"]], cameras[2].project(point[[0, 39]]))
    assert np.all(dot[f"{cameras[0].name}_suu_px2"] > 1e7)


def test_a_run_without_marks_is_refused(run: RunData, calibration: Calibration) -> None:
    with pytest.raises(InputError, match="nothing that is known to stand still"):
        validate(replace(run, references=None), calibration)
    assert run.references is not None
    few = run.references[run.references["frame"] < 20]
    with pytest.raises(InputError, match="in 30 frames or more, the most frequent one in 20"):
        validate(replace(run, references=few), calibration)


@pytest.mark.parametrize(
    ("nees", "velocity_nees", "smoothing", "verdict"),
    [
        (1.9, 0.5, Verdict.RESOLVED, Stillness.PASSED),
        (2.1, 0.5, Verdict.RESOLVED, Stillness.FAILED),
        (0.5, 2.1, Verdict.UNRESOLVED, Stillness.FAILED),
        (0.5, 0.5, Verdict.CONTRADICTED, Stillness.FAILED),
    ],
)
def test_the_verdict(
    nees: float, velocity_nees: float, smoothing: Verdict, verdict: Stillness
) -> None:
    mark = WithheldMark(
        mark="a", beside=Rest.MARKS, cameras=("left",), frames=100, error_um=3.0, sd_um=4.0,
        nees=nees, velocity_error_mm_s=1.0, velocity_sd_mm_s=2.0, velocity_nees=velocity_nees,
        unsmoothed_um=100.0, smoothing=smoothing,
    )  # fmt: skip
    assert mark.verdict is verdict
    assert overall([mark, mark], Rest.MARKS).verdict is verdict
