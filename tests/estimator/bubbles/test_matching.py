"""Matching across views: random scenes against their truth."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from matching_scenes import (
    frame,
    groups_of,
    match_tables,
    recall_and_precision,
    rig,
    table,
    truth,
)
from places import REAL

from telerig.errors import InputError
from telerig.estimator.bubbles.pairing.evidence import Prediction
from telerig.estimator.bubbles.pairing.learning import default_model, learn_rig
from telerig.estimator.bubbles.pairing.model import Finding

PAIR = REAL / "bubble_pair"


# Pairs


def test_twenty_bubbles() -> None:
    rng = np.random.default_rng(10)
    frames = [frame(rng)[0] for _ in range(25)]
    model = learn_rig(frames, rig())
    assert not model.pairs[0, 1].calibration_problem
    assert abs(model.pairs[0, 1].mean_gap_px[0]) < 0.05
    pairs = [match_tables((a, b), model) for a, b in frames]
    recall, precision = recall_and_precision(frames, pairs)
    assert recall >= 0.98 and precision >= 0.98
    sigmas = []
    for own, found in zip(frames, pairs):
        gap, variance = groups_of(own, model, found.rows).unbiased(model)
        sigmas.append(gap[:, 0] / np.sqrt(variance[:, 0, 0]))
    assert np.std(np.concatenate(sigmas)) == pytest.approx(1, abs=0.12)


def test_confidence_comes_true_and_history_helps_where_all_look_alike() -> None:
    rng = np.random.default_rng(11)
    made = [frame(rng, sigma=1.0, spread=0.005) for _ in range(25)]
    frames = [m[0] for m in made]
    model = learn_rig(frames, rig())
    pairs = [match_tables((a, b), model) for a, b in frames]
    confidence = np.concatenate([p.probability for p in pairs])
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
        known.append(match_tables((a, b), model, predicted=track))
    with_history = recall_and_precision(frames, known)
    without = recall_and_precision(frames, pairs)
    assert min(with_history) >= 0.98 and sum(with_history) > sum(without)


@pytest.mark.parametrize("bias", [2.0, -6.0])
def test_a_biased_calibration_is_survived_and_reported(bias: float) -> None:
    rng = np.random.default_rng(12)
    tables, _, _ = frame(rng, 31, shift=bias)
    model = learn_rig([tables], rig())
    learnt = model.pairs[0, 1]
    assert learnt.calibration_problem
    assert learnt.mean_gap_px[0] == pytest.approx(bias, abs=0.15)
    sign = f"{bias:+.0f}"[0]
    assert any("calibration problem" in w and sign in w for w in learnt.sentences())
    pairs = match_tables(tables, model)
    recall, precision = recall_and_precision([tables], [pairs])
    assert recall >= 0.98 and precision >= 0.98


def test_few_pairs_accuse_no_calibration() -> None:
    rng = np.random.default_rng(12)
    tables, _, _ = frame(rng, 3, shift=2.0, seen=1.0, clutter=0.0)
    model = learn_rig([tables], rig())
    learnt = model.pairs[0, 1]
    assert abs(learnt.mean_gap_px[0]) > 1 and learnt.findings[:1] == (Finding.FEW_PAIRS,)
    assert not learnt.calibration_problem


def test_a_bias_that_changes_over_the_volume_is_followed() -> None:
    rng = np.random.default_rng(13)
    points = rng.uniform([-30, -19, -30], [30, 19, 30], (60, 3))
    offset = 1.5 + 1.2 * points[:, 0] / 30 - 1.0 * (points[:, 2] / 30) ** 2
    tables, _, _ = frame(rng, shift=offset, at=points, seen=1.0, clutter=2.0)
    model = learn_rig([tables], rig())
    of_left, of_right = np.split(model.offset(points), 2, axis=1)
    bias = of_left[:, 1] - of_right[:, 1]
    assert np.sqrt(np.mean((bias - offset) ** 2)) < 0.15
    assert model.offset_px.shape == (4, 10)
    assert Finding.OFFSET_VARIES in model.pairs[0, 1].findings
    assert min(recall_and_precision([tables], [match_tables(tables, model)])) >= 0.95


def test_cameras_that_shake_against_each_other() -> None:
    rng = np.random.default_rng(14)
    shifts = rng.normal(0, 2, 20)
    frames = [frame(rng, shift=s)[0] for s in shifts]
    model = learn_rig(frames, rig())
    assert model.pairs[0, 1].frame_px == pytest.approx(np.std(shifts), rel=0.3)
    assert Finding.CAMERA_SHAKE in model.pairs[0, 1].findings
    pairs = [match_tables((a, b), model) for a, b in frames]
    assert min(recall_and_precision(frames, pairs)) >= 0.98


def test_two_alike_at_one_height_are_never_a_guess() -> None:
    cameras = rig()
    points = np.array([[-5.0, 3.0, 8.0], [9.0, 3.0, -4.0], [0.0, -9.0, 0.0]])
    tables = [table(c.project(points)) for c in cameras]
    pairs = match_tables(tables, default_model(cameras))
    assert pairs.rows.tolist() == [[2, 2]], "each pair of the two is as probable as not"
    assert pairs.probability[0] > 0.95 and not pairs.ambiguous[0]
    track = Prediction(
        np.array([7, 8]), points[:2], np.tile(0.04 * np.eye(3), (2, 1, 1)), np.full(2, 1.6)
    )
    known = match_tables(tables, default_model(cameras), predicted=track)
    np.testing.assert_array_equal(known.rows[:, 0], known.rows[:, 1])
    assert (known.probability > 0.95).all() and not known.ambiguous.any()


def test_size_and_contrast_decide_where_the_gap_cannot() -> None:
    cameras = rig()
    points = np.array([[-5.0, 3.0, 8.0], [9.0, 3.02, -4.0]])
    tables = [table(c.project(points), [[14.0, 14.0], [18.0, 18.0]], 0.5) for c in cameras]
    frames = [frame(np.random.default_rng(i))[0] for i in range(5)]
    model = learn_rig(frames, cameras)
    pairs = match_tables(tables, model)
    np.testing.assert_array_equal(pairs.rows[:, 0], pairs.rows[:, 1])
    assert not pairs.ambiguous.any()
    cut = [t.assign(flags="border") for t in tables]
    assert match_tables(cut, model).ambiguous.all(), "cut sizes say nothing"


def test_impossible_sizes_are_left_alone() -> None:
    cameras = rig()
    points = np.array([[-5.0, 3.0, 8.0]])
    frames = [frame(np.random.default_rng(i))[0] for i in range(5)]
    model = learn_rig(frames, cameras)
    tables = [table(c.project(points), size) for c, size in zip(cameras, (12.0, 20.0))]
    pairs = match_tables(tables, model)
    assert len(pairs) == 0


def test_the_order_of_rows_does_not_matter() -> None:
    rng = np.random.default_rng(15)
    (first, second), _, _ = frame(rng)
    model = learn_rig([(first, second)], rig())
    one = match_tables((first, second), model)
    order = rng.permutation(len(second))
    two = match_tables((first, second.iloc[order]), model)
    np.testing.assert_array_equal(order[two.rows[:, 1]], one.rows[:, 1])
    np.testing.assert_allclose(two.probability, one.probability, rtol=1e-9)


# Bad input


def test_nothing_to_match() -> None:
    cameras, empty = rig(), table(np.zeros((0, 2)))
    model = learn_rig([(empty, empty), (table([[3, 4]]), empty)], cameras)
    assert model.pairs[0, 1].findings == (Finding.NO_DETECTIONS,) and model.pairs[0, 1].pairs == 0
    pairs = match_tables((empty, table([[600, 400]])), model)
    assert len(pairs) == 0
    assert learn_rig([], cameras).pairs[0, 1].pairs == 0


def test_one_bubble_is_matched_and_its_bias_not_oversold() -> None:
    cameras = rig()
    tables = [table(c.project(np.array([[1.0, 2.0, 3.0]]))) for c in cameras]
    model = learn_rig([(tables[0], tables[1])], cameras)
    assert Finding.FEW_PAIRS in model.pairs[0, 1].findings
    assert "less what all pairs of a frame have in common" in model.pairs[0, 1].sentences()[0]
    assert len(match_tables(tables, model)) == 1


def test_bad_tables_and_cameras() -> None:
    good, cameras = table([[600, 400]]), rig()
    model = default_model(cameras)
    with pytest.raises(InputError, match="svv_px2"):
        match_tables((good.drop(columns="svv_px2"), good), model)
    with pytest.raises(InputError, match="no finite centre"):
        match_tables((good, good.assign(u_px=np.nan)), model)
    with pytest.raises(InputError, match="same direction"):
        default_model(rig(1.0))
    with pytest.raises(InputError, match="same direction"):
        learn_rig([(good, good)], rig(179.0))


@pytest.mark.skipif(not PAIR.is_dir(), reason="the real pair is not here")
def test_the_real_pairs_listed_circles() -> None:
    from telerig.io.exchange.importing.openlpt import read_openlpt_cameras

    read, *_ = read_openlpt_cameras([PAIR / "cam1.txt", PAIR / "cam2.txt"])
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
    model = learn_rig([(tables[0], tables[1])], cameras)
    pairs = match_tables(tables, model)
    found = [o[i] for o, i in zip(order, (pairs.rows[:, 0], pairs.rows[:, 1]))]
    same = set(found[0][found[0] == found[1]].tolist())
    unsound = {4, 12, 13, 25, 26}
    assert len(same - unsound) >= 30 and not same & unsound
    learnt = model.pairs[0, 1]
    assert learnt.calibration_problem and 1.4 < abs(learnt.mean_gap_px[0]) < 2.2
