"""Affine fits to the neighbours of a lattice place, and homographies."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

NEIGHBOURS: Ints = np.array(
    [(i, j) for i in range(-2, 3) for j in range(-2, 3) if (i, j) != (0, 0)], np.int64
)
"""(24, 2) steps to the places of the 5 x 5 window."""

_HOLD = 0.05
"""Weight of the neighbours' own pitch vectors, which decide where all places lie in one line."""


def fit_neighbours(
    at: Ints, values: Array, places: Ints, basis: Array, *, itself: bool = False
) -> tuple[Array, Array, Array]:
    """Weighted affine fit of the values at the occupied places round each of (C, 2) places.

    at : dot at each place or -1; values : (N, 2) per dot; basis : (N, 2, 2) pitch vectors per dot,
    towards which the fit is pulled weakly. itself : use the place's own dot too. Returns the value
    at the place (C, 2), the pitch vectors (C, 2, 2) and the variance of the value for dots of unit
    variance (C,).
    """
    steps = np.concatenate([NEIGHBOURS, [[0, 0]]]) if itself else NEIGHBOURS
    dots = at[places[:, :1] + steps[:, 0], places[:, 1:] + steps[:, 1]]
    there = (dots >= 0) / (0.5 + np.sum(steps**2, axis=1))
    design = np.column_stack([np.ones(len(steps)), steps])
    outer = np.einsum("ka,kb->kab", design, design).reshape(len(steps), 9)
    normal = (there @ outer).reshape(-1, 3, 3)
    total = np.maximum(there.sum(1), 1e-12)[:, None]
    mean_basis = np.einsum("ck,ckab->cab", there, basis[dots]) / total[..., None]
    right = np.einsum("ck,ka,ckx->cax", there, design, values[dots])
    hold = _HOLD * total[..., None]
    normal = normal + hold * np.diag([0.0, 1.0, 1.0]) + 1e-12 * np.eye(3)
    right[:, 1:] += hold * mean_basis
    solved = np.linalg.solve(normal, right)
    row = np.linalg.solve(normal, np.eye(3)[:, :1])[..., 0]
    spread = np.sum((there * (row @ design.T)) ** 2, axis=1)
    return solved[:, 0], solved[:, 1:], spread


def leave_one_out(at: Ints, residuals: Array, places: Ints) -> Array:
    """(C,) distance of each place's residual from its prediction by the neighbours' residuals, in
    units of a dot's standard deviation if that is 1."""
    flat = np.zeros((len(residuals), 2, 2))
    expected, _, spread = fit_neighbours(at, residuals, places, flat)
    own = residuals[at[tuple(places.T)]]
    return np.asarray(np.linalg.norm(own - expected, axis=1) / np.sqrt(1 + spread))


def fit_homography(source: ArrayLike, target: ArrayLike) -> Array:
    """(3, 3) homography, target ~ H source, of (N, 2) pairs; affine where that is all they tell."""
    import cv2

    homography, _ = cv2.findHomography(np.asarray(source, float), np.asarray(target, float))
    return fit_affine(source, target) if homography is None else np.asarray(homography)


def apply_homography(homography: Array, points: ArrayLike) -> Array:
    """(..., N, 2) images of (..., N, 2) points under (..., 3, 3) homographies."""
    p = np.asarray(points, float)
    h = homography
    mapped = p @ h[..., :2].mT + h[..., None, :, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])


def fit_affine(source: ArrayLike, target: ArrayLike) -> Array:
    """(3, 3) affine map of (N, 2) pairs by least squares, as a homography."""
    a, b = np.asarray(source, float), np.asarray(target, float)
    solved, *_ = np.linalg.lstsq(np.column_stack([a, np.ones(len(a))]), b, rcond=None)
    return np.vstack([solved.T, [0.0, 0.0, 1.0]])
