"""A recording of rerun: where it goes, images and series in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Ints
from telerig.io.report.overlays import in_grey, shrunk
from telerig.io.report.plot.axes import COLOURS, rgb
from telerig.io.tables.smoothing import AXES
from telerig.io.view.names import FRAME, TIME, need_rerun, of_plot, of_spectrum
from telerig.spectra import Spectrum

_QUALITY = 80
"""Of JPEG: 512 x 512 px of a backlit tank take some 20 kB."""
_MOST_HZ = 200.0
_MOST_PX = 1024
"""Larger images are shown smaller; outlines and pixels keep their coordinates."""


def log_image(stream: Any, path: str, image: NDArray[Any], levels: tuple[float, float]) -> None:
    """Log a grey image (rows, columns) as JPEG of 8 bit; a large one is made smaller.

    The entity ``path`` is scaled, so that entities beside it are in pixels of the whole image.
    """
    rr = need_rerun()
    factor = min(1.0, _MOST_PX / max(image.shape))
    small = in_grey(shrunk(image, factor), *levels)[..., 0]
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    stream.log(path, rr.EncodedImage(contents=encoded.tobytes(), media_type="image/jpeg"))
    if factor < 1:
        across = image.shape[1] / small.shape[1]
        stream.log(path, rr.Transform3D(scale=[across, across, 1.0]))


def log_series(
    stream: Any, plot: str, frames: Ints | None, t_s: Array, series: Mapping[str, Array],
    colours: Mapping[str, str],
) -> None:  # fmt: skip
    """Log series of one plot by their names: numbers (F,) over frames and times (F,); NaN are left
    out.

    frames : None where there are none. colours : of each series, like "#1f5fa8".
    """
    rr = need_rerun()
    for name, values in series.items():
        good = np.isfinite(values)
        if not good.any():
            continue
        place = of_plot(plot, name)
        stream.log(place, rr.SeriesLines(colors=rgb(colours[name]), names=name), static=True)
        of_time = [rr.TimeColumn(TIME, duration=t_s[good])]
        of_frames = [] if frames is None else [rr.TimeColumn(FRAME, sequence=frames[good])]
        stream.send_columns(
            place,
            indexes=[*of_frames, *of_time],
            columns=rr.Scalars.columns(scalars=values[good]),
        )


def log_spectrum(stream: Any, name: str, spectrum: Spectrum, static: bool = False) -> None:
    """Log the spectrum of a motion (F, 3) or (F, 1) in µm²/Hz, up to `_MOST_HZ`."""
    rr = need_rerun()
    seen = (spectrum.frequency_hz > 0) & (spectrum.frequency_hz <= _MOST_HZ)
    axes = AXES if spectrum.density.shape[1] > 1 else ("",)
    for axis, density, colour in zip(axes, spectrum.density.T, COLOURS):
        if np.any(density[seen] > 0):
            bars = rr.BarChart(
                np.sqrt(density[seen]), abscissa=spectrum.frequency_hz[seen], color=rgb(colour)
            )
            stream.log(of_spectrum(name, axis), bars, static=static)
