"""Pictures one after the other into an MP4 file that is whole or not there."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import need_package
from telerig.io.files.atomic import atomic_path
from telerig.progress import Progress

Picture = NDArray[np.uint8]

_CODECS = ("libx264", "h264", "mpeg4")
_QUALITY = "20"


def write_film(
    pictures: Iterable[Picture],
    count: int,
    file: Path,
    *,
    rate_hz: float = 25.0,
    what: str = "film",
    stage: Progress | None = None,
) -> None:
    """Write the pictures, each once, into an MP4 file.

    pictures : RGB (height, width, 3), all of one even size; at least one.
    stage : called with (what, done, count).

    Raises InputError for a place that cannot be written, and without PyAV.
    """
    av = need_av()
    with (
        atomic_path(file) as temporary,
        av.open(str(temporary), "w", format="mp4", options={"movflags": "faststart"}) as film,
    ):
        stream: Any = None
        for done, picture in enumerate(pictures, 1):
            if stream is None:
                stream = _stream(film, picture, rate_hz)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            film.mux(stream.encode(frame))
            if stage:
                stage(what, done, count)
        film.mux(stream.encode())


def _stream(film: Any, picture: Picture, rate_hz: float) -> Any:
    codec = next(name for name in _CODECS if name in need_av().codecs_available)
    stream = film.add_stream(codec, rate=round(rate_hz))
    stream.width, stream.height = picture.shape[1], picture.shape[0]
    stream.pix_fmt = "yuv420p"
    if codec == "mpeg4":
        stream.bit_rate = 4_000_000
    else:
        stream.options = {"crf": _QUALITY}
    return stream


def need_av() -> Any:
    """Return PyAV. Raises InputError, with what to install, where it is missing."""
    return need_package("av", "video", "a film")
