"""docs/howto/join.md as it stands: a logger's CSV with a clock of its own, against the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import docs_pages
import numpy as np
import pandas as pd
import pytest

import telerig
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.rig.units import STANDARD_GRAVITY_M_S2

PAGE = "docs/howto/join.md"
OFFSET_S = 17.3
RATE_HZ = 1600.0


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A tracked run with its encoder alone, and the logger's record; the logger's clock is late."""
    monkeypatch.chdir(tmp_path)
    config = replace(run_preset("S1", frames=500), name="rise", bubbles=3)
    sensors = replace(config.stage, accelerometers=("left",))
    config = replace(config, stage=sensors, table=replace(config.table, references=0))
    rng = np.random.default_rng(11)
    dataset = telerig.simulate(config, rng=rng, out=Path("data"), images=False)
    run = dataset.runs["rise"].load()
    sensor = run.accelerometers
    assert sensor is not None
    t_s = np.arange(sensor["t_s"].iloc[0], sensor["t_s"].iloc[-1], 1 / RATE_HZ)
    log = pd.DataFrame({"Time (s)": t_s + OFFSET_S})
    for axis in "xyz":
        reading = np.interp(t_s, sensor["t_s"], sensor[f"a{axis}_m_s2"])
        log[f"{axis.upper()} (g)"] = (reading / STANDARD_GRAVITY_M_S2).round(6)
    log.round(6).to_csv("logger.csv", index=False)
    (run.path / "accelerometer.csv").unlink()
    calibration = calibration_from_cameras(list(true_cameras(config.calibration).values()))
    calibration.save(Path("data/results/calibration"))
    telerig.track(replace(run, accelerometers=None), calibration).save(Path("data/results/rise"))
    yield tmp_path


def rms_mm(trajectories: pd.DataFrame) -> float:
    """RMS of the positions about the true ones, without a constant of each bubble."""
    truth = pd.read_csv("data/truth/runs/rise/bubbles.csv")
    both = trajectories.merge(truth, on=["frame", "particle"], suffixes=("", "_true"))
    assert len(both) > 0.9 * len(truth)
    squares = []
    for _, one in both.groupby("particle"):
        middle = one.iloc[len(one) // 10 : -len(one) // 10]
        for axis in "xyz":
            error = middle[f"{axis}_mm"] - middle[f"{axis}_lab_mm"]
            squares.append(np.mean((error - error.mean()) ** 2))
    return float(np.sqrt(np.mean(squares)))


@pytest.mark.slow
def test_code_of_the_page(place: Path) -> None:
    pytest.importorskip("telerig.estimator.sensors.alignment")
    runner = docs_pages.PageRunner(place)
    for block in docs_pages.blocks_of(PAGE):
        runner.run(block)
    smoothing = runner.names["smoothing"]
    assert isinstance(smoothing, telerig.Smoothing)
    found = smoothing.summary["accelerometers"]["arm"]
    assert found["confirmed"]
    assert found["offset_s"] == pytest.approx(OFFSET_S, abs=1e-3)
    run = telerig.load_run("data/runs/rise")
    alone = telerig.smooth(
        runner.names["tracks"], runner.names["calibration"], stage=run, model="default"
    )
    assert rms_mm(smoothing.trajectories) < 0.85 * rms_mm(alone.trajectories)
    assert (place / "with-logger" / "trajectories.csv").is_file()
