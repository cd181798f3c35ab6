"""Images of many bubbles that overlap, with their true ellipses, and scores of found ellipses."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from bubble_outline_renderer import Drawn, draw
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Array = NDArray[np.float64]
WHITE, SIDE = 3000.0, 384


def swarm(covered: float, hearts: bool, rng: np.random.Generator) -> tuple[NDArray[Any], Array]:
    """An image of 12 bits and the ellipses (N, 5) of its bubbles in focus."""
    bubbles: list[Drawn] = []
    hidden = np.zeros((SIDE, SIDE), np.uint8)
    while hidden.mean() < covered:
        radius = float(np.clip(np.exp(rng.normal(np.log(9.0), 0.45)), 4.5, 40.0))
        stretch = rng.uniform(1.0, 1.35) ** 0.5
        u, v = rng.uniform(-radius, SIDE + radius, 2)
        ellipse = (u, v, radius * stretch, radius / stretch, rng.uniform(0.0, np.pi))
        heart = rng.uniform(0.3, 0.6) if hearts else 0.0
        level, bright = rng.uniform(0.05, 0.25), rng.uniform(0.5, 0.95)
        bubbles.append(Drawn(ellipse, level=level, heart=heart, heart_level=bright))
        axes = (2 * ellipse[2], 2 * ellipse[3])
        cv2.ellipse(hidden, ((u, v), axes, np.rad2deg(ellipse[4])), 1, cv2.FILLED)
    blurred, area = [], 0.0
    while area < 0.3 * covered * SIDE**2:
        radius = float(np.exp(rng.normal(np.log(10.0), 0.5)))
        area += np.pi * radius**2
        place = rng.uniform(0, SIDE, 2)
        blurred.append(Drawn((*place, radius, radius, 0.0), level=rng.uniform(0.3, 0.7)))
    light = draw(bubbles, (SIDE, SIDE), blur_px=1.0)
    light = light * draw(blurred, (SIDE, SIDE), blur_px=rng.uniform(4.0, 6.0))
    v, u = np.mgrid[:SIDE, :SIDE] / SIDE
    light = light * (1.0 - 0.15 * (u - 0.4) ** 2 - 0.1 * (v - 0.6) ** 2)
    noise = 0.015 * np.sqrt(np.maximum(light, 0.05)) * rng.standard_normal(light.shape)
    image = np.clip(np.round(WHITE * (light + noise)), 0, 4095).astype(np.uint16)
    return image, np.array([bubble.ellipse for bubble in bubbles])


def paired(found: Array, truth: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """One-to-one pairs (rows of found, rows of truth)."""
    radius, own = (np.sqrt(e[:, 2] * e[:, 3]) for e in (truth, found))
    far = np.hypot(*(found[:, None, k] - truth[None, :, k] for k in (0, 1))) / radius
    cost = far + np.abs(np.log(own[:, None] / radius))
    allowed = (far < 0.25) & (np.abs(np.log(own[:, None] / radius)) < np.log(1.25))
    i, j = linear_sum_assignment(np.where(allowed, cost, 100.0))
    good = allowed[i, j]
    return i[good], j[good]


def whole(ellipses: Array) -> NDArray[np.bool_]:
    u, v, a, b, angle = ellipses.T
    wide = np.hypot(a * np.cos(angle), b * np.sin(angle))
    high = np.hypot(a * np.sin(angle), b * np.cos(angle))
    inside = (u > wide) & (v > high) & (u < SIDE - 1 - wide) & (v < SIDE - 1 - high)
    return inside & (2.0 * np.sqrt(a * b) >= 8.0)


def scored(found: Array, truth: Array) -> tuple[int, int, int, int]:
    """Truths that count, those found, found ones that are right, and wrong ones."""
    i, j = paired(found, truth)
    counts = whole(truth)
    wrong = whole(found)
    wrong[i] = False
    return int(counts.sum()), int(counts[j].sum()), len(i), int(wrong.sum())
