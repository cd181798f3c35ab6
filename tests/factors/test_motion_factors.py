"""Measurements of cameras, encoder, accelerometers: values by hand, derivatives by differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from telerig.factors import measurements
from telerig.factors.linear_factors import add_linear_factors
from telerig.factors.motion import motion, start
from telerig.factors.state_space import driven_mode, oscillator, ou_velocity
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

UP = np.array([0.0, -1.0, 0.0])


def cameras() -> list[Camera]:
    """An ideal one, and one at 40 degrees with perspective and distortion."""
    a = np.deg2rad(40.0)
    rotation = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    pose = Pose(rotation, np.array([1.0, -2.0, 3.0]))
    return [
        Camera.create("left", (1024, 1024), 10.0),
        Camera.create(
            "right", (1024, 1024), 10.0, camera_from_rig=pose, kappa_per_mm=3e-4, k1=-2e-3
        ),
    ]


def slope(function: Callable[[Any], Any], at: Any, step: float) -> Any:
    """Central differences, the last axis by the argument's components."""
    at = np.asarray(at, float)
    columns = []
    for i in range(at.shape[-1]):
        move = np.zeros(at.shape[-1])
        move[i] = step
        columns.append((function(at + move) - function(at - move)) / (2 * step))
    return np.stack(columns, -1)


@pytest.mark.parametrize("camera", cameras(), ids=lambda c: c.name)
@pytest.mark.parametrize("shape", [(), (1,), (3,)])
def test_image_derivatives(camera: Camera, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(3)
    point, offset = rng.uniform(-15, 15, (*shape, 3)), rng.uniform(-1, 1, (*shape, 3))
    position = rng.uniform(-5, 5, shape)

    def image(p: Any, s: Any, o: Any) -> Any:
        return measurements.image_of_point(camera, p, s, UP, o).uv_px

    found = measurements.image_of_point(camera, point, position, UP, offset)
    assert found.uv_px.shape == (*shape, 2)
    tolerance = {"rtol": 1e-6, "atol": 1e-6}
    np.testing.assert_allclose(
        found.by_point, slope(lambda p: image(p, position, offset), point, 1e-4), **tolerance
    )
    np.testing.assert_allclose(
        found.by_offset, slope(lambda o: image(point, position, o), offset, 1e-4),
        **tolerance,
    )  # fmt: skip
    by_position = slope(lambda s: image(point, s[..., 0], offset), position[..., None], 1e-4)
    np.testing.assert_allclose(found.by_position, by_position[..., 0], **tolerance)


def test_image_is_the_rigs_view_of_the_moved_point() -> None:
    camera = cameras()[1]
    seen = measurements.image_of_point(camera, [1.0, 2.0, 3.0], 7.0, UP, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(seen.uv_px, camera.project([0.9, 8.8, 2.7]), atol=1e-9)


def test_accelerometer_at_rest_shows_gravity_upwards() -> None:
    axes = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    read = measurements.accelerometer_reading(np.zeros(3), -9806.65 * UP, axes)
    np.testing.assert_allclose(read.reading_mm_s2, [-9806.65, 0, 0])


def test_accelerometer_derivatives() -> None:
    rng = np.random.default_rng(5)
    a = rng.normal(size=(4, 3)) * 1000
    axes, bias = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3)
    gravity = -9781.0 * UP

    def reading(x: Any, scale: float = 0.02) -> Any:
        return measurements.accelerometer_reading(x, gravity, axes, bias, scale).reading_mm_s2

    found = measurements.accelerometer_reading(a, gravity, axes, bias, 0.02)
    np.testing.assert_allclose(found.by_acceleration, slope(reading, a, 1.0), atol=1e-9)
    by_scale = (reading(a, 0.03) - reading(a, 0.01)) / 0.02
    np.testing.assert_allclose(found.by_scale, by_scale, rtol=1e-9)


def test_motion_residual_is_whitened() -> None:
    """Steps drawn from the model have residuals of unit covariance."""
    parts = (ou_velocity(10.0, 0.3), oscillator(0.2, 12.0, 0.03), driven_mode(0.1, 20.0, 0.03))
    rng = np.random.default_rng(11)
    count = 4000
    steps = motion(parts, np.full(count, 2e-3))
    assert steps.by_last.shape == (1, 8, 8)
    last = rng.normal(size=(count, 8))
    white = rng.normal(size=(count, 8))
    mean_speed = 280.0
    following = np.linalg.solve(
        steps.by_next[0],
        (white - last @ steps.by_last[0].T - mean_speed * steps.by_input[0, :, 0]).T,
    ).T
    residual = steps.residual(last, following, [mean_speed])
    np.testing.assert_allclose(residual, white, atol=1e-6)
    covariance, by_input = start(parts)
    assert covariance.shape == (8, 8)
    np.testing.assert_array_equal(by_input[:, 0], [0, 1, 0, 0, 0, 0, 0, 0])


def test_linear_factors_are_the_ones_given() -> None:
    import gtsam

    rng = np.random.default_rng(2)
    a, b, rhs = rng.normal(size=(3, 2, 3)), rng.normal(size=(2, 2)), rng.normal(size=(3, 2))
    graph = gtsam.GaussianFactorGraph()
    add_linear_factors(graph, ([0, 1, 2], 9), (a, b), rhs)
    add_linear_factors(graph, ([0], 9), (np.zeros((1, 2, 0)), b), rhs[:1])
    assert graph.size() == 4
    assert list(graph.at(3).keys()) == [9]
    values = gtsam.VectorValues()
    x, y = rng.normal(size=(3, 3)), rng.normal(size=2)
    for i in range(3):
        values.insert(i, x[i])
    values.insert(9, y)
    expected = sum(((a[i] @ x[i] + b @ y - rhs[i]) ** 2).sum() for i in range(3))
    expected += ((b @ y - rhs[0]) ** 2).sum()
    assert 2 * graph.error(values) == pytest.approx(expected)
