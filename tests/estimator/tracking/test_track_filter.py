"""Motion and filter of the tracker against closed forms and dense Gaussian algebra."""

from __future__ import annotations

import numpy as np
import pytest
from tracker_runs import SIGMA_MM, UP, Array, frame_of

from telerig.estimator.tracking.linking.filter import (
    DRIFT,
    Scan,
    States,
    TrackerSettings,
    birth_covariance,
    transition,
)
from telerig.estimator.tracking.linking.frames import Bubbles
from telerig.estimator.tracking.linking.tracker import Tracker
from telerig.factors.state_space import exact_step

# --- motion


def test_a_step_is_the_closed_form_of_a_wiener_velocity() -> None:
    dt, q = 0.013, 7.0
    f, noise = exact_step(np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [np.sqrt(q)]]), dt)
    assert f == pytest.approx(np.array([[1, dt], [0, 1]]), abs=1e-15)
    closed = q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    assert noise == pytest.approx(closed, rel=1e-12)


def test_a_step_is_the_closed_form_of_an_ornstein_uhlenbeck_velocity() -> None:
    dt, tau, sd = 0.05, 0.3, 10.0
    dynamics = np.array([[0.0, 1], [0, -1 / tau]])
    f, noise = exact_step(dynamics, np.array([[0.0], [sd * np.sqrt(2 / tau)]]), dt)
    keep = np.exp(-dt / tau)
    assert f == pytest.approx(np.array([[1, tau * (1 - keep)], [0, keep]]), rel=1e-12)
    assert noise[1, 1] == pytest.approx(sd**2 * (1 - keep**2), rel=1e-10)
    assert noise[0, 1] == pytest.approx(sd**2 * tau * (1 - keep) ** 2, rel=1e-9)


def test_two_steps_are_one_long_step() -> None:
    a, b, whole = (
        transition(TrackerSettings(), (0.0, -1.0, 0.0), t, True) for t in (0.003, 0.009, 0.012)
    )
    scale = np.abs(whole.matrix).max(axis=1, keepdims=True)
    assert b.matrix @ a.matrix / scale == pytest.approx(whole.matrix / scale, rel=1e-11, abs=1e-11)
    noise = b.matrix @ a.noise @ b.matrix.T + b.noise
    assert noise == pytest.approx(whole.noise, rel=1e-8, abs=1e-12)


# --- filter


def test_two_bubbles_under_shake_are_the_dense_gaussian_posterior() -> None:
    """Own plus common parts against one joint Gaussian over all frames, conditioned densely."""
    settings = TrackerSettings(rise_mm_s=0.0, birth_speed_sd_no_encoder_mm_s=120.0)
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.002, 0.012, 12))
    z = rng.normal(0, 0.1, (12, 2, 3)) + np.array([[0, 0, 0], [5, 0, 0]])
    r = np.diag([4e-4, 2e-4, 4e-4])
    tracker = Tracker(settings=settings)
    for i, t in enumerate(times):
        tracker.update(i, t, frame_of(z[i], r, particle=[4, 9]), 0.0)
    mean, covariance = _dense_posterior(settings, times, z, r)
    n = len(mean) // 2
    first, second = tracker.states.x
    assert first == pytest.approx(mean[:n], rel=1e-6, abs=1e-7)
    assert second == pytest.approx(mean[n:], rel=1e-6, abs=1e-7)
    own, common = tracker.states.p[0], tracker.common.covariance
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
        step = transition(settings, (0.0, -1.0, 0.0), round(times[i] - times[i - 1], 12), True)
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
    """Without the drift along the rise, a constant of the model that nothing drives."""
    from scipy.linalg import solve_discrete_are

    settings = TrackerSettings(shake_sd_mm=0.0)
    tracker = Tracker(settings=settings)
    for i in range(400):
        tracker.update(i, i * 0.01, frame_of([[0, 0, 0]], particle=[1]), 0.0)
    step = transition(settings, (0.0, -1.0, 0.0), 0.01, True)
    driven = np.ix_(*[np.delete(np.arange(12), DRIFT.start + 1)] * 2)
    matrix, noise = step.matrix[driven], step.noise[driven]
    h, r = np.eye(3, 11), np.eye(3) * SIGMA_MM**2
    predicted = solve_discrete_are(matrix.T, h.T, noise, r)
    gain = predicted @ h.T @ np.linalg.inv(h @ predicted @ h.T + r)
    steady = predicted - gain @ h @ predicted
    found = tracker.states.p[0][driven]
    assert found == pytest.approx(steady, rel=1e-5, abs=1e-6)


def test_predictions_are_as_good_as_they_say_at_irregular_times() -> None:
    rng = np.random.default_rng(5)
    settings = TrackerSettings(shake_sd_mm=0.0)
    distances = []
    for _ in range(10):
        tracker, t, x = Tracker(settings=settings), 0.0, None
        for i in range(40):
            dt = rng.uniform(0.001, 0.01)
            t += dt
            step = transition(settings, (0.0, -1.0, 0.0), round(dt, 12), True)
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


def test_covariances_stay_positive_through_many_sharp_measurements() -> None:
    # 0.05 µm after an unknown depth, at 333 Hz: P - K S K' was indefinite after some tens of frames
    sharp, settings = 2.5e-9 * np.eye(3), TrackerSettings()

    def scan(frame: int) -> Scan:
        one = np.ones((1, 2), int)
        seen = Bubbles.of(one, np.zeros((1, 3)), sharp[None], -one[:, 0], np.ones(1))
        return Scan(frame, frame / 333, seen, settings)

    none, first = np.zeros(1, int), scan(0)
    states = States.born(first, none, none, np.zeros(3), False)
    deep = np.array([1e3, 1.0, -1e3])
    states.p[:, :3, :3] += np.outer(deep, deep)
    step = transition(settings, (0.0, -1.0, 0.0), 1 / 333, False)
    for frame in range(1, 300):
        states = states.predicted(step, np.zeros(3), np.zeros(12))
        states = states.updated(
            scan(frame), none, np.zeros((1, 12)), np.zeros((1, 3, 3)), np.zeros((12, 3))
        )
        p = states.p[0]
        scale = np.sqrt(np.abs(np.diag(p)))
        assert np.linalg.eigvalsh((p + p.T) / 2 / np.outer(scale, scale)).min() > 0, frame
        assert np.abs(p - p.T).max() < 1e-9 * scale.max() ** 2
