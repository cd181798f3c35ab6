"""Ellipses and what their outlines do: nearest points, displacements, harmonics, for many at once.

An ellipse is a row (u, v, a, b, angle). Points belong to ellipses through an index array, so that
outlines of different length need no padding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from telerig.estimator.frontend.bubble_types import HARMONICS

Array = NDArray[np.float64]
Index = NDArray[np.intp]

ELLIPSE_PARAMETERS = 5
"""Displacements: centre along both axes, a, b, and the shear between the axes."""


@dataclass(frozen=True)
class Foot:
    """Nearest point of each point's ellipse: eccentric anomaly as (cos, sin), ``distance``
    outside the ellipse, ``speed`` |dp/dphi| and ``curvature`` there."""

    cos: Array
    sin: Array
    distance: Array
    speed: Array
    curvature: Array


def rough_distance(ellipse: Array, u: Array, v: Array) -> Array:
    """Distance of points outside ellipses (..., 5) by (g - 1) / |grad g|; broadcasts."""
    cos, sin = np.cos(ellipse[..., 4]), np.sin(ellipse[..., 4])
    a, b = ellipse[..., 2], ellipse[..., 3]
    du, dv = u - ellipse[..., 0], v - ellipse[..., 1]
    x, y = (du * cos + dv * sin) / a, (dv * cos - du * sin) / b
    level = np.sqrt(x * x + y * y) + 1e-12
    slope = np.sqrt((x / a) ** 2 + (y / b) ** 2) + 1e-12
    distance: Array = (level - 1.0) * level / slope
    return distance


def foot_points(ellipse: Array, owner: Index, u: Array, v: Array, *, rounds: int = 3) -> Foot:
    """Nearest points on the ellipses ``ellipse[owner]`` (N, 5) to points (u, v).

    Iteration by the evolute's centre of curvature: no trigonometry, three rounds are exact to
    1e-6 px near the outline of an ellipse of axis ratio 2.
    """
    per = np.stack(
        [ellipse[:, 0], ellipse[:, 1], ellipse[:, 2], ellipse[:, 3]]
        + [np.cos(ellipse[:, 4]), np.sin(ellipse[:, 4])]
    )
    u0, v0, a, b, turn_cos, turn_sin = per.take(owner, axis=1)
    du, dv = u - u0, v - v0
    x, y = du * turn_cos + dv * turn_sin, dv * turn_cos - du * turn_sin
    cos, sin = x / a, y / b
    norm = 1.0 / np.sqrt(cos * cos + sin * sin + 1e-18)
    cos, sin = cos * norm, sin * norm
    focal_a, focal_b = (a * a - b * b) / a, (a * a - b * b) / b
    for _ in range(rounds):
        evolute_x, evolute_y = focal_a * cos**3, -focal_b * sin**3
        radius = np.hypot(a * cos - evolute_x, b * sin - evolute_y)
        away_x, away_y = x - evolute_x, y - evolute_y
        scale = radius / (np.sqrt(away_x * away_x + away_y * away_y) + 1e-12)
        cos, sin = (away_x * scale + evolute_x) / a, (away_y * scale + evolute_y) / b
        norm = 1.0 / np.sqrt(cos * cos + sin * sin + 1e-18)
        cos, sin = cos * norm, sin * norm
    speed = np.sqrt((a * sin) ** 2 + (b * cos) ** 2)
    distance = ((x - a * cos) * b * cos + (y - b * sin) * a * sin) / speed
    return Foot(cos, sin, distance, speed, a * b / speed**3)


def ellipse_basis(ellipse: Array, owner: Index, foot: Foot) -> Array:
    """Outward displacement (5, N) of the outline by centre (along a, along b), a, b and shear."""
    a, b = ellipse[:, 2].take(owner), ellipse[:, 3].take(owner)
    normal_x, normal_y = b * foot.cos / foot.speed, a * foot.sin / foot.speed
    basis = np.empty((ELLIPSE_PARAMETERS, owner.size))
    basis[0], basis[1] = normal_x, normal_y
    basis[2], basis[3] = normal_x * foot.cos, normal_y * foot.sin
    basis[4] = normal_x * foot.sin + normal_y * foot.cos
    return basis


def harmonic_basis(cos: Array, sin: Array) -> Array:
    """(8, N): cos k phi, sin k phi for the orders in HARMONICS, from cos phi and sin phi."""
    basis = np.empty((2 * len(HARMONICS), cos.size))
    real, imaginary = cos, sin
    for order in range(2, HARMONICS[-1] + 1):
        real, imaginary = real * cos - imaginary * sin, real * sin + imaginary * cos
        if order >= HARMONICS[0]:
            basis[2 * (order - HARMONICS[0])] = real
            basis[2 * (order - HARMONICS[0]) + 1] = imaginary
    return basis


def moved(ellipse: Array, step: Array) -> tuple[Array, Array]:
    """Ellipses (B, 5) after displacements (B, 5), and how far their major axes turned (B,).

    a and b stay positive and a >= b.
    """
    cos, sin = np.cos(ellipse[:, 4]), np.sin(ellipse[:, 4])
    u = ellipse[:, 0] + cos * step[:, 0] - sin * step[:, 1]
    v = ellipse[:, 1] + sin * step[:, 0] + cos * step[:, 1]
    a, b = ellipse[:, 2] + step[:, 2], ellipse[:, 3] + step[:, 3]
    half_sum, half_gap = (a + b) / 2.0, (a - b) / 2.0
    spread = np.hypot(half_gap, step[:, 4])
    turn = 0.5 * np.arctan2(step[:, 4], half_gap)
    minor = np.maximum(half_sum - spread, 0.3)
    major = np.maximum(half_sum + spread, minor)
    return np.stack([u, v, major, minor, ellipse[:, 4] + turn], axis=1), turn


def turned_harmonics(harmonics: Array, turn: Array) -> Array:
    """Coefficients (B, 8) about axes that have turned by ``turn`` (B,)."""
    angle = turn[:, None] * np.array(HARMONICS)
    cos, sin = np.cos(angle), np.sin(angle)
    c, s = harmonics[:, 0::2], harmonics[:, 1::2]
    result = np.empty_like(harmonics)
    result[:, 0::2], result[:, 1::2] = c * cos + s * sin, s * cos - c * sin
    return result


def points_on(ellipse: Array, harmonics: Array, phi: Array) -> Array:
    """Outline points (B, n, 2) of ellipses (B, 5) with harmonics (B, 8) at anomalies (n,)."""
    cos, sin = np.cos(phi), np.sin(phi)
    a, b = ellipse[:, 2:3], ellipse[:, 3:4]
    speed = np.sqrt((a * sin) ** 2 + (b * cos) ** 2)
    bump = harmonics @ harmonic_basis(cos, sin)
    x = a * cos + bump * b * cos / speed
    y = b * sin + bump * a * sin / speed
    turn_cos, turn_sin = np.cos(ellipse[:, 4:5]), np.sin(ellipse[:, 4:5])
    u = ellipse[:, 0:1] + turn_cos * x - turn_sin * y
    v = ellipse[:, 1:2] + turn_sin * x + turn_cos * y
    return np.stack([u, v], axis=-1)
