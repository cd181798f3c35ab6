"""`stage_axis/` from the simulator through `telerig calibrate` to where the smoother reads it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from finding_codes import codes
from typer.testing import CliRunner

import telerig
from telerig.errors import InputError
from telerig.estimator.smoothing.smooth import problem_of
from telerig.io.dataset.run import load_run
from telerig.io.rig_file.rig_file import read_rig_toml, write_rig_toml
from telerig.io.simulation.presets import preset, run_preset
from telerig.io.simulation.simulate import simulate
from telerig.scripts.main import app

pytestmark = pytest.mark.usefixtures("without_advice", "undrawn")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven stops over 30 mm, 1 µm positions, an encoder that reads 1 % too much; calibrated."""
    folder = tmp_path_factory.mktemp("stage") / "data"
    command = ["simulate", "rise", "--no-images", "--stage-axis", "7", "--encoder-scale", "0.01"]
    for words in (
        [*command, "--frames", "12", "--seed", "8", "--out", str(folder)],
        ["calibrate", str(folder), "--quiet", "--no-report"],
    ):
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 0, result.output
    (folder / "said.txt").write_text(result.output, encoding="utf-8")
    return folder


def test_calibration_json_says_axis_and_scale_with_covariance(data: Path) -> None:
    file = data / "results" / "calibration" / "calibration.json"
    stage = json.loads(file.read_text(encoding="utf-8"))["stage"]
    truth = json.loads((data / "truth" / "stage_axis.json").read_text(encoding="utf-8"))
    error = stage["encoder_scale"] - truth["encoder_scale"]
    assert abs(error) < min(4 * stage["encoder_scale_sd"], 3e-4)
    assert stage["encoder_scale_sd"] < 1e-4
    off = np.array(stage["axis"]) - truth["axis"]
    tilts = np.array(stage["basis"]).T @ off
    covariance = np.array(stage["axis_covariance_rad2"])
    assert tilts @ np.linalg.solve(covariance, tilts) < 14
    assert np.sqrt(np.diag(covariance)).max() < 1e-4
    assert np.ptp(truth["position_mm"]) > 20


def test_the_smoother_takes_it(data: Path) -> None:
    calibration = telerig.load_calibration(data / "results" / "calibration")
    run = load_run(data / "runs" / "rise")
    problem, *_ = problem_of(None, calibration, stage=run)
    assert problem.travel is not None and problem.travel.source == "stage_axis"
    np.testing.assert_allclose(problem.axis, calibration.stage["axis"])
    assert problem.stage is not None
    raw = pd.read_csv(data / "runs" / "rise" / "stage.csv")
    read = np.interp(problem.stage.t_s, raw["t_s"], raw["position_mm"])
    scale = 1 + calibration.stage["encoder_scale"]
    np.testing.assert_allclose(problem.stage.position_mm * scale, read, atol=1e-12)


def test_a_garbled_stage_is_refused(data: Path, tmp_path: Path) -> None:
    source = data / "results" / "calibration" / "calibration.json"
    content = json.loads(source.read_text(encoding="utf-8"))
    content["stage"]["axis"] = [0.0, 1.0]
    (tmp_path / "calibration.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(InputError, match=r"has a fault at .stage\.axis.: has shape"):
        telerig.load_calibration(tmp_path)


def test_a_plate_that_cameras_see_from_both_sides(tmp_path: Path) -> None:
    """One camera sees the dots through 2 mm of glass, a third of which they look nearer."""
    two, run = preset("two_sided"), run_preset("rise", frames=6)
    seen = replace(run.calibration, target=two.target, angle_deg=150.0, tilt_deg=two.tilt_deg)
    stage = replace(run.stage, axis_views=7, encoder_scale=0.01)
    config = replace(run, stage=stage, calibration=seen)
    data = simulate(config, rng=np.random.default_rng(9), out=tmp_path / "set", images=False)
    found = telerig.calibrate(data, model="radial")
    sd = found.stage["encoder_scale_sd"]
    assert abs(found.stage["encoder_scale"] - 0.01) < 4 * sd < 4e-4
    assert np.sqrt(np.diag(found.stage["axis_covariance_rad2"])).max() < 1e-4
    assert found.stage["chi2_dof"] < 1.5 and "STAGE_OUTLIERS" not in codes(found)


def test_no_stage_options_for_a_calibration_alone(tmp_path: Path) -> None:
    words = ["simulate", "paper", "--stage-axis", "5", "--out", str(tmp_path / "x")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert "calibration without a run" in result.output
    words = ["simulate", "rise", "--stage-axis", "2", "--no-images", "--out", str(tmp_path / "y")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert "3 or more" in result.output


def test_scale_sigma_in_rig_toml(data: Path, tmp_path: Path) -> None:
    from dataclasses import replace

    rig = read_rig_toml(data / "rig.toml")
    assert rig.stage is not None and rig.stage.scale_sigma is None
    write_rig_toml(replace(rig, stage=replace(rig.stage, scale_sigma=2e-4)), tmp_path / "rig.toml")
    again = read_rig_toml(tmp_path / "rig.toml")
    assert again.stage is not None and again.stage.scale_sigma == 2e-4
    bad = (tmp_path / "rig.toml").read_text("utf-8").replace("0.0002", "-1.0")
    (tmp_path / "rig.toml").write_text(bad, encoding="utf-8")
    with pytest.raises(InputError, match="scale_sigma"):
        read_rig_toml(tmp_path / "rig.toml")
