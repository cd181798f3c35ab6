"""Blobs into bubbles: outlines cut where they turn inwards, arcs joined that share an ellipse.

The outline of a union of convex discs turns inwards only where one disc's rim meets another's.
Each arc between such notches belongs to one disc; arcs on both sides of a neighbour may belong to
the same one. A hypothesis is sound when the ellipse runs along its arcs and no outline point of the
blob lies inside it; a blob whose outline and area such ellipses do not explain stays whole and is
called merged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.bubbles.outline.arcs import (
    contour_moments,
    fit_ellipses,
    notch_arcs,
)
from telerig.estimator.bubbles.outline.ellipse_geometry import rough_distance
from telerig.estimator.bubbles.outline.regions import Blob

Array = NDArray[np.float64]

_CLEAN_PX, _CLEAN_SHARE = 0.15, 0.012
_FIT_PX, _FIT_SHARE = 0.3, 0.03
_MIN_ARC_RAD = 1.0
_MIN_EXPLAINED, _MIN_COVERED = 0.75, 0.88
_MAX_ARCS = 24
_SPIRAL, _LEAST_IN_IMAGE = 200, 0.08
_CANVAS_MARGIN_PX = 2
"""Outline points on the image's edge are left out, which narrows the blob by this much."""


@dataclass(frozen=True)
class Part:
    """One bubble of a blob: ``ellipse`` (5,), the blob's index, and whether the blob holds
    others (``shared``) or could not be split (``merged``)."""

    ellipse: Array
    blob: int
    shared: bool = False
    merged: bool = False


def split_blobs(blobs: list[Blob], shape: tuple[int, ...], *, min_diameter_px: float) -> list[Part]:
    """The bubbles in every blob of an image of ``shape``; at least one part for each."""
    if not blobs:
        return []
    whole, rms, largest = contour_moments([blob.contour_px for blob in blobs])
    parts: list[Part] = []
    for index, blob in enumerate(blobs):
        radius = float(np.sqrt(whole[index, 2] * whole[index, 3]))
        allowed = _CLEAN_PX + _CLEAN_SHARE * radius
        clean = rms[index] < allowed and largest[index] < 4.0 * allowed
        if clean and not blob.touches_border:
            parts.append(Part(whole[index], index))
        else:
            parts += _split(blob, index, whole[index], shape, min_diameter_px)
    return parts


def _tolerance(ellipse: Array) -> Array:
    tolerance: Array = _FIT_PX + _FIT_SHARE * np.sqrt(ellipse[..., 2] * ellipse[..., 3])
    return tolerance


def _split(
    blob: Blob, index: int, whole: Array, shape: tuple[int, ...], min_diameter_px: float
) -> list[Part]:
    arcs = notch_arcs(blob.contour_px)
    unsplit = [Part(whole, index, merged=True)]
    if not arcs or len(arcs) > _MAX_ARCS:
        return unsplit
    contour = blob.contour_px[np.isfinite(blob.contour_px[:, 0])]
    if len(arcs) == 1:
        fitted, rms = fit_ellipses(arcs)
        sound = rms[0] < 2.5 * _tolerance(fitted[0]) and _dark(fitted[0], contour, shape)
        return [Part(fitted[0], index)] if sound else unsplit
    return parts_of_arcs(_grouped(arcs, blob), blob, index, shape, min_diameter_px) or unsplit


def parts_of_arcs(
    groups: list[Array], blob: Blob, index: int, shape: tuple[int, ...], min_diameter_px: float
) -> list[Part]:
    """The sound bubbles along groups of arcs of blob ``index``; none if they do not explain it."""
    if not groups:
        return []
    contour = blob.contour_px[np.isfinite(blob.contour_px[:, 0])]
    fitted, rms = fit_ellipses(groups)
    good = [
        ellipse
        for ellipse, group, error in zip(fitted, groups, rms, strict=True)
        if _sound(ellipse, group, float(error), contour, min_diameter_px)
        and _dark(ellipse, contour, shape)
    ]
    if not _explains(good, contour):
        return []
    return [Part(ellipse, index, shared=len(good) > 1) for ellipse in good]


def _sound(
    ellipse: Array, group: Array, rms: float, contour: Array, min_diameter_px: float
) -> bool:
    """Whether the ellipse runs along its arcs, is seen over enough of them, and holds no rim."""
    tolerance = float(_tolerance(ellipse))
    if rms > tolerance or 2.0 * ellipse[3] < min(0.6 * min_diameter_px, 6.0):
        return False
    if _seen_rad(ellipse, group) < _MIN_ARC_RAD or ellipse[2] > 2.2 * ellipse[3]:
        return False
    return _holds_no_rim(ellipse, contour)


def _holds_no_rim(ellipse: Array, contour: Array) -> bool:
    inside = rough_distance(ellipse, contour[:, 0], contour[:, 1]) < -2.0 * _tolerance(ellipse)
    return bool(np.mean(inside) < 0.02)


def _seen_rad(ellipse: Array, points: Array) -> float:
    angle = np.arctan2(points[:, 1] - ellipse[1], points[:, 0] - ellipse[0])
    slot = ((angle + np.pi) * (48 / (2.0 * np.pi))).astype(int) % 48
    return float(np.unique(slot).size * (2.0 * np.pi / 48))


def _grouped(arcs: list[Array], blob: Blob) -> list[Array]:
    """Arcs joined, best pair first, as long as one ellipse fits both."""
    contour = blob.contour_px[np.isfinite(blob.contour_px[:, 0])]
    groups = list(arcs)
    rejected: set[tuple[int, int]] = set()
    ids = list(range(len(groups)))
    while len(groups) > 1:
        pairs = [
            (i, j)
            for i in range(len(groups))
            for j in range(i + 1, len(groups))
            if (ids[i], ids[j]) not in rejected
        ]
        if not pairs:
            break
        joint = [np.concatenate([groups[i], groups[j]]) for i, j in pairs]
        ellipses, rms = fit_ellipses(joint)
        score = rms / _tolerance(ellipses)
        fitting = [
            score[k] < 0.8
            and ellipses[k, 2] < 1.6 * ellipses[k, 3]
            and _holds_no_rim(ellipses[k], contour)
            for k in range(len(pairs))
        ]
        rejected |= {(ids[i], ids[j]) for k, (i, j) in enumerate(pairs) if not fitting[k]}
        if not any(fitting):
            break
        best = int(np.argmin(np.where(fitting, score, np.inf)))
        i, j = pairs[best]
        groups = [g for k, g in enumerate(groups) if k not in (i, j)] + [joint[best]]
        ids = [g for k, g in enumerate(ids) if k not in (i, j)] + [max(ids) + 1]
    return groups


def _explains(ellipses: list[Array], contour: Array) -> bool:
    """Whether the ellipses' rims carry the blob's outline and their discs fill its area."""
    if not ellipses:
        return False
    stack = np.stack(ellipses)
    gap = rough_distance(stack[:, None, :], contour[None, :, 0], contour[None, :, 1])
    nearest = np.min(np.abs(gap), axis=0)
    if np.mean(nearest < 1.0 + 2.0 * np.min(_tolerance(stack))) < _MIN_EXPLAINED:
        return False
    return _covered(stack, contour) > _MIN_COVERED


def _filled(contour: Array) -> tuple[NDArray[np.uint8], NDArray[np.int_]]:
    """The outline filled on a canvas, and the canvas's first pixel (u, v)."""
    import cv2

    low = np.floor(np.min(contour, axis=0)).astype(int)
    size = np.ceil(np.max(contour, axis=0)).astype(int) - low + 1
    canvas = np.zeros((size[1], size[0]), np.uint8)
    cv2.fillPoly(canvas, [np.round(contour - low).astype(np.int32).reshape(-1, 1, 2)], 1)
    return canvas, low


def _dark(ellipse: Array, contour: Array, shape: tuple[int, ...]) -> bool:
    """Whether what the image shows of the ellipse's disc lies within the blob."""
    share = (np.arange(_SPIRAL) + 0.5) / _SPIRAL
    turn = np.arange(_SPIRAL) * np.pi * (3.0 - np.sqrt(5.0))
    x = ellipse[2] * np.sqrt(share) * np.cos(turn)
    y = ellipse[3] * np.sqrt(share) * np.sin(turn)
    cos, sin = np.cos(ellipse[4]), np.sin(ellipse[4])
    u = np.round(ellipse[0] + cos * x - sin * y).astype(int)
    v = np.round(ellipse[1] + sin * x + cos * y).astype(int)
    seen = (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
    if np.mean(seen) < _LEAST_IN_IMAGE:
        return False
    canvas, low = _filled(contour)
    u, v = u[seen] - low[0], v[seen] - low[1]
    near_u, near_v = np.clip(u, 0, canvas.shape[1] - 1), np.clip(v, 0, canvas.shape[0] - 1)
    inside = np.maximum(np.abs(near_u - u), np.abs(near_v - v)) <= _CANVAS_MARGIN_PX
    dark = inside & (canvas[near_v, near_u] > 0)
    return bool(np.mean(dark) > _MIN_COVERED)


def _covered(ellipses: Array, contour: Array) -> float:
    canvas, low = _filled(contour)
    v, u = np.nonzero(canvas)
    gap = rough_distance(ellipses[:, None, :], (u + low[0])[None, :], (v + low[1])[None, :])
    return float(np.mean(np.any(gap < 0.7, axis=0)))
