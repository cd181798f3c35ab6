"""The tracker in situations with a known answer."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from tracker_runs import SIGMA_MM, STILL, UP, Array, cameras, frame_of, kinds, run

from telerig.errors import InputError
from telerig.estimator.tracking.linking.filter import TrackerSettings
from telerig.estimator.tracking.linking.tracker import Tracker
from telerig.rig.triangulation import on_rays

# --- association


def test_common_shake_of_a_whole_distance_does_not_swap_neighbours() -> None:
    """Two bubbles 0.4 mm apart; the rig jumps by 0.4 mm along their line, so that each lands
    where the other was."""
    rng = np.random.default_rng(0)
    shift = np.zeros((40, 3))
    shift[20:, 0] = 0.4
    bubbles = np.array([[0.0, 0, 0], [0.4, 0, 0]])
    frames = [bubbles + s + rng.normal(0, 0.01, (2, 3)) for s in shift]
    ids, events = run(Tracker(settings=STILL), frames)
    assert [i.tolist() for i in ids[5:]] == [ids[5].tolist()] * 35
    assert set(ids[5].tolist()) == {0, 1} and "break" not in kinds(events)


@pytest.mark.parametrize("count", [2, 5])
def test_a_shake_far_beyond_the_settings_breaks_no_track(count: int) -> None:
    """2 mm at 31 Hz: up to 1.2 mm from frame to frame at 333 Hz, where 0.2 mm are expected."""
    rng = np.random.default_rng(3)
    shake = 2.0 * np.sin(2 * np.pi * 31 * np.arange(120) / 333)
    bubbles = rng.uniform(-15, 15, (count, 3))
    frames = [bubbles + [s, 0.3 * s, 0.0] + rng.normal(0, 0.01, (count, 3)) for s in shake]
    ids, events = run(Tracker(settings=STILL), frames, hz=333.0)
    assert [i.tolist() for i in ids[5:]] == [list(range(count))] * 115
    assert kinds(events) == ["birth"] * count


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_jump_beyond_the_distance_of_the_bubbles_exchanges_none(seed: int) -> None:
    """5 mm at 31 Hz: up to 4.9 mm from frame to frame at 200 Hz, of 40 bubbles 3 to 5 mm apart."""
    rng = np.random.default_rng(seed)
    shake = 5.0 * np.sin(2 * np.pi * 31 * np.arange(80) / 200)
    bubbles = rng.uniform(-15, 15, (40, 3))
    frames = [bubbles + [s, 0.3 * s, 0.0] + rng.normal(0, 0.01, (40, 3)) for s in shake]
    ids, events = run(Tracker(settings=STILL), frames, hz=200.0)
    known = np.array(ids[8:])
    assert ((known == known.max(0)) | (known < 0)).all() and (known >= 0).mean() > 0.97
    assert len(np.unique(known.max(0))) == 40
    assert not {"break", "death"} & {*kinds(events)}


@pytest.mark.parametrize(("hz", "sway_mm"), [(200.0, 2.0), (200.0, 5.0), (500.0, 8.0)])
@pytest.mark.parametrize("seed", [4, 5, 10])
def test_a_bubble_alone_is_followed_through_jumps_of_the_rig(
    hz: float, sway_mm: float, seed: int
) -> None:
    """The rig begins to sway at 31 Hz, by up to 4.9 mm from frame to frame; the size is known."""
    rng, frame = np.random.default_rng(seed), np.arange(100)
    sway = sway_mm * np.sin(2 * np.pi * 31 * frame / hz + rng.uniform(0, 6.3))
    sway *= np.clip((frame - 15) / 5, 0, 1)
    places = rng.normal(0, 0.01, (100, 1, 3)) + sway[:, None, None] * [1.0, 0.3, 0.0]
    sizes = 5 * np.exp(rng.normal(0, 0.02, 100))
    frames = [frame_of(place, d_eq_mm=size) for place, size in zip(places, sizes)]
    ids, events = run(Tracker(settings=STILL), frames, hz=hz)
    assert np.array_equal(np.concatenate(ids), np.zeros(100))
    assert kinds(events) == ["birth"]


def test_a_bubble_that_comes_when_another_leaves_is_another_one() -> None:
    """In the same frame, 15 mm away or of another size: the rig has not jumped."""
    rng = np.random.default_rng(0)
    for away, sizes in ((15.0, (5.0, 5.0)), (5.0, (5.0, 3.0))):
        frames = [
            frame_of(rng.normal(0, 0.01, (1, 3)) + [away * (k >= 20), 0, 0], d_eq_mm=sizes[k >= 20])
            for k in range(60)
        ]
        ids, _ = run(Tracker(settings=STILL), frames)
        assert [i.tolist() for i in ids] == [[0]] * 20 + [[1]] * 40


def passing(offset_mm: float, rng: np.random.Generator) -> list[Array]:
    """Two bubbles on straight lines, 100 mm/s towards each other, ``offset_mm`` apart at best."""
    t = (np.arange(60) - 30) / 500
    a = np.stack([50 * t, 0 * t, 0 * t], -1)
    b = np.stack([-50 * t, 0 * t, offset_mm + 0 * t], -1)
    return [np.stack([p, q]) + rng.normal(0, 0.01, (2, 3)) for p, q in zip(a, b)]


def test_a_straight_crossing_keeps_both_ids() -> None:
    ids, events = run(Tracker(settings=STILL), passing(0.0, np.random.default_rng(1)))
    assert ids[5].tolist() == ids[-1].tolist() == [0, 1]
    assert "break" not in kinds(events)


def ambiguous_meeting(rng: np.random.Generator) -> list[Array]:
    """Two bubbles come from -x and +x, are unseen for 12 frames, leave along -z and +z."""
    t = np.arange(30) / 500
    before = [np.array([[s - 0.8, 0, 0], [0.8 - s, 0, 0]]) for s in 12 * t]
    after = [np.array([[0, 0, -0.1 - s], [0, 0, 0.1 + s]]) for s in 12 * t]
    frames = [*before, *[np.zeros((0, 3))] * 12, *after]
    return [f + rng.normal(0, 0.005, f.shape) for f in frames]


def test_a_meeting_that_nothing_can_tell_apart_breaks_both_tracks() -> None:
    ids, events = run(Tracker(settings=STILL), ambiguous_meeting(np.random.default_rng(2)))
    assert ids[20].tolist() == [0, 1]
    assert set(ids[-1].tolist()).isdisjoint({0, 1, -1})
    broken = [e for e in events if e.kind == "break"]
    assert broken and set(broken[0].particles[:2]) == {0, 1}
    assert "runner-up" in broken[0].reason


def test_size_tells_apart_what_position_cannot() -> None:
    frames = ambiguous_meeting(np.random.default_rng(2))
    sized = [frame_of(f, d_eq_mm=[4.0, 5.5][: len(f)]) for f in frames]
    ids, events = run(Tracker(settings=STILL), sized)
    assert ids[20].tolist() == ids[-1].tolist() == [0, 1]
    assert "break" not in kinds(events)


def test_clutter_gets_no_id_and_dropouts_are_bridged() -> None:
    rng = np.random.default_rng(4)
    frames: list[Any] = []
    for i in range(60):
        bubble = np.array([[0.0, 0, 0]]) + rng.normal(0, 0.01, (1, 3))
        frames.append(np.vstack([bubble, rng.uniform(-25, 25, (1, 3))]))
        if i in (30, 31):
            frames[-1] = frames[-1][1:]
    ids, events = run(Tracker(settings=STILL), frames)
    assert all(i[0] == 0 for n, i in enumerate(ids) if n not in (30, 31))
    assert all(i[-1] == -1 for i in ids)
    assert kinds(events) == ["birth"]


def test_birth_and_death_are_told() -> None:
    frames = [np.zeros((1, 3))] * 20 + [np.zeros((0, 3))] * 40
    ids, events = run(Tracker(settings=STILL), frames)
    assert [i.tolist() for i in ids[:20]] == [[0]] * 20
    assert kinds(events) == ["birth", "death"]
    assert events[0].frame == 2 and events[1].t_s == pytest.approx(19 / 500 + 0.05, abs=0.0021)


def test_split_and_merger_balance_volumes() -> None:
    small = 5.0 / 2 ** (1 / 3)
    one = frame_of([[0.0, 0, 0]], d_eq_mm=[5.0])
    two = frame_of([[0.0, 0, 0], [4.0, 0, 0]], d_eq_mm=[small, small])
    _, events = run(Tracker(settings=STILL), [one] * 20 + [two] * 20 + [one] * 60)
    split, merge = (next(e for e in events if e.kind == k) for k in ("split", "merge"))
    assert split.particles == (0, 1) and merge.particles == (0, 1)
    third = frame_of([[0.0, 0, 0], [4.0, 0, 0]], d_eq_mm=[5.0, small])
    _, events = run(Tracker(settings=STILL), [one] * 20 + [third] * 20)
    assert "split" not in kinds(events)


# --- stage


@pytest.mark.parametrize("encoder", [True, False])
def test_the_encoder_carries_tracks_over_a_jerk_of_the_stage(encoder: bool) -> None:
    """A stage that jumps by 6 mm between two frames: the bubble moves by -axis x 6 mm."""
    stage = np.where(np.arange(40) < 20, 0.0, 6.0)
    frames = [-UP[None] * s for s in stage]
    tracker = Tracker(settings=STILL)
    ids, events = run(tracker, frames, stage=stage if encoder else np.full(40, np.nan))
    assert ids[0].tolist() == [0]
    assert (ids[-1].tolist() == [0]) is encoder
    assert kinds(events).count("birth") == (1 if encoder else 2)


def test_without_encoder_a_ramp_of_the_stage_is_followed() -> None:
    t = np.arange(200) / 500
    speed = np.clip(280 * t / 0.15, 0, 280)
    moved = np.cumsum(speed) / 500
    rng = np.random.default_rng(6)
    base = rng.uniform(-20, 20, (5, 3))
    frames = [base + UP * (280 * ti - s) + rng.normal(0, 0.02, (5, 3)) for ti, s in zip(t, moved)]
    ids, events = run(Tracker(), frames, stage=np.full(200, np.nan))
    assert kinds(events) == ["birth"] * 5
    assert ids[0].tolist() == ids[-1].tolist()


@pytest.mark.parametrize("axis", [UP, -UP, np.array([1.0, 0.0, 0.0])])
def test_bubbles_rise_whichever_way_the_stage_counts(axis: Array) -> None:
    t = np.arange(20) / 70
    rng = np.random.default_rng(8)
    base = rng.uniform(-12, 12, (12, 3))
    moved = 250 * t[:, None] * (UP if axis @ UP else axis)
    rises = 280 + rng.normal(0, 15, (12, 1))
    frames = [base + UP * rises * a - m + rng.normal(0, 0.02, (12, 3)) for a, m in zip(t, moved)]
    ids, events = run(Tracker(axis, up=UP), frames, hz=70.0, stage=moved @ axis)
    assert kinds(events) == ["birth"] * 12 and sorted(ids[-1]) == [*range(12)]
    assert all(set(of_one) <= {-1, of_one[-1]} for of_one in zip(*ids))
    assert np.mean(np.array(ids) >= 0) > 0.85


def test_readings_that_fail_for_a_while_are_bridged() -> None:
    t = np.arange(150) / 500
    stage = 300 * t + 2 * np.sin(10 * t)
    rng = np.random.default_rng(7)
    frames = [np.array([[0, 0, 0], [9, 0, 0]]) + UP * (280 * a - s) for a, s in zip(t, stage)]
    frames = [f + rng.normal(0, 0.02, f.shape) for f in frames]
    read = np.where((np.arange(150) > 60) & (np.arange(150) < 100), np.nan, stage)
    tracker = Tracker()
    ids, events = run(tracker, frames, stage=read)
    assert kinds(events) == ["birth"] * 2 and ids[0].tolist() == ids[-1].tolist()
    velocity = tracker.states.x[:, 3:6]
    assert velocity.mean(0) == pytest.approx(280 * UP, abs=12)


# --- given ids, one camera


def test_given_ids_pass_unchanged_and_new_ones_keep_clear() -> None:
    a, b, other = [0.0, 0, 0], [0.05, 0, 0], [20.0, 0, 0]
    frames = [
        frame_of([b, other, a] if i % 2 else [a, other, b], particle=[17, -1, 5]) for i in range(30)
    ]
    ids, events = run(Tracker(settings=STILL), frames)
    assert all(i.tolist() == [17, 18, 5] for i in ids)
    assert kinds(events) == ["birth"] * 3


@pytest.mark.parametrize("seeing", [0, 1])
def test_one_camera_alone_keeps_a_track_alive(seeing: int) -> None:
    camera, tracker, final = cameras()[seeing], Tracker(settings=STILL), []
    points = np.stack([np.sin(np.arange(150) / 30), 0.01 * np.arange(150), np.zeros(150)], -1)
    for i, point in enumerate(points):
        alone = 30 <= i < 110
        uv = camera.project(point[None])
        seen = on_rays(camera, uv, 0.04 * np.eye(2)[None])
        ray = frame_of(*seen[:2], alone=[True])
        final += tracker.update(i, i / 500, ray if alone else frame_of([point]), 0.0).final
        if alone:
            there = tracker.predict(i / 500 + 1e-6, 0.0).points_mm
            assert camera.project(there) == pytest.approx(uv, abs=1.0)
    assert [ids.particle.tolist() for ids in final] == [[0]] * 150 and tracker.next_id == 1


@pytest.mark.parametrize(("share", "given"), [(0.0, 0), (1.0, 1), (0.5, -1)])
def test_what_one_camera_sees_between_two_tracks_is_given_to_neither(
    share: float, given: int
) -> None:
    """Two bubbles pass 0.2 mm apart, and for three frames one camera sees one outline there; a
    third bubble far away tells that nothing else has moved."""
    camera, tracker, final = cameras()[0], Tracker(settings=STILL), []
    noise = SIGMA_MM**2 * np.eye(3)
    for i in range(40):
        three = np.array([[0.0, 0, 0], [0.2, 0.09 * (i - 21), 0], [0, 9, 0]])
        measured = frame_of(three)
        if 20 <= i < 23:
            uv = camera.project(share * three[1:2])
            point, covariance, _ = on_rays(camera, uv, 0.04 * np.eye(2)[None])
            points, covariances = np.array([three[2], *point]), np.array([noise, *covariance])
            measured = frame_of(points, covariances, alone=[False, True])
        final += tracker.update(i, i / 500, measured, 0.0).final
    ids = [one.particle.tolist() for one in final]
    assert sorted(ids[5]) == [0, 1, 2] and ids[-1] == ids[5]
    assert ids[20:23] == [[ids[5][2], [*ids[5], -1][given]]] * 3


# --- streaming


def crowd(seed: int, frames: int = 120) -> list[Array]:
    rng = np.random.default_rng(seed)
    start, speed = rng.uniform(-4, 4, (8, 3)), rng.normal(0, 40, (8, 3))
    out = []
    for i in range(frames):
        points = start + speed * i / 500 + rng.normal(0, 0.02, (8, 3))
        clutter = rng.uniform(-5, 5, (1, 3))
        out.append(np.vstack([points[rng.random(8) > 0.05], clutter]))
    return [*out[:60], *ambiguous_meeting(rng), *out[60:]]


def test_state_does_not_grow_with_the_run() -> None:
    """A bubble that keeps jumping: a new particle every 8 frames, the old ones forgotten."""
    settings = TrackerSettings(rise_mm_s=0.0, gap_s=0.004, gap_frames=1)
    tracker, sizes = Tracker(settings=settings), []
    for i in range(400):
        tracker.update(i, i / 500, frame_of([[10.0 * (i // 8), 0, 0]]), 0.0)
        sizes.append(len(pickle.dumps(tracker)))
    assert tracker.next_id > 40
    assert max(sizes[200:]) < 1.1 * max(sizes[:200])


def test_predict_changes_nothing_and_empty_frames_are_fine() -> None:
    tracker = Tracker(settings=STILL)
    assert tracker.finish() is None
    assert len(tracker.predict(0.0, 0.0).ids) == 0
    for i in range(5):
        tracker.update(i, i / 500, frame_of([[1.0, 2, 3]]), 0.0)
    before = pickle.dumps(tracker)
    seen = tracker.predict(5 / 500, 1.0)
    assert seen.ids.tolist() == [0]
    assert seen.points_mm[0] == pytest.approx([1, 3, 3], abs=0.05)
    assert pickle.dumps(tracker) == before
    for i in range(5, 60):
        assert tracker.update(i, i / 500, frame_of([]), None).final[0].particle.size == 0


# --- refusals


def test_bad_input_is_refused_in_words() -> None:
    tracker = Tracker()
    tracker.update(3, 0.1, frame_of([]), 0.0)
    for frame, t in ((3, 0.2), (4, 0.1), (4, np.nan)):
        with pytest.raises(InputError):
            tracker.update(frame, t, frame_of([]), 0.0)
    with pytest.raises(InputError, match=r"frame 4.*twice"):
        tracker.update(4, 0.2, frame_of(np.zeros((2, 3)), particle=[1, 1]), 0.0)
    with pytest.raises(InputError, match="axis_rig"):
        Tracker(axis_rig=(0, 0, 0))


def test_a_speck_after_a_long_time_without_bubbles_begins_no_track() -> None:
    """What bubbles have in common is as well known as ever when the next ones come."""
    speck, bubble = [[0.0, 0.0, 0.0]], [[3.0, 20.0, 0.0]]
    frames = [[] for _ in range(300)] + [speck] + [bubble] * 6
    ids, _ = run(Tracker(), frames, stage=np.full(len(frames), np.nan))
    assert [i.tolist() for i in ids[300:]] == [[-1], *[[0]] * 6]
