"""Random access to one camera's frames of a run: an image each, a multi-page TIFF, a video.

Nothing but the frame asked for is held, so memory does not grow with the run.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Ints
from telerig.errors import InputError
from telerig.io.images.read import (
    Image,
    damaged,
    image_from_pixels,
    list_images,
    page_pixels,
    read_image,
)
from telerig.io.images.video import VIDEO_EXTENSIONS, VideoFrames

PAGE_EXTENSIONS = (".tif", ".tiff")


class FrameSource(Protocol):
    """One camera's frames in the order of recording, not yet in step with another camera's.

    path : the folder or the file. cut_short : the file ends within its last frame.
    """

    @property
    def path(self) -> Path: ...

    @property
    def cut_short(self) -> bool: ...

    def __len__(self) -> int: ...

    def read(self, position: int) -> Image:
        """As `read_image`. Raises InputError, naming file and frame, if it cannot be read."""

    def where(self, position: int) -> str:
        """File and frame, for errors."""

    def numbers(self) -> Ints | None:
        """(N,) what the names count, increasing; None when they do not count."""


@dataclass(frozen=True)
class ImageFiles:
    """A folder of images, one per frame: their names in natural order.

    Names and not paths, which take ten times the memory and go to every process.
    """

    path: Path
    names: tuple[str, ...]
    cut_short: bool = False

    def __len__(self) -> int:
        return len(self.names)

    def read(self, position: int) -> Image:
        return read_image(self.path / self.names[position])

    def where(self, position: int) -> str:
        return str(self.path / self.names[position])

    def numbers(self) -> Ints | None:
        """The last number in each name, when the rest of the names is alike."""
        parts = [re.fullmatch(r"(.*?)(\d+)(\D*)", Path(n).stem) for n in self.names]
        if not all(parts) or len({(m[1], m[3]) for m in parts if m}) != 1:
            return None
        if any(len(m[2]) > 18 for m in parts if m):
            return None
        counted = np.array([int(m[2]) for m in parts if m], np.int64)
        return counted if np.all(np.diff(counted) > 0) else None


class PageFrames:
    """A multi-page TIFF; pages are found by their offsets and read one at a time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._size = path.stat().st_size
        self._offsets, self.cut_short = _page_offsets(path)
        with self._opened() as tiff:
            self._stack = _contiguous_stack(tiff, len(self._offsets))
        self._length = len(self._offsets)
        if self._stack is not None:
            self._length = self._stack.count
        elif self.cut_short:
            self._length += 1

    def __len__(self) -> int:
        return self._length

    def where(self, position: int) -> str:
        return f"{self.path} (page {position}, from 0)"

    def numbers(self) -> Ints | None:
        return None

    def read(self, position: int) -> Image:
        try:
            pixels = self._page(position) if self._stack is None else self._from_stack(position)
            return image_from_pixels(pixels, self.path)
        except InputError as error:
            raise InputError(error.what, where=self.where(position), todo=error.todo) from error

    def _opened(self) -> Any:
        import tifffile

        try:
            return tifffile.TiffFile(self.path)
        except Exception as error:
            raise damaged(self.path, str(error)) from error

    def _page(self, position: int) -> NDArray[Any]:
        import tifffile

        if position >= len(self._offsets):
            raise damaged(self.path, f"it ends after {len(self._offsets)} pages")
        with self._opened() as tiff:
            tiff.filehandle.seek(int(self._offsets[position]))
            try:
                page = tifffile.TiffPage(tiff, index=position)
                return page_pixels(page, self._size, self.path)
            except InputError:
                raise
            except Exception as error:
                if "imagecodecs" in str(error):
                    todo = "save it without compression, or `pip install imagecodecs`"
                    what = f"cannot be read: {error}"
                    raise InputError(what, where=str(self.path), todo=todo) from error
                raise damaged(self.path, str(error)) from error

    def _from_stack(self, position: int) -> NDArray[Any]:
        assert self._stack is not None
        start, end = self._stack.span(position)
        if end > self._size:
            raise damaged(self.path, f"it has {self._size} bytes, the page asks for {end}")
        height, width = self._stack.shape
        flat = np.fromfile(self.path, self._stack.dtype, height * width, offset=start)
        return flat.reshape(height, width)


@dataclass(frozen=True)
class _Stack:
    """Frames one behind the other behind a single page header, as ImageJ writes them."""

    offset: int
    count: int
    shape: tuple[int, int]
    dtype: Any

    def span(self, position: int) -> tuple[int, int]:
        size = self.shape[0] * self.shape[1] * self.dtype.itemsize
        start = self.offset + position * size
        return start, start + size


def _contiguous_stack(tiff: Any, pages: int) -> _Stack | None:
    """When the file's description counts more frames than there are page headers."""
    page = tiff.pages[0]
    if page.samplesperpixel != 1 or page.photometric == 0:
        return None
    count = int(np.prod(tiff.series[0].shape)) // max(page.size, 1)
    count = max(count, int((tiff.imagej_metadata or {}).get("images", 0)))
    if count <= pages or not page.is_contiguous:
        return None
    dtype = np.dtype(tiff.byteorder + np.dtype(page.dtype).char)
    return _Stack(int(page.dataoffsets[0]), count, (page.imagelength, page.imagewidth), dtype)


def _page_offsets(path: Path) -> tuple[Ints, bool]:
    """Where each page's header begins, and whether the chain of headers leads out of the file."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(0)
        head = file.read(16)
        order = {b"II": "little", b"MM": "big"}.get(head[:2])
        if order is None or len(head) < 16 or size < 16:
            raise damaged(path, "it has no TIFF header")
        big = int.from_bytes(head[2:4], order) == 43  # type: ignore[arg-type]
        counter, entry, pointer = (8, 20, 8) if big else (2, 12, 4)

        def number(at: int, width: int) -> int:
            file.seek(at)
            return int.from_bytes(file.read(width), order)  # type: ignore[arg-type]

        offsets: list[int] = []
        seen: set[int] = set()
        at = number(8 if big else 4, pointer)
        while at:
            following = at + counter + number(at, counter) * entry if at + counter <= size else size
            if following + pointer > size or at in seen:
                return _found(offsets, path), True
            offsets.append(at)
            seen.add(at)
            at = number(following, pointer)
    return _found(offsets, path), False


def _found(offsets: list[int], path: Path) -> Ints:
    if not offsets:
        raise damaged(path, "it has no complete page")
    return np.array(offsets, np.int64)


def open_frames(folder: Path, camera: str) -> FrameSource | None:
    """The frames of one camera in a run's folder, not yet decoded; None when it has none.

    `<camera>/*.tif|png|bmp|jpg`, else `<camera>.tif` (multi-page), else `<camera>.avi|mp4`.
    Raises InputError when there is more than one of them, or a file cannot be opened.
    """
    found = camera_entries(folder, camera)
    if len(found) > 1:
        raise InputError(
            f"camera {camera} has frames in {' and in '.join(p.name for p in found)}",
            where=str(folder),
            todo="keep one of them",
        )
    if not found:
        return None
    path = found[0]
    if path.is_dir():
        files = list_images(path)
        names: dict[str, str] = {}
        for file in files:
            other = names.setdefault(file.stem, file.name)
            if other != file.name:
                raise InputError(
                    f"{other} and {file.name} are the same frame twice",
                    where=str(path),
                    todo="the name without its extension is the frame: remove or rename one",
                )
        if len(files) == 1 and files[0].suffix.lower() in PAGE_EXTENSIONS:
            _refuse_pages(files[0], path)
        return ImageFiles(path, tuple(file.name for file in files))
    if path.suffix.lower() in PAGE_EXTENSIONS:
        return PageFrames(path)
    return VideoFrames(path)


def camera_entries(folder: Path, camera: str) -> list[Path]:
    """What in a run's folder may hold this camera's frames."""
    known = PAGE_EXTENSIONS + VIDEO_EXTENSIONS
    files = (p for p in folder.iterdir() if p.suffix.lower() in known and p.stem == camera)
    found = sorted(p for p in files if p.is_file())
    inner = folder / camera
    return [inner, *found] if inner.is_dir() and list_images(inner) else found


def _refuse_pages(file: Path, folder: Path) -> None:
    try:
        pages = len(PageFrames(file))
    except InputError:
        return
    if pages > 1:
        raise InputError(
            f"holds {pages} frames",
            where=str(file),
            todo=f"a multi-page file stands beside the folder: move it to {folder.name}.tif, "
            f"and remove the folder {folder.name}",
        )
