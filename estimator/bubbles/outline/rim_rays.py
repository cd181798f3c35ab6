"""What an image shows along the normals of candidate bubbles.

An ellipse is looked at along ``RAYS`` normals, evenly spaced in the eccentric anomaly. Outwards is
where the image gets brighter: the rim of a backlit bubble is dark, what surrounds it is lit.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from telerig.arrays import Array, Bools, Float32, Ints
from telerig.estimator.bubbles.outline.ellipse_geometry import rough_distance

RAYS = 32
_STEPS, _LEAST_WINDOW_PX, _LEAST_BASE_PX = 21, 1.5, 0.6
_NEAR_SHARE, _NEAR_PX, _FARTHEST_PX, _BASE_PX = 0.05, 0.75, 2.0, 0.7
_DEPTH_SHARE, _DEPTH_PX, _DEEPEST_PX, _DEPTHS = 0.3, 2.0, 5.0, 4
_DIMMEST = 0.2
_HEART, _RING, _EVEN = (0.0, 0.15, 0.3), (0.45, 0.6, 0.7, 0.8, 0.9), 0.85
_OWN_SHARE, _OWN_PX, _NEAR_BY_PX = 0.12, 1.5, 4.0
_AT_ONCE = 256
"""Ellipses whose places are looked at together: their levels fit into a processor's cache."""


class Judged(NamedTuple):
    """Hold what the image shows along the rims of N ellipses.

    agreement : (N, RAYS) largest cosine of the angle between gradient and outward normal near the
        rim; small where the gradient is no larger than the noise; NaN beyond the image.
    places : (N, RAYS, 2) where that is (px).
    fall : (N, RAYS) how much darker it is within the rim than outside, as a share of the latter.
    inner, outer : (N,) median grey level within the rim and outside.
    slope : (N,) median of the steepest slope across the rim (1/px).
    depth : (N,) how much darker the ring is than what surrounds it, as a share of ``outer``.
    heart : (N,) how much brighter the middle is than the ring, as a share of ``outer``.
    unevenness : (N,) median departure of the ring's level from its median, as a share of what it is
        darker than ``outer``.
    """

    agreement: Array
    places: Array
    fall: Array
    inner: Array
    outer: Array
    slope: Array
    depth: Array
    heart: Array
    unevenness: Array


def _levels(image: Float32, places: Float32) -> Float32:
    """Return the grey levels (N, ...) at places (2, N, ...) (px), by bilinear interpolation; beyond
    the image those of its edge."""
    if not places.size:
        return np.empty(places.shape[1:], np.float32)
    u, v = places.reshape(2, len(places[0]), -1)
    found = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.float32).reshape(places.shape[1:])


def _normals(ellipse: Array) -> tuple[Float32, Float32]:
    """Return places (2, N, RAYS) on ellipses (N, 5) (px), and the outward unit normals there."""
    u, v, a, b, angle = ellipse.T[..., None]
    turn = 2.0 * np.pi * np.arange(RAYS) / RAYS
    cos, sin = np.cos(turn), np.sin(turn)
    turn_cos, turn_sin = np.cos(angle), np.sin(angle)
    speed = np.hypot(b * cos, a * sin) + 1e-12
    x, y = b * cos / speed, a * sin / speed
    places = [u + turn_cos * a * cos - turn_sin * b * sin]
    places += [v + turn_sin * a * cos + turn_cos * b * sin]
    normals = [turn_cos * x - turn_sin * y, turn_sin * x + turn_cos * y]
    return np.array(places, np.float32), np.array(normals, np.float32)


def closed_rims(
    image: Float32, ellipse: Array, window: float, floor: float, stiffness: float
) -> tuple[Array, Array]:
    """Find around each ellipse the closed path along which the image gets brighter outwards most.

    image : (rows, columns) grey levels.
    ellipse : (N, 5) centre u, v, semi-axes (px), angle (rad).
    window : how far from the ellipse the path may be, as a share of its radius; 1.5 px is used
        where this is less.
    floor : slope (1/px) that is noise.
    stiffness : what a step sideways costs, between 0 and 1.

    Along each ray the strength of a place is g / (g + g0 / 2 + floor), with g its slope and g0 the
    median over the rays of the steepest one; the path of the largest sum is found by dynamic
    programming over two turns, of which the inner half is kept, so that the path closes.

    Returns the path's points (N, RAYS, 2) in px, interpolated to the steepest place, and their
    strengths (N, RAYS).
    """
    some = range(0, max(len(ellipse), 1), _AT_ONCE)
    parts = [_closed(image, ellipse[k : k + _AT_ONCE], window, floor, stiffness) for k in some]
    points, strength = zip(*parts, strict=True)
    return np.concatenate(points), np.concatenate(strength)


def _closed(
    image: Float32, ellipse: Array, window: float, floor: float, stiffness: float
) -> tuple[Array, Array]:
    places, normals = _normals(ellipse)
    radius = np.sqrt(ellipse[:, 2:3] * ellipse[:, 3:4])
    reach: Float32 = np.maximum(window * radius, _LEAST_WINDOW_PX).astype(np.float32)
    step: Float32 = np.asarray(2.0 * reach / (_STEPS - 1), np.float32)
    base = np.maximum(step, np.float32(_LEAST_BASE_PX))
    away: Float32 = np.arange(_STEPS, dtype=np.float32) * step - reach
    far, near = (
        _levels(image, places[..., None] + normals[..., None] * at[:, None, :])
        for at in (away + base, away - base)
    )
    slope = np.maximum(far - near, 0.0) / (2.0 * base[..., None])
    half = 0.5 * np.median(slope.max(axis=2), axis=1) + np.float32(floor)
    strength = slope / (slope + half[:, None, None])
    chosen = _strongest_paths(strength, stiffness)
    before, here, after = (_at(slope, chosen + side) for side in (-1, 0, 1))
    bend = before - 2.0 * here + after
    peak = (chosen > 0) & (chosen < _STEPS - 1) & (bend < 0.0)
    shift = np.clip(0.5 * (before - after) / np.where(peak, bend, -1.0), -0.5, 0.5)
    offset = (chosen + np.where(peak, shift, 0.0)) * step - reach
    points = np.moveaxis(places + offset * normals, 0, -1)
    return points.astype(np.float64), _at(strength, chosen).astype(np.float64)


def _at(values: Float32, index: Ints) -> Float32:
    """Return the elements (N, RAYS) of (N, RAYS, n) at an index, the nearest one beyond the end."""
    near = np.clip(index, 0, values.shape[2] - 1)[..., None]
    return np.take_along_axis(values, near, axis=2)[..., 0]


def _strongest_paths(strength: Float32, stiffness: float) -> Ints:
    """Return the steps (N, RAYS) of closed paths of the largest sum of strengths (N, RAYS, n)."""
    many, _, steps = strength.shape
    total = np.full((many, steps + 2), -np.inf, np.float32)
    inside, outside = total[:, :-2], total[:, 2:]
    middle = total[:, 1:-1]
    middle[:] = 0.0
    moves = np.empty((2 * RAYS, many, steps), np.int8)
    for k in range(2 * RAYS):
        aside = np.maximum(inside, outside) - np.float32(stiffness)
        moves[k] = np.where(middle >= aside, 0, np.where(inside >= outside, -1, 1))
        middle[:] = np.maximum(middle, aside) + strength[:, k % RAYS]
    path, at = np.empty((2 * RAYS, many), np.int64), middle.argmax(axis=1)
    for k in range(2 * RAYS - 1, -1, -1):
        path[k] = at
        at = at + moves[k, np.arange(many), at]
    return np.roll(path[RAYS // 2 : RAYS // 2 + RAYS], RAYS // 2, axis=0).T


def judged(image: Float32, ellipse: Array, floor: float) -> Judged:
    """Measure what the image (rows, columns) shows along ellipses (N, 5), see `Judged`.

    floor : slope (1/px) that is noise.
    """
    some = range(0, max(len(ellipse), 1), _AT_ONCE)
    parts = [_judged(image, ellipse[k : k + _AT_ONCE], floor) for k in some]
    return Judged(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _judged(image: Float32, ellipse: Array, floor: float) -> tuple[Array, ...]:
    places, normals = _normals(ellipse)
    radius = np.sqrt(ellipse[:, 2] * ellipse[:, 3]).astype(np.float32)
    near = np.clip(_NEAR_SHARE * radius, _NEAR_PX, _FARTHEST_PX)[:, None, None]
    away = near * np.arange(-2, 3, dtype=np.float32) / 2.0
    around = places[..., None] + normals[..., None] * away
    du, dv = (
        (_levels(image, around + base) - _levels(image, around - base)) / (2.0 * _BASE_PX)
        for base in _BASE_PX * np.eye(2, dtype=np.float32)[:, :, None, None, None]
    )
    outwards = du * normals[0, ..., None] + dv * normals[1, ..., None]
    cosine = outwards / np.sqrt(du * du + dv * dv + np.float32(floor * floor))
    agreement = np.maximum(cosine.max(axis=2), 0.0)
    best = np.where(agreement > 0.0, _at(np.broadcast_to(away, cosine.shape), cosine.argmax(2)), 0)
    slope = np.median(np.maximum(outwards.max(axis=2), 0.0), axis=1)
    rows, columns = image.shape
    u, v = places
    seen = (u >= -0.5) & (v >= -0.5) & (u <= columns - 0.5) & (v <= rows - 0.5)
    depth = np.clip(_DEPTH_SHARE * radius, _DEPTH_PX, _DEEPEST_PX)[:, None, None]
    depths = normals[..., None] * (depth * np.arange(1, _DEPTHS + 1, dtype=np.float32) / _DEPTHS)
    beyond = _levels(image, places[..., None] + depths).max(axis=2)
    within = _levels(image, places[..., None] - depths).min(axis=2)
    fall = (beyond - within) / np.maximum(beyond, _DIMMEST)
    inner, outer = np.median(within, axis=1), np.median(beyond, axis=1)
    centre = ellipse[:, :2].T[:, :, None, None].astype(np.float32)
    shares = np.array([*_HEART, *_RING, _EVEN], np.float32)
    inside = _levels(image, centre + shares * (places[..., None] - centre))
    middle = np.median(inside, axis=1)
    brightest = middle[:, : len(_HEART)].max(axis=1)
    darkest = middle[:, len(_HEART) : -1].min(axis=1)
    fallen = np.maximum(outer - middle[:, -1], 0.1 * outer)
    uneven = np.median(np.abs(inside[..., -1] - middle[:, -1:]), axis=1) / fallen
    lit = np.maximum(outer, _DIMMEST)
    found = (
        np.where(seen, agreement, np.nan), np.moveaxis(places + best * normals, 0, -1), fall,
        inner, outer, slope, (outer - darkest) / lit, (brightest - darkest) / lit, uneven,
    )  # fmt: skip
    return tuple(values.astype(np.float64) for values in found)


def owners(order: Ints, ellipse: Array, places: Array, strong: Bools, least: Array) -> Bools:
    """Choose ellipses one after the other; a place at a rim belongs to the first that has it.

    order : (N,) the best first
    ellipse : (N, 5).
    places : (N, RAYS, 2) places at the rims (px)
    strong : (N, RAYS) where a rim is seen.
    least : (N,) number of places that have to be seen and to belong to no other.

    Returns (N,) which are chosen.
    """
    chosen, own = np.zeros(order.size, np.bool_), strong.copy()
    radius = np.sqrt(ellipse[:, 2] * ellipse[:, 3])
    order = order[strong.sum(axis=1)[order] >= least[order]]
    for rank, n in enumerate(order.tolist()):
        if own[n].sum() < least[n]:
            continue
        chosen[n] = True
        later = order[rank + 1 :]
        apart = np.linalg.norm(ellipse[later, :2] - ellipse[n, :2], axis=1)
        near = later[apart <= ellipse[later, 2] + ellipse[n, 2] + _NEAR_BY_PX]
        gap = np.abs(rough_distance(ellipse[n], places[near, :, 0], places[near, :, 1]))
        reach = np.maximum(_OWN_PX, _OWN_SHARE * np.minimum(radius[near], radius[n]))
        own[near] &= gap >= reach[:, None]
    return chosen
