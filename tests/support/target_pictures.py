"""The plate of the tests, and pictures of a target, drawn by supersampling."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from telerig.rig.target import Target

Array = NDArray[np.float64]

DESIGN = Target(
    rows=3,
    columns=5,
    pitch_mm=(7.0, 7.0),
    dot_diameter_mm=2.4,
    marks=((1, 2), (1, 3), (0, 2)),
    mark_diameter_mm=3.6,
)


def pixel_from_mm(scale: float, tilt_deg: float, roll_deg: float, mirrored: bool) -> Array:
    """(2, 2) affine part of a telecentric view."""
    r, t = np.deg2rad([roll_deg, tilt_deg])
    turn = np.array([[np.cos(r), -np.sin(r)], [np.sin(r), np.cos(r)]])
    return scale * np.diag([1.0, np.cos(t)]) @ turn @ np.diag([-1.0 if mirrored else 1.0, 1.0])


def draw(
    target: Target, affine: Array, size_px: int = 480, seed: int = 0
) -> tuple[NDArray[np.uint8], Array]:
    """An 8-bit image of the target, and the true centre (N, 2) of each dot, by supersampling."""
    ids = target.ids()
    xy = target.nominal_mm(ids)[:, :2]
    centres = xy @ affine.T + (size_px - 1) / 2 - affine @ xy.mean(0)
    radius, hole = target.diameter_mm(ids) / 2, np.zeros(len(ids))
    if target.mark_style == "ring":
        hole[target.is_mark(ids)] = target.dot_diameter_mm / 5
    if target.mark_style == "missing":
        radius[target.is_mark(ids)] = 0.0
    cover = np.zeros((size_px, size_px))
    for centre, large, small in zip(centres, radius, hole):
        reach = large * np.linalg.norm(affine, axis=1) + 1.0
        low = np.maximum(np.floor(centre - reach), 0).astype(int)
        high = np.minimum(np.ceil(centre + reach) + 1, size_px).astype(int)
        if (high <= low).any():  # outside the image
            continue
        steps = (low[k] + (np.arange(4 * (high[k] - low[k])) + 0.5) / 4 - 0.5 for k in (0, 1))
        places = (np.stack(np.meshgrid(*steps), -1) - centre) @ np.linalg.inv(affine).T
        away = np.linalg.norm(places, axis=-1)
        inside = (away < large) & (away >= small)
        rows, columns = high[1] - low[1], high[0] - low[0]
        part = inside.reshape(rows, 4, columns, 4).mean((1, 3))
        cover[low[1] : high[1], low[0] : high[0]] += part
    cover = gaussian_filter(cover, 0.8)
    if target.polarity == "black_on_white":
        cover = 1 - cover
    noise = np.random.default_rng(seed).normal(0, 1.5, cover.shape)
    return np.clip(30 + 180 * cover + noise, 0, 255).astype(np.uint8), centres
