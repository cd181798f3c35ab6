"""Where dots may be: a threshold that follows the light, outlines, and a first look at each.

The threshold is half-way between the local extremes wherever an edge is near and is carried
smoothly across the flats between edges, so it needs no dot size and no even light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from telerig.estimator.frontend.blurred_ellipse import (
    approximate_distance_px,
    axes_from_shape,
    shape_from_axes,
)

Array = NDArray[np.float64]
Grey = NDArray[np.float32]
Polarity = Literal["white_on_black", "black_on_white"]

TOUCHES_BORDER = "touches the image border"
MERGED = "merged with its neighbour"
NOT_ELLIPSE = "outline is not an ellipse"
TOO_SMALL = "smaller than the smallest dot asked for"

_BLOCK = 4
_COARSE_WINDOW = 5
_STRONG_SHARE = 0.15
_STRONG_SIGMA = 7.0
_FLAT_DISTANCES_PX = (6, 5, 4, 3, 2)
_FLAT_SHARE = 0.1


@dataclass(frozen=True)
class Candidate:
    """A blob: ellipse of equal second moments, its box (u, v, width, height), and ``reason``.

    ``reason`` is empty for a blob that may be a dot. ``holes`` lists the outlines (N, 2) of holes.
    """

    label: int
    centre_px: Array
    shape_px: Array
    box: tuple[int, int, int, int]
    area_px2: float
    holes: tuple[NDArray[np.int32], ...]
    reason: str


@dataclass(frozen=True)
class Candidates:
    """All blobs of one polarity and the image (rows, columns) of their labels, 0 for none."""

    polarity: Polarity
    blobs: tuple[Candidate, ...]
    labels: NDArray[np.int32]

    @property
    def promising(self) -> tuple[Candidate, ...]:
        return tuple(blob for blob in self.blobs if not blob.reason)


@dataclass(frozen=True)
class EdgeMap:
    """The smoothed image, its threshold surface, and where the image is flat (no edge near)."""

    smooth: Grey
    threshold: Grey
    flat: NDArray[np.bool_]
    has_edges: bool


def edge_map(image: Grey, sigma: float) -> EdgeMap:
    """Threshold surface of ``image`` (rows, columns) whose noise is about ``sigma`` grey levels."""
    import cv2

    smooth = cv2.GaussianBlur(image, (0, 0), 0.8, borderType=cv2.BORDER_REPLICATE)
    rows, columns = image.shape
    padded = np.pad(smooth, ((0, -rows % _BLOCK), (0, -columns % _BLOCK)), mode="edge")
    square = np.ones((_BLOCK, _BLOCK), np.uint8)
    anchor = (0, 0)
    fine_high = cv2.dilate(padded, square, anchor=anchor)[::_BLOCK, ::_BLOCK]
    fine_low = cv2.erode(padded, square, anchor=anchor)[::_BLOCK, ::_BLOCK]
    window = np.ones((_COARSE_WINDOW, _COARSE_WINDOW), np.uint8)
    high, low = cv2.dilate(fine_high, window), cv2.erode(fine_low, window)
    span = high - low
    strong_span = max(_STRONG_SHARE * float(np.quantile(span, 0.995)), _STRONG_SIGMA * sigma)
    strong = span > strong_span
    weight = np.where(strong, span, 0.0).astype(np.float32) ** 2 * (fine_high - fine_low + 1e-6)
    middle = _spread(0.5 * (high + low), weight)
    size = (padded.shape[1], padded.shape[0])
    threshold = cv2.resize(middle, size, interpolation=cv2.INTER_LINEAR)[:rows, :columns]
    flat = _away_from(smooth > threshold)
    return EdgeMap(smooth, threshold, flat, bool(np.any(strong)))


def _away_from(bright: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels far from any crossing of the threshold, as far as leaves enough of them.

    Chosen by place alone: choosing quiet pixels would bias the noise that they are to tell.
    """
    import cv2

    grey = bright.astype(np.uint8)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    crossing = cv2.morphologyEx(grey, cv2.MORPH_GRADIENT, cross)
    flat = crossing == 0
    for distance in _FLAT_DISTANCES_PX:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * distance + 1, 2 * distance + 1))
        flat = cv2.dilate(crossing, disc) == 0
        flat[[0, -1]] = flat[:, [0, -1]] = False
        if np.count_nonzero(flat) > _FLAT_SHARE * flat.size:
            break
    return flat


def _spread(values: Grey, weight: Grey) -> Grey:
    """Weighted values carried over to where there is no weight, coarse scales filling in."""
    import cv2

    rows, columns = values.shape
    if min(rows, columns) <= 2:
        total = float(np.sum(weight))
        mean = float(np.sum(values * weight)) / total if total > 0 else float(np.mean(values))
        return np.full_like(values, mean)
    half = (max(1, (columns + 1) // 2), max(1, (rows + 1) // 2))
    peak = max(float(weight.max()), 1e-30)
    product = cv2.GaussianBlur(values * (weight / peak), (0, 0), 1.0)
    mass = cv2.GaussianBlur(weight / peak, (0, 0), 1.0)
    local = product / np.maximum(mass, 1e-30)
    coarse_mass = cv2.resize(mass, half, interpolation=cv2.INTER_AREA)
    coarse_product = cv2.resize(product, half, interpolation=cv2.INTER_AREA)
    coarse = _spread(coarse_product / np.maximum(coarse_mass, 1e-30), coarse_mass)
    filled = cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_LINEAR)
    share = mass / (mass + 1e-3)
    spread: Grey = share * local + (1.0 - share) * filled
    return spread


def find_candidates(edges: EdgeMap, polarity: Polarity, min_diameter_px: float) -> Candidates:
    """Every blob of one polarity, with the reason why it cannot be a dot if there is one."""
    import cv2

    bright = polarity == "white_on_black"
    inside = edges.smooth > edges.threshold if bright else edges.smooth < edges.threshold
    labels = np.zeros(edges.smooth.shape, np.int32)
    if not edges.has_edges:
        return Candidates(polarity, (), labels)
    outlines, tree = cv2.findContours(
        inside.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE
    )
    if not outlines:
        return Candidates(polarity, (), labels)
    hierarchy = np.asarray(tree).reshape(-1, 4)
    outlines = [np.asarray(outline, dtype=np.int32).reshape(-1, 2) for outline in outlines]
    blobs: list[Candidate] = []
    for index, outline in enumerate(outlines):
        if hierarchy[index, 3] >= 0:
            continue
        blob = _first_look(len(blobs) + 1, outline, inside.shape, min_diameter_px)
        if blob is None:
            continue
        holes = (
            tuple(outlines[k] for k in np.flatnonzero(hierarchy[:, 3] == index))
            if hierarchy[index, 2] >= 0
            else ()
        )
        blobs.append(Candidate(**{**blob.__dict__, "holes": holes}))
        cv2.drawContours(labels, [outline.reshape(-1, 1, 2)], -1, len(blobs), cv2.FILLED)
    return Candidates(polarity, tuple(blobs), labels)


def _first_look(
    label: int, outline: NDArray[np.int32], image_shape: tuple[int, ...], min_diameter_px: float
) -> Candidate | None:
    """Moments and first verdict of one outline; None for specks below half the smallest dot."""
    import cv2

    u, v, width, height = cv2.boundingRect(outline.reshape(-1, 1, 2))
    if max(width, height) < 0.5 * min_diameter_px:
        return None
    filled = np.zeros((height, width), np.uint8)
    cv2.drawContours(filled, [(outline - (u, v)).reshape(-1, 1, 2)], -1, 1, cv2.FILLED)
    area, centre, shape = _moments(filled)
    centre = centre + (u, v)
    reason = ""
    if u <= 0 or v <= 0 or u + width >= image_shape[1] or v + height >= image_shape[0]:
        reason = TOUCHES_BORDER
    elif 2.0 * axes_from_shape(shape)[0] < min_diameter_px:
        reason = TOO_SMALL
    else:
        reason = _outline_verdict(outline, centre, shape)
    return Candidate(label, centre, shape, (u, v, width, height), area, (), reason)


def _moments(filled: NDArray[np.uint8]) -> tuple[float, Array, Array]:
    import cv2

    m = cv2.moments(filled, binaryImage=True)
    area = float(m["m00"])
    variance = (m["mu20"] / area + 1 / 12, m["mu11"] / area, m["mu02"] / area + 1 / 12)
    squared = shape_from_matrix(variance)
    return area, np.array([m["m10"], m["m01"]]) / area, squared


def shape_from_matrix(variance: tuple[float, float, float]) -> Array:
    """Shape numbers of the uniform ellipse with these second moments (uu, uv, vv)."""
    large, small, angle = axes_from_shape(np.array(variance))
    return shape_from_axes(2.0 * np.sqrt(large), 2.0 * np.sqrt(max(small, 0.05)), angle)


def _outline_verdict(outline: NDArray[np.int32], centre: Array, shape: Array) -> str:
    import cv2

    offset = outline - centre
    distance = approximate_distance_px(shape, offset[:, 0], offset[:, 1]) + 0.5
    _, b, _ = axes_from_shape(shape)
    roughness = float(np.sqrt(np.mean(distance**2)))
    if roughness <= 0.5 + 0.04 * b:
        return ""
    hull = cv2.contourArea(cv2.convexHull(outline.reshape(-1, 1, 2)))
    solidity = cv2.contourArea(outline.reshape(-1, 1, 2)) / max(hull, 1.0)
    return MERGED if 0.6 < solidity < 0.95 else NOT_ELLIPSE


def choose_polarity(options: tuple[Candidates, Candidates]) -> Candidates:
    """The polarity whose dot-like blobs cover more of the image."""
    return max(options, key=lambda c: sum(blob.area_px2 for blob in c.promising))
