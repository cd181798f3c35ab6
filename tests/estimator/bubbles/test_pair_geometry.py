"""Matching: geometry by hand, probabilities by enumeration."""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np
import pytest
from matching_scenes import Array, geometry, groups_of, rig, table, views

from telerig.estimator.bubbles.outline.ellipse_geometry import HARMONIC_COLUMNS
from telerig.estimator.bubbles.pairing import kernels
from telerig.estimator.bubbles.pairing.groups import NEGLIGIBLE, outline_extent
from telerig.estimator.bubbles.pairing.learning import default_model
from telerig.rig.outline import HARMONICS
from telerig.rig.pose import Pose

# Geometry


@pytest.mark.parametrize("angle_deg", [60.0, 90.0, 120.0])
@pytest.mark.parametrize(
    "lens", [{}, {"kappa_per_mm": 1 / 800}, {"k1": 0.02, "p1": 0.003}], ids=["tele", "near", "bent"]
)
def test_gap_of_one_point_is_nothing_and_counts_pixels(
    angle_deg: float, lens: dict[str, float]
) -> None:
    cameras = rig(angle_deg, **lens)
    points = np.random.default_rng(0).uniform(-15, 15, (9, 3))
    uv = [c.project(points) for c in cameras]
    found = geometry(table(uv[0], 1e-6), table(uv[1], 1e-6), cameras)
    np.testing.assert_allclose(np.diag(found.gap_px), 0, atol=1e-4)
    np.testing.assert_allclose(found.points_mm[range(9), range(9)], points, atol=1e-9)
    up = geometry(table(uv[0] + [0, 0.5], 1e-6), table(uv[1], 1e-6), cameras)
    np.testing.assert_allclose(np.diag(up.gap_px), 0.5, rtol=0.05)
    both = geometry(table(uv[0] + [0, 0.5], 1e-6), table(uv[1] + [0, 0.5], 1e-6), cameras)
    np.testing.assert_allclose(np.diag(both.gap_px), 0, atol=0.05)


def test_variance_of_the_gap_is_its_spread() -> None:
    cameras = rig(75.0, kappa_per_mm=1 / 500, k1=0.02)
    rng = np.random.default_rng(1)
    point = np.array([[9.0, -11.0, 6.0]])
    covariance = np.array([[0.05, 0.02], [0.02, 0.03]])
    uv = [c.project(point) + rng.multivariate_normal([0, 0], covariance, 900) for c in cameras]
    tables = [table(p, 1e-6).assign(suu_px2=0.05, suv_px2=0.02, svv_px2=0.03) for p in uv]
    rows = np.tile(np.arange(900)[:, None], 2)
    found = groups_of(tables, default_model(cameras), rows)
    spread = np.var(found.innovation_px)
    assert spread == pytest.approx(found.noise_px2[0, 0, 0], rel=0.15)


@pytest.mark.parametrize("angle_deg", [50.0, 90.0, 130.0])
def test_images_anywhere_have_gaps_anywhere_in_the_span(angle_deg: float) -> None:
    cameras = rig(angle_deg)
    model = default_model(cameras)
    points = np.random.default_rng(2).uniform(-15, 15, (9, 3))
    tables = [table(c.project(points)) for c in cameras]
    found = groups_of(tables, model, np.tile(np.arange(9)[:, None], 2))
    # the innovation is the gap over sqrt(2), and its density that of a normal distribution
    span = model.pairs[0, 1].span_px / 2**0.5
    np.testing.assert_allclose(found.constant, np.log(span) - np.log(2 * np.pi) / 2, atol=1e-6)
    gap = np.diag(geometry(*tables, cameras).gap_px)
    moved = tables[0].assign(v_px=tables[0]["v_px"] + 1.0)
    more = groups_of([moved, tables[1]], model, np.tile(np.arange(9)[:, None], 2))
    change = np.diag(geometry(moved, tables[1], cameras).gap_px) - gap
    np.testing.assert_allclose(change**2, 2 * more.innovation_px[:, 0] ** 2, rtol=1e-3)


@pytest.mark.parametrize("angle_deg", [50.0, 90.0, 130.0])
def test_an_ellipsoid_has_one_height_in_both_views(angle_deg: float) -> None:
    """A telecentric silhouette of x' M^-1 x = 1 is the ellipse of the projected M."""
    cameras, rng = rig(angle_deg), np.random.default_rng(2)
    for _ in range(20):
        turn = Pose.from_rotvec(rng.normal(0, 1, 3)).rotation
        body = turn @ np.diag(rng.uniform(0.4, 1.6, 3) ** 2) @ turn.T
        point = rng.uniform(-10, 10, (1, 3))
        tables = []
        for camera in cameras:
            to_pixel = 20.0 * camera.camera_from_rig.rotation[:2]
            values, vectors = np.linalg.eigh(to_pixel @ body @ to_pixel.T)
            angle = np.arctan2(vectors[1, 1], vectors[0, 1])
            semi_axes = [[np.sqrt(values[1]), np.sqrt(values[0])]]
            tables.append(table(camera.project(point), semi_axes, angle=angle))
        found = geometry(*tables, cameras)
        assert found.size[0, 0, 0] == pytest.approx(0, abs=1e-12)
        assert found.gap_px[0, 0] == pytest.approx(0, abs=1e-9)
        half = np.exp(views(*tables, cameras)[0].log_size[0, 0, 0])
        assert half == pytest.approx(np.sqrt(body[1, 1]), rel=1e-12)


def test_extent_with_harmonics_is_that_of_the_dense_outline() -> None:
    rng = np.random.default_rng(3)
    rows = table(np.zeros((30, 2)), np.sort(rng.uniform(12, 30, (30, 2)))[:, ::-1])
    rows["angle_rad"] = rng.uniform(-2, 2, 30)
    rows[HARMONIC_COLUMNS] = rng.normal(0, 0.4, (30, 8))
    rows.loc[0, HARMONIC_COLUMNS] = np.nan
    across = rng.normal(0, 1, (30, 2))
    middle, half = outline_extent(rows, across)
    phi = np.linspace(0, 2 * np.pi, 20001)
    for i, row in enumerate(rows.to_dict("records")):
        c, s = np.cos(row["angle_rad"]), np.sin(row["angle_rad"])
        point = np.stack([row["a_px"] * np.cos(phi), row["b_px"] * np.sin(phi)])
        normal = np.stack([row["b_px"] * np.cos(phi), row["a_px"] * np.sin(phi)])
        normal /= np.linalg.norm(normal, axis=0)
        if i:
            for k in HARMONICS:
                wave = row[f"c{k}_px"] * np.cos(k * phi) + row[f"s{k}_px"] * np.sin(k * phi)
                point = point + normal * wave
        along = across[i] @ (np.array([[c, -s], [s, c]]) @ point)
        assert half[i] == pytest.approx((along.max() - along.min()) / 2, rel=2e-4)
        assert middle[i] == pytest.approx((along.max() + along.min()) / 2, abs=5e-3)


# Probabilities


def marginals(log_odds: Array) -> Array:
    rows = np.stack(np.unravel_index(np.arange(log_odds.size), log_odds.shape), -1)
    found = kernels.marginals(log_odds.ravel(), rows, np.array(log_odds.shape), NEGLIGIBLE)
    return np.asarray(found.reshape(log_odds.shape))


def enumerated(log_odds: Array) -> Array:
    n, m = log_odds.shape
    out, total = np.zeros((n, m)), 0.0
    for size in range(min(n, m) + 1):
        for rows in combinations(range(n), size):
            for columns in permutations(range(m), size):
                weight = float(np.exp(sum(log_odds[i, j] for i, j in zip(rows, columns))))
                total += weight
                for i, j in zip(rows, columns):
                    out[i, j] += weight
    return out / total


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (4, 1), (3, 5), (5, 3), (4, 4)])
def test_probabilities_are_those_of_all_assignments(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(shape))
    for spread in (0.5, 3.0):
        odds = rng.normal(0, spread, shape)
        np.testing.assert_allclose(marginals(odds), enumerated(odds), rtol=1e-10)


def test_many_detections_around_a_few_are_no_overflow() -> None:
    """The product of 200 rows' odds to have no partner was 0, and all probabilities NaN."""
    odds = np.full((200, 2), 25.0)
    np.testing.assert_allclose(marginals(odds), 1.0 / 200, rtol=1e-6)


def test_large_clusters_are_near_the_exact_answer() -> None:
    rng = np.random.default_rng(5)
    odds = np.full((13, 13), -np.inf)
    for i in range(13):
        odds[i, i] = rng.normal(2, 1)
        odds[i, (i + 1) % 13] = rng.normal(0, 1)
    many = marginals(odds)
    cut = odds.copy()
    cut[12, 0] = -np.inf
    exact = marginals(cut[:11, :12])
    np.testing.assert_allclose(many[3:8, 3:8], exact[3:8, 3:8], atol=0.03)
    assert (many.sum(0) <= 1 + 1e-9).all() and (many.sum(1) <= 1 + 1e-9).all()
