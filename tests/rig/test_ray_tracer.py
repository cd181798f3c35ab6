"""The brute-force tracer of light through tank glass against closed forms; telerig judged by it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from ray_tracer import DISTORTION, PARAMETERS, trace_pixels, trace_ray

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


# ---- what the arguments mean


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
