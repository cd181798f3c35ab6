"""Pictures one after the other into MP4 and GIF files that are whole or not there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.io.files.atomic import atomic_path

Picture = NDArray[np.uint8]
Progress = Callable[[str, int, int], None]

GIF_COLOURS = 128
_CODECS = ("libx264", "h264", "mpeg4")
_QUALITY = "20"


def write_film(
    pictures: Iterable[Picture],
    count: int,
    files: Iterable[Path],
    *,
    rate_hz: float = 25.0,
    gif_width_px: int = 640,
    palette: Sequence[tuple[int, int, int]] | None = None,
    what: str = "film",
    stage: Progress | None = None,
) -> None:
    """Write the pictures, each once, into every file: .mp4 or .gif.

    pictures : RGB (height, width, 3), all of one even size.
    rate_hz : a GIF's is rounded to whole hundredths of a second a picture.
    palette : a GIF's, up to 256 colours; by default of its first picture.
    stage : called with (what, done, count).

    Raises InputError for another kind of file, a place that cannot be written, and for an MP4
    without PyAV.
    """
    targets = [Path(file) for file in files]
    for file in targets:
        if file.suffix.lower() not in (".mp4", ".gif"):
            raise InputError(
                f"films are .mp4 or .gif, not {file.suffix!r}", where=str(file),
                todo="choose one of these endings",
            )  # fmt: skip
    if any(file.suffix.lower() == ".mp4" for file in targets):
        need_av()
    with ExitStack() as stack:
        writers: list[Any] = []
        for file in targets:
            temporary = stack.enter_context(atomic_path(file))
            writers.append(
                _Mp4(temporary, rate_hz) if file.suffix.lower() == ".mp4"
                else _Gif(temporary, rate_hz, gif_width_px, palette)
            )  # fmt: skip
        try:
            for done, picture in enumerate(pictures, 1):
                for writer in writers:
                    writer.add(picture)
                if stage:
                    stage(what, done, count)
            for writer in writers:
                writer.finish()
        finally:
            for writer in writers:
                writer.close()


def need_av() -> Any:
    """Return PyAV. Raises InputError, with what to install, where it is missing."""
    try:
        import av
    except ImportError as error:
        raise InputError(
            "an MP4 film needs PyAV, which is not installed", where="av",
            todo="pip install 'telerig[video]', or make a GIF (--format gif)",
        ) from error  # fmt: skip
    return av


class _Mp4:
    def __init__(self, path: Path, rate_hz: float) -> None:
        self._path, self._rate_hz = path, rate_hz
        self._container: Any = None
        self._stream: Any = None

    def add(self, picture: Picture) -> None:
        av = need_av()
        if self._container is None:
            self._container = av.open(str(self._path), "w", format="mp4",
                                      options={"movflags": "faststart"})  # fmt: skip
            codec = next(name for name in _CODECS if name in av.codecs_available)
            self._stream = self._container.add_stream(codec, rate=round(self._rate_hz))
            self._stream.width, self._stream.height = picture.shape[1], picture.shape[0]
            self._stream.pix_fmt = "yuv420p"
            if codec != "mpeg4":
                self._stream.options = {"crf": _QUALITY}
            else:
                self._stream.bit_rate = 4_000_000
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        for packet in self._stream.encode(frame):
            self._container.mux(packet)

    def finish(self) -> None:
        if self._container is not None:
            for packet in self._stream.encode():
                self._container.mux(packet)

    def close(self) -> None:
        if self._container is not None:
            self._container.close()


class _Gif:
    def __init__(
        self,
        path: Path,
        rate_hz: float,
        width_px: int,
        palette: Sequence[tuple[int, int, int]] | None,
    ) -> None:
        from PIL import Image

        self._path, self._width_px = path, width_px
        self._duration_ms = 10 * max(2, round(100 / rate_hz))
        self._pages: list[Any] = []
        self._palette: Any = None
        if palette is not None:
            self._palette = Image.new("P", (1, 1))
            parts = [part for colour in palette for part in colour]
            self._palette.putpalette(parts + parts[:3] * (256 - len(palette)))

    def add(self, picture: Picture) -> None:
        from PIL import Image

        page = Image.fromarray(picture)
        if page.width > self._width_px:
            height = round(page.height * self._width_px / page.width)
            page = page.resize((self._width_px, height), Image.Resampling.LANCZOS)
        if self._palette is None:
            self._palette = page.quantize(GIF_COLOURS, method=Image.Quantize.MEDIANCUT)
        self._pages.append(page.quantize(palette=self._palette, dither=Image.Dither.NONE))

    def finish(self) -> None:
        first, *rest = self._pages
        first.save(self._path, save_all=True, append_images=rest, loop=0,
                   duration=self._duration_ms, optimize=False)  # fmt: skip

    def close(self) -> None:
        self._pages = []
