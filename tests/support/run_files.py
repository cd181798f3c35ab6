"""Folders of runs: recordings of every kind, and what loading says of bad ones."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image

from telerig.errors import InputError
from telerig.io.dataset.run import RunData, load_run

WIDTH, HEIGHT = 48, 32
SIZES = {"left": (WIDTH, HEIGHT), "right": (WIDTH, HEIGHT)}
CAMERAS = ("left", "right")
RIG = """schema = 1
[cameras.left]
image_size_px = [48, 32]
scale_px_per_mm = 10.0
[cameras.right]
image_size_px = [48, 32]
scale_px_per_mm = 10.0
[target]
layout = "grid"
rows = 3
columns = 5
pitch_mm = 7.0
dot_diameter_mm = 2.4
marks = [[1, 2], [1, 3], [0, 2]]
mark_diameter_mm = 3.6
[accelerometers.arm_left]
mounted_on = "left"
axes = [[1,0,0],[0,1,0],[0,0,1]]
noise_density_ug_sqrt_hz = 22.5
"""


def movie(count: int, bits: int = 8, seed: int = 0) -> NDArray[Any]:
    """(count, HEIGHT, WIDTH) frames that differ all over."""
    kind = np.uint8 if bits == 8 else np.uint16
    return np.random.default_rng(seed).integers(1, 1 << bits, (count, HEIGHT, WIDTH)).astype(kind)


LEFT, RIGHT = movie(6, seed=1), movie(6, seed=2)


def write_images(
    folder: Path, frames: NDArray[Any], names: Sequence[int] | None = None, suffix: str = ".tif"
) -> None:
    folder.mkdir(parents=True)
    for number, frame in zip(names or range(len(frames)), frames):
        file = folder / f"{number:06d}{suffix}"
        tifffile.imwrite(file, frame) if suffix == ".tif" else Image.fromarray(frame).save(file)


def write_video(file: Path, frames: NDArray[Any], codec: str, pixels: str, **options: str) -> None:
    av = pytest.importorskip("av")
    given = "gray" if frames.dtype == np.uint8 else pixels
    with av.open(str(file), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(100), options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixels
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format=given)))
        container.mux(stream.encode())


def error_of(path: Path, *words: str, **options: Any) -> str:
    """The message of the error that loading raises, which has what to do and all the words."""
    with pytest.raises(InputError) as caught:
        load_run(path, **options)
    return checked(str(caught.value), *words)


def checked(message: str, *words: str) -> str:
    assert "\n  -> " in message, "says what to do"
    for word in words:
        assert word in message, message
    return message


def assert_frames(run: RunData, camera: str, frames: NDArray[Any]) -> None:
    got = [run.image(camera, frame) for frame in range(run.frame_count)]
    assert len(got) == len(frames)
    for image, expected in zip(got, frames):
        assert image is not None and image.dtype == expected.dtype
        np.testing.assert_array_equal(image, expected)


# --- times and the stage -----------------------------------------------------------------------


def times(rows: str) -> str:
    return "frame,t_s\n" + rows


GOOD = "0,0\n1,.1\n2,.2\n3,.3\n4,.4\n5,.5\n"
