"""Bubbles that one image hides: smoothed points against a dense least-squares solution."""

from __future__ import annotations

import numpy as np
import pytest

from telerig.estimator.tracking.linking.backtracking import smooth_points
from telerig.estimator.tracking.linking.filter import (
    Motion,
    TrackerSettings,
    birth_covariance,
    transition,
)

Reading = tuple[np.ndarray, np.ndarray, np.ndarray]

FRAMES, HIDDEN = 24, range(9, 15)
SETTINGS = TrackerSettings()
SIDE = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def _run(rng: np.random.Generator) -> tuple[list[Reading | None], list[Motion | None], np.ndarray]:
    """Readings of a bubble drawn from the motion model; HIDDEN frames lack the depth."""
    step = transition(SETTINGS, (0.0, -1.0, 0.0), 0.004, True)
    prior = birth_covariance(SETTINGS, np.zeros((3, 3)), True)
    x = rng.multivariate_normal(np.zeros(len(prior)), prior)
    root = np.linalg.cholesky(step.noise + 1e-14 * np.eye(len(x)))
    noise = np.diag([0.01, 0.007, 0.01]) ** 2
    truth, readings, motions = [], [], []
    for k in range(FRAMES):
        offset = rng.normal(0, 0.2, len(x)) * (np.arange(len(x)) < 3)
        x = step.matrix @ x + offset + root @ rng.normal(size=len(x)) if k else x
        h = SIDE if k in HIDDEN else np.eye(3)
        r = h @ noise @ h.T
        readings.append((h @ x[:3] + rng.multivariate_normal(np.zeros(len(h)), r), r, h))
        motions.append(Motion(step.matrix, step.noise, offset) if k else None)
        truth.append(x[:3])
    readings[5] = None
    return readings, motions, np.array(truth)


def _smoothed(
    readings: list[Reading | None], motions: list[Motion | None]
) -> tuple[np.ndarray, np.ndarray]:
    """Beside a second bubble that nobody sees, which must not matter."""
    measured, noise = np.full((FRAMES, 2, 3), np.nan), np.full((FRAMES, 2, 3, 3), np.nan)
    for k, reading in enumerate(readings):
        if reading is not None:
            value, own, h = reading
            noise[k, 0] = h.T @ own @ h + 1e6 * (np.eye(3) - h.T @ h)
            measured[k, 0] = h.T @ value
    points, covariances = smooth_points(measured, noise, motions, SETTINGS)
    return points[:, 0], covariances[:, 0]


def test_equals_the_dense_gaussian_posterior() -> None:
    readings, motions, _ = _run(np.random.default_rng(0))
    readings[0] = readings[1] = None
    points, covariances = _smoothed(readings, motions)
    p = birth_covariance(SETTINGS, 1e4 * np.eye(3), encoder=False)
    n = len(p)
    mean, joint = np.zeros((FRAMES, n)), np.zeros((FRAMES, n, FRAMES, n))
    mean[0, :3], joint[0, :, 0] = readings[2][0], p
    for k in range(1, FRAMES):
        m = motions[k]
        mean[k] = m.matrix @ mean[k - 1] + m.offset
        joint[k, :, :k] = np.einsum("ij,jab->iab", m.matrix, joint[k - 1, :, :k])
        joint[:k, :, k] = np.moveaxis(joint[k, :, :k], 0, -1)
        joint[k, :, k] = m.matrix @ joint[k - 1, :, k - 1] @ m.matrix.T + m.noise
    rows = [(k, r) for k, r in enumerate(readings) if r is not None]
    sizes = [len(r[0]) for _, r in rows]
    h, noise = np.zeros((sum(sizes), FRAMES * n)), np.zeros((sum(sizes),) * 2)
    for at, (k, r) in zip(np.cumsum([0, *sizes]), rows):
        here = slice(at, at + len(r[0]))
        h[here, k * n : k * n + 3], noise[here, here] = r[2], r[1]
    dense = joint.reshape(FRAMES * n, -1)
    gain = np.linalg.solve(h @ dense @ h.T + noise, h @ dense).T
    left = np.concatenate([r[0] for _, r in rows]) - h @ mean.ravel()
    posterior = (mean.ravel() + gain @ left).reshape(FRAMES, n)[:, :3]
    spread = (dense - gain @ h @ dense).reshape(FRAMES, n, FRAMES, n)
    assert points == pytest.approx(posterior, abs=1e-5)
    for k in range(FRAMES):
        assert covariances[k] == pytest.approx(spread[k, :3, k, :3], abs=1e-7)


def test_hidden_depth_is_as_good_as_it_says() -> None:
    rng, units, errors = np.random.default_rng(1), [], []
    for _ in range(60):
        readings, motions, truth = _run(rng)
        points, covariances = _smoothed(readings, motions)
        off = (points - truth)[list(HIDDEN), 2]
        units.append(off / np.sqrt(covariances[list(HIDDEN), 2, 2]))
        errors.append(off)
    assert np.sqrt(np.mean(np.square(units))) == pytest.approx(1.0, abs=0.2)
    assert np.sqrt(np.mean(np.square(errors))) < 0.1
