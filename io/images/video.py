"""Random access to the frames of an AVI or MP4 file through PyAV (the extra `video`)."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Ints
from telerig.errors import InputError
from telerig.io.images.read import Image, image_from_pixels

VIDEO_EXTENSIONS = (".avi", ".mp4", ".mov", ".mkv")

_COPY = "copy or record it again; a video that plays elsewhere may be converted to a TIFF sequence"
_WIDE_GREY = {"gray9", "gray10", "gray12", "gray14", "gray16"}


class VideoFrames:
    """Frames by index: read in sequence at the decoder's speed, elsewhere from a key frame on.

    Grey formats come out as stored (uint8, or uint16 for 9 to 16 bits); of YUV formats the luma
    plane as stored, without a change of range; RGB must be grey. Raises InputError when PyAV is
    missing or the file is no video that can be decoded.
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
        """The frame, (height, width). Raises InputError, naming file and frame."""
        with self._lock:
            try:
                return image_from_pixels(self._pixels(position), self.path)
            except InputError as error:
                raise InputError(error.what, where=self.where(position), todo=error.todo) from error

    def _pixels(self, position: int) -> NDArray[Any]:
        if self._decoder is None or self._decoder.process != os.getpid():
            self._decoder = _Decoder(self.path)
        try:
            frame = self._decoder.frame(int(self._times[position]))
        except _av().error.FFmpegError as error:
            self._decoder = None
            raise _damaged(self.path, f"a frame cannot be decoded: {error.strerror}") from error
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
        """The frame with this time stamp; None when the decoder never gives it."""
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
        """How far ahead decoding on is no slower than a jump to the key frame before."""
        step = 8 * max(1, round(1 / float(self._stream.average_rate * self._stream.time_base)))
        return time if self._last == -(1 << 62) else self._last + step


def _frame_times(container: Any, path: Path) -> tuple[Ints, bool]:
    """(N,) presentation times in order, from the packets alone; whether the file breaks off."""
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
    try:
        import av
        import av.error
    except ImportError as error:
        raise InputError(
            "reading a video needs PyAV, which is not installed",
            where="av",
            todo='pip install "telerig[video]" (or: pip install av)',
        ) from error
    return av


def _opened(path: Path) -> Any:
    av = _av()
    try:
        container = av.open(str(path))
    except (av.error.FFmpegError, OSError) as error:
        raise _damaged(path, f"it cannot be opened as a video ({error})") from error
    if not container.streams.video:
        container.close()
        raise InputError("holds no video stream", where=str(path), todo=_COPY)
    return container


def _damaged(path: Path, detail: str) -> InputError:
    return InputError(f"is truncated or damaged: {detail}", where=str(path), todo=_COPY)
