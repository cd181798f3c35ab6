"""The image that bubbles are looked for in: checks, and division by the lit screen."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Bools, Float32
from telerig.errors import InputError
from telerig.estimator.bubbles.background.screen import screen_level
from telerig.estimator.images.noise import check_grey_image

_UNIFORM_SHARE = 0.004
_CLIPPED_SHARE = 0.5
_WHITE_SHARE = 0.98
_EVERY_PX = 16
_LIT_SHARE, _BRIGHTEST = 0.6, 0.95
_UNLIT_SHARE = 0.05
"""Below this share of the lit screen the background is black: no shadow shows before it."""
BYTE_SCALE = 255.0
"""Grey level of white in an image of 8 bits."""
SCALES_OF_16_BITS = tuple(float(2**bits - 1) for bits in (10, 12, 14, 16))
"""Grey levels of white that an image stored in 16 bits may have."""
LEAST_BRIGHTNESS = 0.25
"""Brightness relative to the background below which an image counts as dark."""


def checked_image(image: NDArray[Any], min_diameter_px: float, min_contrast: float) -> NDArray[Any]:
    """Return an image (H, W) as an array.

    Raises InputError for one that is not grey or is too small, and for senseless settings.
    """
    image = np.asarray(image)
    check_grey_image(image, 16, "bubbles")
    if not min_diameter_px >= 4.0:
        raise InputError(
            f"bubbles of {min_diameter_px:g} px have too few pixels: no outline of less than 4 px "
            "is measured",
            where="min_diameter_px (--min-diameter)",
            todo="give 4 or more, half a pixel less than your smallest bubbles, as half of those "
            "at the limit are measured smaller; smaller bubbles need a larger magnification",
        )
    if not 0.05 <= min_contrast < 1.0:
        raise InputError(
            f"must lie in 0.05 .. 1, not {min_contrast}",
            where="min_contrast (--min-contrast)",
            todo="try 0.3, the default, or 0.15 for bubbles that are out of focus or of 5 px",
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
    """Return why an image (H, W) can show no bubble, in words; "" if it can."""
    low, high = float(image.min()), float(image.max())
    if high <= 0.0:
        return "the image is black"
    if high - low > _UNIFORM_SHARE * high:
        return ""
    if image.dtype.kind in "ui" and high >= _WHITE_SHARE * full_scale(image):
        return "the image is saturated"
    return "the image is uniform"


def full_scale(image: NDArray[Any]) -> float:
    """Return the grey level of white in an image; 16 bits may hold 10, 12 or 14.

    It is that of the least depth that holds the image, so a dark image may be taken for one of
    less depth than the camera has.
    """
    if image.dtype.itemsize == 1:
        return BYTE_SCALE
    high = float(image.max())
    return next((white for white in SCALES_OF_16_BITS if high <= white), SCALES_OF_16_BITS[-1])


def normalised(
    image: NDArray[Any], background: NDArray[Any] | None, gain: float = 1.0
) -> tuple[Float32, bool]:
    """Return the image divided by its background, and whether the screen is clipped (saturated).

    The quotient is 1 where the background is black.
    gain : brightness of the lit screen relative to the background.
    """
    screen = screen_level(image) if background is None else background
    screen = screen.astype(np.float32, copy=False)
    lit = float(np.quantile(screen[::_EVERY_PX, ::_EVERY_PX], _BRIGHTEST))
    unlit = screen < max(_UNLIT_SHARE * lit, 1e-6 * float(image.max()) + 1e-12)
    dark = bool(unlit.any())
    divisor = np.where(unlit, np.float32(1.0), screen) if dark else screen
    quotient = cv2.divide(_divisible(image), divisor, scale=1.0 / gain, dtype=cv2.CV_32F)
    ratio = np.asarray(quotient, np.float32)
    if dark:
        ratio[unlit] = 1.0
    sample = image[::8, ::8]
    clipped = bool(
        image.dtype.kind in "ui"
        and np.mean(sample == sample.max()) > _CLIPPED_SHARE
        and sample.max() >= _WHITE_SHARE * full_scale(image)
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


def rounding_share(image: NDArray[Any]) -> float:
    """Return the noise that whole grey levels make, as a share of the lit screen's level.

    It is 0 for an image of floating-point numbers.
    """
    some = image[::_EVERY_PX, ::_EVERY_PX]
    level = float(np.quantile(some, _BRIGHTEST)) if image.dtype.kind in "ui" else 0.0
    return 12**-0.5 / level if level > 0 else 0.0


def _divisible(image: NDArray[Any]) -> NDArray[Any]:
    """Return the image in a type that OpenCV divides without a copy, or in single precision."""
    return image if image.dtype in (np.uint8, np.uint16) else image.astype(np.float32, copy=False)
