"""Dark blobs in front of a lit screen: noise, threshold, outlines to start from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Float32
from telerig.estimator.images.noise import clipped_sigma

_NOISE_SAMPLES = 40_000
_DARK_SHARE, _ENOUGH_DARK = 0.12, 120
_FAINT_SHARE = 0.5
_LOW_SIGMA = 6.0
_DARKEST = 0.05
_LIT = 0.85
_LEAST_OUTLINE, _STEEP_SHARE = 5, 0.6
_MAX_CUT_CENTRE_SHARE = 0.6


@dataclass(frozen=True)
class Blob:
    """One dark region: its outline ``contour_px`` (n, 2; closed, to about 0.1 px) at half depth,
    the ``inner`` level (background is 1), the edge's ``blur_px``, and the ``box`` (u, v, width,
    height) of the region it came from."""

    contour_px: Array
    inner: float
    blur_px: float
    box: tuple[int, int, int, int]
    touches_border: bool


class Rejected(NamedTuple):
    """A dark region that is no bubble, and why."""

    u_px: float
    v_px: float
    radius_px: float
    reason: str


def noise_share(ratio: Float32, response: Float32) -> float:
    """Noise of the normalised image where the screen is free, as a share of the background.

    response : the image's `high_pass`, which is blind to any plane.
    """
    free = cv2.erode((ratio > _LIT).astype(np.uint8), np.ones((3, 7), np.uint8)) > 0
    values = response[free] if np.count_nonzero(free) > 200 else response.ravel()
    return clipped_sigma(
        values[:: max(1, values.size // _NOISE_SAMPLES)].astype(np.float64), rounds=6
    )


def dark_noise_share(ratio: Float32, response: Float32, blobs: list[Blob], sigma: float) -> float:
    """Noise within the dark rims, at most ``sigma``, that of the screen: photons are fewer there.

    From the `high_pass` where five by five pixels are dark alike. Structure within the rims makes
    the estimate too large rather than too small.
    """
    found = [np.empty(0, np.float32)]
    for blob in blobs:
        x, y, width, height = blob.box
        crop = np.s_[y : y + height, x : x + width]
        even = (ratio[crop] < blob.inner + _DARK_SHARE * (1.0 - blob.inner)).astype(np.uint8)
        found.append(response[crop][cv2.erode(even, np.ones((5, 5), np.uint8), borderValue=0) > 0])
    values = np.concatenate(found)
    if values.size < _ENOUGH_DARK:
        return sigma
    return min(sigma, clipped_sigma(values[: 10 * _NOISE_SAMPLES].astype(np.float64), rounds=6))


def find_blobs(
    ratio: Float32, *, sigma: float, min_contrast: float, min_diameter_px: float
) -> tuple[list[Blob], list[Rejected]]:
    """Dark regions of the normalised image that may be bubbles, and those too small or faint.

    Hysteresis: a region is what is darker than a faint shadow, and counts when it holds pixels
    darker than ``1 - min_contrast``. Its outline is traced at half of its own depth.
    """
    low = 1.0 - max(_FAINT_SHARE * min_contrast, min(_LOW_SIGMA * sigma, 0.9 * min_contrast))
    mask = cv2.compare(ratio, low, cv2.CMP_LT)
    regions, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    blobs: list[Blob] = []
    rejected: list[Rejected] = []
    too_small = f"smaller than {min_diameter_px:g} px"
    for region in regions:
        if len(region) < _LEAST_OUTLINE:
            continue
        x, y, width, height = cv2.boundingRect(region)
        found: list[Blob] = []
        reason = too_small
        if max(width, height) >= min_diameter_px:
            box = (x, y, width, height)
            found, reason = _trace(ratio, region, box, low, min_contrast, min_diameter_px)
        blobs += found
        if not found:
            radius = 0.5 * float(np.sqrt(width * height))
            rejected.append(Rejected(x + (width - 1) / 2, y + (height - 1) / 2, radius, reason))
    return blobs, rejected


def _trace(
    ratio: Float32,
    region: NDArray[np.int32],
    box: tuple[int, int, int, int],
    low: float,
    min_contrast: float,
    min_diameter_px: float,
) -> tuple[list[Blob], str]:
    """Outlines at half depth within one region, or the reason why there is none."""
    x, y, width, height = box
    rows, columns = ratio.shape
    left, top = max(x - 1, 0), max(y - 1, 0)
    part = ratio[top : min(y + height + 1, rows), left : min(x + width + 1, columns)]
    own = np.zeros(part.shape, np.uint8)
    cv2.drawContours(own, [region], -1, 1, cv2.FILLED, offset=(-left, -top))
    values = part[(own > 0) & (part < low)]
    place = int(_DARKEST * values.size)
    inner = float(np.partition(values, place)[place])
    if inner > 1.0 - min_contrast:
        return [], f"contrast {1.0 - inner:.2f} is below {min_contrast:g}"
    half = 0.5 * (1.0 + inner)
    dark = own & (part < half)
    at_border = (top == 0, left == 0, top + part.shape[0] == rows, left + part.shape[1] == columns)
    if any(at_border):
        _close_at_border(dark, at_border)
    outlines, _ = cv2.findContours(dark, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    blobs = []
    for outline in outlines:
        points = outline.reshape(-1, 2)
        size = int(np.max(np.max(points, axis=0) - np.min(points, axis=0))) + 1
        if len(points) < _LEAST_OUTLINE or size < min_diameter_px:
            continue
        points = points + np.array([left, top])
        refined, blur = refined_contour(ratio, points, half, 1.0 - inner)
        edge = (points[:, 0] <= 0) | (points[:, 1] <= 0)
        edge |= (points[:, 0] >= columns - 1) | (points[:, 1] >= rows - 1)
        refined[edge] = np.nan
        blobs.append(Blob(refined, inner, blur, box, bool(np.any(edge))))
    return blobs, "" if blobs else f"smaller than {min_diameter_px:g} px"


def _close_at_border(dark: NDArray[np.uint8], sides: tuple[bool, ...]) -> None:
    """Join what is dark along the image's edges: a bright centre cut by the edge becomes a hole."""
    lines = (dark[0], dark[:, 0], dark[-1], dark[:, -1])
    for line, at_border in zip(lines, sides, strict=True):
        if not at_border:
            continue
        places = np.flatnonzero(line)
        for low, high in zip(places[:-1].tolist(), places[1:].tolist(), strict=True):
            if 1 < high - low <= _MAX_CUT_CENTRE_SHARE * line.size:
                line[low:high] = 1


def refined_contour(
    ratio: Float32, points: NDArray[np.int_], half: float, contrast: float
) -> tuple[Array, float]:
    """Outline points (n, 2) moved along the gradient to the half level, and the edge's blur."""
    rows, columns = ratio.shape
    u, v = points[:, 0].astype(np.intp), points[:, 1].astype(np.intp)
    u0, u1 = np.maximum(u - 1, 0), np.minimum(u + 1, columns - 1)
    v0, v1 = np.maximum(v - 1, 0), np.minimum(v + 1, rows - 1)
    slope_u = (
        2.0 * (ratio[v, u1] - ratio[v, u0])
        + (ratio[v0, u1] - ratio[v0, u0])
        + (ratio[v1, u1] - ratio[v1, u0])
    ) / 8.0
    slope_v = (
        2.0 * (ratio[v1, u] - ratio[v0, u])
        + (ratio[v1, u0] - ratio[v0, u0])
        + (ratio[v1, u1] - ratio[v0, u1])
    ) / 8.0
    square = np.maximum(slope_u**2 + slope_v**2, (0.02 * contrast) ** 2)
    shift = (half - ratio[v, u]) / square
    shift = shift * np.minimum(1.0, 1.2 / np.maximum(np.abs(shift) * np.sqrt(square), 1e-9))
    refined = np.stack([u + shift * slope_u, v + shift * slope_v], axis=1).astype(np.float64)
    place = int(_STEEP_SHARE * square.size)
    steepest = float(np.sqrt(np.partition(square, place)[place]))
    blur = contrast / (np.sqrt(2.0 * np.pi) * max(steepest, 1e-6))
    return refined, float(np.sqrt(max(blur**2 - 0.6, 0.15)))
