"""Bubbles as bodies and as images, against closed forms, Monte-Carlo and brute force."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.stats import special_ortho_group

from telerig.errors import InputError
from telerig.io.images.outline_raster import cell_coverage, refined
from telerig.io.simulation.images.backlight import Specks, random_screen
from telerig.io.simulation.images.bodies import (
    MODES,
    Bodies,
    bodies_about,
    d_eq_mm,
    outline_moments,
    outline_px,
    rim_mm,
    surface_modes,
    volume_centre_mm,
    volume_mm3,
)
from telerig.io.simulation.images.bubbles import (
    Look,
    Silhouette,
    absorption_patch,
    render_bubbles,
    transmission,
)
from telerig.io.simulation.images.sensor import digitise
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec

BLACK = Look(rim=0.0, heart=0.0, ring=0.0)
SIDE = Pose(rotation_from_rotvec([0.05, 1.5, -0.03]), np.array([0.2, -0.1, 0.3]))


def body(modes=None, seed=0, axes=(1.4, 1.1, 0.8), centre=(0.3, -0.2, 0.1)):
    rotation = special_ortho_group.rvs(3, random_state=seed)
    coefficients = np.zeros(len(MODES)) if modes is None else np.asarray(modes, float)
    return bodies_about(np.array(centre), rotation, np.array(axes), coefficients)


def one_mode(degree, order, amplitude):
    modes = np.zeros(len(MODES))
    modes[MODES.index((degree, order))] = amplitude
    return modes


def circle(u, v, radius, count=128):
    angle = np.arange(count) * 2 * np.pi / count
    return np.stack([u + radius * np.cos(angle), v + radius * np.sin(angle)], -1)


def sphere_points(count, seed=0):
    s = np.random.default_rng(seed).standard_normal((count, 3))
    return s / np.linalg.norm(s, axis=1, keepdims=True)


def surface_mm(shape, directions):
    """(N, 3) points of the surface for unit directions (N, 3) in the undeformed sphere."""
    radius = 1 + surface_modes(directions) @ shape.modes
    return shape.origin_mm + (shape.semi_axes_mm * directions * radius[:, None]) @ shape.rotation.T


def test_modes_are_harmonic_orthogonal_and_reach_one():
    s = sphere_points(400_000)
    values = surface_modes(s)
    gram = values.T @ values / len(s)
    off = gram - np.diag(np.diag(gram))
    assert np.abs(off).max() < 5 * 0.4 / np.sqrt(len(s))
    assert np.abs(values.mean(0)).max() < 5 * 0.7 / np.sqrt(len(s))
    assert values.max() <= 1 + 1e-12 and values.min() >= -1 - 1e-12
    assert np.all(np.abs(values).max(0) > 0.998)


def test_axisymmetric_third_mode_is_the_legendre_polynomial():
    s = sphere_points(50)
    z = s[:, 2]
    assert np.allclose(surface_modes(s)[:, MODES.index((3, 0))], (5 * z**3 - 3 * z) / 2, atol=1e-14)


@pytest.mark.parametrize("count", [128, 301])
def test_ellipsoid_silhouette_is_the_projected_ellipse(count):
    """A point is on the rim iff d^T (P S^2 P^T)^-1 d = 1, S the shape matrix (dual quadric)."""
    shape = body()
    for camera in (
        Camera.create("left", (512, 512), 10.0),
        Camera.create("right", (512, 512), 11.0, camera_from_rig=SIDE, skew=0.01, aspect=1.02),
    ):
        step = 1e-3 * np.eye(3)
        projection = (camera.project(step) - camera.project(-step)).T / 2e-3
        dual = projection @ shape.shape_mm @ shape.shape_mm @ projection.T
        offset = outline_px(shape, camera, count) - camera.project(shape.origin_mm)
        radius = np.sqrt(np.einsum("ni,ij,nj->n", offset, np.linalg.inv(dual), offset))
        assert np.abs(radius - 1).max() < 1e-9
        area, centre, second = outline_moments(outline_px(shape, camera, count))
        assert area == pytest.approx(np.pi * np.sqrt(np.linalg.det(dual)), rel=1e-9)
        assert np.allclose(centre, camera.project(shape.origin_mm), atol=1e-8)
        assert np.allclose(second, dual / 4, rtol=1e-9)


def test_batched_outlines_equal_single_ones():
    some = [body(0.03 * np.sin(np.arange(21) + k), seed=k) for k in range(3)]
    fields = zip(*[(b.origin_mm, b.rotation, b.semi_axes_mm, b.modes) for b in some])
    many = Bodies(*(np.stack(field) for field in fields))
    camera = Camera.create("right", (512, 512), 10.0, camera_from_rig=SIDE, k1=2e-3)
    for k, single in enumerate(some):
        assert np.allclose(outline_px(many, camera)[k], outline_px(single, camera), atol=1e-9)


@pytest.mark.parametrize("parameters", [{}, {"k1": 3e-3, "p1": 1e-3}, {"kappa_per_mm": 1e-3}])
@pytest.mark.parametrize("seed", range(3))
def test_no_surface_point_lies_outside_the_outline_and_some_reach_it(seed, parameters):
    rng = np.random.default_rng(seed)
    shape = body(0.06 * rng.standard_normal(21), seed)
    camera = Camera.create("right", (512, 512), 100.0, camera_from_rig=SIDE, **parameters)
    outline = outline_px(shape, camera, 1440)
    centre = camera.project(shape.origin_mm)
    cloud = camera.project(surface_mm(shape, sphere_points(200_000))) - centre
    rim = outline - centre
    angle = np.arctan2(rim[:, 1], rim[:, 0])
    order = np.argsort(angle)
    radius = np.interp(
        np.arctan2(cloud[:, 1], cloud[:, 0]),
        angle[order],
        np.linalg.norm(rim[order], axis=1),
        period=2 * np.pi,
    )
    beyond = np.linalg.norm(cloud, axis=1) - radius
    assert beyond.max() < 2e-3
    sector = np.floor(np.arctan2(cloud[:, 1], cloud[:, 0]) / (2 * np.pi / 60)).astype(int)
    nearest = [beyond[sector == k].max() for k in np.unique(sector)]
    assert min(nearest) > -0.3


def test_rim_touches_the_surface_where_rays_graze_it():
    shape = body(0.05 * np.cos(np.arange(21)), seed=4)
    ray = np.array([0.3, -0.5, 0.81])
    points = rim_mm(shape, ray / np.linalg.norm(ray), 64)
    along = points + 1e-3 * ray
    local = (along - shape.origin_mm) @ shape.rotation / shape.semi_axes_mm
    radius = np.linalg.norm(local, axis=-1)
    surface = 1 + surface_modes(local / radius[:, None]) @ shape.modes
    assert np.all(np.abs(radius - surface) < 2e-5)


def test_volume_and_its_centre_against_monte_carlo():
    rng = np.random.default_rng(3)
    shape = body(0.08 * rng.standard_normal(21), 3)
    count = 600_000
    cloud = rng.uniform(-2, 2, (count, 3))
    radius = np.linalg.norm(cloud, axis=1)
    inside = radius < 1 + surface_modes(cloud / radius[:, None]) @ shape.modes
    scale = np.prod(shape.semi_axes_mm)
    volume = inside.mean() * 64 * scale
    assert volume_mm3(shape) == pytest.approx(volume, rel=4 / np.sqrt(inside.sum()))
    points = shape.origin_mm + (cloud[inside] * shape.semi_axes_mm) @ shape.rotation.T
    error = points.std(0) / np.sqrt(len(points))
    assert np.all(np.abs(volume_centre_mm(shape) - points.mean(0)) < 4.5 * error)


def test_volume_of_an_axisymmetric_body_in_closed_form():
    """Pappus: V = 2 pi / 3 int (1 + c P3)^3 dz, centre = pi / 2 int (1 + c P3)^4 z dz / V."""
    amplitude = 0.2
    shape = body(one_mode(3, 0, amplitude), axes=(1.0, 1.0, 1.0), centre=(0, 0, 0))
    z = np.polynomial.Polynomial([0, 1])
    radius = 1 + amplitude * (5 * z**3 - 3 * z) / 2

    def over_z(polynomial):
        whole = polynomial.integ()
        return whole(1) - whole(-1)

    volume = 2 * np.pi / 3 * over_z(radius**3)
    centre = np.pi / 2 * over_z(radius**4 * z) / volume
    origin = Bodies(np.zeros(3), np.eye(3), np.ones(3), shape.modes)
    assert volume_mm3(origin) == pytest.approx(volume, rel=1e-12)
    assert np.allclose(volume_centre_mm(origin), [0, 0, centre], atol=1e-12)
    assert np.allclose(volume_centre_mm(shape), 0, atol=1e-12)


def test_third_mode_moves_the_silhouette_but_hardly_the_volume():
    """The figures of the design: 0.019 R and about 0.001 R at 5 %."""
    shape = Bodies(np.zeros(3), np.eye(3), np.ones(3), one_mode(3, 0, 0.05))
    camera = Camera.create(
        "left", (512, 512), 1.0, camera_from_rig=Pose(np.eye(3)[[2, 0, 1]], np.zeros(3))
    )
    _, centre, _ = outline_moments(outline_px(shape, camera, 256) - 255.5)
    assert np.linalg.norm(centre) == pytest.approx(0.019, abs=0.001)
    assert np.linalg.norm(volume_centre_mm(shape)) < 0.002


def test_equal_diameter_is_kept_whatever_the_modes():
    modes = 0.1 * np.random.default_rng(0).standard_normal((5, 21))
    turn = special_ortho_group.rvs(3, 5, random_state=0)
    wanted = np.linspace(1, 3, 5)
    many = bodies_about(np.zeros((5, 3)), turn, np.ones((5, 3)), modes, d_eq_mm=wanted)
    assert np.allclose(d_eq_mm(many), wanted, rtol=1e-12)
    assert np.allclose(volume_centre_mm(many), 0, atol=1e-12)


def test_coverage_is_exact_for_polygons():
    triangle = np.array([[1.25, 1.5], [6.5, 2.25], [3.0, 5.75]])
    coverage = cell_coverage(triangle, (8, 8))
    x, y = triangle.T
    area = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
    assert coverage.sum() == pytest.approx(area, rel=1e-12)
    assert coverage.min() > -1e-12 and coverage.max() < 1 + 1e-12
    square = np.array([[1.0, 1.0], [1.0, 3.0], [4.0, 3.0], [4.0, 1.0]])
    expected = np.zeros((5, 6))
    expected[1:3, 1:4] = 1
    assert np.allclose(cell_coverage(square, (5, 6)), expected, atol=1e-12)
    half = np.array([[0.5, 0.25], [2.5, 0.25], [2.5, 0.75], [0.5, 0.75]])
    assert np.allclose(cell_coverage(half, (1, 3)), [[0.25, 0.5, 0.25]], atol=1e-12)


def test_coverage_against_brute_force():
    rng = np.random.default_rng(5)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 40))
    blob = 10 + (6 + np.sin(3 * angle))[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    coverage = cell_coverage(blob, (20, 20))
    points = rng.uniform(0, 20, (400_000, 2))
    x, y = points.T[:, :, None]
    (x0, y0), (x1, y1) = blob.T, np.roll(blob, -1, 0).T
    hit = ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) / (y1 - y0 + 1e-300) * (x1 - x0))
    inside = hit.sum(1) % 2 == 1
    count = np.histogram2d(*points[inside].T[::-1], bins=20, range=[[0, 20]] * 2)[0]
    total = np.histogram2d(*points.T[::-1], bins=20, range=[[0, 20]] * 2)[0]
    assert np.abs(count / total - coverage).max() < 0.09
    assert np.abs((count / total - coverage).sum()) < 4 * np.sqrt(400 / 400_000) * 10


def test_refined_outlines_keep_their_points():
    outline = circle(3.0, 4.0, 2.0, 16)
    assert np.allclose(refined(outline, 64)[::4], outline, atol=1e-12)
    assert np.allclose(np.linalg.norm(refined(outline, 64) - [3, 4], axis=1), 2, atol=1e-12)


@pytest.mark.parametrize("radius", [3.0, 8.3, 25.7])
@pytest.mark.parametrize("smear", [(0.0, 0.0), (1.7, -0.9)])
def test_dark_area_and_centre_of_a_disc(radius, smear):
    patch = absorption_patch(Silhouette(circle(60.3, 41.8, radius), BLACK, 0.9, smear))
    dark = patch.absorption.astype(float)
    area = dark.sum()
    assert area == pytest.approx(np.pi * radius**2, rel=2e-4)
    v, u = np.mgrid[: dark.shape[0], : dark.shape[1]]
    centre = np.array([(dark * u).sum(), (dark * v).sum()]) / area + [patch.column, patch.row]
    assert np.allclose(centre, [60.3, 41.8], atol=2e-4)
    spread = (dark * (u - u[0].mean()) * (v - v[:, 0].mean())).sum() / area
    offset = centre - [patch.column + u[0].mean(), patch.row + v[:, 0].mean()]
    covariance = spread - offset[0] * offset[1]
    assert covariance == pytest.approx(smear[0] * smear[1] / 12, abs=3e-3)
    uu = (dark * (u + patch.column - centre[0]) ** 2).sum() / area
    assert uu == pytest.approx(radius**2 / 4 + 0.81 + 1 / 12 + smear[0] ** 2 / 12, rel=1e-3)


def test_blurred_ellipse_against_dense_sampling():
    """33 x 33 points per pixel, inside or not, then a Gaussian on that grid, then pixel means."""
    angle = np.arange(128) * 2 * np.pi / 128
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    outline = np.stack([9.0 * np.cos(angle), 5.0 * np.sin(angle)], -1) @ turn.T + [20.2, 19.6]
    n = 33
    place = (np.arange(40 * n) + 0.5) / n - 0.5
    d = (np.stack(np.meshgrid(place, place), -1) - [20.2, 19.6]) @ turn / [9.0, 5.0]
    fine = gaussian_filter((np.sum(d * d, -1) < 1).astype(float), 1.1 * n, truncate=6)
    expected = 1 - fine.reshape(40, n, 40, n).mean((1, 3))
    got = transmission((40, 40), [Silhouette(outline, BLACK, 1.1)])
    assert np.abs(got - expected).max() < 1e-3


def test_heart_and_rim():
    look = Look(rim=0.1, heart=0.9, heart_radius=0.4, heart_sharpness=40, ring=0.0)
    image = transmission((101, 101), [Silhouette(circle(50, 50, 30), look, 0.8)])
    assert image[50, 50] == pytest.approx(0.9, abs=1e-3)
    assert image[50, 72] == pytest.approx(0.1, abs=1e-3)
    assert image[50, 99] == pytest.approx(1.0, abs=1e-6)
    across = image[50, 50:75]
    assert np.argmin(np.abs(across - 0.5)) == pytest.approx(12, abs=1)
    dark_all_over = Look(rim=0.1, heart=0.0, ring=0.0)
    image = transmission((101, 101), [Silhouette(circle(50, 50, 30), dark_all_over, 0.8)])
    assert image[50, 50] == pytest.approx(0.1, abs=1e-6)


def test_overlapping_bubbles_multiply_and_windows_are_clipped():
    bubbles = [Silhouette(circle(x, 20.0, 12.0), Look(), 1.0) for x in (2.0, 15.0)]
    together = transmission((50, 40), bubbles)
    alone = [transmission((50, 40), [bubble]) for bubble in bubbles]
    assert np.allclose(together, alone[0] * alone[1], atol=1e-6)
    far = Silhouette(circle(-300.0, 20.0, 12.0), Look(), 1.0)
    assert np.all(transmission((50, 40), [far]) == 1)


def test_screen_moves_by_the_shift_and_keeps_its_vignetting():
    screen = random_screen(
        np.random.default_rng(1), level=0.7, gradient=0.1, vignetting=0.0, texture=0.05
    )
    still, moved = (screen.image((200, 120), np.array(s)) for s in ([0.0, 0.0], [7.0, -3.0]))
    assert np.allclose(moved[:117, 7:], still[3:, :193], atol=2e-5)
    assert still.std() > 0.005 and abs(still.mean() - 0.7) < 0.15


def test_dirt_on_the_window_moves_and_dirt_on_the_lens_stays():
    screen = random_screen(
        np.random.default_rng(1), level=0.8, gradient=0.0, vignetting=0.0, texture=0.0
    )
    speck = Specks(np.array([[30.0, 20.0]]), np.array([1.5]), np.array([0.5]))
    image = render_bubbles(
        (80, 60),
        [],
        screen,
        screen_shift_px=np.zeros(2),
        window_dirt=speck,
        lens_dirt=speck,
        lab_shift_px=np.array([10.0, 25.0]),
    )
    assert image[20, 30] == pytest.approx(0.4, abs=1e-5)
    assert image[45, 40] == pytest.approx(0.4, abs=1e-5)
    assert image[5, 5] == pytest.approx(0.8, abs=1e-5)


@pytest.mark.parametrize("depth, kind", [(8, np.uint8), (10, np.uint16), (16, np.uint16)])
def test_noise_has_the_spread_asked_for(depth, kind):
    grey = np.full((300, 300), 0.5, np.float32)
    image = digitise(
        grey, np.random.default_rng(0), read_noise=0.01, shot_noise=0.02, bit_depth=depth
    )
    full = 2**depth - 1
    expected = np.sqrt((0.01**2 + 0.5 * 0.02**2) * full**2 + 1 / 12)
    assert image.dtype == kind
    assert image.std() == pytest.approx(expected, rel=0.02)
    assert image.mean() == pytest.approx(full / 2, abs=5 * expected / 300)


def test_light_beyond_full_scale_is_cut_and_other_bit_depths_are_refused():
    grey = np.linspace(0, 1.2, 4096, dtype=np.float32).reshape(64, 64)
    image = digitise(grey, np.random.default_rng(0), read_noise=0.0, shot_noise=0.0, bit_depth=12)
    assert image.min() == 0 and image.max() == 4095
    with pytest.raises(InputError, match="bit depth of 7"):
        digitise(grey, np.random.default_rng(0), read_noise=0.0, shot_noise=0.0, bit_depth=7)
