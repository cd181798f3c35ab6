"""Runs: every kind of recording gives its frames back."""

from __future__ import annotations

import gc
import pickle
import struct
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from run_files import (
    CAMERAS,
    HEIGHT,
    LEFT,
    RIGHT,
    WIDTH,
    assert_frames,
    error_of,
    movie,
    write_images,
    write_video,
)

from telerig.io.dataset.run import load_run
from telerig.io.images.frames import PageFrames

RNG = np.random.default_rng(3)


@pytest.mark.parametrize("suffix", [".tif", ".png", ".bmp"])
def test_image_sequences(suffix: str, run_folder: Path) -> None:
    write_images(run_folder / "left", LEFT, suffix=suffix)
    write_images(run_folder / "right", RIGHT, suffix=suffix)
    run = load_run(run_folder)
    assert (run.name, run.cameras, run.frame_count) == ("rise", CAMERAS, 6)
    assert run.source == "images" and run.notes == []
    assert run.rig is not None and run.rig.first == "left"
    np.testing.assert_allclose(run.t_s, 2.0 + np.arange(6) / 100, rtol=1e-15)
    assert run.position_mm is None and run.stage is None and run.detections is None
    assert_frames(run, "left", LEFT)
    assert_frames(run, "right", RIGHT)
    np.testing.assert_array_equal(run.image(1, 4), RIGHT[4])


def test_names_without_leading_zeros_come_in_the_order_of_their_numbers(run_folder: Path) -> None:
    for camera in CAMERAS:
        (run_folder / camera).mkdir()
        for k, frame in enumerate(movie(12)):
            tifffile.imwrite(run_folder / camera / f"shot{k + 1}.tif", frame)
    assert_frames(load_run(run_folder), "right", movie(12))


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("kind", ["series", "pages", "big", "imagej", "compressed", "motorola"])
def test_multi_page_tiff(kind: str, bits: int, run_folder: Path) -> None:
    frames = movie(7, bits)
    for camera in CAMERAS:
        file = run_folder / f"{camera}.tif"
        if kind == "pages":
            with tifffile.TiffWriter(file) as writer:
                for frame in frames:
                    writer.write(frame, contiguous=False, metadata=None)
        else:
            options: dict[str, Any] = {
                "series": {},
                "big": {"bigtiff": True},
                "imagej": {"imagej": True},
                "compressed": {"compression": "zlib"},
                "motorola": {"byteorder": ">"},
            }[kind]
            tifffile.imwrite(file, frames, photometric="minisblack", **options)
    run = load_run(run_folder)
    assert_frames(run, "left", frames)
    np.testing.assert_array_equal(run.image("right", 5), frames[5])


@pytest.mark.parametrize("counted", [6, 8])
def test_pages_with_gaps_between_them_are_not_read_as_one_block(
    counted: int, run_folder: Path
) -> None:
    """A recorder may write each page beside its header, and the count that was asked for."""
    frames = movie(6)
    for camera in CAMERAS:
        with tifffile.TiffWriter(run_folder / f"{camera}.tif") as writer:
            for k, frame in enumerate(frames):
                words = f"ImageJ=1.53\nimages={counted}\nframes={counted}\n" if k == 0 else None
                writer.write(
                    frame, contiguous=False, metadata=None, description=words, software=False
                )
    assert_frames(load_run(run_folder), "left", frames)


def test_pages_with_a_palette_are_what_they_show(run_folder: Path) -> None:
    frames = movie(3)
    inverse = np.stack([(255 - np.arange(256)) * 257] * 3).astype(np.uint16)
    for camera in CAMERAS:
        file = run_folder / f"{camera}.tif"
        tifffile.imwrite(file, 255 - frames, photometric="palette", colormap=inverse, metadata=None)
    assert_frames(load_run(run_folder), "left", frames)


VIDEOS = [
    ("avi", "rawvideo", "gray", 8),
    ("avi", "rawvideo", "bgr24", 8),
    ("avi", "ffv1", "gray", 8),
    ("mkv", "ffv1", "gray16le", 16),
    ("avi", "ffv1", "gray12le", 12),
]


@pytest.mark.parametrize(("suffix", "codec", "pixels", "bits"), VIDEOS)
def test_lossless_videos_in_any_order(
    suffix: str, codec: str, pixels: str, bits: int, run_folder: Path
) -> None:
    frames = movie(40, bits)
    for camera in CAMERAS:
        write_video(run_folder / f"{camera}.{suffix}", frames, codec, pixels)
    run = load_run(run_folder)
    assert run.frame_count == 40
    for k in [*RNG.permutation(40), 3, 4, 5, 4, 39, 0]:
        np.testing.assert_array_equal(run.image("left", int(k)), frames[k])


def test_mp4_with_frames_that_depend_on_later_ones(run_folder: Path) -> None:
    """x264 with B-frames: packets are not in the order of time; levels tell the frames apart."""
    frames = np.repeat(np.arange(20, 220, 4, dtype=np.uint8), HEIGHT * WIDTH)
    frames = frames.reshape(-1, HEIGHT, WIDTH)
    for camera in CAMERAS:
        file = run_folder / f"{camera}.mp4"
        write_video(file, frames, "libx264", "gray", bf="3", g="12", crf="4")
    run = load_run(run_folder)
    assert run.frame_count == len(frames)
    for k in [*range(len(frames)), *RNG.permutation(len(frames))]:
        image = run.image("left", int(k))
        assert image is not None and abs(float(image.mean()) - 20 - 4 * k) < 1.5, k


def test_a_run_with_a_video_goes_to_another_process(run_folder: Path) -> None:
    for camera in CAMERAS:
        write_video(run_folder / f"{camera}.avi", LEFT, "ffv1", "gray")
    run = load_run(run_folder)
    run.image("left", 2)
    again = pickle.loads(pickle.dumps(run))
    assert_frames(again, "left", LEFT)


def test_video_without_pyav_names_the_command(
    run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for camera in CAMERAS:
        write_video(run_folder / f"{camera}.avi", LEFT, "ffv1", "gray")
    monkeypatch.setitem(sys.modules, "av", None)
    error_of(run_folder, "needs av", "pip install 'telerig[video]'")


def paged_tiff(frame: NDArray[np.uint8], count: int) -> bytes:
    """A TIFF of pages whose first pixel counts, put together by hand: header, pixels, header..."""
    height, width = frame.shape
    out = [b"II*\0" + struct.pack("<I", 8 + frame.size)]
    at = 8
    for k in range(count):
        tags = [(256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, at), (277, 1),
                (278, height), (279, frame.size)]  # fmt: skip
        head = struct.pack("<H", len(tags)) + b"".join(
            struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags
        )
        at += frame.size + len(head) + 4
        following = at + frame.size if k < count - 1 else 0
        pixels = bytes([k % 251]) + frame.tobytes()[1:]
        out += [pixels, head, struct.pack("<I", following)]
    return b"".join(out)


def test_memory_stays_flat_over_2_500_pages(tmp_path: Path) -> None:
    (tmp_path / "left.tif").write_bytes(paged_tiff(movie(1)[0], 2_500))
    source = PageFrames(tmp_path / "left.tif")
    assert len(source) == 2_500
    assert [source.read(k)[0, 0] for k in range(100)] == list(range(100))
    tracemalloc.start()
    for k in range(0, 2_500, 25):
        assert source.read(k)[0, 0] == k % 251
    gc.collect()
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 10 * WIDTH * HEIGHT, "bytes that 400 reads leave behind"
