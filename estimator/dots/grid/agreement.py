"""Two cameras see one target: what one image leaves open of its numbering, the other may decide.

With any lens but its distortion, the pixels x and x' of all dots that two cameras see, in all
views, satisfy x'^T F x = 0 with one matrix F (Luong and Faugeras, IJCV 17:43, 1996). Views that are
numbered in one way only show it, and a numbering of any other view has to agree. A numbering that
is off along the epipolar lines agrees as well and stays open.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from telerig.arrays import Array, Ints
from telerig.estimator.dots.grid.lattice import epipolar_products
from telerig.estimator.dots.grid.numbering import is_likely
from telerig.estimator.dots.thresholds import OUTLIER_SD, WRONG_ODDS

LEAST_PITCHES, LENS_PITCHES = 0.006, 0.03
"""Least and largest standard deviation of a view's distance from F, in pitches: distortion adds to
it. A lens that distorts more decides nothing. In between it is twice the RMS of the views that show
F, as few views draw it towards themselves."""
LEAST_VIEWS = 2
"""Views that determine F: one view of a plane leaves three numbers of it open."""


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
    others are decided anew. If the views do not show one F, nothing is decided.
    """
    known = {
        name: _matched(pair)
        for name, pair in views.items()
        if pair[0].is_decided and pair[1].is_decided
    }
    known = {name: points for name, points in known.items() if len(points) > LEAST_VIEWS}
    pitch = float(np.median([image.pitch_px for pair in views.values() for image in pair]))
    limit, found = LENS_PITCHES * pitch, dict(known)
    while len(found) > LEAST_VIEWS and _worst(found, _epipolar(found)) > OUTLIER_SD * limit:
        found.pop(min(found, key=lambda name: _misfit_without(found, name)))
    form = _epipolar(found)
    agree = len(found) >= max(LEAST_VIEWS, 2 * len(known) / 3)
    if form is None or not agree or _worst(found, form) > OUTLIER_SD * limit:
        return {}
    usual = np.sqrt(np.mean([_misfit(points, form) ** 2 for points in found.values()]))
    sd_px, out = float(np.clip(2 * usual, LEAST_PITCHES * pitch, limit)), {}
    for name in views.keys() - found.keys():
        choice = _chosen(views[name], form, sd_px)
        if choice is not None:
            out[name] = choice
    return out


def _matched(pair: tuple[PossibleNumbers, PossibleNumbers]) -> Array:
    """Return (u, v, u', v') (m, 4) of the m dots that both images show in their likeliest way."""
    _, one, two = np.intersect1d(pair[0].ids[0], pair[1].ids[0], return_indices=True)
    real = pair[0].ids[0][one] >= 0
    return np.concatenate([pair[0].uv_px[one[real]], pair[1].uv_px[two[real]]], axis=1)


def _epipolar(views: Mapping[str, Array]) -> Array | None:
    """Return F (3, 3), transposed, of the points of all views; None if they do not determine it."""
    points = np.concatenate([np.zeros((0, 4)), *views.values()])
    if len(views) < LEAST_VIEWS or len(points) < 9:
        return None
    middle, size = points.mean(0), points.std()
    inside = (points - middle) / size
    products = epipolar_products(inside[:, :2], inside[:, 2:])
    _, values, forms = np.linalg.svd(products, full_matrices=False)
    if values[7] < 2e-3 * values[0]:
        return None
    first, second = (
        np.array([[1, 0, -u], [0, 1, -v], [0, 0, size]]) for u, v in (middle[:2], middle[2:])
    )
    return np.asarray(first.T @ forms[8].reshape(3, 3) @ second)


def _misfit(points: Array, form: Array | None) -> float:
    """Return the RMS distance in px of points (m, 4) from F, to first order (Sampson)."""
    if form is None:
        return np.inf
    one, two = (np.c_[uv, np.ones(len(uv))] for uv in (points[:, :2], points[:, 2:]))
    lines, back = one @ form, two @ form.T
    slope = (lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1)
    return float(np.sqrt(np.mean((lines * two).sum(1) ** 2 / slope)))


def _worst(views: Mapping[str, Array], form: Array | None) -> float:
    return max((_misfit(points, form) for points in views.values()), default=np.inf)


def _misfit_without(views: Mapping[str, Array], name: str) -> float:
    rest = {k: points for k, points in views.items() if k != name}
    return _worst(rest, _epipolar(rest))


def _chosen(
    pair: tuple[PossibleNumbers, PossibleNumbers], form: Array, sd_px: float
) -> tuple[int, int] | None:
    """Return the numberings of both images that are clearly likelier than all others."""
    ids = np.unique(np.concatenate([image.ids.ravel() for image in pair]))
    places = []
    for image in pair:
        place = np.full((len(image.ids), len(ids), 2), np.nan)
        for one, numbers in zip(place, image.ids):
            one[np.searchsorted(ids, numbers)] = image.uv_px
        place[:, ids < 0] = np.nan
        places.append(np.concatenate([place, np.ones((*place.shape[:2], 1))], -1))
    lines, back = places[0] @ form, places[1] @ form.T
    slope = (lines[..., :2] ** 2).sum(-1)[:, None] + (back[..., :2] ** 2).sum(-1)
    squares = np.einsum("kia,lia->kli", lines, places[1]) ** 2 / slope
    many = np.isfinite(squares).sum(-1)
    misfit = np.sqrt(np.nansum(squares, -1) / np.maximum(many, 1)) / sd_px
    misfit[many == 0] = np.inf
    score = pair[0].score[:, None] + pair[1].score - 0.5 * np.minimum(misfit, 100.0) ** 2
    best = np.unravel_index(int(score.argmax()), score.shape)
    clear = np.count_nonzero(score >= score[best] + np.log(WRONG_ODDS)) == 1
    return (int(best[0]), int(best[1])) if clear and misfit[best] < OUTLIER_SD else None
