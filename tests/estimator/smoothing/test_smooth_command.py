"""telerig smooth on a simulated run: its files, its verdict, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import telerig
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.estimator.smoothing.truth import motion_error
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.scripts.main import app

pytestmark = pytest.mark.usefixtures("known_low_passes")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One bubble, encoder and an accelerometer on each arm; tracked."""
    folder = tmp_path_factory.mktemp("smooth") / "data"
    config = run_preset("rise", frames=40)
    config = replace(config, stage=replace(config.stage, accelerometers=("left", "right")))
    telerig.simulate(config, rng=np.random.default_rng(2), out=folder, images=False)
    calibration_from_cameras(list(true_cameras(config.calibration).values())).save(
        folder / "results" / "calibration"
    )
    result = CliRunner().invoke(app, ["track", str(folder / "runs" / "rise"), "--no-report"])
    assert result.exit_code == 0, result.output
    return folder


def test_the_command_writes_the_contract_and_beats_naive(data: Path) -> None:
    result = CliRunner().invoke(app, ["smooth", str(data / "runs" / "rise"), "--quiet"])
    assert result.exit_code == 0, result.output
    out = data / "results" / "rise"
    names = {"trajectories.csv", "shake.csv", "smoothing.json", "results.h5", "report.html"}
    assert names | {"tracks.csv", "detections.csv"} <= {p.name for p in out.iterdir()}
    summary = json.loads((out / "smoothing.json").read_text(encoding="utf-8"))
    assert summary["verdict"] in ("RESOLVED", "PARTIAL", "UNRESOLVED")
    assert summary["verdict"] in result.output
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert (record["command"], record["tracks"]["command"]) == ("smooth", "track")
    trajectories = pd.read_csv(out / "trajectories.csv")
    assert list(trajectories["frame"]) == list(range(40))
    truth = pd.read_csv(data / "truth" / "runs" / "rise" / "bubbles.csv")
    smoothed, naive = (motion_error(trajectories, truth, p) for p in ("", "naive_"))
    assert smoothed.position_um < 0.6 * naive.position_um
    assert smoothed.velocity_mm_s < 0.6 * naive.velocity_mm_s


def test_another_results_folder_and_tracks_from_a_file(data: Path, tmp_path: Path) -> None:
    tracks = data / "results" / "rise" / "tracks.csv"
    result = CliRunner().invoke(
        app,
        ["smooth", str(data / "runs" / "rise"), "--tracks", str(tracks), "--out",
         str(tmp_path / "out"), "--model", "default", "--quiet", "--no-report"],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "trajectories.csv").is_file()
    assert not (tmp_path / "out" / "report.html").exists()


def test_only_tracked_frames_count(tmp_path: Path) -> None:
    config = run_preset("swarm", frames=40, bubbles=3)
    telerig.simulate(config, rng=np.random.default_rng(2), out=tmp_path, images=False)
    rig = calibration_from_cameras(list(true_cameras(config.calibration).values()))
    run = telerig.load_run(tmp_path / "runs" / "swarm")
    tracks = telerig.track(run.first(20), rig)
    cut, whole = (
        telerig.smooth(tracks, rig, stage=part, model="default") for part in (run.first(20), run)
    )
    assert set(whole.shake["frame"]) == set(range(20))
    assert whole.summary["swarm"] == cut.summary["swarm"] != {}


@pytest.mark.parametrize(
    ("option", "value", "words"), [("--tracks", ".", "telerig track"), ("--model", "best", "auto")]
)
def test_no_tracks_and_an_unknown_model_are_refused(
    data: Path, option: str, value: str, words: str
) -> None:
    result = CliRunner().invoke(app, ["smooth", str(data / "runs" / "rise"), option, value])
    assert result.exit_code == 2
    assert words in result.output
