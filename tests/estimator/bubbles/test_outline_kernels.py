"""The compiled loops against NumPy, SciPy and brute force."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from bubble_outline_renderer import Drawn, draw
from numpy.typing import NDArray
from scipy.special import ndtr

from telerig import compiled
from telerig.estimator.bubbles.outline import kernels
from telerig.estimator.bubbles.outline.blobs import fit_ellipses
from telerig.estimator.bubbles.outline.outline_fit import (
    blurred_disc,
    fit_outlines,
    profile_table,
    start_outlines,
)


@pytest.mark.parametrize("many", [9, 17])
def test_products_keep_what_little_a_cut_bubble_tells(many: int) -> None:
    """Single precision gave a border bubble a variance of -139 px^2."""
    rng = np.random.default_rng(5)
    rows = rng.standard_normal((many, 1300))
    rows[1] = rows[0] + 1e-4 * rows[1]
    total = np.zeros((many, many))
    kernels.products(np.ascontiguousarray(rows[:, :1299]), total)
    exact = rows[:, :1299] @ rows[:, :1299].T
    lower = np.tril_indices(many)
    np.testing.assert_allclose(total[lower], exact[lower], rtol=0, atol=1e-12 * np.trace(exact))
    total[lower[::-1]] = total[lower]
    assert np.linalg.eigvalsh(total)[0] > 0


def test_feet_are_the_nearest_points() -> None:
    rng = np.random.default_rng(6)
    ellipse = np.array([3.0, -2.0, 20.0, 12.0, 0.7])
    phi = np.linspace(0.0, 2.0 * np.pi, 40_000, endpoint=False)
    x, y = 20.0 * np.cos(phi), 12.0 * np.sin(phi)
    cos, sin = np.cos(0.7), np.sin(0.7)
    u, v = 3.0 + x * cos - y * sin, -2.0 + x * sin + y * cos
    some = rng.integers(0, phi.size, 200)
    off = rng.uniform(0.9, 1.15, 200)
    points = np.stack([3.0 + off * (u[some] - 3.0), -2.0 + off * (v[some] + 2.0)])
    foot = np.empty((7, 200))
    kernels.feet(ellipse, points[0], points[1], foot)
    away = np.hypot(points[0][:, None] - u, points[1][:, None] - v)
    nearest = away.argmin(1)
    np.testing.assert_allclose(np.abs(foot[2]), away.min(1), atol=1e-3)
    assert np.array_equal(np.abs(foot[2]) < 1e-9, off == 1.0) and np.all((foot[2] > 0) == (off > 1))
    speed = np.hypot(20.0 * np.sin(phi), 12.0 * np.cos(phi))
    np.testing.assert_allclose(foot[3], speed[nearest], rtol=2e-3)
    np.testing.assert_allclose(foot[4], 20.0 * 12.0 / speed[nearest] ** 3, rtol=6e-3)


def test_the_centre_of_a_circle_has_a_foot() -> None:
    foot = np.empty((7, 1))
    kernels.feet(np.array([7.0, 8.0, 3.0, 3.0, 0.4]), np.array([7.0]), np.array([8.0]), foot)
    np.testing.assert_allclose(foot[2:5, 0], [-3.0, 3.0, 1 / 3], rtol=1e-6)


def profiles(distance: NDArray[np.float64], curvature: NDArray[np.float64]) -> NDArray[np.float64]:
    table = profile_table()
    return np.array([kernels.profile(table, d, c) for d, c in zip(distance, curvature)]).T


def test_profile_is_that_of_a_blurred_disc_and_survives_nan() -> None:
    rng = np.random.default_rng(7)
    distance, curvature = rng.uniform(-4.0, 4.0, 300), rng.uniform(0.02, 1.3, 300)
    value, by_distance, by_curvature = profiles(distance, curvature)
    np.testing.assert_allclose(value, blurred_disc(distance, 1.0 / curvature), atol=1e-3)
    step = 0.3
    ends = (blurred_disc(distance + d, 1.0 / curvature) for d in (step / 2, -step / 2))
    np.testing.assert_allclose(by_distance, np.subtract(*ends) / step, atol=0.02)
    straight = profiles(distance, np.zeros(300))[0]
    np.testing.assert_allclose(straight, ndtr(-distance), atol=1e-4)
    assert np.isfinite(by_curvature).all()
    assert len(kernels.profile(profile_table(), np.nan, np.nan)) == 3


def test_impossible_starts_end_without_a_covariance() -> None:
    starts = np.array(
        [[np.nan] * 5, [50.0, 50, 1e9, 1e-3, 0], [1e15, 0, 5, 5, 0], [50, 50, 9, 8, 0]]
    )
    start = start_outlines(starts, np.array([1.0, 1, 1, np.nan]), np.ones(4))
    found = fit_outlines(np.ones((100, 100), np.float32), start, np.ones(2))
    assert not found.coverage[[0, 2, 3]].any()
    assert not found.covariance_px2[[0, 3]].any()


def test_a_cut_outline_whose_residuals_are_large_states_its_error() -> None:
    """With residuals of twice the stated noise the standard deviation was 100,000 px."""
    truth, noise, squares, stated = (34.0, 13.0, 26.0, 24.0, 0.3), 0.03, [], []
    image = draw([Drawn(truth, heart=0.0)], (80, 80), blur_px=1.2)
    for seed in range(12):
        soiled = image + noise * np.random.default_rng(seed).standard_normal(image.shape)
        start = start_outlines(np.array([truth]), np.ones(1), np.full(1, 0.1))
        found = fit_outlines(soiled.astype(np.float32), start, np.full(2, noise / 2))
        assert found.coverage[0] < 0.9 and found.chi2_dof[0] > 3.0
        squares.append(np.square(found.ellipse[0, :2] - truth[:2]).sum())
        stated.append(np.trace(found.covariance_px2[0]))
    assert 0.3 < np.mean(stated) / np.mean(squares) < 6.0


def test_ellipses_along_arcs_are_found_again() -> None:
    phi = np.linspace(0.3, 3.4, 90)
    x, y = 30.0 * np.cos(phi), 26.0 * np.sin(phi)
    one = np.stack(
        [100.0 + x * np.cos(0.4) - y * np.sin(0.4), 50.0 + x * np.sin(0.4) + y * np.cos(0.4)], 1
    )
    other = np.stack([5.0 + 8.0 * np.cos(phi), 9.0 + 8.0 * np.sin(phi)], 1)
    ellipses, rms = fit_ellipses([one, other])
    np.testing.assert_allclose(ellipses[0, :4], [100.0, 50.0, 30.0, 26.0], atol=0.1)
    np.testing.assert_allclose(ellipses[1, :4], [5.0, 9.0, 8.0, 8.0], atol=1e-3)
    assert rms.max() < 0.02


def test_compiled_works_without_a_folder_for_the_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    def njit(cache: bool = False, **options: object) -> object:
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return numba.njit(**options)

    monkeypatch.setattr(compiled, "njit", njit)

    def twice(value: float) -> float:
        return 2.0 * value

    assert compiled.compiled(twice)(1.5) == 3.0
