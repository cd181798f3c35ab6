"""Results folders that earlier versions wrote are still read.

`first_schema` has what the first version with schemas (commit c6f16be) wrote for the preset `rise`
with 60 frames and a stage axis, without images: floats rounded to 7 digits, tables cut to the first
rows, no manifests, no arrays. Its verdict has none of the codes and numbers that came later.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import telerig
from telerig.io.report.remake import remake_report, results_folders

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*there is no manifest.json"),
    pytest.mark.usefixtures("undrawn"),
]
FOLDER = Path(__file__).parent / "first_schema"


def test_calibration() -> None:
    calibration = telerig.load_calibration(FOLDER / "calibration")
    assert calibration.verdict["status"] == "GOOD"
    assert [c.name for c in calibration.cameras] == ["left", "right"]
    np.testing.assert_allclose(calibration.stage["axis"], [0, -1, 0], atol=1e-4)


def test_run() -> None:
    tracks = telerig.load_tracks(FOLDER / "rise")
    assert len(tracks.table) == 20 and tracks.table["x_mm"].notna().all()
    smoothing = telerig.load_smoothing(FOLDER / "rise")
    assert smoothing.trajectories["sx_mm"].gt(0).all() and len(smoothing.shake) == 20


def test_pages(tmp_path: Path) -> None:
    shutil.copytree(FOLDER, tmp_path / "results")
    for results in results_folders(tmp_path):
        page = remake_report(results).read_text(encoding="utf-8")
        assert "cannot be separated" in page or results.kind == "calibration"
