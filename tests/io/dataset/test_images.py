"""Images: every format gives the pixels back; what would falsify them is refused."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image as Pillow

from telerig.errors import InputError, TelerigWarning
from telerig.io.images.read import list_images, natural, read_image

RNG = np.random.default_rng(5)
GREY8 = RNG.integers(0, 256, (37, 53), dtype=np.uint8)
GREY12 = RNG.integers(0, 4096, (37, 53)).astype(np.uint16)
GREY16 = RNG.integers(0, 65536, (37, 53)).astype(np.uint16)


def error_of(file: Path, **options: tuple[int, int]) -> str:
    with pytest.raises(InputError) as caught:
        read_image(file, **options)
    message = str(caught.value)
    assert str(file) in message, "says where"
    assert "\n  -> " in message, "says what to do"
    return message


def packed_tiff12(pixels: NDArray[np.uint16]) -> bytes:
    """A TIFF with 12 bits per sample, packed, as machine-vision software writes them."""
    height, width = pixels.shape
    bits = ((pixels[..., None] >> np.arange(11, -1, -1)) & 1).astype(np.uint8)
    data = np.packbits(bits.reshape(height, -1), axis=1).tobytes()
    tags = [(256, width), (257, height), (258, 12), (259, 1), (262, 1), (273, 0), (277, 1),
            (278, height), (279, len(data))]  # fmt: skip
    start = 8 + 2 + 12 * len(tags) + 4
    entries = (struct.pack("<HHII", tag, 4, 1, start if tag == 273 else n) for tag, n in tags)
    head = b"II*\0" + struct.pack("<IH", 8, len(tags))
    return head + b"".join(entries) + bytes(4) + data


@pytest.mark.parametrize("pixels", [GREY8, GREY12, GREY16], ids=["8", "12", "16"])
@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_lossless_formats_give_back_every_pixel(
    suffix: str, pixels: NDArray[np.uint16], tmp_path: Path
) -> None:
    file = tmp_path / f"a{suffix}"
    if suffix == ".tif":
        tifffile.imwrite(file, pixels)
    else:
        Pillow.fromarray(pixels).save(file)
    image = read_image(file, expected_size_px=(53, 37))
    assert image.dtype == pixels.dtype
    np.testing.assert_array_equal(image, pixels)


@pytest.mark.parametrize(
    "options",
    [
        {"compression": "zlib"},
        {"compression": "zlib", "predictor": True},
        {"byteorder": ">"},
        {"bigtiff": True},
        {"tile": (16, 16)},
        {"rowsperstrip": 5},
    ],
    ids=str,
)
def test_dialects_of_tiff(options: dict[str, object], tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", GREY12, **options)
    image = read_image(tmp_path / "a.tif")
    np.testing.assert_array_equal(image, GREY12)
    assert image.dtype.isnative and image.flags.c_contiguous


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_a_compressed_tiff_is_never_turned(orientation: int, tmp_path: Path) -> None:
    file = tmp_path / "a.tif"
    Pillow.fromarray(GREY8).save(file, compression="tiff_lzw", tiffinfo={274: orientation})
    if orientation == 1:
        np.testing.assert_array_equal(read_image(file), GREY8)
    else:
        assert f"Orientation ({orientation})" in error_of(file)


@pytest.mark.parametrize("pixels", [GREY8, GREY12], ids=["8", "12"])
def test_lzw_tiff_as_opencv_writes_it(pixels: NDArray[np.uint16], tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "a.tif"), pixels, [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), pixels)


def test_packed_12_bit_tiff(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_bytes(packed_tiff12(GREY12[:, :52]))
    image = read_image(tmp_path / "a.tif")
    np.testing.assert_array_equal(image, GREY12[:, :52])


def test_bmp_and_jpeg(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.bmp"), GREY8)
    np.testing.assert_array_equal(read_image(tmp_path / "a.bmp"), GREY8)
    smooth = np.add.outer(np.arange(40), np.arange(60)).astype(np.uint8)
    Pillow.fromarray(smooth).save(tmp_path / "a.jpg", quality=98)
    image = read_image(tmp_path / "a.jpg")
    assert image.shape == (40, 60) and image.dtype == np.uint8
    assert np.abs(image.astype(int) - smooth).max() <= 2


def test_the_content_decides_not_the_extension(tmp_path: Path) -> None:
    Pillow.fromarray(GREY8).save(tmp_path / "a.png")
    (tmp_path / "a.png").rename(tmp_path / "a.tif")
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), GREY8)


@pytest.mark.parametrize("name", ["a.tif", "a.png", "a.bmp", "rgba.png", "planar.tif"])
def test_equal_channels_are_grey(name: str, tmp_path: Path) -> None:
    file, colour = tmp_path / name, np.repeat(GREY8[..., None], 3, axis=2)
    if name == "planar.tif":
        tifffile.imwrite(file, np.moveaxis(colour, -1, 0), photometric="rgb", planarconfig=2)
    elif name == "rgba.png":
        Pillow.fromarray(np.dstack([colour, np.full_like(GREY8, 255)])).save(file)
    elif name == "a.tif":
        tifffile.imwrite(file, colour, photometric="rgb")
    else:
        Pillow.fromarray(colour).save(file)
    np.testing.assert_array_equal(read_image(file), GREY8)


@pytest.mark.parametrize("suffix", [".tif", ".png", ".bmp", ".jpg"])
def test_of_a_colour_image_the_green_channel_is_taken_and_said(suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"a{suffix}"
    colour = np.dstack([255 - GREY8, GREY8, np.zeros_like(GREY8)])
    if suffix == ".tif":
        tifffile.imwrite(file, colour, photometric="rgb")
    else:
        Pillow.fromarray(colour).save(file, quality=100, subsampling=0)
    with pytest.warns(TelerigWarning, match="green channel"):
        green = read_image(file).astype(int)
    np.testing.assert_allclose(green, GREY8, atol=5 if suffix == ".jpg" else 0)


def test_transparency_is_refused(tmp_path: Path) -> None:
    Pillow.fromarray(np.dstack([GREY8] * 4)).save(tmp_path / "a.png")
    assert "transparency" in error_of(tmp_path / "a.png")


def written(suffix: str, file: Path) -> bytes:
    if suffix == ".lzw.tif":
        cv2.imwrite(str(file), GREY12)
    elif suffix == ".zlib.tif":
        tifffile.imwrite(file, GREY12, compression="zlib")
    elif suffix == ".strips.tif":
        tifffile.imwrite(file, GREY12, rowsperstrip=4)
    elif suffix == ".16.png":
        Pillow.fromarray(GREY12).save(file)
    else:
        Pillow.fromarray(GREY8).save(file)
    return file.read_bytes()


FORMATS = [".tif", ".lzw.tif", ".zlib.tif", ".strips.tif", ".png", ".16.png", ".bmp", ".jpg"]


@pytest.mark.parametrize("kept", [0.3, 0.7, 0.9, 0.999])
@pytest.mark.parametrize("suffix", FORMATS)
def test_a_truncated_file_is_named_never_padded(suffix: str, kept: float, tmp_path: Path) -> None:
    file = tmp_path / f"a{suffix}"
    data = written(suffix, file)
    read_image(file)
    file.write_bytes(data[: min(int(kept * len(data)), len(data) - 1)])
    message = error_of(file)
    assert "truncated or damaged" in message and "copy or record it again" in message


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".zlib.tif"])
def test_a_tail_of_zeros_is_a_truncated_file_too(suffix: str, tmp_path: Path) -> None:
    file = tmp_path / f"a{suffix}"
    data = written(suffix, file)
    cut = len(data) * 2 // 3
    file.write_bytes(data[:cut] + bytes(len(data) - cut))
    assert "truncated or damaged" in error_of(file)


def test_a_tiff_whose_last_strips_were_never_written(tmp_path: Path) -> None:
    """tifffile fills strips of no bytes with zeros and says nothing."""
    file = tmp_path / "a.tif"
    tifffile.imwrite(file, GREY12, rowsperstrip=16, compression="zlib")
    with tifffile.TiffFile(file, mode="r+b") as tiff:
        counts = tiff.pages[0].databytecounts
        tiff.pages[0].tags["StripByteCounts"].overwrite([*counts[:-1], 0])
    assert tifffile.imread(file)[-1].max() == 0
    assert "truncated or damaged" in error_of(file)


def test_a_flipped_bit_in_a_png_is_found(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    data = bytearray(written(".png", file))
    data[len(data) // 2] ^= 4
    file.write_bytes(bytes(data))
    assert "checksum" in error_of(file)


NO_IMAGES = [
    b"",
    b"hello, this is no image",
    b"\x93NUMPY..........",
    b"BM",
    b"II*\0",
    b"\xff\xd8\xff\xe0",
    b"\x89PNG\r\n\x1a\n",
]


@pytest.mark.parametrize("content", NO_IMAGES)
def test_files_that_are_no_images(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "a.tif"
    file.write_bytes(content)
    message = error_of(file)
    assert any(word in message for word in ("is empty", "known format", "truncated"))


def test_missing_file(tmp_path: Path) -> None:
    assert "does not exist" in error_of(tmp_path / "nothing.tif")
    (tmp_path / "folder.tif").mkdir()
    assert "cannot be read" in error_of(tmp_path / "folder.tif")


def test_the_wrong_size_names_both(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", GREY8)
    message = error_of(tmp_path / "a.tif", expected_size_px=(640, 480))
    assert "is 53 x 37 px, expected 640 x 480" in message and "image_size_px" in message
    swapped = error_of(tmp_path / "a.tif", expected_size_px=(37, 53))
    assert "width and height swapped?" in swapped


def test_several_pages_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "pages.tif", np.stack([GREY8] * 4), photometric="minisblack")
    tifffile.imwrite(tmp_path / "imagej.tif", np.stack([GREY8] * 4), imagej=True)
    for name in ("pages.tif", "imagej.tif"):
        message = error_of(tmp_path / name)
        assert "holds 4 images" in message and "one image per file" in message


def test_float_tiff_with_finite_values(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "a.tif", GREY12.astype(np.float32) / 3)
    image = read_image(tmp_path / "a.tif")
    assert image.dtype == np.float32
    np.testing.assert_array_equal(image, GREY12.astype(np.float32) / 3)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_float_tiff_that_is_not_finite(value: float, tmp_path: Path) -> None:
    pixels = GREY8.astype(np.float32)
    pixels[3, 7] = pixels[5, 1] = value
    tifffile.imwrite(tmp_path / "a.tif", pixels)
    message = error_of(tmp_path / "a.tif")
    assert "2 pixels that are NaN or infinite" in message and "column 7, row 3" in message


def test_odd_pixel_types(tmp_path: Path) -> None:
    file = tmp_path / "a.tif"
    tifffile.imwrite(file, GREY12.astype(np.int16))
    np.testing.assert_array_equal(read_image(file), GREY12)
    tifffile.imwrite(file, GREY12.astype(np.int32) - 2000)
    assert "do not fit 16 bits" in error_of(file)
    tifffile.imwrite(file, GREY8 > 99, photometric="minisblack")
    assert "thresholded" in error_of(file)
    tifffile.imwrite(file, GREY8, photometric="miniswhite")
    assert "white as 0" in error_of(file)


def test_list_images(tmp_path: Path) -> None:
    for name in ("10.tif", "9.PNG", "100.Jpeg", "notes.txt", "._9.png", "1.npy"):
        (tmp_path / name).touch()
    (tmp_path / "2.tif").mkdir()
    assert [p.name for p in list_images(tmp_path)] == ["9.PNG", "10.tif", "100.Jpeg"]
    with pytest.raises(InputError, match="is not a folder"):
        list_images(tmp_path / "none")


def test_natural_order_of_names_that_begin_alike() -> None:
    names = ["rise10", "rise", "Rise2", "rise2b", "10", "9", "rise-1", "a1b2", "a1"]
    assert sorted(names, key=natural) == [
        "9", "10", "a1", "a1b2", "rise", "Rise2", "rise2b", "rise10", "rise-1"
    ]  # fmt: skip
