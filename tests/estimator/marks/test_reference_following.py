"""Strips of dots fixed to the tank followed by themselves, on exact dots."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from telerig.errors import GeometryError
from telerig.estimator.marks.following import AMBIGUOUS, HIDDEN, MOVED, Follower, TankView
from telerig.estimator.marks.strip_dots import DotSightings
from telerig.estimator.tracking.follow_marks import held_positions, moved_far
from telerig.io.simulation.calibration.scene import true_cameras
from telerig.io.simulation.presets import run_preset
from telerig.rig.camera import Camera

Array = NDArray[np.float64]

UP = np.array([0.0, -1.0, 0.0])


def camera() -> Camera:
    return true_cameras(run_preset("rise").calibration)["left"]


def play(
    heights_mm: Array,
    positions_mm: Array,
    *,
    shake_mm: Array | None = None,
    encoder: bool = True,
    hidden: frozenset[tuple[int, int]] = frozenset(),
    extra: dict[int, Array] | None = None,
    read_mm: Array | None = None,
) -> tuple[Follower, list[tuple[int, int, int]]]:
    """A strip at the given heights seen at the given positions: (frame, dot, mark).

    read_mm : what the encoder reads; None for the positions.
    """
    read = positions_mm if read_mm is None else read_mm
    held = float(held_positions(read, len(read))[0])
    view = TankView.of(camera(), UP)
    follower = Follower(
        view, diameter_mm=1.0, margin_px=8.0, frame_count=len(positions_mm), held_mm=held
    )
    rng, rows = np.random.default_rng(0), []
    size = np.array(camera().image_size_px) - 1
    for frame, position in enumerate(positions_mm):
        rig = np.stack([np.full(len(heights_mm), 12.0), -heights_mm, 0 * heights_mm], -1)
        rig = rig - UP * position - (0 if shake_mm is None else shake_mm[frame]) * UP
        near = np.flatnonzero(np.abs(rig[:, 1]) < 30)
        uv = camera().project(rig[near])
        whole = np.all((uv > 8) & (uv < size - 8), axis=1)
        whole &= np.array([(frame, int(k)) not in hidden for k in near], bool)
        seen, uv = near[whole], uv[whole] + 0.02 * rng.standard_normal((int(whole.sum()), 2))
        if extra is not None and frame in extra:
            uv, seen = np.vstack([uv, extra[frame]]), np.append(seen, -1)
        order = rng.permutation(len(uv))
        dots = DotSightings(uv[order], np.full(len(uv), 0.02))
        found = follower.add(frame, dots, float(read[frame]) if encoder else None)
        rows += [(frame, int(seen[order][i]), mark) for i, mark in found]
    return follower, rows


def identities(rows: list[tuple[int, int, int]]) -> pd.DataFrame:
    return pd.DataFrame(rows, columns=["frame", "dot", "mark"])


EVEN = np.arange(-60.0, 160.0, 6.0)


def test_an_even_strip_is_followed_past_half_its_spacing_with_the_encoder() -> None:
    """Steps of 0.5, 0.9 and 1 spacing, which without the encoder look alike."""
    for step in (3.0, 5.4, 6.0):
        shake = 0.2 * np.sin(np.arange(20) * 1.1)
        follower, rows = play(EVEN, step * np.arange(20), shake_mm=shake)
        table = identities(rows)
        assert table.groupby("mark")["dot"].nunique().max() == 1
        assert table.groupby("dot")["mark"].nunique().max() == 1
        assert follower.breaks == []


def test_without_the_encoder_half_a_spacing_is_ambiguous_and_breaks() -> None:
    follower, rows = play(EVEN, 3.0 * np.arange(12), encoder=False)
    assert AMBIGUOUS in {why for _, why in follower.breaks}
    table = identities(rows)
    assert table.groupby("mark")["dot"].nunique().max() == 1, "a new mark, never a wrong one"


def test_without_the_encoder_slow_or_uneven_strips_are_followed() -> None:
    uneven = EVEN + np.random.default_rng(3).uniform(-1.5, 1.5, len(EVEN))
    for heights, step in ((EVEN, 0.5), (uneven, 2.8)):
        follower, rows = play(heights, step * np.arange(25), encoder=False)
        table = identities(rows)
        assert follower.breaks == []
        assert table.groupby("mark")["dot"].nunique().max() == 1
        assert table.groupby("dot")["mark"].nunique().max() == 1


def test_a_mark_that_was_hidden_and_one_that_left_keep_their_numbers() -> None:
    position = np.concatenate([2.0 * np.arange(20), 2.0 * np.arange(19, -1, -1)])
    hidden = frozenset((f, 10) for f in range(4, 9))
    follower, rows = play(EVEN, position, hidden=hidden)
    table = identities(rows)
    assert table.groupby("dot")["mark"].nunique().max() == 1, "also after coming back"
    marks = {m.number: m for m in follower.kept(moved=True)}
    mine = marks[int(table[table["dot"] == 10]["mark"].iloc[0])]
    assert mine.left_out.get(HIDDEN) == 5


def test_what_moves_with_the_rig_or_by_itself_is_no_mark() -> None:
    path = {f: np.array([[300.0 + 3 * np.sin(f), 250.0 + 2.0 * f]]) for f in range(30)}
    still = {f: np.array([[120.0, 200.0]]) for f in range(30)}
    for extra in (path, still):
        follower, rows = play(EVEN, 2.0 * np.arange(30), extra=extra)
        kept = {m.number for m in follower.kept(moved=True)}
        false = [mark for _, dot, mark in rows if dot < 0 and mark in kept]
        assert false == []


def test_a_dot_off_its_place_is_left_out() -> None:
    """A bubble's edge that passes for the dot, 0.8 px away."""
    dot = next(d for f, d, _ in play(EVEN, 2.0 * np.arange(20))[1] if f == 10)
    view = camera().project(np.array([12.0, -EVEN[dot] + 20.0, 0.0]))
    hidden = frozenset({(10, dot)})
    follower, rows = play(
        EVEN, 2.0 * np.arange(20), hidden=hidden, extra={10: view[None] + [0.8, 0.0]}
    )
    assert not [r for r in rows if r[0] == 10 and r[1] == -1]
    assert sum(m.left_out.get(MOVED, 0) for m in follower.marks) == 1


def test_a_run_in_which_nothing_moves_keeps_its_marks() -> None:
    follower, _ = play(EVEN, np.zeros(10))
    assert len(follower.kept(moved=False)) >= 7


def test_a_record_that_begins_late_is_no_travel() -> None:
    """The stage rests at 100 mm, and a dot that is hidden once stays a mark; or it moves."""
    read = np.where(np.arange(20) < 5, np.nan, 100.0)
    hidden = frozenset({(10, 10)})
    follower, rows = play(EVEN, np.zeros(20), read_mm=read, hidden=hidden)
    moved = moved_far(follower, held_positions(read, 20))
    assert not moved
    assert {mark for _, dot, mark in rows if dot == 10} <= {
        m.number for m in follower.kept(moved=moved)
    }
    position = 1.0 * np.arange(20)
    follower, _ = play(EVEN, position, read_mm=read + position)
    held = held_positions(read + position, 20)
    assert moved_far(follower, held)
    along = held[:, None] * (follower.view.basis @ UP) - follower.shift_mm
    # the step at which the record begins is not seen
    assert np.ptp(along[:, 0]) == pytest.approx(18.0, abs=0.1)


def test_a_camera_along_the_travel_is_refused() -> None:
    ray = camera().unproject(np.array([255.5, 255.5]))[1]
    with pytest.raises(GeometryError, match="looks along"):
        TankView.of(camera(), ray)


def test_places_and_pixels_are_each_others_inverse() -> None:
    view = TankView.of(camera(), UP)
    uv = np.array([[30.0, 40.0], [400.0, 300.0]])
    assert np.allclose(view.pixels(view.lab_mm(uv, 17.0), 17.0), uv, atol=1e-6)
    assert view.px_per_mm == pytest.approx(10.04, rel=0.01)
