"""Runs: detections in place of images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from run_files import CAMERAS, GOOD, LEFT, SIZES, assert_frames, error_of, times

from telerig.errors import InputError
from telerig.io.dataset.run import load_run

HEAD = "frame,camera,u_px,v_px,sigma_px,particle,a_px,b_px,angle_rad,contrast,word\n"
ROWS = """0,left,10,12,0.2,007,5,4,0.1,0.8,x
0,right,11,12,0.4,007,,,,0.7,y
2,left,9,8,.2,,5,4,0,.5,z
"""


def detections(folder: Path, text: str) -> Path:
    (folder / "detections.csv").write_text(text)
    return folder


def test_detections(run_folder: Path) -> None:
    run = load_run(detections(run_folder, HEAD + ROWS))
    table = run.detections
    assert run.source == "detections" and table is not None and run.frame_count == 3
    assert table["particle"].tolist() == ["007", "007", ""], "given ids stay as they are"
    np.testing.assert_allclose(table["suu_px2"], [0.04, 0.16, 0.04])
    np.testing.assert_allclose(table["suv_px2"], 0.0)
    assert table["contrast"].tolist() == [0.8, 0.7, 0.5] and table["word"].tolist() == list("xyz")
    assert np.isnan(table["a_px"][1]) and table["b_px"][0] == 4
    assert table.attrs["sigma_known"] is True and run.notes == []
    with pytest.raises(InputError, match="it has no images"):
        run.image("left", 0)


def test_least_detections(run_folder: Path) -> None:
    (run_folder / "frames.csv").write_text(times(GOOD))
    run = load_run(detections(run_folder, "frame,camera,u_px,v_px\n1,left,10,12\n"))
    assert run.frame_count == 6, "as frames.csv has it"
    assert run.detections is not None
    assert run.detections["svv_px2"].tolist() == [0.25]
    assert run.detections.attrs["sigma_known"] is False
    assert "detections.csv has nothing of camera right" in run.notes
    said = "detections.csv states no sigma_px: its centres count as good to 0.5 px (1 sd)"
    assert said in run.notes


def test_full_covariance(run_folder: Path) -> None:
    head = "frame,camera,u_px,v_px,suu_px2,suv_px2,svv_px2\n"
    run = load_run(detections(run_folder, head + "0,left,10,12,.04,.01,.09\n"))
    assert run.detections is not None
    row = run.detections.iloc[0]
    assert (row["suu_px2"], row["suv_px2"], row["svv_px2"]) == (0.04, 0.01, 0.09)
    error_of(detections(run_folder, head + "0,left,10,12,.04,.1,.09\n"), "is no covariance")


def test_images_and_detections(full_run: Path) -> None:
    detections(full_run, HEAD + ROWS)
    error_of(full_run, "images and detections.csv", "--from images or --from detections")
    assert_frames(load_run(full_run, source="images"), "left", LEFT)
    assert load_run(full_run, source="detections").frame_count == 3
    error_of(full_run, "source is 'both'", source="both")


def change(old: str, new: str) -> str:
    assert old in ROWS
    return HEAD + ROWS.replace(old, new, 1)


BAD_DETECTIONS = [
    ("camera", change("0,right", "0,rigth"), ("row 3, column camera", "did you mean right?")),
    ("right of it", change("10,12", "62,12"), ("row 2, column u_px", "outside the image of 48 px")),
    ("above it", change("10,12", "10,-14"), ("row 2, column v_px", "outside the image of 32 px")),
    ("nan", change("10,12", "nan,12"), ("row 2, column u_px", "not a finite number")),
    ("text", change("10,12", "10,middle"), ("row 2, column v_px", "'middle'")),
    ("negative frame", change("2,left", "-2,left"), ("row 4, column frame", "before 0")),
    ("half frame", change("2,left", "2.5,left"), ("row 4, column frame", "not a whole number")),
    ("sigma", change("0.2,007", "0,007"), ("row 2, column sigma_px", "is 0, not positive")),
    ("twice", change("0,right", "0,left"), ("row 3, column particle", "'007' stands twice")),
    ("axes", change("5,4,0.1", "4,5,0.1"), ("row 2, column a_px", "less than b_px = 5")),
    ("one axis", change("5,4,0.1", "5,,0.1"), ("row 2, column a_px", "no pair of semi-axes")),
    ("degrees", change("5,4,0.1", "5,4,35"), ("row 2, column angle_rad", "a whole turn in rad")),
    ("ragged", change(",x\n", "\n"), ("row 2", "has 10 cells, the header has 11")),
    ("no column", "frame,camera,u_px\n0,left,3\n", ("row 1", "missing column: v_px")),
    ("empty", "frame,camera,u_px,v_px\n", ("no rows below its header",)),
]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"), [b[1:] for b in BAD_DETECTIONS], ids=[b[0] for b in BAD_DETECTIONS]
)
def test_bad_detections(text: str, words: tuple[str, ...], run_folder: Path) -> None:
    error_of(detections(run_folder, text), "detections.csv", *words)


def test_outlines_that_the_border_cuts_may_have_their_centres_outside(run_folder: Path) -> None:
    """As in the table that telerig itself writes."""
    run = load_run(detections(run_folder, change("10,12", "-8,12")))
    assert run.detections is not None and run.detections["u_px"][0] == -8
    message = ("row 2, column u_px", "is -9, outside the image of 48 px")
    error_of(detections(run_folder, change("10,12", "-9,12")), *message)


def test_detections_beyond_frames_csv(run_folder: Path) -> None:
    (run_folder / "frames.csv").write_text(times("0,0\n1,.1\n"))
    error_of(
        detections(run_folder, HEAD + ROWS), "row 4, column frame", "is 2, but the last frame is 1"
    )


def test_detections_without_a_rig(run_folder: Path, tmp_path: Path) -> None:
    bare = detections(run_folder, HEAD + ROWS).rename(tmp_path / "bare")
    run = load_run(bare, cameras=CAMERAS)
    assert isinstance(run.detections, pd.DataFrame) and "sizes are not known" in run.notes[0]
    run = load_run(bare, cameras=CAMERAS, image_sizes_px=SIZES)
    assert run.notes == []
