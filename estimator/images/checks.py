"""Checks of an image that everything which measures in images makes first."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from telerig.errors import InputError


def check_grey_image(image: NDArray[Any], least_size_px: int, wanted: str) -> None:
    """Raise InputError for anything but a finite 2-D image of at least ``least_size_px`` per side.

    wanted : what is looked for in the image, in the plural, for the message.
    """
    if image.ndim != 2:
        raise InputError(
            f"a grey image has 2 dimensions, this array has {image.ndim}: {image.shape}",
            where="image",
            todo="convert colour images to grey first (cv2.cvtColor, or one channel of the array)",
        )
    if min(image.shape) < least_size_px or image.dtype.kind not in "uif":
        raise InputError(
            f"cannot look for {wanted} in an array of shape {image.shape} and type {image.dtype}",
            where="image",
            todo=f"give at least {least_size_px} x {least_size_px} pixels of an integer or float "
            "type",
        )
    if image.dtype.kind == "f" and not np.all(np.isfinite(image.astype(np.float32))):
        raise InputError(
            "the image has pixels that are not finite",
            where="image",
            todo="replace NaN and infinity",
        )
