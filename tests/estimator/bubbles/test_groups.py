"""Groups of detections of three cameras or more: evidence, best sets, probabilities, offsets."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from matching_scenes import Array, match_tables, table
from numpy.typing import NDArray

from telerig.estimator.bubbles.pairing import kernels
from telerig.estimator.bubbles.pairing.evidence import Prediction
from telerig.estimator.bubbles.pairing.groups import NEGLIGIBLE
from telerig.estimator.bubbles.pairing.learning import default_model, learn_rig
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose

Frames = list[list[pd.DataFrame]]


def rig(count: int = 3, step_deg: float = 50.0) -> tuple[Camera, ...]:
    turns = [Pose.from_rotvec([0.0, np.radians(step_deg * k), 0.0]) for k in range(count)]
    return tuple(
        Camera.create(f"c{k}", (1280, 800), 20.0, camera_from_rig=turn)
        for k, turn in enumerate(turns)
    )


def seen(
    cameras: tuple[Camera, ...], points: Array, rng: np.random.Generator, *,
    spread: float = 0.2, missed: float = 0.03, shift: Array | None = None, sigma: float = 0.1,
) -> list[pd.DataFrame]:  # fmt: skip
    """One table for each camera, in random order, with a column ``bubble``; shift : (C, 2) px."""
    radius = 16 * np.exp(rng.normal(0, spread, len(points)))
    out = []
    for c, camera in enumerate(cameras):
        uv = camera.project(points) + sigma * rng.normal(size=(len(points), 2))
        uv += 0 if shift is None else shift[c]
        size = radius[:, None] * (1 + 0.02 * rng.normal(size=(len(points), 1))) + [0.2, 0]
        own = table(uv, size, sigma).assign(bubble=np.arange(len(points)))
        kept = own[rng.random(len(own)) >= missed]
        out.append(kept.iloc[rng.permutation(len(kept))])
    return out


def cloud(count: int, rng: np.random.Generator) -> Array:
    return rng.uniform([-18, -18, -18], [18, 18, 18], (count, 3))


def scored(tables: list[pd.DataFrame], rows: NDArray[np.int64]) -> tuple[float, float]:
    """Share of the bubbles that two cameras see which have a group with all their detections, and
    of the groups which are right."""
    who = [np.append(t["bubble"].to_numpy(), -1) for t in tables]
    named = np.stack([w[r] for w, r in zip(who, rows.T)], -1)
    one = named.max(1)
    right = ((named == one[:, None]) | (rows < 0)).all(1)
    views = np.bincount(np.concatenate([t["bubble"] for t in tables]), minlength=one.max() + 1)
    whole = right & ((rows >= 0).sum(1) == views[one])
    return float(whole.sum() / np.sum(views >= 2)), float(right.mean())


def random_groups(rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    rows = np.unique(rng.integers(-1, 3, (14, 3)), axis=0)
    rows = rows[(rows >= 0).sum(1) >= 2]
    return rng.normal(0.5, 2.0, len(rows)), rows


def disjoint_sets(rows: NDArray[np.int64]) -> list[list[int]]:
    clash = ((rows[:, None] == rows[None]) & (rows[:, None] >= 0)).any(-1)
    found: list[list[int]] = [[]]
    for g in range(len(rows)):
        found += [[*one, g] for one in found if not clash[g, one].any()]
    return found


@pytest.mark.parametrize("seed", range(6))
def test_probabilities_are_those_of_an_enumeration(seed: int) -> None:
    odds, rows = random_groups(np.random.default_rng(seed))
    sets = disjoint_sets(rows)
    weights = np.array([np.exp(odds[one].sum()) for one in sets])
    expected = [sum(w for w, one in zip(weights, sets) if g in one) for g in range(len(rows))]
    found = kernels.marginals(odds, rows, np.array([3, 3, 3]), NEGLIGIBLE)
    np.testing.assert_allclose(found, np.array(expected) / weights.sum(), rtol=1e-9)


@pytest.mark.parametrize(
    ("count", "step_deg"),
    [(3, 50.0), pytest.param(4, 45.0, marks=pytest.mark.slow), (4, 60.0)],
)
def test_bubbles_of_one_size_are_found_by_all_cameras(count: int, step_deg: float) -> None:
    """Of cameras at 0, 60, 120 and 180 degrees the first and the last look along one line."""
    cameras, rng = rig(count, step_deg), np.random.default_rng(2)
    frames = [seen(cameras, cloud(60, rng), rng, spread=0.01, sigma=0.2) for _ in range(3)]
    model = learn_rig(frames, cameras)
    scores = [scored(tables, match_tables(tables, model).rows) for tables in frames]
    recall, precision = np.mean(scores, axis=0)
    assert recall > 0.99 and precision > 0.995 and model.misplaced is None
    alone = learn_rig([t[:2] for t in frames], cameras[:2])
    two = [match_tables(t[:2], alone) for t in frames]
    wrong = np.mean([scored(t[:2], m.rows) for t, m in zip(frames, two)], axis=0)
    assert wrong[1] < 0.97, "two cameras alone cannot tell them apart"


def test_images_that_are_off_are_found_out() -> None:
    """Pixels of one camera are 7 px beside and 4 px above where the calibration expects them."""
    cameras, rng = rig(3), np.random.default_rng(3)
    shift = np.array([[0.0, 0.0], [0.0, 0.0], [7.0, -4.0]])
    frames = [seen(cameras, cloud(25, rng), rng, shift=shift) for _ in range(8)]
    model = learn_rig(frames, cameras)
    scores = [scored(tables, match_tables(tables, model).rows) for tables in frames]
    assert np.mean(scores, axis=0).min() > 0.99
    # what is left of the true shift is one that a shift of all points explains
    left = model.offset(np.zeros(3)) - shift.ravel()
    by_point = np.concatenate([c.project(np.eye(3)) - c.project(np.zeros((1, 3))) for c in cameras])
    by_point = by_point.reshape(3, 3, 2).transpose(0, 2, 1).reshape(6, 3)
    rest = left - by_point @ np.linalg.lstsq(by_point, left, rcond=None)[0]
    assert np.abs(rest).max() < 0.05
    assert sum(m.calibration_problem for m in model.pairs.values()) == 2, "its pairs say so"
    assert model.misplaced is not None
    assert model.misplaced == pytest.approx((2, 7.0, -4.0), abs=0.1)


def test_a_shake_of_each_frame_is_shared_by_its_groups() -> None:
    cameras, rng = rig(3), np.random.default_rng(4)
    frames = [
        seen(cameras, cloud(30, rng), rng, spread=0.01, shift=rng.normal(0, 1.0, (3, 2)))
        for _ in range(10)
    ]
    model = learn_rig(frames, cameras)
    assert model.mean("frame_px") == pytest.approx(2**0.5, rel=0.4)
    scores = [scored(tables, match_tables(tables, model).rows) for tables in frames]
    assert np.mean(scores, axis=0).min() > 0.985


def test_tracks_decide_between_groups() -> None:
    """Twins that two cameras see at one height: predictions say which detections belong together,
    and the third camera's detections of a cut outline join them."""
    cameras, rng = rig(3), np.random.default_rng(5)
    points = np.array([[-6.0, 2.0, 4.0], [5.0, 2.0, -3.0], [9.0, -8.0, 2.0]])
    tables = seen(cameras, points, rng, spread=0.0, missed=0)
    model = default_model(cameras)
    two = [tables[0], tables[1], tables[2].iloc[:0]]
    known = Prediction(np.arange(3), points, np.tile(0.01 * np.eye(3), (3, 1, 1)), np.full(3, 1.6))
    recall, precision = scored(two, match_tables(two, model, known).rows)
    assert recall == precision == 1
    assert match_tables(two, model).ambiguous[:2].any()
    assert scored(tables, match_tables(tables, model).rows) == (1, 1)
