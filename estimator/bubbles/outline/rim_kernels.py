"""Compiled loops along the rims of candidate bubbles.

An ellipse is looked at along ``RAYS`` normals, evenly spaced in the eccentric anomaly. Outwards is
where the image gets brighter: the rim of a backlit bubble is dark, what surrounds it is lit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from telerig.arrays import Array, Bools, Float32, Ints
from telerig.compiled import compiled

RAYS = 32
_STEPS, _LEAST_WINDOW_PX, _LEAST_BASE_PX = 21, 1.5, 0.6
_NEAR_SHARE, _NEAR_PX, _FARTHEST_PX, _BASE_PX = 0.05, 0.75, 2.0, 0.7
_DEPTH_SHARE, _DEPTH_PX, _DEEPEST_PX, _DEPTHS = 0.3, 2.0, 5.0, 4
_DIMMEST = 0.2
_HEART, _RING, _EVEN = (0.0, 0.15, 0.3), (0.45, 0.6, 0.7, 0.8, 0.9), 0.85
_OWN_SHARE, _OWN_PX, _NEAR_BY_PX = 0.12, 1.5, 4.0


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


@compiled
def _level(image: Float32, u: float, v: float) -> float:
    """Interpolate the grey level bilinearly; beyond the image it is that of the edge."""
    rows, columns = image.shape
    u, v = min(max(u, 0.0), columns - 1.001), min(max(v, 0.0), rows - 1.001)
    row, column = int(v), int(u)
    du, dv = u - column, v - row
    above = (1.0 - du) * image[row, column] + du * image[row, column + 1]
    below = (1.0 - du) * image[row + 1, column] + du * image[row + 1, column + 1]
    return float((1.0 - dv) * above + dv * below)


@compiled
def _normals(ellipse: Array, out: Array) -> None:
    """Write into ``out`` (RAYS, 4) places on the ellipse (px) and the outward unit normals."""
    u, v, a, b, angle = ellipse[0], ellipse[1], ellipse[2], ellipse[3], ellipse[4]
    turn_cos, turn_sin = np.cos(angle), np.sin(angle)
    for k in range(RAYS):
        cos, sin = np.cos(2.0 * np.pi * k / RAYS), np.sin(2.0 * np.pi * k / RAYS)
        speed = np.sqrt(b * cos * b * cos + a * sin * a * sin) + 1e-12
        x, y = b * cos / speed, a * sin / speed
        out[k, 0] = u + turn_cos * a * cos - turn_sin * b * sin
        out[k, 1] = v + turn_sin * a * cos + turn_cos * b * sin
        out[k, 2], out[k, 3] = turn_cos * x - turn_sin * y, turn_sin * x + turn_cos * y


@compiled
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
    many = ellipse.shape[0]
    points, found = np.empty((many, RAYS, 2)), np.empty((many, RAYS))
    slope, strength = np.empty((RAYS, _STEPS)), np.empty((RAYS, _STEPS))
    total, back = (
        np.empty((2 * RAYS + 1, _STEPS)),
        np.empty((2 * RAYS + 1, _STEPS), dtype=np.int64),
    )
    ray, steepest = np.empty((RAYS, 4)), np.empty(RAYS)
    path = np.empty(2 * RAYS, dtype=np.int64)
    for n in range(many):
        _normals(ellipse[n], ray)
        reach = max(window * np.sqrt(ellipse[n, 2] * ellipse[n, 3]), _LEAST_WINDOW_PX)
        step = 2.0 * reach / (_STEPS - 1)
        base = max(step, _LEAST_BASE_PX)
        for k in range(RAYS):
            u, v, normal_u, normal_v = ray[k]
            steepest[k] = 0.0
            for i in range(_STEPS):
                far, near = i * step - reach + base, i * step - reach - base
                rise = _level(image, u + far * normal_u, v + far * normal_v)
                rise -= _level(image, u + near * normal_u, v + near * normal_v)
                slope[k, i] = max(rise / (2.0 * base), 0.0)
                steepest[k] = max(steepest[k], slope[k, i])
        half = 0.5 * np.median(steepest) + floor
        for k in range(RAYS):
            for i in range(_STEPS):
                strength[k, i] = slope[k, i] / (slope[k, i] + half)
        total[0] = 0.0
        for k in range(2 * RAYS):
            for i in range(_STEPS):
                best, place = total[k, i], i
                if i > 0 and total[k, i - 1] - stiffness > best:
                    best, place = total[k, i - 1] - stiffness, i - 1
                if i < _STEPS - 1 and total[k, i + 1] - stiffness > best:
                    best, place = total[k, i + 1] - stiffness, i + 1
                total[k + 1, i], back[k + 1, i] = best + strength[k % RAYS, i], place
        i = int(np.argmax(total[2 * RAYS]))
        for k in range(2 * RAYS, 0, -1):
            path[k - 1] = i
            i = back[k, i]
        for turn in range(RAYS // 2, RAYS // 2 + RAYS):
            k, i = turn % RAYS, path[turn]
            away = i * step - reach
            if 0 < i < _STEPS - 1:
                bend = slope[k, i - 1] - 2.0 * slope[k, i] + slope[k, i + 1]
                if bend < 0.0:
                    shift = 0.5 * (slope[k, i - 1] - slope[k, i + 1]) / bend
                    away += step * min(max(shift, -0.5), 0.5)
            points[n, k, 0] = ray[k, 0] + away * ray[k, 2]
            points[n, k, 1] = ray[k, 1] + away * ray[k, 3]
            found[n, k] = strength[k, i]
    return points, found


@compiled
def judged(image: Float32, ellipse: Array, floor: float) -> Judged:
    """Measure what the image (rows, columns) shows along ellipses (N, 5), see `Judged`.

    floor : slope (1/px) that is noise.
    """
    many = ellipse.shape[0]
    agreement, fall = np.empty((many, RAYS)), np.empty((many, RAYS))
    places, levels = np.empty((many, RAYS, 2)), np.empty((6, many))
    ray, within, beyond = np.empty((RAYS, 4)), np.empty(RAYS), np.empty(RAYS)
    steep, around = np.empty(RAYS), np.empty(RAYS)
    for n in range(many):
        _normals(ellipse[n], ray)
        u0, v0 = ellipse[n, 0], ellipse[n, 1]
        radius = np.sqrt(ellipse[n, 2] * ellipse[n, 3])
        near = min(max(_NEAR_SHARE * radius, _NEAR_PX), _FARTHEST_PX)
        depth = min(max(_DEPTH_SHARE * radius, _DEPTH_PX), _DEEPEST_PX) / _DEPTHS
        for k in range(RAYS):
            u, v, normal_u, normal_v = ray[k]
            best, place, steep[k] = 0.0, 0.0, 0.0
            for i in range(-2, 3):
                away = i * near / 2.0
                x, y = u + away * normal_u, v + away * normal_v
                du = _level(image, x + _BASE_PX, y) - _level(image, x - _BASE_PX, y)
                dv = _level(image, x, y + _BASE_PX) - _level(image, x, y - _BASE_PX)
                du, dv = du / (2.0 * _BASE_PX), dv / (2.0 * _BASE_PX)
                outwards = du * normal_u + dv * normal_v
                cosine = outwards / np.sqrt(du * du + dv * dv + floor * floor)
                if cosine > best:
                    best, place = cosine, away
                steep[k] = max(steep[k], outwards)
            seen = -0.5 <= u <= image.shape[1] - 0.5 and -0.5 <= v <= image.shape[0] - 0.5
            agreement[n, k] = best if seen else np.nan
            places[n, k, 0], places[n, k, 1] = u + place * normal_u, v + place * normal_v
            within[k], beyond[k] = 1e9, 0.0
            for i in range(1, _DEPTHS + 1):
                away = i * depth
                outside = _level(image, u + away * normal_u, v + away * normal_v)
                inside = _level(image, u - away * normal_u, v - away * normal_v)
                beyond[k], within[k] = max(beyond[k], outside), min(within[k], inside)
            fall[n, k] = (beyond[k] - within[k]) / max(beyond[k], _DIMMEST)
        brightest, darkest = -1e9, 1e9
        for share in _HEART:
            for k in range(RAYS):
                u, v = u0 + share * (ray[k, 0] - u0), v0 + share * (ray[k, 1] - v0)
                around[k] = _level(image, u, v)
            brightest = max(brightest, np.median(around))
        for share in _RING:
            for k in range(RAYS):
                u, v = u0 + share * (ray[k, 0] - u0), v0 + share * (ray[k, 1] - v0)
                around[k] = _level(image, u, v)
            darkest = min(darkest, np.median(around))
        levels[0, n], levels[1, n] = np.median(within), np.median(beyond)
        levels[2, n] = np.median(steep)
        levels[3, n] = (levels[1, n] - darkest) / max(levels[1, n], _DIMMEST)
        levels[4, n] = (brightest - darkest) / max(levels[1, n], _DIMMEST)
        for k in range(RAYS):
            u, v = u0 + _EVEN * (ray[k, 0] - u0), v0 + _EVEN * (ray[k, 1] - v0)
            around[k] = _level(image, u, v)
        middle = np.median(around)
        fallen = max(levels[1, n] - middle, 0.1 * levels[1, n])
        levels[5, n] = np.median(np.abs(around - middle)) / fallen
    return Judged(
        agreement, places, fall, levels[0], levels[1], levels[2], levels[3], levels[4], levels[5]
    )


@compiled
def owners(order: Ints, ellipse: Array, places: Array, strong: Bools, least: Array) -> Bools:
    """Choose ellipses one after the other; a place at a rim belongs to the first that has it.

    order : (N,) the best first
    ellipse : (N, 5).
    places : (N, RAYS, 2) places at the rims (px)
    strong : (N, RAYS) where a rim is seen.
    least : (N,) number of places that have to be seen and to belong to no other.

    Returns (N,) which are chosen.
    """
    chosen = np.zeros(order.size, dtype=np.bool_)
    before, many = np.empty(order.size, dtype=np.int64), 0
    for n in order:
        own = strong[n].copy()
        if np.sum(own) < least[n]:
            continue
        radius = np.sqrt(ellipse[n, 2] * ellipse[n, 3])
        for i in range(many):
            other = ellipse[before[i]]
            du, dv = ellipse[n, 0] - other[0], ellipse[n, 1] - other[1]
            if np.sqrt(du * du + dv * dv) > ellipse[n, 2] + other[2] + _NEAR_BY_PX:
                continue
            smaller = min(radius, np.sqrt(other[2] * other[3]))
            reach = max(_OWN_PX, _OWN_SHARE * smaller)
            cos, sin = np.cos(other[4]), np.sin(other[4])
            for k in range(RAYS):
                if own[k]:
                    du, dv = places[n, k, 0] - other[0], places[n, k, 1] - other[1]
                    x, y = (du * cos + dv * sin) / other[2], (dv * cos - du * sin) / other[3]
                    far = np.sqrt(x * x + y * y) + 1e-12
                    slope = np.sqrt((x / other[2]) ** 2 + (y / other[3]) ** 2) + 1e-12
                    own[k] = abs(far - 1.0) * far / slope >= reach
        if np.sum(own) >= least[n]:
            chosen[n] = True
            before[many] = n
            many += 1
    return chosen
