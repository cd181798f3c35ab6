"""Random access to one camera's frames of a run; only the frame asked for is in memory."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Ints
from telerig.errors import InputError, need_package
from telerig.io.images.high_speed import HIGH_SPEED_EXTENSIONS, open_high_speed
from telerig.io.images.read import (
    PALETTE,
    WHITE_IS_0,
    Image,
    by_stem,
    damaged,
    decoding,
    image_from_pixels,
    list_images,
    page_pixels,
    read_image,
    refuse_too_large,
    tiff_reader,
)
from telerig.short_text import counted

PAGE_EXTENSIONS = (".tif", ".tiff")


class FrameSource(Protocol):
    """Give access to one camera's frames by their position in the order of recording.

    cut_short : whether the file ends within its last frame.
    """

    @property
    def path(self) -> Path:
        """Return the file or folder that holds the frames."""

    @property
    def cut_short(self) -> bool:
        """Return whether the file ends before the frames that its header states."""

    def __len__(self) -> int: ...

    def read(self, position: int) -> Image:
        """Read the frame at ``position`` (from 0); pixels (height, width).

        Raises InputError, which names file and frame, if the frame cannot be read.
        """

    def where(self, position: int) -> str:
        """Return the file and the frame at ``position`` in words, for errors."""

    def numbers(self) -> Ints | None:
        """Return the number (frames,) of each frame in its file name; None without such numbers.

        The numbers increase.
        """


@dataclass(frozen=True)
class ImageFiles:
    """Give access to a folder that holds one image file per frame, in natural order of the names.

    Names are kept instead of paths, because paths need ten times the memory, in every process.
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
        """Return the last number (frames,) in each name; None if the rest of the names differs."""
        parts = [re.fullmatch(r"(.*?)(\d+)(\D*)", Path(n).stem) for n in self.names]
        if not all(parts) or len({(m[1], m[3]) for m in parts if m}) != 1:
            return None
        if any(len(m[2]) > 18 for m in parts if m):
            return None
        counted = np.array([int(m[2]) for m in parts if m], np.int64)
        return counted if np.all(np.diff(counted) > 0) else None


class PageFrames:
    """Give access to the pages of a multi-page TIFF. Raises InputError if no page is complete."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._size = path.stat().st_size
        self._offsets, self.cut_short = _page_offsets(path)
        with decoding(path), self._opened() as tiff:
            self._stack = _contiguous_stack(tiff, len(self._offsets), path)
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
        with decoding(self.path):
            return tiff_reader().TiffFile(self.path)

    def _page(self, position: int) -> NDArray[Any]:
        if position >= len(self._offsets):
            raise damaged(self.path, f"it ends after {len(self._offsets)} pages")
        try:
            with decoding(self.path), self._opened() as tiff:
                tiff.filehandle.seek(int(self._offsets[position]))
                page = tiff_reader().TiffPage(tiff, index=position)
                return page_pixels(page, self._size, self.path)
        except InputError as error:
            if "imagecodecs" in str(error.__cause__):
                todo = "save it without compression, or `pip install imagecodecs`"
                what = f"cannot be read: {error.__cause__}"
                raise InputError(what, where=str(self.path), todo=todo) from error
            raise

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
    """Hold where frames lie that follow each other after one page header, as ImageJ does it."""

    offset: int
    count: int
    shape: tuple[int, int]
    dtype: Any

    def span(self, position: int) -> tuple[int, int]:
        size = self.shape[0] * self.shape[1] * self.dtype.itemsize
        start = self.offset + position * size
        return start, start + size


def _contiguous_stack(tiff: Any, pages: int, path: Path) -> _Stack | None:
    """Return the stack if the file's description counts more frames than there are page headers."""
    page = tiff.pages[0]
    if page.samplesperpixel != 1 or page.photometric in (WHITE_IS_0, PALETTE):
        return None
    described = tiff.is_imagej or tiff.is_shaped or tiff.is_ome
    if page.subifds is not None or not described:  # a damaged file can count billions of subifds
        return None
    count = int(np.prod(tiff.series[0].shape)) // max(page.size, 1)
    count = max(count, int((tiff.imagej_metadata or {}).get("images", 0)))
    if count <= pages or not page.is_contiguous:
        return None
    if pages > 1 and tiff.pages[1].dataoffsets[0] != page.dataoffsets[0] + page.nbytes:
        return None
    dtype = np.dtype(tiff.byteorder + np.dtype(page.dtype).char)
    refuse_too_large(page.imagewidth, page.imagelength, dtype.itemsize, path)
    return _Stack(int(page.dataoffsets[0]), count, (page.imagelength, page.imagewidth), dtype)


def _page_offsets(path: Path) -> tuple[Ints, bool]:
    """Return where each page's header begins (bytes), and whether the file ends too early."""
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
    """Open the frames of one camera in a run's folder; no frame is decoded.

    The frames are the images `<camera>/*.tif|png|bmp|jpg`, or `<camera>.tif` (multi-page), or a
    video `<camera>.avi|mp4|mov|mkv`, or a high-speed camera's file `<camera>.cine` or
    `<camera>.mraw`. Returns None if the folder has none of these. Raises InputError if it has more
    than one of them, or if a file cannot be opened.
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
        by_stem(files, "frame")
        if len(files) == 1 and files[0].suffix.lower() in PAGE_EXTENSIONS:
            _refuse_pages(files[0], path)
        return ImageFiles(path, tuple(file.name for file in files))
    if path.suffix.lower() in PAGE_EXTENSIONS:
        return PageFrames(path)
    if path.suffix.lower() in HIGH_SPEED_EXTENSIONS:
        return open_high_speed(path)
    return VideoFrames(path)


def camera_entries(folder: Path, camera: str) -> list[Path]:
    """Return the folder and the files in a run's folder that may hold this camera's frames."""
    known = FILE_EXTENSIONS
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
            f"holds {counted(pages, 'frame')}",
            where=str(file),
            todo=f"a multi-page file stands beside the folder: move it to {folder.name}.tif, "
            f"and remove the folder {folder.name}",
        )


VIDEO_EXTENSIONS = (".avi", ".mp4", ".mov", ".mkv")
FILE_EXTENSIONS = PAGE_EXTENSIONS + VIDEO_EXTENSIONS + HIGH_SPEED_EXTENSIONS
"""Of files that hold all frames of a camera."""

_COPY = "copy or record it again; a video that plays elsewhere may be converted to a TIFF sequence"
_WIDE_GREY = {"gray9", "gray10", "gray12", "gray14", "gray16"}


class VideoFrames:
    """Give access to the frames of a video by their position.

    Successive frames are read fast; for any other frame, decoding starts at the key frame before
    it. Grey formats are returned as stored (uint8, or uint16 for 9 to 16 bits), YUV formats as
    their stored brightness; frames of RGB formats must be grey. Raises InputError if PyAV is not
    installed, or if the file is no video.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._decoder: _Decoder | None = None
        with _opened(path) as container:
            self._times, self.cut_short = _frame_times(container, path)

    def __len__(self) -> int:
        return len(self._times)

    def where(self, position: int) -> str:
        return f"{self.path} (frame {position}, from 0)"

    def numbers(self) -> Ints | None:
        return None

    def read(self, position: int) -> Image:
        with self._lock:
            try:
                return image_from_pixels(self._pixels(position), self.path)
            except InputError as error:
                raise InputError(error.what, where=self.where(position), todo=error.todo) from error

    def _pixels(self, position: int) -> NDArray[Any]:
        if self._decoder is None or self._decoder.process != os.getpid():
            self._decoder = _Decoder(self.path)
        try:
            with decoding(self.path, "a frame cannot be decoded: "):
                frame = self._decoder.frame(int(self._times[position]))
        except InputError:
            self._decoder = None
            raise
        if frame is None or frame.is_corrupt:
            self._decoder = None
            raise _damaged(self.path, "a frame is missing or damaged")
        return _grey_plane(frame, self.path)

    def __getstate__(self) -> dict[str, Any]:
        return {"path": self.path, "_times": self._times, "cut_short": self.cut_short}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=threading.Lock(), _decoder=None)


class _Decoder:
    """An open file and where it stands; belongs to the process that opened it."""

    def __init__(self, path: Path) -> None:
        self.process = os.getpid()
        self._container = _opened(path)
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self._frames: Iterator[Any] = self._container.decode(self._stream)
        self._last = -(1 << 62)

    def frame(self, time: int) -> Any:
        """Return the frame with this time stamp; None when the decoder never gives it."""
        if not self._last < time <= self._reach(time):
            self._container.seek(time, stream=self._stream, backward=True)
            self._frames = self._container.decode(self._stream)
        for frame in self._frames:
            self._last = frame.pts if frame.pts is not None else self._last
            if self._last >= time:
                return frame if self._last == time else None
        self._last = 1 << 62
        return None

    def _reach(self, time: int) -> int:
        """Return how far ahead decoding on is no slower than a jump to the key frame before."""
        step = 8 * max(1, round(1 / float(self._stream.average_rate * self._stream.time_base)))
        return time if self._last == -(1 << 62) else self._last + step


def _frame_times(container: Any, path: Path) -> tuple[Ints, bool]:
    """Return presentation times (N,) in order from the packets, and whether the file breaks off."""
    times: list[int] = []
    cut = False
    try:
        for packet in container.demux(container.streams.video[0]):
            if packet.size == 0:
                continue
            cut = packet.is_corrupt
            if packet.pts is None and packet.dts is None:
                raise _damaged(path, f"frame {len(times)} has no time stamp")
            times.append(packet.pts if packet.pts is not None else packet.dts)
    except _av().error.FFmpegError:
        cut = True
    if not times:
        raise _damaged(path, "it has no frame")
    return np.unique(np.array(times, np.int64)), cut


def _grey_plane(frame: Any, path: Path) -> NDArray[Any]:
    name = frame.format.name
    depth = name.removesuffix("le").removesuffix("be")
    if depth in _WIDE_GREY:
        return np.asarray(frame.to_ndarray())
    if name.startswith(("yuv", "nv", "gray")) and frame.format.components[0].bits == 8:
        plane = frame.planes[0]
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)
        step = 2 if name.startswith("yuyv") else 1
        return rows[: frame.height, : step * frame.width : step]
    if frame.format.components[0].bits == 8:
        return np.asarray(frame.to_ndarray(format="rgb24"))
    raise InputError(
        f"has pixels of format {name}", where=str(path), todo="convert it to 8- or 16-bit grey"
    )


def _av() -> Any:
    return need_package("av", "video", "reading a video")


def _opened(path: Path) -> Any:
    av = _av()
    with decoding(path, "it cannot be opened as a video: "):
        container = av.open(str(path), metadata_errors="replace")
        if not container.streams.video:
            container.close()
            raise InputError("holds no video stream", where=str(path), todo=_COPY)
        stream = container.streams.video[0]
        refuse_too_large(stream.width, stream.height, 1, path)
        if not stream.average_rate:
            raise _damaged(path, "it states no frame rate")
    return container


def _damaged(path: Path, detail: str) -> InputError:
    return InputError(f"is truncated or damaged: {detail}", where=str(path), todo=_COPY)
