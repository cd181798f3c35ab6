"""The blurred ellipse against painted sub-pixels, differences, and plain geometry."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from telerig.estimator.dots.fit.blurred_ellipse import (
    approximate_distance_px,
    axes_from_shape,
    coverage_near_edge,
    coverage_on_grid,
    extent_px,
    foot_points,
    largest_curvature,
    shape_from_axes,
)
from telerig.estimator.dots.fit.luminance import EDGE_EXPANSION_LIMIT

Array = NDArray[np.float64]
K = 40  # sub-pixels per pixel


def painted(size: int, centre: Array, a: float, b: float, angle: float, blur: float) -> Array:
    """Ellipse on a fine grid, blurred there, averaged over pixels: no formula of ours."""
    pad = 7
    at = (np.arange((size + 2 * pad) * K) + 0.5) / K - 0.5 - pad
    x, y = np.meshgrid(at - centre[0], at - centre[1])
    p = (x * np.cos(angle) + y * np.sin(angle)) / a
    q = (y * np.cos(angle) - x * np.sin(angle)) / b
    square = p * p + q * q
    slope = 2.0 * np.hypot(p / a, q / b)
    image = np.clip(0.5 - (square - 1.0) / np.maximum(slope, 1e-9) * K, 0.0, 1.0)
    for axis in (0, 1):
        image = gaussian_filter1d(image, blur * K, axis=axis, truncate=5.5)
        count = image.shape[axis] // K
        image = np.moveaxis(image, axis, 0).reshape(count, K, -1).mean(axis=1)
        image = np.moveaxis(image, 0, axis)
    return image[pad:-pad, pad:-pad]


@pytest.mark.parametrize(
    ("a", "b", "angle", "blur"),
    [
        (2.5, 2.5, 0.0, 0.8),
        (4.0, 4.0, 0.3, 0.6),
        (4.0, 1.7, 0.5, 0.6),
        (4.0, 1.7, -1.1, 1.5),
        (7.0, 3.0, 2.0, 0.8),
    ],
)
def test_matches_painted_subpixels(a: float, b: float, angle: float, blur: float) -> None:
    size = int(2 * a + 12)
    centre = np.array([size / 2 + 0.23, size / 2 - 0.31])
    pixels = np.arange(size, dtype=float)
    sigma = np.sqrt(blur**2 + 1 / 12)
    coverage, _ = coverage_on_grid(pixels, pixels, centre, shape_from_axes(a, b, angle), sigma)
    truth = painted(size, centre, a, b, angle, blur)
    # The pixel box's sixth cumulant is left out: 1.5e-4 at 0.6 px of blur, nothing from 0.8 on.
    assert np.max(np.abs(coverage - truth)) < (2.5e-4 if blur < 0.7 else 1e-4)


@pytest.mark.parametrize("shape", [(4.0, 0.0, 4.0), (4.0, 1e-7, 4.0), (3.1, 1.0, 2.4), (9, -3, 6)])
@pytest.mark.parametrize("sigma", [0.5, 1.3])
def test_gradient_is_the_difference_quotient(shape: tuple[float, ...], sigma: float) -> None:
    pixels = np.arange(24, dtype=float)
    theta = np.array([11.7, 12.2, *shape, sigma])

    def value(x: Array) -> Array:
        return coverage_on_grid(pixels, pixels, x[:2], x[2:5], x[5])[0]

    _, gradient = coverage_on_grid(pixels, pixels, theta[:2], theta[2:5], theta[5])
    for i in range(6):
        step = 1e-5 * np.eye(6)[i]
        quotient = (value(theta + step) - value(theta - step)) / 2e-5
        np.testing.assert_allclose(gradient[i], quotient, atol=5e-5)


@pytest.mark.parametrize(
    ("a", "b", "angle", "sigma"), [(20, 20, 0.0, 1.0), (30, 20, 0.3, 1.0), (46, 43, -1.2, 2.3)]
)
def test_edge_expansion_agrees_with_the_exact_sum(
    a: float, b: float, angle: float, sigma: float
) -> None:
    shape = shape_from_axes(a, b, angle)
    assert largest_curvature(shape) * sigma < 0.08
    pixels = np.arange(2 * int(a) + 30, dtype=float)
    centre = np.array([a + 15.23, a + 14.6])
    exact, slopes = coverage_on_grid(pixels, pixels, centre, shape, sigma)
    u, v = np.meshgrid(pixels - centre[0], pixels - centre[1])
    band = np.abs(approximate_distance_px(shape, u, v)) < 5.0 * sigma
    coverage, gradient = coverage_near_edge(u[band], v[band], shape, sigma)
    assert np.max(np.abs(coverage - exact[band])) < 1e-4
    assert np.max(np.abs(gradient - slopes[:, band])) < 0.01 * np.max(np.abs(slopes))


@pytest.mark.parametrize(
    ("a", "b", "angle"), [(5.0, 4.0, 0.4), (8.0, 5.0, 0.0), (12.0, 6.0, 0.4), (20.0, 9.0, 1.1)]
)
def test_edge_expansion_at_its_limit_hardly_moves_a_dot(a: float, b: float, angle: float) -> None:
    shape, pixels = shape_from_axes(a, b, angle), np.arange(2 * int(a) + 20, dtype=float)
    sigma = 0.96 * EDGE_EXPANSION_LIMIT / float(largest_curvature(shape))
    centre = np.array([a + 10.23, a + 9.6])
    exact, slopes = coverage_on_grid(pixels, pixels, centre, shape, sigma)
    u, v = np.meshgrid(pixels - centre[0], pixels - centre[1])
    found, _ = coverage_near_edge(u.ravel(), v.ravel(), shape, sigma)
    error = found - exact.ravel()
    assert np.max(np.abs(error)) < 5.5e-4
    columns = np.vstack([slopes.reshape(6, -1), np.ones(error.size), exact.ravel()])
    moved = np.linalg.lstsq(columns.T, error, rcond=None)[0]
    assert np.linalg.norm(moved[:2]) < 2e-5


def test_foot_points_are_the_nearest_points() -> None:
    rng = np.random.default_rng(3)
    shape = shape_from_axes(30.0, 18.0, 0.8)
    t = np.linspace(0, 2 * np.pi, 20_001)[:-1]
    outline = np.stack(
        [shape[0] * np.cos(t) + shape[1] * np.sin(t), shape[1] * np.cos(t) + shape[2] * np.sin(t)]
    )
    away = 1.0 + rng.uniform(-0.15, 0.2, 60)
    points = outline[:, rng.integers(0, 20_000, 60)] * away
    nearest = np.min(np.hypot(*(points[:, :, None] - outline[:, None, :])), axis=1)
    c, s = foot_points(shape, points[0], points[1])
    gap = np.hypot(points[0] - shape[0] * c - shape[1] * s, points[1] - shape[1] * c - shape[2] * s)
    np.testing.assert_allclose(gap, nearest, atol=1e-3)


@pytest.mark.parametrize("batch", [(), (1,), (4, 3)])
def test_shape_and_axes_are_inverse(batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(5)
    b = rng.uniform(1, 5, batch)
    a, angle = b + rng.uniform(0.1, 5, batch), rng.uniform(-1.5, 1.5, batch)
    axes = axes_from_shape(shape_from_axes(a, b, angle))
    np.testing.assert_allclose(axes, np.stack([a, b, angle], axis=-1), atol=1e-12)


def test_angle_runs_from_u_towards_v_and_extent_encloses() -> None:
    shape = shape_from_axes(5.0, 2.0, np.deg2rad(30.0))
    tip = 5.0 * np.array([np.cos(np.deg2rad(30)), np.sin(np.deg2rad(30))])
    assert approximate_distance_px(shape, tip[0], tip[1]) == pytest.approx(0.0, abs=1e-9)
    assert approximate_distance_px(shape, tip[0], -tip[1]) > 0.5
    t = np.linspace(0, 2 * np.pi, 3601)
    u = shape[0] * np.cos(t) + shape[1] * np.sin(t)
    v = shape[1] * np.cos(t) + shape[2] * np.sin(t)
    np.testing.assert_allclose(extent_px(shape), [u.max(), v.max()], rtol=1e-6)
