"""Bubbles of a whole image by their rims, and what is left of its dark regions.

In: an image and its blobs. Out: the bubbles that rims show (`rims`), each as a blob of its own, and
the outlines of dark regions that could not be divided.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Float32
from telerig.estimator.bubbles.outline.blobs import (
    Blob,
    Part,
    Rejected,
)
from telerig.estimator.bubbles.outline.ellipse_geometry import rough_distance
from telerig.estimator.bubbles.outline.outline_fit import (
    Outlines,
    missed_rims,
    radius_px,
    start_outlines,
)
from telerig.estimator.bubbles.outline.rims import (
    Rims,
    are_bubbles,
    find_rims,
    refitted,
    rim_covariance,
    rims_along,
    sole_owners,
    typical_heart,
)

_LARGEST_SHARE = 6.0
"""The image is so many times as wide as the largest radius of a bubble in a crowd."""
_AROUND_PX, _GRID_PX = 10, 16
_OPENED, _LEFT_AREA = 0.75, 0.5
_EXPLAINED_SHARE, _EXPLAINED_PX = 0.1, 1.0
_NEAR_SHARE, _NEAR_PX, _GROWTH = 0.15, 0.5, 0.15
_LEAST_COVERAGE = 0.3
_SEVERAL, _SMALLER, _FILLED = 3, 0.5, 0.3
_DISAGREE = 1.0
_UNLIKE = "its rim is unlike those of the sharp bubbles"


Window = tuple[slice, slice]
WHOLE: Window = (slice(None), slice(None))


@dataclass(frozen=True)
class Crowd:
    """Hold the bubbles of an image that were found by their rims.

    rims : of the bubbles.
    clusters : outlines (n, 2) in px of dark regions that could not be divided.
    rejected : single dark regions that show no rim like those of the bubbles.
    """

    rims: Rims
    clusters: list[Array]
    rejected: list[Rejected]


def resolved_crowd(
    ratio: Float32,
    sigma: float,
    blobs: list[Blob],
    parts: list[Part],
    sure: Rims,
    window: Window,
    *,
    min_diameter_px: float,
    min_contrast: float,
    alone: bool,
) -> Crowd:
    """Look for rims in a window of the image; dark regions that show none are clusters, unless
    single.

    ratio : (rows, columns) grey levels divided by the background
    sigma : noise of a pixel.
    blobs, parts : the dark regions, and what their outlines tell of the bubbles in them.
    sure : the bubbles of the image that are sure. Their rims belong to them; they are not among
        the bubbles that are returned.
    window : (rows, columns) of the image, such as `around` gives them.
    alone : as for `find_rims`.
    """
    part = ratio[window]
    largest = min(min(ratio.shape) / _LARGEST_SHARE, min(part.shape) / 2.0)
    rims = find_rims(
        part, sigma, min_diameter_px=min_diameter_px, largest_radius_px=largest,
        alone=alone,
    )  # fmt: skip
    rims = rims.moved(window[1].start or 0, window[0].start or 0)
    single = {part.blob: part.ellipse for part in parts if not (part.merged or part.shared)}
    large = [ellipse for ellipse in single.values() if ellipse[2] * ellipse[3] > largest**2]
    if large:
        rims = Rims.concat([rims, rims_along(ratio, sigma, np.stack(large))])
    every = Rims.concat([sure, rims])
    heart = typical_heart(every, min_diameter_px)
    kept, evidence = are_bubbles(every, heart, min_contrast)
    kept[: len(sure)] = True
    every = every.take(kept)
    every = every.take(np.sort(sole_owners(every, evidence[kept], len(sure))))
    several = _over_several(every.ellipse)
    several[: len(sure)] = False
    every = refitted(every.take(~several))
    rims = every.take(slice(len(sure), None))
    clusters, rejected, explained = [], [], _explained(ratio.shape, every.ellipse)
    for index, blob in enumerate(blobs):
        if index not in single or np.any(_within(blob, every)):
            clusters += _left(ratio, blob, explained, min_diameter_px)
        else:
            u, v, a, b, _ = single[index].tolist()
            rejected.append(Rejected(u, v, (a * b) ** 0.5, _UNLIKE))
    return Crowd(rims, clusters, rejected)


def _over_several(ellipse: Array) -> Bools:
    """Return which ellipses (N, 5) hold the centres of several smaller ones that fill much of them.

    Arcs of these bubbles look like its rim; a large bubble in front of so many is rare.
    """
    u, v, a, b, _ = ellipse.T
    inside = rough_distance(ellipse[:, None], u[None], v[None]) < 0.0
    inside &= a * b < _SMALLER * (a * b)[:, None]
    return np.asarray((inside.sum(axis=1) >= _SEVERAL) & (inside @ (a * b) > _FILLED * a * b))


def _within(blob: Blob, rims: Rims) -> Bools:
    outline = _drawn(blob.contour_px)
    if len(outline) < 3:
        return np.zeros(len(rims), np.bool_)
    inside = [
        cv2.pointPolygonTest(outline, (float(u), float(v)), False) >= 0.0
        for u, v in rims.ellipse[:, :2]
    ]
    return np.array(inside, dtype=np.bool_)


def _drawn(contour: Array) -> NDArray[np.float32]:
    known = contour[np.isfinite(contour[:, 0])]
    return np.ascontiguousarray(known[:, None], np.float32)


def around(blob: Blob, shape: tuple[int, ...]) -> Window:
    """Return the window of an image in which a blob and the surroundings of its rim are.

    It begins at multiples of 16 px, so that its halved images are parts of those of the whole.
    """
    x, y, width, height = blob.box
    left, top = (max(low - _AROUND_PX, 0) // _GRID_PX * _GRID_PX for low in (x, y))
    bottom, right = min(y + height + _AROUND_PX, shape[0]), min(x + width + _AROUND_PX, shape[1])
    return slice(top, bottom), slice(left, right)


def _explained(shape: tuple[int, ...], ellipses: Array) -> NDArray[np.uint8]:
    """Return an image that is not 0 where ellipses (N, 5) and their rims' surroundings are."""
    covered = np.zeros(shape, np.uint8)
    for u, v, a, b, angle in ellipses.tolist():
        margin = _EXPLAINED_SHARE * (a * b) ** 0.5 + _EXPLAINED_PX
        axes = (2.0 * (a + margin), 2.0 * (b + margin))
        cv2.ellipse(covered, ((u, v), axes, float(np.rad2deg(angle))), 1, cv2.FILLED)
    return covered


def _left(
    ratio: Float32, blob: Blob, explained: NDArray[np.uint8], min_diameter_px: float
) -> list[Array]:
    """Return outlines (n, 2) of the dark parts of a blob that nothing explains."""
    outline = _drawn(blob.contour_px)
    if len(outline) < 3:
        return []
    x, y, width, height = blob.box
    box = slice(y, y + height), slice(x, x + width)
    filled = np.zeros((height, width), np.uint8)
    cv2.fillPoly(filled, [np.round(outline - [x, y]).astype(np.int32)], 1)
    dark = (filled > 0) & (explained[box] == 0) & (ratio[box] < 0.5 * (1.0 + blob.inner))
    disc = max(int(_OPENED * min_diameter_px) | 1, 3)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (disc, disc))
    opened = cv2.morphologyEx(dark.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    outlines, _ = cv2.findContours(opened, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    least = _LEFT_AREA * np.pi / 4.0 * min_diameter_px**2
    return [
        line[:, 0].astype(np.float64) + [x, y]
        for line in outlines
        if cv2.contourArea(line) >= least
    ]


def settled(fitted: Outlines, rims: Rims) -> Outlines:
    """Return the fitted outlines of N rims, corrected where neighbours have misled the fits.

    A rim is the closed path along which the image gets brighter outwards. A fit whose centre or
    size is far from those of its rim, or that rests on a small part of the outline, is replaced by
    the ellipse through the rim, with its covariance. Where both are sound but differ by more than
    that covariance allows, the difference is added to the covariance of the fit.
    """
    radius = np.sqrt(rims.ellipse[:, 2] * rims.ellipse[:, 3])
    away = fitted.ellipse[:, :2] - rims.ellipse[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        near = np.hypot(away[:, 0], away[:, 1]) < _NEAR_SHARE * radius + _NEAR_PX
        near &= np.abs(np.log(radius_px(fitted) / radius)) < _GROWTH
    covariance = rim_covariance(rims)
    sound = near & (fitted.coverage > _LEAST_COVERAGE) & ~missed_rims(fitted)
    distance = np.einsum("ni,nij,nj->n", away, np.linalg.inv(covariance), away)
    apart = np.where((distance > _DISAGREE)[:, None, None], away[:, :, None] * away[:, None], 0.0)
    along = start_outlines(rims.ellipse, rims.blur_px, rims.inner).changed(
        outer=rims.outer,
        covariance_px2=covariance,
        chi2_dof=np.nan,
        coverage=np.mean(rims.used, axis=1),
    )
    fitted = fitted.changed(covariance_px2=fitted.covariance_px2 + apart)
    return fitted.updated(~sound, along.take(~sound))
