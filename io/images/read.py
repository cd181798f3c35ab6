"""Read one grey image from TIFF, PNG, BMP or JPEG, and refuse what would falsify it.

A file that is cut short must never come back padded: OpenCV pads truncated JPEG files with grey
and says nothing, so each format is checked here before, or by another decoder.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Float32
from telerig.errors import InputError, TelerigWarning
from telerig.io.files.text import read_bytes
from telerig.short_text import counted

Image = NDArray[np.uint8] | NDArray[np.uint16] | Float32

EXTENSIONS = (".tif", ".tiff", ".png", ".bmp", ".jpg", ".jpeg")

_FORMATS = "telerig reads TIFF, PNG, BMP and JPEG"
MOST_BYTES = 400_000_000
"""The largest size of a decoded image: 400 million pixels of 8 bits, 200 million of 16 bits."""
_COPY = (
    "copy or record it again, or remove it; of a run telerig.load_run(skip_unreadable=True) leaves "
    "it out"
)
_COLOUR = (
    "images are in colour: their green channel is used, of which a colour sensor has most pixels; "
    "a mono camera, or a mono mode, resolves better"
)
_MONO = "save it with one grey channel; set a colour camera to a mono mode"


def read_image(
    path: str | PathLike[str], *, expected_size_px: tuple[int, int] | None = None
) -> Image:
    """Read one grey image from a TIFF, PNG, BMP or JPEG file.

    expected_size_px : (width, height) that the image must have; None accepts any size.
    Returns the pixels (height, width) as the file holds them: uint8, uint16, or float32. Three
    equal channels count as grey and an opaque alpha channel is removed. Of a colour image the green
    channel is taken, with a `TelerigWarning`: the others have another magnification behind most
    lenses. There is no EXIF rotation, no gamma and no scaling.
    Raises InputError for a file that is missing, truncated or of an unknown format, that holds
    several pages or values that are not finite, or has another size.
    """
    file = Path(path)
    data = read_bytes(file)
    if not data:
        raise InputError("is empty (0 bytes)", where=str(file), todo=_COPY)
    image = image_from_pixels(_decoder(data, file)(data, file), file)
    if expected_size_px is not None:
        check_size(image, expected_size_px, str(file))
    return image


def image_from_pixels(pixels: NDArray[Any], file: Path) -> Image:
    """Return decoded pixels of a page or a video as grey levels, with the checks of `read_image`.

    file : for errors.
    """
    return _native(_grey(pixels, file), file)


def list_images(folder: str | PathLike[str]) -> list[Path]:
    """List the image files in a folder in natural order (2 before 10), without hidden files."""
    place = Path(folder)
    if not place.is_dir():
        raise InputError("is not a folder", where=str(place), todo="check the path")
    files = (p for p in place.iterdir() if p.suffix.lower() in EXTENSIONS and p.is_file())
    return sorted((p for p in files if not p.name.startswith(".")), key=lambda p: natural(p.name))


def by_stem(files: Iterable[Path], thing: str) -> dict[str, Path]:
    """Return image files by their names without extension.

    thing : what such a name stands for, "view" or "frame". Raises InputError for two files of one.
    """
    found: dict[str, Path] = {}
    for file in files:
        other = found.setdefault(file.stem, file)
        if other != file:
            raise InputError(
                f"{other.name} and {file.name} are the same {thing} twice",
                where=str(file.parent),
                todo=f"the name without its extension is the name of the {thing}: remove or rename "
                "one of the files",
            )
    return found


def natural(name: str) -> tuple[Any, ...]:
    """Return a sorting key for a name, in which runs of digits count as numbers."""
    parts = re.split(r"(\d+)", name)
    return tuple(int(p) if i % 2 else p.lower() for i, p in enumerate(parts)), name


def _decoder(data: bytes, file: Path) -> Callable[[bytes, Path], NDArray[Any]]:
    """Return the decoder for the file's first bytes, whatever its extension says."""
    if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _tiff
    for magic, decode in ((b"\x89PNG\r\n\x1a\n", _png), (b"BM", _bmp), (b"\xff\xd8", _jpeg)):
        if data.startswith(magic):
            return decode
    raise InputError("is not an image of a known format", where=str(file), todo=_FORMATS)


def damaged(path: Path, detail: str) -> InputError:
    """Return the error for a file that ends too early or cannot be decoded."""
    return InputError(f"is truncated or damaged: {detail}", where=str(path), todo=_COPY)


def refuse_too_large(width: int, height: int, bytes_per_pixel: int, file: Path) -> None:
    """Raise InputError if an image, by its header's size, would need more than `MOST_BYTES`."""
    needed = width * height * bytes_per_pixel
    if needed > MOST_BYTES:
        what = f"is {width} x {height} px, {needed / 1e9:.3g} GB when it is decoded"
        todo = f"images up to {MOST_BYTES / 1e9:g} GB are read: cut it out, or save it again"
        raise InputError(what, where=str(file), todo=todo)


@contextmanager
def decoding(file: Path, what: str = "") -> Iterator[None]:
    """Turn every error of a decoder into the InputError of a damaged file; drop its warnings."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:
        raise damaged(file, what + (str(error) or type(error).__name__)) from error


def _opencv(data: bytes, file: Path) -> NDArray[Any]:
    import cv2

    with decoding(file):
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise damaged(file, "it cannot be decoded")
    return np.asarray(pixels)


def _header(data: bytes, kind: str, file: Path) -> Any:
    """Return the image that Pillow opened but did not decode, after its size was checked."""
    from PIL import Image as Pillow

    with decoding(file):
        image = Pillow.open(io.BytesIO(data), formats=[kind])
        bytes_per_pixel = len(image.getbands()) * (2 if ";16" in image.mode else 1)
        refuse_too_large(*image.size, bytes_per_pixel, file)
    return image


def _png(data: bytes, file: Path) -> NDArray[Any]:
    """Decode a PNG file by Pillow, which compares the checksums of all chunks; OpenCV does not."""
    with decoding(file):
        _header(data, "PNG", file).verify()
    return _opencv(data, file)


def _bmp(data: bytes, file: Path) -> NDArray[Any]:
    """Decode a BMP file after Pillow has, which refuses one that is cut off; OpenCV does not."""
    with decoding(file):
        _header(data, "BMP", file).load()
    return _opencv(data, file)


def _jpeg(data: bytes, file: Path) -> NDArray[Any]:
    if data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda"):
        raise damaged(file, "the JPEG has no end marker")
    with decoding(file):
        return np.asarray(_header(data, "JPEG", file))


def _tiff(data: bytes, file: Path) -> NDArray[Any]:
    """Decode a TIFF file; OpenCV where tifffile needs imagecodecs (LZW, 12 packed bits)."""
    bits, orientation = 0, 1
    try:
        with decoding(file), tiff_reader().TiffFile(file) as tiff:
            if len(tiff.pages) == 0:
                raise damaged(file, "the TIFF has no page")
            page = tiff.pages[0]
            of_series = int(np.prod(tiff.series[0].shape)) // max(page.size, 1)
            frames = max(len(tiff.pages), of_series)
            if frames > 1:
                raise InputError(
                    f"holds {counted(frames, 'image')}",
                    where=str(file),
                    todo="save one image per file here; multi-page files belong in runs/",
                )
            bits, orientation = int(np.max(page.bitspersample)), _orientation(page)
            return page_pixels(page, len(data), file)
    except InputError as error:
        if "imagecodecs" not in str(error.__cause__):
            raise
        if orientation != 1:
            raise InputError(
                f"is compressed, and its tag Orientation ({orientation}) would turn or mirror it",
                where=str(file),
                todo="save it without compression",
            ) from error
        pixels = _opencv(data, file)
        return pixels >> 4 if bits == 12 and not np.any(pixels & 15) else pixels


def _orientation(page: Any) -> int:
    tag = page.tags.get("Orientation")
    return 1 if tag is None else int(tag.value)


def tiff_reader() -> Any:
    """Import and return tifffile; what it logs about damaged files is in our errors."""
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL + 1)
    return tifffile


WHITE_IS_0, PALETTE = 0, 3
"""Photometric interpretations of TIFF; a palette's pixels are places in a table of colours."""


def page_pixels(page: Any, file_size: int, file: Path) -> NDArray[Any]:
    """Return the pixels of a page of a TIFF, (height, width) or (height, width, channels).

    page : tifffile's page. file_size : size of the file in bytes.
    Raises InputError if the file ends within the page or stores white as 0, and all errors that
    tifffile raises.
    """
    bits = np.max(page.bitspersample)
    bytes_per_pixel = max(int(bits) // 8, 1) * page.samplesperpixel * page.imagedepth
    refuse_too_large(page.imagewidth, page.imagelength, bytes_per_pixel, file)
    end = max((o + n for o, n in zip(page.dataoffsets, page.databytecounts)), default=0)
    if end > file_size or 0 in page.databytecounts:
        raise damaged(file, f"it has {file_size} bytes, its tags ask for {end}")
    if page.photometric == WHITE_IS_0:
        raise InputError(
            "stores white as 0 (photometric MINISWHITE)",
            where=str(file),
            todo="save it again with black as 0",
        )
    pixels = np.asarray(page.asarray())
    if page.photometric == PALETTE:
        colours = np.moveaxis(np.asarray(page.colormap), 0, -1) >> 8
        return np.asarray(colours.astype(np.uint8)[pixels])
    return np.moveaxis(pixels, 0, -1) if page.axes == "SYX" else pixels


def _grey(pixels: NDArray[Any], file: Path) -> NDArray[Any]:
    if pixels.ndim == 3 and pixels.shape[-1] in (2, 4):
        opaque = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else pixels[0, 0, -1]
        if np.any(pixels[..., -1] != opaque):
            raise InputError(
                "has a fourth channel that is not constant (transparency or CMYK)",
                where=str(file),
                todo=_MONO,
            )
        pixels = pixels[..., :-1]
    if pixels.ndim == 2:
        return pixels
    if pixels.ndim != 3 or pixels.shape[-1] not in (1, 3):
        raise InputError(
            f"has the shape {pixels.shape}, not one of an image", where=str(file), todo=_MONO
        )
    if np.any(pixels != pixels[..., :1]):
        warnings.warn(_COLOUR, TelerigWarning, stacklevel=2)
    return pixels[..., pixels.shape[-1] // 2]


def _native(pixels: NDArray[Any], file: Path) -> Image:
    """Return uint8, uint16 or float32, contiguous; wider integers only if nothing is lost."""
    if pixels.size == 0:
        raise damaged(file, "it has no pixels")
    if pixels.dtype in (np.uint8, np.uint16):
        return np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("="))
    if pixels.dtype.kind == "f":
        bad = np.argwhere(~np.isfinite(pixels))
        if len(bad):
            row, column = bad[0]
            raise InputError(
                f"has {len(bad)} pixels that are NaN or infinite, the first at column "
                f"{column}, row {row}",
                where=str(file),
                todo="save the raw 8- or 16-bit image, or replace those pixels",
            )
        return np.ascontiguousarray(pixels, dtype=np.float32)
    if pixels.dtype.kind in "iu" and pixels.min() >= 0 and pixels.max() <= 65535:
        return np.ascontiguousarray(pixels, dtype=np.uint16)
    raise InputError(
        f"has pixels of type {pixels.dtype}, which do not fit 16 bits",
        where=str(file),
        todo="save it with 8 or 16 bits per pixel (not 1 bit: a "
        "thresholded image has lost its sub-pixel information)",
    )


def check_size(pixels: Image, expected: tuple[int, int], where: str) -> None:
    """Raise InputError unless the image is ``expected`` = (width, height) px."""
    height, width = pixels.shape
    if (width, height) == tuple(expected):
        return
    swapped = " (width and height swapped?)" if (height, width) == tuple(expected) else ""
    raise InputError(
        f"is {width} x {height} px, expected {expected[0]} x {expected[1]}{swapped}",
        where=where,
        todo="correct image_size_px = [width, height] of that "
        "camera in rig.toml, or put the right image there",
    )
