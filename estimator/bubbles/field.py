"""Where in an image bubbles can be seen: the lit screen, without the dark frame around it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from telerig.arrays import Bools
from telerig.errors import InputError
from telerig.io.images.read import read_image

_CELL_PX = 8
_LARGEST_BUBBLE = 10
"""Dark things narrower than the image by this factor are bubbles, not the screen's surround."""
_DARKER, _DIMMEST, _LEAST_SHARE = 3.0, 4.0, 0.02
_MARGIN_CELLS = 1


def lit_field(image: NDArray[Any]) -> Bools | None:
    """Return the part of the image (H, W) that shows the lit screen; None if all of it does.

    Bubbles are closed first; then a threshold (Otsu, IEEE Trans. SMC 9:62, 1979) of the logarithm
    divides lit from dark. The dark part is a window frame, a tank's wall or a stage if it lies at
    the border, covers 2 % of the image, and is three times as dark.
    """
    from skimage.filters import threshold_otsu

    height, width = image.shape
    size = (max(width // _CELL_PX, 4), max(height // _CELL_PX, 4))
    cells = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    reach = max(3, min(size) // _LARGEST_BUBBLE | 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    closed = cv2.morphologyEx(cells, cv2.MORPH_CLOSE, disc, borderType=cv2.BORDER_REPLICATE)
    log = np.log(np.maximum(closed, 1e-3 * float(closed.max()) + 1e-12))
    if not np.ptp(log) > np.log(_DARKER):
        return None
    bright = log > threshold_otsu(log)
    level = float(np.median(log[bright]))
    if not level - np.median(log[~bright]) > np.log(_DARKER):
        return None
    bright &= log > level - np.log(_DIMMEST)
    lit = _largest_part(bright.astype(np.uint8))
    lit = cv2.morphologyEx(lit, cv2.MORPH_OPEN, disc, borderType=cv2.BORDER_REPLICATE)
    if not 0 < lit.sum() < (1 - _LEAST_SHARE) * lit.size:
        return None
    lit = cv2.erode(lit, np.ones((2 * _MARGIN_CELLS + 1,) * 2, np.uint8), borderValue=1)
    whole = cv2.resize(255 * lit, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(whole > 127)


def _largest_part(lit: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the largest connected part with its holes filled: those are dark bubbles."""
    outlines, _ = cv2.findContours(lit, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros_like(lit)
    cv2.drawContours(filled, [max(outlines, key=cv2.contourArea)], -1, 1, cv2.FILLED)
    return filled


def described_field(
    shape: tuple[int, int],
    region_px: ArrayLike | None,
    mask: Path | None,
    where: str,
) -> Bools | None:
    """Return the pixels (H, W) inside a polygon and in which a mask is not 0; None without both.

    where : what gives the region, for errors.
    Raises InputError for what `region_field` and `mask_field` refuse, and where nothing is left.
    """
    parts = [] if region_px is None else [region_field(shape, region_px, where)]
    if mask is not None:
        parts.append(mask_field(shape, read_image(mask), str(mask)))
    if not parts:
        return None
    field = np.logical_and.reduce(parts)
    if not field.any():
        raise InputError(
            f"and {mask} have no pixel in common", where=where, todo="give one of them"
        )
    return np.asarray(field)


def region_field(shape: tuple[int, int], corners_px: ArrayLike, where: str) -> Bools:
    """Return the pixels (H, W) inside a polygon.

    corners_px : (n, 2) corners (u, v), n >= 3.  where : named in errors.
    Raises InputError for what is no polygon and for one that lies outside the image.
    """
    try:
        corners = np.asarray(corners_px, float)
    except (TypeError, ValueError):
        corners = np.zeros(0)
    if corners.ndim != 2 or corners.shape[1:] != (2,) or len(corners) < 3:
        raise InputError(
            "is no polygon", where=where, todo="give three corners or more: [[u, v], [u, v], ...]"
        )
    if not np.isfinite(corners).all() or np.abs(corners).max() > 1e6:
        raise InputError(
            "has a corner that is not two finite numbers, or is far outside any image",
            where=where,
            todo="give the corners in px: [[u, v], [u, v], ...]",
        )
    inside = np.zeros(shape, np.uint8)
    cv2.fillPoly(inside, [np.round(corners).astype(np.int32)], 1)
    if not inside.any():
        raise InputError(
            f"lies outside the image of {shape[1]} x {shape[0]} px", where=where,
            todo="give corners in px, u to the right and v down",
        )  # fmt: skip
    return inside > 0


def mask_field(shape: tuple[int, int], mask: NDArray[Any], where: str) -> Bools:
    """Return the pixels (H, W) in which a mask is not 0. Raises InputError as `region_field`."""
    if mask.shape != shape:
        raise InputError(
            f"is {mask.shape[1]} x {mask.shape[0]} px, the image {shape[1]} x {shape[0]} px",
            where=where,
            todo="paint the mask on an image of this camera",
        )
    if not np.any(mask):
        raise InputError("is black", where=where, todo="paint what is to be looked at white")
    return np.asarray(mask != 0)
