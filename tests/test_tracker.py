"""The tracker against dense Gaussian algebra, closed forms, and situations with a known answer."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from telerig.errors import InputError
from telerig.estimator.track_motion import birth_covariance, transition, van_loan
from telerig.estimator.track_single import expected, update_pixels
from telerig.estimator.track_types import (
    FrameMeasurements,
    FrameResult,
    SingleMeasurements,
    TrackerSettings,
    TrackEvent,
)
from telerig.estimator.tracker import Tracker
from telerig.rig.camera import Camera
from telerig.rig.pose import Pose, rotation_from_rotvec

Array = NDArray[np.float64]
UP = np.array([0.0, -1.0, 0.0])
SIGMA_MM = 0.02
STILL = TrackerSettings(rise_mm_s=0.0, birth_speed_sd_mm_s=50.0)


def frame_of(points: Any, sigma: float = SIGMA_MM, **extra: Any) -> FrameMeasurements:
    return FrameMeasurements.create(points, np.eye(3) * sigma**2, **extra)


def run(
    tracker: Tracker, frames: list[Any], hz: float = 500.0, stage: Array | None = None
) -> tuple[list[Array], list[TrackEvent]]:
    """Final ids per frame, all events; a frame is an array of points or FrameMeasurements."""
    results: list[FrameResult] = []
    for i, points in enumerate(frames):
        measured = points if isinstance(points, FrameMeasurements) else frame_of(points)
        at = 0.0 if stage is None else float(stage[i])
        results.append(tracker.update(i, i / hz, measured, at))
    last = tracker.finish()
    assert last is not None
    results.append(last)
    settled = [s for r in results for s in r.settled]
    assert [s.frame for s in settled] == list(range(len(frames)))
    return [s.particle for s in settled], [e for r in results for e in r.events]


def kinds(events: list[TrackEvent]) -> list[str]:
    return [e.kind for e in events]


# --- motion


def test_van_loan_is_the_closed_form_of_a_wiener_velocity() -> None:
    dt, q = 0.013, 7.0
    f, noise = van_loan(np.array([[0.0, 1], [0, 0]]), np.diag([0.0, q]), dt)
    assert f == pytest.approx(np.array([[1, dt], [0, 1]]), abs=1e-15)
    closed = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    assert noise == pytest.approx(closed, rel=1e-12)


def test_van_loan_is_the_closed_form_of_an_ornstein_uhlenbeck_velocity() -> None:
    dt, tau, sd = 0.05, 0.3, 10.0
    dynamics = np.array([[0.0, 1], [0, -1 / tau]])
    f, noise = van_loan(dynamics, np.diag([0.0, 2 * sd**2 / tau]), dt)
    keep = np.exp(-dt / tau)
    assert f == pytest.approx(np.array([[1, tau * (1 - keep)], [0, keep]]), rel=1e-12)
    assert noise[1, 1] == pytest.approx(sd**2 * (1 - keep**2), rel=1e-10)
    assert noise[0, 1] == pytest.approx(sd**2 * tau * (1 - keep) ** 2, rel=1e-9)


@pytest.mark.parametrize("acceleration", [False, True])
@pytest.mark.parametrize("relaxation", [np.inf, 0.2])
def test_two_steps_are_one_long_step(acceleration: bool, relaxation: float) -> None:
    settings = TrackerSettings(acceleration_state=acceleration, velocity_time_s=relaxation)
    a, b, whole = (
        transition(settings, (0.0, -1.0, 0.0), t, True, True) for t in (0.003, 0.009, 0.012)
    )
    scale = np.abs(whole.matrix).max(axis=1, keepdims=True)
    assert b.matrix @ a.matrix / scale == pytest.approx(whole.matrix / scale, rel=1e-11, abs=1e-11)
    assert b.matrix @ a.drift + b.drift == pytest.approx(whole.drift, rel=1e-9, abs=1e-8)
    noise = b.matrix @ a.noise @ b.matrix.T + b.noise
    assert noise == pytest.approx(whole.noise, rel=1e-8, abs=1e-12)


def test_mean_rise_is_the_fixed_point_of_the_relaxation() -> None:
    settings = TrackerSettings(velocity_time_s=0.1, acceleration_state=False)
    step = transition(settings, (0.0, -1.0, 0.0), 0.02, True, True)
    x = np.concatenate([np.zeros(3), 280 * UP])
    assert step.matrix @ x + step.drift == pytest.approx([0, -5.6, 0, 0, -280, 0], abs=1e-9)


# --- filter


@pytest.mark.parametrize("acceleration", [False, True])
def test_two_bubbles_under_shake_are_the_dense_gaussian_posterior(acceleration: bool) -> None:
    """Own plus common parts against one joint Gaussian over all frames, conditioned densely."""
    settings = TrackerSettings(
        rise_mm_s=0.0, birth_speed_sd_no_encoder_mm_s=120.0, acceleration_state=acceleration
    )
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.002, 0.012, 12))
    z = rng.normal(0, 0.1, (12, 2, 3)) + np.array([[0, 0, 0], [5, 0, 0]])
    r = np.diag([4e-4, 2e-4, 4e-4])
    tracker = Tracker(settings=settings)
    for i, t in enumerate(times):
        tracker.update(i, t, FrameMeasurements.create(z[i], r, particle=[4, 9]), 0.0)
    mean, covariance = _dense_posterior(settings, times, z, r)
    n = len(mean) // 2
    first, second = (t.filter for t in tracker.given)
    assert first.x == pytest.approx(mean[:n], rel=1e-6, abs=1e-7)
    assert second.x == pytest.approx(mean[n:], rel=1e-6, abs=1e-7)
    own, common = first.P, tracker.common.covariance
    assert own + common == pytest.approx(covariance[:n, :n], rel=1e-6, abs=1e-6)
    assert common == pytest.approx(covariance[:n, n:], rel=1e-6, abs=1e-6)


def _dense_posterior(
    settings: TrackerSettings, times: Array, z: Array, r: Array
) -> tuple[Array, Array]:
    """Mean and covariance of both states at the end: every state is a linear map of one vector
    of independent variables (two births, then per frame two own noises and one common)."""
    birth = birth_covariance(settings, r, True)
    n = len(birth)
    blocks, maps = [birth, birth], [np.hstack([np.eye(n), np.zeros((n, n))])]
    maps.append(np.hstack([np.zeros((n, n)), np.eye(n)]))
    rows, values = [], []
    start = [np.concatenate([z[0, k], np.zeros(n - 3)]) for k in (0, 1)]
    for i in range(1, len(times)):
        step = transition(
            settings, (0.0, -1.0, 0.0), round(times[i] - times[i - 1], 12), True, True
        )
        blocks += [step.noise, step.noise, step.common_noise]
        own = [(np.eye(n), np.zeros((n, n))), (np.zeros((n, n)), np.eye(n))]
        maps = [np.hstack([step.matrix @ m, *o, np.eye(n)]) for m, o in zip(maps, own)]
        start = [step.matrix @ s for s in start]
        for k in (0, 1):
            rows.append(maps[k][:3])
            values.append(z[i, k] - start[k][:3])
    size = sum(map(len, blocks))
    prior = np.zeros((size, size))
    at = 0
    for block in blocks:
        prior[at : at + n, at : at + n] = block
        at += n
    h = np.vstack([np.pad(row, ((0, 0), (0, size - row.shape[1]))) for row in rows])
    final = np.vstack(maps)
    total = h @ prior @ h.T + np.kron(np.eye(len(rows)), r)
    gain = final @ prior @ h.T @ np.linalg.inv(total)
    covariance = final @ prior @ final.T - gain @ h @ prior @ final.T
    return np.concatenate(start) + gain @ np.concatenate(values), covariance


def test_steady_state_is_the_riccati_solution() -> None:
    from scipy.linalg import solve_discrete_are

    settings = TrackerSettings(shake_sd_mm=0.0, acceleration_state=False)
    tracker = Tracker(settings=settings)
    for i in range(400):
        tracker.update(i, i * 0.01, frame_of([[0, 0, 0]], particle=[1]), 0.0)
    step = transition(settings, (0.0, -1.0, 0.0), 0.01, True, True)
    h, r = np.eye(3, 6), np.eye(3) * SIGMA_MM**2
    predicted = solve_discrete_are(step.matrix.T, h.T, step.noise, r)
    gain = predicted @ h.T @ np.linalg.inv(h @ predicted @ h.T + r)
    steady = predicted - gain @ h @ predicted
    found = tracker.given[0].filter.P
    assert found == pytest.approx(steady, rel=1e-5, abs=1e-8)


def test_predictions_are_as_good_as_they_say_at_irregular_times() -> None:
    rng = np.random.default_rng(5)
    settings = TrackerSettings(shake_sd_mm=0.0)
    distances = []
    for _ in range(10):
        tracker, t, x = Tracker(settings=settings), 0.0, None
        for i in range(40):
            dt = rng.uniform(0.001, 0.01)
            t += dt
            step = transition(settings, (0.0, -1.0, 0.0), round(dt, 12), True, True)
            if x is None:
                prior = birth_covariance(settings, np.zeros((3, 3)), True)
                x = rng.multivariate_normal(
                    np.concatenate([np.zeros(3), 280 * UP, np.zeros(len(prior) - 6)]), prior
                )
            else:
                x = step.matrix @ x + np.linalg.cholesky(
                    step.noise + 1e-12 * np.eye(len(prior))
                ) @ rng.normal(size=len(prior))
            z = x[:3] - 280 * t * UP + rng.normal(0, SIGMA_MM, 3)
            if i > 2:
                seen = tracker.predict(t, 280 * t)
                off = z - seen.points_mm[0]
                total = seen.covariance_mm2[0] + np.eye(3) * SIGMA_MM**2
                distances.append(off @ np.linalg.solve(total, off))
            tracker.stage.in_lab = True
            tracker.update(i, t, frame_of([z], particle=[0]), 280 * t)
    many = len(distances)
    assert abs(np.mean(distances) - 3) < 4 * np.sqrt(6 / many)


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
    gap = [e for e in events if e.kind == "gap"]
    assert len(gap) == 1 and gap[0].frame == 32 and gap[0].reason == "2 frames bridged"


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
    velocity = np.array([track.filter.x[3:6] for c in tracker.clusters for track in c.tracks])
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


def cameras() -> tuple[Camera, Camera]:
    turn = Pose(rotation_from_rotvec([0.0, np.pi / 2, 0.0]), np.zeros(3))
    return (
        Camera.create("left", (800, 800), 10.0),
        Camera.create("right", (800, 800), 10.0, camera_from_rig=turn),
    )


@pytest.mark.parametrize("seeing", [0, 1])
def test_one_camera_alone_keeps_a_track_alive(seeing: int) -> None:
    pair = cameras()
    tracker = Tracker(pair, settings=STILL)
    points = np.stack([np.sin(np.arange(150) / 30), 0.01 * np.arange(150), np.zeros(150)], -1)
    for i, point in enumerate(points):
        alone = 30 <= i < 110
        uv = pair[seeing].project(point[None])
        singles = SingleMeasurements(np.array([seeing]), uv, np.eye(2)[None] * 0.04)
        measured = frame_of([] if alone else [point], singles=singles if alone else None)
        result = tracker.update(i, i / 500, measured, 0.0)
        if alone:
            assert result.single.tolist() == [0]
            seen = pair[seeing].project(tracker.predict(i / 500 + 1e-6, 0.0).points_mm)
            assert seen == pytest.approx(uv, abs=1.0)
    assert result.particle.tolist() == [0] and tracker.next_id == 1


def test_pixel_update_equals_the_space_update_that_lacks_one_direction() -> None:
    """With an affine camera a pixel is the point measured with infinite noise along the ray."""
    pair = cameras()
    point, noise = np.array([0.12, 0.03, 0.0]), np.eye(2) * 0.04
    results = []
    for alone in (True, False):
        tracker = Tracker(pair, settings=STILL)
        for i in range(10):
            tracker.update(i, i / 500, frame_of([[0.01 * i, 0, 0]]), 0.0)
        track = tracker.clusters[0].tracks[0]
        seen = expected(pair[0], [track], np.zeros((3, 3)))
        if alone:
            uv = pair[0].project(point)
            update_pixels(track, uv, noise, seen.uv_px[0], seen.by_point[0])
        else:
            track.filter.update(point, R=np.diag([4e-4, 4e-4, 1e9]))
        results.append((track.filter.x, track.filter.P))
    (x_pixel, p_pixel), (x_point, p_point) = results
    assert x_pixel == pytest.approx(x_point, abs=1e-6)
    assert p_pixel == pytest.approx(p_point, rel=1e-5, abs=1e-6)


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


def test_an_interrupted_run_goes_on_bit_by_bit() -> None:
    frames = crowd(0)
    whole = Tracker(settings=STILL)
    resumed, was_open = Tracker(settings=STILL), 0
    for i, points in enumerate(frames):
        expected = whole.update(i, i / 500, frame_of(points), 0.01 * i)
        got = resumed.update(i, i / 500, frame_of(points), 0.01 * i)
        assert got.particle.tolist() == expected.particle.tolist()
        assert got.events == expected.events
        assert [s.particle.tolist() for s in got.settled] == [
            s.particle.tolist() for s in expected.settled
        ]
        was_open += any(c.open for c in whole.clusters)
        if i % 3 == 0:
            stored = json.dumps(resumed.to_dict())
            resumed = Tracker(settings=STILL)
            resumed.restore(json.loads(stored))
    assert was_open > 3
    assert json.dumps(resumed.to_dict()) == json.dumps(whole.to_dict())


def test_state_does_not_grow_with_the_run() -> None:
    """A bubble that keeps jumping: a new particle every 8 frames, the old ones forgotten."""
    settings = TrackerSettings(rise_mm_s=0.0, gap_s=0.004, gap_frames=1)
    tracker, sizes = Tracker(settings=settings), []
    for i in range(400):
        tracker.update(i, i / 500, frame_of([[10.0 * (i // 8), 0, 0]]), 0.0)
        sizes.append(len(json.dumps(tracker.to_dict())))
    assert tracker.next_id > 40
    assert len(tracker.to_dict()["ledger"]["seen"]) < 24
    assert max(sizes[200:]) < 1.1 * max(sizes[:200])


def test_predict_changes_nothing_and_empty_frames_are_fine() -> None:
    tracker = Tracker(settings=STILL)
    assert tracker.finish() is None
    assert len(tracker.predict(0.0, 0.0).ids) == 0
    for i in range(5):
        tracker.update(i, i / 500, frame_of([[1.0, 2, 3]]), 0.0)
    before = json.dumps(tracker.to_dict())
    seen = tracker.predict(5 / 500, 1.0)
    assert seen.ids.tolist() == [0]
    assert seen.points_mm[0] == pytest.approx([1, 3, 3], abs=0.05)
    assert json.dumps(tracker.to_dict()) == before
    for i in range(5, 60):
        assert tracker.update(i, i / 500, frame_of([]), None).particle.size == 0


# --- refusals


def test_bad_input_is_refused_in_words() -> None:
    tracker = Tracker(cameras())
    tracker.update(3, 0.1, frame_of([]), 0.0)
    for frame, t in ((3, 0.2), (4, 0.1), (4, np.nan)):
        with pytest.raises(InputError):
            tracker.update(frame, t, frame_of([]), 0.0)
    alone = SingleMeasurements(np.array([2]), np.zeros((1, 2)), np.eye(2)[None])
    with pytest.raises(InputError, match="2 cameras"):
        tracker.update(5, 0.3, frame_of([], singles=alone), 0.0)
    with pytest.raises(InputError, match="not finite"):
        frame_of([[np.nan, 0, 0]])
    with pytest.raises(InputError, match="twice"):
        frame_of(np.zeros((2, 3)), particle=[1, 1])
    with pytest.raises(InputError, match="d_eq_mm"):
        frame_of(np.zeros((2, 3)), d_eq_mm=[1.0])
    with pytest.raises(InputError, match="detection_probability"):
        TrackerSettings(detection_probability=1.0)
    with pytest.raises(InputError, match="confirm_hits"):
        TrackerSettings(confirm_hits=5)
    with pytest.raises(InputError, match="axis_rig"):
        Tracker(axis_rig=(0, 0, 0))
    other = Tracker(settings=STILL)
    with pytest.raises(InputError, match="other settings"):
        other.restore(tracker.to_dict())
