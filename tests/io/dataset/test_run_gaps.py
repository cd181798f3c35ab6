"""Runs: truncated recordings, and frames that a camera misses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from run_files import (
    CAMERAS,
    LEFT,
    RIGHT,
    assert_frames,
    error_of,
    movie,
    write_images,
    write_video,
)

from telerig.errors import InputError
from telerig.io.dataset.run import load_run

# --- truncated and unreadable ------------------------------------------------------------------


def cut(file: Path, keep: float = 0.6) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(keep * len(data))])


def test_truncated_last_image_is_noted(full_run: Path) -> None:
    cut(full_run / "left" / "000005.tif")
    run = load_run(full_run)
    assert run.frame_count == 6
    assert run.image("left", 5) is None
    assert run.image("right", 5) is not None
    (note,) = run.notes
    assert "camera left, frame 5" in note and "truncated" in note and "000005.tif" in note
    error_of(full_run, "000005.tif", "truncated", skip_unreadable=False)


def test_truncated_image_within_the_run(full_run: Path) -> None:
    cut(full_run / "left" / "000002.tif")
    run = load_run(full_run)
    with pytest.raises(InputError, match=r"000002\.tif: is truncated"):
        run.image("left", 2)
    run = load_run(full_run, skip_unreadable=True)
    assert run.image("left", 2) is None and run.image("left", 2) is None
    assert len(run.notes) == 1 and "frame 2" in run.notes[0]


@pytest.mark.parametrize("imagej", [True, False])
def test_truncated_multi_page(imagej: bool, run_folder: Path) -> None:
    for camera in CAMERAS:
        with tifffile.TiffWriter(run_folder / f"{camera}.tif", imagej=imagej) as writer:
            if imagej:
                writer.write(LEFT)
            for frame in () if imagej else LEFT:
                writer.write(frame, contiguous=False, metadata=None)
    left = run_folder / "left.tif"
    full = left.read_bytes()
    last = full.find(LEFT[5].tobytes())
    assert last > 0
    left.write_bytes(full[: last + 100])
    run = load_run(run_folder)
    assert run.frame_count == 6 and run.image("left", 5) is None
    assert any("camera left, frame 5" in note for note in run.notes)
    np.testing.assert_array_equal(run.image("left", 4), LEFT[4])
    error_of(run_folder, "left.tif (page 5", "truncated", skip_unreadable=False)
    left.write_bytes(full[: last // 2])
    if imagej:
        run = load_run(run_folder)
        with pytest.raises(InputError, match=r"page 4, from 0.: is truncated"):
            run.image("left", 4)
    else:
        error_of(run_folder, "the cameras have different numbers of frames", "right 6")


def test_file_that_is_no_tiff(run_folder: Path) -> None:
    (run_folder / "left.tif").write_bytes(b"not an image at all")
    tifffile.imwrite(run_folder / "right.tif", RIGHT)
    error_of(run_folder, "left.tif", "no TIFF header")


def test_truncated_video(run_folder: Path) -> None:
    frames = movie(20)
    for camera in CAMERAS:
        write_video(run_folder / f"{camera}.avi", frames, "rawvideo", "gray")
    full = (run_folder / "left.avi").read_bytes()
    at = full.find(frames[19].tobytes()[:64])
    assert at > 0
    (run_folder / "left.avi").write_bytes(full[: at + 100])
    run = load_run(run_folder, pair_by="order")
    assert run.frame_count == 20 and run.image("left", 19) is None and run.notes
    np.testing.assert_array_equal(run.image("left", 18), frames[18])
    (run_folder / "left.avi").write_bytes(b"RIFF nothing")
    error_of(run_folder, "left.avi", "cannot be opened as a video")


# --- frames that one camera misses -------------------------------------------------------------


def test_a_missing_number_is_a_missing_frame(full_run: Path) -> None:
    (full_run / "right" / "000001.tif").unlink()
    (full_run / "right" / "000005.tif").unlink()
    run = load_run(full_run)
    assert run.frame_count == 6
    assert [run.image("right", frame) is None for frame in range(6)] == [0, 1, 0, 0, 0, 1]
    np.testing.assert_array_equal(run.image("right", 2), RIGHT[2])
    assert run.notes == ["camera right misses 2 frames: 1, 5"]


def test_a_number_that_both_cameras_miss_keeps_its_time(full_run: Path) -> None:
    for camera in CAMERAS:
        (full_run / camera / "000003.tif").unlink()
    run = load_run(full_run)
    assert run.frame_count == 6 and run.image("left", 3) is None
    np.testing.assert_array_equal(run.image("left", 4), LEFT[4])
    assert run.t_s[4] == pytest.approx(2.04)
    (full_run / "frames.csv").write_text("frame,t_s\n0,0\n1,.1\n2,.2\n3,.4\n4,.5\n")
    error_of(full_run, "has 5 rows", "the images' names skip 1 frame (3)", "blank column `missing`")
    (full_run / "frames.csv").write_text("frame,t_s,missing\n0,0,\n1,.1,\n2,.2,\n3,.4,\n4,.5,\n")
    run = load_run(full_run)
    np.testing.assert_array_equal(run.image("left", 3), LEFT[4])


def test_counts_that_differ_without_numbers(run_folder: Path) -> None:
    tifffile.imwrite(run_folder / "left.tif", LEFT)
    tifffile.imwrite(run_folder / "right.tif", RIGHT[:4], photometric="minisblack")
    error_of(run_folder, "the cameras have different numbers of frames: left 6, right 4", "missing")
    run = load_run(run_folder, pair_by="order")
    assert run.frame_count == 6 and run.image("right", 4) is None
    error_of(run_folder, "do not contain the number", pair_by="numbers")
    error_of(run_folder, "pair_by is 'nmbers'", "auto, numbers, order", pair_by="nmbers")


def test_counters_of_their_own(run_folder: Path) -> None:
    write_images(run_folder / "left", LEFT, range(100, 106))
    write_images(run_folder / "right", RIGHT, range(700, 706))
    assert_frames(load_run(run_folder), "right", RIGHT)


def test_counters_off_by_one_are_not_guessed(run_folder: Path) -> None:
    write_images(run_folder / "left", LEFT, range(6))
    write_images(run_folder / "right", RIGHT, range(1, 7))
    error_of(run_folder, "start differently: left at 0 and right at 1", "column `missing`")
    assert load_run(run_folder, pair_by="order").frame_count == 6
    run = load_run(run_folder, pair_by="numbers")
    assert run.frame_count == 7 and run.image("right", 0) is None
    np.testing.assert_array_equal(run.image("right", 1), RIGHT[0])


def test_frames_csv_says_what_is_missing(run_folder: Path) -> None:
    tifffile.imwrite(run_folder / "left.tif", LEFT)
    tifffile.imwrite(run_folder / "right.tif", RIGHT[[0, 1, 3, 4, 5]])
    text = "frame,t_s,missing\n0,0,\n1,0.01,\n2,0.02,right\n3,0.03,\n4,0.04,\n5,0.05,{}\n"
    (run_folder / "frames.csv").write_text(text.format("left"))
    run = load_run(run_folder)
    assert run.image("right", 2) is None and run.image("left", 5) is None
    np.testing.assert_array_equal(run.image("right", 3), RIGHT[3])
    (run_folder / "frames.csv").write_text(text.format("right|up"))
    error_of(run_folder, "frames.csv row 7, column missing", "'up'")
    (run_folder / "frames.csv").write_text(text.format("right"))
    error_of(run_folder, "right has 5 images, but frames.csv has 6 rows", "misses 2 of them")
