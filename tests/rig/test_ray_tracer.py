"""The brute-force tracer of light through tank glass against closed forms; telerig judged by it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from ray_tracer import DISTORTION, PARAMETERS, Method, trace_pixels, trace_ray

from telerig.rig.camera import Camera

Array = NDArray[np.float64]

KAPPAS = (0.0, 1e-5, -1e-5, 1 / 400, -1 / 400)
INDICES = (1.0, 1.52, 1.333)
PLAIN = {"scale_px_per_mm": 40.0, "centre_px": (1023.5, 767.5)}
EVERY_ERROR = PLAIN | {
    "aspect": 1.002, "skew": 3e-4, "rho_mm": 32.0, "k1": -0.02, "k2": 3e-3, "k3": -1e-3,
    "p1": 4e-4, "p2": -7e-4, "s1": 1e-3, "s2": -2e-4, "s3": 5e-4, "s4": 3e-4,
    "tilt_x": 0.05, "tilt_y": -0.08, "image_convergence_per_mm": 2e-3,
}  # fmt: skip
EXACT_PX = 1e-11


def tilted(tilt_deg: float, towards_deg: float = 0.0) -> Array:
    """Normal of a wall that is tilted away from the optical axis."""
    a, b = np.radians([tilt_deg, towards_deg])
    return np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])


def wall(normal: Any = (0, 0, 1), distance_mm: float = -40.0, **other: Any) -> dict[str, Any]:
    return {
        "normal": normal, "distance_mm": distance_mm, "thickness_mm": 10.0, "indices": INDICES,
    } | other  # fmt: skip


def scene(seed: int, count: int) -> Array:
    return np.random.default_rng(seed).uniform(-15, 15, (count, 3))


def refracted(direction: Array, normal: Array, n1: float, n2: float) -> Array:
    """The ray turned about the line across the plane of incidence, by the angles of Snell's law."""
    axis = np.cross(direction, normal)
    sine = float(np.linalg.norm(axis))
    if sine == 0:
        return direction
    axis /= sine
    by = np.arcsin(sine) - np.arcsin(n1 / n2 * sine)
    return np.asarray(direction * np.cos(by) + np.cross(axis, direction) * np.sin(by))


def on_plane(origin: Array, direction: Array, normal: Array, foot: Array) -> Array:
    return np.asarray(origin + direction * (normal @ (foot - origin)) / (normal @ direction))


def camera_ray(kappa: float, x: float, y: float) -> tuple[Array, Array]:
    direction = np.array([kappa * x, kappa * y, 1.0])
    return np.array([x, y, 0.0]), direction / np.linalg.norm(direction)


# ---- accuracy


@pytest.mark.parametrize("kappa", KAPPAS)
def test_fermat_and_snell_agree(kappa: float) -> None:
    camera = EVERY_ERROR | {"kappa_per_mm": kappa}
    for tilt_deg in (0.0, 1.0, 10.0):
        glass = wall(tilted(tilt_deg, 130.0), distance_mm=-18.0)  # some of the points in the glass
        points = scene(5, 6)
        by_length = trace_pixels(camera, glass, points, "fermat")
        by_angles = trace_pixels(camera, glass, points, "snell")
        assert np.abs(by_length - by_angles).max() < EXACT_PX
        faces = [len(trace_ray(camera, glass, p, "snell").points_mm) - 1 for p in points]
        assert {1, 2} <= set(faces)


@pytest.mark.parametrize("kappa", KAPPAS)
def test_points_on_a_ray_traced_from_the_camera_give_its_pixel(kappa: float) -> None:
    """The way back, by angles in doubles: nothing is sought."""
    camera, n = PLAIN | {"kappa_per_mm": kappa}, INDICES
    for seed, tilt_deg in enumerate((0.0, 2.0, 10.0)):
        rng = np.random.default_rng(seed)
        normal = tilted(tilt_deg, rng.uniform(0, 360))
        foot = np.array([0, 0, -40.0])
        for x, y in rng.uniform(-15, 15, (4, 2)):
            origin, in_air = camera_ray(kappa, x, y)
            near = on_plane(origin, in_air, normal, foot)
            in_glass = refracted(in_air, normal, n[0], n[1])
            far = on_plane(near, in_glass, normal, foot + 10 * normal)
            point = far + rng.uniform(1, 60) * refracted(in_glass, normal, n[1], n[2])
            found = trace_pixels(camera, wall(normal), point[None])[0]
            wanted = 40 * np.array([x, y]) + PLAIN["centre_px"]
            np.testing.assert_allclose(found, wanted, rtol=0, atol=EXACT_PX)


@pytest.mark.parametrize("method", ["fermat", "snell"])
@pytest.mark.parametrize("kappa", KAPPAS)
def test_the_path_obeys_snell_and_enters_the_camera(kappa: float, method: Method) -> None:
    normal = tilted(10.0, -70.0)
    for point in scene(8, 4):
        ray = trace_ray(PLAIN | {"kappa_per_mm": kappa}, wall(normal), point, method)
        steps = np.diff(ray.points_mm, axis=0)
        legs = [*(steps / np.linalg.norm(steps, axis=1, keepdims=True)), ray.direction]
        assert ray.indices.tolist() == [1.333, 1.52, 1.0]
        heights = (ray.points_mm[1:] - [0, 0, -40]) @ normal
        np.testing.assert_allclose(heights, [10.0, 0.0], atol=1e-13)
        for n1, before, n2, after in zip(ray.indices, legs, ray.indices[1:], legs[1:]):
            sines = np.cross(before, normal), np.cross(after, normal)  # length and plane at once
            np.testing.assert_allclose(n1 * sines[0], n2 * sines[1], atol=1e-13)
            assert before @ normal < 0 and after @ normal < 0
        last = ray.points_mm[-1]
        taken = np.array([kappa * last[0], kappa * last[1], 1 + kappa * last[2]])
        np.testing.assert_allclose(np.cross(ray.direction, taken), 0, atol=1e-13)
        assert ray.direction[2] < 0


@pytest.mark.parametrize("kappa", KAPPAS)
def test_every_other_path_is_longer(kappa: float) -> None:
    normal = tilted(7.0, 200.0)
    across = np.linalg.svd(normal[None])[2][1:]
    rng = np.random.default_rng(3)
    point = np.array([9.0, -12.0, 11.0])
    ray = trace_ray(PLAIN | {"kappa_per_mm": kappa}, wall(normal), point)

    def optical_length_mm(path: Array) -> float:
        legs = ray.indices[:2] @ np.linalg.norm(np.diff(path, axis=0), axis=1)
        if kappa == 0:
            return float(legs + path[-1, 2])
        return float(legs + np.sign(kappa) * np.linalg.norm(path[-1] - [0, 0, -1 / kappa]))

    shortest = optical_length_mm(ray.points_mm)
    for size_mm in (0.02, 0.5, 5.0):
        for _ in range(200):
            moves = rng.normal(size=(2, 2))
            moved = ray.points_mm.copy()
            moved[1:] += size_mm * moves / np.linalg.norm(moves) @ across
            assert optical_length_mm(moved) > shortest


# ---- closed forms


@pytest.mark.parametrize("method", ["fermat", "snell"])
def test_a_perpendicular_wall_does_nothing_to_a_telecentric_camera(method: Method) -> None:
    points = scene(1, 8)
    wanted = 40 * points[:, :2] + PLAIN["centre_px"]
    found = trace_pixels(PLAIN, wall(), points, method)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=EXACT_PX)


@pytest.mark.parametrize("index", [1.0, 1.333])
@pytest.mark.parametrize("kappa", KAPPAS)
def test_the_same_medium_everywhere_changes_nothing(kappa: float, index: float) -> None:
    camera, points = EVERY_ERROR | {"kappa_per_mm": kappa}, scene(2, 4)
    glass = wall(tilted(10.0, 60.0), indices=(index,) * 3)
    in_air = trace_pixels(camera, wall(distance_mm=100.0), points)
    np.testing.assert_allclose(trace_pixels(camera, glass, points), in_air, rtol=0, atol=EXACT_PX)


@pytest.mark.parametrize("kappa", [1e-5, -1e-5, 1 / 400, -1 / 400])
def test_apparent_depth_near_the_axis(kappa: float) -> None:
    """Behind a perpendicular wall depths shrink by the index: t / 1.52 + h / 1.333."""
    camera = PLAIN | {"kappa_per_mm": kappa, "centre_px": (0.0, 0.0)}
    x_mm = 1e-5
    for depth_mm in (-35.0, -30.0, 0.0, 25.0):
        behind = depth_mm + 40.0
        apparent = -40 + min(behind, 10) / 1.52 + max(behind - 10, 0) / 1.333
        found = trace_pixels(camera, wall(), [[x_mm, -2 * x_mm, depth_mm]])[0]
        wanted = 40 * x_mm / (1 + kappa * apparent) * np.array([1, -2])
        np.testing.assert_allclose(found, wanted, rtol=1e-13)


@pytest.mark.parametrize("tilt_deg, shear_um", [(0.1, 13), (1.0, 131), (10.0, 1318)])
def test_a_tilted_wall_shears_depth(tilt_deg: float, shear_um: int) -> None:
    """In water the rays lean by psi less psi in water; the glass has no part in it.

    In the image the shear is smaller by what the wall takes off lengths along its slope.
    """
    psi = np.radians(tilt_deg)
    lean = psi - np.arcsin(np.sin(psi) / 1.333)
    shear_mm = 30 * np.tan(lean)
    kept = np.cos(psi) * np.cos(lean) / np.cos(psi - lean)
    for towards_deg in (0.0, 90.0, 200.0):
        slope = tilted(90.0, towards_deg)
        points = [4.0, -7.0, -15.0] + np.array(
            [0 * slope, [0, 0, 30.0], slope, np.cross(slope, [0, 0, 1])]
        )
        for glass in ({}, {"thickness_mm": 3.0}, {"indices": (1.0, 1.8, 1.333)}):
            behind = wall(tilted(tilt_deg, towards_deg), **glass)
            seen = trace_pixels(PLAIN, behind, points) / 40
            deeper, along, aside = seen[1:] - seen[0]
            np.testing.assert_allclose(deeper, -kept * shear_mm * slope[:2], rtol=0, atol=1e-12)
            np.testing.assert_allclose(along, kept * slope[:2], rtol=0, atol=1e-12)
            np.testing.assert_allclose(aside, np.cross(slope, [0, 0, 1])[:2], rtol=0, atol=1e-12)
    assert round(1e3 * shear_mm) == shear_um


def test_a_plate_in_air_shifts_the_ray() -> None:
    """By t sin(a - b) / cos(b), across a ray that is not turned."""
    a = np.radians(10.0)
    b = np.arcsin(np.sin(a) / 1.52)
    points = scene(4, 5)
    found = trace_pixels(PLAIN, wall(tilted(10.0), indices=(1.0, 1.52, 1.0)), points)
    shift = found - 40 * points[:, :2] - PLAIN["centre_px"]
    wanted = 40 * 10 * np.sin(a - b) / np.cos(b)
    np.testing.assert_allclose(shift, [[-wanted, 0.0]] * 5, rtol=0, atol=EXACT_PX)


def test_the_telecentric_map_is_affine_behind_any_wall() -> None:
    points = scene(6, 10)
    found = trace_pixels(PLAIN, wall(tilted(10.0, 25.0)), points)
    columns = np.c_[points, np.ones(10)]
    rest = columns @ np.linalg.lstsq(columns, found, rcond=None)[0] - found
    assert np.abs(rest).max() < EXACT_PX
    farther = trace_pixels(PLAIN, wall(tilted(10.0, 25.0), distance_mm=-70.0), points)
    np.testing.assert_allclose(np.diff(farther - found, axis=0), 0, atol=EXACT_PX)


@pytest.mark.parametrize("kappa", KAPPAS)
def test_glass_like_water_is_water(kappa: float) -> None:
    camera, points = PLAIN | {"kappa_per_mm": kappa}, scene(7, 3)
    thin, thick = (
        wall(tilted(10.0), indices=(1.0, 1.333, 1.333), thickness_mm=t) for t in (1.0, 200.0)
    )
    in_water, in_glass = (trace_pixels(camera, glass, points) for glass in (thin, thick))
    np.testing.assert_allclose(in_water, in_glass, rtol=0, atol=EXACT_PX)


def test_turning_all_about_the_axis_turns_the_image() -> None:
    camera = {"scale_px_per_mm": 40.0, "kappa_per_mm": 1 / 400}
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    normal, points = tilted(8.0, 15.0), scene(9, 4)
    turned = trace_pixels(camera, wall(turn @ normal), points @ turn.T)
    still = trace_pixels(camera, wall(normal), points)
    np.testing.assert_allclose(turned, still @ turn[:2, :2].T, rtol=0, atol=EXACT_PX)


def test_kappa_goes_smoothly_through_zero() -> None:
    """The mean of kappa = +-1e-7 is that of 0, up to second order; their difference is not 0."""
    glass, points = wall(tilted(5.0, 45.0)), scene(10, 4)
    plus, none, minus = (
        trace_pixels(PLAIN | {"kappa_per_mm": k}, glass, points) for k in (1e-7, 0.0, -1e-7)
    )
    assert np.abs((plus + minus) / 2 - none).max() < 1e-8
    assert np.abs(plus - minus).max() > 1e-4


def test_water_brings_points_in_front_of_a_hypercentric_centre() -> None:
    """It is the apparent depth that must lie before the centre, here at z = 10."""
    camera = {"scale_px_per_mm": 40.0, "kappa_per_mm": -0.1}
    apparent = -40 + 10 / 1.52 + 41 / 1.333
    for method in ("fermat", "snell"):
        found = trace_pixels(camera, wall(), [[1e-5, 0, 11.0]], method)[0]
        np.testing.assert_allclose(found, [40e-5 / (1 - 0.1 * apparent), 0], rtol=1e-11)
    with pytest.raises(ValueError, match="behind the centre"):  # looks to be at z = 19
        trace_pixels(camera, wall(), [[0.1, 0, 40.0]])


# ---- what the arguments mean


@pytest.mark.parametrize("kappa", KAPPAS)
def test_on_the_cameras_side_light_goes_straight(kappa: float) -> None:
    camera, points = PLAIN | {"kappa_per_mm": kappa}, scene(11, 4)
    wanted = 40 * points[:, :2] / (1 + kappa * points[:, 2:]) + PLAIN["centre_px"]
    for method in ("fermat", "snell"):
        found = trace_pixels(camera, wall(tilted(10.0), distance_mm=30.0), points, method)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=EXACT_PX)
    ray = trace_ray(camera, wall(distance_mm=30.0), points[0])
    assert ray.points_mm.tolist() == [points[0].tolist()] and ray.indices.tolist() == [1.0]


@pytest.mark.parametrize("kappa", [0.0, 1 / 400, -1 / 400])
def test_the_faces_leave_no_step(kappa: float) -> None:
    """Distance is along the axis to the near face, thickness across the wall."""
    camera, normal = PLAIN | {"kappa_per_mm": kappa}, tilted(10.0, 30.0)
    for face, media in (([0, 0, -40.0], (1, 2)), (np.array([0, 0, -40.0]) + 10 * normal, (2, 3))):
        sides = np.array([face - 1e-9 * normal, face + 1e-9 * normal])
        before, after = trace_pixels(camera, wall(normal), sides)
        assert np.abs(after - before).max() < 1e-7
        assert tuple(len(trace_ray(camera, wall(normal), p).indices) for p in sides) == media


def test_the_normal_may_have_either_sign_and_any_length() -> None:
    normal, points = tilted(6.0, 80.0), scene(12, 2)
    camera = PLAIN | {"kappa_per_mm": -1 / 400}
    wanted = trace_pixels(camera, wall(normal), points)
    found = trace_pixels(camera, wall(-3.7 * normal), points)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=EXACT_PX)


def test_distortion_is_opencvs() -> None:
    camera = {k: v for k, v in EVERY_ERROR.items() if k[:4] not in ("tilt", "skew", "imag")}
    k1, k2, k3, p1, p2, *prism = (camera[k] for k in DISTORTION)
    points = scene(13, 20)
    matrix = np.array([[40 * 32, 0, 1023.5], [0, 40 * 32 * 1.002, 767.5], [0, 0, 1]])
    coefficients = np.array([k1, k2, p1, p2, k3, 0, 0, 0, *prism])
    flat = np.c_[points[:, :2] / 32, np.ones(20)]
    wanted = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), matrix, coefficients)[0]
    found = trace_pixels(camera, wall(distance_mm=100.0), points)
    np.testing.assert_allclose(found, wanted.reshape(-1, 2), rtol=0, atol=EXACT_PX)


@pytest.mark.parametrize("kappa", KAPPAS)
def test_in_air_telerig_sees_the_same(kappa: float) -> None:
    values = {k: v for k, v in EVERY_ERROR.items() if k not in ("centre_px", "scale_px_per_mm")}
    camera = Camera.create("left", (2048, 1536), 40.0, kappa_per_mm=kappa, **values)
    named = {k: camera[k] for k in PARAMETERS if k != "rho_mm"} | {"rho_mm": camera.rho_mm}
    points = scene(14, 30)
    found = trace_pixels(named, wall(distance_mm=100.0), points)
    np.testing.assert_allclose(found, camera.project(points), rtol=0, atol=EXACT_PX)


@pytest.mark.parametrize(
    "camera, glass, point, words",
    [
        ({"kapa": 0.1}, {}, (0, 0, 0), "unknown parameters"),
        ({"k1": 0.1}, {}, (0, 0, 0), "needs rho_mm"),
        ({"skew": np.nan}, {}, (0, 0, 0), "finite"),
        ({}, {"tilt": 1}, (0, 0, 0), "has the keys"),
        ({}, {"normal": (0, 0, 0)}, (0, 0, 0), "length zero"),
        ({}, {"normal": (1, 0, 0)}, (0, 0, 0), "along the wall"),
        ({}, {"thickness_mm": 0}, (0, 0, 0), "must be positive"),
        ({}, {}, (0, np.inf, 0), "finite"),
        ({"kappa_per_mm": 0.1}, {}, (0, 0, -10.0), "centre of perspective"),
        ({"kappa_per_mm": -0.1}, {"distance_mm": 50.0}, (1, 0, 11.0), "centre of perspective"),
        ({"kappa_per_mm": 0.1}, {}, (0, 0, 5.0), "not on the camera's side"),
        ({}, {"indices": (1.5, 1.2, 1.0), "normal": tilted(70.0)}, (0, 0, 0), "no ray"),
    ],
)
def test_what_cannot_be_traced_is_refused(camera: Any, glass: Any, point: Any, words: str) -> None:
    for method in ("fermat", "snell"):
        with pytest.raises(ValueError, match=words):
            trace_pixels(PLAIN | camera, wall() | glass, [point], method)
