"""What an image shows along the normals of candidate bubbles.

An ellipse is looked at along ``RAYS`` normals, evenly spaced in the eccentric anomaly. Outwards is
where the image gets brighter: the rim of a backlit bubble is dark, what surrounds it is lit.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from telerig.arrays import Array, Bools, Float32, Ints
from telerig.compiled import compiled
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
    points, strength = np.empty((len(ellipse), RAYS, 2)), np.empty((len(ellipse), RAYS))
    reach = np.maximum(window * np.sqrt(ellipse[:, 2] * ellipse[:, 3]), _LEAST_WINDOW_PX)
    places, normals = (np.moveaxis(part, 0, -1).astype(np.float64) for part in _normals(ellipse))
    _closed(image, places, normals, reach, floor, stiffness, points, strength)
    return points, strength


@compiled
def _level(image: Float32, u: float, v: float) -> float:
    """Grey level at a place (px), by bilinear interpolation; beyond the image that of its edge."""
    rows, columns = image.shape
    u, v = min(max(u, 0.0), columns - 1.0), min(max(v, 0.0), rows - 1.0)
    column, row = min(int(u), columns - 2), min(int(v), rows - 2)
    x, y = u - column, v - row
    above = image[row, column] + x * (image[row, column + 1] - image[row, column])
    below = image[row + 1, column] + x * (image[row + 1, column + 1] - image[row + 1, column])
    return float(above + y * (below - above))


@compiled
def _closed(
    image: Float32, places: Array, normals: Array, reach: Array, floor: float, stiffness: float,
    points: Array, strengths: Array,
) -> None:  # fmt: skip
    """Write the points (N, RAYS, 2) and strengths (N, RAYS) of `closed_rims`.

    places, normals : (N, RAYS, 2) of the ellipses. reach : (N,) of the rays to both sides (px).
    """
    slope, strength = np.empty((RAYS, _STEPS)), np.empty((RAYS, _STEPS))
    steepest, moves = np.empty(RAYS), np.empty((2 * RAYS, _STEPS), np.int8)
    total, ahead = np.empty(_STEPS + 2), np.empty(_STEPS + 2)
    path = np.empty(2 * RAYS, np.int64)
    for n in range(reach.size):
        step = 2.0 * reach[n] / (_STEPS - 1)
        base = max(step, _LEAST_BASE_PX)
        for k in range(RAYS):
            steepest[k] = 0.0
            for i in range(_STEPS):
                far, near = i * step - reach[n] + base, i * step - reach[n] - base
                change = _level(
                    image, places[n, k, 0] + far * normals[n, k, 0],
                    places[n, k, 1] + far * normals[n, k, 1],
                ) - _level(
                    image, places[n, k, 0] + near * normals[n, k, 0],
                    places[n, k, 1] + near * normals[n, k, 1],
                )  # fmt: skip
                slope[k, i] = max(change, 0.0) / (2.0 * base)
                steepest[k] = max(steepest[k], slope[k, i])
        half = 0.5 * np.median(steepest) + floor
        for i in range(_STEPS + 2):
            total[i] = 0.0 if 0 < i <= _STEPS else -np.inf
            ahead[i] = -np.inf
        for k in range(2 * RAYS):
            for i in range(_STEPS):
                inside, outside = total[i], total[i + 2]
                aside = max(inside, outside) - stiffness
                if k < RAYS:
                    strength[k, i] = slope[k, i] / (slope[k, i] + half)
                moves[k, i] = 0
                if total[i + 1] < aside:
                    moves[k, i] = -1 if inside >= outside else 1
                ahead[i + 1] = max(total[i + 1], aside) + strength[k % RAYS, i]
            total, ahead = ahead, total
        at = int(np.argmax(total)) - 1
        for k in range(2 * RAYS - 1, -1, -1):
            path[k] = at
            at += moves[k, at]
        for k in range(RAYS):
            at = path[k + RAYS if k < RAYS // 2 else k]
            shift = 0.0
            if 0 < at < _STEPS - 1:
                before, after = slope[k, at - 1], slope[k, at + 1]
                bend = before - 2.0 * slope[k, at] + after
                if bend < 0.0:
                    shift = min(max(0.5 * (before - after) / bend, -0.5), 0.5)
            offset = (at + shift) * step - reach[n]
            points[n, k, 0] = places[n, k, 0] + offset * normals[n, k, 0]
            points[n, k, 1] = places[n, k, 1] + offset * normals[n, k, 1]
            strengths[n, k] = strength[k, at]


def _at(values: Float32, index: Ints) -> Float32:
    """Return the elements (N, RAYS) of (N, RAYS, n) at an index, the nearest one beyond the end."""
    near = np.clip(index, 0, values.shape[2] - 1)[..., None]
    return np.take_along_axis(values, near, axis=2)[..., 0]


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
