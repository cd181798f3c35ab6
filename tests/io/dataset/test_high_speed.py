"""Phantom .cine and Photron .mraw: pixels, times and numbers as they were written; refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from high_speed_files import write_cine, write_mraw

from telerig.errors import InputError
from telerig.io.dataset.run import load_run
from telerig.io.images.frames import open_frames
from telerig.io.images.high_speed import HighSpeedFrames, open_high_speed


def frames(bits: int, count: int = 4, shape: tuple[int, int] = (6, 9)) -> np.ndarray:
    kind = np.uint8 if bits == 8 else np.uint16
    return np.random.default_rng(bits).integers(0, 2**bits, (count, *shape)).astype(kind)


def opened(path: Path) -> HighSpeedFrames:
    source = open_frames(path.parent, path.stem)
    assert isinstance(source, HighSpeedFrames)
    return source


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_cine(tmp_path: Path, bits: int) -> None:
    file, images = tmp_path / "left.cine", frames(bits)
    t_s = 1.7e9 + np.array([0.0, 0.001, 0.0025, 0.003])
    write_cine(file, images, t_s, bits=bits)
    source = opened(file)
    for position, image in enumerate(images):
        found = source.read(position)
        assert found.dtype == image.dtype
        np.testing.assert_array_equal(found, image)
    np.testing.assert_allclose(source.t_s, t_s - t_s[0], atol=2e-7)
    np.testing.assert_array_equal(source.numbers(), [-2, -1, 0, 1])
    assert not source.cut_short


def test_cine_without_times_has_those_of_its_rate(tmp_path: Path) -> None:
    write_cine(tmp_path / "left.cine", frames(8), rate_hz=500)
    np.testing.assert_allclose(opened(tmp_path / "left.cine").t_s, np.arange(4) / 500)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
@pytest.mark.parametrize("xml", [True, False])
def test_mraw(tmp_path: Path, bits: int, xml: bool) -> None:
    file, images = tmp_path / "left.mraw", frames(bits, shape=(5, 8))
    write_mraw(file, images, bits=bits, xml=xml)
    source = opened(file)
    assert len(source) == 4
    for position, image in enumerate(images):
        np.testing.assert_array_equal(source.read(position), image)
    np.testing.assert_allclose(source.t_s, np.arange(4) / 2000)
    np.testing.assert_array_equal(source.numbers(), [5, 6, 7, 8])


def test_a_run_of_two_cameras_is_paired_by_numbers_and_has_times(tmp_path: Path) -> None:
    write_cine(tmp_path / "left.cine", frames(8, shape=(20, 20)), first=0)
    write_cine(tmp_path / "right.cine", frames(8, shape=(20, 20)), first=0)
    run = load_run(tmp_path, cameras=["left", "right"])
    np.testing.assert_allclose(run.t_s, np.arange(4) / 1000)
    assert any("left.cine" in note for note in run.notes)
    (tmp_path / "run.toml").write_text("frame_rate_hz = 250.0\n")
    np.testing.assert_allclose(
        load_run(tmp_path, cameras=["left", "right"]).t_s, np.arange(4) / 250
    )


def test_files_that_end_early_and_kinds_that_are_not_read(tmp_path: Path) -> None:
    file = tmp_path / "left.cine"
    write_cine(file, frames(8))
    whole = file.read_bytes()
    file.write_bytes(whole[:-10])
    source = opened(file)
    assert source.cut_short and len(source) == 4
    source.read(2)
    with pytest.raises(InputError, match="ends within this frame"):
        source.read(3)
    file.write_bytes(whole[:60])
    with pytest.raises(InputError, match=r"cut off|impossible"):
        open_high_speed(file)
    write_cine(file, frames(8), packing=256)
    with pytest.raises(InputError, match="10 bits with a companding curve"):
        open_high_speed(file)
    raw = tmp_path / "right.mraw"
    write_mraw(raw, frames(12, shape=(5, 8)))
    raw.write_bytes(raw.read_bytes()[:-1])
    assert opened(raw).cut_short
    raw.with_suffix(".cihx").write_text("<cih></cih>")
    with pytest.raises(InputError, match="Image Width is missing"):
        open_high_speed(raw)
    raw.with_suffix(".cihx").unlink()
    with pytest.raises(InputError, match=r"put right\.cihx"):
        open_high_speed(raw)
