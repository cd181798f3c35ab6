"""Images displaced by fractions of a pixel."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Log = NDArray[np.float32]


def crop_of_lab(
    lab: Log,
    origin_px: tuple[int, int],
    shift_px: tuple[float, float],
    shape: tuple[int, int],
    outside: float,
) -> Log:
    """(H, W) of the lab seen at a shift (u, v), by cubic interpolation; ``outside`` beyond it."""
    left, top = shift_px[0] - origin_px[0], shift_px[1] - origin_px[1]
    column, row = math.floor(left), math.floor(top)
    window = np.full((shape[0] + 3, shape[1] + 3), outside, np.float32)
    r0, r1 = max(row - 1, 0), min(row + shape[0] + 2, lab.shape[0])
    c0, c1 = max(column - 1, 0), min(column + shape[1] + 2, lab.shape[1])
    if r0 < r1 and c0 < c1:
        part = lab[r0:r1, c0:c1]
        window[r0 - row + 1 : r1 - row + 1, c0 - column + 1 : c1 - column + 1] = part
    return shifted(window, (left - column, top - row))[1:-2, 1:-2]


def shifted(image: Log, shift_px: tuple[float, float]) -> Log:
    """image(p + shift) for shifts below 1 px, by Catmull-Rom splines; borders replicated."""
    import cv2

    along_u, along_v = (_spline(shift) for shift in shift_px)
    out = cv2.sepFilter2D(image, cv2.CV_32F, along_u, along_v, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(out, np.float32)


def _spline(shift: float) -> NDArray[np.float32]:
    """Five weights, of the pixels from -2 to +2."""
    base = math.floor(shift)
    x = np.abs(np.arange(-1, 3) - (shift - base))
    near, far = 1 - 2.5 * x**2 + 1.5 * x**3, 2 - 4 * x + 2.5 * x**2 - 0.5 * x**3
    weights = np.zeros(5, np.float32)
    # the fourth weight of a non-negative shift falls on +2, that of a negative one on +1
    weights[base + 1 : base + 5] = np.where(x <= 1, near, np.where(x < 2, far, 0.0))
    return weights
