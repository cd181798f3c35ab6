"""Batches of detections on disk."""

from pathlib import Path

import pandas as pd

from telerig.estimator.tracking.detect_run import read_batch
from telerig.io.files.csv_table import write_table


def test_a_camera_named_na_stays(tmp_path: Path) -> None:
    table = pd.DataFrame(
        {"frame": [0, 1], "camera": ["NA", "null"], "u_px": [1.0, None], "flags": ["", "border"]}
    )
    write_table(table, tmp_path / "batch.csv")
    found = read_batch(tmp_path / "batch.csv")
    pd.testing.assert_frame_equal(found, table, check_dtype=False)
