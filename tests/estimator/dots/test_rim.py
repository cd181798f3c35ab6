"""Dots with rough printed edges, and compressed ones: their covariance is that of their errors."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from telerig.arrays import Array
from telerig.estimator.dots.locate import measure_dots

FINE = 8
"""Sub-pixels along u and v."""


def rough_plate(
    rough: float, correlation_rad: float, radius_px: float, seed: int
) -> tuple[Array, Array]:
    """Return a picture of 9 x 9 tilted dots and the centres (81, 2) of the circles drawn rough.

    rough : RMS of the edge's distance from the circle, relative to the radius; its correlation
        along the edge is Gaussian.
    """
    rng = np.random.default_rng(seed)
    matrix = radius_px * np.diag([1.0, 0.9])
    steps = np.stack(np.meshgrid(np.arange(9) - 4, np.arange(9) - 4), -1).reshape(-1, 2)
    size = int(34 * radius_px)
    centres = 3.2 * steps @ matrix + rng.uniform(-0.5, 0.5, (81, 2)) + size / 2
    k, phi = np.arange(60), np.linspace(0.0, 2 * np.pi, 720, endpoint=False)
    share = np.exp(-0.5 * (k * correlation_rad) ** 2) * np.where(k > 0, 2.0, 1.0)
    amplitude = rough * np.sqrt(share / share.sum())
    circle = np.stack([np.cos(phi), np.sin(phi)], -1)
    canvas = np.zeros((size * FINE, size * FINE), np.uint8)
    waves = np.cos(np.outer(phi, k)), np.sin(np.outer(phi, k))
    for centre in centres:
        a, b = amplitude * rng.standard_normal((2, 60))
        radius = 1.0 + waves[0] @ a + waves[1] @ b
        points = (centre + radius[:, None] * circle @ matrix + 0.5) * FINE - 0.5
        cv2.fillPoly(canvas, [np.rint(256 * points).astype(np.int32)], 255, shift=8)
    half = (size * FINE // 2, size * FINE // 2)
    covered = cv2.resize(canvas.astype(np.float32) / 255, half, interpolation=cv2.INTER_AREA)
    covered = gaussian_filter(covered, 0.8 * FINE / 2)
    grey = 40 + 160 * cv2.resize(covered, (size, size), interpolation=cv2.INTER_AREA)
    return np.clip(np.rint(grey + 2 * rng.standard_normal(grey.shape)), 0, 255).astype(
        np.uint8
    ), centres


def nees(dots: pd.DataFrame, centres: Array) -> float:
    """Return the mean squared error per coordinate by the stated covariance."""
    points = dots[["u_px", "v_px"]].to_numpy()
    error = points - centres[cKDTree(centres).query(points)[1]]
    parts = dots[["suu_px2", "suv_px2", "svv_px2"]].to_numpy()
    covariance = parts[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return float(np.mean(error[:, None] @ np.linalg.solve(covariance, error[:, :, None])) / 2)


@pytest.mark.parametrize(("rough", "correlation_rad"), [(0.02, 0.25), (0.03, 0.8), (0.1, 0.5)])
def test_rough_edges_are_in_the_covariance(rough: float, correlation_rad: float) -> None:
    found, squares = 0, []
    for seed in (1, 2):
        picture, centres = rough_plate(rough, correlation_rad, 8.0, seed)
        dots = measure_dots(picture).dots
        found += len(dots)
        squares.append(nees(dots, centres))
    assert found >= 0.97 * 2 * 81
    # 162 values of chi-square scatter by 8 %; ln of the extrapolated power by 0.2 an image.
    assert 0.5 < np.mean(squares) < 1.7


def test_the_share_of_the_edges_stands_apart_and_is_small_on_smooth_dots() -> None:
    picture, _ = rough_plate(0.03, 0.5, 8.0, 3)
    dots = measure_dots(picture).dots
    share = dots["edge_suu_px2"] / dots["suu_px2"]
    assert share.min() > 0.5
    assert share.max() < 1.0
    smooth, centres = rough_plate(0.0, 0.5, 8.0, 3)
    dots = measure_dots(smooth).dots
    assert (dots["edge_suu_px2"] / dots["suu_px2"]).max() < 0.3
    assert 0.7 < nees(dots, centres) < 1.7


def compressed(picture: Array) -> Array:
    return np.asarray(
        cv2.imdecode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 75])[1], 0)
    )


def brightened(picture: Array) -> Array:
    return np.rint(255.0 * (picture / 255.0) ** 0.45).astype(np.uint8)


@pytest.mark.parametrize("spoil", [compressed, brightened])
@pytest.mark.parametrize("radius_px", [3.5, 6.0])
def test_chi_square_is_split_into_what_moves_centres_and_what_does_not(
    spoil: Callable[[Array], Array], radius_px: float
) -> None:
    squares, chi2 = [], []
    for seed in (1, 2, 3):
        picture, centres = rough_plate(0.0, 0.5, radius_px, seed)
        dots = measure_dots(spoil(picture)).dots
        assert len(dots) == 81
        squares.append(nees(dots, centres))
        chi2.append(dots["chi2_dof"].median())
    assert spoil is brightened or np.mean(chi2) > 5.0
    # 243 pairs of squares scatter by 6 %; taking chi2_dof for the noise gives 0.3 to 0.6.
    assert 0.75 < np.mean(squares) < 1.4
