"""A recording of rerun: where it goes, images and series in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Ints
from telerig.errors import InputError

_QUALITY = 80
"""Of JPEG: 512 x 512 px of a backlit tank take some 20 kB."""
_MOST_PX = 1024
"""Larger images are shown smaller; outlines and pixels keep their coordinates."""


def need_rerun() -> Any:
    """Return rerun. Raises InputError, with what to install, where it is missing."""
    try:
        import rerun
    except ImportError as error:
        raise InputError(
            "the viewer needs rerun, which is not installed", where="rerun",
            todo="pip install 'telerig[view]'",
        ) from error  # fmt: skip
    return rerun


def path(*parts: str) -> str:
    """Return the path of an entity; names of cameras and views may hold any character."""
    return str(need_rerun().new_entity_path(list(parts)))


def grey_levels(images: list[NDArray[Any]]) -> tuple[float, float]:
    """Return black and white levels for all images, from some of them; of 8 bit they stay."""
    if not images or images[0].dtype == np.uint8:
        return 0.0, 255.0
    ends = np.array([np.percentile(image, [0.1, 99.9]) for image in images])
    return float(ends[:, 0].min()), float(ends[:, 1].max())


def log_image(stream: Any, path: str, image: NDArray[Any], levels: tuple[float, float]) -> None:
    """Log a grey image (rows, columns) as JPEG of 8 bit; a large one is made smaller.

    The entity ``path`` is scaled, so that entities beside it are in pixels of the whole image.
    """
    rr = need_rerun()
    low, high = levels
    grey = np.clip((image.astype(np.float32) - low) * (255 / max(high - low, 1e-9)), 0, 255)
    factor = min(1.0, _MOST_PX / max(image.shape))
    small = grey.astype(np.uint8)
    if factor < 1:
        small = cv2.resize(small, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    stream.log(path, rr.EncodedImage(contents=encoded.tobytes(), media_type="image/jpeg"))
    if factor < 1:
        across = image.shape[1] / small.shape[1]
        stream.log(path, rr.Transform3D(scale=[across, across, 1.0]))


def log_series(
    stream: Any, plot: str, frames: Ints, t_s: Array, series: Mapping[str, Array],
    colours: Mapping[str, str],
) -> None:  # fmt: skip
    """Log series of one plot by their names: numbers (F,) over frames and times (F,); NaN are left
    out.

    colours : of each series, like "#1f5fa8".
    """
    rr = need_rerun()
    for name, values in series.items():
        good = np.isfinite(values)
        if not good.any():
            continue
        place = path("plots", plot, name)
        stream.log(place, rr.SeriesLines(colors=rgb(colours[name]), names=name), static=True)
        stream.send_columns(
            place,
            indexes=[
                rr.TimeColumn("frame", sequence=frames[good]),
                rr.TimeColumn("time", duration=t_s[good]),
            ],
            columns=rr.Scalars.columns(scalars=values[good]),
        )


def rgb(colour: str) -> list[int]:
    """Return red, green and blue of a colour like "#1f5fa8"."""
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
