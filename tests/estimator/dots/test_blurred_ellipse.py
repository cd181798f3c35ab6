"""The blurred ellipse against painted sub-pixels, differences, and plain geometry."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from telerig.estimator.dots.fit.blurred_ellipse import (
    approximate_distance_px,
    axes_from_shape,
    coverage_on_grid,
    extent_px,
    shape_from_axes,
)

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
    on, beside = approximate_distance_px(shape, tip[[0, 0]], tip[[1, 1]] * [1.0, -1.0])
    assert on == pytest.approx(0.0, abs=1e-9)
    assert beside > 0.5
    t = np.linspace(0, 2 * np.pi, 3601)
    u = shape[0] * np.cos(t) + shape[1] * np.sin(t)
    v = shape[1] * np.cos(t) + shape[2] * np.sin(t)
    np.testing.assert_allclose(extent_px(shape), [u.max(), v.max()], rtol=1e-6)
