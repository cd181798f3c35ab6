"""Ways to give tracks measurements, against all of them."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from telerig.estimator.tracking.linking.association import Conflict, joined
from telerig.estimator.tracking.linking.filter import TrackerSettings
from telerig.estimator.tracking.linking.ranked_ways import Options, Way, alternatives


def every_way(tables: list[tuple[float, Options]]) -> list[Way]:
    """Return all ways, best first."""
    ways = []
    for table, (start, options) in enumerate(tables):
        for taken in product(*([(-1, 0.0), *row] for row in options)):
            given = [c for c, _ in taken if c >= 0]
            if len(set(given)) == len(given):
                total = start + sum(score for _, score in taken)
                ways.append((table, tuple(c for c, _ in taken), total))
    return sorted(ways, key=lambda way: -way[2])


def random_tables(rng: np.random.Generator) -> list[tuple[float, Options]]:
    rows = int(rng.integers(1, 5))
    return [
        (
            float(-rng.uniform(0, 4)),
            [
                [(3 * c, float(rng.normal(2, 4))) for c in range(4) if rng.uniform() < 0.6]
                for _ in range(rows)
            ],
        )
        for _ in range(int(rng.integers(1, 4)))
    ]


@pytest.mark.parametrize("seed", range(20))
def test_alternatives_are_those_of_brute_force(seed: int) -> None:
    tables = random_tables(np.random.default_rng(seed))
    every = every_way(tables)
    near = [way for way in every if way[2] >= every[0][2] - 6.0]
    found = alternatives(tables, 6.0, len(every) + 1)
    assert [way[:2] for way in found] == [way[:2] for way in near]
    assert [way[2] for way in found] == pytest.approx([way[2] for way in near])


@pytest.mark.parametrize("seed", range(20))
def test_fewer_alternatives_are_the_best_and_one_for_each_option(seed: int) -> None:
    tables = random_tables(np.random.default_rng(100 + seed))
    every = every_way(tables)
    near = [way for way in every if way[2] >= every[0][2] - 9.0]
    found = alternatives(tables, 9.0, 3)
    assert [way[:2] for way in found[:3]] == [way[:2] for way in near[:3]]
    shown = {option for _, taken, _ in found for option in enumerate(taken)}
    assert shown == {option for _, taken, _ in near for option in enumerate(taken)}
    for _, taken, score in found[3:]:
        best = [
            max(total for _, other, total in near if other[row] == column)
            for row, column in enumerate(taken)
        ]
        assert score == pytest.approx(min(best))


def test_seven_tracks_with_seven_nearly_equal_options_each() -> None:
    scores = 10.0 + np.random.default_rng(0).uniform(0, 0.5, (7, 7))
    options = [[(c, float(score)) for c, score in enumerate(row)] for row in scores]
    found = alternatives([(0.0, options)], 9.0, 30)
    best = scores[linear_sum_assignment(-scores)].sum()
    assert found[0][2] == pytest.approx(best)
    assert best - found[29][2] < 0.3
    for row in range(7):  # each track is disputed
        assert {taken[row] for _, taken, _ in found} >= set(range(7))


def conflict(weight: list[float], taken: list[list[list[int]]]) -> Conflict:
    """Hypotheses (B,) about the measurements (B, T, F) of tracks; their rows are numbers."""
    columns = np.array(taken)
    many, tracks, frames = columns.shape
    rows = np.arange(many * tracks).reshape(many, tracks)
    return Conflict(np.array(weight), rows, np.arange(frames), columns)


def test_a_hypothesis_that_alone_disputes_a_track_is_kept() -> None:
    settings = TrackerSettings(max_hypotheses=5)
    weight = [-0.1 * k for k in range(8)]
    others = [[[1], [10 + k]] for k in range(8)]
    kept = conflict([*weight, -2.0, -9.5], [*others, [[2], [10]], [[3], [10]]]).merged(settings)
    assert kept.taken.tolist() == [*others, [[2], [10]]]
    assert kept.weight == pytest.approx([*weight, -2.0])
    assert kept.rows.tolist() == [[2 * k, 2 * k + 1] for k in range(9)]


def test_hypotheses_with_equal_recent_measurements_are_one() -> None:
    taken = [[[5, 1, 1]], [[6, 1, 1]], [[6, 2, 1]]]
    found = conflict([0.0, -0.5, -1.0], taken).merged(TrackerSettings())
    assert found.taken.tolist() == [taken[0], taken[2]] and found.rows.tolist() == [[0], [2]]
    total = np.logaddexp(0.0, -0.5)
    assert found.weight == pytest.approx([0.0, -1.0 - total])


def test_what_the_hypotheses_dispute_is_cut_where_they_begin_to_agree_again() -> None:
    """The first two tracks exchange the measurements of frame 1, the third one is safe."""
    one = [[0, 1, 1, 3], [1, 0, 0, 0], [2, 2, 2, 2]]
    two = [[0, 0, 1, 3], [1, 1, 0, 0], [2, 2, 2, 2]]
    found = conflict([0.0, -1.0], [one, two])
    assert found.disputed(2).tolist() == [False, False, False]
    assert found.disputed(3).tolist() == [True, True, False]
    agreed, start = found.broken()
    assert agreed.tolist() == [1, 1, 2] and start == 2


def test_every_hypothesis_of_each_group_takes_part_in_a_joint_one() -> None:
    groups = [
        conflict([0.0, -0.1, -far], [[[k, g]] for k in range(3)])
        for g, far in enumerate((5.0, 4.0, 6.0))
    ]
    found = joined(groups, 4)
    assert found.weight == pytest.approx([0.0, -0.1, -0.1, -0.1, -5.0, -4.0, -6.0])
    assert found.taken[:, :, 1].tolist() == [[0, 1, 2]] * 7
    assert found.taken[4:, :, 0].tolist() == [[2, 0, 0], [0, 2, 0], [0, 0, 2]]
