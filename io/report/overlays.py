"""What was found in an image, drawn over it: dots of a calibration, outlines of bubbles."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array, Bools
from telerig.errors import InputError
from telerig.rig.outline import HARMONICS, points_on
from telerig.short_text import counted

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]
Rejected = tuple[float, float, float, str]

GREEN, RED, PAPER, INK = (40, 200, 70), (235, 45, 45), (255, 255, 255), (30, 30, 30)
_LUMINANCE = (0.299, 0.587, 0.114)
_ELLIPSE = ["u_px", "v_px", "a_px", "b_px", "angle_rad"]
_LARGEST_ID = 9999
_FRACTION_BITS = 4
_SCALE, _LINE_PX, _JPEG_QUALITY = 0.36, 14, 80
_ENOUGH_PIXELS = 50_000
"""For the brightness of the picture."""

_LEAST_CONTRAST = 0.6
_LABEL_PX = 9
"""An outline wider than twice this has its label inside."""

_FINEST_PX = 2.0
"""What is drawn round something is at least so large, to be seen."""

_TURN = np.linspace(0, 2 * np.pi, 48, endpoint=False)


def draw_overlay(
    image: NDArray[Any],
    accepted: pd.DataFrame,
    rejected: pd.DataFrame,
    *,
    max_width_px: int = 480,
) -> Picture:
    """Return an RGB picture (h, w, 3) of the image with its dots, and a legend underneath.

    image : grey (H, W), 8 or 16 bit or float.
    accepted : u_px, v_px, a_px, b_px, angle_rad, dot, row, column; green with their index, as far
        as there is room.
    rejected : u_px, v_px, a_px, b_px, angle_rad, reason; red with the number of the reason, which
        the legend spells out.

    Raises InputError for what is no grey image.
    """
    labels = [str(dot) for dot in accepted["dot"]]
    if len(accepted) and accepted["dot"].max() > _LARGEST_ID:
        labels = [f"{r},{c}" for r, c in zip(accepted["row"], accepted["column"])]
    least_px = _FINEST_PX / min(1.0, max_width_px / image.shape[1])
    dots, strange = (_ellipses(table, least_px) for table in (accepted, rejected))
    return _overlay(
        image, dots, labels, [GREEN] * len(dots), strange, list(rejected["reason"]),
        f"{counted(len(dots), 'dot')} accepted", max_width_px,
    )  # fmt: skip


def encoded(picture: Picture, ending: str = ".jpg") -> bytes:
    """Return the content of an image file of an RGB picture (h, w, 3)."""
    import cv2

    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return cv2.imencode(ending, picture[..., ::-1], quality)[1].tobytes()


def write_picture(picture: Picture, file: Path) -> None:
    """Write an RGB picture (h, w, 3) as JPEG, and make its folder."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(encoded(picture))


def draw_bubble_overlay(
    image: NDArray[Any],
    outlines: Sequence[Array],
    labels: Sequence[str],
    colours: Sequence[Colour] | Colour = GREEN,
    *,
    rejected: Sequence[Rejected] = (),
    found: str | None = None,
    max_width_px: int = 900,
) -> Picture:
    """Return an RGB picture (h, w, 3) of the image, not wider than max_width_px, with its bubbles.

    image : grey (H, W), 8 or 16 bit or float.
    outlines : each (N, 2) px, closed; points that are not finite are passed over.
    labels : one each, "" for none, where there is room.
    colours : RGB, one each or one for all.
    rejected : (u, v, radius, reason) is circled in red with the number of its reason, which the
        legend spells out.
    found : what the outlines are; None for bubbles.

    Raises InputError for what is no grey image.
    """
    alike = len(colours) == 3 and all(np.ndim(part) == 0 for part in colours)
    shades: list[Any] = [colours] * len(outlines) if alike else list(colours)
    finest_px = _FINEST_PX / min(1.0, max_width_px / image.shape[1])
    circles = []
    for u, v, radius, _ in rejected:
        size = max(radius, finest_px) if np.isfinite(radius) else 4 * finest_px
        circles.append(np.stack([u + size * np.cos(_TURN), v + size * np.sin(_TURN)], -1))
    reasons = [reason for *_, reason in rejected]
    found = counted(len(outlines), "bubble") if found is None else found
    return _overlay(image, outlines, labels, shades, circles, reasons, found,
                    max_width_px, _LEAST_CONTRAST)  # fmt: skip


def _overlay(
    image: NDArray[Any],
    outlines: Sequence[Array],
    labels: Sequence[str],
    colours: Sequence[Colour],
    rejected: Sequence[Array],
    reasons: Sequence[str],
    found: str,
    max_width_px: int,
    least_contrast: float = 0.0,
) -> Picture:
    """Return the image with outlines (N, 2) and labels, those rejected in red, and a legend."""
    if image.ndim != 2 or min(image.shape) < 1:
        raise InputError(
            f"an overlay is drawn on a grey image, this one has shape {image.shape}",
            todo="pass one channel, (height, width)",
        )
    factor = min(1.0, max_width_px / image.shape[1])
    picture = _grey_picture(image, factor, least_contrast)
    counts = Counter(reasons).most_common()
    numbers = {reason: str(i + 1) for i, (reason, _) in enumerate(counts)}
    every = [*((outline, numbers[reason], RED) for outline, reason in zip(rejected, reasons)),
             *zip(outlines, labels, colours, strict=True)]  # fmt: skip
    for outline, _, colour in every:
        draw_line(picture, _scaled(outline, factor), colour, closed=True)
    taken = np.zeros(picture.shape[:2], bool)
    for outline, label, colour in every[len(rejected) :] + every[: len(rejected)]:
        _write_beside(picture, _scaled(outline, factor), label, colour, taken)
    lines = [f"{found}, {len(rejected)} rejected"]
    lines += [f"{numbers[reason]}: {reason} ({count})" for reason, count in counts]
    return np.concatenate([picture, _legend(lines, picture.shape[1])])


def _grey_picture(image: NDArray[Any], factor: float, least_contrast: float = 0.0) -> Picture:
    """Return 8-bit RGB; the darkest and brightest thousandth become black and white.

    What is brighter than 1 - least_contrast of the brightest never becomes black.
    """
    stride = 1 + int(np.sqrt(factor**2 * image.size / _ENOUGH_PIXELS))
    grey = shrunk(image, factor)
    low, high = np.percentile(grey[::stride, ::stride], [0.1, 99.9]).tolist()
    low = min(low, (1 - least_contrast) * high) if least_contrast > 0 else low
    return in_grey(grey, low, high)


def shrunk(image: NDArray[Any], factor: float) -> NDArray[np.float32]:
    """Return the image scaled by a factor of at most 1; values that are not finite become 0."""
    import cv2

    grey = np.nan_to_num(image.astype(np.float32))
    if factor >= 1:
        return grey
    size = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32)


def grey_levels(images: Sequence[NDArray[Any]]) -> tuple[float, float]:
    """Return black and white levels for all images, from some of them; of 8 bit they stay."""
    if not len(images) or images[0].dtype == np.uint8:
        return 0.0, 255.0
    ends = np.array([np.percentile(image, [0.1, 99.9]) for image in images])
    return float(ends[:, 0].min()), float(ends[:, 1].max())


def in_grey(grey: NDArray[np.float32], low: float, high: float) -> Picture:
    """Return 8-bit RGB (h, w, 3), black at ``low`` and white at ``high``."""
    stretched = np.clip((grey - low) * (255 / max(high - low, 1e-9)), 0, 255)
    return np.repeat(stretched.astype(np.uint8)[..., None], 3, axis=2)


def draw_line(picture: Picture, points: Array, colour: Colour, *, closed: bool) -> None:
    """Draw a line through (N, 2) pixels; pixel (0, 0) is the centre of the first one."""
    import cv2

    if len(points) > 1:
        corners = np.rint(points * 2**_FRACTION_BITS).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [corners], closed, colour, 1, cv2.LINE_AA, _FRACTION_BITS)


def write_label(
    picture: Picture, label: str, centre: Array, colour: Colour, taken: Bools | None = None
) -> bool:
    """Write text round a point, with a rim; return whether there was room among ``taken``."""
    import cv2

    (width, height), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, _SCALE, 1)
    x = int(np.clip(round(centre[0] - width / 2), 0, max(picture.shape[1] - width, 0)))
    y = int(np.clip(round(centre[1] + height / 2), height, max(picture.shape[0] - 1, height)))
    place = (slice(max(y - height - 1, 0), y + 2), slice(max(x - 1, 0), x + width + 2))
    if taken is not None:
        if taken[place].any():
            return False
        taken[place] = True
    rim = INK if np.dot(colour, _LUMINANCE) > 128 else PAPER
    for shade, thickness in ((rim, 2), (colour, 1)):
        cv2.putText(
            picture, label, (x, y), cv2.FONT_HERSHEY_SIMPLEX, _SCALE, shade, thickness, cv2.LINE_AA
        )
    return True


def _write_beside(
    picture: Picture, points: Array, label: str, colour: Colour, taken: Bools
) -> None:
    """Write a label inside a large outline, else at one of its sides with room."""
    if not label or not len(points):
        return
    low, high = points.min(axis=0), points.max(axis=0)
    middle, reach = (low + high) / 2, (high - low) / 2
    steps = [(1, 0), (-1, 0), (0, -1), (0, 1)]
    if reach.min() > _LABEL_PX:
        steps = [(0, 0), *steps]
    places = [middle + (reach + _LABEL_PX) * step for step in steps]
    any(write_label(picture, label, place, colour, taken) for place in places)


def _legend(lines: list[str], width_px: int) -> Picture:
    """Return wrapped lines of text as a picture. OpenCV's letters are ASCII only."""
    import cv2

    letters = max(8, int((width_px - 8) / (18.5 * _SCALE)))
    plain = [line.replace("µ", "u").encode("ascii", "replace").decode("ascii") for line in lines]
    wrapped = [part for line in plain for part in textwrap.wrap(line, letters)]
    strip = np.full((_LINE_PX * len(wrapped) + 6, width_px, 3), PAPER, np.uint8)
    for i, line in enumerate(wrapped):
        at = (4, _LINE_PX * (i + 1))
        cv2.putText(strip, line, at, cv2.FONT_HERSHEY_SIMPLEX, _SCALE, INK, 1, cv2.LINE_AA)
    return strip


def _ellipses(table: pd.DataFrame, least_px: float) -> list[Array]:
    """Return the ellipse (N, 2) px of each row; no points where it is not finite."""
    ellipse = table[_ELLIPSE].to_numpy(float, copy=True)
    ellipse[:, 2:4] = np.maximum(ellipse[:, 2:4], least_px)
    return list(points_on(ellipse, np.zeros((len(ellipse), 2 * len(HARMONICS))), _TURN))


def _scaled(outline: Array, factor: float) -> Array:
    """Return the finite points of an outline (N, 2) in pixels of the scaled picture."""
    points = np.asarray(outline, float).reshape(-1, 2)
    return np.asarray((points[np.isfinite(points).all(axis=1)] + 0.5) * factor - 0.5)
