"""`telerig view --web` in a real browser: the canvas shows a calibration and a run."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from viewed import entities

import telerig

_FILE = Path(__file__).parents[3] / "docs" / "viewer.py"
_SPEC = importlib.util.spec_from_file_location("viewer", _FILE)
assert _SPEC is not None and _SPEC.loader is not None
viewer = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(viewer)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(viewer.missing()), reason=f"not installed: {viewer.missing()}"),
]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("calibration", {"/rig/all_poses", "/target/deviations", "/images/left/residuals"}),
        ("rise", {"/space/bubbles", "/space/paths/smoothed", "/images/right/outlines"}),
    ],
)
def test_the_browser_shows_what_the_recording_holds(
    tank: Path, tmp_path: Path, name: str, expected: set[str]
) -> None:
    folder = tank / "results" / name
    telerig.view(folder, save=tmp_path / "a.rrd")
    assert expected <= set(entities(tmp_path / "a.rrd"))
    picture = viewer.viewer_picture(folder)
    assert picture.size == viewer.SIZE_PX and viewer.colours(picture) > 100
    pixels = np.asarray(picture, float)
    rows, columns = slice(40, 800), (slice(0, 520), slice(540, 1050), slice(1070, 1590))
    for column in columns[1:] if name == "rise" else columns[1:2]:
        assert pixels[rows, column].std() > 2, "a part of the window is blank"
