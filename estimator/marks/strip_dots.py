"""Dots of a strip that is fixed to the tank: where in the image they may be, and each frame's dots.

They are found like the dots of a target (`dots.locate`). One test, how far a dot's looks are from
those of the strip's, leaves out everything else: bubbles, dirt, and dots that a bubble covers.
Before the strip's looks are known, they are what the description of the strip lets expect.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from telerig.arrays import Array, Bools, Ints
from telerig.estimator.dots.fit.candidates import is_unlike
from telerig.estimator.dots.locate import COLUMNS, measure_dots
from telerig.estimator.dots.thresholds import LEAST_FRAMES, TOUCHED
from telerig.statistics import robust_sd

if TYPE_CHECKING:
    from telerig.estimator.dots.fit.candidates import Polarity

Window = tuple[slice, slice]

BORDER_PX = 1.5
"""Least distance between a dot's blurred edge and the image's border."""

_EXPECTED, _EXPECTED_SD = (0.0, 0.0, -0.5, 0.5), (0.08, 0.15, 0.25, 0.7)
"""The `_features` of a strip's dots, relative to the stated diameter, before any is seen: round,
darker by 40 %, with residuals of a real print; and their standard deviations."""
_LEAST_SPREAD = (0.03, 0.04, 0.05, 0.15)
"""Least standard deviations of the `_features` of a strip's dots from frame to frame."""
_LEAST_SHARE = 0.25
_SYSTEMATIC_PX = 0.005
_RING_TAIL = 0.1


@dataclass(frozen=True)
class DotLook:
    """The appearance of a strip's dots in one camera, and where in the image they may be.

    windows : parts of the image through which the strip passes.
    diameter_px : nominal diameter.
    a_px, blur_px : medians over the dots of the longer semi-axis and of the blur's standard
        deviation.
    usual, spread : (4,) medians and standard deviations of the `_features`.
    """

    polarity: Polarity
    diameter_px: float
    windows: tuple[Window, ...]
    a_px: float
    blur_px: float
    usual: Array
    spread: Array

    @property
    def margin_px(self) -> float:
        """Least distance of a whole dot's centre from the image's border."""
        return self.a_px + 2 * self.blur_px + BORDER_PX


@dataclass(frozen=True)
class DotSightings:
    """The n dots of one frame: centres uv_px (n, 2), and sigma_px (n,), the standard deviation of
    each centre along u and along v."""

    uv_px: Array
    sigma_px: Array


def learn_look(
    images: Iterable[NDArray[Any]],
    travel_px: Array,
    *,
    polarity: Polarity,
    diameter_px: float,
) -> DotLook | None:
    """Return how the strip's dots look in a sample of images; None if no strip is seen.

    Dots of a strip move along the travel, so they lie at the same distance across it in several
    images.

    travel_px : (2,) direction in which the tank moves through the image.
    polarity, diameter_px : nominal ones of the dots.
    """
    across = np.array([-travel_px[1], travel_px[0]]) / np.linalg.norm(travel_px)
    expected = DotLook(
        polarity, diameter_px, ((slice(0, None), slice(0, None)),), diameter_px / 2, 1.0,
        np.array(_EXPECTED) + [np.log(diameter_px / 2), 0.0, 0.0, 0.0], np.array(_EXPECTED_SD),
    )  # fmt: skip
    parts, shape = [pd.DataFrame(columns=[*COLUMNS, "image"], dtype=float)], (0, 0)
    for count, image in enumerate(images):
        parts.append(_dots_like(image, expected).assign(image=count))
        shape = image.shape
    seen = pd.concat([part for part in parts if len(part)] or parts, ignore_index=True)
    place = seen[["u_px", "v_px"]].to_numpy(float) @ across
    groups = _bands(place, seen["image"].to_numpy(), diameter_px)
    if not groups:
        return None
    kept = seen.iloc[np.concatenate(groups)]
    features = _features(kept)
    usual = np.median(features, axis=0)
    a_px, blur_px = kept[["a_px", "blur_px"]].median()
    return replace(
        expected, a_px=float(a_px), blur_px=float(blur_px), usual=usual,
        windows=tuple(_window(place[group], across, diameter_px, shape) for group in groups),
        spread=np.maximum(robust_sd(features - usual, axis=0), _LEAST_SPREAD),
    )  # fmt: skip


def find_dots(image: NDArray[Any], look: DotLook) -> DotSightings:
    """Return the dots of one frame that look like the strip's and are whole in the image."""
    dots = _dots_like(image, look)
    edge = dots["edge_suu_px2"] + dots["edge_svv_px2"]  # the same in all frames
    sigma = np.sqrt((dots["suu_px2"] + dots["svv_px2"] - edge) / 2)
    uv_px = dots[["u_px", "v_px"]].to_numpy(float)
    return DotSightings(uv_px, np.hypot(sigma.to_numpy(float), _SYSTEMATIC_PX))


def _dots_like(image: NDArray[Any], look: DotLook) -> pd.DataFrame:
    """Return the dots (`COLUMNS`) of an image that look like these and are whole and free in it."""
    parts = [pd.DataFrame(columns=COLUMNS, dtype=float)]
    for k, window in enumerate(look.windows):
        if min(image[window].shape) < 8:
            continue
        dots = measure_dots(
            image[window], polarity=look.polarity, min_diameter_px=max(look.diameter_px / 2, 3.0),
            max_diameter_px=1.5 * look.diameter_px + 2.0,
        ).dots  # fmt: skip
        dots["u_px"] += window[1].start
        dots["v_px"] += window[0].start
        good = np.isfinite(dots.to_numpy(float)).all(1) & _is_whole(dots, image, look)
        for earlier in look.windows[:k]:  # they may overlap
            good &= ~_is_whole(dots, image, look, earlier)
        parts.append(dots[good])
    dots = pd.concat([part for part in parts if len(part)] or parts, ignore_index=True)
    off = (_features(dots) - look.usual) / look.spread
    off[:, 3] = np.maximum(off[:, 3], 0.0)
    alike = dots[~is_unlike(off) & ~dots["ring"].to_numpy(bool)]
    free = [_is_free(image, dot, look) for dot in alike.itertuples()]
    found: pd.DataFrame = alike.loc[np.array(free, bool)]
    return found


def _features(dots: pd.DataFrame) -> Array:
    """Return logs (n, 4) of the mean semi-axis, of the ratio of both, of the contrast and of
    chi2_dof (of 1 where it is less) of n dots."""
    a, b, inner, outer, chi2 = dots[
        ["a_px", "b_px", "inner_level", "outer_level", "chi2_dof"]
    ].to_numpy(float).T  # fmt: skip
    contrast = np.abs(outer - inner) / np.maximum(np.maximum(inner, outer), 1e-9)
    parts = (np.sqrt(a * b), b / a, np.maximum(contrast, 1e-9), np.maximum(chi2, 1.0))
    return np.asarray(np.log(np.column_stack(parts)))


def _is_whole(
    dots: pd.DataFrame, image: NDArray[Any], look: DotLook, window: Window | None = None
) -> Bools:
    """Return (n,) whether each dot is whole in the image, or in a part of it."""
    uv, margin = dots[["u_px", "v_px"]].to_numpy(float), look.margin_px - 0.5
    spans = [(0, image.shape[1]), (0, image.shape[0])]
    if window is not None:
        spans = [part.indices(n)[:2] for part, (_, n) in zip(window[::-1], spans)]
    low, high = np.array(spans).T
    return np.asarray(np.all((uv > low + margin) & (uv < high - 1 - margin), axis=1))


def _is_free(image: NDArray[Any], dot: Any, look: DotLook) -> bool:
    """Whether the screen is seen all round a dot: neither a bubble's edge nor its bright middle."""
    first = look.a_px + 3 * look.blur_px
    last = first + max(3.0, 0.8 * look.a_px)
    centre = np.array([dot.u_px, dot.v_px])
    low = np.maximum(np.floor(centre - last).astype(int), 0)
    high = np.ceil(centre + last).astype(int) + 1
    window = image[low[1] : high[1], low[0] : high[0]]
    rows, columns = np.indices(window.shape)
    distance = np.hypot(columns + low[0] - dot.u_px, rows + low[1] - dot.v_px)
    ring = window[(distance > first) & (distance < last)]
    off = np.abs(np.quantile(ring, (_RING_TAIL, 1 - _RING_TAIL)) - dot.outer_level)
    return bool(ring.size > 0 and off.max() < TOUCHED * abs(dot.outer_level - dot.inner_level))


def _bands(place: Array, image: Ints, diameter_px: float) -> list[Ints]:
    """Return the dots of each strip: those (n,) at one place across the line of travel that
    enough images show."""
    if not len(place):
        return []
    order = np.argsort(place)
    cuts = np.flatnonzero(np.diff(place[order]) > 1.5 * diameter_px) + 1
    groups = np.split(order, cuts)
    frames = [len(np.unique(image[group])) for group in groups]
    least = min(LEAST_FRAMES, int(image.max()) + 1)
    enough = max(least, _LEAST_SHARE * max(frames))
    counts = [len(g) for g in groups]
    return [g for g, f, n in zip(groups, frames, counts) if f >= enough and n >= 0.2 * max(counts)]


def _window(place: Array, across: Array, diameter_px: float, shape: Sequence[int]) -> Window:
    """Return the part of the image that the band from least to greatest ``place`` crosses."""
    reach = 1.5 * diameter_px + 6
    low, high = float(place.min()) - reach, float(place.max()) + reach
    height, width = shape
    v, u = np.mgrid[0:height:4, 0:width:4]
    at = u * across[0] + v * across[1]
    inside = (at >= low - 4) & (at <= high + 4)
    rows, columns = np.flatnonzero(inside.any(1)) * 4, np.flatnonzero(inside.any(0)) * 4
    return (
        slice(int(rows[0]), min(int(rows[-1]) + 4, height)),
        slice(int(columns[0]), min(int(columns[-1]) + 4, width)),
    )
