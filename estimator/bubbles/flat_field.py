"""The image that bubbles are looked for in: checks, and division by the lit screen."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Bools, Float32
from telerig.errors import InputError
from telerig.estimator.images.noise import check_grey_image

_UNIFORM_SHARE = 0.004
_CLIPPED_SHARE = 0.5
_WHITE_SHARE = 0.98
_SHRINK = 8
_SCREEN_PASSES = 3
_OUTSIDE, _LEAST_LEVEL = 0.3, 0.2
_EVERY_PX = 4
_LIT_SHARE, _BRIGHTEST = 0.6, 0.95
LEAST_BRIGHTNESS = 0.25
"""Brightness relative to the background below which an image counts as dark."""


def checked_image(image: NDArray[Any], min_diameter_px: float, min_contrast: float) -> NDArray[Any]:
    image = np.asarray(image)
    check_grey_image(image, 16, "bubbles")
    if not min_diameter_px >= 4.0:
        raise InputError(
            f"must be at least 4, not {min_diameter_px}", where="min_diameter_px", todo="try 8.0"
        )
    if not 0.05 <= min_contrast < 1.0:
        raise InputError(
            f"must lie in 0.05 .. 1, not {min_contrast}", where="min_contrast", todo="try 0.3"
        )
    return image


def checked_background(background: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return the background as an array. Raises InputError if it cannot divide such an image."""
    screen = np.asarray(background)
    if screen.shape != shape:
        raise InputError(
            f"shape {screen.shape} differs from the image's {shape}",
            where="background",
            todo="estimate the background from images of this camera",
        )
    if not float(screen.min()) > 0.0:
        raise InputError(
            "has pixels that are not positive",
            where="background",
            todo="give the level of the lit screen at every pixel",
        )
    return screen


def nothing_to_see(image: NDArray[Any]) -> str:
    low, high = float(image.min()), float(image.max())
    if high <= 0.0:
        return "the image is black"
    if high - low > _UNIFORM_SHARE * high:
        return ""
    if image.dtype.kind in "ui" and high >= _WHITE_SHARE * _full_scale(image):
        return "the image is saturated"
    return "the image is uniform"


def _full_scale(image: NDArray[Any]) -> float:
    """White of the image's type; 16 bits may hold 10, 12 or 14."""
    if image.dtype.itemsize == 1:
        return 255.0
    high = float(image.max())
    return next((float(2**bits - 1) for bits in (10, 12, 14) if high <= 2**bits - 1), 65535.0)


def normalised(image: NDArray[Any], background: NDArray[Any] | None) -> tuple[Float32, bool]:
    """Return the image divided by its background, and whether the screen is clipped (saturated)."""
    if background is None:
        screen = screen_level(image.astype(np.float32, copy=False))
        lowest = float(screen.min())
    else:
        screen = background.astype(np.float32, copy=False)
        lowest = float(screen.min())
    floor = 1e-6 * float(image.max()) + 1e-12
    if lowest < floor:
        screen = np.maximum(screen, floor)
    ratio = np.asarray(cv2.divide(_divisible(image), screen, dtype=cv2.CV_32F), np.float32)
    sample = image[::8, ::8]
    clipped = bool(
        image.dtype.kind in "ui"
        and np.mean(sample == sample.max()) > _CLIPPED_SHARE
        and sample.max() >= _WHITE_SHARE * _full_scale(image)
    )
    return ratio, clipped


def brightness(image: NDArray[Any], background: NDArray[Any], field: Bools | None) -> float:
    """Return how bright the lit screen of an image is, relative to its background.

    It is the median over the pixels that are nearly as bright as the brightest ones, so that
    bubbles may cover most of the screen. Pixels outside the field (rows, columns), and those where
    the background is dark, do not count.
    """
    some = (slice(None, None, _EVERY_PX),) * 2
    screen = np.asarray(background[some], np.float32)
    lit = screen >= _LIT_SHARE * np.quantile(screen, _BRIGHTEST)
    if field is not None and field[some].any():
        lit &= field[some]
    ratio = image[some][lit] / screen[lit]
    if not ratio.size:
        return 1.0
    return float(np.median(ratio[ratio >= _LIT_SHARE * np.quantile(ratio, _BRIGHTEST)]))


def _divisible(image: NDArray[Any]) -> NDArray[Any]:
    """Return the image in a type that OpenCV divides without a copy, or in single precision."""
    return image if image.dtype in (np.uint8, np.uint16) else image.astype(np.float32, copy=False)


def screen_of_field(image: NDArray[Any], field: Bools) -> Float32:
    """Return `screen_level` of an image that shows the screen in a field (rows, columns) only."""
    level = float(np.median(image[field]))
    seen = np.where(field, image, _OUTSIDE * level).astype(np.float32)
    return np.maximum(screen_level(seen), np.float32(_LEAST_LEVEL * level))


def screen_level(image: Float32) -> Float32:
    """Return the level of the lit screen (rows, columns), from an image with bubbles before it.

    In the image at an eighth of its size, dark things up to a quarter of the image are closed. Then
    a broad mean over all pixels that are not darker than this is taken. This works if every quarter
    of the image shows some of the screen.
    """
    rows, columns = image.shape
    small_size = (max(columns // _SHRINK, 4), max(rows // _SHRINK, 4))
    small = cv2.resize(image, small_size, interpolation=cv2.INTER_AREA)
    reach = max(3, min(small_size) // 4 | 1)
    kernel = np.ones((reach, reach), np.uint8)
    level = cv2.morphologyEx(small, cv2.MORPH_CLOSE, kernel, borderType=cv2.BORDER_REFLECT)
    width = (2 * (reach // 3) + 1,) * 2
    for _ in range(_SCREEN_PASSES):
        lit = (small > 0.93 * level).astype(np.float32)
        lit = cv2.erode(lit, np.ones((3, 3), np.uint8))
        weight = cv2.GaussianBlur(lit, width, 0) + 1e-3 * cv2.GaussianBlur(lit, (0, 0), reach)
        total = cv2.GaussianBlur(lit * small, width, 0)
        total += 1e-3 * cv2.GaussianBlur(lit * small, (0, 0), reach)
        level = np.where(weight > 1e-9, total / np.maximum(weight, 1e-9), level).astype(np.float32)
    screen: Float32 = cv2.resize(level, (columns, rows), interpolation=cv2.INTER_LINEAR)
    return screen
