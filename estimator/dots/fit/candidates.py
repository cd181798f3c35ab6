"""Candidates for dots, and the reasons why a candidate is no dot.

A threshold follows the illumination: it is half-way between the local extremes wherever an edge is
near, and is interpolated smoothly across the flat parts between edges. So it needs neither a dot
size nor even light. Blobs are rejected by their outlines before the fit, dots by the fit itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, sqrt
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc

from telerig.arrays import Array, Bools, Float32
from telerig.estimator.dots.fit.blurred_ellipse import (
    approximate_distance_px,
    extent_px,
    semi_axes,
)
from telerig.estimator.dots.fit.luminance import PARAMETERS, DotFit, Reason
from telerig.estimator.dots.thresholds import (
    BLOB_BLUR,
    HOLE_SHARE,
    LEAST_MISFIT,
    LOG_FITTED,
    LOG_MISFIT,
    LOG_SPREAD,
    MODEL_RESIDUAL,
    OUTLINE_PX,
    OUTLINE_SD,
    RARE,
    ROUGH_SPREAD,
)
from telerig.statistics import robust_sd

Polarity = Literal["white_on_black", "black_on_white"]

_STRONG_SHARE = 0.15
_STRONG_SIGMA = 7.0
_FLAT_DISTANCE_PX = 3
_PIECE_LEVELS = (0.15, 0.3, 0.45, 0.6, 0.75)
_PIECE_SEMI_AXIS_PX = 4.0
_PIECE_GROWTH_PX = 0.5


@dataclass(frozen=True)
class Candidate:
    """A connected region of bright or dark pixels that may be a dot.

    label : value of its pixels in ``Candidates.labels``.
    centre_px, shape_px : (2,), (3,) of the ellipse with the same second moments, see
        ``blurred_ellipse``.
    holes : outlines (N, 2) of the holes in the region, in px.
    unevenness : how far the outline is from an ellipse, in standard deviations of a dot's.
    reason : why the region is left out whatever its outline; None if it may be a dot.
    """

    label: int
    centre_px: Array
    shape_px: Array
    area_px2: float
    holes: tuple[NDArray[np.int32], ...]
    unevenness: float
    reason: Reason | None

    @property
    def promising(self) -> bool:
        """Whether the outline alone may be that of a dot."""
        return not self.reason and not is_unlike([self.unevenness])


@dataclass(frozen=True)
class Candidates:
    """All blobs of one polarity in an image.

    labels : (rows, columns) the label of the blob to which each pixel belongs, 0 for none.
    """

    polarity: Polarity
    blobs: tuple[Candidate, ...]
    labels: NDArray[np.int32]

    @property
    def promising(self) -> tuple[Candidate, ...]:
        """Return the blobs whose outline may be that of a dot."""
        return tuple(blob for blob in self.blobs if blob.promising)

    def up_to(self, diameter_px: float) -> Candidates:
        """Return the candidates; those larger than this diameter are marked as too large."""
        if np.isinf(diameter_px):
            return self
        most = np.pi / 4 * diameter_px**2
        blobs = (
            replace(b, reason=Reason.TOO_LARGE) if b.area_px2 > most else b for b in self.blobs
        )
        return replace(self, blobs=tuple(blobs))


@dataclass(frozen=True)
class EdgeMap:
    """The edges of an image; all arrays have its shape (rows, columns).

    smooth : smoothed grey levels.
    threshold : the grey level that separates dots from background at each pixel.
    flat : whether there is no edge near the pixel.
    has_edges : whether the image has any edge.
    """

    smooth: Float32
    threshold: Float32
    flat: Bools
    has_edges: bool


def edge_map(image: Float32, sigma: float, block: int = 4, blocks: int = 5) -> EdgeMap:
    """Return the edges and the threshold surface of an image.

    image : (rows, columns) grey levels. sigma : approximate standard deviation of their noise.
    block, blocks : the threshold is between the extremes of squares of blocks x blocks blocks, each
        of block x block pixels.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), 0.8, borderType=cv2.BORDER_REPLICATE)
    rows, columns = image.shape
    missing = (-rows % block, -columns % block)
    padded = cv2.copyMakeBorder(smooth, 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE)
    square = np.ones((block, block), np.uint8)
    anchor = (0, 0)
    fine_high = cv2.dilate(padded, square, anchor=anchor)[::block, ::block]
    fine_low = cv2.erode(padded, square, anchor=anchor)[::block, ::block]
    window = np.ones((blocks, blocks), np.uint8)
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


def _away_from(bright: Bools) -> Bools:
    """Return pixels far from any crossing of the threshold, chosen by place alone against bias."""
    grey = bright.astype(np.uint8)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    crossing = cv2.morphologyEx(grey, cv2.MORPH_GRADIENT, cross)
    size = 2 * _FLAT_DISTANCE_PX + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    flat: Bools = np.asarray(cv2.dilate(crossing, disc) == 0)
    flat[[0, -1]] = flat[:, [0, -1]] = False
    return flat


def _spread(values: Float32, weight: Float32) -> Float32:
    """Return values weighted, and interpolated from coarser scales where there is no weight."""
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
    spread: Float32 = share * local + (1.0 - share) * filled
    return spread


def find_candidates(edges: EdgeMap, polarity: Polarity, min_diameter_px: float) -> Candidates:
    """Return every blob of one polarity in an image.

    A blob that cannot be a dot, for example because it is smaller than ``min_diameter_px``, has a
    ``reason``.
    """
    sign = 1.0 if polarity == "white_on_black" else -1.0
    labels = np.zeros(edges.smooth.shape, np.int32)
    if not edges.has_edges:
        return Candidates(polarity, (), labels)
    above: Float32 = (edges.smooth - edges.threshold) * np.float32(sign)
    shown = [
        (outline, _first_look(outline, holes, labels.shape, min_diameter_px))
        for outline, holes in _outlines(above > 0)
    ]
    shown = [
        one
        for outline, look in shown
        for one in _pieces(above, outline, look, min_diameter_px) or [(outline, look)]
    ]
    blobs: list[Candidate] = []
    for outline, look in shown:
        if look is not None:
            blobs.append(replace(look, label=len(blobs) + 1))
            fill(labels, len(blobs), outline, *look.holes)
    return Candidates(polarity, tuple(blobs), labels)


_Look = tuple[NDArray[np.int32], Candidate | None]


def fill(canvas: NDArray[np.generic], value: int, *outlines: NDArray[np.int32]) -> None:
    """Set the pixels inside the first outline to a value, in place.

    The further outlines are holes in the first one; their pixels stay as they are. Each outline is
    (N, 2) in px.
    """
    cv2.drawContours(canvas, [o.reshape(-1, 1, 2) for o in outlines], -1, value, cv2.FILLED)


def _outlines(
    inside: Bools,
) -> list[tuple[NDArray[np.int32], tuple[NDArray[np.int32], ...]]]:
    """Return the outer outline (N, 2) of each connected region, with the outlines of its holes."""
    found, tree = cv2.findContours(inside.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    if not found:
        return []
    parents = np.asarray(tree).reshape(-1, 4)[:, 3]
    outlines = [np.asarray(outline, dtype=np.int32).reshape(-1, 2) for outline in found]
    holes: dict[int, list[NDArray[np.int32]]] = {}
    for index in np.flatnonzero(parents >= 0):
        holes.setdefault(int(parents[index]), []).append(outlines[index])
    return [(outlines[k], tuple(holes.get(int(k), ()))) for k in np.flatnonzero(parents < 0)]


def _pieces(
    above: Float32, outline: NDArray[np.int32], whole: Candidate | None, min_diameter_px: float
) -> list[_Look]:
    """Return the small dots whose blurs overlap, separated by a higher threshold.

    Only blobs that are no dot and nowhere thicker than the blur are separated: larger dots touch in
    the world.
    """
    if whole is None or whole.promising or whole.reason == Reason.TOO_SMALL:
        return []
    low, high = outline.min(axis=0), outline.max(axis=0) + 1
    filled = np.zeros((high - low)[::-1] + 2, np.uint8)
    fill(filled, 1, outline - low + 1)
    if cv2.distanceTransform(filled, cv2.DIST_L2, 3).max() > _PIECE_SEMI_AXIS_PX + 1.0:
        return []
    crop = np.where(filled[1:-1, 1:-1] > 0, above[low[1] : high[1], low[0] : high[0]], 0.0)
    if not np.any(crop > 0):
        return []
    peak = float(np.quantile(crop[crop > 0], 0.95))
    best: list[_Look] = []
    for level in _PIECE_LEVELS:
        inside = crop > level * peak
        small: list[_Look] = []
        for piece, _ in _outlines(inside):
            least = min_diameter_px - 2.0 * _PIECE_GROWTH_PX
            look = _first_look(piece + low, (), above.shape, least)
            if look is not None and _is_small_dot(look):
                small.append((piece + low, look))
        if len(small) > max(1, len(best)):
            best = small
    grown = _PIECE_GROWTH_PX * np.array([1.0, 0.0, 1.0])
    return [(o, replace(look, shape_px=look.shape_px + grown)) for o, look in best if look]


def _is_small_dot(piece: Candidate) -> bool:
    if piece.reason == Reason.TOUCHES_BORDER:
        return True
    sound = piece.promising or piece.reason == Reason.TOO_SMALL
    return sound and bool(semi_axes(piece.shape_px)[1] <= _PIECE_SEMI_AXIS_PX)


def _first_look(
    outline: NDArray[np.int32],
    holes: tuple[NDArray[np.int32], ...],
    image_shape: tuple[int, ...],
    min_diameter_px: float,
) -> Candidate | None:
    """Return the candidate of one outline; None for specks below half the smallest dot."""
    low, size = outline.min(axis=0), np.ptp(outline, axis=0) + 1
    if size.max() < 0.5 * min_diameter_px:
        return None
    area, centre, shape = _filled_moments(outline)
    reason: Reason | None = None
    if low.min() <= 0 or np.any(low + size >= image_shape[::-1]):
        reason = Reason.TOUCHES_BORDER
    elif 2.0 * semi_axes(shape)[0] < min_diameter_px:
        reason = Reason.TOO_SMALL
    return Candidate(0, centre, shape, area, holes, _unevenness(outline, centre, shape), reason)


def _filled_moments(outline: NDArray[np.int32]) -> tuple[float, Array, Array]:
    """Return area, centre (2,) and ellipse of equal moments (3,) of a filled outline's pixels."""
    low, size = outline.min(axis=0), np.ptp(outline, axis=0) + 1
    filled = np.zeros((int(size[1]), int(size[0])), np.uint8)
    fill(filled, 1, outline - low)
    m = cv2.moments(filled, binaryImage=True)
    area = float(m["m00"])
    variance = (m["mu20"] / area + 1 / 12, m["mu11"] / area, m["mu02"] / area + 1 / 12)
    centre = np.array([m["m10"], m["m01"]]) / area + low
    return area, centre, shape_from_matrix(variance)


def shape_from_matrix(variance: tuple[float, float, float]) -> Array:
    """Return the shape numbers (3,) of the uniform ellipse with the given second moments.

    variance : (uu, uv, vv) in px^2.
    """
    uu, uv, vv = variance
    mean, half = 0.5 * (uu + vv), hypot(0.5 * (uu - vv), uv)
    a, b = 2.0 * sqrt(mean + half), 2.0 * sqrt(max(mean - half, 0.05))
    round_part, turned = 0.5 * (a + b), 0.5 * (a - b) / max(half, 1e-12)
    across = turned * 0.5 * (uu - vv)
    return np.array([round_part + across, turned * uv, round_part - across])


def _unevenness(outline: NDArray[np.int32], centre: Array, shape: Array) -> float:
    """Return how far an outline (N, 2) is from the ellipse of its blob, in standard deviations."""
    distance = approximate_distance_px(shape, *(outline.T - centre[:, None])) + 0.5
    excess = float(np.sqrt(np.mean(distance**2))) - OUTLINE_PX
    return max(excess, 0.0) / float(OUTLINE_SD[0] + OUTLINE_SD[1] * semi_axes(shape)[1])


MODEL_RESIDUAL_DOTS = 5
"""The usual misfit counts as this many dots of the image."""


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][min(np.searchsorted(total, 0.5 * total[-1]), len(values) - 1)])


@dataclass(frozen=True)
class Look:
    """How the dots of an image look: medians of log radius (px), unevenness, log contrast and
    misfit, and the spreads of the latter three. Radius and unevenness are those of the blobs
    weighted by area, so that specks do not count."""

    log_radius: float
    unevenness: float = 0.0
    misfit: float = MODEL_RESIDUAL
    misfit_spread: float = LOG_MISFIT
    log_contrast: float = 0.0
    contrast_spread: float = LOG_SPREAD

    @classmethod
    def of_blobs(cls, found: Candidates) -> Look:
        """Return the look of the blobs that may be dots."""
        areas = np.array([blob.area_px2 for blob in found.promising])
        if areas.size == 0:
            return cls(-np.inf)
        uneven = np.array([blob.unevenness for blob in found.promising])
        area = _weighted_median(areas, areas)
        return cls(0.5 * float(np.log(area / np.pi)), _weighted_median(uneven, areas))

    def with_fits(self, fits: Sequence[DotFit]) -> Look:
        """Return the look with the contrasts and misfits of fitted dots."""
        if not fits:
            return self
        logs = np.log(np.maximum([abs(fit.contrast) for fit in fits], 1e-12))
        middle = float(np.median(logs))
        spread = max(LOG_SPREAD, float(robust_sd(logs - middle)))
        misfits = [fit.misfit for fit in fits] + MODEL_RESIDUAL_DOTS * [MODEL_RESIDUAL]
        misfit = float(np.median(misfits))
        scatter = max(
            LOG_MISFIT,
            float(robust_sd(np.log((np.array(misfits) + LEAST_MISFIT) / (misfit + LEAST_MISFIT)))),
        )
        return Look(self.log_radius, self.unevenness, misfit, scatter, middle, spread)

    def misfit_sd(self, fit: DotFit) -> float:
        """Return how many standard deviations a fit's misfit is above that of the image's dots."""
        excess = np.log((fit.misfit + LEAST_MISFIT) / (self.misfit + LEAST_MISFIT))
        return max(float(excess), 0.0) / self.misfit_spread


def is_unlike(deviations: ArrayLike) -> Bools:
    """Return whether deviations (..., k), in standard deviations, are together rarer than `RARE`
    among true dots, or not finite, as booleans (...)."""
    square = np.square(np.asarray(deviations, np.float64))
    return ~np.asarray(chdtrc(square.shape[-1], square.sum(-1)) >= RARE)


def _objection(deviations: Mapping[Reason, float]) -> Reason | None:
    """Return the reason of the largest deviation, in standard deviations, if all together are
    unlike a dot's."""
    if not is_unlike([*deviations.values()]):
        return None
    return max(deviations, key=lambda reason: np.nan_to_num(deviations[reason], nan=np.inf))


def is_ring(blob: Candidate) -> bool:
    """Return whether a blob is a ring: its holes are too large for specks of dust."""
    holes = sum(float(cv2.contourArea(hole.reshape(-1, 1, 2))) for hole in blob.holes)
    return holes > HOLE_SHARE * blob.area_px2


def saturation_level(grey: Float32) -> float:
    """Return the grey level at which the sensor saturates.

    It is the highest level of the image if more pixels have this level than the levels just below
    it; otherwise infinity.
    """
    top = float(grey.max())
    at_top, lower = grey == top, grey[grey < top]
    if np.count_nonzero(at_top) < 20 or not lower.size:
        return np.inf
    second = float(lower.max())
    below = np.count_nonzero(lower >= min(second, top - 0.005 * (top - float(lower.min()))))
    return top if np.count_nonzero(at_top) > below else np.inf


def clipping_levels(grey: Float32) -> tuple[float, float]:
    """Return grey levels (black, white) at which the image is clipped; infinite where it is not."""
    return -saturation_level(-grey), saturation_level(grey)


def reason_against_blob(blob: Candidate, look: Look) -> Reason | None:
    """Return why a blob is left out before any fit; None for a blob that may be a dot."""
    return blob.reason or _objection(_of_blob(blob, look))


def reason_against_fit(
    blob: Candidate,
    fit: DotFit,
    size_px: tuple[int, ...],
    polarity: Polarity,
    look: Look,
    smaller_sd: float = 0.0,
) -> Reason | None:
    """Return why a dot is left out after the luminance model was fitted to it; None for a good fit.

    size_px : (rows, columns) of the image. smaller_sd : how many standard deviations the fit is
    smaller than those of the dots around.
    """
    if fit.pixels <= PARAMETERS:
        return Reason.HIDDEN
    half, size = extent_px(fit.shape_px) + fit.sigma_px, np.array(size_px[::-1])
    if np.any(fit.centre_px - half < -0.5) or np.any(fit.centre_px + half > size - 0.5):
        return Reason.TOUCHES_BORDER
    axes, own = (np.add(semi_axes(shape), 1.0) for shape in (fit.shape_px, blob.shape_px))
    # The blob of a dot that is thinner than the blur is up to the blur wide, and that of a dot with
    # a heart may be the heart.
    blurred = np.hypot(axes, BLOB_BLUR * fit.sigma_px)
    inner = axes if fit.heart is None else np.minimum(axes, fit.heart[2] * (axes - 1.0) + 1.0)
    misshapen = float(np.log(np.maximum(inner / own, own / blurred)).max())
    way = float(np.linalg.norm(fit.centre_px - blob.centre_px) / np.mean(own))
    sign = 1.0 if polarity == "white_on_black" else -1.0
    faint = np.log(max(sign * fit.contrast, 1e-12)) - look.log_contrast
    of_blob = _of_blob(blob, look)
    return _objection({
        **of_blob,
        Reason.MUCH_SMALLER: max(of_blob[Reason.MUCH_SMALLER], smaller_sd),
        Reason.MISPLACED: max(way, misshapen) / LOG_FITTED,
        Reason.FAINT: max(float(-faint), 0.0) / look.contrast_spread,
        Reason.MISFIT: look.misfit_sd(fit),
    })  # fmt: skip


def _of_blob(blob: Candidate, look: Look) -> dict[Reason, float]:
    """Return how many standard deviations a blob's outline and size are from those of a dot."""
    smaller = look.log_radius - 0.5 * np.log(blob.area_px2 / np.pi)
    return {
        Reason.NOT_ELLIPSE: max(blob.unevenness - look.unevenness, 0.0)
        / max(1.0, ROUGH_SPREAD * look.unevenness),
        Reason.MUCH_SMALLER: max(float(smaller), 0.0) / LOG_SPREAD,
    }
