"""The camera model: values against independent formulas, derivatives, inverses, batch axes."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from telerig.errors import GeometryError, InputError
from telerig.rig import projection
from telerig.rig.camera import Camera
from telerig.rig.lens_parameters import (
    INDEX,
    PARAMETERS,
)
from telerig.rig.pose import Pose, rotation_from_rotvec

MODELS = {
    "ideal": {},
    "radial": {"k1": 0.02, "k2": -0.003, "k3": 0.001},
    "brown": {"k1": -0.03, "p1": 0.004, "p2": -0.002},
    "prism": {"s1": 0.003, "s2": 0.001, "s3": -0.002, "s4": 0.004},
    "kappa": {"kappa_per_mm": 0.0054},
    "bilateral tilt": {"tilt_x": 0.1, "tilt_y": -0.05},
    "object-side tilt": {"tilt_x": 0.1, "tilt_y": -0.05, "image_convergence_per_mm": 0.002},
    "all": {
        "aspect": 1.01, "skew": 0.003, "kappa_per_mm": -1e-3, "k1": 0.02, "k2": 0.01, "p1": 2e-3,
        "p2": 1e-3, "s1": 1e-3, "s3": 2e-3, "tilt_x": 0.08, "tilt_y": 0.1,
        "image_convergence_per_mm": 1e-3, "centre_u_px": 260.0, "centre_v_px": 240.0,
    },
}  # fmt: skip


def camera(model: str, pose: Pose | None = None) -> Camera:
    return Camera.create("left", (512, 480), 10.0, camera_from_rig=pose, **MODELS[model])


def points(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.uniform([-24, -22, -20], [24, 22, 20], (*shape, 3))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("shape", [(), (1,), (7,), (2, 3)])
def test_unproject_inverts_project(model, shape):
    rng = np.random.default_rng(1)
    cam = camera(model, Pose.from_rotvec(rng.normal(size=3), rng.normal(size=3)))
    in_rig = cam.rig_from_camera.apply(np.atleast_2d(points(rng, *shape))).reshape(*shape, 3)
    uv = cam.project(in_rig)
    origin, direction = cam.unproject(uv)
    assert uv.shape == (*shape, 2) and origin.shape == direction.shape == (*shape, 3)
    gap = np.linalg.norm(np.cross(in_rig - origin, direction), axis=-1)
    assert np.max(gap) < 1e-11
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, rtol=1e-14)


@pytest.mark.parametrize("given", [[1], [[1, 2, 3, 4]], 5.0, [], "abc", [[1, 2, 3], [1, 2]]])
def test_what_is_no_array_of_points_or_pixels(given):
    one, two, three = camera("all"), [1, 2], [[1, 2, 3]]
    for function, wrong, size in (
        (one.project, two, 3), (one.unproject, three, 2), (one.distorted_pixel, three, 2),
    ):  # fmt: skip
        for bad in (given, wrong):
            with pytest.raises(InputError) as error:
                function(bad)
            assert "left" in error.value.where and f"(..., {size})" in error.value.todo


@pytest.mark.parametrize("model", MODELS)
def test_jacobians_agree_with_central_differences(model):
    cam, rng = camera(model), np.random.default_rng(2)
    p = np.concatenate([points(rng, 9), np.zeros((1, 3)), [[1e-9, 0, 3.0]]])
    uv, by_point, by_intrinsics = projection.pixel_jacobians(p, cam.intrinsics, cam.rho_mm)
    np.testing.assert_allclose(
        uv, projection.pixel_from_camera(p, cam.intrinsics, cam.rho_mm), rtol=0, atol=1e-11
    )
    h = 1e-6
    for i in range(3):
        step = h * np.eye(3)[i]
        plus = projection.pixel_from_camera(p + step, cam.intrinsics, cam.rho_mm)
        minus = projection.pixel_from_camera(p - step, cam.intrinsics, cam.rho_mm)
        np.testing.assert_allclose(by_point[..., i], (plus - minus) / (2 * h), atol=2e-6)
    for name in PARAMETERS:
        step = h * np.eye(len(PARAMETERS))[INDEX[name]]
        plus = projection.pixel_from_camera(p, cam.intrinsics + step, cam.rho_mm)
        minus = projection.pixel_from_camera(p, cam.intrinsics - step, cam.rho_mm)
        slope = (plus - minus) / (2 * h)
        np.testing.assert_allclose(
            by_intrinsics[..., INDEX[name]], slope, atol=1e-6 * (1 + np.abs(slope).max())
        )


def test_distortion_is_opencv_s():
    rng = np.random.default_rng(3)
    xy = rng.uniform(-0.5, 0.5, (20, 2))
    k1, k2, k3, p1, p2, s1, s2, s3, s4 = c = rng.normal(size=9) * 0.05
    cv_order = np.array([k1, k2, p1, p2, k3, 0, 0, 0, s1, s2, s3, s4])
    expected, _ = cv2.projectPoints(
        np.c_[xy, np.ones(20)], np.zeros(3), np.zeros(3), np.eye(3), cv_order
    )
    np.testing.assert_allclose(projection.distort(xy, c), expected.reshape(-1, 2), atol=1e-13)


def test_perspective_limit_is_opencv_s_pinhole():
    """kappa = 1 / working distance, focal length = scale / kappa, origin moved to the centre."""
    rng = np.random.default_rng(4)
    kappa, scale = 0.0054, 68.0
    cam = Camera.create("left", (2448, 2048), scale, kappa_per_mm=kappa)
    p = rng.uniform(-15, 15, (30, 3))
    f = scale / kappa
    matrix = np.array([[f, 0, (2448 - 1) / 2], [0, f, (2048 - 1) / 2], [0, 0, 1]])
    expected, _ = cv2.projectPoints(p + [0, 0, 1 / kappa], np.zeros(3), np.zeros(3), matrix, None)
    np.testing.assert_allclose(cam.project(p), expected.reshape(-1, 2), atol=1e-9)


@pytest.mark.parametrize("convergence", [0.0, 1 / 300])
def test_tilted_sensor_against_ray_plane_intersection(convergence):
    """Trace each image ray onto a really tilted plane and read in-plane coordinates there."""
    tau, azimuth = 0.15, 0.7
    axis = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
    turned = rotation_from_rotvec(tau * axis)
    normal = turned[:, 2]
    xy = np.random.default_rng(5).uniform(-20, 20, (15, 2))
    if convergence:
        start, towards = np.zeros((15, 3)), np.c_[xy, np.full(15, 1 / convergence)]
        plane = np.array([0, 0, 1 / convergence])
    else:
        start, towards, plane = np.c_[xy, np.zeros(15)], np.tile([0.0, 0, 1], (15, 1)), np.zeros(3)
    length = ((plane - start) @ normal) / (towards @ normal)
    on_plane = (start + length[:, None] * towards - plane) @ turned[:, :2]
    q = -np.tan(tau) * np.array([np.cos(azimuth), np.sin(azimuth)])
    cam = Camera.create(
        "c", (512, 512), 10.0, tilt_x=q[0], tilt_y=q[1], image_convergence_per_mm=convergence
    )
    got = projection.sensor_from_distorted(xy, cam.intrinsics)
    in_plane_turn = got.T @ on_plane
    u, _, vt = np.linalg.svd(in_plane_turn)
    np.testing.assert_allclose(got @ (u @ vt), on_plane, atol=1e-11)
    np.testing.assert_allclose(u @ vt, np.eye(2), atol=1e-12)


def test_bilateral_tilt_sign_cannot_be_seen():
    p = np.random.default_rng(6).uniform(-20, 20, (9, 3))
    one = Camera.create("c", (512, 512), 10.0, tilt_x=0.1, tilt_y=0.2)
    np.testing.assert_array_equal(
        one.project(p), one.with_parameters(tilt_x=-0.1, tilt_y=-0.2).project(p)
    )


@pytest.mark.parametrize("model", MODELS)
def test_mirror_twin_has_the_same_pixels(model):
    rng = np.random.default_rng(7)
    cam = camera(model, Pose.from_rotvec([0.1, 1.2, -0.2], [0.3, 0.1, -0.2]))
    p = points(rng, 12)
    flip, pose = np.diag([1.0, 1.0, -1.0]), cam.camera_from_rig
    twin = replace(
        cam.with_parameters(kappa_per_mm=-cam["kappa_per_mm"]),
        camera_from_rig=Pose(flip @ pose.rotation @ flip, flip @ pose.translation_mm),
    )
    np.testing.assert_allclose(twin.project(p @ flip), cam.project(p), atol=1e-10)


def test_undistort_refuses_beyond_the_fold():
    with pytest.raises(GeometryError, match="cannot be inverted for 1 of 2 points"):
        projection.undistort(np.array([[0.1, 0.1], [0.9, 0.9]]), np.array([-0.4] + [0.0] * 8))


def test_project_refuses_points_behind_the_centre():
    cam = Camera.create("left", (512, 512), 10.0, kappa_per_mm=0.01)
    with pytest.raises(GeometryError, match="behind the perspective centre of camera 'left'"):
        cam.project([0, 0, -101.0])


def test_unknown_parameter_is_named():
    with pytest.raises(GeometryError, match="kapa"):
        Camera.create("left", (512, 512), 10.0, kapa=1.0)
