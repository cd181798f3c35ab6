"""What was found in an image, drawn over it: dots of a calibration, outlines of bubbles."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array, Bools
from telerig.errors import InputError

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

GREEN, RED, PAPER, INK = (40, 200, 70), (235, 45, 45), (255, 255, 255), (30, 30, 30)
_ELLIPSE = ["u_px", "v_px", "a_px", "b_px", "angle_rad"]
_LARGEST_ID = 9999
_FRACTION_BITS = 4
_SCALE, _LINE_PX, _JPEG_QUALITY = 0.36, 14, 80
_ENOUGH_PIXELS = 50_000
"""For the brightness of the picture."""


def draw_overlay(
    image: NDArray[Any],
    accepted: pd.DataFrame,
    rejected: pd.DataFrame,
    *,
    max_width_px: int = 480,
) -> Picture:
    """The image, small, with its dots: an RGB picture (h, w, 3) with a legend underneath.

    image : grey (H, W), 8 or 16 bit or float. accepted : u_px, v_px, a_px, b_px, angle_rad, dot,
    row, column; its dots are green with their index (row,column where ids are opaque), as far as
    there is room for it. rejected : u_px, v_px, a_px, b_px, angle_rad, reason; red with the
    number of the reason, which the legend spells out with the count of its dots.

    Raises InputError for what is no grey image or a table without these columns.
    """
    _check_grey(image)
    _check_columns(accepted, ["dot", "row", "column"], "accepted")
    _check_columns(rejected, ["reason"], "rejected")
    factor = min(1.0, max_width_px / image.shape[1])
    picture = grey_picture(image, factor)
    counts = Counter(rejected["reason"]).most_common()
    numbers = {reason: i + 1 for i, (reason, _) in enumerate(counts)}
    taken = np.zeros(picture.shape[:2], bool)
    _ellipses(picture, rejected, factor, RED)
    _ellipses(picture, accepted, factor, GREEN)
    _write_indices(picture, accepted, _labels(accepted), factor, GREEN, taken)
    _write_indices(
        picture, rejected, [str(numbers[r]) for r in rejected["reason"]], factor, RED, taken
    )
    lines = [f"{len(accepted)} dots accepted, {len(rejected)} rejected"]
    lines += [f"{numbers[reason]}: {reason} ({count})" for reason, count in counts]
    return np.concatenate([picture, legend(lines, picture.shape[1])])


def _check_grey(image: NDArray[Any]) -> None:
    if image.ndim != 2 or min(image.shape) < 1:
        raise InputError(
            f"an overlay is drawn on a grey image, this one has shape {image.shape}",
            todo="pass one channel, (height, width)",
        )


def _check_columns(table: pd.DataFrame, extra: list[str], name: str) -> None:
    missing = [column for column in _ELLIPSE + extra if column not in table]
    if missing:
        raise InputError(
            f"the table of {name} dots lacks {', '.join(missing)}",
            todo=f"it needs {', '.join(_ELLIPSE + extra)}",
        )


def overlay_jpeg(
    image: NDArray[Any], accepted: pd.DataFrame, rejected: pd.DataFrame, *, max_width_px: int
) -> bytes:
    """`draw_overlay` as a JPEG file's content."""
    import cv2

    picture = draw_overlay(image, accepted, rejected, max_width_px=max_width_px)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, encoded = cv2.imencode(".jpg", picture[..., ::-1], quality)
    return encoded.tobytes()


def grey_picture(image: NDArray[Any], factor: float, least_contrast: float = 0.0) -> Picture:
    """8-bit RGB; the darkest and brightest thousandth of the pixels become black and white.

    What is brighter than 1 - least_contrast of the brightest never becomes black, so that an
    empty image does not look like snow.
    """
    import cv2

    height, width = image.shape
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    grey = np.nan_to_num(image.astype(np.float32))
    if factor < 1:
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    stride = 1 + int(np.sqrt(grey.size / _ENOUGH_PIXELS))
    low, high = np.percentile(grey[::stride, ::stride], [0.1, 99.9]).tolist()
    low = min(low, (1 - least_contrast) * high) if least_contrast > 0 else low
    stretched = np.clip((grey - low) * (255 / max(high - low, 1e-9)), 0, 255)
    return np.asarray(cv2.cvtColor(stretched.astype(np.uint8), cv2.COLOR_GRAY2RGB), np.uint8)


def _labels(accepted: pd.DataFrame) -> list[str]:
    if len(accepted) and accepted["dot"].max() > _LARGEST_ID:
        return [f"{r},{c}" for r, c in zip(accepted["row"], accepted["column"])]
    return [str(dot) for dot in accepted["dot"]]


def _ellipses(picture: Picture, table: pd.DataFrame, factor: float, colour: Colour) -> None:
    import cv2

    ellipses = table[_ELLIPSE].to_numpy(float)
    for u, v, a, b, angle in ellipses[np.isfinite(ellipses).all(axis=1)]:
        centre = (np.array([u, v]) + 0.5) * factor - 0.5
        axes = np.maximum(np.array([a, b]) * factor, 1.5)
        cv2.ellipse(
            picture, fixed(centre), fixed(axes), float(np.degrees(angle)), 0, 360, colour, 1,
            cv2.LINE_AA, _FRACTION_BITS,
        )  # fmt: skip


def _write_indices(
    picture: Picture,
    table: pd.DataFrame,
    labels: Iterable[str],
    factor: float,
    colour: Colour,
    taken: Bools,
) -> None:
    """Each label in the middle of its ellipse, else at an end of the long axis, if there is room.

    ``taken`` marks the pixels under labels that are already there.
    """
    for (u, v, a, _, angle), label in zip(table[_ELLIPSE].to_numpy(float), labels):
        if not np.isfinite([u, v, a, angle]).all():
            continue
        along = a * np.array([np.cos(angle), np.sin(angle)])
        places = [(np.array([u, v]) + step * along + 0.5) * factor for step in (0, 1, -1)]
        any(write_label(picture, label, place, colour, taken) for place in places)


def fixed(point: Array) -> tuple[int, int]:
    x, y = np.rint(point * 2**_FRACTION_BITS).astype(int)
    return int(x), int(y)


def write_label(
    picture: Picture,
    label: str,
    centre: Array,
    colour: Colour,
    taken: Bools,
) -> bool:
    """Write text round a point, with a dark rim, unless other text is there; whether it was."""
    import cv2

    (width, height), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, _SCALE, 1)
    x = int(np.clip(round(centre[0] - width / 2), 0, max(picture.shape[1] - width, 0)))
    y = int(np.clip(round(centre[1] + height / 2), height, max(picture.shape[0] - 1, height)))
    place = (slice(max(y - height - 1, 0), y + 2), slice(max(x - 1, 0), x + width + 2))
    if taken[place].any():
        return False
    taken[place] = True
    for shade, thickness in ((INK, 2), (colour, 1)):
        cv2.putText(
            picture, label, (x, y), cv2.FONT_HERSHEY_SIMPLEX, _SCALE, shade, thickness, cv2.LINE_AA
        )
    return True


def legend(lines: list[str], width_px: int) -> Picture:
    """The lines in dark ink on white, wrapped to the width."""
    import textwrap

    import cv2

    letters = max(8, int((width_px - 8) / (18.5 * _SCALE)))
    wrapped = [part for line in lines for part in textwrap.wrap(_ascii(line), letters)]
    strip = np.full((_LINE_PX * len(wrapped) + 6, width_px, 3), PAPER, np.uint8)
    for i, line in enumerate(wrapped):
        at = (4, _LINE_PX * (i + 1))
        cv2.putText(strip, line, at, cv2.FONT_HERSHEY_SIMPLEX, _SCALE, INK, 1, cv2.LINE_AA)
    return strip


def _ascii(text: str) -> str:
    """OpenCV's letters are ASCII only."""
    return text.replace("µ", "u").encode("ascii", "replace").decode("ascii")


Rejected = tuple[float, float, float, str]

_LEAST_CONTRAST = 0.6
_LABEL_PX = 9
"""An outline wider than twice this has its label inside."""

_FINEST_PX = 2.0
"""A circle round what was rejected is at least so large, to be seen."""


def draw_bubble_overlay(
    image: NDArray[Any],
    outlines: Sequence[Array],
    labels: Sequence[str],
    colours: Sequence[Colour] | Colour = GREEN,
    *,
    rejected: Sequence[Rejected] = (),
    max_width_px: int = 900,
) -> Picture:
    """The image, not wider than max_width_px, with its bubbles: an RGB picture (h, w, 3).

    image : grey (H, W), 8 or 16 bit or float. outlines : each (N, 2) px of the image, closed;
    points that are not finite are passed over. labels : one each, "" for none; a label stands in
    the outline's middle, or beside it where other text is, or nowhere. colours : RGB, one each or
    one for all. rejected : (u, v, radius, reason) is circled in red with the number of its reason,
    which the legend underneath spells out with its count.

    Raises InputError for what is no grey image, and for labels or colours that do not fit.
    """
    shades = _checked(image, outlines, labels, colours)
    factor = min(1.0, max_width_px / image.shape[1])
    picture = grey_picture(image, factor, _LEAST_CONTRAST)
    reasons = Counter(reason for *_, reason in rejected)
    numbers = {reason: i + 1 for i, (reason, _) in enumerate(reasons.most_common())}
    circles = [_circle(u, v, radius, factor) for u, v, radius, _ in rejected]
    for circle in circles:
        _draw(picture, circle, factor, RED)
    for outline, shade in zip(outlines, shades):
        _draw(picture, outline, factor, shade)
    taken = np.zeros(picture.shape[:2], bool)
    for outline, label, shade in zip(outlines, labels, shades):
        _write_beside(picture, outline, label, factor, shade, taken)
    for circle, (*_, reason) in zip(circles, rejected):
        _write_beside(picture, circle, str(numbers[reason]), factor, RED, taken)
    lines = [f"{len(outlines)} bubbles, {len(rejected)} rejected"]
    lines += [f"{n}: {reason} ({reasons[reason]})" for reason, n in numbers.items()]
    return np.concatenate([picture, legend(lines, picture.shape[1])])


def draw_binary(
    shape: tuple[int, int], outlines: Sequence[Array], max_width_px: int = 900
) -> NDArray[np.uint8]:
    """(h, w), 255 where at least half of the pixel lies inside an outline, else 0.

    shape : (H, W) of the image, whose pixels the outlines (N, 2) are in.
    """
    from telerig.io.images.outline_raster import cell_coverage

    factor = min(1.0, max_width_px / shape[1])
    picture = np.zeros([max(1, round(n * factor)) for n in shape[:2]], np.uint8)
    for outline in outlines:
        corners = (_finite(outline) + 0.5) * factor
        if len(corners) < 3:
            continue
        low = np.floor(corners.min(axis=0)).astype(int)
        columns, rows = np.ceil(corners.max(axis=0)).astype(int) - low + 1
        inside = cell_coverage(corners - low, (int(rows), int(columns))) >= 0.5
        row, column = np.nonzero(inside)
        row, column = row + low[1], column + low[0]
        seen = (row >= 0) & (row < picture.shape[0]) & (column >= 0) & (column < picture.shape[1])
        picture[row[seen], column[seen]] = 255
    return picture


def _checked(
    image: NDArray[Any],
    outlines: Sequence[Array],
    labels: Sequence[str],
    colours: Sequence[Colour] | Colour,
) -> list[Colour]:
    """One colour per outline."""
    _check_grey(image)
    alike = len(colours) == 3 and all(np.ndim(part) == 0 for part in colours)
    shades: list[Any] = [colours] * len(outlines) if alike else list(colours)
    if not len(outlines) == len(labels) == len(shades):
        raise InputError(
            f"{len(outlines)} outlines, {len(labels)} labels and {len(shades)} colours",
            todo="pass one label and one colour for each outline",
        )
    return [tuple(int(part) for part in shade) for shade in shades]  # type: ignore[misc]


def _finite(outline: Array) -> Array:
    points = np.asarray(outline, float).reshape(-1, 2)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def _circle(u: float, v: float, radius: float, factor: float) -> Array:
    size = max(radius, _FINEST_PX / factor) if np.isfinite(radius) else 4 * _FINEST_PX / factor
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    return np.stack([u + size * np.cos(turn), v + size * np.sin(turn)], -1)


def _draw(picture: Picture, outline: Array, factor: float, colour: Colour) -> None:
    import cv2

    points = (_finite(outline) + 0.5) * factor - 0.5
    if len(points) > 1:
        corners = np.array([fixed(p) for p in points], np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [corners], True, colour, 1, cv2.LINE_AA, _FRACTION_BITS)


def _write_beside(
    picture: Picture,
    outline: Array,
    label: str,
    factor: float,
    colour: Colour,
    taken: Bools,
) -> None:
    points = (_finite(outline) + 0.5) * factor
    if not label or not len(points):
        return
    low, high = points.min(axis=0), points.max(axis=0)
    middle, reach = (low + high) / 2, (high - low) / 2
    steps = [(1, 0), (-1, 0), (0, -1), (0, 1)]
    if reach.min() > _LABEL_PX:
        steps = [(0, 0), *steps]
    places = [middle + (reach + _LABEL_PX) * step for step in steps]
    any(write_label(picture, label, place, colour, taken) for place in places)
