"""Numbering: right in every random view, or openly undecided; never wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from seeds import few_or_many
from target_pictures import DESIGN

from telerig.errors import DetectionError, InputError
from telerig.estimator.dots.grid.numbering import (
    OUTSIDE,
    Numbering,
    is_likely,
    number_dots,
)
from telerig.rig.target import Target, check_handedness

Array = NDArray[np.float64]
DIRT = -(10**9)

LARGE = replace(DESIGN, rows=7, columns=12, marks=((3, 4), (3, 7), (1, 4)))
RING = replace(LARGE, mark_style="ring")
MISSING = replace(LARGE, mark_style="missing")
OBLONG = replace(LARGE, pitch_mm=(6.0, 7.0))
ENDLESS = replace(LARGE, extent="unbounded", marks=((0, 0), (0, 5), (3, 0)))


def scattered(count: int, seed: int) -> Target:
    rng = np.random.default_rng(seed)
    half, points = 3.5 * np.sqrt(count), np.zeros((0, 2))
    while len(points) < count:
        point = rng.uniform(-half, half, 2)
        if not len(points) or np.linalg.norm(points - point, axis=1).min() > 4:
            points = np.vstack([points, point])
    return Target(layout="points", points_mm=points, dot_diameter_mm=1.6)


def staggered(
    rows: int, columns: int, pitch_mm: tuple[float, float], holes: tuple[int, ...] = ()
) -> Target:
    """A grid whose odd rows are shifted by half a pitch and have one dot less."""
    points = [
        ((c + 0.5 * (r % 2)) * pitch_mm[0], r * pitch_mm[1])
        for r in range(rows)
        for c in range(columns - r % 2)
    ]
    listed = np.delete(np.array(points), list(holes), axis=0)
    return Target(layout="points", points_mm=listed, dot_diameter_mm=2.4)


def hexagon(side: int) -> Array:
    """The points of a hexagonal grid within a regular hexagon of so many pitches of 7 mm a side."""
    q, r = np.mgrid[-side : side + 1, -side : side + 1].reshape(2, -1)
    inside = np.abs(q + r) <= side
    return np.asarray(7.0 * np.stack([q + r / 2, r * np.sqrt(0.75)], -1)[inside])


HEXAGONAL = (7.0, 7.0 * np.sqrt(0.75))
CODED = staggered(9, 12, HEXAGONAL, holes=(40, 41, 58, 65))


@dataclass(frozen=True)
class View:
    """How a target is seen: random within these limits."""

    tilt_deg: tuple[float, float] = (0.0, 75.0)
    perspective: float = 0.15
    distortion: float = 0.02
    missing: float = 0.1
    false: float = 0.05
    noise_px: float = 0.1
    mirrored: bool = False
    size_px: int = 2000
    fill: float = 0.8
    off_centre: tuple[float, float] = (0.0, 0.0)


def nominal(target: Target) -> tuple[Array, NDArray[np.int64], float]:
    """Places (N, 2) from the middle of the view, ids, and the half width to show, mm."""
    if target.bounded:
        ids = target.ids()
        xy = target.nominal_mm(ids)[:, :2]
        xy = xy - (xy.min(0) + xy.max(0)) / 2
        return xy, ids, float(np.linalg.norm(xy, axis=1).max())
    row, column = np.mgrid[-12:16, -11:17]
    ids = target.id_from_row_column(row, column).ravel()
    if target.mark_style == "missing":
        ids = ids[~target.is_mark(ids)]
    return target.nominal_mm(ids)[:, :2] - [17.5, 10.5], ids, 42.0


def photograph(
    target: Target, view: View, rng: np.random.Generator
) -> tuple[pd.DataFrame, NDArray[np.int64]]:
    """A shuffled table of dots as an image would give it, and the true id of each."""
    xy, ids, half_mm = nominal(target)
    tilt = np.deg2rad(rng.uniform(*view.tilt_deg))
    azimuth, roll = rng.uniform(0, 2 * np.pi, 2)
    kappa = rng.uniform(-1, 1) * view.perspective / half_mm
    bend = rng.uniform(-1, 1) * view.distortion
    scale = view.fill * view.size_px / 2 / half_mm

    def turn(angle: float) -> Array:
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s], [s, c]])

    lean = turn(roll - azimuth) @ np.diag([-1.0 if view.mirrored else 1.0, 1.0])
    linear = turn(azimuth) @ np.diag([1.0, np.cos(tilt)]) @ lean

    def far(p: Array) -> Array:
        return np.asarray(1 + kappa * np.sin(tilt) * (p @ lean[1]))

    def pixel(p: Array) -> Array:
        q = scale * (p - view.off_centre) @ linear.T / far(p)[:, None]
        radius2 = np.sum(q**2, axis=1, keepdims=True) / (view.size_px / 2) ** 2
        return np.asarray(q * (1 + bend * radius2) + (view.size_px - 1) / 2)

    sane = far(xy) > 0.3
    sane &= np.linalg.norm(scale * xy @ linear.T / far(xy)[:, None], axis=1) < 1.6 * view.size_px
    lost = (rng.random(len(xy)) < view.missing) & ~target.is_mark(ids)
    inside = np.all((pixel(xy) > 5) & (pixel(xy) < view.size_px - 6), axis=1)
    keep = sane & inside & ~lost
    xy, ids = xy[keep], ids[keep]
    steps = [np.array([1e-3, 0.0]), np.array([0.0, 1e-3])]
    jacobian = np.stack([pixel(xy + s) - pixel(xy - s) for s in steps], -1) / 2e-3
    large = target.mark_style == "large" and target.layout == "grid"
    diameter = target.diameter_mm(ids) if large else np.full(len(ids), target.dot_diameter_mm)
    shape = (diameter / 2)[:, None, None] ** 2 * jacobian @ np.swapaxes(jacobian, 1, 2)
    values, vectors = np.linalg.eigh(shape)
    uv, axes = pixel(xy), np.sqrt(values[:, ::-1])
    angle = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
    dirt = rng.binomial(len(uv), view.false)
    like = rng.integers(len(uv), size=dirt)
    uv = np.concatenate([uv, rng.uniform(uv.min(0), uv.max(0), (dirt, 2))])
    axes = np.concatenate([axes, axes[like] * rng.uniform(0.3, 1.5, (dirt, 1))])
    angle = np.concatenate([angle, rng.uniform(0, np.pi, dirt)])
    truth = np.concatenate([ids, np.full(dirt, DIRT)])
    uv = uv + view.noise_px * rng.standard_normal(uv.shape)
    axes = np.sort(np.maximum(axes + view.noise_px * rng.standard_normal(axes.shape), 0.3))
    order = rng.permutation(len(uv))
    table = pd.DataFrame(
        {
            "u_px": uv[:, 0],
            "v_px": uv[:, 1],
            "a_px": axes[:, 1],
            "b_px": axes[:, 0],
            "angle_rad": angle,
            "ring": target.is_mark(truth) if target.mark_style == "ring" else False,
        }
    )
    return table.iloc[order].reset_index(drop=True), truth[order]


def is_right(
    numbering: Numbering, truth: NDArray[np.int64], ids: NDArray[np.int64] | None = None
) -> bool:
    """Whether no dot has a wrong number and nearly all have one."""
    got = numbering.table["dot"].to_numpy() if ids is None else ids
    wanted = truth[numbering.table["index"].to_numpy()]
    real = wanted != DIRT
    assert not numbering.table["dot"].duplicated().any()
    assert len(numbering.table) + len(numbering.unplaced) == len(truth)
    return bool(np.all(got[real] == wanted[real])) and real.sum() >= 0.97 * np.sum(truth != DIRT)


@pytest.mark.parametrize(
    ("target", "view"),
    [
        (DESIGN, View()),
        (DESIGN, View(mirrored=True)),
        (LARGE, View()),
        (LARGE, View(mirrored=True, tilt_deg=(60, 75))),
        (RING, View(false=0.2)),
        (MISSING, View(missing=0.0)),
        (OBLONG, View(mirrored=True)),
        (ENDLESS, View()),
        (replace(ENDLESS, mark_style="ring"), View(mirrored=True)),
        (replace(ENDLESS, mark_style="missing"), View(missing=0.0)),
        (scattered(40, 1), View(mirrored=True)),
        (CODED, View()),
        (CODED, View(mirrored=True)),
        (staggered(9, 12, (14.0, 7.0), holes=(40, 41, 58, 65)), View(mirrored=True)),
        (staggered(9, 12, (7.0, 9.0), holes=(40, 41, 58, 65)), View()),
        (replace(CODED, marks=((0, 40), (0, 45), (0, 60)), mark_style="ring"), View(false=0.2)),
    ],
)
@few_or_many(4, 20)
def test_random_views_are_numbered_right(target: Target, view: View, draws: int) -> None:
    wrong = []
    for seed in range(draws):
        dots, truth = photograph(target, view, np.random.default_rng([11, seed]))
        numbering = number_dots(dots, target)
        good = is_right(numbering, truth) and not numbering.ambiguous
        if not good or numbering.handedness != (-1 if view.mirrored else 1):
            wrong.append(seed)
    assert wrong == []


@pytest.mark.parametrize(("rows", "columns", "order"), [(7, 12, 2), (8, 8, 4)])
@few_or_many(5, 25)
def test_symmetric_targets_list_every_equivalent(
    rows: int, columns: int, order: int, draws: int
) -> None:
    target = replace(LARGE, rows=rows, columns=columns, marks=())
    assert target.symmetry_order() == order
    for seed in range(draws):
        dots, truth = photograph(target, View(), np.random.default_rng([12, seed]))
        numbering = number_dots(dots, target)
        assert numbering.equivalents.shape == (order, len(numbering.table))
        np.testing.assert_array_equal(numbering.equivalents[0], numbering.table["dot"])
        assert sum(is_right(numbering, truth, ids) for ids in numbering.equivalents) == 1
        assert not numbering.ambiguous
        assert numbering.handedness == 1


@pytest.mark.parametrize(
    ("target", "order"),
    [
        (staggered(9, 12, HEXAGONAL), 2),
        (staggered(11, 4, (14.0, 7.0)), 2),
        (replace(CODED, points_mm=hexagon(4)), 6),
    ],
)
def test_symmetric_hexagonal_grids_list_every_equivalent(target: Target, order: int) -> None:
    assert target.symmetry_order() == order
    assert not target.mirror_images_differ()
    labels = [tuple(label) for label in target.turns()]
    for seed in range(5):
        dots, truth = photograph(target, View(missing=0.03), np.random.default_rng([17, seed]))
        numbering = number_dots(dots, target)
        assert not numbering.ambiguous
        found = np.array(numbering.equivalents)
        assert sum(is_right(numbering, truth, ids) for ids in found) == 1
        assert {tuple(np.array(label)[found[0]]) for label in labels} == {*map(tuple, found)}


@pytest.mark.parametrize("target", [staggered(9, 12, HEXAGONAL), replace(LARGE, marks=())])
def test_a_part_of_a_grid_without_marks_is_refused(target: Target) -> None:
    dots, truth = photograph(target, View(missing=0, false=0), np.random.default_rng(3))
    part = dots[target.nominal_mm(truth)[:, 0] < 60].reset_index(drop=True)
    with pytest.raises(DetectionError, match="seen in part and has no marks"):
        number_dots(part, target)


@pytest.mark.parametrize("lost", [(1, 2), (1, 3), (0, 2)])
def test_one_mark_seen_as_a_plain_dot_is_settled_or_left_open(lost: tuple[int, int]) -> None:
    ring = replace(DESIGN, mark_style="ring")
    for seed in range(5):
        dots, truth = photograph(ring, View(missing=0), np.random.default_rng([14, seed]))
        dots.loc[truth == int(ring.id_from_row_column(*lost)), "ring"] = False
        free = number_dots(dots, ring)
        assert any(is_right(free, truth, ids) for ids in free.equivalents)
        assert free.ambiguous == (lost != (1, 2))


def test_a_tie_between_mirror_images_leaves_the_handedness_open() -> None:
    ring = replace(DESIGN, mark_style="ring")
    dots, truth = photograph(ring, View(missing=0), np.random.default_rng(5))
    dots.loc[truth == int(ring.id_from_row_column(0, 2)), "ring"] = False
    numbering = number_dots(dots, ring)
    assert numbering.ambiguous
    assert numbering.handedness == 0
    assert set(numbering.equivalent_handedness.tolist()) == {1, -1}


@pytest.mark.parametrize("target", [RING, replace(ENDLESS, mark_style="ring")])
def test_one_false_mark_changes_nothing(target: Target) -> None:
    for seed in range(6):
        rng = np.random.default_rng([15, seed])
        dots, truth = photograph(target, View(), rng)
        row, column = target.row_column_from_id(np.maximum(truth, 0))
        twin = np.isin(row, (5, -3)) & np.isin(column, (4, 0))
        odd = int(rng.choice(np.flatnonzero(~target.is_mark(truth) & (truth != DIRT) & ~twin)))
        dots.loc[odd, "ring"] = True
        numbering = number_dots(dots, target)
        assert is_right(numbering, truth)
        assert not numbering.ambiguous


def test_a_false_mark_that_completes_the_mirror_image_is_a_tie() -> None:
    dots, truth = photograph(RING, View(missing=0), np.random.default_rng(1))
    dots.loc[truth == int(RING.id_from_row_column(5, 4)), "ring"] = True
    numbering = number_dots(dots, RING)
    assert numbering.ambiguous
    assert is_likely(numbering.score).sum() == 2
    assert any(is_right(numbering, truth, ids) for ids in numbering.equivalents)


def test_a_part_of_a_bounded_target_is_numbered_from_its_marks() -> None:
    view = View(fill=1.4, off_centre=(-8.0, 0.0), tilt_deg=(0, 40), missing=0.05)
    for seed in range(8):
        dots, truth = photograph(LARGE, view, np.random.default_rng([16, seed]))
        if np.isin(LARGE.id_from_row_column(*np.transpose(LARGE.marks)), truth).all():
            assert is_right(number_dots(dots, LARGE), truth)


def test_an_unbounded_target_without_visible_marks_is_refused() -> None:
    target = replace(ENDLESS, mark_style="ring")
    dots, _ = photograph(target, View(), np.random.default_rng(3))
    with pytest.raises(DetectionError, match="none of the target's 3 marks"):
        number_dots(dots.assign(ring=False), target)
    with pytest.raises(InputError, match="no origin"):
        number_dots(dots, replace(target, marks=()))


def test_dots_on_the_lattice_beyond_the_target_are_left_out_with_the_reason() -> None:
    wide = replace(LARGE, columns=13)
    dots, truth = photograph(wide, View(missing=0, false=0), np.random.default_rng(6))
    row, column = np.divmod(truth, 13)
    keep = (column < 12) | (row == 2)
    seen = dots[keep].reset_index(drop=True)
    numbering = number_dots(seen, LARGE)
    assert numbering.unplaced["reason"].tolist() == [OUTSIDE]
    assert numbering.unplaced["index"].tolist() == np.flatnonzero(column[keep] == 12).tolist()
    assert is_right(numbering, np.where(column < 12, row * 12 + column, DIRT)[keep])


def test_a_target_of_other_size_is_refused() -> None:
    dots, _ = photograph(replace(LARGE, columns=20), View(), np.random.default_rng(6))
    with pytest.raises(DetectionError, match="7 x 20 places"):
        number_dots(dots, LARGE)


def test_faults_of_the_table_are_named() -> None:
    dots, _ = photograph(DESIGN, View(), np.random.default_rng(0))
    with pytest.raises(DetectionError, match="no dots found"):
        number_dots(dots.iloc[:0], DESIGN)
    with pytest.raises(InputError, match="b_px"):
        number_dots(dots.drop(columns="b_px"), DESIGN)
    dots.loc[3, "u_px"] = np.nan
    with pytest.raises(InputError, match="row 3"):
        number_dots(dots, DESIGN)


def test_scattered_dots_do_not_match_points() -> None:
    target = scattered(30, 2)
    dots, _ = photograph(scattered(30, 3), View(), np.random.default_rng(0))
    with pytest.raises(DetectionError, match="fit the target's 30 points"):
        number_dots(dots, target)


def test_symmetric_points_are_refused() -> None:
    half = scattered(12, 4).points_mm
    assert half is not None
    half = half + [20.0, 0.0]
    target = Target(layout="points", points_mm=np.concatenate([half, -half]), dot_diameter_mm=1.6)
    dots, _ = photograph(target, View(missing=0), np.random.default_rng(0))
    with pytest.raises(DetectionError, match="equally good"):
        number_dots(dots, target)


def test_mirrored_images_are_named() -> None:
    hands = {(f"v{k}", camera): 1 for k in range(4) for camera in ("left", "right")}
    check_handedness(hands, two_sided=False)
    check_handedness({**hands, ("v4", "left"): 0}, two_sided=False)
    odd = {**hands, ("v2", "right"): -1}
    with pytest.raises(
        DetectionError, match=r"mirrored image \(1 of 8\): camera 'right' view 'v2'"
    ):
        check_handedness(odd, two_sided=False)
    check_handedness(odd, two_sided=True)
    whole = {key: -1 if key[1] == "right" else 1 for key in hands}
    sentence = "every image of camera 'right' is mirrored against camera 'left'"
    with pytest.raises(DetectionError, match=sentence):
        check_handedness(whole, two_sided=False)


def test_targets_of_many_dots() -> None:
    rng = np.random.default_rng(0)
    many = replace(LARGE, rows=24, columns=24, marks=((12, 13), (12, 19), (7, 13)))
    for target in (LARGE, many, scattered(200, 0)):
        dots, truth = photograph(target, View(), rng)
        assert is_right(number_dots(dots, target), truth)
