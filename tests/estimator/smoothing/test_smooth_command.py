"""telerig smooth on a tracked run: its files, its verdict, and what it refuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import telerig
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.results.smoothing import Verdict
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.scripts.main import app

pytestmark = pytest.mark.usefixtures("known_low_passes", "undrawn")


def test_the_command_writes_the_contract(tank_copy: Path) -> None:
    out = tank_copy / "results" / "rise"
    for name in ("trajectories.csv", "shake.csv", "smoothing.json", "results.h5", "report.html"):
        (out / name).unlink(missing_ok=True)
    (out / "manifest.json").unlink()
    run = str(tank_copy / "runs" / "rise")
    result = CliRunner().invoke(app, ["smooth", run, "--model", "default", "--quiet"])
    assert result.exit_code == 0, result.output
    names = {"trajectories.csv", "shake.csv", "smoothing.json", "results.h5", "report.html"}
    assert names | {"tracks.csv", "detections.csv"} <= {p.name for p in out.iterdir()}
    summary = json.loads((out / "smoothing.json").read_text(encoding="utf-8"))
    assert summary["verdict"] in Verdict.__members__ and summary["verdict"] in result.output
    record = json.loads((out / "run.json").read_text(encoding="utf-8"))
    assert (record["command"], record["tracks"]["command"]) == ("smooth", "track")
    assert list(pd.read_csv(out / "trajectories.csv")["frame"]) == list(range(24))


def test_another_results_folder_and_tracks_from_a_file(tank: Path, tmp_path: Path) -> None:
    tracks = tank / "results" / "rise" / "tracks.csv"
    result = CliRunner().invoke(
        app,
        ["smooth", str(tank / "runs" / "rise"), "--tracks", str(tracks), "--out",
         str(tmp_path / "out"), "--model", "default", "--quiet", "--no-report"],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "trajectories.csv").is_file()
    assert not (tmp_path / "out" / "report.html").exists()


def test_only_tracked_frames_count(tmp_path: Path) -> None:
    config = run_preset("swarm", frames=24, bubbles=2)
    telerig.simulate(config, rng=np.random.default_rng(2), out=tmp_path, images=False)
    rig = calibration_from_cameras(list(true_cameras(config.calibration).values()))
    run = telerig.load_run(tmp_path / "runs" / "swarm")
    tracks = telerig.track(run.first(12), rig)
    cut, whole = (
        telerig.smooth(tracks, rig, stage=part, model="default") for part in (run.first(12), run)
    )
    assert set(whole.shake["frame"]) == set(range(12))
    assert whole.summary["swarm"] == cut.summary["swarm"] != {}


@pytest.mark.parametrize(
    ("option", "value", "words"), [("--tracks", ".", "telerig track"), ("--model", "best", "auto")]
)
def test_no_tracks_and_an_unknown_model_are_refused(
    tank: Path, option: str, value: str, words: str
) -> None:
    result = CliRunner().invoke(app, ["smooth", str(tank / "runs" / "rise"), option, value])
    assert result.exit_code == 2
    assert words in result.output


def test_tracks_of_another_run_are_refused_and_those_of_a_renamed_one_not(tank_copy: Path) -> None:
    runs, own = tank_copy / "runs", tank_copy / "results" / "rise"
    shutil.copytree(runs / "rise", runs / "fall")
    command = ["smooth", str(runs / "fall"), "--out", str(own), "--model", "default", "--quiet"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 2
    assert "tracks of the run 'rise', not of 'fall'" in " ".join(result.output.split())
    (runs / "rise").rename(tank_copy / "away")
    assert CliRunner().invoke(app, [*command, "--no-report"]).exit_code == 0
