"""Pictures of a target, drawn by supersampling."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from telerig.rig.target import Target

Array = NDArray[np.float64]


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
    offset = (size_px - 1) / 2 - affine @ xy.mean(0)
    step = (np.arange(size_px * 4) + 0.5) / 4 - 0.5
    uv = np.stack(np.meshgrid(step, step), -1)
    places = (uv - offset) @ np.linalg.inv(affine).T
    if target.layout == "points":
        nearest = cKDTree(xy).query(places)[1]
    else:
        column = np.clip(np.round(places[..., 0] / target.pitch_mm[0]), 0, target.columns - 1)
        row = np.clip(np.round(places[..., 1] / target.pitch_mm[1]), 0, target.rows - 1)
        nearest = (row * target.columns + column).astype(int)
    away = np.linalg.norm(places - target.nominal_mm(nearest)[..., :2], axis=-1)
    inside = away < target.diameter_mm(nearest) / 2
    if target.mark_style == "ring":
        inside &= ~(target.is_mark(nearest) & (away < target.dot_diameter_mm / 5))
    if target.mark_style == "missing":
        inside &= ~target.is_mark(nearest)
    cover = gaussian_filter(inside.reshape(size_px, 4, size_px, 4).mean((1, 3)), 0.8)
    if target.polarity == "black_on_white":
        cover = 1 - cover
    noise = np.random.default_rng(seed).normal(0, 1.5, cover.shape)
    return np.clip(30 + 180 * cover + noise, 0, 255).astype(np.uint8), xy @ affine.T + offset
