"""Runs of a rig of three cameras: tracked and smoothed with the two that `[tracking]` names."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import telerig
from telerig.errors import InputError
from telerig.estimator.calibration.calibrate import calibrate
from telerig.estimator.calibration.quality.truth import true_cameras
from telerig.estimator.calibration.result.calibration import Calibration, calibration_from_cameras
from telerig.estimator.smoothing.results_folder import smooth_run
from telerig.estimator.tracking.results_folder import write_tracking
from telerig.estimator.tracking.track import TrackOptions
from telerig.io.dataset.dataset import load_dataset
from telerig.io.dataset.run import load_run
from telerig.io.simulation.presets import preset, run_preset
from telerig.io.simulation.simulate import simulate
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

pytestmark = pytest.mark.usefixtures("without_advice", "known_low_passes")

THIRD = "[cameras.middle]\nimage_size_px = [512, 512]\nscale_px_per_mm = 10.0\n"


@pytest.fixture(scope="module")
def rise(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("three") / "rise"
    config = run_preset("rise", frames=30)
    simulate(config, rng=np.random.default_rng(1), out=folder, images=False)
    return folder


def calibrations(folder: Path) -> tuple[Calibration, Calibration]:
    """Of the run's two cameras, and with a third one between them."""
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    left, right = true_cameras(truth)
    middle = Camera.create(
        "middle", (512, 512), 10.0, camera_from_rig=Pose.from_rotvec([0.0, 0.8, 0.0])
    )
    both = (calibration_from_cameras(c) for c in ([left, right], [left, middle, right]))
    two, three = (replace(c, findings=()) for c in both)
    return two, three


def with_third(rise: Path, place: Path, tracking: str) -> Path:
    """The dataset with a camera between the two, which saw a bubble of its own."""
    folder = Path(shutil.copytree(rise, place))
    text = (folder / "rig.toml").read_text()
    text = text.replace("[cameras.right]", THIRD + "[cameras.right]", 1)
    (folder / "rig.toml").write_text(text + tracking)
    run = next((folder / "runs").iterdir())
    table = pd.read_csv(run / "detections.csv")
    own = table.iloc[:20].assign(camera="middle", u_px=200.0)
    pd.concat([table, own]).to_csv(run / "detections.csv", index=False)
    return run


def test_a_run_takes_the_two_cameras_that_tracking_names(rise: Path, tmp_path: Path) -> None:
    two, three = calibrations(rise)
    plain = next((rise / "runs").iterdir())
    tracking = '[tracking]\ncameras = ["left", "right"]\n'
    run = with_third(rise, tmp_path / "rig", tracking)
    for name, path, calibration in (("two", plain, two), ("three", run, three)):
        data = load_run(path)
        assert data.cameras == ("left", "right")
        out = tmp_path / name
        write_tracking(data, calibration, out, options=TrackOptions(), record={}, report=False)
        smooth_run(data, calibration, out, out, model="default", report=name == "three")
    for table in ("tracks.csv", "trajectories.csv", "shake.csv"):
        assert (tmp_path / "two" / table).read_text() == (tmp_path / "three" / table).read_text()
    notes = load_run(run).notes
    assert any("of left, middle, right, the run is that of cameras left, right" in n for n in notes)


def test_by_default_the_first_two_are_tracked(rise: Path, tmp_path: Path) -> None:
    data = load_run(with_third(rise, tmp_path / "rig", ""))
    assert data.cameras == ("left", "middle")
    assert set(data.detections["camera"]) == {"left", "middle"}


def test_detections_of_none_of_the_two_are_refused(rise: Path, tmp_path: Path) -> None:
    run = with_third(rise, tmp_path / "rig", "")
    table = pd.read_csv(run / "detections.csv")
    table[table["camera"] == "right"].to_csv(run / "detections.csv", index=False)
    with pytest.raises(InputError, match="no row of the cameras left, middle"):
        load_run(run)


def test_a_pair_without_the_first_camera(tmp_path: Path) -> None:
    """Calibrated from dots with a stage axis, tracked and smoothed in the first camera's frame."""
    config = run_preset("rise", frames=20)
    stage = replace(config.stage, axis_views=5)
    config = replace(config, calibration=preset("three"), stage=stage)
    data = simulate(config, rng=np.random.default_rng(3), out=tmp_path / "rig", images=False)
    with (data.path / "rig.toml").open("a") as file:
        file.write('[tracking]\ncameras = ["middle", "right"]\n')
    calibration = calibrate(load_dataset(data.path), model="radial")
    assert calibration.verdict["status"] == "GOOD"
    assert calibration.stage["chi2_dof"] == pytest.approx(1, abs=0.4)
    run = load_run(next((data.path / "runs").iterdir()))
    assert run.cameras == ("middle", "right")
    tracks = telerig.track(run, calibration)
    assert len(tracks.table) == 20
    pair = calibration.pair("middle", "right")
    uv = [tracks.table[[f"{c}_u_px", f"{c}_v_px"]].to_numpy(float) for c in run.cameras]
    found = pair.triangulate(*uv, sigma_px=0.1)
    assert np.abs(found.points_mm - tracks.table[["x_mm", "y_mm", "z_mm"]]).to_numpy().max() < 0.5
    smoothed = telerig.smooth(tracks, calibration, stage=run, model="default")
    assert len(smoothed.trajectories) == 20
    assert {"middle_y_mm", "right_y_mm"} <= set(smoothed.shake)
