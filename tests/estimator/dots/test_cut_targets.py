"""Targets that the image cuts, with marks out of view and false marks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from telerig.errors import DetectionError
from telerig.estimator.dots.grid.agreement import PossibleNumbers, decided_by_pair
from telerig.estimator.dots.grid.numbering import number_dots
from telerig.rig.pose import rotation_from_rotvec
from telerig.rig.target import Target

Array = NDArray[np.float64]

TARGET = Target(
    rows=9,
    columns=12,
    pitch_mm=(4.0, 4.0),
    dot_diameter_mm=1.6,
    marks=((2, 3), (2, 6), (5, 4)),
    mark_diameter_mm=2.4,
)
IDS = TARGET.ids()
PLACES_MM = TARGET.nominal_mm(IDS) - TARGET.nominal_mm(IDS).mean(0)
SHAPE = (240, 280)
"""Of the image, 24 x 28 mm of a target of 32 x 44 mm."""
MIDDLE = np.array(SHAPE[::-1]) / 2


@dataclass
class Seen:
    """The possible numberings of one image, and the true number of each dot."""

    possible: PossibleNumbers
    truth: NDArray[np.int64]

    def is_right(self, choice: int = 0) -> bool:
        return bool(np.all(self.possible.ids[choice] == self.truth))


def photograph(
    rotation: Array, middle_mm: Array, bend: float, false_mark: int, rng: np.random.Generator
) -> Seen | None:
    """One telecentric camera with a little distortion; false_mark : a dot that looks like a mark,
    -1 for none."""
    linear = 10.0 * rotation[:2]
    off = PLACES_MM @ linear.T + 10.0 * middle_mm[:2]
    uv = MIDDLE + off * (1 + bend * np.sum(off**2, axis=1, keepdims=True) / 200.0**2)
    seen = np.all((uv > 16) & (uv < 2 * MIDDLE - 17), axis=1) & (rng.random(len(uv)) > 0.03)
    mark = TARGET.is_mark(IDS) | (false_mark == IDS)
    diameter = np.where(mark, 2.4, 1.6) * (1 + 0.01 * rng.standard_normal(len(IDS)))
    values, vectors = np.linalg.eigh(linear[:, :2] @ linear[:, :2].T)
    axes = np.sqrt(values) * diameter[:, None] / 2
    table = pd.DataFrame(
        {
            "u_px": uv[:, 0] + 0.02 * rng.standard_normal(len(uv)),
            "v_px": uv[:, 1] + 0.02 * rng.standard_normal(len(uv)),
            "a_px": axes[:, 1],
            "b_px": axes[:, 0],
            "angle_rad": np.arctan2(vectors[1, 1], vectors[0, 1]),
        }
    )[seen]
    try:
        numbering = number_dots(table, TARGET, SHAPE)
    except DetectionError:  # too many numberings to list
        return None
    index = numbering.table["index"].to_numpy()
    points = table[["u_px", "v_px"]].to_numpy()[index]
    return Seen(PossibleNumbers(points, numbering.equivalents, numbering.score), IDS[seen][index])


def views_of_a_rig(
    rng: np.random.Generator, *, false_marks: bool, count: int = 10
) -> dict[str, tuple[Seen, Seen]]:
    second_from_first = rotation_from_rotvec(np.deg2rad([0.0, rng.uniform(25, 60), 0.0]))
    plain, views = IDS[~TARGET.is_mark(IDS)], {}
    for k in range(count):
        spin, lean = np.deg2rad([rng.uniform(-180, 180), rng.uniform(5, 40)])
        tilt = rotation_from_rotvec(lean * np.array([np.cos(3 * spin), np.sin(3 * spin), 0.0]))
        rotation = tilt @ rotation_from_rotvec([0.0, 0.0, spin])
        middle = rng.uniform([-10, -8, -3], [10, 8, 3])
        marks = rng.choice(plain, 2) if false_marks else [-1, -1]
        first = photograph(rotation, middle, 0.005, marks[0], rng)
        rotation, middle = second_from_first @ rotation, second_from_first @ middle
        second = photograph(rotation, middle, -0.004, marks[1], rng)
        if first and second:
            views[f"{k}"] = first, second
    return views


@pytest.mark.parametrize(("false_marks", "most_wrong"), [(False, 0), (True, 2)])
def test_cut_targets_are_hardly_ever_numbered_wrongly(false_marks: bool, most_wrong: int) -> None:
    """A view is wrong where false marks of both cameras suggest the same wrong place."""
    alone, together, wrong = 0, 0, 0
    for seed in range(6):
        views = views_of_a_rig(np.random.default_rng([7, seed]), false_marks=false_marks)
        decided = decided_by_pair({k: (a.possible, b.possible) for k, (a, b) in views.items()})
        for name, pair in views.items():
            for seen, choice in zip(pair, decided.get(name, (-1, -1))):
                alone += seen.possible.is_decided
                known = choice >= 0 or seen.possible.is_decided
                together += known
                wrong += known and not seen.is_right(max(choice, 0))
    assert wrong <= most_wrong
    assert alone >= 60, "of 120 images"
    assert together >= 88


def test_a_wrong_number_is_found_by_the_other_camera() -> None:
    """A decided image contradicts the other views, and gets the numbering that agrees."""
    views = views_of_a_rig(np.random.default_rng(0), false_marks=False)
    pairs = {k: (a.possible, b.possible) for k, (a, b) in views.items()}
    spoilt = next(
        k for k, (a, b) in pairs.items()
        if a.is_decided and b.is_decided and len(a.ids) > 1
    )  # fmt: skip
    first, second = pairs[spoilt]
    swapped = first.ids.copy()
    swapped[[0, 1]] = swapped[[1, 0]]
    wrong = PossibleNumbers(first.uv_px, swapped, first.score)
    decided = decided_by_pair({**pairs, spoilt: (wrong, second)})
    assert decided[spoilt] == (1, 0)


def test_what_the_views_do_not_show_is_not_decided() -> None:
    views = views_of_a_rig(np.random.default_rng(1), false_marks=False)
    pairs = {k: (a.possible, b.possible) for k, (a, b) in views.items()}
    clear = [k for k, (a, b) in pairs.items() if a.is_decided and b.is_decided]
    few = {k: pair for k, pair in pairs.items() if k not in clear[1:]}
    assert decided_by_pair(few) == {}, "one view does not tell the rig"
    rng = np.random.default_rng(2)
    bent = {
        k: tuple(
            PossibleNumbers(p.uv_px + rng.normal(0, 9, p.uv_px.shape), p.ids, p.score) for p in pair
        )
        for k, pair in pairs.items()
    }
    assert decided_by_pair(bent) == {}
