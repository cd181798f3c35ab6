"""Backlit bubbles drawn by supersampling: an authority that shares nothing with the fit.

Every pixel is split into FINE x FINE cells, each covered by as much of the ellipse as a straight
edge through it would; the fine picture is blurred by a Gaussian, then averaged over the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Array = NDArray[np.float64]
FINE = 8


@dataclass(frozen=True)
class Drawn:
    """One bubble: ellipse (u, v, a, b, angle), normal displacements {order: (cos, sin)} in px,
    level of its dark part, radius of its bright heart in units of b (0: none) and its level."""

    ellipse: tuple[float, float, float, float, float]
    harmonics: dict[int, tuple[float, float]] = field(default_factory=dict)
    level: float = 0.12
    heart: float = 0.0
    heart_level: float = 0.8


def fine_grid(shape: tuple[int, int]) -> tuple[Array, Array]:
    """Coordinates (rows, 1) and (1, columns) of the fine points; pixel centres are integers."""
    v = (np.arange(shape[0] * FINE) + 0.5) / FINE - 0.5
    u = (np.arange(shape[1] * FINE) + 0.5) / FINE - 0.5
    return v[:, None], u[None, :]


def _inside(bubble: Drawn, u: Array, v: Array) -> Array:
    """Share of each fine cell that lies inside the outline."""
    u0, v0, a, b, angle = bubble.ellipse
    x = (u - u0) * np.cos(angle) + (v - v0) * np.sin(angle)
    y = (v - v0) * np.cos(angle) - (u - u0) * np.sin(angle)
    if not bubble.harmonics:
        level = np.sqrt((x / a) ** 2 + (y / b) ** 2) + 1e-9
        slope = np.sqrt((x / a**2) ** 2 + (y / b**2) ** 2) / level + 1e-9
        return np.clip(0.5 - (level - 1.0) / slope * FINE, 0.0, 1.0)
    import matplotlib.path

    phi = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    speed = np.sqrt((a * np.sin(phi)) ** 2 + (b * np.cos(phi)) ** 2)
    bump = sum(c * np.cos(k * phi) + s * np.sin(k * phi) for k, (c, s) in bubble.harmonics.items())
    outline = np.stack(
        [
            a * np.cos(phi) + bump * b * np.cos(phi) / speed,
            b * np.sin(phi) + bump * a * np.sin(phi) / speed,
        ],
        axis=1,
    )
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    return matplotlib.path.Path(outline).contains_points(points).reshape(x.shape).astype(float)


def draw(
    bubbles: list[Drawn], shape: tuple[int, int], *, blur_px: float, heart_blur: float = 0.12
) -> Array:
    """Image (rows, columns) relative to the background (1): shadows lie over one another."""
    v, u = fine_grid(shape)
    fine = np.ones((v.size, u.size))
    for bubble in bubbles:
        u0, v0, a, b, _ = bubble.ellipse
        reach = 1.3 * a + 1.0
        rows = slice(*np.searchsorted(v[:, 0], [v0 - reach, v0 + reach]))
        columns = slice(*np.searchsorted(u[0], [u0 - reach, u0 + reach]))
        own_v, own_u = v[rows], u[:, columns]
        own: Array | float = bubble.level
        if bubble.heart:
            radius = np.hypot(own_u - u0, own_v - v0)
            light = 0.5 * (1.0 - np.tanh((radius - bubble.heart * b) / (heart_blur * b)))
            own = bubble.level + (bubble.heart_level - bubble.level) * light
        fine[rows, columns] *= 1.0 - _inside(bubble, own_u, own_v) * (1.0 - own)
    blurred = gaussian_filter(fine, blur_px * FINE, mode="nearest", truncate=5.0)
    image: Array = blurred.reshape(shape[0], FINE, shape[1], FINE).mean(axis=(1, 3))
    return image


def centre_bound_px(
    bubble: Drawn, shape: tuple[int, int], *, blur_px: float, sigma: float
) -> Array:
    """Cramer-Rao bound (2, 2) of the ellipse's centre for white noise ``sigma``.

    Unknown besides: both axes, angle, blur, both levels; the heart and what lies deeper than
    3 blurs or 3/4 of b is left out. Central differences of the drawn image.
    """
    plain = Drawn(bubble.ellipse, level=bubble.level)
    ellipse = np.array(bubble.ellipse)
    steps = np.array([0.25, 0.25, 0.25, 0.25, 0.25 / ellipse[2]])
    rows = []
    for index, step in enumerate(steps):
        change = np.zeros(5)
        change[index] = step
        plus, minus = (
            draw(
                [Drawn(tuple(ellipse + sign * change), level=bubble.level)], shape, blur_px=blur_px
            )
            for sign in (1.0, -1.0)
        )
        rows.append((plus - minus) / (2.0 * step))
    wide, narrow = (draw([plain], shape, blur_px=blur_px * f) for f in (1.05, 0.95))
    rows.append((wide - narrow) / (0.1 * blur_px))
    dark = (1.0 - draw([plain], shape, blur_px=blur_px)) / (1.0 - bubble.level)
    rows += [1.0 - dark, dark]
    if bubble.ellipse[2] == bubble.ellipse[3]:
        rows.pop(4)
    v, u = np.arange(shape[0])[:, None], np.arange(shape[1])[None, :]
    used = np.ones(shape, dtype=bool)
    if bubble.heart:
        radius = np.hypot(u - ellipse[0], v - ellipse[1])
        used = radius > (bubble.heart + 0.25) * ellipse[3]
    jacobian = np.stack([row[used] for row in rows])
    information = jacobian @ jacobian.T / sigma**2
    bound: Array = np.linalg.inv(information)[:2, :2]
    return bound
