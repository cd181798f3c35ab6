"""Outlines in an image: ellipses with harmonics along their normals.

An ellipse is a row of five numbers: centre u and v (px), semi-axes a >= b (px), and the angle from
+u to the major axis (rad, towards +v). The harmonics c_k, s_k (px) displace it along its normal, by
the sum of c_k cos(k phi) + s_k sin(k phi), with phi the eccentric anomaly.
"""

from __future__ import annotations

import numpy as np

from telerig.arrays import Array

HARMONICS = (3, 4, 5, 6)
"""Orders of an outline's displacement: 1 and 2 are the ellipse's own centre and axes."""


def waves(phi: Array, orders: tuple[int, ...] = HARMONICS) -> Array:
    """Return cos(k phi) and sin(k phi) (2 x orders, n) at angles phi (n,): cosine and sine of the
    first order, then those of the others."""
    return np.stack([wave(k * phi) for k in orders for wave in (np.cos, np.sin)])


def points_on(ellipse: Array, harmonics: Array, phi: Array) -> Array:
    """Return points on outlines.

    ellipse : (B, 5) ellipses.
    harmonics : (B, 8) coefficients (px), in the order of `waves`.
    phi : (n,) eccentric anomalies (rad).

    Returns (B, n, 2) pixels (u, v).
    """
    cos, sin = np.cos(phi), np.sin(phi)
    a, b = ellipse[:, 2:3], ellipse[:, 3:4]
    speed = np.sqrt((a * sin) ** 2 + (b * cos) ** 2)
    bump = harmonics @ waves(phi)
    x = a * cos + bump * b * cos / speed
    y = b * sin + bump * a * sin / speed
    turn_cos, turn_sin = np.cos(ellipse[:, 4:5]), np.sin(ellipse[:, 4:5])
    u = ellipse[:, 0:1] + turn_cos * x - turn_sin * y
    v = ellipse[:, 1:2] + turn_sin * x + turn_cos * y
    return np.stack([u, v], axis=-1)
