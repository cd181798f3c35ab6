"""Matching across views: geometry by hand, probabilities by enumeration, random scenes by truth."""

from __future__ import annotations

from itertools import combinations, permutations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.estimator.frontend.bubble_types import HARMONIC_COLUMNS, HARMONICS, Prediction
from telerig.estimator.frontend.matching import match_pairs
from telerig.estimator.frontend.pair_geometry import (
    outline_extent,
    pair_geometry,
    shared_axis,
    view_of,
)
from telerig.estimator.frontend.pair_marginals import best_assignment, marginals
from telerig.estimator.frontend.pair_model import default_model, estimate_pair_model
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

Array = NDArray[np.float64]
Frame = tuple[pd.DataFrame, pd.DataFrame]

PAIR = Path(__file__).parents[2] / "shared" / "real" / "bubble_pair"


def rig(angle_deg: float = 90.0, **lens: float) -> tuple[Camera, Camera]:
    turn = Pose.from_rotvec([0.0, np.radians(angle_deg), 0.0])
    return (
        Camera.create("left", (1280, 800), 20.0, **lens),
        Camera.create("right", (1280, 800), 20.0, camera_from_rig=turn, **lens),
    )


def table(uv: Any, semi_axes: Any = 16.0, sigma: Any = 0.1, angle: Any = 0.0) -> pd.DataFrame:
    uv = np.asarray(uv, float).reshape(-1, 2)
    a, b = np.broadcast_to(np.asarray(semi_axes, float), (len(uv), 2)).T
    return pd.DataFrame(
        {
            "u_px": uv[:, 0], "v_px": uv[:, 1], "suu_px2": np.square(sigma), "suv_px2": 0.0,
            "svv_px2": np.square(sigma), "a_px": a, "b_px": b, "angle_rad": angle,
        }
    )  # fmt: skip


def geometry(first: pd.DataFrame, second: pd.DataFrame, cameras: tuple[Camera, Camera]) -> Any:
    axis = shared_axis(cameras)
    return pair_geometry(view_of(first, cameras[0], axis), view_of(second, cameras[1], axis))


def frame(
    rng: np.random.Generator,
    count: int = 20,
    *,
    sigma: float = 0.1,
    spread: float = 0.2,
    shift: Any = 0.0,
    seen: float = 0.97,
    clutter: float = 0.5,
    at: Array | None = None,
) -> tuple[Frame, Array, Array]:
    """Tables with a column ``bubble``, points and radii (mm)."""
    points = rng.uniform([-30, -19, -30], [30, 19, 30], (count, 3)) if at is None else at
    count = len(points)
    radius = 16.0 * np.exp(rng.normal(0, spread, count))
    tables = []
    for c, camera in enumerate(rig()):
        uv = camera.project(points) + sigma * rng.normal(size=(count, 2))
        uv[:, 1] += shift if c == 0 else 0.0
        size = radius[:, None] * (1 + 0.02 * rng.normal(size=(count, 1))) + [0.2, 0.0]
        size = size + 0.7 * sigma * rng.normal(size=(count, 1))
        good = table(uv, size, sigma).assign(bubble=np.arange(count))[rng.random(count) < seen]
        number = rng.poisson(clutter)
        wrong = table(rng.uniform(0, [1279, 799], (number, 2)), 16.0, sigma).assign(bubble=-1)
        both = pd.concat([good, wrong])
        tables.append(both.iloc[rng.permutation(len(both))])
    return (tables[0], tables[1]), points, radius / 20.0


def truth(tables: Frame, pairs: Any) -> NDArray[np.bool_]:
    who = [t["bubble"].to_numpy() for t in tables]
    return np.asarray((who[0][pairs.first] >= 0) & (who[0][pairs.first] == who[1][pairs.second]))


def recall_and_precision(frames: list[Frame], matches: list[Any]) -> tuple[float, float]:
    right = sum(int(truth(f, m).sum()) for f, m in zip(frames, matches))
    there = sum(len(np.intersect1d(a.bubble[a.bubble >= 0], b.bubble)) for a, b in frames)
    return right / there, right / sum(len(m) for m in matches)


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
    found = geometry(tables[0], tables[1], cameras)
    spread = np.var(np.diag(found.gap_px))
    assert spread == pytest.approx(found.variance_px2[0, 0], rel=0.15)


@pytest.mark.parametrize("angle_deg", [50.0, 90.0, 130.0])
def test_an_ellipsoid_has_one_height_in_both_views(angle_deg: float) -> None:
    """A telecentric silhouette of x' M^-1 x = 1 is the ellipse of the projected M."""
    cameras, rng = rig(angle_deg), np.random.default_rng(2)
    for _ in range(20):
        turn = Pose.from_rotvec(rng.normal(0, 1, 3)).rotation
        body = turn @ np.diag(rng.uniform(0.4, 1.6, 3) ** 2) @ turn.T
        point = rng.uniform(-10, 10, (1, 3))
        views = []
        for camera in cameras:
            to_pixel = 20.0 * camera.camera_from_rig.rotation[:2]
            values, vectors = np.linalg.eigh(to_pixel @ body @ to_pixel.T)
            angle = np.arctan2(vectors[1, 1], vectors[0, 1])
            semi_axes = [[np.sqrt(values[1]), np.sqrt(values[0])]]
            views.append(table(camera.project(point), semi_axes, angle=angle))
        found = geometry(views[0], views[1], cameras)
        assert found.size[0, 0, 0] == pytest.approx(0, abs=1e-12)
        assert found.gap_px[0, 0] == pytest.approx(0, abs=1e-9)
        half = np.exp(geometry(views[0], views[0], cameras).views[0].log_size[0, 0])
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


def test_what_has_no_good_partner_is_left_out() -> None:
    rows, columns = best_assignment(np.array([[3.0, 2.9], [2.8, -4.0], [-1.0, -2.0]]))
    assert list(zip(rows.tolist(), columns.tolist())) == [(0, 1), (1, 0)]
    assert len(best_assignment(-np.ones((2, 3)))[0]) == 0


# Pairs


def test_twenty_bubbles() -> None:
    rng = np.random.default_rng(10)
    frames = [frame(rng)[0] for _ in range(25)]
    model = estimate_pair_model(frames, rig())
    assert not model.calibration_problem
    assert abs(model.mean_gap_px[0]) < 0.05
    pairs = [match_pairs(a, b, rig(), model) for a, b in frames]
    recall, precision = recall_and_precision(frames, pairs)
    assert recall >= 0.98 and precision >= 0.98
    sigmas = np.concatenate([p.gap_sigma for p in pairs])
    assert np.std(sigmas) == pytest.approx(1, abs=0.12)


def test_confidence_comes_true_and_history_helps_where_all_look_alike() -> None:
    rng = np.random.default_rng(11)
    made = [frame(rng, sigma=1.0, spread=0.005) for _ in range(25)]
    frames = [m[0] for m in made]
    model = estimate_pair_model(frames, rig())
    pairs = [match_pairs(a, b, rig(), model) for a, b in frames]
    confidence = np.concatenate([p.confidence for p in pairs])
    right = np.concatenate([truth(f, p) for f, p in zip(frames, pairs)])
    unsure = confidence < 0.95
    assert unsure.sum() > 20, "the scene must be hard for this test to mean something"
    expected, spread = confidence.sum(), np.sqrt((confidence * (1 - confidence)).sum())
    assert abs(right.sum() - expected) < 4 * spread
    assert right[confidence > 0.99].mean() > 0.98
    assert right[unsure].mean() < 0.9
    ambiguous = np.concatenate([p.ambiguous for p in pairs])
    assert ambiguous[~right].mean() > 0.8, "wrong pairs are flagged"

    known = []
    for (a, b), points, radius in made:
        covariance = np.tile(0.05**2 * np.eye(3), (len(points), 1, 1))
        guess = points + rng.normal(0, 0.05, points.shape)
        track = Prediction(100 + np.arange(len(points)), guess, covariance, 2 * radius)
        known.append(match_pairs(a, b, rig(), model, predicted=track))
    with_history = recall_and_precision(frames, known)
    without = recall_and_precision(frames, pairs)
    assert min(with_history) >= 0.98 and sum(with_history) > sum(without)
    for tables, found in zip(frames, known):
        right = truth(tables, found) & (found.particle >= 0)
        who = tables[0]["bubble"].to_numpy()[found.first]
        np.testing.assert_array_equal(found.particle[right], 100 + who[right])


@pytest.mark.parametrize("bias", [2.0, -6.0])
def test_a_biased_calibration_is_survived_and_reported(bias: float) -> None:
    rng = np.random.default_rng(12)
    tables, _, _ = frame(rng, 31, shift=bias)
    model = estimate_pair_model([tables], rig())
    assert model.calibration_problem
    assert model.mean_gap_px[0] == pytest.approx(bias, abs=0.15)
    assert any("calibration problem" in w and f"{bias:+.0f}"[0] in w for w in model.words)
    pairs = match_pairs(*tables, rig(), model)
    recall, precision = recall_and_precision([tables], [pairs])
    assert recall >= 0.98 and precision >= 0.98


def test_a_bias_that_changes_over_the_volume_is_followed() -> None:
    rng = np.random.default_rng(13)
    points = rng.uniform([-30, -19, -30], [30, 19, 30], (60, 3))
    offset = 1.5 + 1.2 * points[:, 0] / 30 - 1.0 * (points[:, 2] / 30) ** 2
    tables, _, _ = frame(rng, shift=offset, at=points, seen=1.0, clutter=2.0)
    model = estimate_pair_model([tables], rig())
    bias, _ = model.bias(points)
    assert np.sqrt(np.mean((bias - offset) ** 2)) < 0.15
    assert len(model.bias_px) == 10 and "changes over the volume" in " ".join(model.words)
    assert min(recall_and_precision([tables], [match_pairs(*tables, rig(), model)])) >= 0.95


def test_cameras_that_shake_against_each_other() -> None:
    rng = np.random.default_rng(14)
    shifts = rng.normal(0, 2, 20)
    frames = [frame(rng, shift=s)[0] for s in shifts]
    model = estimate_pair_model(frames, rig())
    assert model.frame_px == pytest.approx(np.std(shifts), rel=0.3)
    assert "shake" in " ".join(model.words)
    pairs = [match_pairs(a, b, rig(), model) for a, b in frames]
    assert min(recall_and_precision(frames, pairs)) >= 0.98
    found = np.array([p.frame_shift_px for p in pairs]) + model.bias_px[0]
    np.testing.assert_allclose(found, shifts, atol=0.2)


def test_two_alike_at_one_height_are_never_a_silent_guess() -> None:
    cameras = rig()
    points = np.array([[-5.0, 3.0, 8.0], [9.0, 3.0, -4.0], [0.0, -9.0, 0.0]])
    tables = [table(c.project(points)) for c in cameras]
    pairs = match_pairs(tables[0], tables[1], cameras, default_model(cameras))
    by_row = dict(zip(pairs.first.tolist(), range(3)))
    for row in (0, 1):
        k = by_row[row]
        assert pairs.ambiguous[k] and 0.4 < pairs.confidence[k] < 0.51
        other = [a for a in pairs.alternatives[k] if a.first == row and a.second >= 0]
        assert other[0].probability == pytest.approx(pairs.confidence[k], abs=0.01)
        assert {pairs.second[k], other[0].second} == {0, 1}
    assert not pairs.ambiguous[by_row[2]] and pairs.confidence[by_row[2]] > 0.95
    assert pairs.alternatives[by_row[2]] == ()
    track = Prediction(
        np.array([7, 8]), points[:2], np.tile(0.04 * np.eye(3), (2, 1, 1)), np.full(2, 1.6)
    )
    known = match_pairs(tables[0], tables[1], cameras, default_model(cameras), predicted=track)
    np.testing.assert_array_equal(known.first, known.second)
    assert (known.confidence > 0.95).all() and not known.ambiguous.any()
    assert known.particle.tolist() == [7, 8, -1]


def test_size_and_contrast_decide_where_the_gap_cannot() -> None:
    cameras = rig()
    points = np.array([[-5.0, 3.0, 8.0], [9.0, 3.02, -4.0]])
    tables = [table(c.project(points), [[14.0, 14.0], [18.0, 18.0]], 0.5) for c in cameras]
    frames = [frame(np.random.default_rng(i))[0] for i in range(5)]
    model = estimate_pair_model(frames, cameras)
    pairs = match_pairs(tables[0], tables[1], cameras, model)
    np.testing.assert_array_equal(pairs.first, pairs.second)
    assert not pairs.ambiguous.any()
    np.testing.assert_allclose(pairs.height_ratio, 1, atol=1e-9)
    cut = [t.assign(flags="border") for t in tables]
    assert match_pairs(cut[0], cut[1], cameras, model).ambiguous.all(), "cut sizes say nothing"


def test_impossible_sizes_are_left_alone() -> None:
    cameras = rig()
    points = np.array([[-5.0, 3.0, 8.0]])
    frames = [frame(np.random.default_rng(i))[0] for i in range(5)]
    model = estimate_pair_model(frames, cameras)
    tables = [table(c.project(points), size) for c, size in zip(cameras, (12.0, 20.0))]
    pairs = match_pairs(tables[0], tables[1], cameras, model)
    assert len(pairs) == 0 and list(pairs.lonely_first) == [0] and list(pairs.lonely_second) == [0]


def test_the_order_of_rows_does_not_matter() -> None:
    rng = np.random.default_rng(15)
    (first, second), _, _ = frame(rng)
    model = estimate_pair_model([(first, second)], rig())
    one = match_pairs(first, second, rig(), model)
    order = rng.permutation(len(second))
    two = match_pairs(first, second.iloc[order], rig(), model)
    np.testing.assert_array_equal(order[two.second], one.second)
    np.testing.assert_allclose(two.confidence, one.confidence, rtol=1e-9)


# Bad input


def test_nothing_to_match() -> None:
    cameras, empty = rig(), table(np.zeros((0, 2)))
    model = estimate_pair_model([(empty, empty), (table([[3, 4]]), empty)], cameras)
    assert "nothing learnt" in model.words[0] and model.pairs == 0
    pairs = match_pairs(empty, table([[600, 400]]), cameras, model)
    assert len(pairs) == 0 and list(pairs.lonely_second) == [0] and pairs.alternatives == ()
    assert estimate_pair_model([], cameras).pairs == 0


def test_one_bubble_is_matched_and_its_bias_not_oversold() -> None:
    cameras = rig()
    tables = [table(c.project(np.array([[1.0, 2.0, 3.0]]))) for c in cameras]
    model = estimate_pair_model([(tables[0], tables[1])], cameras)
    assert any("Too few pairs" in w for w in model.words)
    assert len(match_pairs(tables[0], tables[1], cameras, model)) == 1


def test_bad_tables_and_cameras() -> None:
    good, cameras = table([[600, 400]]), rig()
    model = default_model(cameras)
    with pytest.raises(InputError, match="svv_px2"):
        match_pairs(good.drop(columns="svv_px2"), good, cameras, model)
    with pytest.raises(InputError, match="no finite centre"):
        match_pairs(good, good.assign(u_px=np.nan), cameras, model)
    with pytest.raises(InputError, match="same direction"):
        match_pairs(good, good, rig(1.0), model)
    with pytest.raises(InputError, match="same direction"):
        estimate_pair_model([(good, good)], rig(179.0))


@pytest.mark.skipif(not PAIR.is_dir(), reason="the real pair is not here")
def test_the_real_pairs_listed_circles() -> None:
    from telerig.io.openlpt import read_openlpt_cameras

    read, _ = read_openlpt_cameras([PAIR / "cam1.txt", PAIR / "cam2.txt"])
    cameras = (read[0], read[1])
    listed = pd.read_csv(PAIR / "bb3d_list.csv")
    rng = np.random.default_rng(0)
    order = [rng.permutation(len(listed)) for _ in range(2)]
    tables = []
    for c in (0, 1):
        rows = listed.iloc[order[c]]
        radius = rows[f"cam{c}_r(px)"].to_numpy()
        uv = rows[[f"cam{c}_x(col)", f"cam{c}_y(row)"]].to_numpy()
        tables.append(table(uv, np.stack([radius, radius], -1), 0.2))
    model = estimate_pair_model([(tables[0], tables[1])], cameras)
    pairs = match_pairs(tables[0], tables[1], cameras, model)
    found = [o[i] for o, i in zip(order, (pairs.first, pairs.second))]
    same = set(found[0][found[0] == found[1]].tolist())
    unsound = {4, 12, 13, 25, 26}
    assert len(same - unsound) >= 30 and not same & unsound
    assert model.calibration_problem and 1.4 < abs(model.mean_gap_px[0]) < 2.2
