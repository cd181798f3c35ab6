"""Rays through plane glass: against an independent tracer, Snell's law, and numerical slopes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from ray_tracer import trace_pixels

from telerig.errors import GeometryError
from telerig.rig import projection, windows
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import INDEX
from telerig.rig.pose import Pose, rotation_from_rotvec
from telerig.rig.triangulation import triangulate
from telerig.rig.windows import Wall

Array = NDArray[np.float64]

WALLS = {
    "facing": ((0.0, 0.0, 1.0), -70.0, (1.0, 1.52, 1.333)),
    "1 deg": ((np.sin(np.radians(1)), 0.0, np.cos(np.radians(1))), -70.0, (1.0, 1.52, 1.333)),
    "25 deg": ((-0.25, 0.34, 0.9), -60.0, (1.0, 1.46, 1.35)),
    "into air": ((0.1, 0.05, 1.0), -60.0, (1.333, 1.5, 1.0)),
}
KAPPAS = (0.0, 1e-9, 2e-5, -3e-5, 1e-3, 1 / 150, -1 / 200)


def wall_named(name: str) -> Wall:
    normal, distance, indices = WALLS[name]
    return Wall(np.array(normal) / np.linalg.norm(normal), distance, 12.0, indices)


def water_points(rng: np.random.Generator, shape: tuple[int, ...] = (12,)) -> Array:
    return rng.uniform(-25, 25, (*shape, 3))


def differences(function: Callable[[Array], Array], at: Array, step: float) -> Array:
    """Fourth-order central differences, last axis of the result the variable."""
    columns = []
    for direction in np.eye(len(at)) * step:
        near = function(at + direction) - function(at - direction)
        far = function(at + 2 * direction) - function(at - 2 * direction)
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, -1)


@pytest.mark.parametrize("kappa", KAPPAS)
@pytest.mark.parametrize("name", WALLS)
def test_pixels_are_those_of_the_independent_tracer(name: str, kappa: float) -> None:
    wall, points = wall_named(name), water_points(np.random.default_rng(1), (6,))
    lens = {"kappa_per_mm": kappa, "k1": 2e-3, "p1": -4e-4, "tilt_x": 0.01, "aspect": 1.001}
    camera = Camera.create("left", (800, 600), 16.0, **lens)
    ideal = windows.ideal_from_water(points, kappa, wall)
    in_air = np.concatenate([ideal, np.zeros((len(ideal), 1))], -1)
    uv = projection.pixel_from_camera(in_air, camera.intrinsics, camera.rho_mm)
    traced = trace_pixels(
        lens | {"scale_px_per_mm": 16.0, "rho_mm": camera.rho_mm, "centre_px": (399.5, 299.5)},
        {
            "normal": wall.normal, "distance_mm": wall.distance_mm,
            "thickness_mm": wall.thickness_mm, "indices": wall.indices,
        },
        points, "snell",
    )  # fmt: skip
    np.testing.assert_allclose(uv, traced, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kappa", KAPPAS)
@pytest.mark.parametrize("name", WALLS)
def test_the_ray_of_an_image_goes_through_its_point(name: str, kappa: float) -> None:
    wall, points = wall_named(name), water_points(np.random.default_rng(2), (3, 5))
    ideal = windows.ideal_from_water(points, kappa, wall)
    assert ideal.shape == (3, 5, 2)
    origin, direction = windows.water_from_ideal(ideal, kappa, wall)
    between = points - origin
    off = between - np.sum(between * direction, -1, keepdims=True) * direction
    assert np.abs(off).max() < 1e-10
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, rtol=1e-14)
    assert np.abs(origin[..., 2]).max() < 1e-12


@pytest.mark.parametrize("name", WALLS)
def test_rays_in_water_obey_snells_law(name: str) -> None:
    wall, kappa = wall_named(name), 1 / 150
    ideal = np.random.default_rng(3).uniform(-25, 25, (9, 2))
    in_air = np.concatenate([kappa * ideal, np.ones((9, 1))], -1)
    in_air /= np.linalg.norm(in_air, axis=-1, keepdims=True)
    _, in_water = windows.water_from_ideal(ideal, kappa, wall)
    before = wall.indices[0] * np.cross(in_air, wall.normal)
    np.testing.assert_allclose(
        wall.indices[2] * np.cross(in_water, wall.normal), before, atol=1e-14
    )
    assert np.all(in_water @ wall.normal > 0)


def test_equal_indices_are_no_wall() -> None:
    wall = replace(wall_named("25 deg"), indices=(1.333, 1.333, 1.333))
    points = water_points(np.random.default_rng(4))
    for kappa in KAPPAS:
        expected = points[:, :2] / (1 + kappa * points[:, 2:])
        np.testing.assert_allclose(
            windows.ideal_from_water(points, kappa, wall), expected, atol=1e-12
        )


def test_the_affine_map_is_that_of_all_points_and_a_facing_wall_does_nothing() -> None:
    points = water_points(np.random.default_rng(5))
    matrix, offset = windows.affine_map(wall_named("25 deg"))
    seen = windows.ideal_from_water(points, 0.0, wall_named("25 deg"))
    np.testing.assert_allclose(seen, points @ matrix.T + offset, atol=1e-13)
    matrix, offset = windows.affine_map(wall_named("facing"))
    np.testing.assert_array_equal(matrix, np.eye(2, 3))
    np.testing.assert_array_equal(offset, 0)


@pytest.mark.parametrize(("tilt_deg", "shear_um"), [(0.1, 13), (1.0, 131)])
def test_a_tilted_wall_shears_depth_as_the_design_says(tilt_deg: float, shear_um: int) -> None:
    tilt = np.radians(tilt_deg)
    wall = Wall(np.array([np.sin(tilt), 0, np.cos(tilt)]), 0.0, 10.0, (1.0, 1.52, 1.333))
    near, far = windows.ideal_from_water(np.array([[0, 0, 20.0], [0, 0, 50.0]]), 0.0, wall)
    assert np.abs(far - near)[0] * 1e3 == pytest.approx(shear_um, abs=0.5)


@pytest.mark.parametrize("kappa", KAPPAS)
@pytest.mark.parametrize("name", WALLS)
def test_derivatives_are_those_of_differences(name: str, kappa: float) -> None:
    wall, points = wall_named(name), water_points(np.random.default_rng(6), (4,))
    found = windows.ideal_jacobians(points, kappa, wall)
    np.testing.assert_array_equal(found.value, windows.ideal_from_water(points, kappa, wall))

    def of_wall(change: Array) -> Array:
        turned = wall.turned(change[:2])
        moved = replace(turned, distance_mm=wall.distance_mm + change[2])
        return windows.ideal_from_water(points, kappa, moved)

    by_wall = differences(of_wall, np.zeros(3), 1e-3)
    np.testing.assert_allclose(found.by_wall, by_wall, rtol=1e-7, atol=1e-7)
    for i, point in enumerate(points):
        by_point = differences(lambda p: windows.ideal_from_water(p, kappa, wall), point, 0.05)
        np.testing.assert_allclose(found.by_point[i], by_point, atol=1e-8)

    def of_kappa(change: Array) -> Array:
        return windows.ideal_from_water(points, kappa + float(change[0]), wall)

    by_kappa = differences(of_kappa, np.zeros(1), 2e-5)[..., 0]
    np.testing.assert_allclose(found.by_kappa, by_kappa, rtol=2e-5, atol=1e-4)


@pytest.mark.parametrize("kappa", [0.0, 2e-5, 1 / 150])
def test_a_camera_behind_a_wall(kappa: float) -> None:
    pose = Pose(rotation_from_rotvec(np.array([0.1, 1.4, -0.2])), np.array([1.0, -2.0, 3.0]))
    camera = Camera.create(
        "left", (800, 600), 16.0, kappa_per_mm=kappa, k1=2e-3, tilt_x=0.02, wall_x_rad=0.03,
        wall_y_rad=-0.02, camera_from_rig=pose,
    )  # fmt: skip
    camera = replace(camera, wall=wall_named("25 deg"))
    points = water_points(np.random.default_rng(7), (2, 3))
    uv = camera.project(points)
    origin, direction = camera.unproject(uv)
    off = np.cross(points - origin, direction)
    assert np.abs(off).max() < 1e-10

    in_camera = pose.apply(points.reshape(-1, 3))
    found, by_point, by_intrinsics = camera.pixel_jacobians(in_camera)
    np.testing.assert_allclose(found, uv.reshape(-1, 2), atol=1e-10)
    level = replace(camera, camera_from_rig=Pose.identity())
    for i, point in enumerate(in_camera):
        expected = differences(level.project, point, 0.02)
        np.testing.assert_allclose(by_point[i], expected, atol=1e-6)
    for name in ("scale_px_per_mm", "kappa_per_mm", "k1", "tilt_x", "wall_x_rad", "wall_y_rad"):

        def of(change: Array, name: str = name) -> Array:
            changed = level.with_parameters(**{name: level[name] + float(change[0])})
            return changed.project(in_camera)

        expected = differences(of, np.zeros(1), 1e-5)[..., 0]
        np.testing.assert_allclose(by_intrinsics[..., INDEX[name]], expected, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("kappa", [0.0, 1e-4])
def test_triangulation_goes_through_the_refracted_rays(kappa: float) -> None:
    side = Pose(rotation_from_rotvec(np.array([0.0, np.pi / 2, 0.0])), np.zeros(3))
    cameras = tuple(
        replace(
            Camera.create(n, (800, 600), 16.0, kappa_per_mm=kappa, camera_from_rig=p),
            wall=wall_named(w),
        )
        for n, p, w in (("left", Pose.identity(), "25 deg"), ("right", side, "1 deg"))
    )
    pair = (cameras[0], cameras[1])
    rng = np.random.default_rng(8)
    points = water_points(rng, (5,))
    exact = tuple(c.project(points) for c in pair)
    for method in ("ml", "midpoint"):
        found = triangulate(pair, (exact[0], exact[1]), 0.1, method)
        np.testing.assert_allclose(found.points_mm, points, atol=1e-8)
        assert np.abs(found.ray_miss_mm).max() < 1e-9
    noisy = [uv + 0.1 * rng.standard_normal((4000, 5, 2)) for uv in exact]
    spread = triangulate(pair, (noisy[0], noisy[1]), 0.1).points_mm
    for i in range(5):
        seen = np.cov(spread[:, i].T)
        stated = triangulate(pair, (exact[0][i], exact[1][i]), 0.1).covariance_mm2
        np.testing.assert_allclose(np.diag(seen), np.diag(stated), rtol=0.12)


def test_the_tangents_are_a_turn_of_the_normal() -> None:
    wall = wall_named("25 deg")
    basis = tangent_basis_of(wall)
    np.testing.assert_allclose(basis.T @ basis, np.eye(2), atol=1e-15)
    np.testing.assert_allclose(basis.T @ wall.normal, 0, atol=1e-15)
    delta = np.array([0.02, -0.03])
    slope = differences(lambda d: wall.turned(d).normal, delta, 1e-3)
    turned = tangent_basis_of(wall.turned(delta))
    np.testing.assert_allclose(wall.turn_jacobian(delta), turned.T @ slope, atol=1e-9)
    angle = np.arccos(wall.turned([3e-3, -4e-3]).normal @ wall.normal)
    assert angle == pytest.approx(np.arctan(5e-3), rel=1e-9)


def tangent_basis_of(wall: Wall) -> Array:
    return windows.tangent_basis(wall.normal)


def test_a_wall_survives_its_file() -> None:
    wall = replace(wall_named("25 deg"), normal_sigma_rad=0.01)
    again = Wall.from_dict(json.loads(json.dumps(wall.as_dict())))
    np.testing.assert_allclose(again.normal, wall.normal, atol=1e-15)
    assert again.normal_sigma_rad == pytest.approx(0.01, rel=1e-15)
    assert replace(again, normal=wall.normal, normal_sigma_rad=0.01) == wall


@pytest.mark.parametrize(
    "damage",
    [
        {"normal": [0.0, 0.0, 0.0]},
        {"normal": [0.0, float("nan"), 1.0]},
        {"normal": [0.0, 0.6, -0.8]},
        {"indices": [1.0, 1.5, 0.0]},
    ],
)
def test_a_wall_that_cannot_be_is_refused(damage: dict[str, list[float]]) -> None:
    with pytest.raises(ValueError, match="of a window"):
        Wall.from_dict(wall_named("25 deg").as_dict() | damage)


def test_what_no_ray_reaches_is_an_error() -> None:
    wall = wall_named("facing")
    with pytest.raises(GeometryError, match="out of the camera's reach"):
        windows.ideal_from_water(np.array([[0.0, 0.0, -500.0]]), 1 / 150, wall)
    with pytest.raises(GeometryError, match="out of the camera's reach"):
        windows.ideal_from_water(np.array([[0.0, 0.0, 900.0]]), -1 / 200, wall)
    steep = Wall(np.array([np.sin(1.2), 0, np.cos(1.2)]), -60.0, 10.0, (1.333, 1.5, 1.0))
    with pytest.raises(GeometryError, match="totally reflected"):
        windows.ideal_from_water(np.array([[0.0, 0.0, 10.0]]), 0.0, steep)
