"""The target's geometry and numbering, against values worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from target_pictures import DESIGN

from telerig.rig.target import Target

ENDLESS = replace(DESIGN, extent="unbounded", marks=((0, 0), (0, 5), (3, 0)))


def test_ids_of_a_bounded_grid_run_along_the_rows() -> None:
    assert DESIGN.ids().tolist() == list(range(15))
    assert int(DESIGN.id_from_row_column(2, 4)) == 14
    row, column = DESIGN.row_column_from_id([0, 7, 14])
    assert row.tolist() == [0, 1, 2]
    assert column.tolist() == [0, 2, 4]


def test_x_follows_columns_and_y_rows_on_unequal_pitches() -> None:
    target = replace(DESIGN, pitch_mm=(2.0, 3.0))
    np.testing.assert_array_equal(target.nominal_mm(8), [6.0, 3.0, 0.0])


@pytest.mark.parametrize("shape", [(), (1,), (3, 2)])
def test_ids_and_places_invert_each_other_on_unbounded_grids(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    row, column = rng.integers(-4095, 4096, (2, *shape))
    ids = ENDLESS.id_from_row_column(row, column)
    back = ENDLESS.row_column_from_id(ids)
    np.testing.assert_array_equal(back[0], row)
    np.testing.assert_array_equal(back[1], column)
    assert ENDLESS.nominal_mm(ids).shape == (*shape, 3)
    assert np.all(ENDLESS.known_id(ids))


def test_marks_and_their_diameters() -> None:
    assert np.flatnonzero(DESIGN.is_mark(DESIGN.ids())).tolist() == [2, 7, 8]
    assert DESIGN.diameter_mm([0, 2]).tolist() == [2.4, 3.6]
    origin = ENDLESS.id_from_row_column(0, 0)
    assert bool(ENDLESS.is_mark(origin))
    assert not ENDLESS.is_mark(origin + 1)


def test_missing_marks_have_no_id() -> None:
    target = replace(DESIGN, mark_style="missing")
    assert target.ids().tolist() == [0, 1, 3, 4, 5, 6, *range(9, 15)]
    assert target.known_id([2, 3, 15, -1]).tolist() == [False, True, False, False]


def test_points_are_numbered_in_their_order() -> None:
    points = np.array([[0.0, 0.0], [3.0, 1.0], [1.0, 4.0]])
    target = Target(layout="points", points_mm=points)
    assert target.bounded
    assert target.ids().tolist() == [0, 1, 2]
    np.testing.assert_array_equal(target.nominal_mm(target.ids())[:, :2], points)
    row, column = target.row_column_from_id([2])
    assert (row.tolist(), column.tolist()) == ([0], [2])


@pytest.mark.parametrize(
    ("change", "order"),
    [
        ({"marks": ()}, 2),
        ({"marks": (), "rows": 5}, 4),
        ({"marks": (), "rows": 5, "pitch_mm": (7.0, 8.0)}, 2),
        ({}, 1),
        ({"marks": ((1, 2),)}, 2),
        ({"marks": ((0, 0), (2, 4))}, 2),
        ({"marks": ((0, 1), (1, 4), (4, 3), (3, 0)), "rows": 5}, 4),
        ({"extent": "unbounded", "marks": ((0, 0), (0, 5), (3, 0))}, 1),
        ({"extent": "unbounded", "marks": ((0, 0), (0, 5))}, 2),
        ({"extent": "unbounded", "marks": ((0, 0), (0, 5), (5, 0), (5, 5))}, 4),
        ({"extent": "unbounded", "marks": ((0, 0),)}, 4),
    ],
)
def test_symmetry_order(change: dict[str, object], order: int) -> None:
    assert replace(DESIGN, **change).symmetry_order() == order  # type: ignore[arg-type]
