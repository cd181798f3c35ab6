"""The renderer against polygon areas, closed-form blur and hand-made geometry."""

import numpy as np
import pytest

from telerig.io.simulation.images.plates import (
    Light,
    Plate,
    disc_coverage,
    pixel_from_plate,
    plate_from_pixel,
    render,
)
from telerig.io.simulation.images.sensor import digitise
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

SIZE = (120, 110)
POSES = {
    "frontal": Pose.identity(),
    "tilted 46 deg": Pose.from_rotvec([0.3, 0.75, 0.2]),
    "tilted 65 deg": Pose.from_rotvec([-1.1, 0.3, 1.0]),
}
LENSES = {
    "ideal": {},
    "radial": {"k1": 0.05, "k2": -0.02},
    "brown": {"k1": -0.03, "p1": 0.004, "p2": -0.003, "s1": 0.002},
    "kappa": {"kappa_per_mm": 2e-3},
    "tilted sensor": {"tilt_x": 0.1, "tilt_y": -0.08, "image_convergence_per_mm": 1 / 100},
    "aspect, skew": {"aspect": 1.02, "skew": 0.01},
}


def camera_of(lens: str) -> Camera:
    return Camera.create("left", SIZE, 10.0, **LENSES[lens])


def plate_of(dots, diameter, hole=0.0, **extra) -> Plate:
    dots = np.asarray(dots, float)
    full = np.ones(len(dots))
    return Plate(dots, diameter * full, hole * full, **extra)


def coverage(camera, pose, plate, blur):
    return disc_coverage(camera, pose, plate, plate.dots_mm, plate.diameter_mm, plate.hole_mm, blur)


def polygon_area_centroid(camera, pose, centre, radius):
    """Area and centroid of the projected outline, by Green's theorem on 20,000 corners."""
    angle = np.linspace(0, 2 * np.pi, 20001)[:-1]
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    rim = camera.project(pose.apply(np.asarray(centre) + radius * circle))
    after = np.roll(rim, -1, 0)
    cross = rim[:, 0] * after[:, 1] - after[:, 0] * rim[:, 1]
    area = cross.sum() / 2
    return abs(area), ((rim + after) * cross[:, None]).sum(0) / (6 * area)


def grey_centroid(grey):
    v, u = np.indices(grey.shape)
    return np.array([np.sum(grey * u), np.sum(grey * v)]) / np.sum(grey)


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("blur", [0.6, 0.8, 1.7])
def test_disc_is_where_its_outline_is(pose, lens, blur):
    camera = camera_of(lens)
    centre = [1.13, -0.57, 0.02]
    got = coverage(camera, pose, plate_of([centre], 2.4), blur)
    area, centroid = polygon_area_centroid(camera, pose, centre, 1.2)
    assert np.allclose(grey_centroid(got), centroid, atol=5e-5)
    assert got.sum() == pytest.approx(area, rel=1e-4)
    assert got.max() == pytest.approx(1, abs=1e-3 if blur < 1 else 0.05)


@pytest.mark.parametrize("radius_px", [2.0, 3.0, 6.0, 20.0])
def test_small_and_large_discs_over_sub_pixel_places(radius_px):
    rng = np.random.default_rng(1)
    camera, pose = camera_of("radial"), POSES["tilted 46 deg"]
    for offset in rng.uniform(-0.05, 0.05, (6, 2)):
        centre = [0.4 + offset[0], 0.3 + offset[1], 0.0]
        got = coverage(camera, pose, plate_of([centre], radius_px / 5), 0.6)
        area, centroid = polygon_area_centroid(camera, pose, centre, radius_px / 10)
        assert np.allclose(grey_centroid(got), centroid, atol=2e-4)
        assert got.sum() == pytest.approx(area, rel=6e-4)


def test_without_blur_pixels_hold_the_share_that_brute_force_counts():
    camera, pose = camera_of("brown"), POSES["tilted 46 deg"]
    got = coverage(camera, pose, plate_of([[0.5, 0.2, 0]], 2.4), 0.0)
    fine = (np.arange(64) + 0.5) / 64 - 0.5
    for v, u in ((45, 62), (50, 75), (56, 53), (64, 69), (56, 62)):
        cells = np.stack(np.meshgrid(u + fine, v + fine), -1)
        xy = plate_from_pixel(camera, pose, cells, plate_of([[0, 0, 0]], 1.0))
        brute = np.mean(np.sum((xy - [0.5, 0.2]) ** 2, -1) < 1.44)
        assert got[v, u] == pytest.approx(brute, abs=1e-3)


def test_blur_has_the_stated_width():
    camera, plate = camera_of("ideal"), plate_of([[0, 0, 0]], 3.0)
    second = []
    for blur in (0.7, 1.0, 2.0):
        got = coverage(camera, Pose.identity(), plate, blur)
        u = np.arange(SIZE[0]) - grey_centroid(got)[0]
        second.append(np.sum(got * u**2) / got.sum())
    assert second[0] == pytest.approx(15**2 / 4 + 1 / 12 + 0.49, abs=2e-3)
    assert np.allclose(np.subtract(second, second[0]), [0, 0.51, 3.51], atol=1e-3)


def test_edge_profile_is_the_blurred_error_function():
    from scipy.stats import norm

    radius, blur = 4.0, 0.8
    got = coverage(camera_of("ideal"), Pose.identity(), plate_of([[0.05, 0.05, 0]], 8.0), blur)
    row = got[55, 60:]
    fine = np.linspace(-0.5, 0.5, 401)
    edge_px = 60.0 + 10 * radius - np.arange(60, 120)
    expected = norm.cdf((edge_px[:, None] - fine) / blur).mean(1)
    assert np.allclose(row, expected, atol=0.01)
    assert np.abs(row - expected).max() < 1.5 * blur**2 / (2 * 40) * norm.pdf(0) / blur


def test_ring_hole_is_subtracted_and_concentric():
    camera, pose = camera_of("radial"), POSES["tilted 46 deg"]
    outer = coverage(camera, pose, plate_of([[0.5, 0.2, 0]], 3.0), 0.8)
    hole = coverage(camera, pose, plate_of([[0.5, 0.2, 0]], 1.2), 0.8)
    ring = coverage(camera, pose, plate_of([[0.5, 0.2, 0]], 3.0, 1.2), 0.8)
    assert np.allclose(ring, outer - hole, atol=2e-4)


def test_glass_between_shifts_a_view_from_behind_by_snells_law():
    camera, tilt, thickness, index = camera_of("ideal"), 0.5, 3.0, 1.5
    behind = Pose.from_rotvec([0, np.pi, 0]) @ Pose.from_rotvec([0, tilt, 0])
    glass = plate_of([[0, 0, 0]], 1.0, thickness_mm=thickness, index=index)
    bare = plate_of([[0, 0, 0]], 1.0)
    shift = pixel_from_plate(camera, behind, [[0, 0, 0]], glass) - pixel_from_plate(
        camera, behind, [[0, 0, 0]], bare
    )
    inside = np.arcsin(np.sin(tilt) / index)
    parallel_offset = thickness * np.sin(tilt - inside) / np.cos(inside)
    assert np.abs(shift[0, 0]) == pytest.approx(10 * parallel_offset, rel=1e-12)
    in_front = Pose.from_rotvec([0, tilt, 0])
    assert np.allclose(
        pixel_from_plate(camera, in_front, [[1, 0, 0]], glass),
        pixel_from_plate(camera, in_front, [[1, 0, 0]], bare),
    )


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("thickness", [0.0, 2.0])
def test_plate_round_trip(lens, thickness):
    rng = np.random.default_rng(3)
    camera = camera_of(lens)
    pose = Pose.from_rotvec([0.2, 2.6, -0.1], [0.3, -0.4, 1.0])
    plate = plate_of([[0, 0, 0]], 1.0, thickness_mm=thickness)
    points = np.c_[rng.uniform(-4, 4, (50, 2)), 0.05 * rng.standard_normal(50)]
    uv = pixel_from_plate(camera, pose, points, plate)
    back = plate_from_pixel(camera, pose, uv, plate, points[:, 2])
    assert np.allclose(back, points[:, :2], atol=1e-10)


def test_levels_polarity_plate_edge_and_light():
    camera = Camera.create("left", (200, 160), 10.0)
    plate = plate_of(
        [[0, 0, 0]], 3.0, outline_mm=(-5, -4, 5, 4), dot_albedo=0.1, plate_albedo=0.8,
        background_albedo=0.3,
    )  # fmt: skip
    grey = render(camera, Pose.identity(), plate, Light(), blur_px=0.8)
    assert grey[80, 100] == pytest.approx(0.1, abs=1e-6)
    assert grey[80, 130] == pytest.approx(0.8, abs=1e-6)
    assert grey[5, 5] == pytest.approx(0.3, abs=1e-6)
    across = np.sum(grey[80, 125:170] - 0.3) / 0.5
    assert across == pytest.approx(99.5 + 50 - 124.5, abs=1e-3)
    bright = render(camera, Pose.identity(), plate, Light(1.2, (0.2, -0.1), 0.1), blur_px=0.8)
    half = np.hypot(200, 160) / 2
    u, v = (130 - 99.5) / half, (80 - 79.5) / half
    expected = 0.8 * 1.2 * (1 + 0.2 * u - 0.1 * v - 0.1 * (u * u + v * v))
    assert bright[80, 130] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("bits, kind", [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_digitise_levels_and_noise(bits, kind):
    grey = np.full((200, 200), 0.4)
    image = digitise(grey, np.random.default_rng(0), read_noise=0.01, bit_depth=bits)
    full = 2**bits - 1
    assert image.dtype == kind
    assert image.mean() == pytest.approx(0.4 * full, rel=1e-3)
    assert image.std() == pytest.approx(np.hypot(0.01 * full, 12**-0.5), rel=0.02)
    shot = digitise(grey, np.random.default_rng(0), read_noise=0, shot_noise=0.02, bit_depth=16)
    assert shot.std() == pytest.approx(0.02 * np.sqrt(0.4) * 65535, rel=0.02)
    assert digitise(grey + 9, np.random.default_rng(0), read_noise=0.01).min() == 255
