"""The code blocks of the documentation run as they stand."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import telerig
from telerig.estimator.imported_calibration import calibration_from_cameras
from telerig.io.run_presets import run_preset
from telerig.io.simulation_scene import true_cameras

PAGE = Path(__file__).parents[1] / "docs" / "smoothing.md"


def test_worked_example_with_own_accelerometers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = run_preset("rise", frames=25)
    config = replace(config, stage=replace(config.stage, accelerometers=("left",)))
    out = tmp_path / "data"
    dataset = telerig.simulate(config, rng=np.random.default_rng(4), out=out, images=False)
    calibration = calibration_from_cameras(list(true_cameras(config.calibration).values()))
    readings = dataset.runs["rise"].load().accelerometers
    assert readings is not None
    (dataset.runs["rise"].path / "accelerometer.csv").unlink()
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    names = {
        "dataset": dataset,
        "calibration": calibration,
        "left_t_s": readings["t_s"].to_numpy(),
        "left_m_s2": readings[["ax_m_s2", "ay_m_s2", "az_m_s2"]].to_numpy(),
    }
    exec(compile(code, str(PAGE), "exec"), names)
    smoothing = names["smoothing"]
    assert len(smoothing.trajectories) == 25
    assert abs(smoothing.summary["accelerometers"]["on the left arm"]["delay_s"]) < 0.01
    assert (tmp_path / "results-with-my-sensor" / "trajectories.csv").is_file()
