"""Runs: what a run's folder must be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from run_files import (
    CAMERAS,
    LEFT,
    RIG,
    RIGHT,
    SIZES,
    assert_frames,
    error_of,
    movie,
    write_images,
    write_video,
)

from telerig.errors import InputError
from telerig.io.dataset.dataset import load_dataset
from telerig.io.dataset.run import load_run


def test_a_dataset_loads_its_runs(full_run: Path) -> None:
    dataset = load_dataset(full_run.parent.parent, need_views=False)
    assert_frames(dataset.runs["rise"].load(), "left", LEFT)


def test_bare_folder_with_cameras_of_a_calibration(full_run: Path, tmp_path: Path) -> None:
    bare = full_run.rename(tmp_path / "bare")
    error_of(bare, "no rig.toml two folders up", "--calibration")
    run = load_run(bare, cameras=CAMERAS, image_sizes_px=SIZES)
    assert run.rig is None and run.cameras == CAMERAS
    assert_frames(run, "right", RIGHT)
    assert load_run(bare, cameras=CAMERAS).image_sizes_px == SIZES, "from the images"
    sizes = SIZES | {"right": (50, 32)}
    error_of(bare, "is 48 x 32 px, expected 50 x 32", cameras=CAMERAS, image_sizes_px=sizes)


def test_wrong_paths(full_run: Path) -> None:
    error_of(full_run.parent / "rize", "there is no such run", "did you mean rise?")
    error_of(full_run / "run.toml", "is a file")


def test_nothing_in_the_folder(run_folder: Path) -> None:
    error_of(run_folder, "no images", "left/*.tif")
    error_of(run_folder, "no detections.csv", source="detections")


def test_camera_without_frames(run_folder: Path) -> None:
    write_images(run_folder / "left", LEFT)
    error_of(run_folder, "camera right has no frames", "right.avi")


def test_frames_of_an_unknown_camera(full_run: Path) -> None:
    write_images(full_run / "rigth", LEFT)
    error_of(full_run, "there is no camera 'rigth'", "did you mean right?")


def test_two_recordings_of_one_camera(full_run: Path) -> None:
    tifffile.imwrite(full_run / "left.tif", LEFT)
    error_of(full_run, "left", "left.tif", "keep one")


def test_the_same_frame_twice(full_run: Path) -> None:
    tifffile.imwrite(full_run / "left" / "000002.tiff", LEFT[2])
    error_of(full_run, "000002.tif and 000002.tiff are the same frame twice")


def test_multi_page_file_within_a_camera_folder(run_folder: Path) -> None:
    for camera in CAMERAS:
        (run_folder / camera).mkdir()
        tifffile.imwrite(run_folder / camera / "all.tif", LEFT)
    error_of(run_folder, "holds 6 frames", "move it to left.tif")


@pytest.mark.parametrize("kind", ["images", "pages", "video"])
def test_image_size_of_another_rig(kind: str, run_folder: Path) -> None:
    small = movie(3)[:, :-2]
    for camera in CAMERAS:
        if kind == "images":
            write_images(run_folder / camera, small)
        elif kind == "pages":
            tifffile.imwrite(run_folder / f"{camera}.tif", small, photometric="minisblack")
        else:
            frames = np.ascontiguousarray(movie(3))
            write_video(run_folder / f"{camera}.avi", frames, "ffv1", "gray")
            rig = run_folder.parent.parent / "rig.toml"
            rig.write_text(RIG.replace("[48, 32]", "[48, 34]"))
    expected = "is 48 x 32 px, expected 48 x 34" if kind == "video" else "is 48 x 30 px, expected"
    error_of(run_folder, expected, "left", "image_size_px")


def test_size_that_changes_within_the_run(full_run: Path) -> None:
    tifffile.imwrite(full_run / "left" / "000003.tif", LEFT[3][:, :-1])
    run = load_run(full_run, skip_unreadable=True)
    with pytest.raises(InputError, match=r"000003\.tif: is 47 x 32 px, expected 48 x 32"):
        run.image("left", 3)


def test_no_such_camera_or_frame(full_run: Path) -> None:
    run = load_run(full_run)
    with pytest.raises(InputError, match="did you mean left"):
        run.image("lefft", 0)
    with pytest.raises(InputError, match="there is no frame 6"):
        run.image("left", 6)
    with pytest.raises(InputError, match="there is no frame -1"):
        run.image("left", -1)
