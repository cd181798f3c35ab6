"""Runs: times of the frames, the stage and the sensors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from run_files import CAMERAS, GOOD, error_of, times

from telerig.io.dataset.run import load_run

BAD_TIMES = [
    ("shorter", "0,0\n1,.1\n2,.2\n", ("row 4", "images of 6 frames: frame 3 has no time")),
    (
        "longer",
        GOOD + "6,.6\n7,.7\n",
        ("row 8, column frame", "is 6", "last frame with images is 5"),
    ),
    ("stands still", GOOD.replace("3,.3", "3,.2"), ("row 5, column t_s", "not later than 0.2 s")),
    ("back", GOOD.replace("3,.3", "3,.15"), ("row 5, column t_s", "times must increase")),
    ("twice", GOOD.replace("4,.4", "3,.4"), ("row 6, column frame", "3 stands twice")),
    ("gap", GOOD.replace("3,.3\n", ""), ("row 5, column frame", "the time of frame 3")),
    ("unsorted", "1,.1\n0,.0\n2,.2\n3,.3\n4,.4\n5,.5\n", ("row 3, column frame", "sort")),
    ("negative", "-1,0\n" + GOOD, ("row 2, column frame", "is -1, before 0")),
    ("nan", GOOD.replace(".3", "nan"), ("row 5, column t_s", "not a finite number")),
    ("blank", GOOD.replace(".3", ""), ("row 5, column t_s", "is blank")),
    ("words", GOOD.replace(".3", "soon"), ("row 5, column t_s", "'soon'")),
    ("half", GOOD.replace("3,", "3.5,"), ("row 5, column frame", "not a whole number")),
]


@pytest.mark.parametrize(
    ("rows", "words"), [b[1:] for b in BAD_TIMES], ids=[b[0] for b in BAD_TIMES]
)
def test_bad_frames_csv(rows: str, words: tuple[str, ...], full_run: Path) -> None:
    (full_run / "frames.csv").write_text(times(rows))
    error_of(full_run, "frames.csv", *words)


def test_frames_csv_wins_over_run_toml(full_run: Path) -> None:
    (full_run / "frames.csv").write_text(times(GOOD))
    run = load_run(full_run)
    np.testing.assert_allclose(run.t_s, np.arange(6) / 10)
    assert "frames.csv; those of run.toml" in run.notes[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("frame_rate_hz = 0", ("frame_rate_hz", "is 0, not positive")),
        ("start_s = 1.0", ("frame_rate_hz", "is missing")),
        ("frame_rate = 100", ("frame_rate", "did you mean frame_rate_hz?")),
        ('frame_rate_hz = "100 Hz"', ("'100 Hz', not a finite number",)),
        ("frame_rate_hz = nan", ("nan, not a finite number",)),
        ("frame_rate_hz 100", ("not valid TOML",)),
    ],
)
def test_bad_run_toml(text: str, words: tuple[str, ...], full_run: Path) -> None:
    (full_run / "run.toml").write_text(text)
    error_of(full_run, "run.toml", *words)


def test_no_times_at_all(full_run: Path) -> None:
    (full_run / "run.toml").unlink()
    error_of(full_run, "neither frames.csv nor run.toml", "frame_rate_hz")
    for camera in CAMERAS:
        for k in range(1, 6):
            (full_run / camera / f"{k:06d}.tif").unlink()
    run = load_run(full_run)
    assert run.t_s.tolist() == [0.0] and "only frame" in run.notes[0]


def test_stage_at_mid_exposure(full_run: Path) -> None:
    (full_run / "stage.csv").write_text("t_s,position_mm,flag\n1.99,10,a\n2.01,20,b\n2.06,25,c\n")
    run = load_run(full_run)
    assert run.stage is not None and run.stage["flag"].tolist() == ["a", "b", "c"]
    np.testing.assert_allclose(run.position_mm, [15, 20, 21, 22, 23, 24], rtol=1e-12)


def test_frames_outside_the_stage_record(full_run: Path) -> None:
    (full_run / "stage.csv").write_text("t_s,position_mm\n2.005,1\n2.035,2\n")
    run = load_run(full_run)
    assert run.position_mm is not None
    assert np.isnan(run.position_mm).tolist() == [1, 0, 0, 0, 1, 1]
    assert "3 frames (0 to 5)" in run.notes[0] and "outside the record" in run.notes[0]
    assert "2 s to 2.05 s" in run.notes[0]


def test_silent_stage_is_noted(full_run: Path) -> None:
    rows = [f"{t:.3f},0" for t in [*np.arange(1.99, 2.012, 0.001), 2.06]]
    (full_run / "stage.csv").write_text("t_s,position_mm\n" + "\n".join(rows))
    (note,) = load_run(full_run).notes
    assert "no reading for 0.048 s from 2.012 s" in note


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("1,0\n", ("single row",)),
        ("1,0\n1,1\n2,2\n", ("row 3, column t_s", "not later than 1 s")),
        ("1,0\n2,x\n", ("row 3, column position_mm", "'x'")),
    ],
)
def test_bad_stage_csv(rows: str, words: tuple[str, ...], full_run: Path) -> None:
    (full_run / "stage.csv").write_text("t_s,position_mm\n" + rows)
    error_of(full_run, "stage.csv", *words)


def test_accelerometers(full_run: Path) -> None:
    head = "t_s,sensor,ax_m_s2,ay_m_s2,az_m_s2\n"
    file = full_run / "accelerometer.csv"
    file.write_text(head + "0,arm_left,0,9.81,0\n0.001,arm_left,0.1,9.8,0\n")
    table = load_run(full_run).accelerometers
    assert table is not None and table["ay_m_s2"].tolist() == [9.81, 9.8]
    file.write_text(head + "0,arm_leff,0,9.81,0\n")
    error_of(full_run, "row 2, column sensor", "did you mean arm_left?")
    file.write_text(head + "0,arm_left,0,9.81,0\n0,arm_left,0,9.81,0\n")
    error_of(full_run, "row 3, column t_s", "sort the rows by time")


def test_references(full_run: Path) -> None:
    head = "frame,camera,mark,u_px,v_px\n"
    file = full_run / "references.csv"
    file.write_text(head + "0,left,a,3,4\n0,right,a,5,6\n5,left,b,7,8\n")
    run = load_run(full_run)
    table = run.references
    assert table is not None and table["mark"].tolist() == ["a", "a", "b"]
    said = "references.csv states no sigma_px: its centres count as good to 0.1 px (1 sd)"
    assert said in run.notes
    assert table["svv_px2"].tolist() == pytest.approx([0.01] * 3)
    file.write_text(head + "0,left,a,3,4\n0,left,a,5,6\n")
    error_of(full_run, "references.csv row 3, column mark", "'a' stands twice in frame 0")
    file.write_text(head + "6,left,a,3,4\n")
    error_of(full_run, "row 2, column frame", "is 6, but the last frame is 5")


@pytest.mark.parametrize(
    ("seconds", "said"),
    [([0, 1, 2], "Check that t_s is in s"), ([0, 0.1, 0.2], "Check that both files are in s")],
)
def test_a_stage_record_in_milliseconds_is_noticed(
    full_run: Path, seconds: list[float], said: str
) -> None:
    (full_run / "frames.csv").write_text(times(GOOD))
    rows = "".join(f"{t},{i}\n" for i, t in enumerate(seconds))
    (full_run / "stage.csv").write_text("t_s,position_mm\n" + rows)
    assert said in " ".join(load_run(full_run).notes)


def test_a_stage_without_a_record_is_told(full_run: Path) -> None:
    """A forgotten file: bubbles that the moving rig follows are then in no track."""
    rig = full_run.parent.parent / "rig.toml"
    assert not any("stage.csv" in note for note in load_run(full_run).notes)
    stage = "[stage]\naxis_left = [0, -1, 0]\nup_left = [0, -1, 0]\n"
    rig.write_text(rig.read_text() + stage)
    assert any("there is no stage.csv" in note for note in load_run(full_run).notes)
    (full_run / "stage.csv").write_text("t_s,position_mm\n1.9,1\n2.5,2\n")
    assert not any("there is no stage.csv" in note for note in load_run(full_run).notes)
