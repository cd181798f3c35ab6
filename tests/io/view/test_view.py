"""`telerig view`: what its recording holds, and what it says where rerun is missing."""

from __future__ import annotations

import sys
from pathlib import Path
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest
import tifffile
from filmed_run import FRAMES, SIZE_PX, write_run
from typer.testing import CliRunner
from viewed import entities, needs_rerun

import telerig
from telerig.errors import InputError, TelerigWarning
from telerig.io.report.overlays import grey_levels
from telerig.io.view.show import frames_of, log_results
from telerig.scripts.main import app


def view(*words: object) -> str:
    done = CliRunner().invoke(app, ["view", *map(str, words)])
    assert done.exit_code == 0, done.output
    return done.output


def test_without_rerun_the_error_names_the_extra(
    tank: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    done = CliRunner().invoke(
        app, ["view", str(tank / "results/rise"), "--save", str(tmp_path / "a")]
    )
    assert done.exit_code == 2 and "pip install 'telerig[view]'" in done.output
    assert not list(tmp_path.iterdir())


def test_frames_are_a_first_one_and_an_end() -> None:
    assert frames_of("100:200") == (100, 200) and frames_of(None) is None
    for text in ("7", "9:9", "a:b", "-1:3"):
        with pytest.raises(InputError, match="give A:B"):
            frames_of(text)


def test_frames_beyond_the_end_of_a_run_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("rerun", "rerun.blueprint"):
        monkeypatch.setitem(sys.modules, name, MagicMock())
    folder = write_run(tmp_path / "results" / "rise")
    with pytest.raises(InputError, match=f"frame from {FRAMES} on.*\n.*0 to {FRAMES - 1}"):
        log_results(MagicMock(), folder, (FRAMES, FRAMES + 9))


def test_levels_are_those_of_the_images() -> None:
    deep = [np.linspace(1000, 3000, 10_000).reshape(100, 100).astype(np.uint16)]
    low, high = grey_levels(deep)
    assert 1000 <= low < 1010 and 2990 < high <= 3000
    assert grey_levels([np.zeros((2, 2), np.uint8)]) == (0.0, 255.0) == grey_levels([])


@needs_rerun
@pytest.mark.slow
def test_a_calibration_and_a_run_have_everything_on_one_time_line(
    tank: Path, tmp_path: Path
) -> None:
    view(tank / "results/calibration", "--save", tmp_path / "c.rrd")
    found = entities(tmp_path / "c.rrd")
    assert {"/rig/all_poses", "/rig/target/dots", "/target/deviations"} <= set(found)
    for camera in ("left", "right"):
        assert {f"/rig/cameras/{camera}/{part}" for part in ("axis", "body", "field")} <= set(found)
        assert {f"/images/{camera}/{part}" for part in ("dots", "residuals")} <= set(found)
    assert "written" in view(tank / "results/rise", "--save", tmp_path / "r.rrd")
    found = entities(tmp_path / "r.rrd")
    assert {"/space/bubbles", "/space/paths/smoothed", "/space/paths/triangulated"} <= set(found)
    assert {"/images/left/outlines", "/images/right/rays"} <= set(found)
    assert "/space/rig" in found, "what the cameras see moves with the stage"
    for plot in (
        "ray_miss_um",
        "speed_mm_s",
        "height_less_line_mm",
        "shake_um",
        "encoder_residual_um",
    ):
        assert any(path.startswith(f"/plots/{plot}/") for path in found), plot


@needs_rerun
@pytest.mark.slow
def test_images_of_the_recording_are_in_it_for_chosen_frames(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "results" / "rise")
    for camera in ("left", "right"):
        (tmp_path / "runs" / "rise" / camera).mkdir(parents=True)
        for frame in range(FRAMES):
            image = np.full((SIZE_PX[1], SIZE_PX[0]), 150 + frame % 2, np.uint8)
            cv2.circle(image, (60, 60), 9, 20, -1)
            tifffile.imwrite(tmp_path / "runs" / "rise" / camera / f"{frame:03d}.tif", image)
    (tmp_path / "runs" / "rise" / "run.toml").write_text("frame_rate_hz = 100.0\n")
    telerig.view(folder, save=tmp_path / "all.rrd")
    telerig.view(folder, save=tmp_path / "some.rrd", frames=(5, 8))
    whole, some = (tmp_path / f"{name}.rrd" for name in ("all", "some"))
    assert "/images/left/image" in entities(some)
    assert some.stat().st_size < whole.stat().st_size
    (tmp_path / "runs" / "rise" / "stage.csv").write_text("t_s,position_mm\n0,no number\n")
    with pytest.warns(TelerigWarning, match=r"stage\.csv"):
        telerig.view(folder, save=whole)
    assert "/images/left/image" in entities(whole)
    with pytest.raises(InputError, match="neither a calibration nor a tracked run"):
        telerig.view(tmp_path, save=tmp_path / "none.rrd")
    assert not (tmp_path / "none.rrd").exists()
