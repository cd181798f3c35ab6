"""Two cameras see one target: what one image leaves open of its numbering, the other may decide.

The pixels (u, v, u', v') of all dots that two telecentric cameras see lie on one hyperplane, in all
views (the affine epipolar constraint; Koenderink and van Doorn, J. Opt. Soc. Am. A 8:377, 1991).
Views that are numbered in one way only show it, and a numbering of any other view has to agree.
A numbering that is off along the epipolar lines agrees as well and stays open.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from telerig.arrays import Array, Ints
from telerig.estimator.dots.grid.numbering import is_likely
from telerig.estimator.dots.thresholds import OUTLIER_SD, WRONG_ODDS

LEAST_PITCHES, LENS_PITCHES = 0.006, 0.03
"""Least and largest standard deviation of a view's distance from the hyperplane, in pitches:
distortion and perspective bend it. A lens that bends it more decides nothing. In between it is
twice the RMS of the views that show the hyperplane, as few views bend it towards themselves."""
LEAST_VIEWS = 2
"""Views that determine the hyperplane: a view of a plane spans two of its three directions."""


@dataclass(frozen=True)
class PossibleNumbers:
    """The n dots of one image and the K ways to number them, likeliest first.

    uv_px : (n, 2). ids : (K, n), -1 for no dot of the target. score : (K,) log-likelihoods.
    """

    uv_px: Array
    ids: Ints
    score: Array

    @property
    def is_decided(self) -> bool:
        """Return whether a single way of numbering the dots is likely."""
        return bool(is_likely(self.score).sum() == 1)

    @property
    def pitch_px(self) -> float:
        """The median distance of neighbouring dots."""
        near, _ = cKDTree(self.uv_px).query(self.uv_px, 2)
        return float(np.median(near[:, 1]))


def decided_by_pair(
    views: Mapping[str, tuple[PossibleNumbers, PossibleNumbers]],
) -> dict[str, tuple[int, int]]:
    """Return which numberings the two images of a view have, for each view that this decides.

    views : the images of both cameras, by view. Views whose images were decided but contradict the
    others are decided anew. If the views do not show one hyperplane, nothing is decided.
    """
    known = {
        name: _matched(pair)
        for name, pair in views.items()
        if pair[0].is_decided and pair[1].is_decided
    }
    known = {name: points for name, points in known.items() if len(points) > LEAST_VIEWS}
    pitch = float(np.median([image.pitch_px for pair in views.values() for image in pair]))
    limit, found = LENS_PITCHES * pitch, dict(known)
    while len(found) > LEAST_VIEWS and _worst(found, _hyperplane(found)) > OUTLIER_SD * limit:
        found.pop(min(found, key=lambda name: _misfit_without(found, name)))
    plane = _hyperplane(found)
    agree = len(found) >= max(LEAST_VIEWS, 2 * len(known) / 3)
    if plane is None or not agree or _worst(found, plane) > OUTLIER_SD * limit:
        return {}
    usual = np.sqrt(np.mean([_misfit(points, plane) ** 2 for points in found.values()]))
    sd_px, out = float(np.clip(2 * usual, LEAST_PITCHES * pitch, limit)), {}
    for name in views.keys() - found.keys():
        choice = _chosen(views[name], plane, sd_px)
        if choice is not None:
            out[name] = choice
    return out


def _matched(pair: tuple[PossibleNumbers, PossibleNumbers]) -> Array:
    """Return (u, v, u', v') (m, 4) of the m dots that both images show in their likeliest way."""
    _, one, two = np.intersect1d(pair[0].ids[0], pair[1].ids[0], return_indices=True)
    real = pair[0].ids[0][one] >= 0
    return np.concatenate([pair[0].uv_px[one[real]], pair[1].uv_px[two[real]]], axis=1)


def _hyperplane(views: Mapping[str, Array]) -> tuple[Array, float] | None:
    """Return the unit normal (4,) and the offset in px of the points of all views; None if they do
    not determine it."""
    if len(views) < LEAST_VIEWS:
        return None
    points = np.concatenate([*views.values()])
    middle = points.mean(0)
    _, size, axes = np.linalg.svd(points - middle, full_matrices=False)
    if size[2] < 1e-3 * size[0]:
        return None
    return axes[3], float(axes[3] @ middle)


def _misfit(points: Array, plane: tuple[Array, float] | None) -> float:
    if plane is None:
        return np.inf
    return float(np.sqrt(np.mean((points @ plane[0] - plane[1]) ** 2)))


def _worst(views: Mapping[str, Array], plane: tuple[Array, float] | None) -> float:
    return max((_misfit(points, plane) for points in views.values()), default=np.inf)


def _misfit_without(views: Mapping[str, Array], name: str) -> float:
    rest = {k: points for k, points in views.items() if k != name}
    return _worst(rest, _hyperplane(rest))


def _chosen(
    pair: tuple[PossibleNumbers, PossibleNumbers], plane: tuple[Array, float], sd_px: float
) -> tuple[int, int] | None:
    """Return the numberings of both images that are clearly likelier than all others."""
    normal, offset = plane
    ids, parts = np.unique(np.concatenate([image.ids.ravel() for image in pair])), []
    for image, direction in zip(pair, (normal[:2], normal[2:])):
        part = np.full((len(image.ids), len(ids)), np.nan)
        np.put_along_axis(part, np.searchsorted(ids, image.ids), image.uv_px @ direction, axis=1)
        part[:, ids < 0] = np.nan
        parts.append(part)
    off = parts[0][:, None] + parts[1] - offset
    many = np.isfinite(off).sum(-1)
    misfit = np.sqrt(np.nansum(off**2, -1) / np.maximum(many, 1)) / sd_px
    misfit[many == 0] = np.inf
    score = pair[0].score[:, None] + pair[1].score - 0.5 * np.minimum(misfit, 100.0) ** 2
    best = np.unravel_index(int(score.argmax()), score.shape)
    clear = np.count_nonzero(score >= score[best] + np.log(WRONG_ODDS)) == 1
    return (int(best[0]), int(best[1])) if clear and misfit[best] < OUTLIER_SD else None
