"""Bubbles where dark regions run into each other: found by their rims.

A backlit bubble is a dark ring: all along its rim the image gets brighter outwards, whatever lies
behind it. Every pixel's gradient therefore votes for centres on its own line, one for each radius;
the votes for a radius are a convolution, made by Fourier transform (the vector field's form of
Hough's transform for circles). Directions are normalised, so that the sum is the share of a circle
at which a rim is seen, from 0 to 1, and faint bubbles count as much as black ones. From each
maximum a closed rim is followed through the image, and an ellipse is fitted to it.

Most candidates are no bubbles, but arcs of several. What is chosen has to be seen along its own
rim, and a piece of rim belongs to one bubble only: an ellipse over several bubbles finds its rim
owned by them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import fft, special

from telerig.arrays import Array, Bools, Float32, Rows
from telerig.estimator.bubbles.outline import rim_rays
from telerig.estimator.bubbles.outline.ellipse_geometry import Index, rough_distance
from telerig.estimator.bubbles.outline.outline_fit import ellipses_along

_LEAST_RADIUS_SHARE, _LEAST_DIAMETER_PX, _LEAST_SIDE = 0.4, 6.0, 16
_RADII_PER_OCTAVE, _LEAST_VOTES = 7, 0.4
_BLUR_CELLS, _CALM_CELLS = 1.0, 0.8
_NOISE_SLOPE = 0.3
"""Slope that is noise, in standard deviations of a pixel's noise: 1.5 of a slope at that blur."""
_PASSES = ((0, 0.45, 0.1), (0, 0.25, 0.1), (1, 0.15, 0.1), (2, 0.1, 0.02), (2, 0.05, 0.0))
"""Octaves finer than that of the candidate, window as a share of the radius, and stiffness."""
_SEEN_STRENGTH, _LEAST_SEEN = 0.33, 10
_LONGEST, _LARGEST_CHANGE, _LARGEST_SHIFT = 2.0, 1.8, 0.6
_STRONG, _LEAST_FALL = 0.6, 0.15
_OWN_SHARE, _OWN_PX, _OWN_RADII, _LEAST_INSIDE = 0.5, 2.0, 0.15, 0.5
_WITH_HEARTS, _WITHOUT_HEARTS = 0.67, 0.85
_HEART_WEIGHT, _UNEVEN_WEIGHT, _FULL_HEART = 0.5, 0.33, 0.6
_LARGE_SHARE, _SURE, _SURE_SHARE, _HEARTS_SHOW = 0.75, 0.9, 0.8, 0.75
_SECTORS, _MISLED, _UNSEEN_SHARE = 8, 2.0, 0.5
_LEAST_VARIANCE_PX2 = 0.01**2


@dataclass(frozen=True)
class Rims(Rows):
    """Hold N candidate bubbles with what is seen of their rims.

    ellipse : (N, 5) ellipses.
    points : (N, RAYS, 2) places on the rims (px)
    used : (N, RAYS) those the ellipse was fitted to.
    places : (N, RAYS, 2) where the gradient near the ellipse points outwards best (px).
    strong : (N, RAYS) whether a rim is seen there.
    inside : (N,) share of the rim that lies within the image.
    agreement : (N,) share of that which is seen, weighted with the cosine to the gradient.
    depth : (N,) how much darker the ring is than what surrounds it, as a share of the latter.
    heart : (N,) how much brighter the middle is than the ring, as the same share.
    unevenness : (N,) departures of the ring's level, as a share of what it is darker.
    inner, outer : (N,) grey levels within the rim and outside.
    blur_px : (N,) blur of the edge.
    """

    ellipse: Array
    points: Array
    used: Bools
    places: Array
    strong: Bools
    inside: Array
    agreement: Array
    depth: Array
    heart: Array
    unevenness: Array
    inner: Array
    outer: Array
    blur_px: Array

    def moved(self, u_px: float, v_px: float) -> Rims:
        """Return the same candidates as they are in an image of which this one is a part."""
        by = np.array([u_px, v_px])
        ellipse = self.ellipse + [u_px, v_px, 0.0, 0.0, 0.0]
        return replace(self, ellipse=ellipse, points=self.points + by, places=self.places + by)


def find_rims(
    ratio: Float32, sigma: float, *, min_diameter_px: float, largest_radius_px: float, alone: bool
) -> Rims:
    """Return all candidates for bubbles in an image, with what is seen of their rims.

    The functions `sole_owners` and `are_bubbles` then decide which of them are bubbles.

    ratio : (rows, columns) grey levels divided by the background.
    sigma : noise of a pixel, as a share of the background.
    min_diameter_px, largest_radius_px : limits of the rims' size.
    alone : whether the image is judged by itself, and is not one of a run.
    """
    levels = [np.ascontiguousarray(ratio, np.float32)]
    least = _LEAST_RADIUS_SHARE * max(min_diameter_px, _LEAST_DIAMETER_PX)
    while least * 2 ** len(levels) < largest_radius_px and min(levels[-1].shape) > _LEAST_SIDE:
        rows, columns = levels[-1].shape
        half = cv2.resize(levels[-1], (columns // 2, rows // 2), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half, np.float32))
    floors = [_NOISE_SLOPE * sigma / 2**k for k in range(len(levels))]
    found = [_voted(image, floors[k], least, alone) for k, image in enumerate(levels)]
    octave = np.repeat(np.arange(len(found)), [len(one) for one in found])
    circle = _from_octave(np.concatenate(found), octave)
    small = circle[:, 2] < largest_radius_px
    circle, octave = circle[small], octave[small]
    calm = [_blurred(image, _CALM_CELLS) for image in levels]
    ellipse = np.column_stack([circle[:, :3], circle[:, 2], np.zeros(len(circle))])
    points, used, alive = _followed(calm, floors, ellipse, octave)
    alive &= ellipse[:, 2] * ellipse[:, 3] < largest_radius_px**2
    return measured_rims(calm[0], sigma, ellipse[alive], points[alive], used[alive])


def _blurred(image: Float32, sigma: float) -> Float32:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float32)


def _from_octave(circle: Array, octave: Index) -> Array:
    """Circles (N, 3) of halved images in pixels of the whole one."""
    size = 2.0 ** octave[:, None]
    return np.asarray(circle * size + [0.5, 0.5, 0.0] * (size - 1.0))


def _voted(image: Float32, floor: float, least_radius: float, alone: bool) -> Array:
    """Circles (N, 3) of an octave of radii (px) that are seen over enough of their rims.

    The votes at a place x for radius r are the mean over directions n of n . g(x + r n), with g the
    normalised gradient. Its transform is i J1(k r) k . G / |k|, with J1 Bessel's function.

    In an image by itself the last radius is also the first of the next octave: its blur, of twice
    as many pixels, moves a rim inwards by about half a step, and the maximum of a bubble between
    the two would be beyond the radii of either. In the images of runs, which are sparser, that
    radius cost more than it found (docs/decisions/035-crowds.md).
    """
    radii = least_radius * 2.0 ** (np.arange(-1, _RADII_PER_OCTAVE + 1 + alone) / _RADII_PER_OCTAVE)
    margin = int(np.ceil(radii[-1])) + 2
    wide = cv2.copyMakeBorder(image, *(margin,) * 4, cv2.BORDER_REPLICATE)
    calm = _blurred(np.asarray(wide, np.float32), _BLUR_CELLS)
    du, dv = (cv2.Scharr(calm, cv2.CV_32F, *order, scale=1 / 32) for order in ((1, 0), (0, 1)))
    size = np.sqrt(du * du + dv * dv + np.float32(floor) ** 2) + np.float32(1e-12)
    shape = tuple(fft.next_fast_len(n, real=True) for n in calm.shape)
    per_u = 2.0 * np.pi * np.fft.rfftfreq(shape[1])[None, :].astype(np.float32)
    per_v = 2.0 * np.pi * np.fft.fftfreq(shape[0])[:, None].astype(np.float32)
    wave = np.hypot(per_u, per_v)
    wave[0, 0] = 1.0
    across = fft.rfft2(du / size, shape) * (1j * per_u / wave)
    across += fft.rfft2(dv / size, shape) * (1j * per_v / wave)
    step = 0.02
    bessel = special.j1(np.arange(0.0, float(wave.max()) * radii[-1] + 1.0, step))
    bessel = bessel.astype(np.float32)
    inside = slice(margin, margin + image.shape[0]), slice(margin, margin + image.shape[1])
    votes = np.stack(
        [
            fft.irfft2(across * bessel[(wave * (r / step)).astype(np.int32)], shape)[inside]
            for r in radii.tolist()
        ]
    )
    best = np.stack([cv2.dilate(one, np.ones((5, 5), np.uint8)) for one in votes])
    best = np.maximum(np.maximum(best[:-2], best[2:]), best[1:-1])
    k, v, u = np.nonzero((votes[1:-1] > _LEAST_VOTES) & (votes[1:-1] == best))
    return np.column_stack([u, v, radii[k + 1]]).astype(np.float64)


def _followed(
    calm: list[Float32], floors: list[float], ellipse: Array, octave: Index
) -> tuple[Array, Bools, Bools]:
    """Follow the closed rims and fit ellipses (N, 5) to them, in place; from coarse to fine.

    Returns the points (N, RAYS, 2), which of them the fits used, and which candidates are left.
    """
    many = len(ellipse)
    points = np.empty((many, rim_rays.RAYS, 2))
    used = np.zeros((many, rim_rays.RAYS), np.bool_)
    alive, began = np.ones(many, np.bool_), ellipse.copy()
    for finer, window, stiffness in _PASSES:
        level = np.maximum(octave - finer, 0)
        for k in np.unique(level[alive]).tolist():
            own = np.flatnonzero(alive & (level == k))
            size, offset = 2.0**k, (2.0**k - 1.0) / 2.0
            local = ellipse[own]
            local[:, :2] = (local[:, :2] - offset) / size
            local[:, 2:4] /= size
            rim, strength = rim_rays.closed_rims(calm[k], local, window, floors[k], stiffness)
            seen = strength > _SEEN_STRENGTH
            enough = seen.sum(axis=1) >= _LEAST_SEEN
            alive[own[~enough]] = False
            if not np.any(enough):
                continue
            own, rim, seen = own[enough], rim[enough], seen[enough]
            fitted = ellipses_along(rim[seen], seen.sum(axis=1))[0]
            fitted[:, :2] = fitted[:, :2] * size + offset
            fitted[:, 2:4] *= size
            change = np.abs(np.log(np.sqrt(fitted[:, 2] * fitted[:, 3]) / began[own, 2]))
            shift = np.linalg.norm(fitted[:, :2] - began[own, :2], axis=1)
            sound = (change < np.log(_LARGEST_CHANGE)) & (shift < _LARGEST_SHIFT * began[own, 2])
            alive[own] = sound & (fitted[:, 2] < _LONGEST * fitted[:, 3])
            ellipse[own], points[own], used[own] = fitted, rim * size + offset, seen
    return points, used, alive


def rims_along(ratio: Float32, sigma: float, ellipse: Array) -> Rims:
    """Return candidates that were found in another way: the rims along ellipses (N, 5)."""
    calm = _blurred(np.ascontiguousarray(ratio, np.float32), _CALM_CELLS)
    _, window, stiffness = _PASSES[-1]
    points, strength = rim_rays.closed_rims(calm, ellipse, window, _NOISE_SLOPE * sigma, stiffness)
    used = strength > _SEEN_STRENGTH
    used[used.sum(axis=1) < _LEAST_SEEN] = True
    return measured_rims(calm, sigma, ellipse, points, used)


def measured_rims(calm: Float32, sigma: float, ellipse: Array, points: Array, used: Bools) -> Rims:
    """Return what an image, slightly blurred, shows along the rims of ellipses (N, 5)."""
    seen = rim_rays.judged(calm, ellipse, _NOISE_SLOPE * sigma)
    strong = (seen.agreement > _STRONG) & (seen.fall > _LEAST_FALL)
    inside = np.isfinite(seen.agreement)
    agreement = np.sum(seen.agreement, axis=1, where=inside, initial=0.0)
    agreement /= np.maximum(np.sum(inside, axis=1), 1)
    edge = (seen.outer - seen.inner) / (np.sqrt(2.0 * np.pi) * np.maximum(seen.slope, 1e-6))
    blur = np.sqrt(np.maximum(edge**2 - _CALM_CELLS**2 - 0.25, 0.1))
    return Rims(
        *(ellipse, points, used, seen.places, strong, np.mean(inside, axis=1), agreement),
        *(seen.depth, seen.heart, seen.unevenness, seen.inner, seen.outer, blur),
    )


def typical_heart(rims: Rims, min_diameter_px: float) -> float:
    """Return how bright the hearts of an image's bubbles are, 0 where they show none.

    It is the upper quartile among the surest candidates that are not the smallest: some of these
    are out of focus and have none.
    """
    radius = np.sqrt(rims.ellipse[:, 2] * rims.ellipse[:, 3])
    large = rims.take(radius > _LARGE_SHARE * min_diameter_px)
    if not len(large):
        return 0.0
    sure = large.agreement >= min(float(np.quantile(large.agreement, _SURE_SHARE)), _SURE)
    return float(np.clip(np.quantile(large.heart[sure], _HEARTS_SHOW), 0.0, _FULL_HEART))


def sole_owners(rims: Rims, evidence: Array, sure: int = 0) -> Index:
    """Return the positions of candidates no two of which claim the same rim, the surest first.

    evidence : (N,) of each, as `are_bubbles` returns it.
    sure : number of candidates, the first ones, that are bubbles in any case.
    """
    rank = evidence + np.where(np.arange(len(rims)) < sure, 2.0, 0.0)
    order = np.argsort(-rank, kind="stable")
    least = _OWN_SHARE * rim_rays.RAYS * rims.inside
    least[:sure] = 0.0
    own = rim_rays.owners(order, rims.ellipse, rims.places, rims.strong, least)
    return np.asarray(order[own[order]])


def are_bubbles(rims: Rims, heart: float, min_contrast: float) -> tuple[Bools, Array]:
    """Return which candidates look like the bubbles of their image, and the evidence for each.

    heart : result of `typical_heart`. Where bubbles show bright hearts, a candidate that shows less
        has to show more of its rim; so has every candidate where no bubble has a heart, and
        one whose ring is uneven.
    """
    evidence = rims.agreement - _HEART_WEIGHT * np.maximum(heart - rims.heart, 0.0)
    evidence -= _UNEVEN_WEIGHT * np.minimum(rims.unevenness, 1.0)
    least = _WITHOUT_HEARTS + (_WITH_HEARTS - _WITHOUT_HEARTS) * heart / _FULL_HEART
    seen = (rims.inside >= _LEAST_INSIDE) & (rims.depth >= min_contrast)
    return np.asarray(seen & (evidence >= least)), evidence


def refitted(rims: Rims) -> Rims:
    """Return chosen bubbles with ellipses fitted to the places that are seen and theirs alone.

    Places near the rim of another chosen bubble are left out, unless too few remain.
    """
    used, ellipse = rims.used.copy(), rims.ellipse.copy()
    radius = np.sqrt(ellipse[:, 2] * ellipse[:, 3])
    for k in range(len(rims)):
        apart = np.linalg.norm(ellipse[:, :2] - ellipse[k, :2], axis=1)
        near = np.flatnonzero(apart < ellipse[:, 2] + ellipse[k, 2] + 2.0 * _OWN_PX)
        near = near[near != k]
        u, v = rims.points[k].T
        gap = np.abs(rough_distance(rims.ellipse[near, None, :], u[None, :], v[None, :]))
        reach = np.maximum(_OWN_PX, _OWN_RADII * np.minimum(radius[near], radius[k]))
        own = used[k] & rims.strong[k] & ~np.any(gap < reach[:, None], axis=0)
        if np.count_nonzero(own) >= _LEAST_SEEN:
            used[k] = own
    points = rims.points[used]
    if len(rims):
        ellipse = ellipses_along(points, used.sum(axis=1))[0]
    return replace(rims, ellipse=ellipse, used=used)


def rim_covariance(rims: Rims) -> Array:
    """Return the covariances (N, 2, 2) of the ellipses' centres, in px^2.

    The spread of the centres with one of eight sectors of the rim left out (jackknife; neighbouring
    points err together), twice, because neighbours mislead several sectors at once; and half of the
    share of the rim that is not seen, times the radius, squared. The two numbers were found on
    rendered swarms: 1.5 and 0.3 bring the median NEES of crowds nearer to 1 (0.82 -> 0.90 with 20 %
    covered), and make the tails worse (mean 3.0 -> 3.6).
    """
    sector = np.arange(rim_rays.RAYS) * _SECTORS // rim_rays.RAYS
    without = [rims.used & (sector != k) for k in range(_SECTORS)]
    centres = np.stack(
        [ellipses_along(rims.points[part], part.sum(axis=1))[0][:, :2] for part in without]
    )
    away = centres - np.mean(centres, axis=0)
    spread = np.einsum("sni,snj->nij", away, away) * (_SECTORS - 1.0) / _SECTORS
    unseen = _UNSEEN_SHARE * np.clip(1.0 - rims.agreement * rims.inside, 0.0, 1.0)
    along = unseen**2 * rims.ellipse[:, 2] * rims.ellipse[:, 3] + _LEAST_VARIANCE_PX2
    return np.asarray(_MISLED * spread + along[:, None, None] * np.eye(2))
