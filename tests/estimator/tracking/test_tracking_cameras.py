"""Runs of a rig of three cameras: tracked and smoothed with all, or with those that are named."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import telerig
from telerig.command_options import SmoothingOptions
from telerig.errors import InputError
from telerig.estimator.calibration.calibrate import calibrate
from telerig.estimator.calibration.result.calibration import Calibration, calibration_from_cameras
from telerig.estimator.smoothing.results_folder import smooth_run
from telerig.estimator.tracking.results_folder import write_tracking
from telerig.estimator.tracking.track import TrackOptions
from telerig.io.dataset.dataset import load_dataset
from telerig.io.dataset.run import load_run
from telerig.io.simulation.calibration.scene import true_cameras
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
    left, right = true_cameras(run_preset("rise").calibration).values()
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


@pytest.mark.slow
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
        smooth_run(
            data, calibration, out, out, SmoothingOptions(model="default"), report=name == "three"
        )
    for table in ("tracks.csv", "trajectories.csv", "shake.csv"):
        assert (tmp_path / "two" / table).read_text() == (tmp_path / "three" / table).read_text()
    notes = load_run(run).notes
    assert any("of left, middle, right, the run is that of cameras left, right" in n for n in notes)


def test_by_default_all_that_saw_bubbles_are_tracked(rise: Path, tmp_path: Path) -> None:
    run = with_third(rise, tmp_path / "rig", "")
    assert load_run(run).cameras == ("left", "middle", "right")
    table = pd.read_csv(run / "detections.csv")
    table[table["camera"] != "middle"].to_csv(run / "detections.csv", index=False)
    data = load_run(run)
    assert data.cameras == ("left", "right")
    assert set(data.detections["camera"]) == {"left", "right"}


def test_detections_of_none_of_the_two_are_refused(rise: Path, tmp_path: Path) -> None:
    run = with_third(rise, tmp_path / "rig", '[tracking]\ncameras = ["left", "middle"]\n')
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
    pair = calibration.subset("middle", "right")
    uv = [tracks.table[[f"{c}_u_px", f"{c}_v_px"]].to_numpy(float) for c in run.cameras]
    found = pair.triangulate(*uv, sigma_px=0.1)
    assert np.abs(found.points_mm - tracks.table[["x_mm", "y_mm", "z_mm"]]).to_numpy().max() < 0.5
    smoothed = telerig.smooth(tracks, calibration, stage=run, model="default")
    assert len(smoothed.trajectories) == 20
    assert {"middle_y_mm", "right_y_mm"} <= set(smoothed.shake)


@pytest.fixture(scope="module")
def swarm(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Calibration]:
    folder = tmp_path_factory.mktemp("swarm") / "three"
    config = run_preset("swarm_three", frames=24, bubbles=10)
    data = simulate(config, rng=np.random.default_rng(5), out=folder, images=False)
    known = calibration_from_cameras(list(true_cameras(config.calibration).values()))
    return next((data.path / "runs").iterdir()), replace(known, findings=())


@pytest.mark.slow
def test_a_camera_that_is_gone_for_a_while_loses_no_track(
    swarm: tuple[Path, Calibration], tmp_path: Path
) -> None:
    run, calibration = swarm
    whole = telerig.track(load_run(run), calibration)
    copy = Path(shutil.copytree(run.parents[1], tmp_path / "set")) / "runs" / run.name
    table = pd.read_csv(copy / "detections.csv")
    gone = (table["camera"] == "middle") & table["frame"].between(8, 15)
    table[~gone].to_csv(copy / "detections.csv", index=False)
    tracks = telerig.track(load_run(copy), calibration)
    assert tracks.table["particle"].nunique() == whole.table["particle"].nunique()
    assert not set(tracks.events["kind"]) & {"break", "gap"}
    known = tracks.table["frame"].between(8, 15)
    middle = tracks.table[[f"middle_{x}" for x in ("u_px", "v_px", "suu_px2", "du_px")]]
    assert middle[known].isna().all(axis=None) and not middle[~known].isna().all(axis=1).all()
    others = tracks.table[["left_u_px", "right_u_px", "ray_miss_mm", "x_mm"]]
    assert np.isfinite(others[known].to_numpy()).all()
    joined = tracks.table.merge(whole.table, on=["frame", "particle"], suffixes=("", "_whole"))
    assert len(joined) > 0.97 * len(whole.table)
    off = joined[["x_mm", "y_mm", "z_mm"]].to_numpy()
    off = off - joined[["x_mm_whole", "y_mm_whole", "z_mm_whole"]].to_numpy()
    # the shake of the camera that is gone, 1 px, is in the points of all others
    assert np.abs(off[joined["frame"].between(8, 15)]).max() < 0.2
    assert np.abs(off[~joined["frame"].between(8, 15)]).max() < 1e-9
    smoothed = telerig.smooth(tracks, calibration, stage=load_run(copy), model="default")
    assert {"left_y_mm", "middle_y_mm", "right_y_mm"} <= set(smoothed.shake)


def test_rows_say_which_cameras_see_a_bubble(swarm: tuple[Path, Calibration]) -> None:
    run, calibration = swarm
    tracks = telerig.track(load_run(run), calibration)
    names = [camera.name for camera in calibration.cameras]
    seen = tracks.table[[f"{name}_u_px" for name in names]].notna()
    assert seen.sum(axis=1).min() >= 2 and (seen.sum(axis=1) == 3).mean() > 0.6
    of_tracks = tracks.detections.dropna(subset=["particle"])
    for name in names:
        own = tracks.table.loc[seen[f"{name}_u_px"], ["frame", "particle", f"{name}_u_px"]]
        there = of_tracks[of_tracks["camera"] == name]
        joined = own.merge(there, on=["frame", "particle"])
        assert len(joined) == len(own)
        assert (joined[f"{name}_u_px"] == joined["u_px"]).all()
    counted = tracks.summary["detections"] - int(seen.to_numpy().sum())
    assert tracks.summary["detections_without_partner_or_track"] == counted
