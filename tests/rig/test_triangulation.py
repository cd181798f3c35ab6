"""Triangulation against brute force, SciPy and Monte-Carlo."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize

from telerig.errors import GeometryError, InputError
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose
from telerig.rig.triangulation import (
    midpoint,
    on_rays,
    stacked_jacobian,
    triangulate,
    triangulate_views,
)

LENSES: dict[str, tuple[dict[str, float], dict[str, float]]] = {
    "ideal": ({}, {}),
    "distorted": ({"k1": 0.01, "p1": 1e-3}, {"k1": -0.02, "s1": 2e-3}),
    "near_telecentric": ({"kappa_per_mm": 1e-4, "k1": 0.01}, {"kappa_per_mm": -5e-5}),
    "perspective": ({"kappa_per_mm": 1 / 400, "k1": 0.01}, {"kappa_per_mm": 1 / 300, "k1": 0.02}),
    "tilted": (
        {"tilt_x": 0.1, "tilt_y": -0.05, "image_convergence_per_mm": 1 / 600},
        {"tilt_x": 0.1, "aspect": 1.01, "skew": 0.01},
    ),
}
SIGMA = np.array([[[0.04, 0.01], [0.01, 0.09]], [[0.0225, 0.0], [0.0, 0.01]]])
"""Unlike in both cameras and along both axes, so that a mixed-up weight shows."""


def rig(kind: str = "ideal", angle_rad: float = 1.2, gap_mm: float = 0.4) -> tuple[Camera, Camera]:
    first, second = LENSES[kind]
    pose = Pose.from_rotvec([0.05, angle_rad, -0.1], [0.2, gap_mm, 0.3])
    return (
        Camera.create("left", (512, 480), 10.0, **first),
        Camera.create("right", (512, 480), 11.0, camera_from_rig=pose, **second),
    )


def points(count: int, seed: int = 0) -> Any:
    return np.random.default_rng(seed).uniform(-12, 12, (count, 3))


def noisy(cameras: tuple[Camera, Camera], count: int, seed: int = 1) -> Any:
    rng = np.random.default_rng(seed)
    factors = np.linalg.cholesky(SIGMA)
    return [
        camera.project(points(count)) + rng.standard_normal((count, 2)) @ factor.T
        for camera, factor in zip(cameras, factors)
    ]


def sigmas(count: int) -> Any:
    return tuple(np.broadcast_to(s, (count, 2, 2)) for s in SIGMA)


@pytest.mark.parametrize("kind", LENSES)
@pytest.mark.parametrize("method", ["ml", "midpoint"])
def test_exact_pixels_give_the_points_back(kind: str, method: str) -> None:
    cameras, truth = rig(kind), points(50)
    found = triangulate(cameras, tuple(c.project(truth) for c in cameras), 0.1, method)
    np.testing.assert_allclose(found.points_mm, truth, atol=1e-9)
    np.testing.assert_allclose(found.ray_miss_mm, 0, atol=1e-9)


@pytest.mark.parametrize("kind", LENSES)
def test_ml_is_the_minimum_that_scipy_finds(kind: str) -> None:
    cameras = rig(kind)
    pixels = noisy(cameras, 8)
    found = triangulate(cameras, tuple(pixels), sigmas(8))
    whiten = [np.linalg.inv(np.linalg.cholesky(s)) for s in SIGMA]
    for i in range(8):

        def residual(x: Any, i: int = i) -> Any:
            gaps = [w @ (c.project(x) - uv[i]) for c, uv, w in zip(cameras, pixels, whiten)]
            return np.concatenate(gaps)

        fit = least_squares(
            residual, np.zeros(3), xtol=1e-15, ftol=1e-15, gtol=1e-15, jac="3-point"
        )
        np.testing.assert_allclose(found.points_mm[i], fit.x, atol=1e-6)
        expected = np.linalg.inv(fit.jac.T @ fit.jac)
        np.testing.assert_allclose(found.covariance_mm2[i], expected, rtol=1e-5, atol=1e-9)


def test_midpoint_is_the_point_nearest_to_both_rays() -> None:
    rng = np.random.default_rng(2)
    for _ in range(2):
        a, b, da, db = rng.normal(0, 5, (4, 3))
        da, db = da / np.linalg.norm(da), db / np.linalg.norm(db)

        def total(x: Any, a: Any = a, b: Any = b, da: Any = da, db: Any = db) -> float:
            return float((np.cross(x - a, da) ** 2).sum() + (np.cross(x - b, db) ** 2).sum())

        middle, miss = midpoint(a, da, b, db)
        brute = minimize(total, np.zeros(3), tol=1e-14, method="Nelder-Mead",
                         options={"xatol": 1e-10, "fatol": 1e-14, "maxiter": 4000})  # fmt: skip
        np.testing.assert_allclose(middle, brute.x, atol=1e-6)
        assert abs(miss) == pytest.approx(np.sqrt(2 * total(middle)), rel=1e-9)


@pytest.mark.parametrize("unit", [1.0, 3.0])
def test_midpoint_does_not_mind_the_length_of_directions(unit: float) -> None:
    middle, miss = midpoint(
        np.array([0.0, 0.0, -5.0]), unit * np.array([0.0, 0.0, 1.0]),
        np.array([7.0, 0.5, 0.0]), unit * np.array([-1.0, 0.0, 0.0]),
    )  # fmt: skip
    np.testing.assert_allclose(middle, [0, 0.25, 0], atol=1e-12)
    # first direction x second = z x (-x) = -y; the second ray lies 0.5 towards +y
    assert miss == pytest.approx(-0.5)


def test_ray_miss_in_hand_made_numbers() -> None:
    """Axes cross at right angles; 3 px of v in the second camera are 0.3 mm, downwards (+y)."""
    pose = Pose.from_rotvec([0.0, np.pi / 2, 0.0])
    cameras = (
        Camera.create("left", (512, 512), 10.0),
        Camera.create("right", (512, 512), 10.0, camera_from_rig=pose),
    )
    centre = np.array([255.5, 255.5])
    found = triangulate(cameras, (centre, centre + [0, 3.0]), 0.1)
    # second camera's axis in the rig: third row of its rotation = (-1, 0, 0); z x (-x) = -y
    np.testing.assert_allclose(pose.rotation[2], [-1, 0, 0], atol=1e-12)
    assert found.ray_miss_mm == pytest.approx(-0.3)
    np.testing.assert_allclose(found.points_mm, [0, 0.15, 0], atol=1e-12)
    swapped = triangulate(cameras, (centre + [0, 3.0], centre), 0.1)
    assert swapped.ray_miss_mm == pytest.approx(0.3)


@pytest.mark.parametrize("kind", ["distorted", "perspective"])
@pytest.mark.parametrize("method", ["ml", "midpoint"])
def test_covariance_is_the_monte_carlo_spread(kind: str, method: str) -> None:
    cameras = rig(kind)
    truth, count, rng = np.array([4.0, -6.0, 8.0]), 20_000, np.random.default_rng(3)
    factors = np.linalg.cholesky(0.01 * SIGMA)
    pixels = tuple(
        c.project(truth) + rng.standard_normal((count, 2)) @ f.T for c, f in zip(cameras, factors)
    )
    found = triangulate(cameras, pixels, tuple(0.1**2 * s for s in sigmas(count)), method)
    spread = np.cov(found.points_mm.T)
    whiten = np.linalg.inv(np.linalg.cholesky(found.covariance_mm2.mean(0)))
    np.testing.assert_allclose(whiten @ spread @ whiten.T, np.eye(3), atol=0.05)
    np.testing.assert_allclose(found.points_mm.mean(0), truth, atol=5 * spread.max() ** 0.5 / 140)


def test_ml_is_never_worse_than_the_midpoint() -> None:
    cameras = rig("distorted")
    pixels = tuple(noisy(cameras, 500))
    best = triangulate(cameras, pixels, sigmas(500))
    middle = triangulate(cameras, pixels, sigmas(500), "midpoint")
    gain = np.trace(middle.covariance_mm2 - best.covariance_mm2, axis1=1, axis2=2)
    assert gain.min() > -1e-12
    assert gain.max() > 0


SHAPES: list[tuple[int, ...]] = [(), (1,), (3, 5)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("method", ["ml", "midpoint"])
def test_leading_axes(shape: tuple[int, ...], method: str) -> None:
    cameras = rig("near_telecentric")
    truth = np.random.default_rng(4).uniform(-5, 5, (*shape, 3))
    found = triangulate(cameras, tuple(c.project(truth) for c in cameras), 0.02, method)
    np.testing.assert_allclose(found.points_mm, truth, atol=1e-9)
    assert found.covariance_mm2.shape == (*shape, 3, 3)
    assert found.ray_miss_mm.shape == shape


def test_sigma_as_scalar_array_and_covariance_agree() -> None:
    cameras = rig()
    pixels = tuple(noisy(cameras, 6))
    forms: list[Callable[[], Any]] = [
        lambda: 0.2,
        lambda: np.full(6, 0.2),
        lambda: np.tile(0.04 * np.eye(2), (6, 1, 1)),
        lambda: (0.2, np.full(6, 0.2)),
    ]
    reference = triangulate(cameras, pixels, 0.2)
    for form in forms:
        found = triangulate(cameras, pixels, form())
        np.testing.assert_allclose(found.points_mm, reference.points_mm, atol=1e-12)
        np.testing.assert_allclose(found.covariance_mm2, reference.covariance_mm2)


def test_many_points_at_once() -> None:
    cameras, truth = rig("distorted"), points(100_000)
    pixels = tuple(c.project(truth) for c in cameras)
    start = time.process_time()
    found = triangulate(cameras, pixels, 0.02)
    assert time.process_time() - start < 2.0
    assert np.abs(found.points_mm - truth).max() < 1e-8


@pytest.mark.parametrize("kind", LENSES)
def test_blocks_give_what_dense_normal_equations_give(kind: str) -> None:
    cameras, count = rig(kind), 5000
    pixels = noisy(cameras, count)
    found = triangulate(cameras, tuple(pixels), sigmas(count))
    weight = np.zeros((4, 4))
    weight[:2, :2], weight[2:, 2:] = np.linalg.inv(SIGMA)
    at = found.points_mm
    for _ in range(3):
        predicted, jacobian = stacked_jacobian(cameras, at)
        weighted = np.swapaxes(jacobian, 1, 2) @ weight
        off = (np.concatenate(pixels, 1) - predicted)[..., None]
        at = at + np.linalg.solve(weighted @ jacobian, weighted @ off)[..., 0]
    np.testing.assert_allclose(found.points_mm, at, atol=1e-12)
    dense = np.linalg.inv(weighted @ jacobian)
    np.testing.assert_allclose(found.covariance_mm2, dense, rtol=0, atol=1e-12 * dense.max())


def test_bad_input() -> None:
    cameras, pixels = rig(), noisy(rig(), 4)
    with pytest.raises(InputError, match="pair up"):
        triangulate(cameras, (pixels[0], pixels[1][:3]), 0.1)
    with pytest.raises(InputError, match="has the shape"):
        triangulate(cameras, (pixels[0][:, :1], pixels[1][:, :1]), 0.1)
    with pytest.raises(InputError, match="unknown method"):
        triangulate(cameras, tuple(pixels), 0.1, "best")
    for sigma in (0.0, -1.0, np.nan, np.zeros((2, 2)), [[1, 2], [2, 1]], -np.eye(2), np.ones(3)):
        with pytest.raises(InputError, match="sigma_px"):
            triangulate(cameras, tuple(pixels), sigma)
    with pytest.raises(InputError, match="3 entries of sigma_px for 2 cameras"):
        triangulate(cameras, tuple(pixels), (0.1, 0.1, 0.1))


def test_parallel_cameras_are_an_error() -> None:
    first = Camera.create("left", (512, 480), 10.0)
    with pytest.raises(GeometryError, match="parallel"):
        triangulate((first, first), tuple(noisy((first, first), 4)), 0.1)


def test_pixels_that_are_not_finite_are_an_error() -> None:
    cameras, pixels = rig(), noisy(rig(), 4)
    pixels[1][2, 0] = np.nan
    with pytest.raises(InputError, match="1 of 4 points"):
        triangulate(cameras, tuple(pixels), 0.1)


def fan(count: int = 3) -> tuple[Camera, ...]:
    """Cameras 50 degrees apart about the vertical axis, none like another."""
    poses = [Pose.from_rotvec([0.03 * i, 0.87 * i, 0], [0.1 * i, 0.2 * i, 0]) for i in range(count)]
    return tuple(
        Camera.create(f"camera {i}", (512, 480), 10.0 + i, camera_from_rig=pose, k1=0.01 * i)
        for i, pose in enumerate(poses)
    )


NOISE = (0.05, 0.1, 0.2, 0.08)


def seen_by_some(cameras: tuple[Camera, ...], count: int) -> list[Any]:
    """Noisy pixels; which cameras see a point goes round over all combinations."""
    rng = np.random.default_rng(4)
    out = []
    for c, camera in enumerate(cameras):
        uv = camera.project(points(count)) + NOISE[c] * rng.standard_normal((count, 2))
        uv[(np.arange(count) // 2**c) % 2 == 1] = np.nan
        out.append(uv)
    return out


@pytest.mark.parametrize("count", [2, 3, 4])
def test_views_ml_is_the_minimum_that_scipy_finds(count: int) -> None:
    cameras, number = fan(count), 2**count
    pixels = seen_by_some(cameras, number)
    found = triangulate_views(cameras, pixels, NOISE[:count])
    assert found.ray_miss_mm.shape == (number, count)
    for i in range(number):
        seen = [c for c in range(count) if np.isfinite(pixels[c][i]).all()]
        assert found.seen_by is not None and found.seen_by[i] == len(seen)
        assert np.isfinite(found.ray_miss_mm[i]).tolist() == [
            c in seen and len(seen) > 1 for c in range(count)
        ]
        if len(seen) < 2:
            assert np.isnan(found.points_mm[i]).all() and np.isnan(found.covariance_mm2[i]).all()
            continue

        def residual(x: Any, i: int = i, seen: list[int] = seen) -> Any:
            return np.concatenate([(cameras[c].project(x) - pixels[c][i]) / NOISE[c] for c in seen])

        fit = least_squares(residual, np.zeros(3), xtol=1e-15, ftol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(found.points_mm[i], fit.x, atol=1e-6)
        expected = np.linalg.inv(fit.jac.T @ fit.jac)
        np.testing.assert_allclose(found.covariance_mm2[i], expected, rtol=1e-4, atol=1e-9)
        for c in seen:
            origin, direction = cameras[c].unproject(pixels[c][i])
            miss = np.linalg.norm(np.cross(found.points_mm[i] - origin, direction))
            assert found.ray_miss_mm[i, c] == pytest.approx(miss, abs=1e-12)
    assert found.unplaced == count + 1


@pytest.mark.parametrize("method", ["ml", "midpoint"])
@pytest.mark.parametrize("shape", [(), (1,), (3, 2)])
def test_views_of_two_cameras_are_the_pair(method: str, shape: tuple[int, ...]) -> None:
    cameras = fan(2)
    truth = np.random.default_rng(1).uniform(-9, 9, (*shape, 3))
    pixels = tuple(c.project(truth) + 0.3 for c in cameras)
    pair = triangulate((cameras[0], cameras[1]), (pixels[0], pixels[1]), 0.1, method)
    views = triangulate_views(cameras, pixels, 0.1, method)
    np.testing.assert_allclose(views.points_mm, pair.points_mm, atol=1e-9)
    np.testing.assert_allclose(views.covariance_mm2, pair.covariance_mm2, rtol=1e-7, atol=1e-12)
    total = views.ray_miss_mm.sum(-1)
    assert np.all(total >= np.abs(pair.ray_miss_mm) - 1e-9)
    if method == "midpoint":
        np.testing.assert_allclose(total, np.abs(pair.ray_miss_mm), atol=1e-9)


@pytest.mark.parametrize("kind", ["ideal", "distorted", "tilted"])
def test_two_points_of_unknown_depth_are_one_of_known_depth(kind: str) -> None:
    cameras = rig(kind)
    truth = np.random.default_rng(8).uniform(-9, 9, (6, 3))
    pixels = [camera.project(truth) for camera in cameras]
    noise = [np.tile(own, (6, 1, 1)) for own in SIGMA]
    whole = triangulate_views(cameras, pixels, tuple(noise))
    rays = [on_rays(c, uv, s) for c, uv, s in zip(cameras, pixels, noise)]
    weights = [np.linalg.inv(covariance) for _, covariance, _ in rays]
    pull = sum(w @ points[..., None] for w, (points, _, _) in zip(weights, rays))
    found = np.linalg.solve(sum(weights), pull)[..., 0]
    np.testing.assert_allclose(found, truth, atol=1e-4)
    covariance = np.linalg.inv(sum(weights))
    np.testing.assert_allclose(covariance, whole.covariance_mm2, rtol=1e-3, atol=1e-7)
    for camera, uv, (points, _, by_pixel) in zip(cameras, pixels, rays):
        np.testing.assert_allclose(camera.project(points), uv, atol=1e-6)
        moved = camera.project(points + by_pixel @ [0.02, -0.01])
        np.testing.assert_allclose(moved - uv, np.tile([0.02, -0.01], (6, 1)), atol=1e-4)


@pytest.mark.parametrize("method", ["ml", "midpoint"])
def test_views_scatter_as_their_covariance_says(method: str) -> None:
    cameras, count = fan(3), 4000
    truth = np.array([3.0, -2.0, 4.0])
    rng = np.random.default_rng(7)
    pixels = [
        camera.project(truth) + sigma * rng.standard_normal((count, 2))
        for camera, sigma in zip(cameras, NOISE)
    ]
    found = triangulate_views(cameras, pixels, NOISE[:3], method)
    error = found.points_mm - truth
    normed = np.linalg.solve(found.covariance_mm2, error[..., None])[..., 0]
    assert (error * normed).sum(-1).mean() / 3 == pytest.approx(1, abs=0.05)


def test_views_that_cannot_be_used() -> None:
    cameras = fan(3)
    uv = np.full((4, 2), 250.0)
    with pytest.raises(InputError, match="do not belong together"):
        triangulate_views(cameras, [uv, uv], 0.1)
    with pytest.raises(InputError, match="do not belong together"):
        triangulate_views(cameras, [uv, uv, uv[:2]], 0.1)
    with pytest.raises(InputError, match="unknown method"):
        triangulate_views(cameras, [uv, uv, uv], 0.1, "middle")
    with pytest.raises(GeometryError, match="parallel"):
        triangulate_views((cameras[0], cameras[0]), [uv, uv], 0.1)
    with pytest.raises(InputError, match="2 entries of sigma_px for 3 cameras"):
        triangulate_views(cameras, [uv, uv, uv], (0.1, 0.1))


def test_views_of_no_point_and_covariances_of_unseen_pixels() -> None:
    cameras = fan(3)
    found = triangulate_views(cameras, [np.zeros((0, 2))] * 3, 0.1)
    assert found.points_mm.shape == found.ray_miss_mm.shape == (0, 3)
    uv = [camera.project([[1.0, 2.0, 3.0]]) for camera in cameras]
    uv[1] = np.full((1, 2), np.nan)
    unseen = (np.eye(2)[None], np.full((1, 2, 2), np.nan), np.eye(2)[None])
    found = triangulate_views(cameras, uv, unseen)
    np.testing.assert_allclose(found.points_mm, [[1.0, 2.0, 3.0]], atol=1e-9)
