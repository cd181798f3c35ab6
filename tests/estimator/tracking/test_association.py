"""Ways to give tracks measurements, against all of them."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from telerig.estimator.tracking.association import Branch, _joint, merged
from telerig.estimator.tracking.filter import TrackerSettings
from telerig.estimator.tracking.ranked_ways import Options, Way, alternatives


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


def test_a_hypothesis_that_alone_disputes_a_track_is_kept() -> None:
    settings = TrackerSettings(max_hypotheses=5)
    others = [(-0.1 * k, (((0, 1),), ((0, 10 + k),)), k) for k in range(8)]
    alone = (-2.0, (((0, 2),), ((0, 10),)), 99)
    improbable = (-9.5, (((0, 3),), ((0, 10),)), 100)
    kept = merged([*others, alone, improbable], settings)
    assert [index for _, index in kept] == [0, 1, 2, 3, 4, 5, 6, 7, 99]
    same = [(-0.1 * k, (((k % 2, 1),), ((0, 10 + k // 2 % 2),)), k) for k in range(9)]
    assert len(merged(same[:4], settings)) == 4
    assert [index for _, index in merged(others[:3], settings)] == [0, 1, 2]


def test_every_hypothesis_of_each_group_takes_part_in_a_joint_one() -> None:
    groups = [[Branch(-weight, []) for weight in (0.0, 0.1, far)] for far in (5.0, 4.0, 6.0)]
    found = _joint(groups, 4)
    weights = [sum(branch.weight for branch in one) for one in found]
    assert weights == pytest.approx([0.0, -0.1, -0.1, -0.1, -5.0, -4.0, -6.0])
