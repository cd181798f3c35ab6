"""Compiled loops of pairing and of the body fit, against NumPy and finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from telerig.arrays import Array
from telerig.estimator.bubbles.pairing.evidence import Prediction, evidence, gate2
from telerig.estimator.bubbles.shape import kernels
from telerig.rig.pose import rotation_from_rotvec


def spread(rng: np.random.Generator, count: int, sd: Array) -> Array:
    root = rng.normal(size=(count, 3, 3)) * sd
    return np.asarray(root @ root.mT + 1e-4 * np.eye(3))


@pytest.mark.parametrize("depth_mm", [0.1, 100.0])
def test_pairings_inside_the_gate_are_those_of_every_distance(depth_mm: float) -> None:
    rng, limit = np.random.default_rng(1), gate2(3)
    tracks = Prediction(np.arange(30), rng.normal(size=(30, 3)), spread(rng, 30, np.full(3, 0.1)),
                        np.full(30, np.nan))  # fmt: skip
    points, noise = rng.normal(size=(50, 3)), spread(rng, 50, np.array([0.02, 0.02, depth_mm]))
    allowed, certain = rng.random((30, 50)) < 0.8, rng.random(50) < 0.1
    shift, unsure = np.array([0.1, 0.0, -0.1]), 0.01 * np.eye(3)
    found = evidence(tracks, points, noise, np.full(50, np.nan), allowed=allowed, certain=certain,
                     shift_mm=shift, unsure_mm2=unsure)  # fmt: skip
    between = points - tracks.points_mm[:, None]
    total = tracks.covariance_mm2[:, None] + noise
    left = (between - shift)[..., None]
    far = (left * np.linalg.solve(total + unsure, left)).sum((-1, -2))
    row, column = np.nonzero(allowed & ((far <= limit) | certain))
    assert 50 < len(row) < allowed.sum()
    np.testing.assert_array_equal(found.row, row)
    np.testing.assert_array_equal(found.column, column)
    np.testing.assert_allclose(found.innovation_mm, between[row, column], atol=1e-12)
    np.testing.assert_allclose(found.information @ total[row, column],
                               np.broadcast_to(np.eye(3), (len(row), 3, 3)), atol=1e-6)  # fmt: skip
    expected = -np.log(np.linalg.det(2 * np.pi * total[row, column])) / 2
    np.testing.assert_allclose(found.constant, expected, rtol=1e-9)


def turned(frame: Array, value: Array, change: Array) -> tuple[Array, Array]:
    """Bodies whose six parameters have changed; the pole moves towards the equatorial axes."""
    first, second = change[2:4]
    turn = rotation_from_rotvec(frame @ np.array([-second, first, 0.0]))
    return turn @ frame, value + change[[0, 1, 4, 5]]


def test_moments_and_their_derivatives() -> None:
    rng = np.random.default_rng(2)
    measure = rng.normal(size=(1, 6, 9))
    frame = rotation_from_rotvec([0.4, -0.7, 0.2])
    value = np.array([0.3, 0.25, 1e-4, -2e-4])
    axes = np.exp(0.3 + 0.25 / 3), np.exp(0.3 - 2 * 0.25 / 3)
    moments = kernels.moments(frame[None], value[None])[0]
    sphere = frame @ np.diag([axes[0] ** 2, axes[0] ** 2, axes[1] ** 2]) @ frame.T
    np.testing.assert_allclose(moments, sphere, rtol=1e-3, atol=1e-3)
    g, slope = kernels.outlines(measure, frame[None], value[None])
    np.testing.assert_allclose(g[0], measure[0] @ moments.ravel(), rtol=1e-12)
    for k in range(6):
        ends = []
        for h in (1e-5, -1e-5):
            moved, changed = turned(frame, value, h * np.eye(6)[k])
            ends.append(measure[0] @ kernels.moments(moved[None], changed[None])[0].ravel())
        np.testing.assert_allclose(slope[0, :, k], (ends[0] - ends[1]) / 2e-5, atol=2e-3)
