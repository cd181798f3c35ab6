"""The demo's last part, smoothed from tables of the same run."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.dataset.dataset import load_dataset
from telerig.io.results.stale import stale
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.simulate import simulate
from telerig.scripts.demo import _config, smooth_and_compare, track_and_compare


@pytest.mark.slow
def test_the_demo_resolves_its_shake_and_states_its_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = _config()
    simulate(config, rng=np.random.default_rng(0), out=tmp_path / "d", images=False)
    data = load_dataset(tmp_path / "d")
    assert data.rig.stage is not None and data.rig.stage.scale_sigma == 0
    cameras = calibration_from_cameras(list(true_cameras(config.calibration).values()))
    cameras.save(data.results / "calibration")
    assert track_and_compare(data, quiet=True)
    assert not stale(data.results / "rise")
    capsys.readouterr()
    assert smooth_and_compare(data, cameras, quiet=True)
    said = capsys.readouterr().out.splitlines()
    error, stated = map(float, re.findall(r"[\d.]+", said[-4])[:2])
    assert 0.7 < error / stated < 1.3
    assert said[-4].endswith("  RESOLVED")
    assert said[-3].startswith("PASSED") and said[-2].startswith("RESOLVED")
