"""Tables that stay on disk give what tables in memory give."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import telerig
from telerig.command_options import SmoothingOptions
from telerig.estimator.calibration.result.calibration import calibration_from_cameras
from telerig.estimator.smoothing.problem import tracks as problem_tracks
from telerig.estimator.smoothing.results_folder import smooth_run
from telerig.estimator.tracking.results_folder import write_tracking
from telerig.estimator.tracking.track import TrackOptions
from telerig.estimator.tracking.tracks import StoredTracks, open_tracks
from telerig.io.files import frame_table
from telerig.io.files.frame_table import FrameTable
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset

pytestmark = pytest.mark.usefixtures("known_low_passes")


@pytest.mark.slow
def test_a_run_is_tracked_and_smoothed_from_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = run_preset("swarm", frames=14, bubbles=2)
    telerig.simulate(config, rng=np.random.default_rng(1), out=tmp_path / "data", images=False)
    cameras = list(true_cameras(config.calibration).values())
    calibration = calibration_from_cameras(cameras, name="truth")
    run = tmp_path / "data" / "runs" / "swarm"

    def done(folder: Path) -> telerig.Smoothing:
        write_tracking(
            telerig.load_run(run), calibration, folder, options=TrackOptions(), record={},
            report=False,
        )  # fmt: skip
        data = telerig.load_run(run)
        return smooth_run(
            data, calibration, folder, folder, SmoothingOptions(model="default"), report=False
        )

    whole = done(tmp_path / "whole")
    monkeypatch.setattr(frame_table, "LARGE_BYTES", 0)
    monkeypatch.setattr(frame_table, "_BLOCK_BYTES", 20_000)
    monkeypatch.setattr(problem_tracks, "_FRAMES_AT_ONCE", 11)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    assert isinstance(telerig.load_run(run).detections, FrameTable)
    stored = done(tmp_path / "stored")
    assert not list(temporary.iterdir())  # nothing is left of a process that is killed
    assert isinstance(open_tracks(tmp_path / "stored"), StoredTracks)
    for name in ("tracks.csv", "detections.csv"):
        both = [pd.read_csv(tmp_path / folder / name) for folder in ("whole", "stored")]
        pd.testing.assert_frame_equal(*both)
    pd.testing.assert_frame_equal(whole.trajectories, stored.trajectories)
    pd.testing.assert_frame_equal(whole.shake, stored.shake)
    bare = smooth_run(
        telerig.load_run(run), calibration, tmp_path / "stored" / "tracks.csv", tmp_path / "bare",
        SmoothingOptions(model="default"), report=False,
    )  # fmt: skip
    assert set(bare.trajectories["particle"]) == set(whole.trajectories["particle"])


def test_a_table_on_disk_has_the_rows_of_each_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_table, "LARGE_BYTES", 0)
    monkeypatch.setattr(frame_table, "_BLOCK_BYTES", 40)
    frame = np.repeat([0, 1, 4, 5, 9], [3, 1, 6, 2, 1])
    whole = pd.DataFrame({"frame": frame, "value": np.arange(len(frame)) / 3})
    file = tmp_path / "table.csv"
    whole.to_csv(file, index=False)

    def read(content: bytes, row: int) -> pd.DataFrame | None:
        from telerig.io.files.csv_table import Column, read_part

        return read_part(file, content, row, [Column("frame", "whole"), Column("value")])

    table = FrameTable.of(file, read, lambda part: None)
    assert table is not None
    assert table.rows == len(whole)
    assert table.columns == ["frame", "value"]
    for first, end in ((0, 10), (1, 5), (2, 4), (4, 5), (6, 20)):
        rows = table.between(first, end)
        expected = whole[(frame >= first) & (frame < end)]
        np.testing.assert_array_equal(rows["value"], expected["value"])
        np.testing.assert_array_equal(rows.index, expected.index + 2)
    assert table.before(5).between(0, 10)["frame"].max() == 4
    parts = pd.concat(table.parts(3))
    np.testing.assert_array_equal(parts["value"], whole["value"])
    whole.iloc[::-1].to_csv(file, index=False)
    assert FrameTable.of(file, read, lambda part: None) is None
